"""Simulated wheel odometry with random walk errors and systematic scale errors."""

import numpy as np
from jaxtyping import Float

from jaxsonar.geometry.se2 import relative, wrap_angle
from jaxsonar.hardware.errors import SonarError

LATERAL_RATIO = 0.5
"""Standard deviation of the lateral error of a step relative to its longitudinal error. Chosen by hand."""


def simulate_odometry(
    poses: Float[np.ndarray, "scans 3"],
    *,
    distance: float,
    turn: float,
    scale: float = 0.0,
    turn_scale: float = 0.0,
    seed: int = 0,
) -> Float[np.ndarray, "scans 3"]:
    """Poses by odometry, starting at the first true pose.

    The errors of the steps are independent, with variances proportional to the length (``odometry_step_sd``). The drift
    therefore does not depend on the division of a trajectory into steps. The same arguments give the same poses.

    Args:
        poses: true world_from_robot (x, y, theta), metres and radians.
        distance: standard deviation of the distance after one metre, metres; grows with the square root of the
            distance. It is also the standard deviation of the heading after one radian of rotation, besides ``turn``.
        turn: standard deviation of the heading after one metre, radians; grows with the square root of the distance.
        scale: relative error of all distances; positive for wheels that are smaller than assumed.
        turn_scale: relative error of all rotations; positive for a track that is wider than assumed.
        seed: seed of the errors.

    Returns:
        world_from_robot by odometry, (scans, 3), headings in [-pi, pi).

    Raises:
        SonarError: a value out of range; the message names it and the allowed range.
    """
    limits = {"distance": (distance, 0.0, 10.0), "turn": (turn, 0.0, 10.0)}
    limits |= {"scale": (scale, -0.9, 10.0), "turn_scale": (turn_scale, -0.9, 10.0), "seed": (seed, 0, np.inf)}
    for name, (value, low, high) in limits.items():
        if not low <= value <= high:
            raise SonarError(f"odometry: {name} {value:g}; allowed is {low:g} to {high:g}")
    if not np.isfinite(poses).all():
        row = int(np.argmin(np.isfinite(poses).all(axis=1)))
        raise SonarError(f"odometry: pose {row} is {poses[row].tolist()}; allowed are finite x, y (m) and theta (rad)")
    if len(poses) < 2:
        return poses.copy()
    steps = relative(poses[:-1], poses[1:])
    sd = odometry_step_sd(poses, distance=distance, turn=turn)
    error = sd * np.random.default_rng(seed).standard_normal(steps.shape)
    length = np.linalg.norm(steps[:, :2], axis=-1, keepdims=True)
    along = np.divide(steps[:, :2], length, out=np.zeros((len(steps), 2)), where=length > 0)
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    measured = steps[:, :2] * (1 + scale) + along * error[:, :1] + across * error[:, 1:2]
    heading = poses[0, 2] + np.cumsum(np.append(0.0, steps[:, 2] * (1 + turn_scale) + error[:, 2]))
    cos, sin = np.cos(heading[:-1]), np.sin(heading[:-1])
    x, y = measured.T
    displacement = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    position = poses[0, :2] + np.concatenate([np.zeros((1, 2)), np.cumsum(displacement, axis=0)])
    return np.column_stack([position, wrap_angle(heading)])


def odometry_step_sd(
    poses: Float[np.ndarray, "scans 3"], *, distance: float, turn: float
) -> Float[np.ndarray, "steps 3"]:
    """Standard deviations of the steps between poses: along and across the step (metres), heading (radians).

    Args:
        poses: world_from_robot (x, y, theta), metres and radians.
        distance: as for ``simulate_odometry``.
        turn: as for ``simulate_odometry``.
    """
    steps = relative(poses[:-1], poses[1:])
    length, rotation = np.linalg.norm(steps[:, :2], axis=-1), np.abs(steps[:, 2])
    along = distance * np.sqrt(length)
    return np.stack([along, LATERAL_RATIO * along, np.sqrt(turn**2 * length + distance**2 * rotation)], axis=-1)
