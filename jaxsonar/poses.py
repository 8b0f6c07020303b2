"""Planar poses (x, y, theta): metres, radians counter-clockwise, world_from_robot."""

import numpy as np
from jaxtyping import Float


def rotation(theta: float) -> Float[np.ndarray, "2 2"]:
    """Matrix that turns counter-clockwise by theta radians."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s], [s, c]])


def to_world(pose: Float[np.ndarray, "3"], points: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """Points of the robot frame in the world frame, metres."""
    return points @ rotation(pose[2]).T + pose[:2]
