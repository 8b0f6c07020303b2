"""Planar poses (x, y, theta): metres, radians counter-clockwise, world_from_robot."""

import numpy as np
from jaxtyping import Float


def wrap_angle(angle: Float[np.ndarray, "*batch"] | float) -> Float[np.ndarray, "*batch"]:
    """The same directions in [-pi, pi), radians."""
    wrapped = (angle + np.pi) % (2 * np.pi) - np.pi
    return np.where(wrapped >= np.pi, -np.pi, wrapped)  # the modulo may round up to pi


def unit(angle: Float[np.ndarray, "*batch"] | float) -> Float[np.ndarray, "*batch 2"]:
    """Unit vectors in these directions, radians."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def rotation(theta: float) -> Float[np.ndarray, "2 2"]:
    """Matrix that turns counter-clockwise by theta radians."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s], [s, c]])


def to_world(pose: Float[np.ndarray, "3"], points: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """Points of the robot frame in the world frame, metres."""
    return points @ rotation(pose[2]).T + pose[:2]


def relative(
    world_from_a: Float[np.ndarray, "*batch 3"], world_from_b: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """a_from_b: the poses b as seen from the poses a."""
    offset = world_from_b[..., :2] - world_from_a[..., :2]
    c, s = np.cos(world_from_a[..., 2]), np.sin(world_from_a[..., 2])
    x, y = c * offset[..., 0] + s * offset[..., 1], c * offset[..., 1] - s * offset[..., 0]
    return np.stack([x, y, wrap_angle(world_from_b[..., 2] - world_from_a[..., 2])], axis=-1)


def inverse(a_from_b: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """b_from_a."""
    return relative(a_from_b, np.zeros_like(a_from_b))


def composed(
    a_from_b: Float[np.ndarray, "3"], b_from_c: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """a_from_c."""
    place = to_world(a_from_b, b_from_c[..., :2])
    return np.concatenate([place, wrap_angle(b_from_c[..., 2:] + a_from_b[2])], axis=-1)
