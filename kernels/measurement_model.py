"""How ONE echo path hears ONE reflector: exact range, and the directions in which the sound leaves and arrives.

Frames and units as everywhere: robot frame, metres, radians. A reflector is two numbers: a plane (rho, theta), a corner
or an edge (x, y).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .array_geometry import EchoPaths
from .geometry import dot, mirrored, normal, tangent, towards

_SOFT = 0.08  # of the chord of half a cone; where its border is neither inside nor outside


class Sighting(eqx.Module):
    """What one path hears of one reflector."""

    range: Float[Array, "*paths"]
    """Half the path length, metres."""
    slope: Float[Array, "*paths 2"]
    """Its derivatives by the reflector's two parameters; 0 for second order."""
    departure: Float[Array, "*paths 2"]
    """Unit vector along which the sound leaves the transmitter."""
    arrival: Float[Array, "*paths 2"]
    """Unit vector from the receiver to where the sound comes from."""
    foot: Float[Array, "*paths"]
    """Plane: where along it the sound is reflected, metres from the foot of the origin; else 0."""
    exists: Bool[Array, "*paths"]
    """Whether the path can exist: both sensors before the plane."""


def plane(line: Float[Array, "2"], path: EchoPaths) -> Sighting:
    """A wall (rho, theta), by the image source."""
    n, t = normal(line[1]), tangent(line[1])
    height, across = line[0] - dot(path.midpoint, n), dot(path.half_baseline, t)
    lean, beside = dot(path.half_baseline, n), dot(path.midpoint, t)
    before = height > jnp.abs(lean)
    height = jnp.where(before, height, 1)
    reach = jnp.sqrt(height * height + across * across)
    upright, along = height / reach, across / reach
    return Sighting(
        range=reach,
        slope=jnp.stack([upright, -(upright * beside + along * lean)]),
        departure=upright * n + along * t,
        arrival=upright * n - along * t,
        foot=beside + across * lean / height,
        exists=before,
    )


def corner(place: Float[Array, "2"], path: EchoPaths) -> Sighting:
    """A right-angled corner: double reflection, as if the virtual sensor sent and heard, for both sensors alike."""
    reach, direction = towards(place - path.midpoint)
    return Sighting(reach, direction, direction, direction, jnp.zeros_like(reach), reach > 0)


def edge(place: Float[Array, "2"], path: EchoPaths) -> Sighting:
    """An edge or a thin pole: diffraction, each leg for itself."""
    out, departure = towards(place - path.midpoint + path.half_baseline)
    back, arrival = towards(place - path.midpoint - path.half_baseline)
    slope = (departure + arrival) / 2
    return Sighting((out + back) / 2, slope, departure, arrival, jnp.zeros_like(out), (out > 0) & (back > 0))


def second_order(first: Float[Array, "2"], second: Float[Array, "2"], path: EchoPaths) -> Sighting:
    """Wall to wall: reflected at one plane, then at another, by the image of the image."""
    tx, rx = path.midpoint - path.half_baseline, path.midpoint + path.half_baseline
    behind_first, behind_second = mirrored(tx, first), mirrored(rx, second)
    way, departure = towards(mirrored(behind_second, first) - tx)
    _, arrival = towards(mirrored(behind_first, second) - rx)
    # From behind the first to behind the second, before each other's plane, and through the first one first.
    start, end = _before(tx, first), _before(rx, second)
    last, next_ = _before(behind_second, first), _before(behind_first, second)
    exists = (jnp.minimum(jnp.minimum(start, end), jnp.minimum(last, next_)) > 0) & (start * end < next_ * last)
    return Sighting(way / 2, jnp.zeros(2, way.dtype), departure, arrival, jnp.zeros_like(way), exists)


def heard_share(sighting: Sighting, path: EchoPaths) -> Float[Array, ""]:
    """How far a sighting lies within both cones: 1 inside, 0 outside, with a soft border; 0 where it cannot exist."""
    share = jnp.clip(((1 + _SOFT) ** 2 - off_axis(sighting, path)) / (4 * _SOFT), 0, 1)
    return jnp.where(sighting.exists, share * share * (3 - 2 * share), 0)


def off_axis(sighting: Sighting, path: EchoPaths) -> Float[Array, ""]:
    """How far off the axes, the larger one of transmitter and receiver: 0 on the axis, 1 at the border, rising."""
    out, back = sighting.departure - path.axes[0], sighting.arrival - path.axes[1]
    return jnp.maximum(dot(out, out) / path.cone[0], dot(back, back) / path.cone[1])


def _before(point: Float[Array, "2"], line: Float[Array, "2"]) -> Float[Array, ""]:
    return line[0] - dot(point, normal(line[1]))
