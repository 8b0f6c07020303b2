"""How ONE echo path hears ONE reflector: exact range, and the directions in which the sound leaves and arrives.

Frames and units as everywhere: robot frame, metres, radians. A reflector is two numbers: a plane (rho, theta), a corner
or an edge (x, y).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .geometry import normal, safe_sqrt, tangent, wrap_angle
from .paths import EchoPaths

_SOFT = 0.08  # of half a cone; where its border is neither inside nor outside


class Sighting(eqx.Module):
    """What one path hears of one reflector."""

    range: Float[Array, "*paths"]
    """Half the path length, metres."""
    departure: Float[Array, "*paths"]
    """Direction in which the sound leaves the transmitter, radians."""
    arrival: Float[Array, "*paths"]
    """Direction in which the receiver looks to where the sound comes from, radians."""
    foot: Float[Array, "*paths"]
    """Plane: where along it the sound is reflected, metres from the foot of the origin; else 0."""
    exists: Bool[Array, "*paths"]
    """Whether the path can exist: both sensors before the plane."""


def plane(line: Float[Array, "2"], path: EchoPaths) -> Sighting:
    """A wall (rho, theta), by the image source."""
    n, t = normal(line[1]), tangent(line[1])
    height, across = line[0] - path.midpoint @ n, path.half_baseline @ t
    before = height > jnp.abs(path.half_baseline @ n)
    level = jnp.where(before, height, 1)
    slant = jnp.arctan2(across, level)
    foot = path.midpoint @ t + across * (path.half_baseline @ n) / level
    return Sighting(jnp.hypot(height, across), line[1] + slant, line[1] - slant, foot, before)


def corner(place: Float[Array, "2"], path: EchoPaths) -> Sighting:
    """A right-angled corner: double reflection, as if the virtual sensor sent and heard, for both sensors alike."""
    reach, bearing = _towards(place - path.midpoint)
    return Sighting(reach, bearing, bearing, jnp.zeros_like(reach), reach > 0)


def edge(place: Float[Array, "2"], path: EchoPaths) -> Sighting:
    """An edge or a thin pole: diffraction, each leg for itself."""
    out, departure = _towards(place - path.midpoint + path.half_baseline)
    back, arrival = _towards(place - path.midpoint - path.half_baseline)
    return Sighting((out + back) / 2, departure, arrival, jnp.zeros_like(out), (out > 0) & (back > 0))


def second_order(first: Float[Array, "2"], second: Float[Array, "2"], path: EchoPaths) -> Sighting:
    """Wall to wall: reflected at one plane, then at another, by the image of the image."""
    tx, rx = path.midpoint - path.half_baseline, path.midpoint + path.half_baseline
    out = _mirrored(_mirrored(rx, second), first) - tx
    back = _mirrored(_mirrored(tx, first), second) - rx
    length, departure = _towards(out)
    exists = (normal(first[1]) @ out > 0) & (normal(second[1]) @ back > 0)
    return Sighting(length / 2, departure, _towards(back)[1], jnp.zeros_like(length), exists)


def heard_share(sighting: Sighting, path: EchoPaths) -> Float[Array, ""]:
    """How far a sighting lies within both cones: 1 inside, 0 outside, with a soft border; 0 where it cannot exist."""
    share = jnp.clip((1 + _SOFT - off_axis(sighting, path)) / (2 * _SOFT), 0, 1)
    return jnp.where(sighting.exists, share * share * (3 - 2 * share), 0)


def off_axis(sighting: Sighting, path: EchoPaths) -> Float[Array, ""]:
    """The larger one of the angles off the axes of transmitter and receiver, in half cones: 1 is the border."""
    directions = jnp.stack([sighting.departure, sighting.arrival])
    return (jnp.abs(wrap_angle(directions - path.heading)) / path.half_beam).max()


def _towards(offset: Float[Array, "2"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Length and direction of a vector, with finite gradients at zero."""
    here = (offset == 0).all()
    return safe_sqrt(offset @ offset), jnp.arctan2(offset[1], jnp.where(here, 1, offset[0]))


def _mirrored(point: Float[Array, "2"], line: Float[Array, "2"]) -> Float[Array, "2"]:
    n = normal(line[1])
    return point + 2 * (line[0] - point @ n) * n
