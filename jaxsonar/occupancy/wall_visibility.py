"""What known walls explain of the echoes, and what they hide: lines of sight for occupancy grids."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar.floor_plans.room import crossings, point_to_walls
from jaxsonar.geometry.se2 import wrap_angle

EXPLAINED = 0.08
"""Metres; an echo this near to the range at which a known wall, end or corner must answer is the wall's."""
BEYOND_END = 0.3
"""Metres; walls answer beyond the ends that a map knows: those are the outermost feet of perpendiculars (section 5)."""
BEYOND_CONE = np.radians(5.0)
"""Radians; a wall is strong enough to be heard a little outside the cone."""
HIDDEN = 1.0
"""Metres; so far a wall may go on beyond its ends where nobody could hear it, and hides what is behind."""
TOUCHES = 0.05
"""Metres; a wall whose end is this near to another wall ends there."""
NO_WALL = 0.2
"""Metres; so far around the foot of a sensor that would have heard a wall, and did not, there is none."""


class KnownWalls(NamedTuple):
    """Known walls, where they meet, and the cells they go through."""

    segments: np.ndarray  # (walls, 2, 2)
    points: np.ndarray  # (points, 2): ends, and corners of walls that go on a little
    cells: np.ndarray  # (cells, 2) column and row in the world, each once
    may_go_on: np.ndarray  # (walls, 2) metres beyond start and end: none where the end is on another wall
    resolution: float

    @classmethod
    def of(cls, walls: np.ndarray, resolution: float) -> "KnownWalls":
        """Walls without length are left out."""
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
        gap = point_to_walls(walls.reshape(-1, 2), walls)
        gap[np.arange(len(gap)), np.arange(len(gap)) // 2] = np.inf
        may_go_on = np.where(gap.min(axis=1, initial=np.inf) <= TOUCHES, 0.0, HIDDEN).reshape(-1, 2)
        return cls(walls, np.concatenate([walls.reshape(-1, 2), corners]), cells, may_go_on, resolution)

    def near(self, place: np.ndarray, reach: float) -> "KnownWalls":
        """Those within reach of a place, metres, if they go on as far as they may."""
        walls = (point_to_walls(place[None], self.segments) <= reach + HIDDEN)[0]
        points = np.linalg.norm(self.points - place, axis=-1) <= reach + EXPLAINED
        cells = np.linalg.norm((self.cells + 0.5) * self.resolution - place, axis=-1) <= reach
        return KnownWalls(
            self.segments[walls], self.points[points], self.cells[cells], self.may_go_on[walls], self.resolution
        )


def explained(
    position: np.ndarray, heading: np.ndarray, half: np.ndarray, first: np.ndarray, walls: KnownWalls
) -> Bool[np.ndarray, " looks"]:
    """Which first echoes come at the range of a known wall, its end or a corner, from within the cone."""
    foot, along, length = _feet(position, walls)
    on_wall = np.abs(along - length / 2) <= length / 2 + BEYOND_END
    points = np.broadcast_to(walls.points, (len(position), *walls.points.shape))
    distance, off_axis = _seen(position, heading, np.concatenate([foot, points], axis=1))
    there = np.concatenate([on_wall, np.ones(points.shape[:2], bool)], axis=1)
    there &= np.abs(distance - first[:, None]) <= EXPLAINED
    return (there & (off_axis <= half[:, None] + BEYOND_CONE)).any(axis=1)


def beyond_ends(
    position: np.ndarray, heading: np.ndarray, sure: np.ndarray, silent: np.ndarray, walls: KnownWalls
) -> Float[np.ndarray, "walls 2"]:
    """How far each wall may go on beyond its start and its end, metres, as far as one scan can tell.

    A map knows walls only as far as the feet of sensors reached. Where such a foot would be, but the sensor was silent,
    the wall has ended: so an open door stays open for who looks squarely through it.

    Args:
        position: (looks, 2) metres.
        heading: (looks,) radians.
        sure: (looks,) half of the cone in which a wall is heard for certain, radians.
        silent: (looks,) how far nothing was heard, metres.
        walls: the walls around.
    """
    foot, along, length = _feet(position, walls)
    distance, off_axis = _seen(position, heading, foot)
    missed = (off_axis <= sure[:, None]) & (distance + EXPLAINED < silent[:, None])
    beyond = np.stack([-along, along - length], axis=-1)
    ends = np.where(missed[..., None] & (beyond > 0), np.maximum(beyond - NO_WALL, 0), np.inf)
    return np.minimum(ends.min(axis=0, initial=np.inf), walls.may_go_on)


def sight(
    position: np.ndarray,
    heading: np.ndarray,
    half: np.ndarray,
    max_range: float,
    walls: KnownWalls,
    beyond: Float[np.ndarray, "walls 2"],
) -> Float[np.ndarray, "looks rays"]:
    """How far each look sees between rays across its cone, metres: to a wall, or to the maximum range.

    The rays are a cell apart at the far end, and between two of them the nearer wall counts. No rays without walls.

    Args:
        position: (looks, 2) metres.
        heading: (looks,) radians.
        half: (looks,) half of each cone, radians.
        max_range: metres.
        walls: the walls around.
        beyond: how far they go on beyond their starts and ends, metres.
    """
    if not len(walls.segments):
        return np.zeros((len(position), 0))
    rays = int(np.ceil(2 * half.max(initial=0) * max_range / walls.resolution)) + 1
    turn = heading[:, None] + half[:, None] * np.linspace(-1, 1, rays + 1)
    ends = position[:, None] + max_range * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    starts = np.broadcast_to(position[:, None], ends.shape)
    share, other = crossings(np.stack([starts, ends], axis=-2).reshape(-1, 2, 2), walls.segments)
    before, after = (beyond / np.linalg.norm(walls.segments[:, 1] - walls.segments[:, 0], axis=-1)[:, None]).T
    hit = (share >= 0) & (other >= -before - 1e-9) & (other <= 1 + after + 1e-9)
    reach = np.where(hit, share, np.inf).min(axis=1).reshape(turn.shape) * max_range
    return np.minimum(reach[:, 1:], reach[:, :-1])


def _feet(position: np.ndarray, walls: KnownWalls) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Foot of the perpendicular from each look to the line of each wall, metres along it, and the wall's length."""
    start, way = walls.segments[:, 0], walls.segments[:, 1] - walls.segments[:, 0]
    length = np.linalg.norm(way, axis=-1)
    tangent = way / length[:, None]
    along = ((position[:, None] - start) * tangent).sum(-1)
    return start + along[..., None] * tangent, along, length


def _seen(position: np.ndarray, heading: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (metres) and angle off the axis (radians, without sign) at which each look has its points."""
    to = point - position[:, None]
    off_axis = np.abs(wrap_angle(np.arctan2(to[..., 1], to[..., 0]) - heading[:, None]))
    return np.linalg.norm(to, axis=-1), off_axis
