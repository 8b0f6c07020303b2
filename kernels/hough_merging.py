"""Votes of infinite lines, for merging in parameter space (paper, section 5)."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from . import hough_accumulator as hough
from .hough_accumulator import HoughSettings


@partial(jax.jit, static_argnames="settings")
def vote_lines(
    rho: Float[Array, "clusters lines"], theta: Float[Array, "clusters lines"], *, settings: HoughSettings
) -> tuple[Bool[Array, "clusters theta rho"], Int[Array, "clusters lines"]]:
    """Highly occupied cells of each cluster of lines: votes, low pass, threshold.

    Args:
        rho: distances from the cluster's origin, metres, any sign; NaN where there is no line.
        theta: directions of the normals, radians.
        settings: the accumulator; its threshold is a number of lines.

    Returns:
        The highly occupied cells, and the flat cell of each line: one past the last cell for NaN and for lines beyond
        the accumulator.
    """

    def one_cluster(lines: tuple[Array, Array]) -> tuple[Array, Array]:
        rho, theta = lines
        known = jnp.isfinite(rho)
        row = hough.theta_row(jnp.where(known, theta, 0), settings)
        cell = hough.cell_of(jnp.where(known, rho, 0), row, known, settings)
        votes = hough.accumulate(cell, settings)
        return hough.lowpass(votes, settings) > settings.threshold, cell

    return jax.lax.map(one_cluster, (rho, theta))
