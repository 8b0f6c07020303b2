"""Occupancy grids from echoes and walls, for planners: where a robot may drive, where not, and what nobody has seen.

A counting model after Moravec and Elfes: every direct path that listens is a look into its cone, and each cell counts
what the looks say. Counts are whole numbers, so the order of scans does not matter and parts of a log add up to the
whole. Two things are special about sonar. A smooth wall reflects an oblique sound away, so silence beyond a known wall
says nothing: walls bound every look. And an echo says "somewhere on this arc": echoes that a known wall explains mark
nothing, as the wall says it better; of the others, cells count as obstacles where arcs from several places meet.
"""

import json
import os
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16
from scipy.spatial import ConvexHull, QhullError

from jaxsonar.hardware.errors import SonarError

from .files import atomic_write, shown
from .logs import Log, Scan
from .poses import rotation, to_world, wrap_angle
from .ring import Ring
from .rooms import crossings, point_to_walls

OCCUPIED, UNKNOWN, FREE = 0, 205, 254
"""Grey values of map_server's trinary images."""
NO_WALLS = np.zeros((0, 2, 2))
"""Where nothing is known beforehand."""
MARGIN = 0.04
"""Metres; so much nearer than its echo a look leaves cells alone, for errors of ranges and poses."""
SURE = 2 / 3
"""Share of a cone in which silence counts. Towards its border a sensor is deaf to all but large walls: 6 dB one way is
12 dB there and back, over the inner two thirds it is 5 dB."""
EXPLAINED = 0.08
"""Metres; an echo this near to the range at which a known wall, end or corner must answer is the wall's."""
BEYOND_END = 0.3
"""Metres; walls go on beyond the ends that a map knows: those are the outermost feet of perpendiculars (section 5)."""
BEYOND_CONE = np.radians(5.0)
"""Radians; a wall is strong enough to be heard a little outside the cone."""
SHADE = np.radians(15.0)
"""Radians; an echo that no wall explains comes from something as wide as a wall, so it hides so much on each side of
the cone too: those looks go by it obliquely, and would not hear a wall there."""
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
    counts: Int[np.ndarray, "4 rows columns"]
    """``free``, ``hidden``, ``arcs``, ``walls``, one on the other."""
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
        return cls(resolution, (0, 0), np.zeros((4, 0, 0), np.int32), np.zeros((0, 0), np.uint16))

    @property
    def origin(self) -> tuple[float, float]:
        """Lower left corner (x, y) of the lower left cell, world frame, metres."""
        return self.corner[0] * self.resolution, self.corner[1] * self.resolution

    @property
    def free(self) -> Int[np.ndarray, "rows columns"]:
        """Looks that went through the cell; the robot's own body is worth 20."""
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
        agreed = (self.arcs >= min_looks) & (np.bitwise_count(self.places) >= min_places)
        obstacle = agreed & (self.arcs >= arc_share * (self.arcs + self.free))
        occupied = obstacle | (self.walls > 0) & (self.walls >= self.free)
        looks = self.free + self.hidden + self.arcs
        free = (self.free >= min_looks) & (self.free >= free_share * looks)
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
    eyes, first = _Eyes.of(ring), _first_echoes(ring, log)
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
    known = _Walls.of(walls, resolution)
    for cell, scan in zip(at, posed, strict=True):
        pose, corner = log.pose[scan], cell - size
        near = known.near(pose[:2], eyes.reach)
        seen = _evidence(eyes, pose, first[scan], listening[scan], near, corner, 2 * size + 1, resolution)
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


class _Eyes(NamedTuple):
    """The direct paths of a ring as plain arrays, and the outline of the robot that carries them."""

    position: np.ndarray  # (sensors, 2)
    heading: np.ndarray  # (sensors,)
    half: np.ndarray  # (sensors,) half a cone, radians
    max_range: float
    reach: float  # from the robot's origin, metres
    body: np.ndarray  # (edges, 3): inside where a x + b y + c <= 0; no edges where the sensors enclose no area

    @classmethod
    def of(cls, ring: Ring) -> "_Eyes":
        position, half = np.asarray(ring.position), np.minimum(np.asarray(ring.beam) / 2, np.pi / 2)
        try:
            body = ConvexHull(position).equations
        except (QhullError, ValueError):  # a bumper, or fewer than three sensors
            body = np.zeros((0, 3))
        reach = float(np.linalg.norm(position, axis=-1).max()) + ring.max_range
        return cls(position, np.asarray(ring.heading), half, ring.max_range, reach, body)


class _Walls(NamedTuple):
    """Known walls, where they meet, and the cells they go through."""

    segments: np.ndarray  # (walls, 2, 2)
    points: np.ndarray  # (points, 2): ends, and corners of walls that go on a little
    cells: np.ndarray  # (cells, 2) column and row in the world, each once
    resolution: float

    @classmethod
    def of(cls, walls: np.ndarray, resolution: float) -> "_Walls":
        length = np.linalg.norm(walls[:, 1] - walls[:, 0], axis=-1)
        walls, length = walls[length > 0], length[length > 0]
        share, other = crossings(walls, walls)
        spare = BEYOND_END / length[:, None]
        meet = (np.abs(share - 0.5) <= 0.5 + spare) & (np.abs(other - 0.5) <= 0.5 + spare.T)
        first, _ = np.nonzero(np.triu(meet))
        corners = walls[first, 0] + share[np.triu(meet)][:, None] * (walls[first, 1] - walls[first, 0])
        # Samples a quarter of a cell apart miss no more than a clipped corner of a cell.
        samples = (4 * length / resolution).astype(int) + 2
        wall = np.repeat(np.arange(len(walls)), samples)
        step = np.arange(samples.sum()) - np.repeat(np.cumsum(samples) - samples, samples)
        along = (step / (samples[wall] - 1))[:, None]
        marks = walls[wall, 0] + along * (walls[wall, 1] - walls[wall, 0])
        cells = np.unique(np.floor(marks / resolution).astype(int), axis=0)
        return cls(walls, np.concatenate([walls.reshape(-1, 2), corners]), cells, resolution)

    def near(self, place: np.ndarray, reach: float) -> "_Walls":
        """Those within reach of a place, metres."""
        walls = (point_to_walls(place[None], self.segments) <= reach)[0]
        points = np.linalg.norm(self.points - place, axis=-1) <= reach + EXPLAINED
        cells = np.linalg.norm((self.cells + 0.5) * self.resolution - place, axis=-1) <= reach
        return _Walls(self.segments[walls], self.points[points], self.cells[cells], self.resolution)


def _first_echoes(ring: Ring, log: Log) -> Float[np.ndarray, "scans sensors"]:
    """The nearest direct echo of each sensor, metres; infinite where it heard none within the maximum range."""
    direct = log.tx == log.rx
    sensor, scan = log.tx[direct], log.echo_scan[direct]
    if sensor.max(initial=0) >= ring.count:
        raise SonarError(
            f"grid: echo of sensor {sensor.max()}; allowed are 0 to {ring.count - 1}, the sensors of {ring.name!r}"
        )
    corrected = np.asarray(ring.corrected(log.range[direct], sensor, sensor))
    first = np.full((len(log), ring.count), np.inf)
    np.minimum.at(first, (scan, sensor), np.where(corrected < ring.max_range, corrected, np.inf))
    return first


def _evidence(
    eyes: _Eyes,
    pose: Float[np.ndarray, " 3"],
    first: Float[np.ndarray, " sensors"],
    listening: Bool[np.ndarray, " sensors"],
    walls: _Walls,
    corner: Int[np.ndarray, " 2"],
    size: int,
    resolution: float,
) -> Int[np.ndarray, "4 size size"]:
    """What one scan says about the square of cells around the robot that starts with cell ``corner``."""
    position, heading = to_world(pose, eyes.position[listening]), eyes.heading[listening] + pose[2]
    half, first = eyes.half[listening], first[listening]
    explained = _explained(position, heading, half, first, walls) | (first <= 0)

    # An echo that a wall explains says nothing about what is behind it, so that those looks end there.
    limit = np.where(explained, np.minimum(first, eyes.max_range), eyes.max_range)
    disc, place = _disc(eyes.max_range, resolution, size), position / resolution - corner
    look, cell, distance, off_axis = _cells_in_cones(disc, place, heading, half + SHADE, limit, size)
    sight = _sight(position, heading, half + SHADE, eyes.max_range, walls, resolution)
    rays = sight.shape[1]
    half, first, seen = half[look], first[look], np.ones(len(look), bool)
    if rays:
        ray = ((off_axis / (half + SHADE) + 1) * (rays / 2)).astype(int)
        seen = distance < sight[look, np.minimum(ray, rays - 1)]
    off_axis, unexplained = np.abs(off_axis), seen & ~explained[look]
    thick = resolution / np.sqrt(2)  # a circle through a cell is no farther from its centre than its corners are
    # Cells that the inner cone touches, so that no ring of unknown cells stays around a robot that stands.
    touched = distance * np.sin(np.maximum(off_axis - SURE * half, 0)) <= thick
    free = seen & touched & (distance < first - thick - MARGIN)
    arcs = unexplained & (off_axis <= half) & (np.abs(distance - first) <= thick)
    # Beyond the tangent of any point of the arc; outside the cone that is the tangent at the arc's end.
    hidden = unexplained & (distance * np.cos(np.maximum(off_axis - half, 0)) > first + thick)
    said = [np.bincount(cell[what], minlength=size**2) for what in (free, hidden, arcs)]
    counts = np.stack([*said, np.zeros(size**2, int)]).reshape(4, size, size)

    column, row = (walls.cells - corner).T
    counts[0, row, column] = 0
    counts[3, row, column] = 1
    column, row = (_under(eyes, pose, corner, size, resolution)).T
    counts[0, row, column] += BODY
    return counts


class _Disc(NamedTuple):
    """Cells around a point, for 4 x 4 places of the point in its own cell, by direction: a cone is a slice."""

    angle: np.ndarray  # (16, 2 cells) directions, radians, ascending over two turns
    distance: np.ndarray  # (16, 2 cells) metres
    cell: np.ndarray  # (16, 2 cells) index in a square of ``size`` rows, relative to the point's own cell


@lru_cache(maxsize=2)
def _disc(max_range: float, resolution: float, size: int) -> _Disc:
    far = max_range / resolution + 1
    column, row = np.meshgrid(*[np.arange(-int(far), int(far) + 1)] * 2)
    inside = np.hypot(column, row) <= far
    column, row = column[inside], row[inside]
    place = np.arange(16)[:, None]
    dx = (column + 0.5 - (place % 4 + 0.5) / 4) * resolution
    dy = (row + 0.5 - (place // 4 + 0.5) / 4) * resolution
    angle = np.arctan2(dy, dx)
    order = np.argsort(angle, axis=1, kind="stable")
    angle, distance = (np.take_along_axis(values, order, axis=1) for values in (angle, np.hypot(dx, dy)))
    cell = (row * size + column)[order]
    return _Disc(
        np.concatenate([angle, angle + 2 * np.pi], axis=1), np.tile(distance, 2), np.tile(cell.astype(np.int64), 2)
    )


def _cells_in_cones(
    disc: _Disc, position: np.ndarray, heading: np.ndarray, half: np.ndarray, limit: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Cells that each look looks at: (look, cell of the square, distance in metres, angle off the axis in radians).

    Args:
        disc: cells around a sensor.
        position: (looks, 2) in cells from the corner of the square; known to a quarter of a cell.
        heading: (looks,) radians.
        half: (looks,) half of each cone, radians.
        limit: (looks,) how far each look goes, metres.
        size: rows of the square.
    """
    own = np.floor(position)
    place = np.floor((position - own) * 4).astype(int)
    place = place[:, 1] * 4 + place[:, 0]
    begin = wrap_angle(heading - half)
    ends = [np.searchsorted(disc.angle[k], (a, b)) for k, a, b in zip(place, begin, begin + 2 * half, strict=True)]
    first, last = np.array(ends, dtype=int).reshape(-1, 2).T
    look = np.repeat(np.arange(len(place)), last - first)
    before = np.cumsum(last - first) - (last - first)
    index = np.arange(len(look)) + (place * disc.angle.shape[1] + first - before)[look]
    distance = disc.distance.ravel()[index]
    near = distance <= limit[look]
    look, index, distance = look[near], index[near], distance[near]
    off_axis = disc.angle.ravel()[index] - (begin + half)[look]
    return look, disc.cell.ravel()[index] + (own @ (1, size)).astype(int)[look], distance, off_axis


def _explained(
    position: np.ndarray, heading: np.ndarray, half: np.ndarray, first: np.ndarray, walls: _Walls
) -> Bool[np.ndarray, " looks"]:
    """Which first echoes come at the range of a known wall, its end or a corner, from within the cone."""
    start, along = walls.segments[:, 0], walls.segments[:, 1] - walls.segments[:, 0]
    length = np.linalg.norm(along, axis=-1)
    tangent = along / length[:, None]
    share = ((position[:, None] - start) * tangent).sum(-1)
    feet = start + share[..., None] * tangent
    on_wall = np.abs(share - length / 2) <= length / 2 + BEYOND_END
    points = np.broadcast_to(walls.points, (len(position), *walls.points.shape))
    to = np.concatenate([feet, points], axis=1) - position[:, None]
    there = np.concatenate([on_wall, np.ones(points.shape[:2], bool)], axis=1)
    there &= np.abs(np.linalg.norm(to, axis=-1) - first[:, None]) <= EXPLAINED
    off_axis = np.abs(wrap_angle(np.arctan2(to[..., 1], to[..., 0]) - heading[:, None]))
    return (there & (off_axis <= half[:, None] + BEYOND_CONE)).any(axis=1)


def _sight(
    position: np.ndarray, heading: np.ndarray, half: np.ndarray, max_range: float, walls: _Walls, resolution: float
) -> np.ndarray:
    """How far each look sees between rays across its cone, metres: to a known wall, or to the maximum range.

    The rays are a cell apart at the far end, and between two of them the nearer wall counts. No rays without walls.
    """
    if not len(walls.segments):
        return np.zeros((len(position), 0))
    rays = int(np.ceil(2 * half.max(initial=0) * max_range / resolution)) + 1
    turn = heading[:, None] + half[:, None] * np.linspace(-1, 1, rays + 1)
    ends = position[:, None] + max_range * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    starts = np.broadcast_to(position[:, None], ends.shape)
    share, other = crossings(np.stack([starts, ends], axis=-2).reshape(-1, 2, 2), walls.segments)
    hit = (share >= 0) & (np.abs(other - 0.5) <= 0.5 + 1e-9)
    reach = np.where(hit, share, np.inf).min(axis=1).reshape(turn.shape) * max_range
    return np.minimum(reach[:, 1:], reach[:, :-1])


def _under(eyes: _Eyes, pose: np.ndarray, corner: np.ndarray, size: int, resolution: float) -> np.ndarray:
    """Cells that the robot itself stands on, counted from ``corner``: inside the outline of its sensors."""
    if not len(eyes.body):
        return np.zeros((0, 2), int)
    wide = int(np.ceil(np.linalg.norm(eyes.position, axis=-1).max() / resolution)) + 1
    cells = np.stack(np.meshgrid(*[np.arange(size // 2 - wide, size // 2 + wide + 1)] * 2), axis=-1).reshape(-1, 2)
    inside = ((cells + corner + 0.5) * resolution - pose[:2]) @ rotation(pose[2])
    return cells[(inside @ eyes.body[:, :2].T + eyes.body[:, 2] <= 0).all(axis=1)]


def _window(start: np.ndarray, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of an array of this shape that starts at (column, row)."""
    column, row = (int(k) for k in start)
    return slice(row, row + shape[-2]), slice(column, column + shape[-1])


def _room_for(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    columns, rows = (int(k) for k in high - low)
    if columns * rows > MOST_CELLS:
        raise SonarError(f"grid: {columns} x {rows} cells; allowed are {MOST_CELLS} at most")
    return np.zeros((4, rows, columns), np.int32), np.zeros((rows, columns), np.uint16)


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


def grid_image_path(path: str | os.PathLike[str]) -> Path:
    """Where the image of a grid goes: beside its YAML file, under the same name.

    Raises:
        SonarError: the path does not end in .yaml or .yml.
    """
    suffix = Path(path).suffix
    if suffix.lower() not in (".yaml", ".yml"):
        came = f"suffix '{shown(suffix)}'" if suffix else "no suffix"
        raise SonarError(f"{shown(path)}: {came} came; allowed for a grid is .yaml or .yml, its .pgm goes beside it")
    return Path(path).with_suffix(".pgm")


def save_nav2(grid: OccupancyGrid, path: str | os.PathLike[str]) -> None:
    """Write the grid as Nav2's map_server loads it: MAP.yaml, and the image MAP.pgm beside it.

    The threshold for free is 0.196, as map_saver writes it for trinary images: with Nav2's older 0.25 the grey of
    unknown cells would be read as free (navigation2, pull request 5278).

    Args:
        grid: what is known, one cell at least.
        path: the YAML file, .yaml or .yml.

    Raises:
        SonarError: another suffix, a grid without cells, or a place that cannot be written.
    """
    image_path = grid_image_path(path)
    image = grid.classify()
    if not image.size:
        why = f"{grid.skipped} scans without a pose" if grid.skipped else "no scan"
        raise SonarError(f"{shown(path)}: {why} came, the grid is empty; needed is a scan with a pose")
    rows, columns = image.shape
    x, y = grid.origin
    with atomic_write(image_path, binary=True) as file:
        file.write(f"P5\n{columns} {rows}\n255\n".encode() + image.tobytes())
    with atomic_write(path) as file:
        file.write(
            f"image: {json.dumps(image_path.name)}\n"  # a JSON string is a YAML string, whatever is in the name
            f"mode: trinary\nresolution: {grid.resolution:.9g}\norigin: [{x:.9g}, {y:.9g}, 0.0]\n"
            "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
        )
