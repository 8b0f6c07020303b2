"""What no unbiased estimate of poses and walls goes below: the Cramer-Rao bound of a simulated run.

The association is known from the simulator, its noise is white, and odometry is as wrong as ``simulate_odometry`` makes it. The
formulas are those of ``benchmarks.calibration.accuracy``, their slopes central differences: nothing is shared with the kernels.
Echoes of second order are no part of it, nor is that corners lie where walls meet or that walls go on behind a door, so
that it is a little too large where the library uses that. The first pose is known; it is the frame.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import solveh_banded

from benchmarks.calibration.cramer_rao import LOOSE, NUDGE, reports
from benchmarks.calibration.cramer_rao import scene as reflectors_of
from benchmarks.slam.scenarios import DISTANCE, TURN, Scene
from jaxsonar.geometry.se2 import relative, wrap_angle
from jaxsonar.simulation.traced_echoes import EchoKind
from jaxsonar.simulation.wheel_odometry import odometry_step_sd

EXACT = 1e-5
"""Metres and radians: what is exact in odometry (a robot that turns on the spot stays there) is known so well."""


@dataclass(frozen=True, eq=False)
class Bound:
    """Least covariances; world frame, metres and radians."""

    poses: Float[np.ndarray, "scans 3 3"]
    """Of every pose, the first one known."""
    wall: Int[np.ndarray, " walls"]
    """Walls of the room that were heard."""
    distance: Float[np.ndarray, " walls"]
    """Variance of their distance from where they are, square metres: in the middle of each."""
    turn: Float[np.ndarray, " walls"]
    """Variance of their direction, square radians."""

    @property
    def ate(self) -> float:
        """Root mean square of the positions' errors, metres."""
        return float(np.sqrt(np.mean(self.poses[:, 0, 0] + self.poses[:, 1, 1])))

    @property
    def ate_heading(self) -> float:
        """The same of the headings, radians."""
        return float(np.sqrt(np.mean(self.poses[:, 2, 2])))


def bound(scene: Scene, *, distance: float = DISTANCE, turn: float = TURN) -> Bound:
    """Of a run through a place that is unknown at first.

    Args:
        scene: the truth and what was heard.
        distance: what odometry is wrong by, as ``simulate_odometry`` takes it.
        turn: likewise.
    """
    slopes = _Slopes.of(scene)
    count, scans = len(slopes.places), len(scene.poses)
    pose, both, place = slopes.information(scans)
    place[:, np.arange(2), np.arange(2)] += 1 / LOOSE**2
    on_first, on_second, between = _links(scene.poses, distance, turn)
    pose[:-1] += on_first
    pose[1:] += on_second
    free = slice(1, None)  # the first pose is known
    chain = _Chain(pose[free], between[1:])
    border = both[free].reshape(3 * (scans - 1), 2 * count)
    solved = chain.solve(border) if scans > 1 else border
    whole = np.zeros((2 * count, 2 * count))
    for k in range(count):
        whole[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = place[k]
    places = np.linalg.inv(whole - border.T @ solved)
    rows = solved.reshape(scans - 1, 3, 2 * count)
    poses = np.zeros((scans, 3, 3))
    for begin in range(0, scans - 1, 512):
        some = rows[begin : begin + 512]
        poses[1 + begin : 1 + begin + len(some)] = (some @ places) @ some.transpose(0, 2, 1)
    poses[free] += chain.blocks()
    return Bound(poses, *_walls(scene, slopes, places))


def pose_bound(scene: Scene) -> Float[np.ndarray, "scans 3 3"]:
    """Covariance of every pose by itself, from its own scan, in a room that is known."""
    pose, _, _ = _Slopes.of(scene).information(len(scene.poses))
    return np.linalg.inv(pose)


@dataclass(frozen=True, eq=False)
class _Slopes:
    """How the reports of all first-order echoes change, in units of the noise."""

    scan: np.ndarray  # (echoes,)
    own: np.ndarray  # (echoes,) its reflector
    kinds: np.ndarray  # (reflectors, 2) kind and number
    places: np.ndarray  # (reflectors, 2)
    by_pose: np.ndarray  # (echoes, 3)
    by_place: np.ndarray  # (echoes, 2)

    @classmethod
    def of(cls, scene: Scene) -> "_Slopes":
        heard = scene.heard
        first, own, places = reflectors_of(scene.room, heard)
        kind, scan = heard.kind[first], heard.scan[first]
        ends = np.asarray(scene.ring.position)[scene.ring.paths[heard.path[first]]]
        scale = np.full(len(first), 343.2 / float(scene.ring.speed_of_sound))

        def slope(place: np.ndarray, pose: np.ndarray) -> np.ndarray:
            at = [(places[own] + way * place, scene.poses[scan] + way * pose) for way in (NUDGE, -NUDGE)]
            up, down = (reports(kind, *one, ends, scale) for one in at)
            return (up - down) / (2 * NUDGE * scene.sigma)

        by_pose = np.stack([slope(np.zeros(2), one) for one in np.eye(3)], axis=-1)
        by_place = np.stack([slope(one, np.zeros(3)) for one in np.eye(2)], axis=-1)
        kinds = np.unique(np.stack([heard.kind, heard.reflector])[:, first], axis=1).T  # in the order of places
        return cls(scan, own, kinds, places, by_pose, by_place)

    def information(self, scans: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of poses (scans, 3, 3), of poses with reflectors (scans, 3, reflectors, 2), of these (reflectors, 2, 2)."""
        count = len(self.places)
        pose, both = np.zeros((scans, 3, 3)), np.zeros((scans, 3, count, 2))
        place = np.zeros((count, 2, 2))
        np.add.at(pose, self.scan, self.by_pose[:, :, None] * self.by_pose[:, None])
        np.add.at(place, self.own, self.by_place[:, :, None] * self.by_place[:, None])
        cross = self.by_pose[:, :, None] * self.by_place[:, None]
        np.add.at(both.transpose(0, 2, 1, 3), (self.scan, self.own), cross)
        return pose, both, place


def _links(poses: np.ndarray, distance: float, turn: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Information of every step: on the pose before it, on the one after it, and between these, (steps, 3, 3) each."""
    sd = np.maximum(odometry_step_sd(poses, distance=distance, turn=turn), EXACT)
    step = relative(poses[:-1], poses[1:])
    ahead = np.arctan2(step[:, 1], step[:, 0])
    c, s = np.cos(ahead), np.sin(ahead)

    def slope(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        up, down = (relative(poses[:-1] + way * a, poses[1:] + way * b) for way in (NUDGE, -NUDGE))
        off = up - down
        off[:, 2] = wrap_angle(off[:, 2])
        along, across = c * off[:, 0] + s * off[:, 1], c * off[:, 1] - s * off[:, 0]
        return np.stack([along, across, off[:, 2]], axis=-1) / (2 * NUDGE * sd)

    first = np.stack([slope(one, np.zeros(3)) for one in np.eye(3)], axis=-1)
    second = np.stack([slope(np.zeros(3), one) for one in np.eye(3)], axis=-1)
    turned = first.transpose(0, 2, 1)
    return turned @ first, second.transpose(0, 2, 1) @ second, turned @ second


class _Chain:
    """A matrix of 3 x 3 blocks along the diagonal and next to it."""

    def __init__(self, diagonal: np.ndarray, upper: np.ndarray):
        self.diagonal, self.upper = diagonal, upper

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The inverse times a matrix."""
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
        """The blocks along the diagonal of the inverse."""
        count = len(self.diagonal)
        before, after = self.diagonal.copy(), self.diagonal.copy()
        for k in range(1, count):
            before[k] -= self.upper[k - 1].T @ np.linalg.solve(before[k - 1], self.upper[k - 1])
        for k in range(count - 2, -1, -1):
            after[k] -= self.upper[k] @ np.linalg.solve(after[k + 1], self.upper[k].T)
        return np.linalg.inv(before + after - self.diagonal)


def _walls(scene: Scene, slopes: _Slopes, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Number, variance of the distance in the middle, and of the direction, of every wall that was heard."""
    row = np.flatnonzero(slopes.kinds[:, 0] == EchoKind.PLANE)
    number = slopes.kinds[row, 1]
    middle = scene.room.walls[number].mean(axis=1)
    theta = slopes.places[row, 1]
    along = (np.stack([-np.sin(theta), np.cos(theta)], axis=-1) * middle).sum(-1)
    own = covariance.reshape(len(slopes.places), 2, len(slopes.places), 2)[row, :, row]
    to_middle = np.stack([-np.ones(len(row)), along], axis=-1)
    return number, np.einsum("ki,kij,kj->k", to_middle, own, to_middle), own[:, 1, 1].copy()
