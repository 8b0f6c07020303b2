"""Occupancy grids from direct echoes and known walls."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16
from scipy import ndimage

from jaxsonar.hardware.errors import SonarError
from jaxsonar.occupancy.inverse_sensor_model import (
    LAYERS,
    DirectReadings,
    TransducerArrays,
    footprint_cells,
    inverse_sensor_model,
)
from jaxsonar.occupancy.settings import SETTINGS
from jaxsonar.occupancy.wall_visibility import WallMap
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.scans.single_firings import group_firings
from jaxsonar.sensors.ring import Ring

OCCUPIED, UNKNOWN, FREE = 0, 205, 254
"""Grey values of map_server's trinary images."""
NO_WALLS = np.zeros((0, 2, 2))
"""No known walls."""


@dataclass(frozen=True, eq=False, repr=False)
class OccupancyGrid:
    """Counts of observations in square cells that are aligned with the world's axes; cell (0, 0) starts at the origin.

    Rows increase with y, columns with x. The arrays are read-only and cropped to their content, so that grids of the
    same evidence are equal. ``a + b`` is the grid of both logs.
    """

    resolution: float
    """Side of a cell, metres."""
    corner: tuple[int, int]
    """First cell of the arrays (column, row), in cells of the world; its x starts at column * resolution."""
    counts: Int[np.ndarray, "5 rows columns"]
    """The layers ``free``, ``occluded``, ``arcs``, ``walls`` and ``footprint``."""
    viewpoints: UInt16[np.ndarray, "rows columns"]
    """One bit for each viewpoint, modulo 16, from which an arc through the cell was observed."""
    scans: int = 0
    """Number of scans in the grid."""
    skipped: int = 0
    """Number of scans that were left out because they have no pose."""

    @classmethod
    def empty(cls, *, resolution: float = 0.05) -> "OccupancyGrid":
        """A grid without observations.

        Raises:
            SonarError: a resolution that is not from 1 mm to 10 m.
        """
        if not 1e-3 <= resolution <= 10:
            raise SonarError(f"grid: resolution {resolution:g} m; allowed is 0.001 to 10 m")
        return cls(resolution, (0, 0), np.zeros((len(LAYERS), 0, 0), np.int32), np.zeros((0, 0), np.uint16))

    @property
    def origin(self) -> tuple[float, float]:
        """Lower left corner (x, y) of the lower left cell, world frame, metres."""
        return self.corner[0] * self.resolution, self.corner[1] * self.resolution

    @property
    def free(self) -> Int[np.ndarray, "rows columns"]:
        """Number of beams that passed through each cell."""
        return self.counts[0]

    @property
    def occluded(self) -> Int[np.ndarray, "rows columns"]:
        """Number of beams that ended in front of each cell, at an echo that no known wall explains."""
        return self.counts[1]

    @property
    def arcs(self) -> Int[np.ndarray, "rows columns"]:
        """Number of echoes that no known wall explains and whose arc crosses each cell."""
        return self.counts[2]

    @property
    def walls(self) -> Int[np.ndarray, "rows columns"]:
        """Number of scans that had a known wall in each cell within their range."""
        return self.counts[3]

    @property
    def footprint(self) -> Int[np.ndarray, "rows columns"]:
        """Number of scans in which the robot stood on each cell."""
        return self.counts[4]

    def add(self, ring: Ring, scan: Scan, *, walls: Float[np.ndarray, "walls 2 2"] = NO_WALLS) -> "OccupancyGrid":
        """This grid with one more scan, for maps that are built while the robot drives; see ``occupancy``."""
        return self + occupancy(ring, scan.as_log(), walls=walls, resolution=self.resolution)

    def __add__(self, other: "OccupancyGrid") -> "OccupancyGrid":
        if self.resolution != other.resolution:
            raise SonarError(
                f"grid: resolutions {self.resolution:g} and {other.resolution:g} m came; allowed is to add equal ones"
            )
        grids = [grid for grid in (self, other) if grid.free.size]
        low = np.min([grid.corner for grid in grids], axis=0) if grids else np.zeros(2, int)
        high = np.max([np.add(grid.corner, grid.free.shape[::-1]) for grid in grids], axis=0) if grids else low
        counts, viewpoints = _allocate(low, high)
        for grid in grids:
            here = _window(np.subtract(grid.corner, low), grid.free.shape)
            counts[:, *here] += grid.counts
            viewpoints[here] |= grid.viewpoints
        scans, skipped = self.scans + other.scans, self.skipped + other.skipped
        return _cropped(self.resolution, low, counts, viewpoints, scans, skipped)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, OccupancyGrid):
            return NotImplemented
        exact = ("resolution", "corner", "scans", "skipped")
        same = all(getattr(self, name) == getattr(other, name) for name in exact)
        return same and np.array_equal(self.counts, other.counts) and np.array_equal(self.viewpoints, other.viewpoints)

    def __repr__(self) -> str:
        rows, columns = self.free.shape
        return f"OccupancyGrid({columns} x {rows} cells of {self.resolution:g} m, {self.scans} scans)"

    def classify(
        self, *, free_share: float = 0.5, arc_share: float = 0.33, min_beams: int = 2, min_viewpoints: int = 3
    ) -> UInt8[np.ndarray, "rows columns"]:
        """The grid as a trinary image of map_server: 0 occupied, 254 free, 205 unknown; row 0 has the largest y.

        Args:
            free_share: least fraction of the beams at a free cell that pass through it. A higher value keeps planners
                away from unmapped walls; a lower value frees the surroundings of poles and table legs.
            arc_share: least fraction of arcs among the arcs and free beams at an obstacle that is not a known wall.
            min_beams: least number of beams through a free cell, and of arcs at an obstacle.
            min_viewpoints: least number of viewpoints, 0.2 m apart, from which an obstacle was observed.
        """
        through = self.free + SETTINGS.footprint_weight * self.footprint
        agreed = (self.arcs >= min_beams) & (np.bitwise_count(self.viewpoints) >= min_viewpoints)
        obstacle = agreed & (self.arcs >= arc_share * (self.arcs + through))
        occupied = obstacle | (self.walls > 0) & (self.walls >= through)
        free = (through >= min_beams) & (through >= free_share * (through + self.occluded + self.arcs)) & ~occupied
        # Free cells that are not connected to where the robot drove are errors, or lie behind an unmapped wall.
        region = np.zeros(free.shape, np.int32)
        ndimage.label(free, output=region)
        free &= np.isin(region, region[free & (self.footprint > 0)])
        image = np.where(occupied, OCCUPIED, np.where(free, FREE, UNKNOWN)).astype(np.uint8)
        return image[::-1]


def occupancy(
    ring: Ring,
    log: Log,
    *,
    walls: Float[np.ndarray, "walls 2 2"] = NO_WALLS,
    resolution: float = 0.05,
) -> OccupancyGrid:
    """The occupancy grid of a log, from its direct echoes and known walls.

    The cone of a sensor that fired and heard nothing is free. A sensor that a scan did not measure is no evidence
    (``measured_paths``). Every reading counts at the pose of the robot when it was measured. Firings that stand in
    scans of their own are grouped (``group_firings``).

    Args:
        ring: the sensors.
        log: scans; those without a pose are counted and skipped.
        walls: ends (x, y) of the known walls, world frame, metres.
        resolution: side of a cell, metres.

    Raises:
        SonarError: poses too far apart, or cells too small, for a grid; a wall that is not finite; a sensor number that
            the ring does not have.
    """
    empty = OccupancyGrid.empty(resolution=resolution)
    log = group_firings(log)
    sensors, readings = TransducerArrays.of(ring), DirectReadings.of(ring, log)
    posed = np.flatnonzero(np.isfinite(log.pose).all(axis=-1))
    skipped = len(log) - len(posed)
    _check(ring, walls, resolution)
    if not len(posed):
        return replace(empty, skipped=skipped)
    # Allocate the cells that any scan can observe.
    robot = readings.robot[posed][readings.measured[posed]]
    robot = np.concatenate([log.pose[posed, :2], robot[:, :2]])
    half = int(np.ceil(sensors.max_distance / resolution)) + 2
    low, high = (np.floor(end(robot, axis=0) / resolution) for end in (np.min, np.max))
    if np.prod(high - low + 2 * half + 1) > SETTINGS.max_cells:
        span = np.ptp(robot, axis=0) + 2 * sensors.max_distance
        area = " x ".join(f"{side:g}" for side in span)
        raise SonarError(f"grid: {area} m in cells of {resolution:g} m; allowed are {SETTINGS.max_cells} cells at most")
    low = low.astype(int) - half
    counts, viewpoints = _allocate(low, high.astype(int) + half + 1)
    # Add the counts of every scan.
    wall_map, columns = WallMap.of(walls, resolution), counts.shape[2]
    flat_counts = counts.reshape(len(LAYERS), -1)
    for scan in posed:
        pose, robot, measured = log.pose[scan], readings.robot[scan], readings.measured[scan]
        motion = np.linalg.norm(robot[measured, :2] - pose[:2], axis=-1).max(initial=0.0)
        near = wall_map.near(pose[:2], sensors.max_distance, margin=motion)
        seen = inverse_sensor_model(sensors, robot, readings.first_echo[scan], measured, near, low, columns)
        footprint = footprint_cells(sensors, pose, resolution)
        walls_and_footprint = ((cells - low) @ (1, columns) for cells in (near.cells, footprint))
        for layer, cells in zip(flat_counts, (*seen[:3], *walls_and_footprint), strict=True):
            np.add.at(layer, cells, np.int32(1))
        column, row = np.floor(robot[seen.arc_sensor, :2] / SETTINGS.viewpoint_cell).astype(int).T % 4
        np.bitwise_or.at(viewpoints.ravel(), seen.arcs, (1 << (4 * row + column)).astype(np.uint16))
    # The cells of walls are not free.
    column, row = (wall_map.cells - low).T
    inside = (column >= 0) & (row >= 0) & (column < counts.shape[2]) & (row < counts.shape[1])
    counts[0, row[inside], column[inside]] = 0
    return _cropped(resolution, low, counts, viewpoints, len(posed), skipped)


def _check(ring: Ring, walls: np.ndarray, resolution: float) -> None:
    if ring.max_range > SETTINGS.max_range_cells * resolution:
        came = f"max_range {ring.max_range:g} m in cells of {resolution:g} m"
        raise SonarError(f"grid: {came}; allowed is at most {SETTINGS.max_range_cells} cells far")
    limit = SETTINGS.max_wall_coordinate
    bad = ~(np.abs(walls) <= limit).all(axis=(1, 2))
    if bad.any():
        k = int(np.argmax(bad))
        raise SonarError(f"grid: wall {k} is {walls[k].tolist()}; allowed are finite coordinates up to {limit:g} m")


def _window(start: np.ndarray, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Slices (rows, columns) of an array of this shape that starts at (column, row)."""
    column, row = (int(k) for k in start)
    return slice(row, row + shape[-2]), slice(column, column + shape[-1])


def _allocate(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Empty counts and viewpoints for the cells from low to high (column, row)."""
    columns, rows = (int(k) for k in high - low)
    if columns * rows > SETTINGS.max_cells:
        raise SonarError(f"grid: {columns} x {rows} cells; allowed are {SETTINGS.max_cells} at most")
    return np.zeros((len(LAYERS), rows, columns), np.int32), np.zeros((rows, columns), np.uint16)


def _cropped(
    resolution: float, low: np.ndarray, counts: np.ndarray, viewpoints: np.ndarray, scans: int, skipped: int
) -> OccupancyGrid:
    """The grid without empty rows and columns at its border, so that the same evidence always gives equal arrays."""
    row, column = np.nonzero(counts.any(axis=0))
    if not len(row):
        return replace(OccupancyGrid.empty(resolution=resolution), scans=scans, skipped=skipped)
    rows, columns = np.unique(row), np.unique(column)
    here = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    counts, viewpoints = counts[:, *here].copy(), viewpoints[here].copy()
    counts.setflags(write=False)
    viewpoints.setflags(write=False)
    corner = int(low[0] + columns[0]), int(low[1] + rows[0])
    return OccupancyGrid(resolution, corner, counts, viewpoints, scans, skipped)
