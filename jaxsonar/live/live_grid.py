"""``LiveGrid``: an occupancy grid that is updated in a thread of its own while scans arrive."""

import os
import time
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np

from jaxsonar.geometry.se2 import subtract_poses
from jaxsonar.hardware.errors import SonarError
from jaxsonar.live.background_work import run_in_background
from jaxsonar.live.grid_files import GridFiles
from jaxsonar.live.live_map import LiveMap
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.occupancy.grid_evidence import GridMethod
from jaxsonar.occupancy.incremental_grid import IncrementalGrid
from jaxsonar.occupancy.known_reflectors import KnownReflectors
from jaxsonar.occupancy.nav2_map import Nav2Mode, check_grid
from jaxsonar.occupancy.occupancy_grid import OccupancyGrid
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class LiveGridSettings:
    """Timing of a live grid. All values are chosen by hand."""

    pause: float = 5.0
    """Pause between two updates, in durations of the last one: an update uses a sixth of one core."""
    max_pending: int = 1024
    """With this many pending scans an update starts without a pause: 100 s of the paper's ring, about 10 MB."""
    max_position_change: float = 0.025
    """A grid with a scan whose estimated position has changed by more than this is built anew, metres: half a cell."""
    max_heading_change: float = float(np.radians(0.5))
    """The same for headings, radians: 25 mm at 3 m."""


SETTINGS = LiveGridSettings()


class LiveGrid:
    """Adds the scans of a ``LiveMap`` to a grid, and writes it. To be used in one thread.

    With poses that are estimated, a scan is entered at its estimate of that time. When loop closures have moved earlier
    scans, the next update builds the grid again from all scans, which such a map keeps. Otherwise no scan is kept.
    """

    def __init__(
        self,
        live: LiveMap,
        filename: str | os.PathLike[str],
        *,
        interval: float,
        method: GridMethod = "counts",
        mode: Nav2Mode = "trinary",
        certain: float | None = None,
    ):
        """A grid without scans; nothing is written.

        Args:
            live: the map, whose walls bound free space and explain echoes.
            filename: YAML file of the grid.
            interval: seconds between two updates, at least.
            method: how echoes become obstacles, see ``occupancy``.
            mode: how map_server reads the image.
            certain: angle off the axis up to which walls are heard for sure, as for ``occupancy``.

        Raises:
            SonarError: another suffix than .yaml or .yml; a ring whose range is too long for a grid.
        """
        self.empty: str = ""
        """After ``finish``: the reason why no grid was written; empty if one was."""
        self._live, self._interval = live, interval
        self._method: GridMethod = method
        self._certain = certain
        self._grid = self._new_grid()
        self._files = GridFiles(filename, mode=mode)
        self._pending: list[Scan] = []
        self._entered: list[np.ndarray] = []
        """Poses of the scans in the grid, if poses are estimated."""
        self._update: Future[OccupancyGrid] | None = None
        self._due = time.monotonic() + interval

    def _new_grid(self) -> IncrementalGrid:
        return IncrementalGrid(self._live.ring, method=self._method, certain=self._certain)

    def warm_up(self) -> None:
        """Compile the programs of the first update."""
        ring, rng = self._live.ring, np.random.default_rng(0)
        half = 0.7 * ring.max_range
        corners = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        walls = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
        path = np.repeat(ring.paths, 2, axis=0)
        ranges = rng.uniform(0.3, 0.9, len(path)) * ring.max_range
        amplitude = np.full(len(path), np.nan)
        scans = [
            Scan(k, 0.1 * k, np.array([0.3 * k, 0.0, 0.0]), path[:, 0], path[:, 1], ranges, amplitude, asked=ring.paths)
            for k in range(2)
        ]
        grid = self._new_grid()
        grid.add(Log.from_scans(scans))
        grid.update(walls)

    def add(self, scans: Sequence[Scan]) -> None:
        """Add scans of ``LiveMap.process``, in its order; the next update enters them."""
        self._pending += scans

    @property
    def is_full(self) -> bool:
        """Whether an update should start now, because many scans are pending."""
        return len(self._pending) >= SETTINGS.max_pending

    @property
    def is_due(self) -> bool:
        """Whether an update should start with the next map."""
        is_running = self._update is not None and not self._update.done()
        return self.is_full or (bool(self._pending) and not is_running and time.monotonic() >= self._due)

    def start_update(self, world: GlobalMap) -> None:
        """Start an update in the background; waits for a running one.

        Args:
            world: the map of all scans so far.

        Raises:
            SonarError: the update before failed: poses too far apart for a grid, or a file that cannot be written.
        """
        self.wait()
        rebuilt = self._live.slam and self._has_moved()
        scans, self._pending = self._live.scans_at_current_poses() if rebuilt else self._pending, []
        if rebuilt:
            self._grid, self._entered = self._new_grid(), []
        if self._live.slam:
            self._entered += [scan.pose for scan in scans]
        ring, heard, start = self._live.ring, self._live.in_range > 0, time.monotonic()

        def update() -> OccupancyGrid:
            grid = self._updated(scans, world, ring)
            if heard and grid.free.size:
                self._files.write(grid)
            now = time.monotonic()
            self._due = now + max(self._interval, SETTINGS.pause * (now - start))
            return grid

        self._update = run_in_background(update, name="jaxsonar grid")

    def _updated(self, scans: Sequence[Scan], world: GlobalMap, ring: Ring) -> OccupancyGrid:
        """The grid with some more scans; ``ring`` has the present speed of sound."""
        self._grid.set_ring(ring)
        if scans:
            self._grid.add(Log.from_scans(scans))
        return self._grid.update(KnownReflectors.of_map(world))

    def wait(self) -> OccupancyGrid | None:
        """Wait for a running update. Returns the latest grid; None before the first.

        Raises:
            SonarError: the update failed.
        """
        update, self._update = self._update, None
        return None if update is None else update.result()

    def finish(self, world: GlobalMap) -> None:
        """Write the grid of all scans.

        Args:
            world: the map of all scans.

        Raises:
            SonarError: as for ``start_update``.
        """
        self.start_update(world)
        grid = self.wait()
        assert grid is not None
        self._files.finish()
        try:
            check_grid(grid)
        except SonarError as error:
            self.empty = str(error)
        if not (self.empty or self._live.in_range):
            self.empty = "no echo within the maximum range came; needed is an echo"

    def _has_moved(self) -> bool:
        """Whether the estimated pose of a scan in the grid has changed."""
        if not self._entered:
            return False
        entered = np.array(self._entered)
        change = subtract_poses(self._live.poses()[: len(entered)], entered)
        far = np.hypot(change[:, 0], change[:, 1]) > SETTINGS.max_position_change
        return bool((far | (np.abs(change[:, 2]) > SETTINGS.max_heading_change)).any())
