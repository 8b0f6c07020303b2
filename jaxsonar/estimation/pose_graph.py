"""Pose graph of planar poses and relative pose measurements: sparse least squares, and covariances on request.

Poses are world_from_node: (x, y, theta) in metres and radians. The first node is fixed. The information matrix of a
factor may be singular: parallel walls do not determine the displacement along them.

The normal equations are factorized by SuperLU. The multifrontal factorization of ``block_cholesky`` would also yield
all marginal covariances, but it runs in Python, and graphs are solved often with few nodes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU, splu

from jaxsonar.estimation.levenberg_marquardt import LevenbergMarquardtSettings, minimize
from jaxsonar.geometry.se2 import relative, relative_covariance, relative_jacobians, subtract_poses, wrap_pose
from jaxsonar.hardware.errors import SonarError

GAUSS_NEWTON = LevenbergMarquardtSettings(
    max_iterations=30,
    initial_damping=0.0,
    min_damping=0.0,
    increase=10.0,
    damping_after_rejection=1e-4,
    relative_tolerance=0.0,
    absolute_tolerance=-np.inf,
    step_tolerance=1e-7,
)
"""Gauss-Newton steps, damped only after a step that increased the cost; converged when a step is below 1e-7 m and rad.
The cost is no test of convergence, because without loops it is 0 at the minimum. Chosen by hand."""


@dataclass(frozen=True)
class PoseGraphSettings:
    """Constants of the pose graph."""

    min_relative_pivot: float = 1e-13
    """Smallest pivot as a fraction of its diagonal element; below, the factors do not determine all poses. Chosen by
    hand, above the rounding errors of double precision."""
    solver: LevenbergMarquardtSettings = GAUSS_NEWTON
    """Damping schedule and convergence tests."""


SETTINGS = PoseGraphSettings()


class BetweenFactor(NamedTuple):
    """A measured pose of one node relative to another."""

    first: int
    """Index of the node whose frame the measurement is in."""
    second: int
    """Index of the node that was measured."""
    first_from_second: Float[np.ndarray, "3"]
    """The measurement, metres and radians."""
    information: Float[np.ndarray, "3 3"]
    """Inverse covariance of the measurement; zero in directions that were not measured."""


class PoseGraph:
    """Poses at the minimum of the cost, and their covariances.

    Args:
        poses: (nodes, 3) world_from_node.
        factors: the measurements between the nodes.
        converged: whether the solver converged.
    """

    def __init__(self, poses: Float[np.ndarray, "nodes 3"], factors: Sequence[BetweenFactor], *, converged: bool):
        self.poses, self.factors, self.converged = poses, tuple(factors), converged
        self._stacked = _StackedFactors.of(factors)

    def __len__(self) -> int:
        return len(self.poses)

    @cached_property
    def chi2(self) -> Float[np.ndarray, " factors"]:
        """Squared Mahalanobis norm of the residual of each factor."""
        residual = self._stacked.residual(self.poses)
        return np.einsum("li,lij,lj->l", residual, self._stacked.information, residual)

    @cached_property
    def _cholesky(self) -> SuperLU:
        problem = _PoseGraphProblem(len(self.poses), self._stacked)
        return problem.factorize(problem.normal_matrix(self.poses))

    def joint_covariance(self, nodes: Int[np.ndarray, " nodes"]) -> Float[np.ndarray, "unknowns unknowns"]:
        """Joint covariance of the given nodes in the world frame, three rows per node; 0 for the first node.

        A node may occur more than once.
        """
        size = 3 * len(self.poses) - 3
        column = (3 * np.asarray(nodes)[:, None] - 3 + np.arange(3)).ravel()
        free = column >= 0
        wanted = np.zeros((size, len(column)))
        wanted[column[free], np.flatnonzero(free)] = 1.0
        # One column at a time: for several columns SuperLU calls a multithreaded BLAS, which is far slower.
        solved = np.stack([self._cholesky.solve(one) for one in wanted.T], axis=-1) if size else wanted
        cov = np.where(free[:, None], solved[np.maximum(column, 0)] if size else 0.0, 0.0)
        return (cov + cov.T) / 2

    def marginal_covariances(self, nodes: Int[np.ndarray, " nodes"]) -> Float[np.ndarray, "nodes 3 3"]:
        """Marginal covariances of the given nodes in the world frame."""
        return _diagonal_blocks(self.joint_covariance(nodes))

    def relative_poses(
        self, first: int, seconds: Int[np.ndarray, " nodes"]
    ) -> tuple[Float[np.ndarray, "nodes 3"], Float[np.ndarray, "nodes 3 3"]]:
        """The poses of the nodes ``seconds`` in the frame of the node ``first``, and their marginal covariances."""
        count = len(seconds)
        seen = relative(self.poses[first], self.poses[seconds])
        joint = self.joint_covariance(np.append(np.asarray([first]), seconds))
        cross = joint[:3, 3:].reshape(3, count, 3).swapaxes(0, 1)
        cov = relative_covariance(self.poses[first], seen, joint[:3, :3], _diagonal_blocks(joint[3:, 3:]), cross)
        return seen, (cov + cov.swapaxes(1, 2)) / 2

    def relative_covariances(self, nodes: Int[np.ndarray, " nodes"]) -> Float[np.ndarray, "nodes nodes 3 3"]:
        """Covariance of the pose of each node relative to each other one, as in ``relative_poses``; [first, second]."""
        count = len(nodes)
        joint = self.joint_covariance(nodes).reshape(count, 3, count, 3).swapaxes(1, 2)
        own = joint[np.arange(count), np.arange(count)]
        out = np.zeros_like(joint)
        for k, node in enumerate(nodes):
            seen = relative(self.poses[node], self.poses[nodes])
            out[k] = relative_covariance(self.poses[node], seen, own[k], own, joint[k])
        return (out + out.swapaxes(2, 3)) / 2


def solve_pose_graph(
    poses: Float[np.ndarray, "nodes 3"], factors: Sequence[BetweenFactor], *, settings: PoseGraphSettings = SETTINGS
) -> PoseGraph:
    """The poses with the smallest sum of squared, weighted residuals.

    Args:
        poses: (nodes, 3) world_from_node, initial values; the first one is fixed.
        factors: measurements between nodes; together they must determine every pose.
        settings: constants of the solver.

    Returns:
        The poses; ``converged`` is False if the iterations did not suffice.

    Raises:
        SonarError: non-finite numbers, a factor of a node that does not exist, poses that no factor determines.
    """
    stacked = _StackedFactors.of(factors)
    _check(poses, stacked)
    if len(poses) < 2:
        return PoseGraph(poses, factors, converged=True)
    problem = _PoseGraphProblem(len(poses), stacked, settings)
    found = minimize(problem, poses, settings.solver)
    return PoseGraph(found.point, factors, converged=found.converged)


class _StackedFactors(NamedTuple):
    """All factors as arrays."""

    first: Int[np.ndarray, " factors"]
    second: Int[np.ndarray, " factors"]
    first_from_second: Float[np.ndarray, "factors 3"]
    information: Float[np.ndarray, "factors 3 3"]

    @classmethod
    def of(cls, factors: Sequence[BetweenFactor]) -> "_StackedFactors":
        return cls(
            np.array([factor.first for factor in factors], dtype=np.int64),
            np.array([factor.second for factor in factors], dtype=np.int64),
            np.array([factor.first_from_second for factor in factors], dtype=np.float64).reshape(-1, 3),
            np.array([factor.information for factor in factors], dtype=np.float64).reshape(-1, 3, 3),
        )

    def residual(self, poses: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "factors 3"]:
        """Predicted minus measured relative poses, metres and radians."""
        return subtract_poses(relative(poses[self.first], poses[self.second]), self.first_from_second)

    def jacobian(self, poses: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "factors 3 6"]:
        """Derivatives of the residuals by the poses of both nodes."""
        world_from_first = poses[self.first]
        first_from_second = relative(world_from_first, poses[self.second])
        return np.concatenate(relative_jacobians(world_from_first, first_from_second), axis=-1)


def _check(poses: Float[np.ndarray, "nodes 3"], factors: _StackedFactors) -> None:
    nodes = np.concatenate([factors.first, factors.second])
    if len(nodes) and (nodes.min() < 0 or nodes.max() >= len(poses)):
        raise SonarError(
            f"pose graph: a factor of node {nodes.max()} or {nodes.min()}; allowed are 0 to {len(poses) - 1}"
        )
    if not all(np.isfinite(values).all() for values in (poses, factors.first_from_second, factors.information)):
        raise SonarError("pose graph: a pose, a relative pose or an information matrix is not finite")


def _diagonal_blocks(joint: Float[np.ndarray, "unknowns unknowns"]) -> Float[np.ndarray, "nodes 3 3"]:
    """The 3 x 3 blocks along the diagonal."""
    count = len(joint) // 3
    return joint.reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count)]


class _NormalMatrix(NamedTuple):
    """Entries of the normal matrix, undamped, in the order of ``_PoseGraphProblem.row`` and ``column``."""

    values: Float[np.ndarray, " entries"]
    diagonal: Float[np.ndarray, " unknowns"]


class _PoseGraphProblem:
    """Cost, normal equations and solver (``LeastSquares``); unknowns are the poses of all nodes but the first.

    The sparsity pattern of the normal matrix is computed once.
    """

    def __init__(self, nodes: int, factors: _StackedFactors, settings: PoseGraphSettings = SETTINGS):
        self.factors, self.size, self.settings = factors, 3 * nodes - 3, settings
        index = 3 * np.stack([factors.first, factors.second], axis=-1)[..., None] - 3 + np.arange(3)
        self.index = index.reshape(-1, 6)
        row, column = (x.ravel() for x in np.broadcast_arrays(self.index[:, :, None], self.index[:, None]))
        self.kept = (row >= 0) & (column >= 0)
        self.row, self.column = row[self.kept], column[self.kept]
        self.free = self.index.ravel() >= 0

    def evaluate(self, poses: Float[np.ndarray, "nodes 3"]) -> tuple[float, Float[np.ndarray, "factors 3"]]:
        """The sum of chi2, and the residuals times the information matrices."""
        residual = self.factors.residual(poses)
        weighted = (self.factors.information @ residual[..., None])[..., 0]
        return float((residual * weighted).sum()), weighted

    def linearize(
        self, poses: Float[np.ndarray, "nodes 3"], weighted: Float[np.ndarray, "factors 3"]
    ) -> tuple[_NormalMatrix, Float[np.ndarray, " unknowns"]]:
        """The normal matrix, and half the gradient of the cost."""
        by_pose = np.einsum("lij,li->lj", self.factors.jacobian(poses), weighted).ravel()[self.free]
        gradient = np.bincount(self.index.ravel()[self.free], weights=by_pose, minlength=self.size)
        return self.normal_matrix(poses), gradient

    def step(
        self,
        poses: Float[np.ndarray, "nodes 3"],
        equations: tuple[_NormalMatrix, Float[np.ndarray, " unknowns"]],
        damping: float,
    ) -> tuple[Float[np.ndarray, "nodes 3"], float]:
        """The poses after a damped step, and its largest component in metres or radians."""
        matrix, gradient = equations
        step = -self.factorize(matrix, damping).solve(gradient).reshape(-1, 3)
        return np.concatenate([poses[:1], wrap_pose(poses[1:] + step)]), float(np.abs(step).max())

    def normal_matrix(self, poses: Float[np.ndarray, "nodes 3"]) -> _NormalMatrix:
        """The normal matrix at these poses."""
        jacobian = self.factors.jacobian(poses)
        values = (jacobian.swapaxes(1, 2) @ self.factors.information @ jacobian).ravel()[self.kept]
        diagonal = np.bincount(self.row, weights=values * (self.row == self.column), minlength=self.size)
        return _NormalMatrix(values, diagonal)

    def factorize(self, matrix: _NormalMatrix, damping: float = 0.0) -> SuperLU:
        """Factorize with the diagonal raised by this fraction of it; a SonarError if the matrix is singular."""
        undetermined = SonarError(
            "pose graph: the factors do not determine all poses; every node needs a chain of factors of full rank"
        )
        diagonal = np.arange(self.size)
        # The diagonal is always stored, so that a node without factors shows as a zero pivot.
        rows, columns = np.append(self.row, diagonal), np.append(self.column, diagonal)
        values = np.append(matrix.values, damping * matrix.diagonal)
        normal = csc_matrix((values, (rows, columns)), shape=(self.size, self.size))
        try:
            factor = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError as error:  # a pivot is exactly zero
            raise undetermined from error
        min_pivot = self.settings.min_relative_pivot * matrix.diagonal[np.argsort(factor.perm_c)]
        if (factor.U.diagonal() <= min_pivot).any():
            raise undetermined
        return factor
