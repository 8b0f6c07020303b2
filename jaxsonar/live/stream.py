"""From a device to lines and a map, live: what ``jaxsonar stream`` does."""

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from jaxsonar import kernels
from jaxsonar.estimation.odometry_noise import Slip
from jaxsonar.estimation.trajectory import save_trajectory
from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.drop_oldest_queue import CAPACITY, NewestQueue
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.reader_thread import Reader
from jaxsonar.hardware.scan_assembler import RawScan
from jaxsonar.hardware.transport_base import Event, open_source, parse_url, register
from jaxsonar.live.live_map import AT_ONCE, LiveMap, LiveScan
from jaxsonar.live.replay import file_opener
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.mapping.map_geojson import save_map
from jaxsonar.scans.recording_journal import open_record
from jaxsonar.sensors.ring import Ring

MAP_EVERY = 2.0
"""Seconds between two writings of the map."""
WARMING_CAPACITY = 8192
"""Scans that find room while things are compiled, 12 min of the paper's ring and some 30 MB."""
_LOOK = 0.2
_TOLD = 0.1  # seconds between two words on how it goes
_SWITCH = 5e-4  # seconds that one thread may keep the interpreter, where another has a scan to hand on
_LATENCIES = 1 << 16  # the latest ones are kept


@runtime_checkable
class Viewer(Protocol):
    """What shows a stream while it runs (``view.View``)."""

    def show(self, live: LiveScan) -> None:
        """The latest scan."""

    def show_map(self, world: GlobalMap) -> None:
        """The map so far."""

    def close(self) -> None:
        """The last words."""


@dataclass
class Status:
    """How a stream goes; one object, kept up to date."""

    scans: int = 0
    """Scans that lines were found in, or looked for."""
    echoes: int = 0
    """In those scans."""
    lines: int = 0
    """In those scans."""
    rate: float = 0.0
    """Scans a second, lately."""
    waiting: int = 0
    """Scans in the queue."""
    counts: dict[str, int] = field(default_factory=dict)
    """What the reader met (``Reader.counts``)."""
    unplaced: int = 0
    """Scans without a pose: their lines are there, but not in the map."""
    p50: float = float("nan")
    """Median of the time from a scan's last group to its lines, seconds; once those are worked off that came while
    things were compiled."""
    p99: float = float("nan")
    """99th percentile of it."""
    event: str = ""
    """The latest word about the link; empty while it is well."""
    warm: bool = False
    """Everything is compiled."""
    ending: bool = False
    """Told to end while things are compiled: what is in the record already is still to go into the map."""

    def line(self) -> str:
        """All of it that matters, on one line."""
        per = max(self.scans, 1)
        said = [
            f"{self.scans} scans" if self.warm else f"{self.scans} scans, compiling",
            f"{self.rate:.1f} scans/s",
            f"{self.echoes / per:.0f} echoes/scan",
            f"{self.lines / per:.1f} lines/scan",
            f"{self.counts.get('dropped', 0)} dropped",
            f"{self.counts.get('rejected', 0)} damaged{self._kinds()}",
        ]
        if np.isfinite(self.p50):
            said.append(f"latency {1e3 * self.p50:.1f} ms, p99 {1e3 * self.p99:.1f} ms")
        for name in ("missing", "lost", "late", "repeated", "restarts", "gaps"):
            if self.counts.get(name):
                said.append(f"{self.counts[name]} {_SAID[name]}")
        if self.unplaced:
            said.append(f"{self.unplaced} without a pose")
        if self.waiting > 1:
            said.append(f"{self.waiting} waiting")
        ending = "; ending once the map has them (again Ctrl-C: at once)" if self.ending else ""
        return ", ".join(said) + (f"; {self.event}" if self.event else "") + ending

    def _kinds(self) -> str:
        names = ("oversized", "impossible", "out_of_ring", "unknown", "newer", "refused")
        kinds = [f"{self.counts[name]} {name.replace('_', ' ')}" for name in names if self.counts.get(name)]
        return f" ({', '.join(kinds)})" if kinds else ""


_SAID = {
    "missing": "groups missing",
    "lost": "messages lost",
    "late": "late",
    "repeated": "repeated",
    "restarts": "restarts",
    "gaps": "gaps",
}


def stream(
    url: str,
    ring: Ring,
    *,
    method: str = "ml",
    settings: kernels.HoughSettings | None = None,
    sigma: float | None = None,
    record: str | os.PathLike[str] | None = None,
    map_path: str | os.PathLike[str] | None = None,
    map_every: float = MAP_EVERY,
    slip: Slip | None = None,
    trajectory: str | os.PathLike[str] | None = None,
    scans: int | None = None,
    view: Viewer | None = None,
    on_scan: Callable[[LiveScan], None] | None = None,
    on_status: Callable[[Status], None] | None = None,
    on_event: Callable[[Event], None] | None = None,
    stop: threading.Event | None = None,
) -> Status:
    """Read a device until it ends: lines of every scan at once, a map that grows, and a record.

    Args:
        url: ``tcp://HOST:PORT``, ``udp://HOST:PORT``, ``pty:PATH``, ``serial:///dev/ttyUSB0?baud=921600``,
            ``file:LOG?speed=1``, or a scheme that another package offers.
        ring: the sensors.
        method: "ml" or "hough", as ``local_models``.
        settings: as ``local_models``.
        sigma: as ``local_models``.
        record: file for everything that comes, ``.csv``, ``.parquet`` or ``.mcap``; see ``open_record``.
        map_path: GeoJSON, written now and then and at the end, each time whole.
        map_every: seconds between two writings.
        slip: how wrong the device's poses are: they are odometry then, and the robot's own are estimated (``slam``).
        trajectory: TUM file of the estimated poses, written at the end; with ``slip``.
        scans: end after this many.
        view: shows it.
        on_scan: told of every scan with its model.
        on_status: told how it goes, several times a second.
        on_event: told what becomes of the link, in the thread that reads.
        stop: set it, from any thread or signal handler, to end: what came so far is still written. Where only a record
            is, the compiler is not waited for: a daemon thread is then left, and ``Status.warm`` is False.

    Returns:
        How it went.

    Raises:
        SonarError: a call that makes no sense, a device that cannot be opened, a place that cannot be written to. What
            came before is written.
    """
    if trajectory is not None and slip is None:
        raise SonarError("stream: a trajectory came without slip; allowed is a trajectory where poses are estimated")
    mapping = bool(map_path) or view is not None
    live = LiveMap(ring, method=method, settings=settings, sigma=sigma, mapping=mapping, slip=slip)
    register("file", file_opener(ring))
    scheme = parse_url(url).scheme
    readers: list[Reader] = []

    def heard(event: Event) -> None:
        for listener in readers:
            listener.event(event)
        if on_event is not None and not any(listener.decoder.ended for listener in readers):
            on_event(event)

    source = open_source(url, on_event=heard)
    queue = NewestQueue[RawScan](WARMING_CAPACITY, size=lambda scan: len(scan.echoes))
    try:
        recorder = None if record is None else open_record(record)
    except SonarError:
        source.close()
        raise
    patient = True if scheme == "file" else False if scheme == "udp" else None
    reader = Reader(source, queue, sensors=ring.count, recorder=recorder, scans=scans, patient=patient)
    readers.append(reader)
    run = _Run(
        live, reader, queue, map_path=map_path, map_every=map_every, view=view, on_scan=on_scan, trajectory=trajectory
    )
    stop = threading.Event() if stop is None else stop
    with _switching(_SWITCH):
        reader.start()
        try:
            run.until_end(stop, on_status)
        finally:
            reader.stop()
            run.finish(on_status)
    if on_status is not None:
        on_status(run.status)
    return run.status


class _Run:
    """One stream, from the queue on."""

    def __init__(
        self,
        live: LiveMap,
        reader: Reader,
        queue: NewestQueue[RawScan],
        *,
        map_path: str | os.PathLike[str] | None,
        map_every: float,
        view: Viewer | None,
        on_scan: Callable[[LiveScan], None] | None,
        trajectory: str | os.PathLike[str] | None,
    ):
        self._trajectory = trajectory
        self.status = Status()
        self._live, self._reader, self._queue = live, reader, queue
        self._map_path, self._map_every = map_path, map_every
        self._view, self._on_scan = view, on_scan
        self._latency = np.full(_LATENCIES, np.nan)
        self._timed = 0
        self._caught_up = float("inf")
        self._map_at = time.monotonic() + map_every
        self._mapped = -1
        self._ticks: list[tuple[float, int]] = []
        self._told = 0.0
        self._warming = _in_background(live.warm_up)

    def until_end(self, stop: threading.Event, on_status: Callable[[Status], None] | None) -> None:
        """Compile while the first scans come, then take scan after scan."""
        while not wait([self._warming], _LOOK).done:
            if stop.is_set():
                return
            self._tell(on_status)
        self._warming.result()
        self.status.warm = True
        while not (stop.is_set() or self._queue.ended):
            self._take(self._queue.get(_LOOK, most=AT_ONCE))
            if not (len(self._queue) or np.isfinite(self._caught_up)):
                self._caught_up = time.monotonic()  # what came while things were compiled has been worked off
                self._queue.capacity = CAPACITY
            if not len(self._queue) or self._live.waiting >= AT_ONCE:
                self._live.absorb()
            if time.monotonic() >= self._map_at:
                self._write_map()
            self._tell(on_status)

    def finish(self, on_status: Callable[[Status], None] | None) -> None:
        """What is left: scans in the queue, the last map, what went wrong."""
        if not self._warming.done():
            asked = (self._map_path, self._view, self._on_scan, self._trajectory)
            if all(one is None for one in asked):
                self._note()
                while not self._queue.ended:
                    self._queue.get(0.0, most=AT_ONCE)  # nobody asks for lines, but for what went wrong
                return
            self.status.ending = len(self._queue) > 0
            while self.status.ending and not wait([self._warming], _LOOK).done:
                self._tell(on_status)
            done = self._warming.done()
            self.status.warm, self.status.ending = done and self._warming.exception() is None, False
        error: BaseException | None = None
        while error is None and not self._queue.ended:
            try:
                self._take(self._queue.get(0.0, most=AT_ONCE))
            except BaseException as failure:  # of the reader; what came before it is still to be written
                error = failure
        self._write_map(last=True)
        if self._trajectory is not None:
            save_trajectory(self._live.trajectory(), self._trajectory)
        self._note()
        if self._view is not None:
            self._view.close()
        if error is not None:
            raise error

    def _take(self, raws: list[RawScan]) -> None:
        if not raws:
            return
        taken = self._live.take(raws)
        now = time.monotonic()
        status = self.status
        for raw, live in zip(raws, taken, strict=True):
            status.scans += 1
            status.echoes += len(live.scan.tx)
            status.lines += len(live.model.lines)
            if raw.received >= self._caught_up:
                self._latency[self._timed % _LATENCIES] = now - raw.received
                self._timed += 1
            if self._on_scan is not None:
                self._on_scan(live)
        if self._view is not None:
            self._view.show(taken[-1])

    def _write_map(self, *, last: bool = False) -> None:
        if self._map_path is None and self._view is None:
            return
        if self.status.scans != self._mapped or last:
            world, self._mapped = self._live.map(), self.status.scans
            if self._map_path is not None:
                save_map(world, self._map_path)
            if self._view is not None:
                self._view.show_map(world)
        self._map_at = time.monotonic() + self._map_every

    def _tell(self, on_status: Callable[[Status], None] | None) -> None:
        status, now = self.status, time.monotonic()
        if on_status is None or (now - self._told < _TOLD and not status.ending):
            return
        self._told = now
        self._ticks = [tick for tick in self._ticks if now - tick[0] < 2.0] + [(now, status.scans)]
        (before, scans), *_ = self._ticks
        status.rate = (status.scans - scans) / (now - before) if now > before else 0.0
        self._note()
        on_status(status)

    def _note(self) -> None:
        status, event = self.status, self._reader.last_event
        status.waiting, status.counts, status.unplaced = len(self._queue), self._reader.counts, self._live.unplaced
        status.event = shown(event.text) if event is not None and event.kind != "back" else ""
        if self._timed:
            known = self._latency[: self._timed]
            status.p50, status.p99 = np.percentile(known, [50, 99]).tolist()


@contextmanager
def _switching(interval: float) -> Iterator[None]:
    """Let Python threads take turns this often (seconds): by default one that waits does so for 5 ms."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(min(before, interval))
    try:
        yield
    finally:
        sys.setswitchinterval(before)


def _in_background(work: Callable[[], None]) -> Future[None]:
    """Work in a thread that no process waits for: a compiler cannot be told to stop."""
    future: Future[None] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as failure:
            future.set_exception(failure)

    threading.Thread(target=run, name="jaxsonar warm-up", daemon=True).start()
    return future
