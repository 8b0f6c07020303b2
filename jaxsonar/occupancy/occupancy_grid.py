"""Occupancy grids from echoes and walls, for planners: where a robot may drive, where not, and what nobody has seen.

A counting model after Moravec and Elfes: every direct path that listens is a look into its cone, and each cell counts
what the looks say. Counts are whole numbers, so the order of scans does not matter and parts of a log add up to the
whole. Two things are special about sonar. A smooth wall reflects an oblique sound away, so silence beyond a known wall
says nothing: walls bound every look. And an echo says "somewhere on this arc": echoes that a known wall explains mark
nothing, as the wall says it better; of the others, cells count as obstacles where arcs from several places meet.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16
from scipy import ndimage

from jaxsonar.hardware.errors import SonarError
from jaxsonar.occupancy.inverse_sensor_model import Eyes, evidence, first_echoes
from jaxsonar.occupancy.wall_visibility import KnownWalls
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.sensors.ring import Ring

OCCUPIED, UNKNOWN, FREE = 0, 205, 254
"""Grey values of map_server's trinary images."""
NO_WALLS = np.zeros((0, 2, 2))
"""Where nothing is known beforehand."""
BODY = 20
"""Looks that the robot's own body is worth: it stands there."""
PLACE = 0.2
"""Metres; the side of the squares that tell places of the robot apart, in a pattern of 4 x 4 that repeats."""
FARTHEST_WALL = 10_000.0
"""Metres from the world's origin."""
MOST_CELLS_FAR = 400
"""Cells from a sensor to its maximum range: 20 m at 0.05 m."""
MOST_CELLS = 50_000_000
"""Cells of the largest grid, 350 m x 350 m at 0.05 m; more is a wrong pose or a wrong resolution."""


@dataclass(frozen=True, eq=False, repr=False)
class OccupancyGrid:
    """Counts of what the looks say, in square cells aligned with the world's axes; cell (0, 0) starts at the origin.

    Rows go up with y, columns with x. The arrays are read-only and as small as what they hold, so that grids of the
    same evidence are equal. ``a + b`` is the grid of both logs.
    """

    resolution: float
    """Side of a cell, metres."""
    corner: tuple[int, int]
    """Which cell of the world (column, row) the arrays start with: x from column * resolution."""
    counts: Int[np.ndarray, "5 rows columns"]
    """``free``, ``hidden``, ``arcs``, ``walls``, ``driven``, one on the other."""
    places: UInt16[np.ndarray, "rows columns"]
    """One bit for each kind of place that an arc through the cell was heard from."""
    scans: int = 0
    """Scans in the grid."""
    skipped: int = 0
    """Scans left out because they have no pose."""

    @classmethod
    def empty(cls, *, resolution: float = 0.05) -> "OccupancyGrid":
        """A grid that knows nothing.

        Raises:
            SonarError: a resolution that is not from 1 mm to 10 m.
        """
        if not 1e-3 <= resolution <= 10:
            raise SonarError(f"grid: resolution {resolution:g} m; allowed is 0.001 to 10 m")
        return cls(resolution, (0, 0), np.zeros((5, 0, 0), np.int32), np.zeros((0, 0), np.uint16))

    @property
    def origin(self) -> tuple[float, float]:
        """Lower left corner (x, y) of the lower left cell, world frame, metres."""
        return self.corner[0] * self.resolution, self.corner[1] * self.resolution

    @property
    def free(self) -> Int[np.ndarray, "rows columns"]:
        """Looks that went through the cell."""
        return self.counts[0]

    @property
    def hidden(self) -> Int[np.ndarray, "rows columns"]:
        """Looks that ended at an echo before the cell, one that no wall explains."""
        return self.counts[1]

    @property
    def arcs(self) -> Int[np.ndarray, "rows columns"]:
        """Looks with an echo that no wall explains, and that may come from the cell."""
        return self.counts[2]

    @property
    def walls(self) -> Int[np.ndarray, "rows columns"]:
        """Scans that had a wall in the cell within reach."""
        return self.counts[3]

    @property
    def driven(self) -> Int[np.ndarray, "rows columns"]:
        """Scans in which the robot itself stood on the cell."""
        return self.counts[4]

    def add(self, ring: Ring, scan: Scan, *, walls: Float[np.ndarray, "walls 2 2"] = NO_WALLS) -> "OccupancyGrid":
        """This grid and one scan more, for maps that grow while the robot drives; see ``occupancy``."""
        return self + occupancy(ring, scan.as_log(), walls=walls, resolution=self.resolution)

    def __add__(self, other: "OccupancyGrid") -> "OccupancyGrid":
        if self.resolution != other.resolution:
            raise SonarError(
                f"grid: resolutions {self.resolution:g} and {other.resolution:g} m came; allowed is to add equal ones"
            )
        parts = [grid for grid in (self, other) if grid.free.size]
        low = np.min([grid.corner for grid in parts], axis=0) if parts else np.zeros(2, int)
        high = np.max([np.add(grid.corner, grid.free.shape[::-1]) for grid in parts], axis=0) if parts else low
        counts, places = _room_for(low, high)
        for grid in parts:
            here = _window(np.subtract(grid.corner, low), grid.free.shape)
            counts[:, *here] += grid.counts
            places[here] |= grid.places
        scans, skipped = self.scans + other.scans, self.skipped + other.skipped
        return _trimmed(self.resolution, low, counts, places, scans, skipped)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, OccupancyGrid):
            return NotImplemented
        exact = ("resolution", "corner", "scans", "skipped")
        same = all(getattr(self, name) == getattr(other, name) for name in exact)
        return same and np.array_equal(self.counts, other.counts) and np.array_equal(self.places, other.places)

    def __repr__(self) -> str:
        rows, columns = self.free.shape
        return f"OccupancyGrid({columns} x {rows} cells of {self.resolution:g} m, {self.scans} scans)"

    def classify(
        self, *, free_share: float = 0.5, arc_share: float = 0.33, min_looks: int = 2, min_places: int = 3
    ) -> UInt8[np.ndarray, "rows columns"]:
        """An image as map_server's trinary ones: 0 occupied, 254 free, 205 unknown; row 0 is the largest y.

        Args:
            free_share: of the looks at a free cell at least this share must go through it. More keeps planners from
                walls that no map knows, less frees the surroundings of poles and table legs.
            arc_share: of the arcs and looks through an obstacle at least this share must be arcs, where no wall is.
            min_looks: looks that must go through a free cell, arcs that must meet at an obstacle.
            min_places: an obstacle that is no wall was heard from so many places, 0.2 m apart.
        """
        through = self.free + BODY * self.driven
        agreed = (self.arcs >= min_looks) & (np.bitwise_count(self.places) >= min_places)
        obstacle = agreed & (self.arcs >= arc_share * (self.arcs + through))
        occupied = obstacle | (self.walls > 0) & (self.walls >= through)
        free = (through >= min_looks) & (through >= free_share * (through + self.hidden + self.arcs)) & ~occupied
        # Specks that the robot cannot reach from where it drove are chance, or lie behind a wall that no map knows.
        island = np.zeros(free.shape, np.int32)
        ndimage.label(free, output=island)
        free &= np.isin(island, island[free & (self.driven > 0)])
        image = np.where(occupied, OCCUPIED, np.where(free, FREE, UNKNOWN)).astype(np.uint8)
        return image[::-1]


def occupancy(
    ring: Ring,
    log: Log,
    *,
    walls: Float[np.ndarray, "walls 2 2"] = NO_WALLS,
    resolution: float = 0.05,
    fired: Bool[np.ndarray, "scans sensors"] | None = None,
) -> OccupancyGrid:
    """What the direct echoes of a log say about each cell around the robot's path.

    A sensor without an echo heard nothing, and what it looked at is free. So a log must not leave out echoes that are
    merely stale: name the sensors that fired instead.

    Args:
        ring: the sensors.
        log: scans; those without a pose are counted and skipped.
        walls: ends (x, y) of the known walls, world frame, metres.
        resolution: side of a cell, metres.
        fired: which sensors were really listening in each scan; all of them if left out.

    Raises:
        SonarError: poses so far apart, or cells so small, that no grid can be made; a wall that is not finite; a sensor
            that the ring lacks.
    """
    nothing = OccupancyGrid.empty(resolution=resolution)
    eyes, first = Eyes.of(ring), first_echoes(ring, log)
    listening = np.ones((len(log), ring.count), bool) if fired is None else fired
    posed = np.flatnonzero(np.isfinite(log.pose).all(axis=-1))
    skipped = len(log) - len(posed)
    _check(ring, walls, resolution)
    if not len(posed):
        return replace(nothing, skipped=skipped)
    at = np.floor(log.pose[posed, :2] / resolution)
    size = int(np.ceil(eyes.reach / resolution)) + 2
    if np.prod(np.ptp(at, axis=0) + 2 * size + 1) > MOST_CELLS:
        across = " x ".join(f"{span:g}" for span in np.ptp(log.pose[posed, :2], axis=0) + 2 * eyes.reach)
        raise SonarError(f"grid: {across} m in cells of {resolution:g} m; allowed are {MOST_CELLS} cells at most")
    at = at.astype(int)
    low = at.min(axis=0) - size
    counts, places = _room_for(low, at.max(axis=0) + size + 1)
    known = KnownWalls.of(walls, resolution)
    for cell, scan in zip(at, posed, strict=True):
        pose, corner = log.pose[scan], cell - size
        near = known.near(pose[:2], eyes.reach)
        seen = evidence(eyes, pose, first[scan], listening[scan], near, corner, 2 * size + 1)
        here = _window(corner - low, seen.shape[1:])
        counts[:, *here] += seen
        column, row = np.floor(pose[:2] / PLACE).astype(int) % 4
        places[here] |= np.where(seen[2] > 0, 1 << (4 * row + column), 0).astype(np.uint16)
    return _trimmed(resolution, low, counts, places, len(posed), skipped)


def _check(ring: Ring, walls: np.ndarray, resolution: float) -> None:
    if ring.max_range > MOST_CELLS_FAR * resolution:
        came = f"max_range {ring.max_range:g} m in cells of {resolution:g} m"
        raise SonarError(f"grid: {came}; allowed is at most {MOST_CELLS_FAR} cells far")
    bad = ~(np.abs(walls) <= FARTHEST_WALL).all(axis=(1, 2))
    if bad.any():
        k = int(np.argmax(bad))
        raise SonarError(
            f"grid: wall {k} is {walls[k].tolist()}; allowed are finite coordinates up to {FARTHEST_WALL:g} m"
        )


def _window(start: np.ndarray, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of an array of this shape that starts at (column, row)."""
    column, row = (int(k) for k in start)
    return slice(row, row + shape[-2]), slice(column, column + shape[-1])


def _room_for(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    columns, rows = (int(k) for k in high - low)
    if columns * rows > MOST_CELLS:
        raise SonarError(f"grid: {columns} x {rows} cells; allowed are {MOST_CELLS} at most")
    return np.zeros((5, rows, columns), np.int32), np.zeros((rows, columns), np.uint16)


def _trimmed(
    resolution: float, low: np.ndarray, counts: np.ndarray, places: np.ndarray, scans: int, skipped: int
) -> OccupancyGrid:
    """The grid without empty rows and columns around, so that the same evidence always gives equal arrays."""
    row, column = np.nonzero(counts.any(axis=0))
    if not len(row):
        return replace(OccupancyGrid.empty(resolution=resolution), scans=scans, skipped=skipped)
    rows, columns = np.unique(row), np.unique(column)
    here = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    counts, places = counts[:, *here].copy(), places[here].copy()
    counts.setflags(write=False)
    places.setflags(write=False)
    corner = int(low[0] + columns[0]), int(low[1] + rows[0])
    return OccupancyGrid(resolution, corner, counts, places, scans, skipped)
