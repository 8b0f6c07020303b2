"""``jaxsonar lines``: straight lines around the robot, scan by scan."""

import argparse
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import partial
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxsonar.detection.extract import LocalModel

from jaxsonar.cli.arguments import RING_HELP, SETTINGS_HELP, add_method, figure_filename, number
from jaxsonar.cli.console import check_sigma_is_used, print_left_out, print_status, settings_beside, with_progress

SUMMARY = "Straight lines around the robot, from every scan of a log."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar lines``."""
    parser.add_argument("log", metavar="LOG", help="scan log, .csv or .parquet")
    parser.add_argument("--ring", required=True, help=RING_HELP)
    add_method(parser)
    parser.add_argument("--settings", metavar="TOML", help=SETTINGS_HELP)
    parser.add_argument(
        "-o", "--output", metavar="LINES", required=True, help="JSON Lines, an object a scan; - = stdout"
    )
    parser.add_argument(
        "--figure", type=figure_filename, metavar="FIG", help="draw arcs and lines of one scan, .svg, .png or .pdf"
    )
    parser.add_argument("--scan", type=number(int, -(2**62), 2**62), metavar="N", help="scan to draw (default: first)")


def run(options: argparse.Namespace) -> None:
    """``jaxsonar lines``."""
    from jaxsonar.detection.extract import local_models
    from jaxsonar.detection.local_map import save_models
    from jaxsonar.detection.settings import hough_settings
    from jaxsonar.detection.settings_toml import load_settings, save_settings
    from jaxsonar.fileio.atomic_files import check_outputs, shown
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.scans.log_file import load_log
    from jaxsonar.sensors.ring_toml import load_ring

    check_outputs({"-o": options.output, "--figure": options.figure}, [options.log, options.ring, options.settings])
    if options.scan is not None and not options.figure:
        raise SonarError(f"--scan {options.scan} came alone; allowed is --scan with --figure, to which it belongs")
    check_sigma_is_used(options.sigma, options.method, None)
    ring, log = load_ring(options.ring), load_log(options.log)
    settings = hough_settings(ring, load_settings(options.settings) if options.settings else None)
    if options.scan is not None and options.scan not in log.scan:
        held = f"numbers from {log.scan.min()} to {log.scan.max()}" if len(log) else "none"
        raise SonarError(f"--scan {options.scan}: no such scan in {shown(options.log)}; it holds {len(log)}, {held}")

    try:
        models = local_models(
            ring,
            log,
            method=options.method,
            settings=settings,
            sigma=options.sigma,
            on_left_out=partial(print_left_out, ring.name),
        )
    except SonarError as error:
        raise SonarError(f"{shown(options.log)}: {error}") from None
    tally = RunSummary(options.scan)
    save_models(tally.watch(with_progress(models, len(log), "scans")), options.output)
    if beside := settings_beside(options.output):
        save_settings(settings, beside)
    model = tally.wanted
    if options.figure and model is None:
        print_status(f"no scan to draw: {options.figure} is not written")
    elif options.figure and model is not None:
        from jaxsonar.reports import plot_scan as figures_scan
        from jaxsonar.reports import plot_style as figures

        scan = log[int((log.scan == model.scan).argmax())]
        figures.save(figures_scan.lines_figure(ring, scan, model), options.figure)
    print_status(tally.summary())


class RunSummary:
    """What a run over many scans came to, and the model that a figure is wanted of."""

    def __init__(self, scan: int | None):
        self.scans = self.lines = self.with_lines = 0
        self.reasons: Counter[str] = Counter()
        self.scan = scan
        self.wanted: LocalModel | None = None

    def watch(self, models: "Iterable[LocalModel]") -> "Iterator[LocalModel]":
        for model in models:
            self.scans += 1
            self.lines += len(model.lines)
            self.with_lines += bool(model.lines)
            if model.empty:
                self.reasons[model.empty] += 1
            if self.wanted is None and self.scan in (None, model.scan):
                self.wanted = model
            yield model

    def summary(self) -> str:
        share = f" ({100 * self.with_lines / self.scans:.1f} %)" if self.scans else ""
        reasons = "".join(f"; {count} without: {why}" for why, count in self.reasons.most_common())
        return f"{self.scans} scans, {self.lines} lines, {self.with_lines} scans with lines{share}{reasons}"
