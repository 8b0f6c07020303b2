"""Cramer-Rao bound of a calibration.

The bound uses all received first-order echoes, with the association known from the simulator. The Jacobians are central
differences of range formulas of this module, independent of the library. Second-order echoes and the prior that corners
lie where walls meet are not included, so the bound is slightly too large where the library uses them.
"""

import numpy as np
from jaxtyping import Float

from benchmarks.calibration.trials import FIRST_ORDER, SIGMA, Trial
from jaxsonar import Room
from jaxsonar.geometry.se2 import relative, wrap_angle
from jaxsonar.hardware.messages import REFERENCE_SPEED_OF_SOUND
from jaxsonar.simulation.simulator import Simulation
from jaxsonar.simulation.traced_echoes import EchoKind

SPEED_SD, OFFSET_SD, LANDMARK_SD = 0.015, 0.03, 1.0
"""Prior standard deviations as in the library: speed of sound (relative), offsets (m), landmarks and poses (m, rad)."""

MIN_STEP_SD, METRE_ANGLE = (0.0005, 0.001), 0.5
"""Minimum odometry noise of a step (m, rad), and the rotation as noisy as one metre (rad), as in the library."""

NUDGE = 1e-6
"""Step of the central differences: metres, radians or relative."""


def expected_ranges(
    kind: np.ndarray,
    parameters: Float[np.ndarray, "echoes 2"],
    pose: Float[np.ndarray, "echoes 3"],
    ends: Float[np.ndarray, "echoes 2 2"],
    scale: Float[np.ndarray, " echoes"],
) -> Float[np.ndarray, " echoes"]:
    """Expected ranges without offsets, metres.

    Args:
        kind: values of ``EchoKind``.
        parameters: (rho, theta) of planes, (x, y) of points; world frame, metres and radians.
        pose: world_from_robot.
        ends: transmitter and receiver, robot frame, metres.
        scale: ``REFERENCE_SPEED_OF_SOUND`` divided by the speed of sound.
    """
    cos, sin = np.cos(pose[:, 2, None]), np.sin(pose[:, 2, None])
    x, y = ends[..., 0], ends[..., 1]
    at = pose[:, None, :2] + np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    normal = np.stack([np.cos(parameters[:, 1]), np.sin(parameters[:, 1])], axis=-1)
    height = (at * normal[:, None]).sum(-1) - parameters[:, :1]
    base = ((at[:, 0] - at[:, 1]) ** 2).sum(-1)
    wall = np.sqrt(np.maximum(base + 4 * height[:, 0] * height[:, 1], 0)) / 2
    corner = np.linalg.norm(at.mean(axis=1) - parameters, axis=-1)
    edge = np.linalg.norm(at - parameters[:, None], axis=-1).mean(axis=1)
    return np.select([kind == EchoKind.PLANE, kind == EchoKind.CORNER], [wall, corner], edge) * scale


def first_order_echoes(room: Room, simulation: Simulation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices of the first-order echoes, the reflector of each, and the parameters of the reflectors."""
    first = np.flatnonzero(np.isin(simulation.kind, FIRST_ORDER))
    found, reflector = np.unique(
        np.stack([simulation.kind, simulation.reflector])[:, first], axis=1, return_inverse=True
    )
    parameters = np.zeros((found.shape[1], 2))
    for k, (kind, number) in enumerate(found.T):
        if kind == EchoKind.PLANE:
            along = room.walls[number, 1] - room.walls[number, 0]
            theta = np.arctan2(-along[0], along[1])
            parameters[k] = room.walls[number, 0] @ [np.cos(theta), np.sin(theta)], theta
        else:
            parameters[k] = (room.poles if kind == EchoKind.POLE else room.junctions.vertices)[number]
    return first, reflector.ravel(), parameters


def bound(
    trial: Trial, *, mean_free: bool, poses_free: bool = False, odometry: float | None = None, sigma: float = SIGMA
) -> Float[np.ndarray, "known known"]:
    """Cramer-Rao bound of the covariance: relative offsets (metres), then the logarithm of the speed of sound.

    Args:
        trial: the truth and the simulated echoes.
        mean_free: whether the mean offset is estimated; otherwise it is known.
        poses_free: whether the poses are estimated; the first pose is always known.
        odometry: relative error of the odometry between scans; None: no odometry.
        sigma: noise of the ranges, metres.
    """
    first, reflector, parameters = first_order_echoes(trial.room, trial.simulation)
    kind, scan = trial.simulation.kind[first], trial.simulation.scan[first]
    pairs = trial.true.paths[trial.simulation.path[first]]
    rows, sensors, scans = np.arange(len(first)), trial.true.count, len(trial.poses)
    ends = np.asarray(trial.true.position)[pairs]
    scale = np.full(len(first), REFERENCE_SPEED_OF_SOUND / float(trial.true.speed_of_sound))
    count = sensors + 1 + parameters.size + 3 * scans * poses_free
    jacobian = np.zeros((len(first), count))
    for column in pairs.T:  # a path has the mean of the two offsets
        np.add.at(jacobian, (rows, column), 0.5)

    def derivative(**change: np.ndarray) -> np.ndarray:
        """Derivative of all ranges, by central differences."""
        at = {"parameters": parameters[reflector], "pose": trial.poses[scan], "scale": np.log(scale)}
        up, down = ({name: value + sign * change.get(name, 0) for name, value in at.items()} for sign in (1, -1))
        high, low = (expected_ranges(kind, s["parameters"], s["pose"], ends, np.exp(s["scale"])) for s in (up, down))
        return (high - low) / (2 * NUDGE)

    jacobian[:, sensors] = derivative(scale=-NUDGE * np.ones(len(first)))
    for k in range(2):
        jacobian[rows, sensors + 1 + 2 * reflector + k] = derivative(parameters=NUDGE * np.eye(2)[k])
    for k in range(3 * poses_free):
        jacobian[rows, sensors + 1 + parameters.size + 3 * scan + k] = derivative(pose=NUDGE * np.eye(3)[k])
    expected = np.full(count, 1 / LANDMARK_SD**2)
    expected[:sensors], expected[sensors] = 1 / OFFSET_SD**2, 1 / SPEED_SD**2
    information = jacobian.T @ jacobian / sigma**2 + np.diag(expected)
    if poses_free:
        begin = sensors + 1 + parameters.size
        information[begin:, begin:] += _odometry_information(trial.poses, odometry)
    # Unless the mean offset is free, offsets vary only in the subspace that keeps it.
    rotation, _ = np.linalg.qr(np.column_stack([np.ones(sensors), np.eye(sensors)[:, 1:]]))
    basis = np.zeros((count, count - 1 + mean_free))
    kept = rotation if mean_free else rotation[:, 1:]
    basis[:sensors, : kept.shape[1]] = kept
    basis[sensors:, kept.shape[1] :] = np.eye(count - sensors)
    covariance = basis @ np.linalg.inv(basis.T @ information @ basis) @ basis.T
    centering = np.eye(sensors + 1)
    centering[:sensors, :sensors] -= 1 / sensors
    return centering @ covariance[: sensors + 1, : sensors + 1] @ centering


def _odometry_information(poses: Float[np.ndarray, "scans 3"], odometry: float | None) -> np.ndarray:
    """Information about the poses from odometry and the known first pose."""
    information = np.zeros((poses.size, poses.size))
    information[:3, :3] = np.eye(3) * 1e12
    if odometry is None:
        return information
    step = relative(poses[:-1], poses[1:])
    distance, rotation = np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2])
    position_sd = odometry * distance + MIN_STEP_SD[0]
    heading_sd = odometry * (rotation + METRE_ANGLE * distance) + MIN_STEP_SD[1]
    step_sd = np.stack([position_sd, position_sd, heading_sd], axis=-1)
    jacobian = np.zeros((poses.size - 3, poses.size))
    for column in range(poses.size):
        change = np.zeros(poses.size)
        change[column] = NUDGE
        up, down = poses + change.reshape(-1, 3), poses - change.reshape(-1, 3)
        difference = relative(up[:-1], up[1:]) - relative(down[:-1], down[1:])
        difference[:, 2] = wrap_angle(difference[:, 2])
        jacobian[:, column] = difference.ravel() / (2 * NUDGE)
    jacobian /= step_sd.ravel()[:, None]
    return information + jacobian.T @ jacobian
