"""Echoes to reflectors, least squares, and again: ring, poses and reflectors settle while the gate closes.

Graduated non-convexity: at first an echo may be centimetres off its reflector and still pull at it, with the weight of
Geman and McClure's loss; the scale of that loss halves until it is four sigma, where an echo is either right or not.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.estimation.batch_data import BatchData
from jaxsonar.estimation.landmark_map import LandmarkMap
from jaxsonar.estimation.sparse_lm import adjust as sparsely
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_parameters import ParameterBasis

GATE, DOUBT = 4.0, 5.0
"""Sigma; how far an echo may be off its reflector, and how near to its range another one's makes it doubtful."""
LEAST_ECHOES = 3
"""Echoes that a reflector needs to say anything of the ring."""
LEAST_SIGMA = 1e-5
"""Metres; noise-free echoes have some, too: that of their digits."""
_BESIDE = 0.5  # m; beyond the maximum range, for poses and reflectors that are not yet where they should be
_HALVINGS = 12
_LAST_ROUNDS = 3
_ENOUGH = 0.01  # decrease of half a sum of squares in units of sigma: far less than anything is known to
_JUDGED, _MISFIT = 8, 1.1  # echoes and share; from there on a point must fit as well as the walls do
_OTHER_KIND = 0.97  # of the sum of squares; a corner that is an edge, or the other way round


class AdjustmentState(NamedTuple):
    """How far the settling has come; NumPy arrays in double precision."""

    coordinates: Float[np.ndarray, " modes"]
    """Of the ring along its modes."""
    poses: Float[np.ndarray, "scans 3"]
    landmark_map: LandmarkMap
    """The reflectors, where they are now."""


class AdjustmentResult(NamedTuple):
    """The end of it."""

    state: AdjustmentState
    problem: kernels.LeastSquaresProblem
    """The last least squares."""
    solution: kernels.LeastSquaresSolution
    used: Bool[np.ndarray, "scans echoes"]
    """Echoes that a reflector explains, and no other one nearly so."""
    candidate: Int[np.ndarray, "scans echoes"]
    """Row of the surroundings' candidates that each of them comes from."""
    residual: Float[np.ndarray, "scans echoes"]
    """Reported minus expected, metres; only where used."""
    sigma: float
    """Noise of the ranges, metres."""


def gnc_adjust(
    ring: Ring,
    data: BatchData,
    modes: ParameterBasis,
    state: AdjustmentState,
    *,
    initial_scale: float,
    poses_free: bool,
    sigma: float | None = None,
) -> AdjustmentResult:
    """Close the gate around a start, round by round. To be called with 64-bit floats enabled.

    Args:
        ring: where the modes begin.
        data: the scans.
        modes: how the ring may change.
        state: the start.
        widest: scale of the first round, metres.
        poses_free: whether poses are estimated.
        sigma: noise of the ranges, metres, if it is known.
    """
    state, noise = _anneal(ring, data, modes, state, initial_scale=initial_scale, poses_free=poses_free, sigma=sigma)
    known = int(np.linalg.matrix_rank(modes.columns)) if modes.columns.any() else 0
    for _ in range(_LAST_ROUNDS):
        found = _reassociate(ring, data, modes, state, noise, poses_free)
        reflectors = len(np.unique(np.asarray(found.problem.factors.reflection.first)[found.used]))
        left = int(found.used.sum()) - 2 * reflectors - known - 3 * data.scan_count * poses_free
        if sigma is None and left > 0:
            noise = max(float(np.sqrt((found.residual**2).sum() / left)), LEAST_SIGMA)
        state = _without_misfits(_of_better_kind(found, data), found)
    return _reassociate(ring, data, modes, state, noise, poses_free)


def anneal(
    ring: Ring,
    data: BatchData,
    modes: ParameterBasis,
    state: AdjustmentState,
    *,
    initial_scale: float,
    sigma: float | None = None,
) -> AdjustmentState:
    """Close the gate around a start, as ``settle``, but without its last rounds: a better start, poses free."""
    return _anneal(ring, data, modes, state, initial_scale=initial_scale, poses_free=True, sigma=sigma)[0]


def _anneal(
    ring: Ring,
    data: BatchData,
    modes: ParameterBasis,
    state: AdjustmentState,
    *,
    initial_scale: float,
    poses_free: bool,
    sigma: float | None,
) -> tuple[AdjustmentState, float]:
    """Round by round with half the scale, down to four sigma; and sigma, from the middle of the residuals."""
    scale, spread, last = initial_scale, initial_scale / GATE, False
    for _ in range(_HALVINGS):
        used, _, reflection = _associated(ring, data, modes, state, gate=3 * scale, doubt=0.0)
        residual = _residual(ring, data, modes, state, reflection)
        weight = used / (1 + (residual / scale) ** 2) ** 2 * (GATE / scale) ** 2
        state, _, _ = _adjusted(ring, data, modes, state, reflection, weight, poses_free)
        residual = _residual(ring, data, modes, state, reflection)
        near = np.abs(residual[used & (np.abs(residual) < 3 * scale)])
        spread = max(1.4826 * float(np.median(near)) if len(near) else scale / GATE, LEAST_SIGMA)
        if last:
            break
        tight = GATE * (spread if sigma is None else sigma)
        scale, last = max(scale / 2, tight), scale / 2 <= tight
    return state, spread if sigma is None else sigma


def _reassociate(ring: Ring, data: BatchData, modes: ParameterBasis, state: AdjustmentState, noise: float, poses_free: bool) -> AdjustmentResult:
    """One round in which an echo is right or not: within the gate, and no second reflector near."""
    used, candidate, reflection = _associated(ring, data, modes, state, gate=GATE * noise, doubt=DOUBT * noise)
    state, problem, found = _adjusted(ring, data, modes, state, reflection, used / noise**2, poses_free)
    residual = np.where(used, _residual(ring, data, modes, state, reflection), 0)
    return AdjustmentResult(state, problem, found, used, candidate, residual, noise)


def ring_change(modes: ParameterBasis, state: AdjustmentState) -> Float[np.ndarray, " ring"]:
    """Change of offsets, log speed of sound and positions so far."""
    return modes.columns @ state.coordinates


def problem_of(
    ring: Ring,
    data: BatchData,
    modes: ParameterBasis,
    state: AdjustmentState,
    reflection: kernels.Reflection,
    weight: Float[np.ndarray, "scans echoes"],
) -> kernels.LeastSquaresProblem:
    """The least-squares problem of given associations."""
    return kernels.LeastSquaresProblem(
        sensors=ring.sensors,
        basis=jnp.asarray(modes.columns),
        landmarks=_arrays(state.landmark_map.landmarks),
        factors=kernels.EchoFactors(
            path=jnp.asarray(data.path),
            reported=jnp.asarray(np.nan_to_num(data.reported)),
            reflection=_arrays(reflection),
            weight=jnp.asarray(weight),
        ),
        prior_poses=jnp.asarray(data.poses),
        prior_information=jnp.asarray(data.prior_information),
        odometry=jnp.asarray(data.odometry),
        odometry_information=jnp.asarray(data.odometry_information),
        landmark_prior_sd=data.landmark_prior_sd,
    )


def _associated(
    ring: Ring, data: BatchData, modes: ParameterBasis, state: AdjustmentState, *, gate: float, doubt: float
) -> tuple[Bool[np.ndarray, "scans echoes"], Int[np.ndarray, "scans echoes"], kernels.Reflection]:
    """Which echoes are within the gate of a reflector, with no second one near, and where they come from."""
    around = state.landmark_map
    # Scans have very different numbers of echoes: in rows of a few echoes each there is little padding.
    rows, columns = data.packed_echoes
    scan = rows[:, 0]
    near = around.candidates_in_range(state.poses, data.world, float(ring.max_range) + _BESIDE)
    found = kernels.associate(
        kernels.apply_parameters(ring.sensors, jnp.asarray(ring_change(modes, state))),
        _arrays(around.landmarks),
        _arrays(around.candidates),
        jnp.asarray(state.poses[scan]),
        jnp.asarray(data.world[scan]),
        jnp.asarray(data.path[rows, columns]),
        jnp.asarray(data.reported[rows, columns]),
        jnp.asarray(near[scan]),
    )
    candidate, residual, rival = np.full(data.path.shape, -1), *np.full((2, *data.path.shape), np.inf)
    for whole, part in zip((candidate, residual, rival), (found.candidate, found.residual, found.competitor_gap), strict=True):
        whole[rows, columns] = np.asarray(part)
    used = (candidate >= 0) & (np.abs(residual) < gate) & (rival > doubt) & np.isfinite(data.reported)
    candidate = np.where(candidate >= 0, candidate, 0)
    kind, first, second = (
        np.asarray(leaf)[candidate]
        for leaf in (
            around.candidates.reflection.kind,
            around.candidates.reflection.first,
            around.candidates.reflection.second,
        )
    )
    if data.wall_explained is not None:
        used &= ~(data.wall_explained & np.isin(kind, (kernels.CORNER, kernels.EDGE)))
    if data.min_echoes_per_landmark > 1:
        room = len(around.world)
        group = first + room * np.arange(len(first))[:, None]
        used &= np.bincount(group[used], minlength=room * len(first))[group] >= data.min_echoes_per_landmark
    # A reflector that hardly anything comes from fits anything.
    count = np.bincount(first[used], minlength=len(around.world))
    used &= (count[first] >= LEAST_ECHOES) | (kind == kernels.SECOND_ORDER)
    return used, candidate, kernels.Reflection(kind.astype(np.int32), first.astype(np.int32), second.astype(np.int32))


def _adjusted(
    ring: Ring,
    data: BatchData,
    modes: ParameterBasis,
    state: AdjustmentState,
    reflection: kernels.Reflection,
    weight: Float[np.ndarray, "scans echoes"],
    poses_free: bool,
) -> tuple[AdjustmentState, kernels.LeastSquaresProblem, kernels.LeastSquaresSolution]:
    problem = problem_of(ring, data, modes, state, reflection, weight)
    if data.sparse:
        found = sparsely(problem, _unknowns(state), poses_free=poses_free, most=data.max_iterations, enough=_ENOUGH)
    else:
        found = kernels.adjust(problem, _unknowns(state), poses_free=poses_free, most=data.max_iterations)
    now = found.unknowns
    scene = eqx.tree_at(lambda s: s.parameters, state.landmark_map.landmarks, np.asarray(now.landmarks))
    moved = AdjustmentState(np.asarray(now.coordinates), np.asarray(now.poses), state.landmark_map._replace(landmarks=scene))
    return moved, problem, found


def _of_better_kind(found: AdjustmentResult, data: BatchData) -> AdjustmentState:
    """Corners that fit better as edges, and edges that fit better as corners, become these."""
    state, problem, used, residual = found.state, found.problem, found.used, found.residual
    around = state.landmark_map
    kind = np.asarray(around.landmarks.kind)
    of_point = kind > kernels.PLANE
    flipped = np.where(of_point, kernels.CORNER + kernels.EDGE - kind, kind).astype(np.int32)
    reflection = problem.factors.reflection
    first = np.asarray(reflection.first)
    single = np.asarray(reflection.kind) != kernels.SECOND_ORDER
    other = eqx.tree_at(
        lambda p: (p.scene.kind, p.heard.reflection.kind, p.modes, p.sensors),
        problem,
        (
            jnp.asarray(flipped),
            jnp.asarray(np.where(single, flipped[first], np.asarray(reflection.kind)).astype(np.int32)),
            jnp.zeros_like(problem.basis),
            kernels.apply_parameters(problem.sensors, problem.basis @ jnp.asarray(state.coordinates)),
        ),
    )
    adjust = sparsely if data.sparse else kernels.adjust
    fitted = adjust(other, _unknowns(state), poses_free=False).unknowns
    then = np.where(used, np.asarray(kernels.residuals(other, fitted)), 0)
    mine = used & single
    sums = [np.bincount(first[mine], weights=left[mine] ** 2, minlength=len(kind)) for left in (residual, then)]
    better = of_point & (sums[1] < _OTHER_KIND * sums[0])
    if not better.any():
        return state
    now = np.where(better, flipped, kind).astype(np.int32)
    places = np.where(better[:, None], np.asarray(fitted.landmarks), np.asarray(around.landmarks.parameters))
    scene = eqx.tree_at(lambda s: (s.kind, s.parameters), around.landmarks, (now, places))
    of_candidate = np.asarray(around.candidates.reflection.kind)
    alone = np.isin(of_candidate, (kernels.CORNER, kernels.EDGE))
    of_candidate = np.where(alone, now[np.asarray(around.candidates.reflection.first)], of_candidate).astype(np.int32)
    candidates = eqx.tree_at(lambda c: c.reflection.kind, around.candidates, of_candidate)
    return state._replace(landmark_map=around._replace(landmarks=scene, candidates=candidates))


def _without_misfits(state: AdjustmentState, found: AdjustmentResult) -> AdjustmentState:
    """The points whose echoes fit neither a corner nor an edge are none: two walls at another angle, for instance.

    Their echoes would be taken for noise, and the gate would open for more of them.
    """
    around = state.landmark_map
    kind = np.asarray(found.problem.factors.reflection.kind)
    first = np.asarray(found.problem.factors.reflection.first)
    walls = found.used & (kind == kernels.PLANE)
    if not walls.any():
        return state
    variance = float(np.mean(found.residual[walls] ** 2))
    points = found.used & ((kind == kernels.CORNER) | (kind == kernels.EDGE))
    count = np.bincount(first[points], minlength=len(around.world))
    sums = np.bincount(first[points], weights=found.residual[points] ** 2, minlength=len(around.world))
    most = _MISFIT * count * variance * (1 + 4 * np.sqrt(2 / np.maximum(count, 1)))
    bad = (count >= _JUDGED) & (sums > most)
    of_bad = bad[np.asarray(around.candidates.reflection.first)]
    now = np.asarray(around.candidates.reflection.kind)
    now = np.where(of_bad & (now != kernels.SECOND_ORDER), -1, now).astype(np.int32)
    return state._replace(
        landmark_map=around._replace(candidates=eqx.tree_at(lambda c: c.reflection.kind, around.candidates, now))
    )


def _residual(
    ring: Ring, data: BatchData, modes: ParameterBasis, state: AdjustmentState, reflection: kernels.Reflection
) -> Float[np.ndarray, "scans echoes"]:
    problem = problem_of(ring, data, modes, state, reflection, np.zeros_like(data.reported))
    return np.asarray(kernels.residuals(problem, _unknowns(state)))


def _unknowns(state: AdjustmentState) -> kernels.Unknowns:
    return kernels.Unknowns(
        jnp.asarray(state.coordinates), jnp.asarray(state.poses), jnp.asarray(state.landmark_map.landmarks.parameters)
    )


def _arrays(tree):
    return jax.tree.map(jnp.asarray, tree)
