"""Conversion of a device's raw scans to scans of a log."""

import numpy as np

from jaxsonar.hardware.scan_assembler import RawScan
from jaxsonar.scans.scan_log import Scan


def scan_from_raw(raw: RawScan) -> Scan:
    """A raw scan as a scan of a log: times of flight become ranges, the pose is that of the last firing group."""
    echoes = raw.echoes
    return Scan(
        scan=raw.scan,
        stamp=raw.stamp,
        pose=raw.pose,
        tx=echoes["tx"].astype(np.int64),
        rx=echoes["rx"].astype(np.int64),
        range=raw.ranges,
        amplitude=echoes["amplitude"].astype(np.float64),
    )
