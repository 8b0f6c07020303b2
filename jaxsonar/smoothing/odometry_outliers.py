"""Where a path is broken: steps between scans that say something else than the odometry does, farther than it slips.

In a corridor a handful of echoes of corners and edges hold a scan along the walls. Two of them a few centimetres apart,
as a door has them, are soon taken for one: the path bends until they are, and all scans are sure of it. So where a step
is broken, what is heard beyond it is another point; that costs no more than one step of odometry.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import norm

from jaxsonar.geometry.se2 import relative, wrap_angle
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.smoothing.covisibility import taken

RARE = 0.3
"""Mean number of steps of a run that are taken for broken by chance."""
_TOGETHER = 2  # a scan that is out of line breaks the steps on both sides of it, each by less
_BESIDE = 40  # scans; farther on the robot comes by again: what is the same then is not for odometry to say


def broken_steps(
    poses: Float[np.ndarray, "scans 3"], odometry: Float[np.ndarray, "steps 3"], linked: Float[np.ndarray, "steps 3"]
) -> Int[np.ndarray, " some"]:
    """Steps, by themselves or two together, whose odometry slips farther than chance would have it.

    Args:
        poses: world_from_robot.
        odometry: each next pose in the frame of the one before, as measured.
        linked: inverse variances of it; 0 where there is none.
    """
    known = linked.min(axis=-1, initial=np.inf) > 0
    slip = relative(poses[:-1], poses[1:]) - odometry
    slip[:, 2] = wrap_angle(slip[:, 2])
    variance = np.divide(1.0, linked, out=np.ones_like(linked), where=linked > 0)
    bound = norm.isf(RARE / max(2 * _TOGETHER * slip.size, 1))
    broken = np.zeros(len(slip), dtype=bool)
    for count in range(1, _TOGETHER + 1):
        first = np.arange(len(slip) - count + 1)
        window = first[:, None] + np.arange(count)
        # Over two steps robots turn little: their slips are added as if they did not.
        sigmas = np.abs(slip[window].sum(axis=1)) / np.sqrt(variance[window].sum(axis=1))
        far = (sigmas.max(axis=-1) > bound) & known[window].all(axis=-1)
        broken[window[far]] = True
    return np.flatnonzero(broken)


@dataclass(frozen=True, eq=False)
class Breaks:
    """Broken steps of a path, and what follows for its map."""

    steps: Int[np.ndarray, " some"]
    """Rows of the scans from which the step to the next one is broken, ascending."""
    rows: dict[int, int]
    """Of the scans by their numbers."""

    def parted(self, world: GlobalMap) -> GlobalMap:
        """The map with a point on either side of a broken step, where there was one for both."""
        points = []
        for number, seen in enumerate(world.point_scans):
            row = np.array([self.rows[scan] for scan in seen], dtype=np.int64)
            order = np.argsort(row, kind="stable")
            part = np.zeros(len(row), dtype=np.int64)
            part[order[1:]] = np.cumsum(self._between(row[order[:-1]], row[order[1:]]))
            for k in range(int(part.max(initial=0)) + 1):
                points.append((number, tuple(np.asarray(seen)[part == k].tolist())))
        return taken(world, list(enumerate(world.scans)), points)

    def heard_by(self, world: GlobalMap, scans: int) -> Bool[np.ndarray, "scans reflectors"]:
        """Which scans may hear each wall and point of such a map: no point of the other side."""
        out = np.ones((scans, len(world) + len(world.point_scans)), dtype=bool)
        every = np.arange(scans)
        for number, seen in enumerate(world.point_scans):
            row = np.sort([self.rows[scan] for scan in seen])
            if len(row):
                after = np.clip(np.searchsorted(row, every), 1, max(len(row) - 1, 1))
                beside = row[np.stack([after - 1, np.minimum(after, len(row) - 1)])]
                nearest = np.take_along_axis(beside, np.abs(beside - every).argmin(axis=0)[None], axis=0)[0]
                out[:, len(world) + number] = ~self._between(np.minimum(every, nearest), np.maximum(every, nearest))
        return out

    def _between(self, first: Int[np.ndarray, " pairs"], last: Int[np.ndarray, " pairs"]) -> Bool[np.ndarray, " pairs"]:
        """Whether a broken step leads from one scan to another one that is not far on."""
        crossed = np.searchsorted(self.steps, last) > np.searchsorted(self.steps, first)
        return crossed & (last - first <= _BESIDE)
