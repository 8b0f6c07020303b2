"""cramer_rao."""

import numpy as np
from jaxtyping import Float

from benchmarks.calibration.trials import (
    FIRST_ORDER,
    SIGMA,
    Trial,
)
from jaxsonar import Room
from jaxsonar.geometry.se2 import relative, wrap_angle
from jaxsonar.simulation.simulator import Simulation
from jaxsonar.simulation.traced_echoes import EchoKind

SPEED_SD, OFFSET_SD, LOOSE = 0.015, 0.03, 1.0
"""What the library expects, too: of the speed of sound (relative), offsets (m), reflectors and poses (m, rad)."""

SLIP, TURN = (0.0005, 0.001), 0.5
"""Odometry (m, rad) where the robot stands, and radians in which it slips as over a metre, as the library expects."""

NUDGE = 1e-6
"""Metres, radians or relative; of the central differences."""


def reports(
    kind: np.ndarray,
    place: Float[np.ndarray, "echoes 2"],
    pose: Float[np.ndarray, "echoes 3"],
    ends: Float[np.ndarray, "echoes 2 2"],
    scale: Float[np.ndarray, " echoes"],
) -> Float[np.ndarray, " echoes"]:
    """Reported ranges without offsets, metres.

    Args:
        kind: values of ``Kind``.
        place: (rho, theta) of planes, (x, y) of points; world frame, metres and radians.
        pose: world_from_robot.
        ends: transmitter and receiver, robot frame, metres.
        scale: 343.2 m/s over the speed of sound.
    """
    cos, sin = np.cos(pose[:, 2, None]), np.sin(pose[:, 2, None])
    x, y = ends[..., 0], ends[..., 1]
    at = pose[:, None, :2] + np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    normal = np.stack([np.cos(place[:, 1]), np.sin(place[:, 1])], axis=-1)
    height = (at * normal[:, None]).sum(-1) - place[:, :1]
    base = ((at[:, 0] - at[:, 1]) ** 2).sum(-1)
    wall = np.sqrt(np.maximum(base + 4 * height[:, 0] * height[:, 1], 0)) / 2
    corner = np.linalg.norm(at.mean(axis=1) - place, axis=-1)
    edge = np.linalg.norm(at - place[:, None], axis=-1).mean(axis=1)
    return np.select([kind == EchoKind.PLANE, kind == EchoKind.CORNER], [wall, corner], edge) * scale


def scene(room: Room, heard: Simulation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which echoes are of first order, the reflector of each of these, and where those are (as ``reports`` has it)."""
    first = np.flatnonzero(np.isin(heard.kind, FIRST_ORDER))
    found, own = np.unique(np.stack([heard.kind, heard.reflector])[:, first], axis=1, return_inverse=True)
    places = np.zeros((found.shape[1], 2))
    for k, (kind, number) in enumerate(found.T):
        if kind == EchoKind.PLANE:
            along = room.walls[number, 1] - room.walls[number, 0]
            theta = np.arctan2(-along[0], along[1])
            places[k] = room.walls[number, 0] @ [np.cos(theta), np.sin(theta)], theta
        else:
            places[k] = (room.poles if kind == EchoKind.POLE else room.junctions.vertices)[number]
    return first, own.ravel(), places


def bound(
    one: Trial, *, mean_free: bool, poses_free: bool = False, odometry: float | None = None, sigma: float = SIGMA
) -> Float[np.ndarray, "known known"]:
    """Covariance that no unbiased estimate goes below: relative offsets (metres), then logarithm of the speed of sound.

    Args:
        one: the truth and what was heard.
        mean_free: whether the mean offset is estimated, too; it is known otherwise.
        poses_free: whether the poses are; the first one is known.
        odometry: share that odometry between the scans is wrong by; None: no odometry.
        sigma: noise of the ranges, metres.
    """
    first, own, places = scene(one.room, one.heard)
    kind, scan = one.heard.kind[first], one.heard.scan[first]
    pairs = one.true.paths[one.heard.path[first]]
    rows, sensors, scans = np.arange(len(first)), one.true.count, len(one.poses)
    ends = np.asarray(one.true.position)[pairs]
    scale = np.full(len(first), 343.2 / float(one.true.speed_of_sound))
    count = sensors + 1 + places.size + 3 * scans * poses_free
    jacobian = np.zeros((len(first), count))
    for column in pairs.T:  # the report of a path has half of each offset
        np.add.at(jacobian, (rows, column), 0.5)

    def slope(**change: np.ndarray) -> np.ndarray:
        """By central differences."""
        at = {"place": places[own], "pose": one.poses[scan], "scale": np.log(scale)}
        up, down = ({name: value + way * change.get(name, 0) for name, value in at.items()} for way in (1, -1))
        high, low = (reports(kind, s["place"], s["pose"], ends, np.exp(s["scale"])) for s in (up, down))
        return (high - low) / (2 * NUDGE)

    jacobian[:, sensors] = slope(scale=-NUDGE * np.ones(len(first)))
    for k in range(2):
        jacobian[rows, sensors + 1 + 2 * own + k] = slope(place=NUDGE * np.eye(2)[k])
    for k in range(3 * poses_free):
        jacobian[rows, sensors + 1 + places.size + 3 * scan + k] = slope(pose=NUDGE * np.eye(3)[k])
    expected = np.full(count, 1 / LOOSE**2)
    expected[:sensors], expected[sensors] = 1 / OFFSET_SD**2, 1 / SPEED_SD**2
    information = jacobian.T @ jacobian / sigma**2 + np.diag(expected)
    if poses_free:
        begin = sensors + 1 + places.size
        information[begin:, begin:] += _links(one.poses, odometry)
    # Offsets that are known but for those that leave the mean as it is, unless the mean is free.
    turn, _ = np.linalg.qr(np.column_stack([np.ones(sensors), np.eye(sensors)[:, 1:]]))
    basis = np.zeros((count, count - 1 + mean_free))
    kept = turn if mean_free else turn[:, 1:]
    basis[:sensors, : kept.shape[1]] = kept
    basis[sensors:, kept.shape[1] :] = np.eye(count - sensors)
    covariance = basis @ np.linalg.inv(basis.T @ information @ basis) @ basis.T
    flat = np.eye(sensors + 1)
    flat[:sensors, :sensors] -= 1 / sensors
    return flat @ covariance[: sensors + 1, : sensors + 1] @ flat


def _links(poses: Float[np.ndarray, "scans 3"], odometry: float | None) -> np.ndarray:
    """Information of poses that odometry and the known first pose bring."""
    information = np.zeros((poses.size, poses.size))
    information[:3, :3] = np.eye(3) * 1e12
    if odometry is None:
        return information
    step = relative(poses[:-1], poses[1:])
    way, turn = np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2])
    off = np.stack([odometry * way + SLIP[0]] * 2 + [odometry * (turn + TURN * way) + SLIP[1]], axis=-1)
    jacobian = np.zeros((poses.size - 3, poses.size))
    for column in range(poses.size):
        change = np.zeros(poses.size)
        change[column] = NUDGE
        up, down = poses + change.reshape(-1, 3), poses - change.reshape(-1, 3)
        difference = relative(up[:-1], up[1:]) - relative(down[:-1], down[1:])
        difference[:, 2] = wrap_angle(difference[:, 2])
        jacobian[:, column] = difference.ravel() / (2 * NUDGE)
    jacobian /= off.ravel()[:, None]
    return information + jacobian.T @ jacobian
