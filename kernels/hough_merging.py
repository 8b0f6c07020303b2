"""Merging in parameter space: infinite lines through the same accumulator, low pass and components (section 5)."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from . import hough_accumulator as hough
from . import line_centroids as clusters
from .geometry import normal
from .hough_accumulator import HoughSettings


def cells_of_lines(
    rho: Float[Array, "*lines"], theta: Float[Array, "*lines"], settings: HoughSettings
) -> Int[Array, "*lines"]:
    """Flat cell of each line; one past the last for NaN, or a line beyond the accumulator."""
    known = jnp.isfinite(rho)
    row = hough.theta_row(jnp.where(known, theta, 0), settings)
    return hough.cell_of(jnp.where(known, rho, 0), row, known, settings)


@partial(jax.jit, static_argnames="settings")
def occupied_by_lines(
    rho: Float[Array, "clusters lines"], theta: Float[Array, "clusters lines"], *, settings: HoughSettings
) -> Bool[Array, "clusters theta rho"]:
    """Highly occupied cells of each cluster of lines: votes, low pass, threshold.

    Args:
        rho: distances from the cluster's origin, metres, any sign; NaN where there is no line.
        theta: directions of the normals, radians.
        settings: the accumulator; its threshold is a number of lines.
    """

    def one_cluster(lines):
        rho, theta = lines
        votes = hough.accumulate(cells_of_lines(rho, theta, settings), settings)
        return hough.lowpass(votes, settings) > settings.threshold

    return jax.lax.map(one_cluster, (rho, theta))


@partial(jax.jit, static_argnames=("settings", "size"))
def merged_lines(
    rho: Float[Array, "clusters lines"],
    theta: Float[Array, "clusters lines"],
    labels: Int[Array, "clusters theta_and_one rho"],
    *,
    settings: HoughSettings,
    size: int,
) -> tuple[Float[Array, "clusters merged"], Float[Array, "clusters merged"], Int[Array, "clusters lines"]]:
    """Centres of gravity of the components, and the component of each line.

    Args:
        rho: as ``occupied_by_lines``.
        theta: as ``occupied_by_lines``.
        labels: component of each cell, as ``clusters.centres_of_gravity`` takes them; then a row for lines that have
            no cell.
        settings: as ``occupied_by_lines``.
        size: room for this many components a cluster.

    Returns:
        rho (metres) and theta (radians) of the merged lines, and for each line the number of its component, 1 to
        ``size``, or 0 for none.
    """

    def one_cluster(one):
        rho, theta, label = one
        of_line = label.ravel()[cells_of_lines(rho, theta, settings)].astype(jnp.int32)
        rho, n = jnp.where(of_line == 0, 0, rho), normal(jnp.where(of_line == 0, 0, theta))
        count = len(rho)
        points = (rho[:, None], n[:, :1], n[:, 1:], of_line[:, None])
        lines = clusters.centres_of_gravity(*points, jnp.arange(count), clusters=size, echoes=count)
        return lines.rho, lines.theta, jnp.abs(of_line)

    return jax.lax.map(one_cluster, (rho, theta, labels))
