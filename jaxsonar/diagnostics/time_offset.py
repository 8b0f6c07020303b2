"""Time offset between echoes and poses: the search over whole steps, before ``motion_fit`` estimates it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.plausibility.pose_agreement import agreement, part_of_groups
from jaxsonar.scans.firing_poses import poses_at
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class TimeOffsetSettings:
    """Constants of the search. Chosen by hand."""

    motion: float = 0.1
    """Motion in one step of the search, metres; a turn of 1 rad counts like 1 m."""
    moving: float = 0.75
    """Quantile of the speeds of the robot that gives the length of a step."""
    limits: tuple[float, float] = (0.02, 2.0)
    """Shortest and longest step, seconds."""
    steps: tuple[int, ...] = (1, 2, 3, 4, 6, 8, 10, 12)
    """Time offsets that are tried, in steps, either way."""
    patience: int = 2
    """The search ends after this many offsets that explain less than the best one."""
    starts: int = 2
    """Best offsets from which the estimation starts."""
    most_echoes: int = 48
    """Echoes of a scan that are compared."""


SETTINGS = TimeOffsetSettings()


def search_step(log: Log) -> float:
    """Time in which the moving robot covers ``SETTINGS.motion``, seconds; NaN if its motion in time is not known."""
    samples = log.pose_samples
    samples = samples[np.isfinite(samples).all(axis=1)]
    elapsed = np.diff(samples[:, 0])
    motion = np.hypot(*np.diff(samples[:, 1:3], axis=0).T) + np.abs(wrap_angle(np.diff(samples[:, 3])))
    speed = motion[elapsed > 0] / elapsed[elapsed > 0]
    if not (speed > 0).any():
        return float("nan")
    return float(np.clip(SETTINGS.motion / np.quantile(speed[speed > 0], SETTINGS.moving), *SETTINGS.limits))


def with_later_poses(log: Log, lag: float) -> Log:
    """The log in which the poses of a later time (seconds) belong to the echoes; scans without a stamp keep theirs."""
    samples = log.pose_samples
    samples = samples[np.isfinite(samples).all(axis=1)]
    time, first = np.unique(samples[:, 0], return_index=True)
    known = np.isfinite(log.stamp) & np.isfinite(log.pose).all(axis=1)
    pose = log.pose.copy()
    pose[known] = poses_at(time, samples[first, 1:], log.stamp[known] + lag)
    odometry = log.odometry
    if odometry is not None:
        odometry = np.column_stack([odometry[:, 0] - lag, odometry[:, 1:]])
    return replace(log, pose=pose, odometry=odometry)


def _mean_support(ring: Ring, log: Log, groups: Sequence[Int[np.ndarray, "_"]]) -> float:
    """The mean support of some echoes of each scan, the same ones for every time offset."""
    part = part_of_groups(log, groups, most_echoes=SETTINGS.most_echoes)
    return agreement(ring, *part, support_only=True).mean_support


def search_time_offsets(ring: Ring, log: Log, groups: Sequence[Int[np.ndarray, "_"]]) -> list[float]:
    """Time offsets (seconds) with which the echoes agree better than without, the best first.

    Args:
        ring: the sensors.
        log: the scans.
        groups: rows of the scans that are compared.
    """
    step, given, found = search_step(log), _mean_support(ring, log, groups), []
    for sign in (1, -1) if np.isfinite(step) else ():
        best, misses = given, 0
        for steps in SETTINGS.steps:
            lag = sign * steps * step
            agrees = _mean_support(ring, with_later_poses(log, lag), groups)
            misses = 0 if agrees > best else misses + 1
            best = max(best, agrees)
            found.append((agrees, lag))
            if misses == SETTINGS.patience:
                break
    return [lag for agrees, lag in sorted(found, reverse=True)[: SETTINGS.starts] if agrees > given]
