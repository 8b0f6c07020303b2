"""Planar rigid motions, SE(2): poses (x, y, theta) in metres and radians, theta counter-clockwise.

``a_from_b`` is the pose of frame b in frame a; it transforms points given in b to points in a. The covariance of a pose
is that of additive errors of (x, y, theta).
"""

import numpy as np
from jaxtyping import Float


def wrap_angle(angle: Float[np.ndarray, "*batch"] | float) -> Float[np.ndarray, "*batch"]:
    """The equivalent angles in [-pi, pi), radians."""
    wrapped = (angle + np.pi) % (2 * np.pi) - np.pi
    return np.where(wrapped >= np.pi, -np.pi, wrapped)  # the modulo may round up to pi


def unit(angle: Float[np.ndarray, "*batch"] | float) -> Float[np.ndarray, "*batch 2"]:
    """Unit vectors in the given directions, radians. For the theta of a wall: its normal."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def tangent_of(theta: Float[np.ndarray, "*batch"] | float) -> Float[np.ndarray, "*batch 2"]:
    """Unit tangents of the walls with these normal directions: the normals rotated by +90 degrees."""
    return np.stack([-np.sin(theta), np.cos(theta)], axis=-1)


def perpendicular(vector: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """The vectors rotated by +90 degrees; also the derivative of a rotated vector by the angle."""
    return np.stack([-vector[..., 1], vector[..., 0]], axis=-1)


def rotation(theta: float) -> Float[np.ndarray, "2 2"]:
    """The matrix that rotates by theta radians."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s], [s, c]])


def rotate(
    vector: Float[np.ndarray, "*#batch 2"], theta: Float[np.ndarray, "*#batch"] | float
) -> Float[np.ndarray, "... 2"]:
    """Vectors rotated by theta radians, both broadcast against each other."""
    theta = np.asarray(theta)
    return np.cos(theta)[..., None] * vector + np.sin(theta)[..., None] * perpendicular(vector)


def transform_points(
    a_from_b: Float[np.ndarray, "*#batch 3"], p_b: Float[np.ndarray, "*#batch 2"]
) -> Float[np.ndarray, "... 2"]:
    """Points of frame b in frame a, metres; one pose for all points, or poses and points broadcast."""
    if a_from_b.ndim == 1:
        return p_b @ rotation(a_from_b[2]).T + a_from_b[:2]
    return rotate(p_b, a_from_b[..., 2]) + a_from_b[..., :2]


def compose(
    a_from_b: Float[np.ndarray, "*#batch 3"], b_from_c: Float[np.ndarray, "*#batch 3"]
) -> Float[np.ndarray, "... 3"]:
    """a_from_c: the group product, row by row or broadcast; theta in [-pi, pi)."""
    position = transform_points(a_from_b, b_from_c[..., :2])
    return np.concatenate([position, wrap_angle(b_from_c[..., 2:] + a_from_b[..., 2:])], axis=-1)


def relative(
    world_from_a: Float[np.ndarray, "*#batch 3"], world_from_b: Float[np.ndarray, "*#batch 3"]
) -> Float[np.ndarray, "... 3"]:
    """a_from_b: the poses of the frames b in the frames a, row by row or broadcast; theta in [-pi, pi)."""
    offset = world_from_b[..., :2] - world_from_a[..., :2]
    c, s = np.cos(world_from_a[..., 2]), np.sin(world_from_a[..., 2])
    x, y = c * offset[..., 0] + s * offset[..., 1], c * offset[..., 1] - s * offset[..., 0]
    return np.stack([x, y, wrap_angle(world_from_b[..., 2] - world_from_a[..., 2])], axis=-1)


def inverse(a_from_b: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """b_from_a."""
    return relative(a_from_b, np.zeros_like(a_from_b))


def subtract_poses(
    poses: Float[np.ndarray, "*#batch 3"], others: Float[np.ndarray, "*#batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Differences of the coordinates (x, y, theta) of poses in one frame; theta in [-pi, pi)."""
    difference = poses - others
    return np.concatenate([difference[..., :2], wrap_angle(difference[..., 2:])], axis=-1)


def wrap_pose(pose: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """The same poses with theta in [-pi, pi)."""
    return np.concatenate([pose[..., :2], wrap_angle(pose[..., 2:])], axis=-1)


def diagonal_covariance(sd: tuple[float, float]) -> Float[np.ndarray, "3 3"]:
    """Covariance of independent errors with the standard deviations (position in x and in y, theta)."""
    return np.diag(np.square([sd[0], sd[0], sd[1]]))


def compose_jacobians(
    a_from_b: Float[np.ndarray, "3"], b_from_c: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]:
    """Derivatives of ``compose(a_from_b, b_from_c)`` by its first and by its second argument."""
    rotated = rotation(a_from_b[2])
    offset = rotated @ b_from_c[:2]
    by_first, by_second = np.eye(3), np.eye(3)
    by_first[:2, 2] = -offset[1], offset[0]
    by_second[:2, :2] = rotated
    return by_first, by_second


def relative_jacobians(
    world_from_a: Float[np.ndarray, "*batch 3"], a_from_b: Float[np.ndarray, "*batch 3"]
) -> tuple[Float[np.ndarray, "*batch 3 3"], Float[np.ndarray, "*batch 3 3"]]:
    """Derivatives of ``relative(world_from_a, world_from_b)`` by its first and by its second argument.

    Args:
        world_from_a: the first argument.
        a_from_b: the result.
    """
    c, s = np.cos(world_from_a[..., 2]), np.sin(world_from_a[..., 2])
    by_second = np.zeros((*world_from_a.shape, 3))
    by_second[..., 0, 0], by_second[..., 0, 1] = c, s
    by_second[..., 1, 0], by_second[..., 1, 1] = -s, c
    by_second[..., 2, 2] = 1.0
    by_first = -by_second
    by_first[..., 0, 2], by_first[..., 1, 2] = a_from_b[..., 1], -a_from_b[..., 0]
    return by_first, by_second


def compose_with_covariance(
    a_from_b: Float[np.ndarray, "3"],
    cov_ab: Float[np.ndarray, "3 3"],
    b_from_c: Float[np.ndarray, "3"],
    cov_bc: Float[np.ndarray, "3 3"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """a_from_c and its covariance, to first order; the errors of the two poses are independent."""
    by_first, by_second = compose_jacobians(a_from_b, b_from_c)
    return compose(a_from_b, b_from_c), by_first @ cov_ab @ by_first.T + by_second @ cov_bc @ by_second.T


def propagate(
    pose: Float[np.ndarray, "3"],
    covariance: Float[np.ndarray, "unknowns unknowns"],
    step: Float[np.ndarray, "3"],
    step_cov: Float[np.ndarray, "3 3"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "unknowns unknowns"]]:
    """``compose_with_covariance`` for a pose that is correlated with other unknowns (prediction step of EKF-SLAM).

    Args:
        pose: frame_from_robot before the step.
        covariance: joint covariance of the pose (first 3 rows) and any other unknowns, which do not change.
        step: the next pose in the frame of the robot; its errors are independent of everything else.
        step_cov: its covariance.
    """
    by_pose, by_step = compose_jacobians(pose, step)
    joint = covariance.copy()
    joint[:3] = by_pose @ joint[:3]
    joint[:, :3] = joint[:, :3] @ by_pose.T
    joint[:3, :3] += by_step @ step_cov @ by_step.T
    return compose(pose, step), joint


def rotate_covariance(theta: float, cov: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Covariances of poses after a change of frame: ``theta`` is the angle of new_from_old, which has no error."""
    by_pose = np.eye(3)
    by_pose[:2, :2] = rotation(theta)
    return by_pose @ cov @ by_pose.T


def relative_covariance(
    world_from_a: Float[np.ndarray, "3"],
    a_from_b: Float[np.ndarray, "*batch 3"],
    cov_a: Float[np.ndarray, "3 3"],
    cov_b: Float[np.ndarray, "*batch 3 3"],
    cross: Float[np.ndarray, "*batch 3 3"],
) -> Float[np.ndarray, "*batch 3 3"]:
    """Covariance of ``relative`` of one pose and one or more others, to first order.

    Args:
        world_from_a: the first pose.
        a_from_b: the relative poses.
        cov_a: covariance of world_from_a.
        cov_b: covariances of world_from_b.
        cross: covariances between the errors of world_from_a (rows) and world_from_b (columns).
    """
    by_a, by_b = relative_jacobians(np.broadcast_to(world_from_a, a_from_b.shape), a_from_b)
    mixed = by_a @ cross @ by_b.swapaxes(-1, -2)
    cov = by_a @ cov_a @ by_a.swapaxes(-1, -2) + by_b @ cov_b @ by_b.swapaxes(-1, -2)
    return cov + mixed + mixed.swapaxes(-1, -2)


def interpolate(
    start: Float[np.ndarray, "*batch 3"], end: Float[np.ndarray, "*batch 3"], fraction: Float[np.ndarray, "*batch"]
) -> Float[np.ndarray, "*batch 3"]:
    """Poses between two poses by motion with constant velocity and turn rate (a geodesic of SE(2)).

    Args:
        start: poses x, y (m), theta (rad) at fraction 0.
        end: poses at fraction 1; the turn is the shorter one.
        fraction: any real number; below 0 and above 1 the motion is extrapolated.
    """
    x, y, turn = np.moveaxis(relative(start, end), -1, 0)
    # The twist that leads from start to end in unit time: (x, y) = V(turn) velocity.
    sine, versine = _arc_factors(turn)
    scale = sine**2 + versine**2
    velocity_x, velocity_y = (sine * x + versine * y) / scale, (sine * y - versine * x) / scale
    sine, versine = _arc_factors(fraction * turn)
    step_x, step_y = sine * velocity_x - versine * velocity_y, versine * velocity_x + sine * velocity_y
    return compose(start, np.stack([fraction * step_x, fraction * step_y, fraction * turn], axis=-1))


def _arc_factors(turn: Float[np.ndarray, "*batch"]) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
    """sin(turn) / turn and (1 - cos(turn)) / turn, continuous at 0."""
    # (1 - cos a) / a = sinc(a / 2)^2 a / 2, which does not cancel.
    return np.sinc(turn / np.pi), np.sinc(turn / (2 * np.pi)) ** 2 * turn / 2
