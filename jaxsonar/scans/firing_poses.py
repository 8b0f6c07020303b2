"""Poses of the robot at the time of each reading."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxsonar.geometry.se2 import compose, interpolate, relative
from jaxsonar.scans.measured_paths import path_rows
from jaxsonar.scans.readings import explicit_log, measurement_times
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class FiringSettings:
    """Constants of the poses of firings. Chosen by hand."""

    max_extrapolation: float = 1.0
    """Largest extrapolation of the motion beyond the first and the last known pose, in intervals between poses."""


SETTINGS = FiringSettings()


def reading_motion(log: Log) -> Float[np.ndarray, "readings 3"] | None:
    """scan_from_robot of each reading: x, y (m), theta (rad) of the robot when the reading was measured.

    The motion between the stamp of the scan and the time of measurement, stamp + t - age, is interpolated in the
    odometry of the log (``Log.odometry``) or, without it, in the poses of its scans. Readings of scans without stamp or
    pose, and all readings if fewer than two poses are known, belong to the pose of their scan.

    Returns:
        The poses; None if every reading belongs to the pose of its scan.
    """
    if not (log.t.any() or log.age.any()):
        return None
    time, pose = _known_poses(log)
    if len(time) < 2:
        return None
    scan = log.echo_scan
    moves = np.isfinite(log.stamp) & np.isfinite(log.pose).all(axis=1)
    rows = np.flatnonzero(moves[scan] & ((log.t != 0) | (log.age != 0)))
    motion = np.zeros((len(scan), 3))
    at_stamp = poses_at(time, pose, log.stamp[scan[rows]])
    motion[rows] = relative(at_stamp, poses_at(time, pose, measurement_times(log)[rows]))
    return motion if motion.any() else None


def reading_poses(log: Log) -> Float[np.ndarray, "readings 3"]:
    """world_from_robot when each reading was measured: x, y (m), theta (rad); NaN for scans without a pose."""
    pose, motion = log.pose[log.echo_scan], reading_motion(log)
    return pose if motion is None else compose(pose, motion)


def path_poses(ring: Ring, log: Log) -> Float[np.ndarray, "scans paths 3"] | None:
    """scan_from_robot of each path of each scan, as ``reading_motion``; zero for paths that were not measured.

    A path that heard nothing has the time of its transmitter (``explicit_log``), also without a silent reading.

    Returns:
        The poses; None if every reading belongs to the pose of its scan.
    """
    log = explicit_log(log) if log.t.any() else log
    motion = reading_motion(log)
    if motion is None:
        return None
    path = path_rows(ring, log.tx, log.rx)
    known = path >= 0
    poses = np.zeros((len(log), len(ring.paths), 3))
    poses[log.echo_scan[known], path[known]] = motion[known]
    return poses


def path_poses_of_scan(ring: Ring, scan: Scan) -> Float[np.ndarray, "paths 3"] | None:
    """The row of one scan in ``path_poses``; None if every reading belongs to the pose of the scan."""
    if scan.odometry is None:
        return None
    poses = path_poses(ring, scan.as_log())
    return None if poses is None else poses[0]


def _known_poses(log: Log) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, "samples 3"]]:
    """Times, ascending, and poses between which motion is interpolated."""
    samples = log.pose_samples
    samples = samples[np.isfinite(samples).all(axis=1)]
    time, first = np.unique(samples[:, 0], return_index=True)
    return time, samples[first, 1:]


def poses_at(
    time: Float[np.ndarray, " samples"],
    pose: Float[np.ndarray, "samples 3"],
    at: Float[np.ndarray, " times"],
    *,
    extrapolation: float = SETTINGS.max_extrapolation,
) -> Float[np.ndarray, "times 3"]:
    """Poses at some times, interpolated between two or more samples.

    Before the first and after the last sample they are extrapolated by up to ``extrapolation`` intervals.
    """
    before = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    fraction = (at - time[before]) / (time[before + 1] - time[before])
    fraction = np.clip(fraction, -extrapolation, 1 + extrapolation)
    return interpolate(pose[before], pose[before + 1], fraction)
