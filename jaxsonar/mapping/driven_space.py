"""Where the robot itself drove. A wall cannot stand there."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.sensors.ring import Ring

_CELL = SETTINGS.evidence.position_cell


@dataclass(frozen=True, eq=False)
class DrivenSpace:
    """Cells in which the middle of the robot was, and when it was there last. The size grows with the floor."""

    cells: Int[np.ndarray, "cells 2"]
    """Cells of ``EvidenceSettings.position_cell``, without repetition, in ascending order."""
    time: Float[np.ndarray, " cells"]
    """Time as in ``WallSegments.last_seen``."""

    @classmethod
    def empty(cls) -> "DrivenSpace":
        """No cell."""
        return cls(np.zeros((0, 2), np.int64), np.zeros(0))

    @classmethod
    def of(cls, ring: Ring, pose: Float[np.ndarray, "scans 3"], time: Float[np.ndarray, " scans"]) -> "DrivenSpace":
        """The cells near the robot's center, which no wall can have reached.

        Args:
            ring: the sensors; the robot is at least as wide as they are.
            pose: world_from_robot of the scans, metres and radians; NaN if unknown.
            time: of the scans.
        """
        known = np.isfinite(pose).all(axis=1)
        half_width = SETTINGS.evidence.inner_share * float(np.hypot(*np.asarray(ring.position).T).min())
        steps = int(min(half_width, SETTINGS.evidence.max_half_width) / _CELL)
        offset = np.stack(np.meshgrid(*2 * [np.arange(-steps, steps + 1)]), axis=-1).reshape(-1, 2)
        offset = offset[np.hypot(*offset.T) <= steps]
        cells = np.floor(pose[known, None, :2] / _CELL).astype(np.int64) + offset
        return cls._latest(cells.reshape(-1, 2), np.repeat(time[known], len(offset)))

    def union(self, other: "DrivenSpace") -> "DrivenSpace":
        """The cells of both."""
        return self._latest(np.concatenate([self.cells, other.cells]), np.append(self.time, other.time))

    def latest(self, points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, " points"]:
        """When the robot was last in the cell of each point; -inf if it never was."""
        cells = np.floor(points / _CELL).astype(np.int64)
        both, number = np.unique(np.concatenate([self.cells, cells]), axis=0, return_inverse=True)
        time = np.full(len(both), -np.inf)
        number = number.ravel()
        time[number[: len(self.cells)]] = self.time
        return time[number[len(self.cells) :]]

    @classmethod
    def _latest(cls, cells: Int[np.ndarray, "rows 2"], time: Float[np.ndarray, " rows"]) -> "DrivenSpace":
        distinct, number = np.unique(cells, axis=0, return_inverse=True)
        last = np.full(len(distinct), -np.inf)
        np.maximum.at(last, number.ravel(), time)
        return cls(distinct, last)
