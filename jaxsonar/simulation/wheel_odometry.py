"""What wheels say of a robot's way: simulated odometry, wrong by a random walk and by what is wrong for good."""

import numpy as np
from jaxtyping import Float

from jaxsonar.geometry.se2 import relative, wrap_angle
from jaxsonar.hardware.errors import SonarError

ACROSS = 0.5
"""Sideways error of a step, as a share of that along it: wheels roll along and slip across."""


def simulate_odometry(
    poses: Float[np.ndarray, "scans 3"],
    *,
    distance: float,
    turn: float,
    scale: float = 0.0,
    turn_scale: float = 0.0,
    seed: int = 0,
) -> Float[np.ndarray, "scans 3"]:
    """The poses that odometry would report: it begins where the robot does, and drifts.

    The errors of the steps are independent (``step_sd``), so that the drift does not depend on how a way is divided
    into steps. The same arguments give the same poses.

    Args:
        poses: world_from_robot (x, y, theta) as it is, metres and radians.
        distance: standard deviation of the way after one metre, metres; it grows with the root of the way. After one
            radian of turning the heading is wrong by as many radians, besides ``turn``.
        turn: standard deviation of the heading after one metre, radians; it grows with the root of the way.
        scale: by which every way is too long, relative: wheels smaller than believed.
        turn_scale: by which every turn is too far, relative: a track wider than believed.
        seed: of the errors.

    Returns:
        world_from_robot by odometry, (scans, 3), headings in [-pi, pi).

    Raises:
        SonarError: a value out of range, named with what is allowed.
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
    error = odometry_step_sd(poses, distance=distance, turn=turn) * np.random.default_rng(seed).standard_normal(
        steps.shape
    )
    way = np.linalg.norm(steps[:, :2], axis=-1, keepdims=True)
    along = np.divide(steps[:, :2], way, out=np.zeros((len(steps), 2)), where=way > 0)
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    told = steps[:, :2] * (1 + scale) + along * error[:, :1] + across * error[:, 1:2]
    heading = poses[0, 2] + np.cumsum(np.append(0.0, steps[:, 2] * (1 + turn_scale) + error[:, 2]))
    cos, sin = np.cos(heading[:-1]), np.sin(heading[:-1])
    moved = np.stack([cos * told[:, 0] - sin * told[:, 1], sin * told[:, 0] + cos * told[:, 1]], axis=-1)
    place = poses[0, :2] + np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)])
    return np.column_stack([place, wrap_angle(heading)])


def odometry_step_sd(
    poses: Float[np.ndarray, "scans 3"], *, distance: float, turn: float
) -> Float[np.ndarray, "steps 3"]:
    """Standard deviations of the steps between poses: along and across the step (metres), heading (radians).

    Args:
        poses: world_from_robot (x, y, theta), metres and radians.
        distance: as for ``drifted``.
        turn: as for ``drifted``.
    """
    steps = relative(poses[:-1], poses[1:])
    way, turned = np.linalg.norm(steps[:, :2], axis=-1), np.abs(steps[:, 2])
    along = distance * np.sqrt(way)
    return np.stack([along, ACROSS * along, np.sqrt(turn**2 * way + distance**2 * turned)], axis=-1)
