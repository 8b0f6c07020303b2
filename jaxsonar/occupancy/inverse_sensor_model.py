"""What one scan says about the cells around the robot: each direct path that listens is a look into its cone."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, QhullError

from jaxsonar.geometry.se2 import rotation, to_world, wrap_angle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.occupancy.wall_visibility import KnownWalls, beyond_ends, explained, sight
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

MARGIN = 0.04
"""Metres; so much nearer than its echo a look leaves cells alone, for errors of ranges and poses."""
SURE = 2 / 3
"""Share of a cone in which silence counts. Towards its border a sensor is deaf to all but large walls: 6 dB one way is
12 dB there and back, over the inner two thirds it is 5 dB."""
SHADE = np.radians(15.0)
"""Radians; an echo that no wall explains comes from something as wide as a wall, so it hides so much on each side of
the cone too: those looks go by it obliquely, and would not hear a wall there."""


class Eyes(NamedTuple):
    """The direct paths of a ring as plain arrays, and the outline of the robot that carries them."""

    position: np.ndarray  # (sensors, 2)
    heading: np.ndarray  # (sensors,)
    half: np.ndarray  # (sensors,) half a cone, radians
    max_range: float
    reach: float  # from the robot's origin, metres
    body: np.ndarray  # (edges, 3): inside where a x + b y + c <= 0; no edges where the sensors enclose no area

    @classmethod
    def of(cls, ring: Ring) -> "Eyes":
        """Those of a ring."""
        position, half = np.asarray(ring.position), np.minimum(np.asarray(ring.beam) / 2, np.pi / 2)
        try:
            body = ConvexHull(position).equations
        except (QhullError, ValueError):  # a bumper, or fewer than three sensors
            body = np.zeros((0, 3))
        reach = float(np.linalg.norm(position, axis=-1).max()) + ring.max_range
        return cls(position, np.asarray(ring.heading), half, ring.max_range, reach, body)


def first_echoes(ring: Ring, log: Log) -> Float[np.ndarray, "scans sensors"]:
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


def evidence(
    eyes: Eyes,
    pose: Float[np.ndarray, " 3"],
    first: Float[np.ndarray, " sensors"],
    listening: Bool[np.ndarray, " sensors"],
    walls: KnownWalls,
    corner: Int[np.ndarray, " 2"],
    size: int,
) -> Int[np.ndarray, "5 size size"]:
    """What one scan says about the square of cells around the robot that starts with cell ``corner``.

    Free, hidden, arcs, walls, driven: the layers of ``OccupancyGrid.counts``.
    """
    resolution = walls.resolution
    position, heading = to_world(pose, eyes.position[listening]), eyes.heading[listening] + pose[2]
    half, first = eyes.half[listening], first[listening]
    known = explained(position, heading, half, first, walls) | (first <= 0)

    # An echo that a wall explains says nothing about what is behind it, so that those looks end there.
    limit = np.where(known, np.minimum(first, eyes.max_range), eyes.max_range)
    disc, place = _disc(eyes.max_range, resolution, size), position / resolution - corner
    look, cell, distance, off_axis = _cells_in_cones(disc, place, heading, half + SHADE, limit, size)
    beyond = beyond_ends(position, heading, SURE * half, np.minimum(first, eyes.max_range), walls)
    open_until = sight(position, heading, half + SHADE, eyes.max_range, walls, beyond)
    rays = open_until.shape[1]
    half, first, seen = half[look], first[look], np.ones(len(look), bool)
    if rays:
        ray = ((off_axis / (half + SHADE) + 1) * (rays / 2)).astype(int)
        seen = distance < open_until[look, np.minimum(ray, rays - 1)]
    off_axis, unexplained = np.abs(off_axis), seen & ~known[look]
    thick = resolution / np.sqrt(2)  # a circle through a cell is no farther from its centre than its corners are
    # Cells that the inner cone touches, so that no ring of unknown cells stays around a robot that stands.
    touched = distance * np.sin(np.maximum(off_axis - SURE * half, 0)) <= thick
    free = seen & touched & (distance < first - thick - MARGIN)
    arcs = unexplained & (off_axis <= half) & (np.abs(distance - first) <= thick)
    # Beyond the tangent of any point of the arc; outside the cone that is the tangent at the arc's end.
    hidden = unexplained & (distance * np.cos(np.maximum(off_axis - half, 0)) > first + thick)
    counts = np.zeros((5, size, size), int)
    for layer, what in enumerate((free, hidden, arcs)):
        counts[layer].flat = np.bincount(cell[what], minlength=size**2)
    column, row = (walls.cells - corner).T
    counts[0, row, column] = 0
    counts[3, row, column] = 1
    column, row = _under(eyes, pose, corner, size, resolution).T
    counts[4, row, column] = 1
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


def _under(eyes: Eyes, pose: np.ndarray, corner: np.ndarray, size: int, resolution: float) -> np.ndarray:
    """Cells that the robot itself stands on, counted from ``corner``: inside the outline of its sensors, or theirs."""
    if len(eyes.body):
        wide = int(np.ceil(np.linalg.norm(eyes.position, axis=-1).max() / resolution)) + 1
        cells = np.stack(np.meshgrid(*[np.arange(size // 2 - wide, size // 2 + wide + 1)] * 2), axis=-1).reshape(-1, 2)
        inside = ((cells + corner + 0.5) * resolution - pose[:2]) @ rotation(pose[2])
        cells = cells[(inside @ eyes.body[:, :2].T + eyes.body[:, 2] <= 0).all(axis=1)]
        if len(cells):
            return cells
    return np.floor(to_world(pose, eyes.position) / resolution).astype(int) - corner
