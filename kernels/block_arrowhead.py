"""Normal equations of a chain of poses that all hang on shared unknowns: a block arrow, linear in the poses.

The poses are eliminated one after the other (Schur complement of a block tridiagonal matrix). What a pose leaves of the
shared block is kept as three rows and added up at the end, in one product of matrices: the shared block itself, which
is dense and wide where many reflectors are shared, is touched once, not once a pose.

With P poses and S shared unknowns: time P S^2, and room for P 3 S numbers, twice.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Arrow(NamedTuple):
    """Normal equations H x = g, taken apart: shared unknowns, poses, and poses with their next ones."""

    shared: Float[Array, "shared shared"]
    shared_g: Float[Array, " shared"]
    cross: Float[Array, "poses 3 shared"]
    """H of each pose (rows) and the shared unknowns."""
    pose: Float[Array, "poses 3 3"]
    pose_g: Float[Array, "poses 3"]
    next: Float[Array, "poses 3 3"]
    """H of each pose (rows) and the next one; 0 for the last."""


class Eliminated(NamedTuple):
    """The equations of the shared unknowns alone, and what it takes to come back to the poses.

    Given the shared unknowns s and the next pose: x = inverse (right_g - right s - next x_next).
    """

    shared: Float[Array, "shared shared"]
    shared_g: Float[Array, " shared"]
    inverse: Float[Array, "poses 3 3"]
    right: Float[Array, "poses 3 shared"]
    right_g: Float[Array, "poses 3"]


def eliminated(arrow: Arrow, damping: Float[Array, ""]) -> Eliminated:
    """Without the poses; the diagonal raised by a share (Levenberg and Marquardt)."""
    pose = _damped(arrow.pose, damping)

    def eliminate(carry, one):
        last, last_right, link = carry
        cross, pose, pose_g, following = one
        # What the pose before leaves of this one: link is H(before, this), last the inverse of the block before.
        into = link.T @ last
        inverse = jnp.linalg.inv(pose - into @ link)
        right = jnp.concatenate([cross, pose_g[:, None]], axis=1) - into @ last_right
        return (inverse, right, following), (inverse, right)

    nothing = jnp.zeros((3, 3), pose.dtype)
    start = (nothing, jnp.zeros((3, arrow.shared.shape[0] + 1), pose.dtype), nothing)
    _, (inverse, right) = jax.lax.scan(eliminate, start, (arrow.cross, pose, arrow.pose_g, arrow.next))
    whole = right.reshape(-1, right.shape[-1])
    folded = whole[:, :-1].T @ (inverse @ right).reshape(whole.shape)
    return Eliminated(
        shared=_damped(arrow.shared, damping) - folded[:, :-1],
        shared_g=arrow.shared_g - folded[:, -1],
        inverse=inverse,
        right=right[..., :-1],
        right_g=right[..., -1],
    )


def solved(arrow: Arrow, damping: Float[Array, ""]) -> tuple[Float[Array, " shared"], Float[Array, "poses 3"]]:
    """Shared unknowns and poses."""
    rest = eliminated(arrow, damping)
    shared = jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(rest.shared), rest.shared_g)

    def substitute(later, one):
        inverse, side, following = one
        here = inverse @ (side - following @ later)
        return here, here

    sides = rest.right_g - rest.right @ shared
    back = (rest.inverse, sides, arrow.next)
    _, poses = jax.lax.scan(substitute, jnp.zeros(3, shared.dtype), back, reverse=True)
    return shared, poses


def covariances(arrow: Arrow) -> tuple[Float[Array, "shared shared"], Float[Array, "poses 3 3"]]:
    """Of the shared unknowns, and of each pose by itself: blocks of the inverse of the whole matrix."""
    rest = eliminated(arrow, jnp.zeros((), arrow.shared.dtype))
    shared = jnp.linalg.inv(rest.shared)
    # right s of every pose: its covariance with s, in one product, and with itself.
    with_shared = rest.right @ shared
    alone = jnp.einsum("pis,pjs->pij", with_shared, rest.right)

    def substitute(carry, one):
        # Covariances of the next pose: its own, and with s. All that is left open by both is this pose's inverse.
        later, later_shared = carry
        inverse, right, with_shared, alone, following = one
        mixed = following @ later_shared @ right.T
        inside = alone + mixed + mixed.T + following @ later @ following.T
        here = inverse + inverse @ inside @ inverse
        here_shared = -inverse @ (with_shared + following @ later_shared)
        return (here, here_shared), here

    start = (jnp.zeros((3, 3), shared.dtype), jnp.zeros((3, shared.shape[0]), shared.dtype))
    back = (rest.inverse, rest.right, with_shared, alone, arrow.next)
    _, poses = jax.lax.scan(substitute, start, back, reverse=True)
    return shared, (poses + jnp.swapaxes(poses, -1, -2)) / 2


def _damped(matrices: Float[Array, "*many n n"], damping: Float[Array, ""]) -> Float[Array, "*many n n"]:
    unit = jnp.broadcast_to(jnp.eye(matrices.shape[-1], dtype=matrices.dtype), matrices.shape)
    return matrices + damping * unit * matrices
