"""Conversion of a device's raw scans to scans of a log."""

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.hardware.scan_assembler import RawScan
from jaxsonar.scans.asked_pairs import NO_PAIRS
from jaxsonar.scans.scan_log import Scan
from jaxsonar.sensors.ring import Ring


def group_paths(ring: Ring) -> Int[np.ndarray, "paths 3"]:
    """Firing group, transmitter and receiver of every path of a ring, for ``ScanAssembler`` and ``ReaderThread``."""
    return np.column_stack([ring.firing_group_of_sensor[ring.paths[:, 0]], ring.paths])


def scan_from_raw(raw: RawScan) -> Scan:
    """A raw scan as a scan of a log: times of flight become ranges, and paths that heard nothing silent readings.

    The scan measured exactly the paths of its readings. Each reading has the time at which its transmitter fired.
    ``odometry`` holds the poses of the firing groups.
    """
    echoes, silent = raw.echoes, np.zeros((0, 3), np.int64) if raw.silent is None else raw.silent
    nothing = np.full(len(silent), np.nan)
    return Scan(
        scan=raw.scan,
        stamp=raw.stamp,
        pose=raw.pose,
        tx=np.concatenate([echoes["tx"].astype(np.int64), silent[:, 1]]),
        rx=np.concatenate([echoes["rx"].astype(np.int64), silent[:, 2]]),
        range=np.concatenate([raw.ranges, nothing]),
        amplitude=np.concatenate([echoes["amplitude"].astype(np.float64), nothing]),
        t=raw.group_time[np.concatenate([raw.group, silent[:, 0]])],
        asked=NO_PAIRS,
        odometry=group_odometry(raw),
    )


def group_odometry(raw: RawScan) -> Float[np.ndarray, "samples 4"] | None:
    """Time (s) and pose of the firing groups with a known pose, in order of time; None if no pose is known."""
    known = np.flatnonzero(np.isfinite(raw.group_pose).all(axis=1))
    order = known[np.argsort(raw.group_time[known], kind="stable")]
    if not len(order):
        return None
    return np.column_stack([raw.stamp + raw.group_time[order], raw.group_pose[order]])
