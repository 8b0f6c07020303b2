"""Lines, points and path lengths in the plane, for ONE line, ONE point, ONE pair of sensors.

A line is (rho, theta): the points p with normal(theta) . p = rho, with rho >= 0 and theta in [-pi, pi). A range is half
the length of the path transmitter -> reflector -> receiver.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def wrap_angle(angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The same direction in [-pi, pi), radians."""
    wrapped = angle - 2 * jnp.pi * jnp.floor((angle + jnp.pi) / (2 * jnp.pi))  # many times faster than a modulo
    return jnp.where(jnp.abs(wrapped) < jnp.pi, wrapped, -jnp.pi)  # rounding may land on the open end, or beyond


def normal(theta: Float[Array, "*batch"]) -> Float[Array, "*batch 2"]:
    """Unit normal (cos theta, sin theta) of a line."""
    return jnp.stack([jnp.cos(theta), jnp.sin(theta)], axis=-1)


def tangent(theta: Float[Array, "*batch"]) -> Float[Array, "*batch 2"]:
    """Unit tangent of a line: its normal turned a quarter counter-clockwise."""
    return jnp.stack([-jnp.sin(theta), jnp.cos(theta)], axis=-1)


def dot(a: Float[Array, "2"], b: Float[Array, "2"]) -> Float[Array, ""]:
    """Inner product of two vectors; written out, because compilers make loops of single operations of it, not calls."""
    return a[0] * b[0] + a[1] * b[1]


def length(vector: Float[Array, "2"]) -> Float[Array, ""]:
    """Length of a vector, with a finite gradient at zero."""
    return safe_sqrt(dot(vector, vector))


def towards(offset: Float[Array, "2"]) -> tuple[Float[Array, ""], Float[Array, "2"]]:
    """Length and direction of a vector, with finite gradients at zero."""
    way = length(offset)
    return way, offset / jnp.where(way > 0, way, 1)


def fold_line(
    rho: Float[Array, "*batch"], theta: Float[Array, "*batch"]
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """The same line with rho >= 0 and theta in [-pi, pi): (rho, theta) and (-rho, theta + pi) are one line."""
    behind = rho < 0
    return jnp.where(behind, -rho, rho), wrap_angle(jnp.where(behind, theta + jnp.pi, theta))


def safe_sqrt(x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Square root, and 0 with gradient 0 where x is not positive."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def plane_range(
    rho: Float[Array, ""], theta: Float[Array, ""], tx: Float[Array, "2"], rx: Float[Array, "2"]
) -> Float[Array, ""]:
    """Range in metres of the echo of a wall, by the image source: exact for direct and cross echoes.

    Args:
        rho: distance of the wall's line from the origin, metres.
        theta: direction of its normal, radians.
        tx: position of the transmitter, metres.
        rx: position of the receiver, metres, on the same side of the wall.
    """
    midpoint, half_baseline = (tx + rx) / 2, (rx - tx) / 2
    height, across = rho - dot(midpoint, normal(theta)), dot(half_baseline, tangent(theta))
    return safe_sqrt(height * height + across * across)


def point_range(corner: Float[Array, "2"], tx: Float[Array, "2"], rx: Float[Array, "2"]) -> Float[Array, ""]:
    """Range in metres of the double reflection in a right-angled corner: its distance from the virtual sensor."""
    return length(corner - (tx + rx) / 2)


def edge_range(edge: Float[Array, "2"], tx: Float[Array, "2"], rx: Float[Array, "2"]) -> Float[Array, ""]:
    """Range in metres of the diffraction at an edge or a thin pole: half the way to it and on to the receiver."""
    return (length(edge - tx) + length(edge - rx)) / 2


def mirrored(point: Float[Array, "2"], line: Float[Array, "2"]) -> Float[Array, "2"]:
    """A point's image behind a line (rho, theta), metres: where its sound seems to come from."""
    n = normal(line[1])
    return point + 2 * (line[0] - dot(point, n)) * n
