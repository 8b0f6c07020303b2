"""Readings of single sensors as scans: each sensor at most once in a scan, each reading with its own time."""

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.recordings.rosbag_odometry import Odometry
from jaxsonar.scans.asked_pairs import NO_PAIRS
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.single_firings import SETTINGS


def log_from_readings(
    time: Float[np.ndarray, " readings"],
    sensor: Int[np.ndarray, " readings"],
    reported: Float[np.ndarray, " readings"],
    *,
    order: Int[np.ndarray, " readings"],
    odometry: Odometry | None,
) -> Log:
    """An explicit log of direct readings.

    A scan ends before the second reading of a sensor, after ``SingleFiringSettings.max_scan_duration``, and where the
    odometry has a gap or jumps. Its stamp is the time of its first reading, and its pose is interpolated there.

    Args:
        time: seconds, in any order.
        sensor: sensor of the ring. Readings of one sensor at one time in ``order`` are echoes of one firing.
        reported: half path lengths, metres; NaN: nothing was heard.
        order: number of the message, which orders equal times.
        odometry: poses of the robot; None if they are unknown.
    """
    rows = np.lexsort((order, time))
    time, sensor, reported, order = time[rows], sensor[rows], reported[rows], order[rows]
    state = np.zeros(len(time), np.int64)
    if odometry is not None and len(odometry.samples) > 1:
        state = np.where(odometry.known(time), odometry.part_at(time), -1)
    scan = _scans(time, sensor, order, state)
    first = np.flatnonzero(np.diff(scan, prepend=-1))
    stamp = time[first]
    pose = np.full((len(stamp), 3), np.nan) if odometry is None else odometry.poses(stamp)
    return Log.from_echoes(
        scan,
        sensor,
        sensor,
        reported,
        t=time - stamp[scan],
        stamp=stamp,
        pose=pose,
        asked=NO_PAIRS,
        odometry=None if odometry is None or not np.isfinite(pose).any() else odometry.samples,
    )


def _scans(
    time: Float[np.ndarray, " readings"],
    sensor: Int[np.ndarray, " readings"],
    order: Int[np.ndarray, " readings"],
    state: Int[np.ndarray, " readings"],
) -> Int[np.ndarray, " readings"]:
    """Number of the scan of each reading."""
    scan = np.zeros(len(time), np.int64)
    message_of: dict[int, int] = {}
    current, begin, last_state = 0, 0.0, 0
    rows = zip(time.tolist(), sensor.tolist(), order.tolist(), state.tolist(), strict=True)
    for row, (now, one, message, now_state) in enumerate(rows):
        repeated = message_of.get(one, message) != message
        if not message_of or repeated or now - begin > SETTINGS.max_scan_duration or now_state != last_state:
            current += bool(message_of)
            begin, last_state = now, now_state
            message_of = {}
        message_of[one] = message
        scan[row] = current
    return scan
