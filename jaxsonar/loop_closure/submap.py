"""Submaps: what a robot knows of the last few metres of its path, in a frame of its own (Tardos et al. 2002).

A submap begins where the robot stands, so that its errors are those of a few metres; the graph of ``posegraph`` says
where the submaps lie.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.geometry.se2 import unit
from jaxsonar.registration.feature_map import tangent_of


@dataclass(frozen=True, eq=False)
class Submap:
    """A finished submap; its frame is the robot's pose at its first scan."""

    kind: Int[np.ndarray, " reflectors"]
    """``kernels.PLANE``, ``CORNER`` or ``EDGE``."""
    parameters: Float[np.ndarray, "reflectors 2"]
    """Planes: (distance of the anchor from the wall along the normal, theta); points: place minus anchor, as
    ``kernels.Scene``. The normal of a wall leads away from the robot."""
    anchor: Float[np.ndarray, "reflectors 2"]
    """A fixed place near each, metres."""
    ends: Float[np.ndarray, "reflectors 2"]
    """Planes: where they begin and end along their tangent, metres from the anchor; points: 0."""
    scans: Int[np.ndarray, " reflectors"]
    """Number of scans that saw each."""
    exit: Float[np.ndarray, "3"]
    """Frame of the next submap in this one: the robot's last pose, metres and radians."""
    covariance: Float[np.ndarray, "unknowns unknowns"]
    """Joint covariance of ``exit`` (3) and of ``parameters`` (2 each, in their order)."""
    rows: Int[np.ndarray, " poses"]
    """Rows (of the run) of the scans taken in it, in order."""
    poses: Float[np.ndarray, "poses 3"]
    """submap_from_robot of these scans."""
    pose_cov: Float[np.ndarray, "poses 3 3"]
    """Their covariance, with respect to the frame of the submap."""

    def __len__(self) -> int:
        return len(self.kind)

    @property
    def walls(self) -> Int[np.ndarray, " walls"]:
        """Rows that are walls."""
        return np.flatnonzero(self.kind == kernels.PLANE)

    @property
    def segments(self) -> Float[np.ndarray, "walls 2 2"]:
        """Both ends of every wall, metres."""
        row = self.walls
        theta = self.parameters[row, 1]
        normal, along = unit(theta), tangent_of(theta)
        middle = self.anchor[row] + self.parameters[row, :1] * normal
        return middle[:, None] + self.ends[row][..., None] * along[:, None]

    @property
    def points(self) -> Float[np.ndarray, "points 2"]:
        """Places of the corners and edges, metres."""
        row = np.flatnonzero(self.kind != kernels.PLANE)
        return self.anchor[row] + self.parameters[row]
