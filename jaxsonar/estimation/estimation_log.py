"""Logs as the estimators of poses, maps and rings take them."""

from dataclasses import replace

from jaxsonar.scans.readings import unique_readings
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.single_firings import group_firings


def estimation_log(log: Log) -> Log:
    """The log with full scans, every measurement once, and the motion between its readings as measured.

    - Firings that are scans of their own are merged into scans in which every transmitter fires once
      (``group_firings``). Every pose that is estimated later belongs to such a scan.
    - Readings that were not renewed are left out (``unique_readings``).
    - If readings have times of their own, the poses of the log become its ``odometry``. Otherwise the motion between
      the readings of a scan would change with every estimate of the poses.

    A log without these features is returned unchanged.
    """
    log = unique_readings(group_firings(log))
    known = log.motion
    return log if known is log.odometry or known is None or len(known) < 2 else replace(log, odometry=known)
