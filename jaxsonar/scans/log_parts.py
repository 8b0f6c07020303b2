"""Logs from parts of a file: the readable scans among unreadable ones, and one log from consecutive parts."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.scan_log import Log


def readable_runs(read: Callable[[int, int], Log], scans: int) -> tuple[list[tuple[int, Log]], dict[int, str]]:
    """Find the readable runs of scans by bisection.

    Args:
        read: reads the scans a to b (exclusive); raises a SonarError if any of them is unreadable.
        scans: number of scans.

    Returns:
        First row and scans of each run in ascending order, and for each unreadable scan the reason.
    """
    runs, reasons = [], {}
    pending = [(0, scans)]
    while pending:
        begin, end = pending.pop()
        try:
            runs.append((begin, read(begin, end)))
        except SonarError as error:
            if end - begin == 1:
                reasons[begin] = str(error)
            else:
                middle = (begin + end) // 2
                pending += [(middle, end), (begin, middle)]
    return runs, reasons


def concatenate(logs: list[Log]) -> Log:
    """One log from consecutive parts of a log."""
    if len(logs) == 1:
        return logs[0]
    names = ("scan", "stamp", "pose", "tx", "rx", "range", "amplitude", "t", "age")
    empty = Log.from_scans([])
    columns = {name: np.concatenate([getattr(log, name) for log in (empty, *logs)]) for name in names}
    echoes = np.concatenate([np.zeros(1, np.int64), *(np.diff(log.start) for log in logs)])
    if not logs:
        return empty
    odometry = None
    if any(log.odometry is not None for log in logs):
        odometry = np.unique(np.concatenate([_samples(log) for log in logs]), axis=0)
    return Log(start=np.cumsum(echoes), **columns, asked=logs[0].asked, odometry=odometry)


def _samples(log: Log) -> Float[np.ndarray, "samples 4"]:
    """``Log.odometry``, or else the known stamps and poses of the scans."""
    if log.odometry is not None:
        return log.odometry
    known = np.isfinite(log.stamp) & np.isfinite(log.pose).all(axis=1)
    return np.column_stack([log.stamp, log.pose])[known]
