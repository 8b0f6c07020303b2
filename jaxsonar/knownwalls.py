"""What known walls explain of the echoes, and what they hide: lines of sight for occupancy grids."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from .poses import wrap_angle
from .rooms import crossings, point_to_walls

EXPLAINED = 0.08
"""Metres; an echo this near to the range at which a known wall, end or corner must answer is the wall's."""
BEYOND_END = 0.3
"""Metres; walls answer beyond the ends that a map knows: those are the outermost feet of perpendiculars (section 5)."""
BEYOND_CONE = np.radians(5.0)
"""Radians; a wall is strong enough to be heard a little outside the cone."""
HIDDEN = 1.0
"""Metres; so far a wall may go on beyond its ends where nobody could hear it, and hides what is behind."""
NO_WALL = 0.2
"""Metres; so far around the foot of a sensor that would have heard a wall, and did not, there is none."""


class KnownWalls(NamedTuple):
    """Known walls, where they meet, and the cells they go through."""

    segments: np.ndarray  # (walls, 2, 2)
    points: np.ndarray  # (points, 2): ends, and corners of walls that go on a little
    cells: np.ndarray  # (cells, 2) column and row in the world, each once
    resolution: float

    @classmethod
    def of(cls, walls: np.ndarray, resolution: float) -> "KnownWalls":
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

    def near(self, place: np.ndarray, reach: float) -> "KnownWalls":
        """Those within reach of a place, metres."""
        walls = (point_to_walls(place[None], self.segments) <= reach)[0]
        points = np.linalg.norm(self.points - place, axis=-1) <= reach + EXPLAINED
        cells = np.linalg.norm((self.cells + 0.5) * self.resolution - place, axis=-1) <= reach
        return KnownWalls(self.segments[walls], self.points[points], self.cells[cells], self.resolution)


def _explained(
    position: np.ndarray, heading: np.ndarray, half: np.ndarray, first: np.ndarray, walls: KnownWalls
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
    position: np.ndarray, heading: np.ndarray, half: np.ndarray, max_range: float, walls: KnownWalls, resolution: float
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


