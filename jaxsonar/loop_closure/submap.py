"""Submaps: the landmarks and robot poses of the last few metres, in a frame of their own (Tardos et al. 2002).

A submap begins at the robot, so that its errors are those of a few metres; the pose graph contains the poses of the
submaps.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.registration.features import Features, landmark_features


@dataclass(frozen=True, eq=False)
class Submap:
    """A finished submap; its frame is the robot's pose at its first scan."""

    landmarks: kernels.Landmarks
    """Walls, corners and edges, NumPy arrays without unused rows. The normal of a wall points away from the robot."""
    scan_counts: Int[np.ndarray, " landmarks"]
    """Number of scans that observed each landmark."""
    exit_pose: Float[np.ndarray, "3"]
    """Pose of the next submap in this one, which is the robot's last pose; metres and radians."""
    covariance: Float[np.ndarray, "unknowns unknowns"]
    """Joint covariance of ``exit_pose`` (3) and the parameters of the landmarks (2 each, in their order)."""
    rows: Int[np.ndarray, " poses"]
    """Rows of its scans in the log, in order."""
    poses: Float[np.ndarray, "poses 3"]
    """submap_from_robot of these scans."""
    pose_covariances: Float[np.ndarray, "poses 3 3"]
    """Their covariances."""
    directions: Bool[np.ndarray, "poses directions"] | None = None
    """Directions that each of them measured (``measured_directions``), in the robot frame; None: all."""

    def __len__(self) -> int:
        return len(self.landmarks.kind)

    @property
    def walls(self) -> Int[np.ndarray, " walls"]:
        """Rows of the walls."""
        return np.flatnonzero(self.landmarks.kind == kernels.PLANE)

    @property
    def landmark_covariances(self) -> Float[np.ndarray, "landmarks 2 2"]:
        """Marginal covariance of the parameters of each landmark."""
        count, row = len(self), np.arange(len(self))
        return self.covariance[3:, 3:].reshape(count, 2, count, 2)[row, :, row]

    def joint_covariance(self, rows: Int[np.ndarray, " rows"]) -> Float[np.ndarray, "unknowns unknowns"]:
        """Joint covariance of the parameters of some landmarks."""
        unknown = (3 + 2 * rows[:, None] + np.arange(2)).ravel()
        return self.covariance[np.ix_(unknown, unknown)]

    @property
    def features(self) -> Features:
        """Walls and points with their marginal covariances."""
        return landmark_features(self.landmarks, self.landmark_covariances, self.scan_counts)
