"""Extent of a line from the sensors that observe it (paper, section 5)."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .geometry import normal, tangent


def segment_endpoints(
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
