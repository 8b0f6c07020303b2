"""The estimate that an adjustment starts from, and its result."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.estimation.landmark_map import LandmarkMap
from jaxsonar.estimation.sparse_adjustment import AdjustmentSolution


class AdjustmentState(NamedTuple):
    """Current estimate; NumPy arrays in double precision."""

    coordinates: Float[np.ndarray, " coordinates"]
    """Of the ring parameters in their basis."""
    poses: Float[np.ndarray, "scans 3"]
    """world_from_robot."""
    landmark_map: LandmarkMap
    """The landmarks with their current parameters."""

    def unknowns(self) -> kernels.Unknowns:
        """The estimate as the arguments of the residuals."""
        landmarks = self.landmark_map.landmarks.parameters
        return kernels.Unknowns(jnp.asarray(self.coordinates), jnp.asarray(self.poses), jnp.asarray(landmarks))

    def with_unknowns(self, unknowns: kernels.Unknowns) -> "AdjustmentState":
        """The state with other values of the unknowns."""
        landmarks = self.landmark_map.landmarks.with_parameters(np.asarray(unknowns.landmarks))
        landmark_map = self.landmark_map._replace(landmarks=landmarks)
        return AdjustmentState(np.asarray(unknowns.coordinates), np.asarray(unknowns.poses), landmark_map)


class AdjustmentResult(NamedTuple):
    """Result of the robust adjustment."""

    state: AdjustmentState
    problem: kernels.LeastSquaresProblem
    """The last least-squares problem."""
    solution: AdjustmentSolution
    """Its solution."""
    used: Bool[np.ndarray, "scans echoes"]
    """Inliers: echoes that one landmark explains, and no other one nearly so."""
    candidate: Int[np.ndarray, "scans echoes"]
    """Row of the reflection in ``landmark_map.candidates`` that each echo is assigned to."""
    residual: Float[np.ndarray, "scans echoes"]
    """Reported minus predicted range of the inliers, metres; 0 elsewhere."""
    sigma: float
    """Standard deviation of the range noise, metres."""
    sigma_dof: float = 0.0
    """Degrees of freedom from which ``sigma`` was estimated; 0 if it was given, or could not be estimated."""
