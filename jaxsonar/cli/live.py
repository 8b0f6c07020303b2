"""The commands ``stream`` and ``emulate``: what they can be told, and what they do."""

import argparse
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from jaxsonar.hardware.errors import SonarError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jaxsonar.hardware.messages import Message
    from jaxsonar.hardware.transport_base import Event
    from jaxsonar.live.stream import Status
    from jaxsonar.sensors.ring import Ring

ON_TERMINAL, ELSEWHERE = 1.0, 10.0
"""Seconds between two status lines."""


def stream(options: argparse.Namespace) -> None:
    """``jaxsonar stream``."""
    from jaxsonar.cli.console import _check_sigma_is_used
    from jaxsonar.cli.slam import slip_of
    from jaxsonar.detection.settings_toml import load_settings
    from jaxsonar.fileio.atomic_files import check_outputs
    from jaxsonar.fileio.compilation_cache import use_compilation_cache
    from jaxsonar.hardware.transport_base import parse_url
    from jaxsonar.live.stream import stream as stream_scans
    from jaxsonar.sensors.ring_toml import load_ring

    _check_sigma_is_used(options.sigma, options.method, None)
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

        view = View(ring, file=options.rrd, say=_say)
    use_compilation_cache()
    show = _StatusLine()
    try:
        with _stopped_by_signals() as stop:
            status = stream_scans(
                options.url,
                ring,
                method=options.method,
                settings=settings,
                sigma=options.sigma,
                record=options.record,
                map_path=options.map,
                slip=slip_of(options.odometry) if options.slam else None,
                trajectory=options.trajectory,
                scans=options.scans,
                view=view,
                on_status=show.status,
                on_event=show.event,
                stop=stop,
            )
    except KeyboardInterrupt:
        _say("jaxsonar stream: interrupted")
        _end(1)
    show.last(status)
    if not status.warm:
        _end(0)


def emulate(options: argparse.Namespace) -> None:
    """``jaxsonar emulate``."""
    from jaxsonar.hardware.device_emulator import emulate as emulate_device
    from jaxsonar.hardware.fault_injection import Faults, parse_stall
    from jaxsonar.hardware.transport_servers import listen
    from jaxsonar.sensors.ring_toml import load_ring

    stall, every = parse_stall(options.stall) if options.stall else (0.0, 10.0)
    faults = Faults(
        corrupt=options.corrupt,
        drop=options.drop,
        reorder=options.reorder,
        stall=stall,
        every=every,
        seed=options.seed,
    )
    messages = _messages(options, load_ring(options.ring))
    with listen(options.listen) as sink, _stopped_by_signals() as stop:
        print(f"listening on {sink.url}", flush=True)
        done = emulate_device(messages, sink, speed=options.speed, faults=faults, stop=stop)
    damage = "".join(
        f", {count} {what}"
        for count, what in (
            (done.damaged, "damaged"),
            (done.dropped, "dropped"),
            (done.swapped, "swapped"),
            (done.stalls, "stalls"),
        )
        if count
    )
    _say(f"{done.messages} messages, {done.frames} frames, {done.sent_bytes} bytes{damage}")


def _messages(options: argparse.Namespace, ring: "Ring") -> "Iterable[Message]":
    if Path(options.log).suffix.lower() not in (".geojson", ".json"):
        if options.path or options.sigma:
            raise SonarError("--path or --sigma came with a log; allowed are they with a room (.geojson)")
        from jaxsonar.live.replay import messages_of

        return messages_of(options.log, ring)
    if not options.path:
        raise SonarError("a room came without --path; needed is the way through it, --path CSV")
    from jaxsonar.floor_plans.room_geojson import load_room
    from jaxsonar.simulation.device_messages import room_messages
    from jaxsonar.simulation.poses_csv import load_path

    poses, stamps = load_path(options.path)
    return room_messages(ring, load_room(options.log), poses, stamps, sigma=options.sigma, seed=options.seed)


class _StatusLine:
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
                _say(text)


@contextmanager
def _stopped_by_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set; a second one of them ends the process as usual."""
    stop = threading.Event()
    before = {}

    def told(number: int, _: object) -> None:
        stop.set()
        signal.signal(number, before[number])

    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.getsignal(number)
        signal.signal(number, told)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def add_commands(
    command: Callable[[str, str], argparse.ArgumentParser],
    *,
    whole: Callable[[int, int], Callable[[str], Any]],
    number: Callable[[float, float], Callable[[str], Any]],
    ending_in: Callable[..., Callable[[str], Any]],
    odometry: Callable[[str], Any],
    texts: dict[str, str],
) -> None:
    """Tell the command line of both.

    Args:
        command: adds a command by name and summary.
        whole: a whole number within bounds.
        number: a number within bounds.
        ending_in: a file name with one of some suffixes.
        odometry: parser of PERCENT,DEG.
        texts: help shared with other commands: ``ring``, ``sigma``, ``settings``, ``odometry``.
    """
    live = command("stream", "Lines and a growing map from a device, live.")
    live.add_argument(
        "url",
        metavar="URL",
        help="serial:///dev/ttyUSB0?baud=921600, tcp://HOST:PORT, udp://HOST:PORT, pty:PATH or file:LOG?speed=1",
    )
    live.add_argument("--ring", required=True, help=texts["ring"])
    live.add_argument("--method", choices=("ml", "hough"), default="ml", help="default: ml; hough: the paper's, faster")
    live.add_argument("--sigma", type=number(1e-4, 1), metavar="METRES", help=texts["sigma"])
    live.add_argument("--settings", metavar="TOML", help=texts["settings"])
    live.add_argument(
        "--record",
        type=ending_in(".csv", ".parquet", ".mcap"),
        metavar="LOG",
        help="keep everything: .csv, .parquet: a scan log; .mcap: the raw messages (extra live)",
    )
    live.add_argument("--map", type=ending_in(".geojson", ".json"), metavar="MAP", help="GeoJSON, written every 2 s")
    live.add_argument("--slam", action="store_true", help="the device's poses are odometry: estimate the robot's own")
    live.add_argument(
        "--trajectory", type=ending_in(".tum", ".txt"), metavar="TRAJ", help="with --slam: the poses, TUM, at the end"
    )
    live.add_argument("--odometry", type=odometry, metavar="PERCENT,DEG", help=texts["odometry"])
    live.add_argument("--scans", type=whole(1, 2**62), metavar="N", help="end after N scans (default: with the device)")
    live.add_argument("--view", action="store_true", help="show it (extra viz), on this machine only")
    live.add_argument("--rrd", type=ending_in(".rrd"), metavar="FILE", help="the view as a file for rerun (extra viz)")

    device = command("emulate", "A log, or a room and a way through it, as a device.")
    device.add_argument("log", metavar="LOG", help="scan log or record (.csv, .parquet, .mcap), or room (.geojson)")
    device.add_argument("--ring", required=True, help=texts["ring"])
    device.add_argument(
        "--listen",
        required=True,
        metavar="URL",
        help="tcp://HOST:PORT, udp://HOST:PORT (PORT 0: any), pty: or pty:PATH; without HOST this machine only",
    )
    device.add_argument("--speed", type=number(0, 1e6), default=1.0, metavar="FACTOR", help="0 = as fast as it goes")
    device.add_argument("--corrupt", type=number(0, 1), default=0.0, metavar="P", help="share of frames to damage")
    device.add_argument("--drop", type=number(0, 1), default=0.0, metavar="P", help="share of frames to lose")
    device.add_argument("--reorder", type=number(0, 1), default=0.0, metavar="P", help="share of frames to send late")
    device.add_argument("--stall", metavar="S[@EVERY]", help="say nothing for S seconds, every EVERY seconds")
    device.add_argument("--seed", type=whole(0, 2**32 - 1), default=0, help="of the faults, and of a room's noise")
    device.add_argument("--path", metavar="CSV", help="the way through a room: columns x, y (m), theta (rad), [stamp]")
    device.add_argument(
        "--sigma", type=number(0, 1), default=0.0, metavar="M", help="range noise in a room (default: 0)"
    )


def _end(code: int) -> NoReturn:
    """Leave without waiting for the compiler, which cannot be told to stop; everything is written."""
    for file in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            file.flush()
    os._exit(code)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
