"""From labelled cells back to the points in them: centre of gravity, involved echoes, extent (paper, sections 4, 5)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .geometry import fold_line, normal, tangent


class Clusters(eqx.Module):
    """Extracted straight lines of ONE scan, in the order of their labels; unused places hold no echo and NaN."""

    rho: Float[Array, "*scans clusters"]
    """Distance from the robot's origin, metres, >= 0."""
    theta: Float[Array, "*scans clusters"]
    """Direction of the normal in the robot frame, radians, in [-pi, pi)."""
    votes: Int[Array, "*scans clusters"]
    """Number of points in the component."""
    involved: Bool[Array, "*scans clusters echoes"]
    """Which echoes have a point in the component."""


def centres_of_gravity(
    rho: Float[Array, "echoes points"],
    normal_x: Float[Array, "echoes points"],
    normal_y: Float[Array, "echoes points"],
    label: Int[Array, "echoes points"],
    *,
    clusters: int,
) -> Clusters:
    """Centre of gravity of the POINTS of each component (paper, section 4), the mean of theta taken on the circle.

    Args:
        rho: distances of the voting lines, metres, any sign: (rho, n) and (-rho, -n) are one line.
        normal_x: cosines of their normals.
        normal_y: sines of their normals.
        label: component of the cell that each point fell into: 0 for none, k or -k for component k. Minus marks cells
            that joined across rho = 0: their points enter as the same lines seen from the other side, so that a
            component around rho = 0 has one centre.
        clusters: how many components the result has room for.
    """
    flip = jnp.where(rho < 0, -1, 1) * jnp.sign(label)  # 0 for the points in no component
    flip = flip.astype(rho.dtype)
    moments = jnp.stack([jnp.abs(flip), flip * rho, flip * normal_x, flip * normal_y], axis=-1)
    per_echo = jax.vmap(lambda member, values: jnp.zeros((clusters + 1, 4), rho.dtype).at[member].add(values))
    of_echo = per_echo(jnp.abs(label), moments)[:, 1:]
    involved = (of_echo[..., 0] > 0).T
    sums = of_echo.sum(axis=0)
    votes = sums[:, 0].astype(jnp.int32)  # exact: far below 2**24 points
    sums, empty = sums[:, 1:], votes == 0
    count = jnp.where(empty, 1, votes).astype(rho.dtype)
    nowhere = (sums[:, 1] == 0) & (sums[:, 2] == 0)
    east = jnp.where(nowhere, 1, sums[:, 1])  # atan2(0, 0) has no gradient
    mean_rho, mean_theta = fold_line(sums[:, 0] / count, jnp.arctan2(sums[:, 2], east))
    return Clusters(
        rho=jnp.where(empty, jnp.nan, mean_rho),
        theta=jnp.where(empty, jnp.nan, mean_theta),
        votes=votes,
        involved=involved,
    )


def extent(
    rho: Float[Array, ""],
    theta: Float[Array, ""],
    sensors: Float[Array, "echoes 2"],
    involved: Bool[Array, " echoes"],
) -> Float[Array, "2 2"]:
    """Endpoints of ONE line: the outermost feet of the perpendiculars from its involved sensors (paper, section 5).

    Args:
        rho: distance of the line, metres.
        theta: direction of its normal, radians.
        sensors: real or virtual sensor of each echo, robot frame, metres.
        involved: which echoes contributed; without any the endpoints are NaN.

    Returns:
        Two endpoints in the robot frame, metres, the second one counter-clockwise from the first as seen from the
        origin.
    """
    foot = sensors @ tangent(theta)
    first = jnp.where(involved, foot, jnp.inf).min()
    last = jnp.where(involved, foot, -jnp.inf).max()
    ends = (rho * normal(theta))[None] + jnp.outer(jnp.stack([first, last]), tangent(theta))
    return jnp.where(involved.any(), ends, jnp.nan)
