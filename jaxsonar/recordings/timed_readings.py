"""Logs from sonar readings and poses that a file holds in messages of their own, each with its time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from jaxsonar.scans.firing_poses import poses_at
from jaxsonar.scans.scan_log import Log

MAX_EXTRAPOLATION = 1.0
"""Longest time before the first and after the last pose of the odometry in which a scan still has a pose, seconds."""


@dataclass(eq=False)
class TimedReadings:
    """Sonar scans and poses in the order of their file."""

    stamp: list[float] = field(default_factory=list)
    """Time of each scan, seconds; NaN if unknown."""
    pose: list[tuple[float, float, float] | None] = field(default_factory=list)
    """world_from_robot of each scan: the last pose before it in the file, metres and radians; None if there is none."""
    ranges: list[dict[int, float]] = field(default_factory=list)
    """Range of each sensor of each scan, metres; NaN: it heard nothing."""
    odometry: list[tuple[float, float, float, float]] = field(default_factory=list)
    """Time (s) and pose (m, m, rad); the time is NaN if unknown."""

    def add_pose(self, stamp: float, x: float, y: float, theta: float) -> None:
        """Add a pose of the robot."""
        self.odometry.append((stamp, x, y, theta))

    def add_scan(self, stamp: float, ranges: dict[int, float]) -> None:
        """Add a sonar scan."""
        self.stamp.append(stamp)
        self.pose.append(self.odometry[-1][1:] if self.odometry else None)
        self.ranges.append(ranges)

    def as_log(self, on_note: Callable[[str], None]) -> Log:
        """The scans as a log. The pose of a scan is interpolated at its time, if both have times.

        Args:
            on_note: called with one line if scans have no pose.
        """
        stamp = np.array(self.stamp, np.float64)
        pose = np.array([(np.nan,) * 3 if one is None else one for one in self.pose], np.float64).reshape(-1, 3)
        samples = np.array(self.odometry, np.float64).reshape(-1, 4)
        samples = _ascending(samples)
        if len(samples):
            timed = np.isfinite(stamp)
            pose[timed] = _poses_at(samples, stamp[timed])
        without = int(np.isnan(pose[:, 0]).sum())
        if without:
            on_note(f"{without} of {len(stamp)} scans have no pose: there is no odometry at their time")
        counts = [len(ranges) for ranges in self.ranges]
        sensor = np.array([sensor for ranges in self.ranges for sensor in ranges], np.int64)
        return Log.from_echoes(
            np.repeat(np.arange(len(stamp)), counts),
            sensor,
            sensor.copy(),
            np.array([value for ranges in self.ranges for value in ranges.values()], np.float64),
            stamp=stamp,
            pose=pose,
            odometry=samples if len(samples) > 1 else None,
        )


def listed_numbers(numbers: Sequence[int]) -> str:
    """Numbers in words; runs are joined: ``0, 16 to 23``."""
    ordered, parts = sorted(numbers), []
    begin = 0
    for k in range(1, len(ordered) + 1):
        if k == len(ordered) or ordered[k] != ordered[k - 1] + 1:
            first, last = ordered[begin], ordered[k - 1]
            parts.append(str(first) if first == last else f"{first} to {last}")
            begin = k
    return ", ".join(parts)


def _ascending(samples: Float[np.ndarray, "samples 4"]) -> Float[np.ndarray, "_ 4"]:
    """Samples with a time, in ascending order; of several at one time, the last."""
    samples = samples[np.isfinite(samples[:, 0])][::-1]
    return samples[np.unique(samples[:, 0], return_index=True)[1]]


def _poses_at(samples: Float[np.ndarray, "samples 4"], stamp: Float[np.ndarray, " scans"]) -> Float[np.ndarray, "_ 3"]:
    """Poses at some times, interpolated; the first and the last pose slightly beyond; NaN farther away."""
    time, pose = samples[:, 0], samples[:, 1:]
    at = np.repeat(pose, len(stamp), axis=0) if len(time) == 1 else poses_at(time, pose, stamp, extrapolation=0.0)
    at[(stamp < time[0] - MAX_EXTRAPOLATION) | (stamp > time[-1] + MAX_EXTRAPOLATION)] = np.nan
    return at
