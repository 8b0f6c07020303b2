"""Model selection of point landmarks after an adjustment: corner or edge, or not a point at all."""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxsonar import kernels
from jaxsonar.estimation.adjustment_state import AdjustmentResult, AdjustmentState
from jaxsonar.estimation.sparse_adjustment import solve_adjustment


@dataclass(frozen=True)
class LandmarkSelectionSettings:
    """Constants of the model selection. All of them were chosen by hand."""

    kind_change_ratio: float = 0.97
    """A corner becomes an edge, and vice versa, if that reduces the sum of squared residuals below this fraction."""
    min_judged_echoes: int = 8
    """Echoes of a point from which on its goodness of fit is tested."""
    max_variance_ratio: float = 1.1
    """Variance of the residuals of a point relative to that of walls; beyond, with four standard deviations of the
    sample variance as a margin, the point is removed."""


SETTINGS = LandmarkSelectionSettings()


def reclassify_points(found: AdjustmentResult, settings: LandmarkSelectionSettings = SETTINGS) -> AdjustmentState:
    """Turn corners into edges, and edges into corners, where that fits the echoes better.

    Args:
        found: result of an adjustment.
        settings: ``kind_change_ratio``.

    Returns:
        The state of ``found`` with corrected kinds, and positions adjusted to them.
    """
    state, problem, used = found.state, found.problem, found.used
    landmarks, candidates = state.landmark_map.landmarks, state.landmark_map.candidates
    kind = np.asarray(landmarks.kind)
    is_point = np.isin(kind, (kernels.CORNER, kernels.EDGE))
    other_kind = np.where(is_point, kernels.CORNER + kernels.EDGE - kind, kind).astype(np.int32)
    # 1. The same echoes with every point of the other kind; ring and poses are held.
    reflection = problem.factors.reflection
    first, first_order = np.asarray(reflection.first), np.asarray(reflection.kind) != kernels.SECOND_ORDER
    alternative = eqx.tree_at(
        lambda p: (p.landmarks.kind, p.factors.reflection.kind, p.basis, p.sensors),
        problem,
        (
            jnp.asarray(other_kind),
            jnp.asarray(np.where(first_order, other_kind[first], np.asarray(reflection.kind)).astype(np.int32)),
            jnp.zeros_like(problem.basis),
            kernels.apply_parameters(problem.sensors, problem.basis @ jnp.asarray(state.coordinates)),
        ),
    )
    fitted = solve_adjustment(alternative, state.unknowns(), poses_free=False).unknowns
    residual = np.where(used, np.asarray(kernels.residuals(alternative, fitted)), 0)
    # 2. The sums of squares of both hypotheses, point by point.
    counted = used & first_order
    before, after = (
        np.bincount(first[counted], weights=values[counted] ** 2, minlength=len(kind))
        for values in (found.residual, residual)
    )
    changed = is_point & (after < settings.kind_change_ratio * before)
    if not changed.any():
        return state
    # 3. Kinds and positions of the points that changed, and kinds of their reflections.
    kind = np.where(changed, other_kind, kind).astype(np.int32)
    parameters = np.where(changed[:, None], np.asarray(fitted.landmarks), np.asarray(landmarks.parameters))
    landmarks = eqx.tree_at(lambda s: (s.kind, s.parameters), landmarks, (kind, parameters))
    of_candidate = np.asarray(candidates.reflection.kind)
    of_point = np.isin(of_candidate, (kernels.CORNER, kernels.EDGE))
    of_candidate = np.where(of_point, kind[np.asarray(candidates.reflection.first)], of_candidate).astype(np.int32)
    candidates = eqx.tree_at(lambda c: c.reflection.kind, candidates, of_candidate)
    return state._replace(landmark_map=state.landmark_map._replace(landmarks=landmarks, candidates=candidates))


def remove_misfitting_points(
    state: AdjustmentState, found: AdjustmentResult, settings: LandmarkSelectionSettings = SETTINGS
) -> AdjustmentState:
    """Remove the reflections of points whose echoes do not fit their kind, such as two walls at an angle.

    Circles are judged, too: their radius may be wrong.

    Otherwise their residuals would increase the estimated noise, and the gate would admit more such echoes.

    Args:
        state: the state to change.
        found: the adjustment that its residuals are from.
        settings: ``min_judged_echoes`` and ``max_variance_ratio``.
    """
    landmark_map = state.landmark_map
    kind = np.asarray(found.problem.factors.reflection.kind)
    first = np.asarray(found.problem.factors.reflection.first)
    of_wall = found.used & (kind == kernels.PLANE)
    if not of_wall.any():
        return state
    variance = float(np.mean(found.residual[of_wall] ** 2))
    of_point = found.used & np.isin(kind, (kernels.CORNER, kernels.EDGE, kernels.CIRCLE))
    count = np.bincount(first[of_point], minlength=len(landmark_map.map_index))
    squares = np.bincount(first[of_point], weights=found.residual[of_point] ** 2, minlength=len(landmark_map.map_index))
    margin = 1 + 4 * np.sqrt(2 / np.maximum(count, 1))  # four standard deviations of the sample variance
    misfits = (count >= settings.min_judged_echoes) & (
        squares > settings.max_variance_ratio * count * variance * margin
    )
    reflection = landmark_map.candidates.reflection
    of_candidate = np.asarray(reflection.kind)
    removed = misfits[np.asarray(reflection.first)] & (of_candidate != kernels.SECOND_ORDER)
    of_candidate = np.where(removed, -1, of_candidate).astype(np.int32)
    candidates = eqx.tree_at(lambda c: c.reflection.kind, landmark_map.candidates, of_candidate)
    return state._replace(landmark_map=landmark_map._replace(candidates=candidates))
