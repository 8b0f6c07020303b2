"""Covisibility: which segments of a trajectory observe the same landmark.

A robot that returns to a place without an accepted loop closure may be decimetres from its estimated position. What it
observes there need not be the nearest landmark, and a wrong association makes all poses certain of a wrong result. So a
landmark that is observed again is a new one, unless the relative poses are known well enough.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from jaxsonar.geometry.se2 import rotate, unit
from jaxsonar.geometry.segments import cross
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.smoothing.settings import SETTINGS


@dataclass(frozen=True, eq=False)
class Traversals:
    """Consecutive segments of a trajectory, and how well they are known relative to each other."""

    segment_id: Int[np.ndarray, " scans"]
    """Segment of each scan, ascending."""
    poses: Float[np.ndarray, "segments 3"]
    """world_from_segment: pose at which each begins."""
    covariance: Float[np.ndarray, "segments segments 3 3"]
    """Covariance of first_from_second for every pair of segments, metres and radians."""

    def split_landmarks(self, world: GlobalMap, rows: dict[int, int]) -> GlobalMap:
        """Split every landmark of a map into one for each group of mutually well known segments.

        Args:
            world: the map.
            rows: row of each scan number in the log.
        """
        walls, points = [], []
        for number, scans in enumerate((*world.scans, *world.point_scans)):
            is_wall = number < len(world)
            row = number if is_wall else number - len(world)
            segments = self._segments_of(scans, rows)
            covisible = self._covisible(world, number, segments)[segments]
            graph = csr_array(covisible | covisible.T)
            group = connected_components(graph, directed=False)[1] if len(segments) else np.zeros(0)
            segment_of_scan = np.array([self.segment_id[rows[scan]] for scan in scans], dtype=np.int64)
            for k in range(int(group.max(initial=0)) + 1):
                in_group = np.isin(segment_of_scan, segments[group == k])
                (walls if is_wall else points).append((row, tuple(np.asarray(scans)[in_group].tolist())))
        return select_landmarks(world, walls, points)

    def visibility_mask(self, world: GlobalMap, rows: dict[int, int]) -> Bool[np.ndarray, "segments landmarks"]:
        """Which segments may observe each wall and point of a map that ``split_landmarks`` returned."""
        all_scans = (*world.scans, *world.point_scans)
        mask = np.ones((len(self.poses), len(all_scans)), dtype=bool)
        for number, scans in enumerate(all_scans):
            segments = self._segments_of(scans, rows)
            if len(segments):
                mask[:, number] = self._covisible(world, number, segments).any(axis=1)
        return mask

    def _segments_of(self, scans: tuple[int, ...], rows: dict[int, int]) -> Int[np.ndarray, " some"]:
        return np.unique(self.segment_id[[rows[scan] for scan in scans]]) if scans else np.zeros(0, dtype=np.int64)

    def _covisible(
        self, world: GlobalMap, number: int, observers: Int[np.ndarray, " some"]
    ) -> Bool[np.ndarray, "segments some"]:
        """Whether the position of a landmark relative to each segment is certain enough, if the observers detected it.

        The position along a wall may be uncertain.
        """
        heading = -self.poses[:, 2]
        if number < len(world):
            first, last = world.segments[number]
            length_squared = max(float(((last - first) ** 2).sum()), 1e-12)
            fraction = ((self.poses[:, :2] - first) @ (last - first)) / length_squared
            position = first + np.clip(fraction, 0, 1)[:, None] * (last - first)
            axes = unit(np.array([world.theta[number]]))
        else:
            position, axes = world.points[[number - len(world)] * len(self.poses)], np.eye(2)
        arm = rotate(position[:, None] - self.poses[observers, :2], heading[:, None])
        variance = np.zeros((len(self.poses), len(observers)))
        for axis in axes:
            direction = np.broadcast_to(rotate(axis, heading)[:, None], arm.shape)
            jacobian = np.concatenate([direction, cross(arm, direction)[..., None]], axis=-1)
            variance += np.einsum("pqi,pqij,pqj->pq", jacobian, self.covariance[:, observers], jacobian)
        consecutive = np.abs(np.arange(len(self.poses))[:, None] - observers) <= 1
        return variance < np.where(consecutive, SETTINGS.max_consecutive_sd, SETTINGS.max_covisible_sd) ** 2


def select_landmarks(
    world: GlobalMap, walls: list[tuple[int, tuple[int, ...]]], points: list[tuple[int, tuple[int, ...]]]
) -> GlobalMap:
    """A map of selected rows of another one.

    Args:
        world: the other map.
        walls: row of each wall, and the scans that observed it; a row may be selected more than once.
        points: the same of points.
    """
    wall, point = (np.array([row for row, _ in selected], dtype=np.int64) for selected in (walls, points))
    columns = {}
    for field in fields(world):
        value, of_points = getattr(world, field.name), field.name.startswith("point")
        if isinstance(value, np.ndarray):
            columns[field.name] = value[point if of_points else wall]
    return replace(
        world,
        **columns,
        scans=tuple(scans for _, scans in walls),
        end_kinds=tuple(world.end_kinds[row] for row in wall) if world.end_kinds else (),
        point_kinds=tuple(world.point_kinds[row] for row in point),
        point_scans=tuple(scans for _, scans in points),
    )
