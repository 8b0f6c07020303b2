"""Odometry outliers: steps between scans whose estimate contradicts the odometry, and points split at them.

In a corridor, a few echoes of corners and edges determine a scan's position along the walls. Two points some
centimetres apart, such as the jambs of a door, may be merged into one: the trajectory bends until they coincide, and
all scans are certain of it. So beyond an outlier a point is a new one; this costs no more than one step of odometry.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import norm

from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.smoothing.covisibility import select_landmarks
from jaxsonar.smoothing.settings import SETTINGS


def find_odometry_outliers(
    residual: Float[np.ndarray, "steps 3"], information: Float[np.ndarray, "steps 3"]
) -> Int[np.ndarray, " outliers"]:
    """Steps whose odometry residual, alone or summed over consecutive steps, is too large for chance.

    Args:
        residual: odometry residuals, metres and radians, in the frame where each step begins.
        information: inverse variances of the odometry; 0 where there is none.
    """
    measured = information.min(axis=-1, initial=np.inf) > 0
    variance = np.divide(1.0, information, out=np.ones_like(information), where=information > 0)
    most = SETTINGS.outlier_steps
    bound = norm.isf(SETTINGS.expected_false_outliers / max(2 * most * residual.size, 1))
    is_outlier = np.zeros(len(residual), dtype=bool)
    for count in range(1, most + 1):
        first = np.arange(len(residual) - count + 1)
        window = first[:, None] + np.arange(count)
        # The rotation within two steps is small: their residuals are added as if both had one frame.
        normalized = np.abs(residual[window].sum(axis=1)) / np.sqrt(variance[window].sum(axis=1))
        is_large = (normalized.max(axis=-1) > bound) & measured[window].all(axis=-1)
        is_outlier[window[is_large]] = True
    return np.flatnonzero(is_outlier)


@dataclass(frozen=True, eq=False)
class OdometryOutliers:
    """Odometry outliers of a trajectory, and the points that they split."""

    steps: Int[np.ndarray, " outliers"]
    """Rows of the scans at which the steps begin, ascending."""
    rows: dict[int, int]
    """Row of each scan number in the log."""

    def split_landmarks(self, world: GlobalMap) -> GlobalMap:
        """Split every point of a map that is observed on both sides of an outlier."""
        points = []
        for number, scans in enumerate(world.point_scans):
            row = np.array([self.rows[scan] for scan in scans], dtype=np.int64)
            order = np.argsort(row, kind="stable")
            part = np.zeros(len(row), dtype=np.int64)
            part[order[1:]] = np.cumsum(self._separates(row[order[:-1]], row[order[1:]]))
            for k in range(int(part.max(initial=0)) + 1):
                points.append((number, tuple(np.asarray(scans)[part == k].tolist())))
        return select_landmarks(world, list(enumerate(world.scans)), points)

    def visibility_mask(self, world: GlobalMap, scan_count: int) -> Bool[np.ndarray, "scans landmarks"]:
        """Which scans may observe each wall and point of a map that ``split_landmarks`` returned."""
        mask = np.ones((scan_count, len(world) + len(world.point_scans)), dtype=bool)
        every = np.arange(scan_count)
        for number, scans in enumerate(world.point_scans):
            row = np.sort([self.rows[scan] for scan in scans])
            if len(row):
                after = np.clip(np.searchsorted(row, every), 1, max(len(row) - 1, 1))
                adjacent = row[np.stack([after - 1, np.minimum(after, len(row) - 1)])]
                nearest = np.take_along_axis(adjacent, np.abs(adjacent - every).argmin(axis=0)[None], axis=0)[0]
                first, last = np.minimum(every, nearest), np.maximum(every, nearest)
                mask[:, len(world) + number] = ~self._separates(first, last)
        return mask

    def _separates(
        self, first: Int[np.ndarray, " pairs"], last: Int[np.ndarray, " pairs"]
    ) -> Bool[np.ndarray, " pairs"]:
        """Whether an outlier lies between two scans that are not far apart."""
        crossed = np.searchsorted(self.steps, last) > np.searchsorted(self.steps, first)
        return crossed & (last - first <= SETTINGS.max_split_distance)
