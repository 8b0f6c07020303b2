"""Which candidate lines of a gathered window are walls: those whose ranges a plane explains better than a point does.

Where few sensors look around, a post or a corner answers from every pose of the window, and its arcs cross in one
place; the Hough step takes the tangent there for a line. The fit of both models to the ranges decides.
"""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.detection.hough_detector import Candidate, Extracted, arcs_of
from jaxsonar.kernels.shape_buckets import bucket_size
from jaxsonar.sensors.ring import Ring

TOLERANCE = 0.03
"""Metres; how far a range may be from what a reflector explains: steps of 10 mm, readings 0.2 s late, odometry."""
BETTER = 4 / 3
"""A plane must explain this many times what a point explains, or nothing is decided."""
MIN_ECHOES = 4
"""Echoes of a wall: two determine it, and the third could still lie on it by chance."""
MIN_EXTENT = 0.2
"""Metres along the wall that they must cover: less determines no direction."""


def verified(ring: Ring, extracted: Extracted, settings: kernels.HoughSettings, *, gap: float) -> list[list[Candidate]]:
    """The walls of each window of a step.

    Candidates are taken in the order of how much a plane explains; every echo is explained once.

    Args:
        ring: the sensors.
        extracted: candidates.
        settings: that they were found with.
        gap: a wall that was not heard over more than this much of its length is two, metres.
    """
    step, lines = extracted.step, extracted.lines
    rows, columns = lines.rho.shape
    candidates = np.full((2, len(step.path), bucket_size(columns, least=16)), np.nan, np.float32)
    candidates[:, :rows, :columns] = lines.rho, lines.theta
    rho, theta = (jnp.asarray(values) for values in candidates)
    fits = kernels.fit_candidates(arcs_of(ring, settings), step.packed, rho, theta, tolerance=TOLERANCE)
    plane, point = np.asarray(fits.plane_score), np.asarray(fits.point_score)
    rho, theta, foot = (np.asarray(values) for values in (fits.rho, fits.theta, fits.foot))
    good = np.asarray(fits.explained) & (plane > BETTER * point)[..., None]  # False where there is no candidate
    walls: list[list[Candidate]] = [[] for _ in range(rows)]
    free = np.ones((rows, good.shape[2]), dtype=bool)
    for row in range(rows):
        for k in np.argsort(-plane[row, :columns], kind="stable"):
            for echoes in _stretches(good[row, k] & free[row], foot[row, k], gap):
                free[row, echoes] = False
                ends = foot[row, k, echoes[[0, -1]]]
                line = float(rho[row, k]), float(theta[row, k])
                walls[row].append(Candidate(*line, _segment(*line, ends), int(lines.votes[row, k]), np.sort(echoes)))
    return walls


def _stretches(
    mine: Bool[np.ndarray, " echoes"], foot: Float[np.ndarray, " echoes"], gap: float
) -> Iterator[Int[np.ndarray, " some"]]:
    """Echoes of every part of a wall that was heard without a gap, in the order of their feet."""
    echoes = np.flatnonzero(mine)
    echoes = echoes[np.argsort(foot[echoes], kind="stable")]
    for part in np.split(echoes, np.flatnonzero(np.diff(foot[echoes]) > gap) + 1):
        if len(part) >= MIN_ECHOES and foot[part[-1]] - foot[part[0]] >= MIN_EXTENT:
            yield part


def _segment(rho: float, theta: float, ends: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2 2"]:
    normal = np.array([np.cos(theta), np.sin(theta)])
    return rho * normal + np.outer(ends, [-normal[1], normal[0]])
