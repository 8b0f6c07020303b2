"""Centre of gravity of lines by the components of their cells, and the extent of a line (paper, section 5)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .geometry import fold_line, normal, tangent


class Clusters(eqx.Module):
    """Lines in the order of the labels of their components; unused places hold no echo and NaN."""

    rho: Float[Array, "*scans clusters"]
    """Distance from the robot's origin, metres, >= 0."""
    theta: Float[Array, "*scans clusters"]
    """Direction of the normal in the robot frame, radians, in [-pi, pi)."""
    votes: Int[Array, "*scans clusters"]
    """Number of points in the component."""
    involved: Bool[Array, "*scans clusters echoes"]
    """Which echoes have a point in the component."""


def centres_of_gravity(
    rho: Float[Array, "arcs points"],
    normal_x: Float[Array, "arcs points"],
    normal_y: Float[Array, "arcs points"],
    label: Int[Array, "arcs points"],
    owner: Int[Array, " arcs"],
    *,
    clusters: int,
    echoes: int,
) -> Clusters:
    """Centre of gravity of the POINTS of each component (paper, section 4), the mean of theta taken on the circle.

    Args:
        rho: distances of the voting lines, metres, any sign: (rho, n) and (-rho, -n) are one line.
        normal_x: cosines of their normals.
        normal_y: sines of their normals.
        label: component of the cell that each point fell into: 0 for none, k or -k for component k. Minus marks cells
            that joined across rho = 0: their points enter as the same lines seen from the other side, so that a
            component around rho = 0 has one centre.
        owner: echo that each arc, or piece of one, belongs to.
        clusters: how many components the result has room for.
        echoes: number of echoes.
    """
    flip = jnp.where(rho < 0, -1, 1) * jnp.sign(label)  # 0 for the points in no component
    flip = flip.astype(rho.dtype)
    member = jnp.abs(label)
    counts = _counted(owner[:, None] * (clusters + 1) + member, (clusters + 1) * echoes).reshape(echoes, -1)[:, 1:]
    involved, votes = (counts > 0).T, counts.sum(axis=0)
    sums = _summed(member, jnp.stack([flip * rho, flip * normal_x, flip * normal_y]), clusters + 1)[:, 1:]
    empty = votes == 0
    count = jnp.where(empty, 1, votes).astype(rho.dtype)
    nowhere = (sums[1] == 0) & (sums[2] == 0)
    east = jnp.where(nowhere, 1, sums[1])  # atan2(0, 0) has no gradient
    mean_rho, mean_theta = fold_line(sums[0] / count, jnp.arctan2(sums[2], east))
    return Clusters(
        rho=jnp.where(empty, jnp.nan, mean_rho),
        theta=jnp.where(empty, jnp.nan, mean_theta),
        votes=votes,
        involved=involved,
    )


def _counted(index: Int[Array, "arcs points"], size: int) -> Int[Array, " size"]:
    return jnp.zeros(size, jnp.int32).at[index.ravel()].add(1, mode="promise_in_bounds")


def _summed(member: Int[Array, "arcs points"], values: Float[Array, "columns arcs points"], size: int):
    """Sums over the points of each component, (columns, size): one after the other on a CPU, else without atomics."""

    def scattered(member, values):
        one = jnp.zeros(size, values.dtype)
        return jax.vmap(lambda column: one.at[member].add(column, mode="promise_in_bounds"))(values)

    def multiplied(member, values):
        own = member[None] == jnp.arange(size)[:, None]
        return jnp.where(own[None], values[:, None], 0).sum(axis=-1)

    flat = member.ravel(), values.reshape(len(values), -1)
    return jax.lax.platform_dependent(*flat, cpu=scattered, default=multiplied)


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
