"""The loop of a stream: compile in the background, process scan by scan, write map and grid now and then."""

import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import wait
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from jaxsonar.estimation.trajectory import save_trajectory
from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.drop_oldest_queue import CAPACITY, DropOldestQueue
from jaxsonar.hardware.reader_thread import ReaderThread
from jaxsonar.hardware.scan_assembler import RawScan
from jaxsonar.live.background_work import run_in_background
from jaxsonar.live.live_grid import LiveGrid
from jaxsonar.live.live_map import SETTINGS as LIVE_MAP_SETTINGS
from jaxsonar.live.live_map import LiveMap, LiveScan
from jaxsonar.live.status import Status
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.mapping.map_geojson import save_map


@dataclass(frozen=True)
class StreamSettings:
    """Timing and capacities of a stream. All values are chosen by hand."""

    map_interval: float = 2.0
    """Seconds between two writes of the map, at least."""
    map_pause: float = 5.0
    """Pause between two computations of the map, in durations of the last one: scans do not wait for most of the time,
    however large the map is."""
    warm_up_capacity: int = 8192
    """Capacity of the queue during compilation, scans: 12 min of the paper's ring, about 30 MB."""
    poll_interval: float = 0.2
    """Seconds between two checks of the stop event."""
    status_interval: float = 0.1
    """Minimum time between two calls of ``on_status``, seconds."""
    rate_window: float = 2.0
    """Time over which the rate is averaged, seconds."""
    latency_history: int = 1 << 16
    """Number of latencies kept for the percentiles."""
    switch_interval: float = 5e-4
    """Seconds that one Python thread may hold the interpreter lock. The default of 5 ms would delay scans."""


SETTINGS = StreamSettings()


@runtime_checkable
class Viewer(Protocol):
    """Shows a stream while it runs; ``rerun_viewer.RerunViewer`` is one."""

    def show(self, live: LiveScan) -> None:
        """Show the latest scan."""

    def show_map(self, world: GlobalMap) -> None:
        """Show the current map."""

    def close(self) -> None:
        """Called at the end of the stream."""


class StreamLoop:
    """Processes the scans of one stream, taken from the queue of its reader."""

    def __init__(
        self,
        live: LiveMap,
        reader: ReaderThread,
        queue: DropOldestQueue[RawScan],
        *,
        map_filename: str | os.PathLike[str] | None,
        map_interval: float,
        grid: LiveGrid | None,
        trajectory: str | os.PathLike[str] | None,
        view: Viewer | None,
        on_scan: Callable[[LiveScan], None] | None,
        on_status: Callable[[Status], None] | None,
    ):
        """Start the compilation in the background. For the arguments see ``stream``."""
        self.status = Status()
        self._live, self._reader, self._queue = live, reader, queue
        self._map_filename, self._map_interval, self._trajectory = map_filename, map_interval, trajectory
        self._grid = grid
        self._view, self._on_scan, self._on_status = view, on_scan, on_status
        self._latencies = np.full(SETTINGS.latency_history, np.nan)
        self._timed_scans = 0
        self._caught_up = float("inf")
        """Time when the scans that arrived during compilation were processed (``time.monotonic``)."""
        self._next_map = time.monotonic() + map_interval
        self._mapped_scans = -1
        self._rate_samples: list[tuple[float, int]] = []
        self._reported_at = 0.0
        self._compilation = run_in_background(self._warm_up, name="jaxsonar warm-up")

    def _warm_up(self) -> None:
        """Compile everything."""
        self._live.warm_up()
        if self._grid is not None:
            self._grid.warm_up()

    def wait_until_compiled(self, stop: threading.Event) -> bool:
        """Wait for the compilation. False if ``stop`` was set, or the stream ended without a scan, before."""
        while not wait([self._compilation], SETTINGS.poll_interval).done:
            if stop.is_set() or self._queue.ended:
                return False
            self._report()
        self._compilation.result()
        self.status.warm = True
        return True

    def process_scans(self, stop: threading.Event) -> None:
        """Process scans until the stream ends or ``stop`` is set."""
        batch = LIVE_MAP_SETTINGS.max_batch
        while not (stop.is_set() or self._queue.ended):
            self._process(self._queue.get(SETTINGS.poll_interval, max_items=batch))
            if not (len(self._queue) or np.isfinite(self._caught_up)):
                self._caught_up = time.monotonic()
                self._queue.capacity = CAPACITY
            if not len(self._queue) or self._live.pending >= batch:
                self._live.update_map()
            self._update_outputs()
            self._report()

    def finish(self) -> None:
        """Process the scans in the queue and write the last map, grid and trajectory.

        If only a recording was requested, the scans are discarded and the compilation is not waited for.

        Raises:
            BaseException: the error of the reading thread, after everything received before it is written.
        """
        if not self._compilation.done():
            outputs = (self._map_filename, self._grid, self._view, self._on_scan, self._trajectory)
            if all(output is None for output in outputs):
                self._update_status()
                while not self._queue.ended:
                    self._queue.get(0.0, max_items=LIVE_MAP_SETTINGS.max_batch)  # raises an error of the reader
                return
            self.status.ending = len(self._queue) > 0
            while self.status.ending and not wait([self._compilation], SETTINGS.poll_interval).done:
                self._report()
            done = self._compilation.done()
            self.status.warm, self.status.ending = done and self._compilation.exception() is None, False
        error: BaseException | None = None
        while error is None and not self._queue.ended:
            try:
                self._process(self._queue.get(0.0, max_items=LIVE_MAP_SETTINGS.max_batch))
            except BaseException as failure:  # of the reader; scans received before it are still written
                error = failure
        self._finish_outputs()
        self._update_status()
        if self._view is not None:
            self._view.close()
        if error is not None:
            raise error

    def _process(self, raw_scans: list[RawScan]) -> None:
        if not raw_scans:
            return
        live_scans = self._live.process(raw_scans)
        now = time.monotonic()
        status = self.status
        for raw, live in zip(raw_scans, live_scans, strict=True):
            status.scans += 1
            status.echoes += live.scan.echo_count
            status.lines += len(live.model.lines)
            if raw.received >= self._caught_up:
                self._latencies[self._timed_scans % SETTINGS.latency_history] = now - raw.received
                self._timed_scans += 1
            if self._on_scan is not None:
                self._on_scan(live)
        if self._grid is not None:
            self._grid.add([live.scan for live in live_scans])
        if self._view is not None:
            self._view.show(live_scans[-1])

    def _update_outputs(self) -> None:
        """Write and show map and grid if they are due, and there are new scans."""
        start, grid = time.monotonic(), self._grid
        is_due = start >= self._next_map and self.status.scans != self._mapped_scans
        if not (is_due or (grid is not None and grid.is_full)):
            return
        if grid is None and self._map_filename is None and self._view is None:
            return
        world = self._live.map()
        self._write_map(world)
        if grid is not None and grid.is_due:
            grid.start_update(world)
        now = time.monotonic()
        self._next_map = now + max(self._map_interval, SETTINGS.map_pause * (now - start))

    def _finish_outputs(self) -> None:
        """Write the last map, trajectory and grid."""
        if self._map_filename is not None or self._view is not None:
            self._write_map(self._live.map())
        if self._trajectory is not None:
            save_trajectory(self._live.trajectory(), self._trajectory)
        if self._grid is not None:
            self._grid.finish(self._live.map())
            self.status.no_grid = self._grid.empty

    def _write_map(self, world: GlobalMap) -> None:
        self._mapped_scans = self.status.scans
        if self._map_filename is not None:
            save_map(world, self._map_filename)
        if self._view is not None:
            self._view.show_map(world)

    def _report(self) -> None:
        """Call ``on_status``, at most every ``status_interval``."""
        status, now = self.status, time.monotonic()
        if self._on_status is None or (now - self._reported_at < SETTINGS.status_interval and not status.ending):
            return
        self._reported_at = now
        recent = [sample for sample in self._rate_samples if now - sample[0] < SETTINGS.rate_window]
        self._rate_samples = [*recent, (now, status.scans)]
        (before, scans), *_ = self._rate_samples
        status.rate = (status.scans - scans) / (now - before) if now > before else 0.0
        self._update_status()
        self._on_status(status)

    def _update_status(self) -> None:
        status, event = self.status, self._reader.last_event
        status.queued, status.counts = len(self._queue), self._reader.counts
        status.without_pose = self._live.without_pose
        status.left_out, status.in_range = self._live.left_out, self._live.in_range
        status.event = shown(event.text) if event is not None and event.kind != "back" else ""
        if self._timed_scans:
            latencies = self._latencies[: self._timed_scans]
            status.p50, status.p99 = np.percentile(latencies, [50, 99]).tolist()
