"""``jaxsonar lines``: detected lines around the robot, scan by scan."""

import argparse
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import partial
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxsonar.detection.local_model import LocalModel

from jaxsonar.cli.arguments import add_detection_arguments, figure_filename, number
from jaxsonar.cli.console import (
    check_sigma_is_used,
    errors_in,
    print_left_out,
    print_status,
    settings_filename,
    with_progress,
    write_figure,
)
from jaxsonar.cli.inputs import add_log_arguments, load_inputs, nothing_used

SUMMARY = "Detect lines around the robot, in every scan of a log."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar lines``."""
    add_log_arguments(parser)
    add_detection_arguments(parser)
    parser.add_argument(
        "-o", "--output", metavar="LINES", required=True, help="JSON Lines, one object per scan; - = stdout"
    )
    parser.add_argument(
        "--figure", type=figure_filename, metavar="FIG", help="draw arcs and lines of one scan, .svg, .png or .pdf"
    )
    parser.add_argument("--scan", type=number(int, -(2**62), 2**62), metavar="N", help="scan to draw (default: first)")


def run(options: argparse.Namespace) -> int:
    """Run ``jaxsonar lines``. Returns 1 if no echo could be used."""
    from jaxsonar.detection.extract import local_models
    from jaxsonar.detection.local_model import save_models
    from jaxsonar.detection.settings import hough_settings
    from jaxsonar.detection.settings_toml import load_settings, save_settings
    from jaxsonar.fileio.atomic_files import check_outputs, shown
    from jaxsonar.hardware.errors import SonarError

    check_outputs({"-o": options.output, "--figure": options.figure}, [options.log, options.ring, options.settings])
    if options.scan is not None and not options.figure:
        raise SonarError(f"--scan {options.scan} came alone; allowed is --scan with --figure, to which it belongs")
    check_sigma_is_used(options.sigma, options.method)
    ring, log = load_inputs(options)
    settings = hough_settings(ring, load_settings(options.settings) if options.settings else None)
    if options.scan is not None and options.scan not in log.scan:
        numbers = f"numbers from {log.scan.min()} to {log.scan.max()}" if len(log) else "none"
        raise SonarError(f"--scan {options.scan}: no such scan in {shown(options.log)}; it holds {len(log)}, {numbers}")
    if nothing_used(ring, log, options.log):
        return 1
    with errors_in(options.log):
        models = local_models(
            ring,
            log,
            method=options.method,
            settings=settings,
            sigma=options.sigma,
            on_left_out=partial(print_left_out, ring.name),
        )
    summary = RunSummary(options.scan)
    save_models(summary.observe(with_progress(models, len(log), "scans")), options.output)
    if settings_file := settings_filename(options.output):
        save_settings(settings, settings_file)
    model = summary.model_to_draw
    if options.figure and model is None:
        print_status(f"no scan to draw: {options.figure} is not written")
    elif options.figure and model is not None:
        from jaxsonar.reports.plot_scan import lines_figure

        scan = log[int((log.scan == model.scan).argmax())]
        write_figure(lines_figure(ring, scan, model), options.figure)
    print_status(summary.text())
    return 0


class RunSummary:
    """Counts lines over all scans, and keeps the local model that is to be drawn."""

    def __init__(self, scan_to_draw: int | None):
        self.scans = self.lines = self.scans_with_lines = 0
        self.reasons: Counter[str] = Counter()
        """Number of scans without lines, by reason."""
        self.scan_to_draw = scan_to_draw
        self.model_to_draw: LocalModel | None = None

    def observe(self, models: "Iterable[LocalModel]") -> "Iterator[LocalModel]":
        """Yield the same models, and count them."""
        for model in models:
            self.scans += 1
            self.lines += len(model.lines)
            self.scans_with_lines += bool(model.lines)
            if model.empty:
                self.reasons[model.empty] += 1
            if self.model_to_draw is None and self.scan_to_draw in (None, model.scan):
                self.model_to_draw = model
            yield model

    def text(self) -> str:
        """One line for the user."""
        share = f" ({100 * self.scans_with_lines / self.scans:.1f} %)" if self.scans else ""
        reasons = "".join(f"; {count} without: {reason}" for reason, count in self.reasons.most_common())
        return f"{self.scans} scans, {self.lines} lines, {self.scans_with_lines} scans with lines{share}{reasons}"
