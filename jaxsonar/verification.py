"""Which candidate lines of a gathered window are walls: those whose ranges a plane explains better than a point does.

Where few sensors look around, a post or a corner answers from every pose of the window, and its arcs cross in one
place; the Hough step takes the tangent there for a line. The fit of both models to the ranges decides.
"""

from collections.abc import Callable, Iterator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels

from .candidates import Candidate, Extracted, arcs_of
from .echoes import room_for
from .ring import Ring
from .windows import Windows

TOLERANCE = 0.03
"""Metres; how far a range may be from what a reflector explains: steps of 10 mm, readings 0.2 s late, odometry."""
BETTER = 4 / 3
"""A plane must explain this many times what a point explains, or nothing is decided."""
MIN_ECHOES = 4
"""Echoes of a wall: two determine it, and the third could still lie on it by chance."""
MIN_EXTENT = 0.2
"""Metres along the wall that they must cover: less determines no direction."""


def verified(
    ring: Ring, windows: Windows, extracted: Extracted, settings: kernels.HoughSettings
) -> Callable[[int], Iterator[Candidate]]:
    """The walls of each window of a step, as ``Extracted.of_scan`` gives candidates.

    Candidates are taken in the order of how much a plane explains; every echo is explained once. A wall that was not
    heard over more than ``windows.gap`` of its length (a door) is two.
    """
    step, lines = extracted.step, extracted.lines
    size = room_for(lines.rho.shape[1], least=16)
    shape = (len(step.path), size)
    rho, theta = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
    rows, columns = lines.rho.shape
    rho[:rows, :columns], theta[:rows, :columns] = lines.rho, lines.theta
    fits = kernels.fit_candidates(
        arcs_of(ring, settings), step.packed, jnp.asarray(rho), jnp.asarray(theta), tolerance=TOLERANCE
    )
    plane, point = np.asarray(fits.plane_score), np.asarray(fits.point_score)
    rho, theta, foot = (np.asarray(values) for values in (fits.rho, fits.theta, fits.foot))
    good = np.asarray(fits.explained) & (plane > BETTER * point)[..., None]  # False where there is no candidate

    def walls(row: int) -> Iterator[Candidate]:
        free = np.ones(good.shape[2], dtype=bool)
        for k in np.argsort(-plane[row, :columns], kind="stable"):
            for echoes in _stretches(good[row, k] & free, foot[row, k], windows.gap):
                free[echoes] = False
                ends = foot[row, k, echoes[[0, -1]]]
                yield Candidate(
                    rho=float(rho[row, k]),
                    theta=float(theta[row, k]),
                    segment=_segment(float(rho[row, k]), float(theta[row, k]), ends),
                    votes=int(lines.votes[row, k]),
                    echoes=np.sort(echoes),
                )

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
