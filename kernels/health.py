"""What every path of a ring should hear of what stands around it, and under which angles; for the health report."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from . import measurement_model as reflectors
from .array_geometry import EchoPaths
from .ml_detection import CORNER, PLANE


class Outlook(eqx.Module):
    """What paths should hear of reflectors; of a batch with leading axes (scans, reflectors, paths)."""

    range: Float[Array, "*looks"]
    """Half the path length, metres."""
    slope: Float[Array, "*looks 2"]
    """Its derivatives by the reflector's two parameters."""
    angle: Float[Array, "*looks"]
    """Direction in which the sound leaves, from the axis of the transmitter, radians, counter-clockwise."""
    foot: Float[Array, "*looks"]
    """Planes: where along them the sound is reflected, metres from the foot of the origin; else 0."""
    share: Float[Array, "*looks"]
    """How far it lies within both cones: 1 inside, 0 outside or where there is no such reflector."""
    exists: Bool[Array, "*looks"]
    """Whether the path can exist, whatever the cones: both sensors before a plane."""


@jax.jit
def outlook(
    paths: EchoPaths, kind: Int[Array, "scans reflectors"], parameters: Float[Array, "scans reflectors 2"]
) -> Outlook:
    """What each path should hear of each reflector of a batch of scans.

    Args:
        paths: of the ring.
        kind: PLANE, CORNER or EDGE; -1 none.
        parameters: (rho, theta) of planes, (x, y) of corners and edges; robot frame, metres, radians.
    """

    def one(kind: Int[Array, ""], x: Float[Array, "2"], path: EchoPaths) -> Outlook:
        plane, corner, edge = (model(x, path) for model in (reflectors.plane, reflectors.corner, reflectors.edge))
        seen = jax.tree.map(
            lambda *leaf: jnp.where(kind == PLANE, leaf[0], jnp.where(kind == CORNER, leaf[1], leaf[2])),
            plane,
            corner,
            edge,
        )
        axis, towards = path.axes[0], seen.departure
        angle = jnp.arctan2(axis[0] * towards[1] - axis[1] * towards[0], axis @ towards)
        share = jnp.where(kind >= 0, reflectors.heard_share(seen, path), 0)
        return Outlook(seen.range, seen.slope, angle, seen.foot, share, seen.exists & (kind >= 0))

    by_path = jax.vmap(one, in_axes=(None, None, 0))
    return jax.vmap(jax.vmap(by_path, in_axes=(0, 0, None)), in_axes=(0, 0, None))(kind, parameters, paths)
