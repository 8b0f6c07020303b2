"""Cramer-Rao bound of a simulated run: lower bound of the covariances of poses and walls.

The association is known from the simulator, the noise is white, the odometry noise is that of ``simulate_odometry``.
The range formulas are those of ``benchmarks.calibration.cramer_rao`` and the Jacobians are central differences, so
nothing is shared with the kernels. The odometry noise is a random walk here, and proportional to the step there.
Second-order echoes and the priors that corners lie where walls meet and that walls continue behind a door are not
included, so the bound is slightly too large where the library uses them. The first pose is known; it is the frame.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import solveh_banded

from benchmarks.calibration.cramer_rao import LANDMARK_SD, NUDGE, expected_ranges, first_order_echoes
from benchmarks.slam.scenarios import DISTANCE, TURN, Scene
from jaxsonar.geometry.se2 import relative, wrap_angle
from jaxsonar.hardware.messages import REFERENCE_SPEED_OF_SOUND
from jaxsonar.simulation.traced_echoes import EchoKind
from jaxsonar.simulation.wheel_odometry import odometry_step_sd

EXACT = 1e-5
"""Standard deviation of exact components of the odometry, such as the translation of a turn in place, m and rad."""


@dataclass(frozen=True, eq=False)
class Bound:
    """Lower bounds of covariances; world frame, metres and radians."""

    poses: Float[np.ndarray, "scans 3 3"]
    """Covariance of each pose; the first one is known."""
    wall: Int[np.ndarray, " walls"]
    """Walls of the room with echoes."""
    distance: Float[np.ndarray, " walls"]
    """Variance of the distance of each wall at its midpoint, square metres."""
    turn: Float[np.ndarray, " walls"]
    """Variance of the direction of each wall, square radians."""

    @property
    def ate(self) -> float:
        """Root mean square position error, metres."""
        return float(np.sqrt(np.mean(self.poses[:, 0, 0] + self.poses[:, 1, 1])))

    @property
    def ate_heading(self) -> float:
        """Root mean square heading error, radians."""
        return float(np.sqrt(np.mean(self.poses[:, 2, 2])))


def bound(scene: Scene, *, distance: float = DISTANCE, turn: float = TURN) -> Bound:
    """Bound of a run in an unknown environment.

    Args:
        scene: the truth and the simulated echoes.
        distance: position noise of the odometry, as in ``simulate_odometry``.
        turn: heading noise of the odometry, as in ``simulate_odometry``.
    """
    jacobians = _RangeJacobians.of(scene)
    count, scans = len(jacobians.parameters), len(scene.poses)
    pose, cross, reflectors = jacobians.information(scans)
    reflectors[:, np.arange(2), np.arange(2)] += 1 / LANDMARK_SD**2
    on_first, on_second, between = _odometry_information(scene.poses, distance, turn)
    pose[:-1] += on_first
    pose[1:] += on_second
    unknown = slice(1, None)  # the first pose is known
    odometry_chain = _BlockTridiagonal(pose[unknown], between[1:])
    border = cross[unknown].reshape(3 * (scans - 1), 2 * count)
    solved = odometry_chain.solve(border) if scans > 1 else border
    whole = np.zeros((2 * count, 2 * count))
    for k in range(count):
        whole[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = reflectors[k]
    covariance = np.linalg.inv(whole - border.T @ solved)
    rows = solved.reshape(scans - 1, 3, 2 * count)
    poses = np.zeros((scans, 3, 3))
    for begin in range(0, scans - 1, 512):
        some = rows[begin : begin + 512]
        poses[1 + begin : 1 + begin + len(some)] = (some @ covariance) @ some.transpose(0, 2, 1)
    poses[unknown] += odometry_chain.blocks()
    return Bound(poses, *_walls(scene, jacobians, covariance))


def pose_bound(scene: Scene) -> Float[np.ndarray, "scans 3 3"]:
    """Covariance of each pose from its own scan alone, in a known room."""
    pose, _, _ = _RangeJacobians.of(scene).information(len(scene.poses))
    return np.linalg.inv(pose)


@dataclass(frozen=True, eq=False)
class _RangeJacobians:
    """Jacobians of the ranges of all first-order echoes, in units of the noise."""

    scan: np.ndarray  # (echoes,)
    reflector: np.ndarray  # (echoes,) row of the reflector
    kinds: np.ndarray  # (reflectors, 2) kind and number
    parameters: np.ndarray  # (reflectors, 2)
    d_range_d_pose: np.ndarray  # (echoes, 3)
    d_range_d_reflector: np.ndarray  # (echoes, 2)

    @classmethod
    def of(cls, scene: Scene) -> "_RangeJacobians":
        simulation = scene.simulation
        first, reflector, parameters = first_order_echoes(scene.room, simulation)
        kind, scan = simulation.kind[first], simulation.scan[first]
        ends = np.asarray(scene.ring.position)[scene.ring.paths[simulation.path[first]]]
        scale = np.full(len(first), REFERENCE_SPEED_OF_SOUND / float(scene.ring.speed_of_sound))

        def derivative(reflector_step: np.ndarray, pose: np.ndarray) -> np.ndarray:
            at = [
                (parameters[reflector] + sign * reflector_step, scene.poses[scan] + sign * pose)
                for sign in (NUDGE, -NUDGE)
            ]
            up, down = (expected_ranges(kind, *one, ends, scale) for one in at)
            return (up - down) / (2 * NUDGE * scene.sigma)

        d_range_d_pose = np.stack([derivative(np.zeros(2), one) for one in np.eye(3)], axis=-1)
        d_range_d_reflector = np.stack([derivative(one, np.zeros(3)) for one in np.eye(2)], axis=-1)
        kinds = np.unique(
            np.stack([simulation.kind, simulation.reflector])[:, first], axis=1
        ).T  # in the order of the parameters
        return cls(scan, reflector, kinds, parameters, d_range_d_pose, d_range_d_reflector)

    def information(self, scans: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Information: poses (scans, 3, 3), cross terms (scans, 3, reflectors, 2), reflectors (reflectors, 2, 2)."""
        count = len(self.parameters)
        pose, cross = np.zeros((scans, 3, 3)), np.zeros((scans, 3, count, 2))
        reflectors = np.zeros((count, 2, 2))
        np.add.at(pose, self.scan, self.d_range_d_pose[:, :, None] * self.d_range_d_pose[:, None])
        np.add.at(reflectors, self.reflector, self.d_range_d_reflector[:, :, None] * self.d_range_d_reflector[:, None])
        products = self.d_range_d_pose[:, :, None] * self.d_range_d_reflector[:, None]
        np.add.at(cross.transpose(0, 2, 1, 3), (self.scan, self.reflector), products)
        return pose, cross, reflectors


def _odometry_information(poses: np.ndarray, distance: float, turn: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Information of each odometry step: first pose, second pose and cross term, (steps, 3, 3) each."""
    sd = np.maximum(odometry_step_sd(poses, distance=distance, turn=turn), EXACT)
    step = relative(poses[:-1], poses[1:])
    direction = np.arctan2(step[:, 1], step[:, 0])
    c, s = np.cos(direction), np.sin(direction)

    def derivative(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        up, down = (relative(poses[:-1] + sign * a, poses[1:] + sign * b) for sign in (NUDGE, -NUDGE))
        difference = up - down
        difference[:, 2] = wrap_angle(difference[:, 2])
        along, across = c * difference[:, 0] + s * difference[:, 1], c * difference[:, 1] - s * difference[:, 0]
        return np.stack([along, across, difference[:, 2]], axis=-1) / (2 * NUDGE * sd)

    first = np.stack([derivative(one, np.zeros(3)) for one in np.eye(3)], axis=-1)
    second = np.stack([derivative(np.zeros(3), one) for one in np.eye(3)], axis=-1)
    first_transposed = first.transpose(0, 2, 1)
    return first_transposed @ first, second.transpose(0, 2, 1) @ second, first_transposed @ second


class _BlockTridiagonal:
    """A symmetric block tridiagonal matrix with 3 x 3 blocks."""

    def __init__(self, diagonal: np.ndarray, upper: np.ndarray):
        self.diagonal, self.upper = diagonal, upper

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The inverse times ``right``."""
        size = 3 * len(self.diagonal)
        banded = np.zeros((6, size))
        for i in range(3):
            for j in range(i + 1):
                banded[i - j, j::3] = self.diagonal[:, i, j]
            for j in range(3):  # row i of the next block, column j of this one
                below = 3 + i - j
                banded[below, j : size - 3 : 3] = self.upper[:, j, i]
        return solveh_banded(banded, right, lower=True)

    def blocks(self) -> np.ndarray:
        """The diagonal blocks of the inverse."""
        count = len(self.diagonal)
        before, after = self.diagonal.copy(), self.diagonal.copy()
        for k in range(1, count):
            before[k] -= self.upper[k - 1].T @ np.linalg.solve(before[k - 1], self.upper[k - 1])
        for k in range(count - 2, -1, -1):
            after[k] -= self.upper[k] @ np.linalg.solve(after[k + 1], self.upper[k].T)
        return np.linalg.inv(before + after - self.diagonal)


def _walls(
    scene: Scene, jacobians: _RangeJacobians, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Index, variance of the distance at the midpoint, and variance of the direction of each wall with echoes."""
    row = np.flatnonzero(jacobians.kinds[:, 0] == EchoKind.PLANE)
    number = jacobians.kinds[row, 1]
    middle = scene.room.walls[number].mean(axis=1)
    theta = jacobians.parameters[row, 1]
    along = (np.stack([-np.sin(theta), np.cos(theta)], axis=-1) * middle).sum(-1)
    reflector = covariance.reshape(len(jacobians.parameters), 2, len(jacobians.parameters), 2)[row, :, row]
    to_middle = np.stack([-np.ones(len(row)), along], axis=-1)
    return number, np.einsum("ki,kij,kj->k", to_middle, reflector, to_middle), reflector[:, 1, 1].copy()
