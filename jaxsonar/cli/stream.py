"""``jaxsonar stream``: lines, a growing map and an occupancy grid from a device, live."""

import argparse
import os
import sys
import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

from jaxsonar.hardware.errors import SonarError

if TYPE_CHECKING:
    from jaxsonar.hardware.transport_base import LinkEvent
    from jaxsonar.live.status import Status


from jaxsonar.cli.arguments import (
    ODOMETRY_HELP,
    add_detection_arguments,
    add_grid_arguments,
    filename_ending_in,
    finite,
    grid_outputs,
    number,
    odometry_error,
    odometry_noise,
)
from jaxsonar.cli.console import calibrated_certain_angle, check_sigma_is_used, print_status, stopped_by_signals
from jaxsonar.cli.inputs import InputMessages, add_strict, load_checked_ring

TERMINAL_INTERVAL, LOG_INTERVAL = 1.0, 10.0
"""Seconds between two status lines, on a terminal and elsewhere. Chosen by hand."""

SUMMARY = "Detect lines and build a map from a device, live."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar stream``."""
    parser.add_argument(
        "url",
        metavar="URL",
        help="serial:///dev/ttyUSB0?baud=921600, tcp://HOST:PORT, udp://HOST:PORT, pty:PATH or file:LOG?speed=1",
    )
    add_detection_arguments(parser)
    parser.add_argument(
        "--record",
        type=filename_ending_in(".csv", ".parquet", ".mcap"),
        metavar="LOG",
        help="record everything: .csv, .parquet: a scan log; .mcap: the raw messages (extra live)",
    )
    parser.add_argument(
        "--map", type=filename_ending_in(".geojson", ".json"), metavar="MAP", help="GeoJSON, written every 2 s"
    )
    add_grid_arguments(parser)
    parser.add_argument(
        "--slam",
        action="store_true",
        help="treat the device's poses as odometry, and estimate the robot's poses; map and grid follow when they are "
        "corrected",
    )
    parser.add_argument(
        "--trajectory",
        type=filename_ending_in(".tum", ".txt"),
        metavar="TRAJ",
        help="with --slam: the poses, TUM, at the end",
    )
    parser.add_argument("--odometry", type=odometry_error, metavar="PERCENT,DEG", help=ODOMETRY_HELP)
    parser.add_argument(
        "--scans",
        type=number(int, 1, 2**62),
        metavar="N",
        help="stop after N scans (default: at the end of the stream)",
    )
    parser.add_argument(
        "--wait",
        type=number(float, 0, 86400),
        default=0.0,
        metavar="S",
        help="wait up to S seconds for a device that cannot be opened yet",
    )
    parser.add_argument(
        "--no-echo",
        action="append",
        default=[],
        type=finite(-1e9),
        metavar="METRES",
        help="file:LOG: a range that means no echo; can be repeated",
    )
    add_strict(parser)
    parser.add_argument("--view", action="store_true", help="show the stream (extra viz), on this machine only")
    parser.add_argument(
        "--rrd", type=filename_ending_in(".rrd"), metavar="FILE", help="the view as a file for rerun (extra viz)"
    )


def run(options: argparse.Namespace) -> int:
    """Run ``jaxsonar stream``."""
    from jaxsonar.detection.settings_toml import load_settings
    from jaxsonar.fileio.atomic_files import check_outputs, shown
    from jaxsonar.fileio.compilation_cache import use_compilation_cache
    from jaxsonar.hardware.transport_base import NotOpenedError, parse_url
    from jaxsonar.live.grid_files import second_image_filename
    from jaxsonar.live.stream import stream as stream_scans

    check_sigma_is_used(options.sigma, options.method)
    url = parse_url(options.url)
    replayed = url.path if url.scheme == "file" else None
    if (options.trajectory or options.odometry) and not options.slam:
        raise SonarError("--trajectory or --odometry came without --slam; allowed are they with --slam")
    if options.no_echo and replayed is None:
        raise SonarError("--no-echo came with a device; allowed is it with file:LOG")
    grid_mode = options.grid_mode or "trinary"
    second_image = options.grid and second_image_filename(options.grid, mode=grid_mode)
    outputs = {
        "--record": options.record,
        "--map": options.map,
        **grid_outputs(options),
        "--grid's second image": second_image,
        "--rrd": options.rrd,
        "--trajectory": options.trajectory,
    }
    check_outputs(outputs, [options.ring, options.settings, replayed])
    messages = InputMessages(strict=options.strict)
    ring = load_checked_ring(options.ring, messages)
    messages.warn_of_noise(options.sigma)
    messages.check()
    settings = load_settings(options.settings) if options.settings else None
    view = None
    if options.view or options.rrd:
        from jaxsonar.live.rerun_viewer import RerunViewer

        view = RerunViewer(ring, file=options.rrd, print_status=print_status)
    use_compilation_cache()
    status_line = StatusLine(messages)
    try:
        with stopped_by_signals() as stop:
            status_line.stop = stop
            status = stream_scans(
                options.url,
                ring,
                method=options.method,
                settings=settings,
                sigma=options.sigma,
                record=options.record,
                map_filename=options.map,
                grid=options.grid,
                grid_method=options.grid_method or "counts",
                grid_mode=grid_mode,
                grid_certain=calibrated_certain_angle(options.ring) if options.grid else None,
                odometry_noise=odometry_noise(options.odometry) if options.slam else None,
                trajectory=options.trajectory,
                scans=options.scans,
                no_echo=options.no_echo,
                wait=options.wait,
                view=view,
                on_status=status_line.status,
                on_event=status_line.event,
                stop=stop,
            )
    except NotOpenedError:
        if status_line.stop is None or not status_line.stop.is_set():
            raise
        print_status("jaxsonar stream: interrupted")
        return 1
    except KeyboardInterrupt:
        print_status("jaxsonar stream: interrupted")
        _exit_now(1)
    status_line.last(status)
    reason = ""
    if unknown := status.unknown_protocol():
        messages.warn(f"{shown(options.url)}: {unknown}")
        reason = str(unknown)
    elif reason := status.why_nothing_is_used(ring):
        print_status(f"nothing found: {shown(options.url)}: {reason}")
    try:
        messages.check()
    except SonarError as error:
        if status.warm:
            raise
        print_status(f"jaxsonar stream: {error}")
        _exit_now(2)
    if not status.warm:
        _exit_now(int(bool(reason)))
    if status.no_grid and not reason:
        raise SonarError(f"--grid {shown(options.grid)}: {status.no_grid}")
    return int(bool(reason))


class StatusLine:
    """Prints the status: an overwritten line on a terminal, new lines at intervals elsewhere; events at once."""

    def __init__(self, messages: InputMessages):
        self.stop: threading.Event | None = None
        """Set if a warning ends the stream (``--strict``)."""
        self._messages = messages
        self._is_terminal = sys.stderr.isatty()
        self._printed_at = 0.0
        self._ending = False
        self._start = time.monotonic()
        self._lock = threading.Lock()

    def status(self, status: "Status") -> None:
        """Print the status if it is due."""
        now = time.monotonic()
        was_ending, self._ending = self._ending, status.ending
        if (
            now - self._printed_at >= (TERMINAL_INTERVAL if self._is_terminal else LOG_INTERVAL)
            or self._ending > was_ending
        ):
            first, self._printed_at = self._printed_at == 0.0, now
            if self._is_terminal or self._ending or not first:
                self._write(status.text(), overwrite=True)

    def event(self, event: "LinkEvent") -> None:
        """Print a link event; called in the reading thread."""
        self._write(event.text)
        if event.text.startswith("warning: "):
            self._messages.warnings.append(event.text.removeprefix("warning: "))
            if self._messages.strict and self.stop is not None:
                self.stop.set()

    def last(self, status: "Status") -> None:
        """Print the final status."""
        seconds = time.monotonic() - self._start
        self._write(f"{status.text()}; {seconds:.1f} s")

    def _write(self, text: str, *, overwrite: bool = False) -> None:
        with self._lock:
            if self._is_terminal:
                print(f"\r\x1b[2K{text}", end="" if overwrite else "\n", file=sys.stderr, flush=True)
            else:
                print_status(text)


def _exit_now(code: int) -> NoReturn:
    """Exit without waiting for a compilation, which cannot be cancelled. All files are written already."""
    for file in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            file.flush()
    os._exit(code)
