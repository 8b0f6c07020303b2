"""Vectors, rotations, rigid motions and lines in the plane, for ONE vector, ONE pose or ONE line; vmap for batches.

A line is (rho, theta): the points p with normal(theta) . p = rho. In canonical form rho >= 0 and theta is in [-pi, pi).
A pose is (x, y, theta), metres and radians. All functions have finite gradients everywhere.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def wrap_angle(angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Return the equivalent angle in [-pi, pi), radians."""
    wrapped = angle - 2 * jnp.pi * jnp.floor((angle + jnp.pi) / (2 * jnp.pi))  # many times faster than a modulo
    return jnp.where(jnp.abs(wrapped) < jnp.pi, wrapped, -jnp.pi)  # rounding may reach the open end or exceed it


def normal(theta: Float[Array, "*batch"]) -> Float[Array, "*batch 2"]:
    """Unit normal (cos theta, sin theta) of a line; also the unit vector in direction theta."""
    return jnp.stack([jnp.cos(theta), jnp.sin(theta)], axis=-1)


def tangent(theta: Float[Array, "*batch"]) -> Float[Array, "*batch 2"]:
    """Unit tangent (-sin theta, cos theta) of a line: its normal rotated by 90 degrees counter-clockwise."""
    return jnp.stack([-jnp.sin(theta), jnp.cos(theta)], axis=-1)


def dot(a: Float[Array, "2"], b: Float[Array, "2"]) -> Float[Array, ""]:
    """Inner product of two vectors, written out: XLA fuses scalar operations, but calls a library for dot products."""
    return a[0] * b[0] + a[1] * b[1]


def signed_angle(a: Float[Array, "2"], b: Float[Array, "2"]) -> Float[Array, ""]:
    """Angle from vector a to vector b, counter-clockwise, in [-pi, pi], radians."""
    return jnp.arctan2(a[0] * b[1] - a[1] * b[0], dot(a, b))


def length(vector: Float[Array, "2"]) -> Float[Array, ""]:
    """Euclidean length of a vector, with gradient 0 at zero."""
    return safe_sqrt(dot(vector, vector))


def length_and_direction(vector: Float[Array, "2"]) -> tuple[Float[Array, ""], Float[Array, "2"]]:
    """Length of a vector and the unit vector along it, with finite gradients at zero (where the direction is zero)."""
    distance = length(vector)
    return distance, vector / jnp.where(distance > 0, distance, 1)


def rotate(vector: Float[Array, "2"], angle: Float[Array, ""]) -> Float[Array, "2"]:
    """Rotate a vector by an angle, counter-clockwise: from the frame of a pose to its parent frame."""
    return vector[0] * normal(angle) + vector[1] * tangent(angle)


def rotate_back(vector: Float[Array, "2"], angle: Float[Array, ""]) -> Float[Array, "2"]:
    """Rotate a vector by minus an angle: from the parent frame of a pose to its own frame."""
    return jnp.stack([dot(normal(angle), vector), dot(tangent(angle), vector)])


def fold_line(
    rho: Float[Array, "*batch"], theta: Float[Array, "*batch"]
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Canonical form of a line: rho >= 0, theta in [-pi, pi). (rho, theta) and (-rho, theta + pi) are the same line."""
    negative = rho < 0
    return jnp.where(negative, -rho, rho), wrap_angle(jnp.where(negative, theta + jnp.pi, theta))


def segment_endpoints(
    rho: Float[Array, ""],
    theta: Float[Array, ""],
    sensors: Float[Array, "echoes 2"],
    involved: Bool[Array, " echoes"],
) -> Float[Array, "2 2"]:
    """Endpoints of ONE line: the outermost footpoints of its involved sensors (paper, section 5).

    Args:
        rho: distance of the line, metres.
        theta: direction of its normal, radians.
        sensors: real or virtual sensor of each echo, robot frame, metres.
        involved: which echoes contributed; without any the endpoints are NaN.

    Returns:
        Two endpoints in the robot frame, metres, the second one counter-clockwise from the first as seen from the
        origin.
    """
    footpoint = sensors @ tangent(theta)
    first = jnp.where(involved, footpoint, jnp.inf).min()
    last = jnp.where(involved, footpoint, -jnp.inf).max()
    endpoints = (rho * normal(theta))[None] + jnp.outer(jnp.stack([first, last]), tangent(theta))
    return jnp.where(involved.any(), endpoints, jnp.nan)


def mirror_point(point: Float[Array, "2"], line: Float[Array, "2"]) -> Float[Array, "2"]:
    """Mirror image of a point at a line (rho, theta): the position of its image source, metres."""
    n = normal(line[1])
    return point + 2 * (line[0] - dot(point, n)) * n


def safe_sqrt(x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Square root for positive x; 0 with gradient 0 otherwise."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)
