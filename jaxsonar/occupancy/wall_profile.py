"""Which parts of known walls exist, and where walls may stand that no sensor has faced."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import KDTree

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.geometry.segments import crossings, lengths, point_to_segments
from jaxsonar.occupancy.known_reflectors import KnownReflectors
from jaxsonar.occupancy.settings import SETTINGS

_WALLS = SETTINGS.reflectors


class FacingReadings(NamedTuple):
    """Direct readings of all scans, and where the robot drove."""

    position: Float[np.ndarray, "readings 2"]
    """Of the sensors, world frame, metres."""
    heading: Float[np.ndarray, " readings"]
    """Of the sensors, radians."""
    certain: Float[np.ndarray, " readings"]
    """Half of the part of each cone in which a wall is heard for sure, radians."""
    first_echo: Float[np.ndarray, " readings"]
    """Range up to which each sensor heard nothing, metres."""
    driven: Float[np.ndarray, "poses 2"]
    """Positions of the robot, metres."""
    max_range: float
    """Metres."""

    @classmethod
    def concatenate(cls, parts: Sequence["FacingReadings"], max_range: float) -> "FacingReadings":
        """All readings of several collections, possibly of none."""
        empty = cls(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0), np.zeros((0, 2)), max_range)
        some = (empty, *parts)
        return cls(
            np.concatenate([part.position for part in some]),
            np.concatenate([part.heading for part in some]),
            np.concatenate([part.certain for part in some]),
            np.concatenate([part.first_echo for part in some]),
            np.concatenate([part.driven for part in some]),
            max_range,
        )

    def latest(self, count: int) -> "FacingReadings":
        """The latest readings and positions, at most this many of each."""
        return FacingReadings(
            self.position[-count:],
            self.heading[-count:],
            self.certain[-count:],
            self.first_echo[-count:],
            self.driven[-count:],
            self.max_range,
        )


class WallProfile(NamedTuple):
    """Which parts of walls and of their extensions exist, according to all readings."""

    parts: KnownReflectors
    """The walls without the parts that readings looked through, and all points."""
    extensions: Float[np.ndarray, "extensions 2 2"]
    """Segments along which a wall may go on unseen, metres."""


class LookedThrough(NamedTuple):
    """Parts of segments that no wall can fill."""

    open: Bool[np.ndarray, "segments bins"]
    """Whether readings refute each part; parts have the length of a cell."""
    before: int
    """Number of parts before the start of each segment, and after its end."""
    parts: Int[np.ndarray, " segments"]
    """Number of all parts of each segment."""


def look_through(
    segments: Float[np.ndarray, "segments 2 2"],
    known: KnownReflectors,
    readings: FacingReadings,
    *,
    beyond: float,
    resolution: float,
) -> LookedThrough:
    """Which parts of segments, and of their extensions, have no wall.

    A reading faces the part that holds its footpoint. It confirms the part with an echo from there, and refutes it
    with a later echo or none, or with an echo whose range fits a known point or wall end better, such as the frame of a
    door. Where the robot drove, there is no wall.

    Args:
        segments: where walls may be, world frame, metres.
        known: walls, which hide what is behind them, and points. The walls may be the segments themselves.
        readings: of all scans.
        beyond: length of the extensions, metres.
        resolution: length of a part, metres.
    """
    length, before = lengths(segments), int(np.ceil(beyond / resolution))
    bins = np.ceil(length / resolution).astype(int) + 2 * before
    confirmed, refuted = (np.zeros((len(segments), bins.max()), np.int64) for _ in range(2))
    tangent = (segments[:, 1] - segments[:, 0]) / length[:, None]
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    points, radii, max_range = known.reflecting_points(), known.reflecting_radii(), readings.max_range
    for here, reading, wall, height in _facing_pairs(segments, normal, readings, beyond=beyond):
        along = ((here.position[reading] - segments[wall, 0]) * tangent[wall]).sum(-1)
        cell = np.floor(along / resolution).astype(int) + before
        on_segment = np.flatnonzero((cell >= 0) & (cell < bins[wall]))
        if not len(on_segment):
            continue
        reading, wall, height, cell = (column[on_segment] for column in (reading, wall, height, cell))
        # Another wall in between hides the part.
        start = here.position[reading]
        foot = start - height[:, None] * normal[wall]
        near = known.near(start.min(axis=0) - max_range, start.max(axis=0) + max_range)
        shown = ~_is_hidden(start, foot, segments[wall], near.walls)
        reading, wall, height, cell, start = (column[shown] for column in (reading, wall, height, cell, start))
        later = here.first_echo[reading] - np.abs(height)
        half_width = here.certain[reading] / SETTINGS.free.certain
        close = (points >= start.min(axis=0, initial=np.inf) - max_range) & (
            points <= start.max(axis=0, initial=-np.inf) + max_range
        )
        close = close.all(axis=1)
        fit = _point_residual(
            start, here.heading[reading], half_width, here.first_echo[reading], points[close], radii[close]
        )
        passed = (later > _WALLS.explained) | (later > _WALLS.distinct) & (fit < later)
        for counts, some in ((refuted, passed), (confirmed, ~passed)):
            np.add.at(counts, (wall[some], cell[some]), 1)
    driven = readings.driven
    for wall in range(len(segments)):  # where the robot drove, there is no wall
        offset = driven - segments[wall, 0]
        near = np.abs(offset @ normal[wall]) <= resolution
        cell = np.floor((offset[near] @ tangent[wall]) / resolution).astype(int) + before
        cell = cell[(cell >= 0) & (cell < bins[wall])]
        refuted[wall, cell] += 1_000
    kernel = np.ones(2 * _WALLS.window + 1, np.int64)
    refuted, confirmed = (
        ndimage.convolve1d(counts, kernel, axis=1, mode="constant") for counts in (refuted, confirmed)
    )
    return LookedThrough((refuted >= _WALLS.min_looks) & (refuted > 2 * confirmed), before, bins)


def _facing_pairs(
    segments: Float[np.ndarray, "segments 2 2"],
    normal: Float[np.ndarray, "segments 2"],
    readings: FacingReadings,
    *,
    beyond: float,
) -> Iterator[tuple[FacingReadings, Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"], Float[np.ndarray, " pairs"]]]:
    """Readings that face the lines of segments, and hear nothing nearer, one part of the floor after the other.

    Args:
        segments: world frame, metres.
        normal: of each.
        readings: of all scans.
        beyond: length of the extensions of the segments, metres.

    Yields:
        Readings of about the same place and direction; rows of these readings and of the segments; heights of the
        readings above the segments' lines, in the direction of the normals, metres.
    """
    low, high = segments.min(axis=1) - beyond, segments.max(axis=1) + beyond
    limit = np.minimum(readings.max_range, readings.first_echo + _WALLS.explained)
    sector = np.floor(readings.heading % (2 * np.pi) / (np.pi / 4))
    key = np.column_stack([np.floor(readings.position / (readings.max_range / 2)), sector]).astype(int)
    order = np.lexsort(key.T)
    new = np.flatnonzero((np.diff(key[order], axis=0) != 0).any(axis=1)) + 1
    for rows in np.split(order, new) if len(order) else []:
        position, heading, certain = readings.position[rows], readings.heading[rows], readings.certain[rows]
        # Footpoints lie in the cones: in a box around them.
        angle = heading[:, None] + certain[:, None] * np.linspace(-1, 1, 5)
        rim = position[:, None] + limit[rows, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        cones = np.concatenate([position, rim.reshape(-1, 2)])
        sagitta = float(limit[rows].max() * (1 - np.cos(certain.max() / 4)))
        inside = (low <= cones.max(axis=0) + sagitta) & (high >= cones.min(axis=0) - sagitta)
        near = np.flatnonzero(inside.all(axis=1))
        if not len(near):
            continue
        first_echo = readings.first_echo[rows]
        here = FacingReadings(position, heading, certain, first_echo, readings.driven, readings.max_range)
        ray = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        count = max(1, 4_000_000 // len(near))
        for begin in range(0, len(rows), count):
            part = slice(begin, begin + count)
            height = position[part] @ normal[near].T - (segments[near, 0] * normal[near]).sum(-1)
            ahead = ray[part] @ normal[near].T * np.where(height < 0, 1, -1)
            reading, wall = np.nonzero(
                (ahead >= np.cos(certain[part, None])) & (np.abs(height) < limit[rows[part], None])
            )
            if len(reading):
                yield here, reading + begin, near[wall], height[reading, wall]


def profile_walls(known: KnownReflectors, readings: FacingReadings, *, resolution: float) -> WallProfile:
    """Test every part of every wall, and of its extensions, with the readings that face it.

    An open door stays open for a robot that looks through it at a right angle, or drives through it.
    """
    walls, length = known.walls, lengths(known.walls)
    if not len(walls):
        return WallProfile(known, np.zeros((0, 2, 2)))
    looked = look_through(walls, known, readings, beyond=_WALLS.max_extension, resolution=resolution)
    open_, beyond, bins = looked
    tangent = (walls[:, 1] - walls[:, 0]) / length[:, None]
    parts, sd, extensions = [], [], []
    for wall in range(len(walls)):
        inside = np.zeros(bins[wall], bool)
        inside[beyond : bins[wall] - beyond] = True
        kept = inside & ~open_[wall, : bins[wall]]
        edges = np.flatnonzero(np.diff(np.concatenate([[0], kept.astype(int), [0]])))
        for first, last in edges.reshape(-1, 2):
            ends = np.clip((np.array([first, last]) - beyond) * resolution, 0, length[wall])
            if ends[1] > ends[0]:
                parts.append(walls[wall, 0] + ends[:, None] * tangent[wall])
                fraction = ends / length[wall]
                sd.append(known.wall_sd[wall, 0] * (1 - fraction) + known.wall_sd[wall, 1] * fraction)
        unseen = ~inside & ~open_[wall, : bins[wall]]
        edges = np.flatnonzero(np.diff(np.concatenate([[0], unseen.astype(int), [0]])))
        along = (edges.reshape(-1, 2) - beyond) * resolution
        along = along[along[:, 1] - along[:, 0] >= _WALLS.min_length]
        limit = _meeting_points(walls, wall)
        along = np.where(along < 0, np.maximum(along, limit[0]), np.minimum(along, limit[1]))
        for first, last in along[along[:, 1] - along[:, 0] > 1e-6]:
            extensions.append(walls[wall, 0] + np.array([[first], [last]]) * tangent[wall])
    found = known._replace(walls=np.array(parts).reshape(-1, 2, 2), wall_sd=np.array(sd).reshape(-1, 2))
    return WallProfile(found, np.array(extensions).reshape(-1, 2, 2))


def _is_hidden(
    start: Float[np.ndarray, "rays 2"],
    end: Float[np.ndarray, "rays 2"],
    segment: Float[np.ndarray, "rays 2 2"],
    walls: Float[np.ndarray, "walls 2 2"],
) -> Bool[np.ndarray, " rays"]:
    """Whether a wall other than the ray's own segment lies between its start and its end."""
    hidden = np.zeros(len(start), bool)
    rows = max(1, 1_000_000 // max(len(walls), 1))
    for begin in range(0, len(start), rows):
        here = slice(begin, begin + rows)
        fraction, other = crossings(np.stack([start[here], end[here]], axis=1), walls)
        blocks = (fraction > 0) & (fraction < 0.98) & (other >= 0) & (other <= 1)
        own = (segment[here, None] == walls).all(axis=(2, 3))
        hidden[here] = (blocks & ~own).any(axis=1)
    return hidden


def hidden_walls(
    known: KnownReflectors, obstacles: Float[np.ndarray, "obstacles 2"], readings: FacingReadings, *, resolution: float
) -> Float[np.ndarray, "hidden 2 2"]:
    """Segments between edges near each other, along which a short wall may stand that no sensor has faced, metres.

    The ends of a wall, such as the edges of a box, return echoes in all directions, its surface in one only.

    Args:
        known: the map.
        obstacles: positions of further obstacles, metres.
        readings: of all scans.
        resolution: side of a cell, metres.
    """
    edges = known.points[known.point_radius == 0]
    ends = np.concatenate([edges, known.walls.reshape(-1, 2), obstacles])
    if not len(ends):
        return np.zeros((0, 2, 2))
    segments = ends[_near_pairs(ends)]
    segments = segments[lengths(segments) >= 2 * resolution]
    if not len(segments):
        return segments
    looked = look_through(segments, known, readings, beyond=0.0, resolution=resolution)
    row, part = np.nonzero(~looked.open & (np.arange(looked.open.shape[1]) < looked.parts[:, None]))
    tangent = (segments[:, 1] - segments[:, 0]) / lengths(segments)[:, None]
    end = np.minimum((part[:, None] + [0, 1]) * resolution, lengths(segments)[row, None])
    return segments[row, 0, None] + end[..., None] * tangent[row, None]


def _meeting_points(walls: Float[np.ndarray, "walls 2 2"], wall: int) -> tuple[float, float]:
    """Positions along ONE wall, at or before its start and at or beyond its end, where its line meets other walls.

    Metres from its start; infinite where it meets none.
    """
    others = np.delete(walls, wall, axis=0)
    length = float(np.linalg.norm(walls[wall, 1] - walls[wall, 0]))
    if not len(others):
        return -np.inf, np.inf
    gap = point_to_segments(walls[wall], others).min(axis=1)
    fraction, other = crossings(walls[wall][None], others)
    spare = _WALLS.touches / lengths(others)
    meets = np.where((other[0] >= -spare) & (other[0] <= 1 + spare), fraction[0] * length, np.nan)
    before, after = meets[meets <= _WALLS.touches], meets[meets >= length - _WALLS.touches]
    return (
        0.0 if gap[0] <= _WALLS.touches else float(before.max(initial=-np.inf)),
        length if gap[1] <= _WALLS.touches else float(after.min(initial=np.inf)),
    )


def _near_pairs(points: Float[np.ndarray, "points 2"]) -> Int[np.ndarray, "pairs 2"]:
    """Pairs of points near each other, each with its nearest only, so that their number grows with the points."""
    gap, other = KDTree(points).query(points, k=_WALLS.hidden_neighbors + 1, distance_upper_bound=_WALLS.max_hidden)
    first, rank = np.nonzero(np.isfinite(gap))
    second = np.asarray(other)[first, rank]
    pairs = np.unique(np.sort(np.stack([first, second], axis=-1), axis=1), axis=0)
    return pairs[pairs[:, 0] != pairs[:, 1]]


def _point_residual(
    position: Float[np.ndarray, "readings 2"],
    heading: Float[np.ndarray, " readings"],
    half_width: Float[np.ndarray, " readings"],
    first_echo: Float[np.ndarray, " readings"],
    points: Float[np.ndarray, "points 2"],
    radii: Float[np.ndarray, " points"],
) -> Float[np.ndarray, " readings"]:
    """Smallest difference of the first echo and the range of a point or circle in the cone, metres; inf without one."""
    ray = points - position[:, None]
    off_axis = np.abs(wrap_angle(np.arctan2(ray[..., 1], ray[..., 0]) - heading[:, None]))
    residual = np.abs(np.linalg.norm(ray, axis=-1) - radii - first_echo[:, None])
    inside = off_axis <= half_width[:, None] + _WALLS.beyond_cone
    return np.where(inside, residual, np.inf).min(axis=1, initial=np.inf)
