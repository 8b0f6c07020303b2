"""Visibility of known walls: which echoes they explain, and how far each beam can see."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar.geometry.se2 import unit, wrap_angle
from jaxsonar.geometry.segments import crossings, lengths, point_to_segments, sample_segments
from jaxsonar.occupancy.settings import SETTINGS


class WallMap(NamedTuple):
    """Known walls, their ends and corners, and the grid cells that they cross."""

    segments: Float[np.ndarray, "walls 2 2"]
    """Start and end points, world frame, metres."""
    points: Float[np.ndarray, "points 2"]
    """Ends of walls, and crossings of walls that extend a little beyond their ends, metres."""
    cells: np.ndarray
    """Cells (column, row) that a wall crosses, world frame, without repetition."""
    extension_limit: Float[np.ndarray, "walls 2"]
    """Largest length by which each wall may extend beyond its start and its end, metres; 0 where it meets another."""
    resolution: float
    """Side of a cell, metres."""

    @classmethod
    def of(cls, walls: Float[np.ndarray, "walls 2 2"], resolution: float) -> "WallMap":
        """The map of these walls. Walls without length are left out."""
        length = lengths(walls)
        walls, length = walls[length > 0], length[length > 0]
        # Corners: crossings on both walls, or a little beyond their ends.
        fraction, other = crossings(walls, walls)
        spare = SETTINGS.beyond_end / length[:, None]
        meet = (np.abs(fraction - 0.5) <= 0.5 + spare) & (np.abs(other - 0.5) <= 0.5 + spare.T)
        first, _ = np.nonzero(np.triu(meet))
        corners = walls[first, 0] + fraction[np.triu(meet)][:, None] * (walls[first, 1] - walls[first, 0])
        # Cells: samples a quarter of a cell apart miss at most a clipped corner of a cell.
        samples = (4 * length / resolution).astype(int) + 2
        cells = np.unique(np.floor(sample_segments(walls, samples)[0] / resolution).astype(int), axis=0)
        # Ends that touch another wall cannot extend.
        gap = point_to_segments(walls.reshape(-1, 2), walls)
        gap[np.arange(len(gap)), np.arange(len(gap)) // 2] = np.inf
        touches = gap.min(axis=1, initial=np.inf) <= SETTINGS.touches
        extension_limit = np.where(touches, 0.0, SETTINGS.max_extension).reshape(-1, 2)
        return cls(walls, np.concatenate([walls.reshape(-1, 2), corners]), cells, extension_limit, resolution)

    def near(self, position: Float[np.ndarray, "2"], radius: float, *, margin: float = 0.0) -> "WallMap":
        """The part of the map within a radius of a position, metres, with the walls extended as far as possible.

        The walls and points, but not the cells, extend farther by the margin, metres.
        """
        walls = (point_to_segments(position[None], self.segments) <= radius + margin + SETTINGS.max_extension)[0]
        points = np.linalg.norm(self.points - position, axis=-1) <= radius + margin + SETTINGS.explained
        cells = np.linalg.norm((self.cells + 0.5) * self.resolution - position, axis=-1) <= radius
        return WallMap(
            self.segments[walls], self.points[points], self.cells[cells], self.extension_limit[walls], self.resolution
        )


def explained_by_walls(
    position: Float[np.ndarray, "beams 2"],
    heading: Float[np.ndarray, " beams"],
    half_width: Float[np.ndarray, " beams"],
    first_echo: Float[np.ndarray, " beams"],
    walls: WallMap,
) -> Bool[np.ndarray, " beams"]:
    """Which first echoes match the range of a known wall, wall end or corner within the cone.

    Args:
        position: of the sensors, world frame, metres.
        heading: of the sensors, radians.
        half_width: of the cones, radians.
        first_echo: range of the first echo, metres; inf for none.
        walls: the known walls.
    """
    foot, along, length = _footpoints(position, walls)
    on_wall = np.abs(along - length / 2) <= length / 2 + SETTINGS.beyond_end
    points = np.broadcast_to(walls.points, (len(position), *walls.points.shape))
    distance, off_axis = _range_and_angle(position, heading, np.concatenate([foot, points], axis=1))
    match = np.concatenate([on_wall, np.ones(points.shape[:2], bool)], axis=1)
    match &= np.abs(distance - first_echo[:, None]) <= SETTINGS.explained
    return np.any(match & (off_axis <= half_width[:, None] + SETTINGS.beyond_cone), axis=1)


def estimate_extensions(
    position: Float[np.ndarray, "beams 2"],
    heading: Float[np.ndarray, " beams"],
    half_width: Float[np.ndarray, " beams"],
    silent_until: Float[np.ndarray, " beams"],
    walls: WallMap,
) -> Float[np.ndarray, "walls 2"]:
    """Largest length by which each wall can extend beyond its start and its end, metres, according to one scan.

    A map contains walls up to the outermost footpoint. If the extended wall would have a footpoint of a sensor, but the
    sensor received nothing, then the wall has ended before. So an open door stays open for a robot that looks through
    it at a right angle.

    Args:
        position: of the sensors, world frame, metres.
        heading: of the sensors, radians.
        half_width: half of the part of each cone in which a wall is always detected, radians.
        silent_until: range up to which nothing was received, metres.
        walls: the known walls.
    """
    foot, along, length = _footpoints(position, walls)
    distance, off_axis = _range_and_angle(position, heading, foot)
    missed = (off_axis <= half_width[:, None]) & (distance + SETTINGS.explained < silent_until[:, None])
    beyond = np.stack([-along, along - length], axis=-1)
    limit = np.where(missed[..., None] & (beyond > 0), np.maximum(beyond - SETTINGS.no_wall, 0), np.inf)
    return np.minimum(limit.min(axis=0, initial=np.inf), walls.extension_limit)


def visible_range(
    position: Float[np.ndarray, "beams 2"],
    heading: Float[np.ndarray, " beams"],
    half_width: Float[np.ndarray, " beams"],
    max_range: float,
    walls: WallMap,
    extension: Float[np.ndarray, "walls 2"],
) -> Float[np.ndarray, "beams sectors"]:
    """Distance to the nearest wall, at most the maximum range, for sectors of each beam, metres.

    A sector lies between two rays; the rays are one cell apart at the maximum range. The nearer of the walls on the two
    rays counts. Without walls there are no sectors.

    Args:
        position: of the sensors, world frame, metres.
        heading: of the sensors, radians.
        half_width: of the beams, radians.
        max_range: metres.
        walls: the known walls.
        extension: length by which they extend beyond their starts and ends, metres.
    """
    if not len(walls.segments):
        return np.zeros((len(position), 0))
    sectors = int(np.ceil(2 * half_width.max(initial=0) * max_range / walls.resolution)) + 1
    angle = heading[:, None] + half_width[:, None] * np.linspace(-1, 1, sectors + 1)
    ends = position[:, None] + max_range * unit(angle)
    starts = np.broadcast_to(position[:, None], ends.shape)
    fraction, other = crossings(np.stack([starts, ends], axis=-2).reshape(-1, 2, 2), walls.segments)
    before, after = (extension / lengths(walls.segments)[:, None]).T
    hit = (fraction >= 0) & (other >= -before - 1e-9) & (other <= 1 + after + 1e-9)
    distance = np.where(hit, fraction, np.inf).min(axis=1).reshape(angle.shape) * max_range
    return np.minimum(distance[:, 1:], distance[:, :-1])


def _footpoints(
    position: Float[np.ndarray, "beams 2"], walls: WallMap
) -> tuple[Float[np.ndarray, "beams walls 2"], Float[np.ndarray, "beams walls"], Float[np.ndarray, " walls"]]:
    """Footpoint of each sensor on the line of each wall, its position along the wall, and the wall's length, metres."""
    start, along = walls.segments[:, 0], walls.segments[:, 1] - walls.segments[:, 0]
    length = np.linalg.norm(along, axis=-1)
    tangent = along / length[:, None]
    foot_along = ((position[:, None] - start) * tangent).sum(-1)
    return start + foot_along[..., None] * tangent, foot_along, length


def _range_and_angle(
    position: Float[np.ndarray, "beams 2"], heading: Float[np.ndarray, " beams"], points: Float[np.ndarray, "beams n 2"]
) -> tuple[Float[np.ndarray, "beams n"], Float[np.ndarray, "beams n"]]:
    """Distance (metres) and absolute angle off the axis (radians) of the points from the sensors."""
    to_point = points - position[:, None]
    off_axis = np.abs(wrap_angle(np.arctan2(to_point[..., 1], to_point[..., 0]) - heading[:, None]))
    return np.linalg.norm(to_point, axis=-1), off_axis
