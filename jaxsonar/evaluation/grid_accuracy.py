"""Accuracy of occupancy grids against true walls."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from jaxsonar.geometry.segments import lengths, sample_segments
from jaxsonar.occupancy.occupancy_grid import OccupancyGrid

TOLERANCE = 0.075
"""Distance up to which an occupied cell belongs to a wall or a pole, metres: one and a half cells."""
HEARD = 0.1
"""A part of a wall was heard if an echo was reflected within this distance, metres."""
_STEP = 0.01


class GridAccuracy(NamedTuple):
    """How a grid compares with true walls."""

    precision: float
    """Share of the occupied cells that are at a wall or a pole."""
    recall: float
    """Share of the cells of walls that were heard, with an occupied cell nearby."""
    free_wall: float
    """Length of the walls in free cells, metres."""
    wall: float
    """Length of all walls, metres."""

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        return 2 * self.precision * self.recall / max(self.precision + self.recall, 1e-9)


def grid_accuracy(
    grid: OccupancyGrid,
    walls: Float[np.ndarray, "walls 2 2"],
    poles: Float[np.ndarray, "poles 2"],
    heard: Float[np.ndarray, "points 2"],
    *,
    occupied: Bool[np.ndarray, "rows columns"] | None = None,
    free: Bool[np.ndarray, "rows columns"] | None = None,
) -> GridAccuracy:
    """Compare a grid with the truth.

    Args:
        grid: the grid.
        walls: true walls, world frame, metres.
        poles: true poles, metres.
        heard: points of walls at which echoes were reflected, metres.
        occupied: other occupied cells than those of the grid, such as those of another threshold.
        free: other free cells.
    """
    occupied = grid.occupied if occupied is None else occupied
    free = grid.free if free is None else free
    samples, _ = sample_segments(walls, (lengths(walls) / _STEP).astype(int) + 2)
    row, column = np.nonzero(occupied)
    center = (np.stack([column, row], axis=-1) + grid.corner + 0.5) * grid.resolution
    near, _ = KDTree(np.concatenate([samples, poles])).query(center)
    reached = samples[KDTree(heard).query(samples)[0] <= HEARD] if len(heard) else samples[:0]
    truth = (np.unique(np.floor(reached / grid.resolution), axis=0) + 0.5) * grid.resolution
    found = KDTree(center).query(truth)[0] <= TOLERANCE if len(center) else np.zeros(len(truth), bool)
    column, row = (np.floor(samples / grid.resolution) - grid.corner).T.astype(int)
    inside = (column >= 0) & (row >= 0) & (column < free.shape[1]) & (row < free.shape[0])
    in_free = free[row[inside], column[inside]].sum() / max(len(samples), 1)
    return GridAccuracy(
        float(np.mean(near <= TOLERANCE)) if len(center) else 0.0,
        float(np.mean(found)) if len(truth) else 0.0,
        float(in_free * lengths(walls).sum()),
        float(lengths(walls).sum()),
    )
