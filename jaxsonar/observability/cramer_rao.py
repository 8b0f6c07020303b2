"""Cramer-Rao bounds of reflectors from the ranges of an array, by batches of scenes."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar import kernels
from jaxsonar.geometry.se2 import unit
from jaxsonar.observability.reflectors import ArrayPaths, is_heard, predicted_ranges, reflectors_at

RANK_TOLERANCE = 1e-10
"""Smallest share of the largest eigenvalue of the information, in scaled units, that is not a rounding error."""


class ReflectorBound(NamedTuple):
    """Lower bounds of standard deviations for a range noise of 1 m; infinite where the ranges hold no information.

    NaN in scenes in which no path hears the reflector.
    """

    distance: Float[np.ndarray, " scenes"]
    """Distance of the surface from the array's center, metres per metre; for a known bearing if it is unobservable."""
    bearing: Float[np.ndarray, " scenes"]
    """Direction of the normal of planes and circles, bearing of corners and edges, radians per metre."""
    curvature: Float[np.ndarray, " scenes"]
    """Curvature of circles, 1/m per metre; 0 for the other kinds."""
    echoes: Float[np.ndarray, " scenes"]
    """Number of paths that hear the reflector."""


def covariance_bound(
    jacobian: Float[np.ndarray, "scenes paths parameters"], heard: Bool[np.ndarray, "scenes paths"]
) -> Float[np.ndarray, "scenes parameters parameters"]:
    """Inverse of the Fisher information of ranges with independent errors of variance 1.

    If some direction of the parameters is unobservable, the variances of the parameters that take part in it are
    infinite; the covariances are meaningless then.
    """
    weighted = jacobian * heard[..., None]
    information = np.einsum("spi,spj->sij", weighted, weighted)
    scale = np.sqrt(np.maximum(np.einsum("sii->si", information), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(information / (scale[:, :, None] * scale[:, None, :]))
    observable = values > RANK_TOLERANCE
    inverse = np.where(observable, 1 / np.where(observable, values, 1), 0)
    covariance = np.einsum("sik,sk,sjk->sij", vectors, inverse, vectors) / (scale[:, :, None] * scale[:, None, :])
    touched = (np.where(observable[:, None, :], 0, np.abs(vectors)) > 1e-4).any(axis=-1)
    scene, parameter = np.nonzero(touched | (scale < 1e-12))
    covariance[scene, parameter, parameter] = np.inf
    return covariance


def reflector_bound(
    kind: int,
    paths: ArrayPaths,
    distance: Float[np.ndarray, " scenes"],
    bearing: Float[np.ndarray, " scenes"],
    *,
    radius: float = 1.0,
) -> ReflectorBound:
    """Bounds of one reflector per scene, from the paths that hear it with their nominal cones.

    Args:
        kind: ``kernels.PLANE``, ``CORNER``, ``EDGE`` or ``CIRCLE``.
        paths: the paths that measure.
        distance: of the nearest point of the surface from the array's center, metres.
        bearing: of this point, radians.
        radius: of circles, metres.
    """
    parameters = reflectors_at(kind, distance, bearing, curvature=1 / radius)
    predicted = predicted_ranges(kind, parameters, paths)
    heard, jacobian = is_heard(predicted, paths), predicted.d_range_d_landmark
    if kind in (kernels.CORNER, kernels.EDGE):
        # From (x, y) to distance and bearing.
        outward, across = unit(bearing), unit(bearing + np.pi / 2) * distance[:, None]
        jacobian = jacobian @ np.stack([outward, across], axis=-1)
    echoes = heard.sum(axis=1).astype(np.float64)
    deviation = np.sqrt(np.einsum("sii->si", covariance_bound(jacobian, heard)))
    deviation[echoes == 0] = np.nan
    if kind == kernels.CIRCLE:
        return ReflectorBound(deviation[:, 0], deviation[:, 1], deviation[:, 2], echoes)
    alone = np.sqrt(((jacobian[..., 0] * heard) ** 2).sum(axis=1))
    known_bearing = np.divide(1, alone, out=np.full(len(alone), np.inf), where=alone > 0)
    nearest = np.where(np.isinf(deviation[:, 1]), known_bearing, deviation[:, 0])
    return ReflectorBound(nearest, deviation[:, 1], np.zeros(len(distance)), echoes)
