"""Tables of a ring's echo arcs that every scan shares; computed once per ring and settings."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.sensors.ring import Ring


class NormalSums(NamedTuple):
    """Cumulative sums over the arc points of every path; the sum over a run of points is a difference of two."""

    x: Float[np.ndarray, "paths points_and_one"]
    """Sums of the x components of the normals of the first k points, k from 0."""
    y: Float[np.ndarray, "paths points_and_one"]
    """Sums of the y components."""


@dataclass(frozen=True, eq=False)
class ArcTables:
    """Echo arcs of all paths of a ring for one set of accumulator settings."""

    arcs: kernels.RingArcs
    """Equidistant arc points and the occupancy threshold, on the device."""
    pieces: Int[np.ndarray, " paths"]
    """Number of pieces of ``kernels.PIECE_POINTS`` points into which the arc of each path is cut."""

    @cached_property
    def normal_sums(self) -> NormalSums:
        """Cumulative sums of the normals, in double precision on the host."""
        theta = np.asarray(self.arcs.arcs.theta, np.float64)
        normals = np.stack([np.cos(theta), np.sin(theta)])
        return NormalSums(*np.cumsum(np.pad(normals, ((0, 0), (0, 0), (1, 0))), axis=-1))


def arc_tables(ring: Ring, settings: kernels.HoughSettings) -> ArcTables:
    """Tables of a ring, stored in ``Ring.cache``."""
    key = ("arc_tables", settings)
    if key not in ring.cache:
        points = kernels.points_of_widest_arc(np.asarray(ring.beam), settings)
        arcs = kernels.ring_arcs(
            ring.sensors, settings=settings, points=points, simultaneous=simultaneous_transmitters(ring)
        )
        pieces = -(-np.asarray(arcs.arcs.exists).sum(axis=1) // kernels.PIECE_POINTS)
        ring.cache[key] = ArcTables(arcs, pieces)
    return ring.cache[key]


def simultaneous_transmitters(ring: Ring, *, most: int = 2) -> Int[np.ndarray, "paths transmitters"] | None:
    """Other sensors of the firing group of each path's transmitter, those nearest to its receiver first.

    Args:
        ring: the sensors.
        most: number of them; -1 where a group has fewer.

    Returns:
        None if every sensor fires alone, or if the ring has direct paths only: their neighbors would fire at the same
        time, and crosstalk would resemble the echoes themselves.
    """
    if not ring.neighbors:
        return None
    group, (tx, rx) = ring.firing_group_of_sensor, ring.paths.T
    together = group[tx][:, None] == group
    together[np.arange(len(tx)), tx] = False
    most = min(most, int(together.sum(axis=1).max(initial=0)))
    if not most:
        return None
    position = np.asarray(ring.position)
    distance = np.linalg.norm(position[rx][:, None] - position, axis=-1)
    nearest = np.argsort(np.where(together, distance, np.inf), axis=1, kind="stable")[:, :most]
    return np.where(np.take_along_axis(together, nearest, axis=1), nearest, -1).astype(np.int32)
