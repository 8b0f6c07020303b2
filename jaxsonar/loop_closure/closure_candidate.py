"""Loop-closure candidates in the pose graph: their residuals, and the chi-square tests on them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from jaxsonar.estimation.joint_compatibility import chi2_bound
from jaxsonar.estimation.pose_graph import BetweenFactor, PoseGraph
from jaxsonar.geometry.se2 import relative, relative_jacobians, subtract_poses
from jaxsonar.loop_closure.closure_detection import ClosureMeasurement
from jaxsonar.loop_closure.settings import SETTINGS

PROPOSED, ACCEPTED, REFUSED, WITHDRAWN = "proposed", "accepted", "refused", "withdrawn"


@dataclass(frozen=True, eq=False)
class ClosureCandidate:
    """A measured closure between two nodes of the pose graph, and its state."""

    earlier: int
    newest: int
    measurement: ClosureMeasurement
    position: Float[np.ndarray, "2"]
    """Center of the common reflectors, in the frame of the earlier node, metres."""
    state: str = PROPOSED

    @property
    def factor(self) -> BetweenFactor:
        """The candidate as a constraint of the pose graph."""
        return BetweenFactor(
            self.earlier, self.newest, self.measurement.earlier_from_newest, self.measurement.information
        )

    @property
    def dof(self) -> int:
        """Number of directions that the measurement determines."""
        return self.measurement.basis.shape[1]


def innovation(
    graph: PoseGraph, candidates: list[ClosureCandidate]
) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows rows"]]:
    """Residuals of candidates that are not in the graph, in their determined directions, and their covariance."""
    joint = graph.joint_covariance(np.array([node for one in candidates for node in (one.earlier, one.newest)]))
    residual, design, noise = [], [], []
    for one in candidates:
        expected = relative(graph.poses[one.earlier], graph.poses[one.newest])
        by_first, by_second = relative_jacobians(graph.poses[one.earlier], expected)
        basis = one.measurement.basis
        residual.append(basis.T @ subtract_poses(expected, one.measurement.earlier_from_newest))
        design.append(basis.T @ np.concatenate([by_first, by_second], axis=1))
        noise.append(basis.T @ np.linalg.pinv(one.measurement.information, hermitian=True) @ basis)
    jacobian = block_diag(*design)
    covariance = SETTINGS.inflation**2 * jacobian @ joint @ jacobian.T + block_diag(*noise)
    return np.concatenate(residual), covariance


def innovation_chi2(graph: PoseGraph, candidate: ClosureCandidate) -> float:
    """Chi-square of a candidate under the covariance of a graph that does not contain it."""
    residual, covariance = innovation(graph, [candidate])
    return float(residual @ np.linalg.solve(covariance, residual))


def candidates_chi2_bound(candidates: list[ClosureCandidate], probability: float) -> float:
    """Chi-square that correct candidates exceed with this probability."""
    return chi2_bound(sum(one.dof for one in candidates), probability)
