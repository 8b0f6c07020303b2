"""How well ranges tell the kinds of reflectors apart: noise-free distances, and error rates with noise."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar import kernels
from jaxsonar.observability.reflector_fits import residual_squares
from jaxsonar.observability.reflectors import THREE_KINDS, ArrayPaths, is_heard, predicted_ranges, reflectors_at

TIE = 1e-3
"""Log-likelihoods (in units of chi-square) that differ by less are equal: then any of the kinds is chosen."""


def kind_separations(
    paths: ArrayPaths, distance: Float[np.ndarray, " scenes"], bearing: Float[np.ndarray, " scenes"]
) -> dict[tuple[int, int], Float[np.ndarray, " scenes"]]:
    """Norm of the residuals that the best reflector of another kind leaves without noise, metres.

    Divided by the standard deviation of the ranges it is the sensitivity index d' of the two kinds: with equal priors,
    maximum likelihood confuses them with the probability Q(d' / 2).

    Returns:
        For each pair of kinds the smaller norm of the two ways around. 0 where nothing tells them apart; NaN if no path
        hears the reflector.
    """
    norm = {}
    for kind in THREE_KINDS:
        predicted = predicted_ranges(kind, reflectors_at(kind, distance, bearing), paths)
        heard = is_heard(predicted, paths)
        for other in THREE_KINDS:
            if other != kind:
                squares = residual_squares(other, paths, predicted.range, heard, distance, bearing)
                norm[kind, other] = np.where(heard.any(axis=1), np.sqrt(squares), np.nan)
    pairs = [(one, other) for one in THREE_KINDS for other in THREE_KINDS if one < other]
    return {(one, other): np.fmin(norm[one, other], norm[other, one]) for one, other in pairs}


def error_probability(
    true_kind: Sequence[int],
    paths: ArrayPaths,
    ranges: Float[np.ndarray, "scenes paths"],
    heard: Bool[np.ndarray, "scenes paths"],
    distance: Float[np.ndarray, " scenes"],
    bearing: Float[np.ndarray, " scenes"],
    *,
    sigma: float,
    kinds: tuple[int, ...] = THREE_KINDS,
) -> float:
    """Share of the scenes in which maximum likelihood chooses a wrong kind; kinds of equal likelihood share the scene.

    A circle has a parameter more than the other kinds, for which it pays log(echoes) of chi-square (BIC).

    Args:
        true_kind: kind of each scene.
        paths: the paths that measure.
        ranges: measured half path lengths, metres.
        heard: which of them exist.
        distance: true distance of the surface, metres.
        bearing: its bearing, radians.
        sigma: standard deviation of the ranges, metres.
        kinds: kinds to choose from.
    """
    some = heard.any(axis=1)
    if not some.any():
        return float("nan")
    audible = np.asarray(heard.any(axis=0))
    paths, ranges, heard = paths.selected(audible), ranges[:, audible], heard[:, audible]
    score = np.stack(
        [residual_squares(kind, paths, ranges, heard, distance, bearing) / sigma**2 for kind in kinds], axis=-1
    )
    echoes = np.maximum(heard.sum(axis=1), 1)
    score += np.array([kind == kernels.CIRCLE for kind in kinds]) * np.log(echoes)[:, None]
    best = score < score.min(axis=1, keepdims=True) + TIE
    right = best & (np.array(kinds) == np.array(true_kind)[:, None])
    return float((1 - right.any(axis=1) / best.sum(axis=1))[some].mean())
