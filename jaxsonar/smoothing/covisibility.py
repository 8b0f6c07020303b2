"""Which scans may hear the same reflector: those that are known to each other better than reflectors are apart.

A robot that comes by again, and whose closure does not count, may be decimetres from where it believes to be. What it
hears there need not come from the wall that is nearest; tied to a wrong one, all poses become sure of what is wrong. So
a wall that is heard again is another wall, until it is known that it is the same.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from jaxsonar.geometry.se2 import unit
from jaxsonar.mapping.global_map import GlobalMap

NEAR = 0.04
"""Metres; standard deviation of where a reflector is heard, up to which it is told from its neighbors."""
_CARRIED = 0.5  # m; stretches that follow one another are one way, but where the robot was carried


@dataclass(frozen=True, eq=False)
class Passages:
    """Stretches of a path, and how well they are known as seen from each other."""

    part: Int[np.ndarray, " scans"]
    """Which stretch each scan is of; they follow one another."""
    poses: Float[np.ndarray, "parts 3"]
    """world_from_part: where each begins."""
    covariance: Float[np.ndarray, "parts parts 3 3"]
    """Of the second one's pose in the frame of the first one, of errors added to it: metres and radians."""

    def parted(self, world: GlobalMap, rows: dict[int, int]) -> GlobalMap:
        """The map with a reflector for every group of stretches that are known to each other.

        Args:
            world: the map.
            rows: of the scans by their numbers.
        """
        walls, points = [], []
        for number, seen in enumerate((*world.scans, *world.point_scans)):
            wall = number < len(world)
            row = number if wall else number - len(world)
            parts = self._parts(seen, rows)
            tied = self._known(world, number, parts)[parts]
            group = connected_components(csr_array(tied | tied.T), directed=False)[1] if len(parts) else np.zeros(0)
            of_scan = np.array([self.part[rows[scan]] for scan in seen], dtype=np.int64)
            for k in range(int(group.max(initial=0)) + 1):
                own = np.isin(of_scan, parts[group == k])
                (walls if wall else points).append((row, tuple(np.asarray(seen)[own].tolist())))
        return taken(world, walls, points)

    def heard_by(self, world: GlobalMap, rows: dict[int, int]) -> Bool[np.ndarray, "parts reflectors"]:
        """Which stretches may hear each wall and point of such a map."""
        seen = (*world.scans, *world.point_scans)
        out = np.ones((len(self.poses), len(seen)), dtype=bool)
        for number, scans in enumerate(seen):
            parts = self._parts(scans, rows)
            if len(parts):
                out[:, number] = self._known(world, number, parts).any(axis=1)
        return out

    @cached_property
    def _from_world(self) -> Float[np.ndarray, "parts 2 2"]:
        """Turns directions in the world into those that each stretch has."""
        c, s = np.cos(self.poses[:, 2]), np.sin(self.poses[:, 2])
        return np.stack([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=-2)

    def _parts(self, scans: tuple[int, ...], rows: dict[int, int]) -> Int[np.ndarray, " some"]:
        return np.unique(self.part[[rows[scan] for scan in scans]]) if scans else np.zeros(0, dtype=np.int64)

    def _known(self, world: GlobalMap, number: int, seen: Int[np.ndarray, " some"]) -> Bool[np.ndarray, "parts some"]:
        """Whether a reflector that some stretches saw is heard from every stretch where it is expected.

        Along a wall nothing need be known.
        """
        from_world = self._from_world
        if number < len(world):
            first, last = world.segments[number]
            share = ((self.poses[:, :2] - first) @ (last - first)) / max(float(((last - first) ** 2).sum()), 1e-12)
            place = first + np.clip(share, 0, 1)[:, None] * (last - first)
            axes = unit(np.array([world.theta[number]]))
        else:
            place, axes = world.points[[number - len(world)] * len(self.poses)], np.eye(2)
        lever = np.einsum("pij,pqj->pqi", from_world, place[:, None] - self.poses[seen, :2])
        variance = np.zeros((len(self.poses), len(seen)))
        for axis in axes:
            n = np.broadcast_to((from_world @ axis)[:, None], lever.shape)
            turn = n[..., 1] * lever[..., 0] - n[..., 0] * lever[..., 1]
            slope = np.concatenate([n, turn[..., None]], axis=-1)
            variance += np.einsum("pqi,pqij,pqj->pq", slope, self.covariance[:, seen], slope)
        after = np.abs(np.arange(len(self.poses))[:, None] - seen) <= 1
        return variance < np.where(after, _CARRIED, NEAR) ** 2


def taken(
    world: GlobalMap, walls: list[tuple[int, tuple[int, ...]]], points: list[tuple[int, tuple[int, ...]]]
) -> GlobalMap:
    """A map of these rows of another one, seen by these scans."""
    wall, point = (np.array([row for row, _ in chosen], dtype=np.int64) for chosen in (walls, points))
    chosen = {}
    for field in fields(world):
        value, of_points = getattr(world, field.name), field.name.startswith("point")
        if isinstance(value, np.ndarray):
            chosen[field.name] = value[point if of_points else wall]
    return replace(
        world,
        **chosen,
        scans=tuple(seen for _, seen in walls),
        point_kinds=tuple(world.point_kinds[row] for row in point),
        point_scans=tuple(seen for _, seen in points),
    )
