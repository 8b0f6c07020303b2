"""Submaps: the reflectors and robot poses of the last few metres, in a frame of their own (Tardos et al. 2002).

A submap begins at the robot, so that its errors are those of a few metres; the pose graph contains the poses of the
submaps.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.geometry.se2 import tangent_of, unit
from jaxsonar.registration.features import Features


@dataclass(frozen=True, eq=False)
class Submap:
    """A finished submap; its frame is the robot's pose at its first scan."""

    kind: Int[np.ndarray, " reflectors"]
    """``kernels.PLANE``, ``CORNER`` or ``EDGE``."""
    parameters: Float[np.ndarray, "reflectors 2"]
    """Planes: (distance from the anchor to the wall along the normal, theta); points: position minus anchor, as in
    ``kernels.Landmarks``. The normal of a wall points away from the robot."""
    anchor: Float[np.ndarray, "reflectors 2"]
    """A fixed point near each reflector, metres."""
    ends: Float[np.ndarray, "reflectors 2"]
    """Planes: observed interval along the tangent, metres from the anchor; points: 0."""
    scans: Int[np.ndarray, " reflectors"]
    """Number of scans that observed each reflector."""
    exit: Float[np.ndarray, "3"]
    """Pose of the next submap in this one, which is the robot's last pose; metres and radians."""
    covariance: Float[np.ndarray, "unknowns unknowns"]
    """Joint covariance of ``exit`` (3) and ``parameters`` (2 each, in their order)."""
    rows: Int[np.ndarray, " poses"]
    """Rows of its scans in the log, in order."""
    poses: Float[np.ndarray, "poses 3"]
    """submap_from_robot of these scans."""
    pose_cov: Float[np.ndarray, "poses 3 3"]
    """Their covariances."""

    def __len__(self) -> int:
        return len(self.kind)

    @property
    def walls(self) -> Int[np.ndarray, " walls"]:
        """Rows of the walls."""
        return np.flatnonzero(self.kind == kernels.PLANE)

    @property
    def segments(self) -> Float[np.ndarray, "walls 2 2"]:
        """End points of the observed part of every wall, metres."""
        row = self.walls
        theta = self.parameters[row, 1]
        normal, along = unit(theta), tangent_of(theta)
        foot = self.anchor[row] + self.parameters[row, :1] * normal
        return foot[:, None] + self.ends[row][..., None] * along[:, None]

    @property
    def points(self) -> Float[np.ndarray, "points 2"]:
        """Positions of corners and edges, metres."""
        row = np.flatnonzero(self.kind != kernels.PLANE)
        return self.anchor[row] + self.parameters[row]

    @property
    def reflector_covariances(self) -> Float[np.ndarray, "reflectors 2 2"]:
        """Marginal covariance of the parameters of each reflector."""
        count, row = len(self), np.arange(len(self))
        return self.covariance[3:, 3:].reshape(count, 2, count, 2)[row, :, row]

    def joint_covariance(self, rows: Int[np.ndarray, " rows"]) -> Float[np.ndarray, "unknowns unknowns"]:
        """Joint covariance of the parameters of some reflectors."""
        unknown = (3 + 2 * rows[:, None] + np.arange(2)).ravel()
        return self.covariance[np.ix_(unknown, unknown)]

    @property
    def features(self) -> Features:
        """Walls and points with their marginal covariances."""
        row, point = self.walls, np.flatnonzero(self.kind != kernels.PLANE)
        covariance = self.reflector_covariances
        return Features(
            reference=self.anchor[row],
            theta=self.parameters[row, 1],
            offset=self.parameters[row, 0],
            covariance=covariance[row],
            extent=self.ends[row],
            weight=np.ones(len(row)),
            scans=self.scans[row].astype(np.float64),
            point=self.points,
            is_corner=self.kind[point] == kernels.CORNER,
            point_sd=np.sqrt(np.trace(covariance[point], axis1=1, axis2=2) / 2),
        )
