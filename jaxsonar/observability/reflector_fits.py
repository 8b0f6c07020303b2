"""Least-squares fits of one reflector to the ranges of one scene, for batches of scenes."""

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar import kernels
from jaxsonar.observability.reflectors import ArrayPaths, predicted_ranges, reflectors_at
from jaxsonar.observability.settings import SETTINGS

Ranges = Float[np.ndarray, "scenes paths"]


def residual_squares(
    kind: int,
    paths: ArrayPaths,
    ranges: Ranges,
    heard: Bool[np.ndarray, "scenes paths"],
    distance: Float[np.ndarray, " scenes"],
    bearing: Float[np.ndarray, " scenes"],
) -> Float[np.ndarray, " scenes"]:
    """Sum of the squared residuals of the best reflector of a kind, square metres.

    Args:
        kind: ``kernels.PLANE``, ``CORNER``, ``EDGE`` or ``CIRCLE``.
        paths: the paths that measure.
        ranges: half path lengths, metres.
        heard: which of the ranges exist.
        distance: start of the iteration: distance of the surface, metres.
        bearing: start of the iteration, radians.
    """
    if kind != kernels.CIRCLE:
        return _gauss_newton(kind, reflectors_at(kind, distance, bearing), paths, ranges, heard)
    starts = (reflectors_at(kind, distance, bearing, curvature=kappa) for kappa in SETTINGS.first_curvatures)
    return np.min([_levenberg_marquardt(start, paths, ranges, heard) for start in starts], axis=0)


def _gauss_newton(
    kind: int,
    parameters: Float[np.ndarray, "scenes 2"],
    paths: ArrayPaths,
    ranges: Ranges,
    heard: Bool[np.ndarray, "scenes paths"],
) -> Float[np.ndarray, " scenes"]:
    """Steps of least norm, so that parameters that the ranges do not determine stay where they are."""
    for _ in range(SETTINGS.steps):
        residual, jacobian = _linearized(kind, parameters, paths, ranges, heard)
        step = np.linalg.pinv(jacobian, rcond=1e-9) @ residual[..., None]
        parameters = parameters + np.clip(step[..., 0], -SETTINGS.max_step, SETTINGS.max_step)
    residual, _ = _linearized(kind, parameters, paths, ranges, heard)
    return (residual**2).sum(axis=-1)


def _levenberg_marquardt(
    parameters: Float[np.ndarray, "scenes 3"],
    paths: ArrayPaths,
    ranges: Ranges,
    heard: Bool[np.ndarray, "scenes paths"],
) -> Float[np.ndarray, " scenes"]:
    """Curved reflectors; a damping each, because the curvature is determined badly."""
    damping = np.full(len(parameters), 1e-3)
    residual, jacobian = _linearized(kernels.CIRCLE, parameters, paths, ranges, heard)
    cost = (residual**2).sum(axis=-1)
    for _ in range(SETTINGS.steps):
        normal = np.einsum("spi,spj->sij", jacobian, jacobian)
        diagonal = np.einsum("sii->si", normal)
        damped = normal + np.eye(3) * (damping[:, None] * diagonal + 1e-12)[:, None, :]
        step = np.linalg.solve(damped, np.einsum("spi,sp->si", jacobian, residual)[..., None])[..., 0]
        moved = parameters + step
        moved[:, 2] = np.clip(moved[:, 2], 0, SETTINGS.max_curvature)
        new_residual, new_jacobian = _linearized(kernels.CIRCLE, moved, paths, ranges, heard)
        new_cost = (new_residual**2).sum(axis=-1)
        better = new_cost < cost
        parameters = np.where(better[:, None], moved, parameters)
        residual = np.where(better[:, None], new_residual, residual)
        jacobian = np.where(better[:, None, None], new_jacobian, jacobian)
        cost, damping = np.where(better, new_cost, cost), damping * np.where(better, 0.2, 6.0)
    return cost


def _linearized(
    kind: int,
    parameters: Float[np.ndarray, "scenes parameters"],
    paths: ArrayPaths,
    ranges: Ranges,
    heard: Bool[np.ndarray, "scenes paths"],
) -> tuple[Ranges, Float[np.ndarray, "scenes paths parameters"]]:
    """Residuals and derivatives of the ranges, 0 for paths that heard nothing."""
    predicted = predicted_ranges(kind, parameters, paths)
    residual = np.where(heard, ranges - predicted.range, 0)
    return residual, np.where(heard[..., None], predicted.d_range_d_landmark, 0)
