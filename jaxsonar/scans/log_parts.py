"""Logs from parts of a file: the readable scans among unreadable ones, and one log from consecutive parts."""

from collections.abc import Callable

import numpy as np

from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.readings import READING_COLUMNS
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
    names = ("scan", "stamp", "pose", *READING_COLUMNS)
    empty = Log.from_scans([])
    columns = {name: np.concatenate([getattr(log, name) for log in (empty, *logs)]) for name in names}
    echoes = np.concatenate([np.zeros(1, np.int64), *(np.diff(log.start) for log in logs)])
    if not logs:
        return empty
    odometry = None
    if any(log.odometry is not None for log in logs):
        odometry = np.unique(np.concatenate([log.pose_samples for log in logs]), axis=0)
    return Log(start=np.cumsum(echoes), **columns, asked=logs[0].asked, odometry=odometry)
