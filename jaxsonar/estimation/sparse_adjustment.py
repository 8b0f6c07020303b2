"""Bundle adjustment of ring parameters, poses and landmarks on the echo ranges, with sparse normal equations.

The unknowns form blocks: a pose, a landmark, and the coordinates of the ring parameters as the last block. An echo
depends on one pose and one or two landmarks, an odometry step on two poses. The blocks are eliminated in a
fill-reducing order (``block_cholesky``), so that time and memory grow linearly with the number of scans.

All functions must be called with 64-bit floats enabled (``jax.enable_x64``).
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.estimation.block_cholesky import SymbolicFactorization
from jaxsonar.estimation.levenberg_marquardt import LevenbergMarquardtSettings, minimize
from jaxsonar.geometry.se2 import subtract_poses
from jaxsonar.kernels.shape_buckets import next_power_of_two, pad_rows

DEFAULT_SOLVER = LevenbergMarquardtSettings()


@dataclass(frozen=True)
class SparseAdjustmentSettings:
    """Constants of the bundle adjustment."""

    min_echo_rows: int = 1024
    """Echoes are padded to a power of two, at least this, so that few shapes are compiled. Chosen by hand."""
    trace_probes: int = 8
    """Random vectors for the trace of a matrix: 2 % of the trace for a thousand echoes. Chosen by hand."""
    solver: LevenbergMarquardtSettings = DEFAULT_SOLVER
    """Damping schedule and convergence tests."""


SETTINGS = SparseAdjustmentSettings()


class AdjustmentSolution(NamedTuple):
    """Unknowns at the minimum of the cost."""

    unknowns: kernels.Unknowns
    cost: float
    """Half the weighted sum of squares, priors included."""
    initial_cost: float
    """The cost at the start."""
    iterations: int
    """Trial steps of the solver, rejected ones included."""


class MarginalCovariances(NamedTuple):
    """Marginal covariances of the unknowns, all others being estimated as well."""

    coordinates: Float[np.ndarray, "coordinates coordinates"]
    """Of the coordinates of the ring parameters, jointly."""
    poses: Float[np.ndarray, "scans 3 3"]
    """Of (x, y, theta) of each pose: metres and radians, world frame."""
    landmarks: Float[np.ndarray, "landmarks 2 2"]
    """Of ``Landmarks.parameters`` of each landmark."""


def solve_adjustment(
    problem: kernels.LeastSquaresProblem,
    start: kernels.Unknowns,
    *,
    poses_free: bool,
    max_iterations: int = 20,
    absolute_tolerance: float = 0.0,
    settings: SparseAdjustmentSettings = SETTINGS,
) -> AdjustmentSolution:
    """Minimize ``kernels.cost`` from a start within the basin of attraction.

    Args:
        problem: echoes, odometry and priors.
        start: initial values of the unknowns.
        poses_free: whether the poses are estimated; otherwise they keep their initial values.
        max_iterations: trial steps at most.
        absolute_tolerance: converged when a step decreases the cost by less than this.
        settings: constants of the solver.
    """
    solver = replace(settings.solver, max_iterations=max_iterations, absolute_tolerance=absolute_tolerance)
    found = minimize(_SparseProblem(problem, poses_free, settings), _Point.of(start), solver)
    return AdjustmentSolution(found.point.unknowns(), found.cost, found.initial_cost, found.iterations)


def marginal_covariances(
    problem: kernels.LeastSquaresProblem,
    unknowns: kernels.Unknowns,
    *,
    poses_free: bool,
    settings: SparseAdjustmentSettings = SETTINGS,
) -> MarginalCovariances:
    """Covariances at the minimum of the cost, by the Gauss-Newton approximation; 0 for poses that are not estimated."""
    sparse, point = _SparseProblem(problem, poses_free, settings), _Point.of(unknowns)
    matrix, _ = sparse.linearize(point, sparse.evaluate(point)[1])
    blocks = sparse.structure.factorize(matrix).marginals()
    poses, count = np.zeros((len(point.poses), 3, 3)), sparse.pose_count
    if poses_free:
        poses[:count] = np.array(blocks[:count]).reshape(-1, 3, 3)
        poses[count:] = np.eye(3) / sparse.prior_information[count:, :, None]
    landmarks = np.array(blocks[count : count + len(point.landmarks)]).reshape(-1, 2, 2)
    return MarginalCovariances(blocks[-1] if len(point.coordinates) else np.zeros((0, 0)), poses, landmarks)


def absorbed_freedom(
    problem: kernels.LeastSquaresProblem,
    unknowns: kernels.Unknowns,
    *,
    poses_free: bool,
    settings: SparseAdjustmentSettings = SETTINGS,
) -> float:
    """Degrees of freedom of the echoes that the unknowns absorb: the trace of the hat matrix of the echoes.

    Without odometry and priors it is the number of unknowns. What odometry and priors determine is not absorbed. The
    trace is estimated with random signs (Hutchinson), always the same ones.
    """
    sparse, point = _SparseProblem(problem, poses_free, settings), _Point.of(unknowns)
    evaluation = sparse.evaluate(point)[1]
    cholesky = sparse.structure.factorize(sparse.linearize(point, evaluation)[0])
    echoes, odometry = evaluation
    odometry = odometry._replace(residual=np.zeros_like(odometry.residual))
    rng, traces = np.random.default_rng(0), []
    for _ in range(settings.trace_probes):
        signs = rng.choice([-1.0, 1.0], echoes.residual.shape)
        probe = echoes._replace(residual=signs / np.sqrt(echoes.weight))
        gradient = sparse.gradient((probe, odometry))
        traces.append(float(gradient @ cholesky.solve(gradient)))
    return float(np.mean(traces))


class _Point(NamedTuple):
    """``kernels.Unknowns`` as NumPy arrays in double precision."""

    coordinates: Float[np.ndarray, " coordinates"]
    poses: Float[np.ndarray, "scans 3"]
    landmarks: Float[np.ndarray, "landmarks 2"]

    @classmethod
    def of(cls, unknowns: kernels.Unknowns) -> "_Point":
        """The same values."""
        leaves = unknowns.coordinates, unknowns.poses, unknowns.landmarks
        return cls(*(np.array(leaf, dtype=np.float64) for leaf in leaves))

    def unknowns(self) -> kernels.Unknowns:
        """The same values as JAX arrays."""
        return kernels.Unknowns(*(jnp.asarray(leaf) for leaf in self))


class _Factors(NamedTuple):
    """Residuals of one kind (echoes or odometry), and how each of them depends on one block."""

    residual: Float[np.ndarray, "terms rows"]
    """Measured minus predicted."""
    weight: Float[np.ndarray, "terms rows"]
    """Inverse variances."""
    jacobians: tuple[Float[np.ndarray, "terms rows _"], ...]
    """Derivatives of the predictions, in the order of ``_SparseProblem.dependencies``."""


class _Dependency(NamedTuple):
    """Which terms of one kind of factors depend on a block in one way."""

    block: Int[np.ndarray, " chosen"]
    """Index of the block, for each chosen term."""
    term: Int[np.ndarray, " chosen"]
    """Index of the term."""


class _Product(NamedTuple):
    """Contribution of two dependencies of the same factors to the normal matrix."""

    kind: int
    """0: echoes, 1: odometry."""
    first: int
    second: int
    """Indices of the two dependencies."""
    term: Int[np.ndarray, " chosen"]
    """Terms that have both dependencies."""
    entry: Int[np.ndarray, "_ _ _"]
    """Storage index of each entry, term by term; one index for all terms if they all depend on the same two blocks."""


class _SparseProblem:
    """Cost, normal equations and solver (``LeastSquares``). Blocks: poses (if free), landmarks, ring coordinates."""

    def __init__(self, problem: kernels.LeastSquaresProblem, poses_free: bool, settings: SparseAdjustmentSettings):
        self.problem = problem
        weight = np.asarray(problem.factors.weight)
        scan, echo = np.nonzero(weight > 0)
        self.weight = weight[scan, echo]
        self.odometry_information = np.asarray(problem.odometry_information)[:-1]
        self.prior_information = np.asarray(problem.prior_information)
        self.prior_poses = np.asarray(problem.prior_poses)
        self.prior_landmarks = np.asarray(problem.landmarks.parameters)
        self.coordinate_count, self.landmark_count = problem.basis.shape[1], len(self.prior_landmarks)
        steps = np.flatnonzero((self.odometry_information > 0).any(axis=1))
        # Poses behind the last one with an echo or odometry are padding; they keep their values.
        self.pose_count = max(int(scan.max(initial=-1)) + 1, int(steps.max(initial=-2)) + 2) if poses_free else 0
        size = next_power_of_two(len(scan), least=settings.min_echo_rows)
        self.scan, self.echo = (jnp.asarray(pad_rows(rows.astype(np.int32), size)) for rows in (scan, echo))
        self.dependencies = self._dependencies(scan, echo, steps, poses_free)
        counts = [self.pose_count, self.landmark_count, 1 if self.coordinate_count else 0]
        sizes = np.repeat([3, 2, self.coordinate_count], counts)
        self.structure, self.products = self._structure(sizes)

    def _dependencies(
        self, scan: Int[np.ndarray, " terms"], echo: Int[np.ndarray, " terms"], steps: np.ndarray, poses_free: bool
    ) -> tuple[list[_Dependency], list[_Dependency]]:
        """Of echoes on (first landmark, second landmark, pose, coordinates); of odometry on (pose, pose, coordinates).

        The order is that of the Jacobians in ``evaluate``.
        """
        reflection = self.problem.factors.reflection
        kind, first, second = (
            np.asarray(leaf)[scan, echo] for leaf in (reflection.kind, reflection.first, reflection.second)
        )
        every, ring = np.arange(len(scan)), self.pose_count + self.landmark_count
        second_order = np.flatnonzero(kind == kernels.SECOND_ORDER)
        none = np.zeros(0, dtype=np.int64)
        echoes = [
            _Dependency(self.pose_count + first, every),
            _Dependency(self.pose_count + second[second_order], second_order),
            _Dependency(scan, every) if poses_free else _Dependency(none, none),
        ]
        odometry = [_Dependency(steps, steps), _Dependency(steps + 1, steps)] if poses_free else []
        if self.coordinate_count:
            echoes.append(_Dependency(np.full(len(scan), ring), every))
            odometry += [_Dependency(np.full(len(steps), ring), steps)] if poses_free else []
        return echoes, odometry

    def _structure(self, sizes: Int[np.ndarray, " blocks"]) -> tuple[SymbolicFactorization, list[_Product]]:
        """The symbolic factorization, and where the products of Jacobians are stored in the normal matrix."""
        common = []
        for kind, group in enumerate(self.dependencies):
            for first in range(len(group)):
                for second in range(first, len(group)):
                    common.append((kind, first, second, *_common_terms(group[first], group[second])))
        pairs = np.concatenate([np.zeros((0, 2), dtype=np.int64), *(pair for *_, pair in common)])
        structure, products = SymbolicFactorization(sizes, pairs), []
        for kind, first, second, term, pair in common:
            if not len(term):
                continue
            if (pair == pair[0]).all():
                pair = pair[:1]
            base, row_stride, column_stride = (x[:, None, None] for x in structure.storage(pair[:, 0], pair[:, 1]))
            rows, columns = (np.arange(int(sizes[block])) for block in pair[0])
            index = base + row_stride * rows[:, None] + column_stride * columns
            products.append(_Product(kind, first, second, term, index))
        return structure, products

    def evaluate(self, point: _Point) -> tuple[float, tuple[_Factors, _Factors]]:
        """The cost (``kernels.cost``), and the factors of echoes and odometry with their Jacobians."""
        found = kernels.linearize(self.problem, point.unknowns(), self.scan, self.echo)
        count = len(self.weight)
        by_echo = (found.d_range_d_first, found.d_range_d_second, found.d_range_d_pose, found.d_range_d_coordinates)
        by_step = (found.d_odometry_d_from, found.d_odometry_d_to, found.d_odometry_d_coordinates)
        echoes = _Factors(
            np.asarray(found.residual)[:count, None],
            self.weight[:, None],
            tuple(np.asarray(jacobian)[:count, None] for jacobian in by_echo),
        )
        odometry = _Factors(
            -np.asarray(found.odometry_residual),
            self.odometry_information,
            tuple(np.asarray(jacobian) for jacobian in by_step),
        )
        pose_change, landmark_change = self._prior_residuals(point)
        total = sum(float((factors.weight * factors.residual**2).sum()) for factors in (echoes, odometry))
        total += float((point.coordinates**2).sum() + (landmark_change**2).sum())
        total += float((self.prior_information * pose_change**2).sum())
        return total / 2, (echoes, odometry)

    def linearize(
        self, point: _Point, evaluation: tuple[_Factors, _Factors]
    ) -> tuple[Float[np.ndarray, " stored"], Float[np.ndarray, " unknowns"]]:
        """The normal matrix as the symbolic factorization stores it, and the negative gradient of the cost."""
        structure = self.structure
        # 1. Products of the Jacobians of echoes and odometry.
        index, values = [np.zeros(0, dtype=np.int64)], [np.zeros(0)]
        for product in self.products:
            factors, term = evaluation[product.kind], product.term
            first = factors.jacobians[product.first][term] * factors.weight[term][..., None]
            second = factors.jacobians[product.second][term]
            if len(product.entry) < len(term):  # the same two blocks: the sum over all terms is one matrix product
                first, second = (x.reshape(1, -1, x.shape[-1]) for x in (first, second))
            index.append(product.entry.ravel())
            values.append((np.swapaxes(first, 1, 2) @ second).ravel())
        matrix = np.bincount(np.concatenate(index), np.concatenate(values), minlength=structure.nnz)
        matrix = matrix.astype(np.float64, copy=False)  # whole numbers if there is no product
        # 2. Their gradients.
        gradient = self.gradient(evaluation)
        # 3. The priors.
        pose_change, landmark_change = self._prior_residuals(point)
        information, landmark_sd = self.prior_information[: self.pose_count], self.problem.landmark_prior_sd
        landmark_information = np.full(2 * self.landmark_count, 1 / landmark_sd**2)
        matrix[structure.diagonal] += np.concatenate(
            [information.ravel(), landmark_information, np.ones(self.coordinate_count)]
        )
        by_prior = (information * pose_change[: self.pose_count]).ravel(), landmark_change.ravel() / landmark_sd
        return matrix, gradient - np.concatenate([*by_prior, point.coordinates])

    def gradient(self, evaluation: tuple[_Factors, _Factors]) -> Float[np.ndarray, " unknowns"]:
        """The negative gradient of the cost of echoes and odometry, without the priors."""
        structure = self.structure
        gradient = np.zeros(int(structure.begin[-1]))
        for factors, group in zip(evaluation, self.dependencies, strict=True):
            weighted = factors.weight * factors.residual
            for jacobian, (block, term) in zip(factors.jacobians, group, strict=False):
                if not len(term):
                    continue
                by_block = np.einsum("trd,tr->td", jacobian[term], weighted[term])
                row = structure.begin[block][:, None] + np.arange(by_block.shape[1])
                gradient += np.bincount(row.ravel(), by_block.ravel(), minlength=len(gradient))
        return gradient

    def step(
        self,
        point: _Point,
        equations: tuple[Float[np.ndarray, " stored"], Float[np.ndarray, " unknowns"]],
        damping: float,
    ) -> tuple[_Point, float]:
        """The point after a damped step, and the largest component of the step."""
        matrix = equations[0].copy()
        matrix[self.structure.diagonal] *= 1 + damping
        step = self.structure.factorize(matrix).solve(equations[1])
        by_pose, by_landmark, by_coordinate = np.split(
            step, [3 * self.pose_count, 3 * self.pose_count + 2 * self.landmark_count]
        )
        poses = point.poses.copy()
        poses[: self.pose_count] += by_pose.reshape(-1, 3)
        landmarks = point.landmarks + by_landmark.reshape(-1, 2)
        return _Point(point.coordinates + by_coordinate, poses, landmarks), float(np.abs(step).max(initial=0.0))

    def _prior_residuals(self, point: _Point) -> tuple[Float[np.ndarray, "scans 3"], Float[np.ndarray, "landmarks 2"]]:
        """Poses minus their prior means (metres, radians); landmarks likewise, in prior standard deviations."""
        landmark_change = (point.landmarks - self.prior_landmarks) / self.problem.landmark_prior_sd
        return subtract_poses(point.poses, self.prior_poses), landmark_change


def _common_terms(
    first: _Dependency, second: _Dependency
) -> tuple[Int[np.ndarray, " common"], Int[np.ndarray, "common 2"]]:
    """Terms that occur in both dependencies, and the two blocks of each."""
    term, i, k = np.intersect1d(first.term, second.term, assume_unique=True, return_indices=True)
    return term, np.stack([first.block[i], second.block[k]], axis=1)
