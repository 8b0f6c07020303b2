"""What the motion between two scans does to what is known."""

import numpy as np
from jaxtyping import Float

from jaxsonar.estimation.odometry_noise import Slip
from jaxsonar.geometry.se2 import rotation, unit

UNKNOWN = (0.3, 0.3)
"""Standard deviation of the motion between scans without odometry, metres and radians."""


def step_variance(slip: Slip, step: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Of one step of odometry, in the frame where it begins: square metres (ahead, left) and radians.

    Args:
        slip: how wrong the odometry is.
        step: the next pose seen from the one before; NaN where it was not measured.
    """
    if not np.isfinite(step).all():
        return np.square([UNKNOWN[0], UNKNOWN[0], UNKNOWN[1]])
    sd = slip(np.stack([np.zeros(3), step]), np.arange(2))[0]
    return np.square(sd)


def moved(
    pose: Float[np.ndarray, "3"],
    covariance: Float[np.ndarray, "unknowns unknowns"],
    step: Float[np.ndarray, "3"],
    variance: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "unknowns unknowns"]]:
    """A pose after a step, and its covariance with all that hangs on it.

    Args:
        pose: frame_from_robot before it.
        covariance: of the pose (the first 3) and anything else.
        step: the next pose in the frame of this one.
        variance: of the step, in that frame.
    """
    turned = rotation(pose[2])
    way = turned @ step[:2]
    by_pose = np.eye(3)
    by_pose[0, 2], by_pose[1, 2] = -way[1], way[0]
    after = covariance.copy()
    after[:3] = by_pose @ after[:3]
    after[:, :3] = after[:, :3] @ by_pose.T
    after[:2, :2] += turned @ np.diag(variance[:2]) @ turned.T
    after[2, 2] += variance[2]
    return np.append(pose[:2] + way, pose[2] + step[2]), after


def placed(
    base: Float[np.ndarray, "3"],
    base_cov: Float[np.ndarray, "3 3"],
    pose: Float[np.ndarray, "3"],
    covariance: Float[np.ndarray, "3 3"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """A pose of a frame in the world, and its covariance; the errors of frame and pose are independent."""
    turned = rotation(base[2])
    way = turned @ pose[:2]
    by_base = np.eye(3)
    by_base[0, 2], by_base[1, 2] = -way[1], way[0]
    by_pose = np.eye(3)
    by_pose[:2, :2] = turned
    heading = base[2] + pose[2]
    world = np.append(base[:2] + way, np.arctan2(*unit(heading)[::-1]))
    return world, by_base @ base_cov @ by_base.T + by_pose @ covariance @ by_pose.T
