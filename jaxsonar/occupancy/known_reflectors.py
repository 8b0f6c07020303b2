"""Known walls and points: which echoes they explain, which of their parts later readings refute, and what they hide."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.geometry.segments import crossings, lengths, point_to_segments, sample_segments
from jaxsonar.occupancy.settings import SETTINGS

_WALLS = SETTINGS.reflectors


@runtime_checkable
class ReflectorMap(Protocol):
    """What a grid uses of a map, such as ``GlobalMap``."""

    @property
    def segments(self) -> Float[np.ndarray, "walls 2 2"]:
        """End points of the walls, world frame, metres."""
        ...

    @property
    def theta(self) -> Float[np.ndarray, " walls"]:
        """Directions of their normals, radians."""
        ...

    @property
    def sigma_rho(self) -> Float[np.ndarray, " walls"]:
        """Standard deviations of their distances from the origin, metres; NaN if unknown."""
        ...

    @property
    def sigma_theta(self) -> Float[np.ndarray, " walls"]:
        """Standard deviations of the directions, radians; NaN if unknown."""
        ...

    @property
    def points(self) -> Float[np.ndarray, "points 2"]:
        """Corners and edges, metres."""
        ...

    @property
    def point_cov(self) -> Float[np.ndarray, "points 2 2"]:
        """Their covariances, square metres; NaN if unknown."""
        ...


class KnownReflectors(NamedTuple):
    """Walls and points of a map, with standard deviations."""

    walls: Float[np.ndarray, "walls 2 2"]
    """Start and end points, world frame, metres."""
    wall_sd: Float[np.ndarray, "walls 2"]
    """Standard deviation across the wall at its start and its end, metres."""
    points: Float[np.ndarray, "points 2"]
    """Corners and edges, metres."""
    point_sd: Float[np.ndarray, " points"]
    """Largest standard deviation of each point, metres."""

    @classmethod
    def of_walls(cls, walls: Float[np.ndarray, "walls 2 2"]) -> "KnownReflectors":
        """Exact walls without points. Walls without length are left out."""
        walls = walls[lengths(walls) > 0]
        return cls(walls, np.zeros((len(walls), 2)), np.zeros((0, 2)), np.zeros(0))

    @classmethod
    def of_map(cls, world: ReflectorMap) -> "KnownReflectors":
        """Walls and points of a map. Standard deviations that are unknown count as 0."""
        keep = lengths(world.segments) > 0
        walls, theta = world.segments[keep], world.theta[keep]
        sd_rho, sd_theta = np.nan_to_num(world.sigma_rho[keep]), np.nan_to_num(world.sigma_theta[keep])
        # rho belongs to the foot of the world's origin: its error contains that of the direction, by this lever arm.
        tangent = np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
        lever = (walls.mean(axis=1) * tangent).sum(-1) * sd_theta
        middle = np.sqrt(np.maximum(sd_rho**2 - lever**2, 0))
        sd = np.hypot(middle, lengths(walls) / 2 * sd_theta)
        covariance = np.nan_to_num(world.point_cov)
        point_sd = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[:, -1], 0)) if len(covariance) else np.zeros(0)
        return cls(walls, np.stack([sd, sd], axis=-1), world.points, point_sd)

    def near(self, low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]) -> "KnownReflectors":
        """The reflectors that may be in a box, metres."""
        wall = ((self.walls.max(axis=1) >= low) & (self.walls.min(axis=1) <= high)).all(axis=1)
        point = ((self.points >= low) & (self.points <= high)).all(axis=1)
        return KnownReflectors(self.walls[wall], self.wall_sd[wall], self.points[point], self.point_sd[point])

    def reflecting_points(self) -> Float[np.ndarray, "points 2"]:
        """Points, wall ends, and crossings of walls that go on a little beyond their ends, metres."""
        length = lengths(self.walls)
        fraction, other = crossings(self.walls, self.walls)
        spare = _WALLS.beyond_end / length[:, None]
        meet = np.triu((np.abs(fraction - 0.5) <= 0.5 + spare) & (np.abs(other - 0.5) <= 0.5 + spare.T))
        first, _ = np.nonzero(meet)
        corners = self.walls[first, 0] + fraction[meet][:, None] * (self.walls[first, 1] - self.walls[first, 0])
        return np.concatenate([self.points, self.walls.reshape(-1, 2), corners])

    def cells(self, resolution: float) -> Int[np.ndarray, "cells 2"]:
        """Cells (column, row) of the world that the reflectors cover, with their uncertainty, without repetition."""
        length = lengths(self.walls)
        # Samples a quarter of a cell apart miss at most a clipped corner of a cell.
        samples = (4 * length / resolution).astype(int) + 2
        points, row = sample_segments(self.walls, samples)
        fraction = np.concatenate([np.linspace(0, 1, n) for n in samples]) if len(samples) else np.zeros(0)
        sd = self.wall_sd[row, 0] * (1 - fraction) + self.wall_sd[row, 1] * fraction
        points, sd = np.concatenate([points, self.points]), np.concatenate([sd, self.point_sd])
        radius = np.minimum(_WALLS.drawn_sd * sd, _WALLS.max_drawn) / resolution
        center = np.floor(points / resolution).astype(int)
        found = [center]
        reach = int(np.ceil(radius.max(initial=0)))
        for column in range(-reach, reach + 1):
            for line in range(-reach, reach + 1):
                cell = center + np.array([column, line])
                inside = np.linalg.norm(cell + 0.5 - points / resolution, axis=-1) <= radius
                found.append(cell[inside])
        return np.unique(np.concatenate(found), axis=0)


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
        columns = zip(*(part[:-1] for part in (empty, *parts)), strict=True)
        return cls(*(np.concatenate(column) for column in columns), max_range)

    def latest(self, count: int) -> "FacingReadings":
        """The latest readings and positions, at most this many of each."""
        return FacingReadings(*(column[-count:] for column in self[:-1]), self.max_range)


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
    walls: Float[np.ndarray, "walls 2 2"],
    readings: FacingReadings,
    *,
    beyond: float,
    resolution: float,
) -> LookedThrough:
    """Which parts of segments, and of their extensions, have no wall.

    A reading faces the part that holds its footpoint. It confirms the part with an echo from there, and refutes it
    with a later echo or none; where the robot drove, there is no wall.

    Args:
        segments: where walls may be, world frame, metres.
        walls: known walls, which hide what is behind them. The first of them may be the segments themselves.
        readings: of all scans.
        beyond: length of the extensions, metres.
        resolution: length of a part, metres.
    """
    length, before = lengths(segments), int(np.ceil(beyond / resolution))
    bins = np.ceil(length / resolution).astype(int) + 2 * before
    confirmed, refuted = (np.zeros((len(segments), bins.max()), np.int64) for _ in range(2))
    tangent = (segments[:, 1] - segments[:, 0]) / length[:, None]
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    for here, reading, wall, height in _facing_pairs(segments, normal, readings, beyond=beyond):
        along = ((here.position[reading] - segments[wall, 0]) * tangent[wall]).sum(-1)
        cell = np.floor(along / resolution).astype(int) + before
        on_segment = np.flatnonzero((cell >= 0) & (cell < bins[wall]))
        reading, wall, height, cell = (column[on_segment] for column in (reading, wall, height, cell))
        if not len(cell):
            continue
        # Another wall in between hides the part.
        start = here.position[reading]
        foot = start - height[:, None] * normal[wall]
        rays = np.concatenate([start, foot])
        between = ((walls.max(axis=1) >= rays.min(axis=0)) & (walls.min(axis=1) <= rays.max(axis=0))).all(axis=1)
        shown = ~_is_hidden(start, foot, segments[wall], walls[between])
        passed = here.first_echo[reading] > np.abs(height) + _WALLS.explained
        for counts, some in ((refuted, shown & passed), (confirmed, shown & ~passed)):
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
        np.apply_along_axis(np.convolve, 1, counts, kernel, "same") for counts in (refuted, confirmed)
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
        here = FacingReadings(*(column[rows] for column in readings[:4]), readings.driven, readings.max_range)
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
    looked = look_through(walls, walls, readings, beyond=_WALLS.max_extension, resolution=resolution)
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
    found = KnownReflectors(
        np.array(parts).reshape(-1, 2, 2), np.array(sd).reshape(-1, 2), known.points, known.point_sd
    )
    return WallProfile(found, np.array(extensions).reshape(-1, 2, 2))


def explained_by_reflectors(
    known: KnownReflectors,
    position: Float[np.ndarray, "echoes 2 2"],
    heading: Float[np.ndarray, "echoes 2"],
    half_width: Float[np.ndarray, "echoes 2"],
    distance: Float[np.ndarray, " echoes"],
) -> Bool[np.ndarray, " echoes"]:
    """Which echoes have the range of a known wall, wall end, corner or point within both cones.

    Args:
        known: the map around the echoes.
        position: of transmitter and receiver of each echo, world frame, metres.
        heading: of both, radians.
        half_width: of their cones, radians.
        distance: half path length, metres.
    """
    walls, points = known.walls, known.reflecting_points()
    middle, half = position.mean(axis=1), (position[:, 1] - position[:, 0]) / 2
    length = lengths(walls)
    tangent = (walls[:, 1] - walls[:, 0]) / np.maximum(length, 1e-9)[:, None]
    offset = middle[:, None] - walls[:, 0]
    height = np.abs(offset[..., 0] * tangent[:, 1] - offset[..., 1] * tangent[:, 0])
    along = (offset * tangent).sum(-1)
    expected = np.hypot(height, half @ tangent.T)
    foot = walls[:, 0] + along[..., None] * tangent
    on_wall = np.abs(along - length / 2) <= length / 2 + _WALLS.beyond_end
    to_point = np.linalg.norm(points - position[:, :, None], axis=-1).mean(axis=1)
    match = np.concatenate([np.where(on_wall, expected, np.inf), to_point], axis=1)
    match = np.abs(match - distance[:, None]) <= _WALLS.explained
    target = np.concatenate([foot, np.broadcast_to(points, (len(foot), *points.shape))], axis=1)
    seen = np.ones(match.shape, bool)
    for end in (0, 1):
        ray = target - position[:, None, end]
        off_axis = np.abs(wrap_angle(np.arctan2(ray[..., 1], ray[..., 0]) - heading[:, end, None]))
        seen &= off_axis <= half_width[:, end, None] + _WALLS.beyond_cone
    return (match & seen).any(axis=1)


def direction_of(walls: Float[np.ndarray, "walls 2 2"]) -> Float[np.ndarray, " walls"]:
    """Directions of the normals of walls, radians."""
    along = walls[:, 1] - walls[:, 0]
    return np.arctan2(along[:, 0], -along[:, 1])


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
    ends = np.concatenate([known.points, known.walls.reshape(-1, 2), obstacles])
    if not len(ends):
        return np.zeros((0, 2, 2))
    segments = ends[cKDTree(ends).query_pairs(_WALLS.max_hidden, output_type="ndarray")]
    segments = segments[lengths(segments) >= 2 * resolution]
    if not len(segments):
        return segments
    looked = look_through(segments, known.walls, readings, beyond=0.0, resolution=resolution)
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
