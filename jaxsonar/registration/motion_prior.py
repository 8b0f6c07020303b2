"""Prior distribution of the pose of a scan, from its neighbors, from odometry, and from the usual motion of robots."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.se2 import compose, relative, subtract_poses, wrap_angle
from jaxsonar.registration.settings import FEATURE_SETTINGS as SETTINGS


class MotionPrior(NamedTuple):
    """One component of the prior: a normal distribution of the pose, with a uniform part of the heading."""

    pose: Float[np.ndarray, "3"]
    """Mean, map_from_robot."""
    sd: tuple[float, float]
    """Standard deviations of the position (in x and in y) and of the heading, metres and radians."""
    any_turn: float
    """Probability that the heading is uniformly distributed."""
    probability: float
    """Of this component."""
    straight: bool = False
    """Whether the robot came straight from ``pose``, so that no wall is between."""

    def log_density(self, poses: Float[np.ndarray, "poses 3"]) -> Float[np.ndarray, " poses"]:
        """Log-density of poses, including the probability of the component, nats."""
        offset = subtract_poses(poses, self.pose)
        distance = (offset[:, :2] ** 2).sum(-1) / self.sd[0] ** 2
        turn = offset[:, 2] / self.sd[1]
        normal = (1 - self.any_turn) * np.exp(-(turn**2) / 2) / (np.sqrt(2 * np.pi) * self.sd[1])
        heading = np.log(normal + self.any_turn / (2 * np.pi) + 1e-30)
        return np.log(self.probability) - distance / 2 - np.log(2 * np.pi * self.sd[0] ** 2) + heading

    def information(self) -> Float[np.ndarray, "3 3"]:
        """Inverse covariance; almost none of the heading where any rotation is possible."""
        heading = 1e-3 if self.any_turn else self.sd[1] ** -2
        return np.diag([self.sd[0] ** -2, self.sd[0] ** -2, heading])


def usual_motion(gap: int) -> MotionPrior:
    """Prior of the relative pose of two scans without odometry; ``gap`` is the difference of their numbers."""
    sd = SETTINGS.step_sd * gap**0.75, min(SETTINGS.turn_sd * gap**0.5, 2.0)
    return MotionPrior(np.zeros(3), sd, SETTINGS.any_turn, 1.0)


class MotionModel:
    """Motion of the robot between scans: by odometry, and as observed so far.

    Args:
        odometry: (scans, 3) world_from_robot, drifting, metres and radians; NaN where there is none.
        odometry_sd: standard deviation of odometry, as a fraction of the distance and of the rotation.
    """

    def __init__(self, odometry: Float[np.ndarray, "scans 3"], odometry_sd: float):
        self.odometry, self.odometry_sd = odometry, odometry_sd
        steps = np.linalg.norm(np.diff(odometry[:, :2], axis=0), axis=1)
        turns = np.abs(wrap_angle(np.diff(odometry[:, 2])))
        # Gaps count as zero: NaN would make all later sums NaN.
        self._distance = np.concatenate([[0.0], np.cumsum(np.nan_to_num(steps))])
        self._rotation = np.concatenate([[0.0], np.cumsum(np.nan_to_num(turns))])

    def has_odometry(self, scan: int | np.integer) -> bool:
        """Whether a scan has odometry."""
        return bool(np.isfinite(self.odometry[scan, 0]))

    def priors(
        self, poses: Float[np.ndarray, "scans 3"], anchors: Int[np.ndarray, " anchors"], scan: int
    ) -> list[MotionPrior]:
        """Components of the prior of a scan; the widest is the last.

        Args:
            poses: map_from_robot of the registered scans, NaN for others.
            anchors: the nearest registered scans before and after.
            scan: row of the scan.
        """
        nearest = anchors[np.argmin(np.abs(anchors - scan))]
        measured = self.has_odometry(scan) and self.has_odometry(nearest)
        priors = [self._by_odometry(poses, nearest, scan)] if measured else []
        # Between two registered scans: their mean, weighted by nearness, with the variance of both together.
        gaps = np.abs(anchors - scan).astype(float)
        weight = 1 / gaps**2
        mean = poses[nearest].copy()
        mean[:2] = (weight[:, None] * poses[anchors, :2]).sum(0) / weight.sum()
        mean[2] += float((weight * wrap_angle(poses[anchors, 2] - mean[2])).sum() / weight.sum())
        steps = float(np.sqrt(1 / weight.sum()))
        step, turn = _observed_motion(poses)
        sd = (step * steps**0.75, min(turn * steps**0.5, 2.0))
        adjacent = len(anchors) == 1 and bool(gaps[0] == 1)
        probability = SETTINGS.odometry_failure if measured else 1.0
        return [*priors, MotionPrior(mean, sd, SETTINGS.any_turn, probability, straight=adjacent)]

    def _by_odometry(self, poses: Float[np.ndarray, "scans 3"], anchor: int | np.integer, scan: int) -> MotionPrior:
        position_floor, heading_floor = SETTINGS.odometry_sd_floor
        heading = heading_floor + self.odometry_sd * abs(self._rotation[scan] - self._rotation[anchor])
        distance = abs(self._distance[scan] - self._distance[anchor])
        position = position_floor + (self.odometry_sd + heading / 2) * distance
        moved = relative(self.odometry[anchor], self.odometry[scan])
        return MotionPrior(compose(poses[anchor], moved), (position, heading), 0.0, 1 - SETTINGS.odometry_failure)


def _observed_motion(poses: Float[np.ndarray, "scans 3"]) -> tuple[float, float]:
    """Standard deviations of the motion between scans, estimated from consecutive registered scans."""
    motion = relative(poses[:-1], poses[1:])
    motion = motion[np.isfinite(motion[:, 0])]
    step, turn, count = SETTINGS.step_sd, SETTINGS.turn_sd, SETTINGS.prior_motions
    position = (count * step**2 + (motion[:, :2] ** 2).sum() / 2) / (count + len(motion))
    heading = (count * turn**2 + (motion[:, 2] ** 2).sum()) / (count + len(motion))
    return max(step / 2, float(np.sqrt(position))), max(turn / 2, float(np.sqrt(heading)))
