"""``jaxsonar stream``: lines and a growing map from a device, live."""

import argparse
import os
import sys
import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

from jaxsonar.hardware.errors import SonarError

if TYPE_CHECKING:
    from jaxsonar.hardware.transport_base import Event
    from jaxsonar.live.stream import Status


from jaxsonar.cli.arguments import (
    ODOMETRY_HELP,
    RING_HELP,
    SETTINGS_HELP,
    SIGMA_HELP,
    filename_ending_in,
    finite,
    number,
    odometry_error,
    odometry_noise_of,
)
from jaxsonar.cli.console import check_sigma_is_used, print_status, stopped_by_signals

ON_TERMINAL, ELSEWHERE = 1.0, 10.0
"""Seconds between two status lines."""

SUMMARY = "Lines and a growing map from a device, live."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar stream``."""
    parser.add_argument(
        "url",
        metavar="URL",
        help="serial:///dev/ttyUSB0?baud=921600, tcp://HOST:PORT, udp://HOST:PORT, pty:PATH or file:LOG?speed=1",
    )
    parser.add_argument("--ring", required=True, help=RING_HELP)
    parser.add_argument(
        "--method", choices=("ml", "hough"), default="ml", help="default: ml; hough: the paper's, faster"
    )
    parser.add_argument("--sigma", type=finite(1e-4, 1), metavar="METRES", help=SIGMA_HELP)
    parser.add_argument("--settings", metavar="TOML", help=SETTINGS_HELP)
    parser.add_argument(
        "--record",
        type=filename_ending_in(".csv", ".parquet", ".mcap"),
        metavar="LOG",
        help="keep everything: .csv, .parquet: a scan log; .mcap: the raw messages (extra live)",
    )
    parser.add_argument(
        "--map", type=filename_ending_in(".geojson", ".json"), metavar="MAP", help="GeoJSON, written every 2 s"
    )
    parser.add_argument("--slam", action="store_true", help="the device's poses are odometry: estimate the robot's own")
    parser.add_argument(
        "--trajectory",
        type=filename_ending_in(".tum", ".txt"),
        metavar="TRAJ",
        help="with --slam: the poses, TUM, at the end",
    )
    parser.add_argument("--odometry", type=odometry_error, metavar="PERCENT,DEG", help=ODOMETRY_HELP)
    parser.add_argument(
        "--scans", type=number(int, 1, 2**62), metavar="N", help="end after N scans (default: with the device)"
    )
    parser.add_argument("--view", action="store_true", help="show it (extra viz), on this machine only")
    parser.add_argument(
        "--rrd", type=filename_ending_in(".rrd"), metavar="FILE", help="the view as a file for rerun (extra viz)"
    )


def run(options: argparse.Namespace) -> None:
    """``jaxsonar stream``."""
    from jaxsonar.detection.settings_toml import load_settings
    from jaxsonar.fileio.atomic_files import check_outputs
    from jaxsonar.fileio.compilation_cache import use_compilation_cache
    from jaxsonar.hardware.transport_base import parse_url
    from jaxsonar.live.stream import stream as stream_scans
    from jaxsonar.sensors.ring_toml import load_ring

    check_sigma_is_used(options.sigma, options.method, None)
    url = parse_url(options.url)
    played = url.path if url.scheme == "file" else None
    if (options.trajectory or options.odometry) and not options.slam:
        raise SonarError("--trajectory or --odometry came without --slam; allowed are they with --slam")
    outputs = {
        "--record": options.record,
        "--map": options.map,
        "--rrd": options.rrd,
        "--trajectory": options.trajectory,
    }
    check_outputs(outputs, [options.ring, options.settings, played])
    ring = load_ring(options.ring)
    settings = load_settings(options.settings) if options.settings else None
    view = None
    if options.view or options.rrd:
        from jaxsonar.live.rerun_viewer import View

        view = View(ring, file=options.rrd, say=print_status)
    use_compilation_cache()
    show = StatusLine()
    try:
        with stopped_by_signals() as stop:
            status = stream_scans(
                options.url,
                ring,
                method=options.method,
                settings=settings,
                sigma=options.sigma,
                record=options.record,
                map_path=options.map,
                slip=odometry_noise_of(options.odometry) if options.slam else None,
                trajectory=options.trajectory,
                scans=options.scans,
                view=view,
                on_status=show.status,
                on_event=show.event,
                stop=stop,
            )
    except KeyboardInterrupt:
        print_status("jaxsonar stream: interrupted")
        _end(1)
    show.last(status)
    if not status.warm:
        _end(0)


class StatusLine:
    """One line that is written over on a terminal, now and then a new one elsewhere; events at once."""

    def __init__(self):
        self._terminal = sys.stderr.isatty()
        self._at = 0.0
        self._ending = False
        self._began = time.monotonic()
        self._lock = threading.Lock()

    def status(self, status: "Status") -> None:
        """How it goes."""
        now = time.monotonic()
        told, self._ending = self._ending, status.ending
        if now - self._at >= (ON_TERMINAL if self._terminal else ELSEWHERE) or self._ending > told:
            first, self._at = self._at == 0.0, now
            if self._terminal or self._ending or not first:
                self._write(status.line(), over=True)

    def event(self, event: "Event") -> None:
        """Something about the link, told by the thread that reads."""
        self._write(event.text)

    def last(self, status: "Status") -> None:
        """What came of it."""
        seconds = time.monotonic() - self._began
        self._write(f"{status.line()}; {seconds:.1f} s")

    def _write(self, text: str, *, over: bool = False) -> None:
        with self._lock:
            if self._terminal:
                print(f"\r\x1b[2K{text}", end="" if over else "\n", file=sys.stderr, flush=True)
            else:
                print_status(text)


def _end(code: int) -> NoReturn:
    """Leave without waiting for the compiler, which cannot be told to stop; everything is written."""
    for file in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            file.flush()
    os._exit(code)
