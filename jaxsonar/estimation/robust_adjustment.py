"""Robust bundle adjustment by graduated non-convexity (GNC): data association and least squares in turn.

At first an echo may be centimetres away from its landmark and still attract it, with the weight of the Geman-McClure
loss. The scale of the loss is halved in each round until it is four sigma; from there on an echo is an inlier or an
outlier. Reference: Yang et al., "Graduated Non-Convexity for Robust Spatial Perception", 2020.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.estimation.adjustment_state import AdjustmentResult, AdjustmentState
from jaxsonar.estimation.batch_data import BatchData
from jaxsonar.estimation.landmark_map import LandmarkMap
from jaxsonar.estimation.landmark_selection import reclassify_points, remove_misfitting_points
from jaxsonar.estimation.sparse_adjustment import AdjustmentSolution, absorbed_freedom, solve_adjustment
from jaxsonar.geometry.robust_statistics import MAD_TO_SIGMA
from jaxsonar.kernels.detection_cones import DEAF
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_parameters import PRIOR, ParameterBasis, parameter_basis


@dataclass(frozen=True)
class GncSettings:
    """Constants of the robust adjustment. All of them were chosen by hand."""

    gate_sigmas: float = 4.0
    """Largest residual of an inlier, standard deviations."""
    ambiguity_sigmas: float = 5.0
    """An echo is left out if a second landmark predicts a range this close to that of the first one, standard
    deviations. Comparing with the measured range instead would bias the residuals."""
    loss_gate: float = 3.0
    """Largest residual that has a weight while annealing, in scales of the loss."""
    min_landmark_echoes: int = 3
    """Echoes that a landmark needs; with fewer of them its parameters fit anything."""
    min_sigma: float = 1e-5
    """Lower bound of the estimated noise, metres: simulated ranges without noise are rounded to about this."""
    range_margin: float = 0.5
    """Metres beyond the maximum range within which landmarks are candidates, while poses are inaccurate."""
    max_annealing_rounds: int = 12
    """Rounds in which the scale of the loss is halved, at most."""
    final_rounds: int = 3
    """Rounds of association and least squares with a fixed gate, in which the noise is estimated."""
    levels: tuple[float, ...] = (20.0, -6.0, -10.0, -14.0, -18.0, -22.0, -26.0, -30.0, -34.0, -38.0)
    """Borders of the levels of echoes from outside of the cones that are judged, dB."""
    min_level_echoes: int = 20
    """Echoes of a level from which on it is judged."""
    background_gates: float = 3.0
    """Residuals up to this many gates show how many echoes of a level match by chance."""
    min_purity: float = 0.8
    """Least share of the echoes of a level within the gate that do not match by chance, if it is heard."""
    max_unknowns: float = 0.2
    """Number of unknowns, as a fraction of the number of echoes, up to which the echoes alone determine all of them.
    With more, odometry and priors determine a part."""


SETTINGS = GncSettings()


def gnc_adjust(
    ring: Ring,
    data: BatchData,
    basis: ParameterBasis,
    state: AdjustmentState,
    *,
    initial_scale: float,
    poses_free: bool,
    sigma: float | None = None,
    settings: GncSettings = SETTINGS,
) -> AdjustmentResult:
    """Adjust ring parameters, poses and landmarks. To be called with 64-bit floats enabled.

    Args:
        ring: the ring at coordinates 0.
        data: the measurements.
        basis: basis of the ring parameters.
        state: initial values.
        initial_scale: scale of the robust loss in the first round, metres.
        poses_free: whether poses are estimated.
        sigma: standard deviation of the range noise, metres; estimated if left out.
        settings: constants of the algorithm.
    """
    job = RobustAdjustment(ring, data, basis, poses_free, settings)
    # 1. Shrink the scale of the robust loss. Then find out which echoes are heard outside of the cones.
    state, noise = job.anneal(state, initial_scale, sigma)
    job = replace(job, threshold=job.hearing_threshold(state, noise))
    dof = 0.0
    for _ in range(settings.final_rounds):
        # 2. Associate with a fixed gate and minimize.
        found = job.reassociate(state, noise)
        # 3. Estimate the noise from the residuals.
        dof = _degrees_of_freedom(data, basis, found, poses_free, settings)
        if sigma is None and dof > 0:
            noise = max(float(np.sqrt((found.residual**2).sum() / dof)), settings.min_sigma)
        # 4. Correct the kind of points, and remove those that fit neither kind.
        state = remove_misfitting_points(reclassify_points(found), found)
    return job.reassociate(state, noise)._replace(sigma_dof=max(dof, 0.0) if sigma is None else 0.0)


def _degrees_of_freedom(
    data: BatchData, basis: ParameterBasis, found: AdjustmentResult, poses_free: bool, settings: GncSettings
) -> float:
    """Number of echoes minus what the unknowns absorb."""
    echoes, landmarks = int(found.used.sum()), np.asarray(found.problem.factors.reflection.first)[found.used]
    parameters = int(np.linalg.matrix_rank(basis.columns)) if basis.columns.any() else 0
    unknowns = 2 * len(np.unique(landmarks)) + parameters + 3 * data.scan_count * poses_free
    if unknowns <= settings.max_unknowns * echoes:
        return float(echoes - unknowns)
    return echoes - absorbed_freedom(found.problem, found.solution.unknowns, poses_free=poses_free)


def anneal(
    ring: Ring,
    data: BatchData,
    basis: ParameterBasis,
    state: AdjustmentState,
    *,
    initial_scale: float,
    sigma: float | None = None,
    settings: GncSettings = SETTINGS,
) -> AdjustmentState:
    """Only the annealing of ``gnc_adjust``, with free poses: better initial values."""
    return RobustAdjustment(ring, data, basis, True, settings).anneal(state, initial_scale, sigma)[0]


def explained_echoes(
    ring: Ring, data: BatchData, landmark_map: LandmarkMap, *, gate: float, settings: GncSettings = SETTINGS
) -> Bool[np.ndarray, "scans echoes"]:
    """Which echoes landmarks explain without any adjustment. To be called with 64-bit floats enabled.

    Args:
        ring: the sensors.
        data: the measurements, with poses.
        landmark_map: the landmarks.
        gate: largest residual of an explained echo, metres.
        settings: constants of the algorithm.
    """
    basis = parameter_basis(ring, (), poses_free=False, speed_sd=PRIOR.speed_sd)
    state = AdjustmentState(np.zeros(basis.columns.shape[1]), data.poses, landmark_map)
    return RobustAdjustment(ring, data, basis, False, settings).associate(state, gate=gate, ambiguity=0.0).used


def least_squares_problem(
    ring: Ring,
    data: BatchData,
    basis: ParameterBasis,
    state: AdjustmentState,
    reflection: kernels.Reflection,
    weight: Float[np.ndarray, "scans echoes"],
) -> kernels.LeastSquaresProblem:
    """The least-squares problem of a given data association.

    Args:
        ring: the ring at coordinates 0.
        data: the measurements.
        basis: basis of the ring parameters.
        state: its landmarks are the prior means.
        reflection: (scans, echoes) the reflection that each echo is assigned to.
        weight: inverse variance of each echo, 1 / square metres.
    """
    return kernels.LeastSquaresProblem(
        sensors=ring.sensors,
        basis=jnp.asarray(basis.columns),
        landmarks=to_jax(state.landmark_map.landmarks),
        factors=kernels.EchoFactors(
            path=jnp.asarray(data.path),
            reported=jnp.asarray(np.nan_to_num(data.reported)),
            reflection=to_jax(reflection),
            weight=jnp.asarray(weight),
            motion=None if data.motion is None else jnp.asarray(data.motion),
        ),
        prior_poses=jnp.asarray(data.poses),
        prior_information=jnp.asarray(data.prior_information),
        odometry=jnp.asarray(data.odometry),
        odometry_information=jnp.asarray(data.odometry_information),
        landmark_prior_sd=data.landmark_prior_sd,
    )


def to_jax(tree):
    """All arrays of a tree as JAX arrays."""
    return jax.tree.map(jnp.asarray, tree)


class Association(NamedTuple):
    """Data association of all echoes."""

    used: Bool[np.ndarray, "scans echoes"]
    candidate: Int[np.ndarray, "scans echoes"]
    reflection: kernels.Reflection
    residual: Float[np.ndarray, "scans echoes"]
    """Reported minus expected range, metres."""
    level: Float[np.ndarray, "scans echoes"]
    """Level of the expected echo outside of the cones, dB; infinite inside."""


@dataclass(frozen=True)
class RobustAdjustment:
    """Measurements and model of one robust adjustment."""

    ring: Ring
    data: BatchData
    basis: ParameterBasis
    poses_free: bool
    settings: GncSettings
    threshold: float = DEAF
    """Level of the faintest echoes that are heard outside of the cones, dB (``kernels.EchoAssociation.level``)."""

    def anneal(
        self, state: AdjustmentState, initial_scale: float, sigma: float | None
    ) -> tuple[AdjustmentState, float]:
        """Halve the scale of the loss in each round until it is the gate; also returns the standard deviation.

        Unless ``sigma`` is given, it is estimated robustly (median absolute deviation).
        """
        settings = self.settings
        scale, spread, last = initial_scale, initial_scale / settings.gate_sigmas, False
        for _ in range(settings.max_annealing_rounds):
            gate = settings.loss_gate * scale
            found = self.associate(state, gate=gate, ambiguity=0.0)
            used, reflection = found.used, found.reflection
            residual = self.residual(state, reflection)
            # Geman-McClure weights, normalized so that an echo within the scale counts as one within the gate.
            weight = used / (1 + (residual / scale) ** 2) ** 2 * (settings.gate_sigmas / scale) ** 2
            state, _, _ = self.adjust(state, reflection, weight)
            residual = self.residual(state, reflection)
            inliers = np.abs(residual[used & (np.abs(residual) < gate)])
            median = float(np.median(inliers)) if len(inliers) else None
            spread = scale / settings.gate_sigmas if median is None else MAD_TO_SIGMA * median
            spread = max(spread, settings.min_sigma)
            if last:
                break
            tight = settings.gate_sigmas * (spread if sigma is None else sigma)
            scale, last = max(scale / 2, tight), scale / 2 <= tight
        return state, spread if sigma is None else sigma

    def reassociate(self, state: AdjustmentState, noise: float) -> AdjustmentResult:
        """One round of association with a hard gate, and least squares."""
        gate, ambiguity = self.settings.gate_sigmas * noise, self.settings.ambiguity_sigmas * noise
        used, candidate, reflection, _, _ = self.associate(state, gate=gate, ambiguity=ambiguity)
        state, problem, solution = self.adjust(state, reflection, used / noise**2)
        residual = np.where(used, self.residual(state, reflection), 0)
        return AdjustmentResult(state, problem, solution, used, candidate, residual, noise)

    def hearing_threshold(self, state: AdjustmentState, noise: float) -> float:
        """Level of the faintest echoes of walls that are heard outside of the cones, dB; ``DEAF`` if none are.

        Echoes of a level are heard if far more ranges lie within the gate about the expected one than beside it.

        Args:
            state: poses and landmarks after the annealing.
            noise: standard deviation of the ranges, metres.
        """
        settings = self.settings
        gate, ambiguity = settings.gate_sigmas * noise, settings.ambiguity_sigmas * noise
        faintest = settings.levels[-1]
        wide = replace(self, threshold=faintest)
        found = wide.associate(state, gate=settings.background_gates * gate, ambiguity=ambiguity)
        of_wall = found.used & (found.reflection.kind == kernels.PLANE)
        off, level = np.abs(found.residual[of_wall]), found.level[of_wall]
        threshold = DEAF
        for low, high in zip(settings.levels[1:], settings.levels[:-1], strict=True):
            here = off[(level > low) & (level <= high)]
            near = np.count_nonzero(here < gate)
            chance = (len(here) - near) / (settings.background_gates - 1)
            if len(here) < settings.min_level_echoes and threshold == DEAF:
                continue
            if len(here) >= settings.min_level_echoes and near - chance < settings.min_purity * near:
                break
            threshold = low
        return threshold

    def associate(self, state: AdjustmentState, *, gate: float, ambiguity: float) -> Association:
        """Assign each echo to the closest reflection; use it if within the gate and no second reflection is near."""
        data, landmark_map, settings = self.data, state.landmark_map, self.settings
        # 1. The closest reflection of every echo, in rows of a few echoes each.
        rows, columns = data.packed_echoes
        scan = rows[:, 0]
        max_range = float(self.ring.max_range) + settings.range_margin
        motion = data.motion
        if motion is not None:
            max_range += float(np.hypot(motion[..., 0], motion[..., 1]).max())
        in_range = landmark_map.candidates_in_range(state.poses, data.map_index, max_range)
        found = kernels.associate(
            kernels.apply_parameters(self.ring.sensors, jnp.asarray(self.basis.columns @ state.coordinates)),
            to_jax(landmark_map.landmarks),
            to_jax(landmark_map.candidates),
            jnp.asarray(state.poses[scan]),
            jnp.asarray(data.map_index[scan]),
            jnp.asarray(data.path[rows, columns]),
            jnp.asarray(data.reported[rows, columns]),
            jnp.asarray(in_range[scan]),
            None if motion is None else jnp.asarray(motion[rows, columns]),
            jnp.asarray(self.threshold, dtype=state.poses.dtype),
        )
        none = np.full((3, *data.path.shape), np.inf)
        candidate, (residual, competitor_gap, level) = np.full(data.path.shape, -1), none
        for whole, part in zip(
            (candidate, residual, competitor_gap, level),
            (found.candidate, found.residual, found.competitor_gap, found.level),
            strict=True,
        ):
            whole[rows, columns] = np.asarray(part)
        # 2. The gates.
        used = (candidate >= 0) & (np.abs(residual) < gate) & (competitor_gap > ambiguity) & np.isfinite(data.reported)
        candidate = np.where(candidate >= 0, candidate, 0)
        of_candidates = landmark_map.candidates.reflection
        kind, first, second = (
            np.asarray(leaf)[candidate] for leaf in (of_candidates.kind, of_candidates.first, of_candidates.second)
        )
        if data.wall_explained is not None:
            used &= ~(data.wall_explained & np.isin(kind, (kernels.CORNER, kernels.EDGE, kernels.CIRCLE)))
        # 3. Landmarks with too few echoes, in a scan or in all.
        count = len(landmark_map.map_index)
        if data.min_echoes_per_landmark > 1:
            pair = first + count * np.arange(len(first))[:, None]
            used &= np.bincount(pair[used], minlength=count * len(first))[pair] >= data.min_echoes_per_landmark
        echoes = np.bincount(first[used], minlength=count)
        used &= (echoes[first] >= settings.min_landmark_echoes) | (kind == kernels.SECOND_ORDER)
        reflection = kernels.Reflection(*(leaf.astype(np.int32) for leaf in (kind, first, second)))
        return Association(used, candidate, reflection, residual, level)

    def adjust(
        self, state: AdjustmentState, reflection: kernels.Reflection, weight: Float[np.ndarray, "scans echoes"]
    ) -> tuple[AdjustmentState, kernels.LeastSquaresProblem, AdjustmentSolution]:
        """Least squares of a given association and weights: the new state, the problem and its solution."""
        problem = least_squares_problem(self.ring, self.data, self.basis, state, reflection, weight)
        solution = solve_adjustment(
            problem,
            state.unknowns(),
            poses_free=self.poses_free,
            max_iterations=self.data.max_iterations,
            absolute_tolerance=self.data.cost_tolerance,
        )
        return state.with_unknowns(solution.unknowns), problem, solution

    def residual(self, state: AdjustmentState, reflection: kernels.Reflection) -> Float[np.ndarray, "scans echoes"]:
        """Reported minus predicted range of each echo for a given association, metres."""
        no_weight = np.zeros_like(self.data.reported)
        problem = least_squares_problem(self.ring, self.data, self.basis, state, reflection, no_weight)
        return np.asarray(kernels.residuals(problem, state.unknowns()))
