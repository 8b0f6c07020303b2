"""Logs in which every firing is a scan of its own: the order of the transmitters, and the scans that they form."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from jaxsonar.scans.asked_pairs import firing_period
from jaxsonar.scans.readings import with_silent_readings
from jaxsonar.scans.scan_log import Log


@dataclass(frozen=True)
class SingleFiringSettings:
    """Constants of the grouping of single firings. Chosen by hand."""

    max_scan_duration: float = 2.0
    """Longest time between the first and the last firing of a scan, seconds."""
    min_repetitions: float = 3.0
    """Echoes for each transmitter of a firing order, at least. With fewer, an order may appear by chance."""


SETTINGS = SingleFiringSettings()


def group_firings(log: Log) -> Log:
    """Merge firings that are scans of their own into scans in which every transmitter fires once.

    A log whose scans hold several transmitters is returned unchanged. If the log does not list the paths that heard
    nothing, they are added as far as the transmitter is known: by an echo of the same firing, or by a periodic firing
    order that all echoes agree with. A new scan begins with the second firing of a transmitter, where stamps or poses
    are missing, and after ``SingleFiringSettings.max_scan_duration``. A scan has the number, stamp and pose of its
    first firing; ``t`` is the time of the others, and ``odometry`` keeps all poses.
    """
    if len(log) < 2 or len(log.asked):
        return log
    transmitter = _transmitters(log)
    if transmitter is None:
        return log
    if not np.isnan(log.range).any():
        transmitter = _complete_by_order(transmitter)
        log = _with_silent_paths(log, transmitter)
    group = _groups(log, transmitter)
    first, scan = np.flatnonzero(np.diff(group, prepend=-1)), log.echo_scan
    t = log.t + np.where(np.isnan(log.stamp), 0, log.stamp - log.stamp[first[group]])[scan]
    return replace(
        log,
        scan=log.scan[first],
        stamp=log.stamp[first],
        pose=log.pose[first],
        start=np.append(log.start[first], len(log.tx)),
        t=t,
        odometry=log.pose_samples,
    )


def _transmitters(log: Log) -> Int[np.ndarray, " scans"] | None:
    """Transmitter of each scan, -1 without a reading; None if a scan has several, or all have the same."""
    counts = np.diff(log.start)
    if not counts.any():
        return None
    transmitter = np.full(len(log), -1)
    transmitter[counts > 0] = np.minimum.reduceat(log.tx, log.start[:-1][counts > 0])
    if (transmitter[log.echo_scan] != log.tx).any() or (log.tx == log.tx[0]).all():
        return None
    return transmitter


def _complete_by_order(transmitter: Int[np.ndarray, " scans"]) -> Int[np.ndarray, " scans"]:
    """Transmitters with those of silent firings (-1) by the shortest period that all others agree with, if any."""
    heard = np.flatnonzero(transmitter >= 0)
    tx = transmitter[heard]
    _, first, row = np.unique(tx, return_index=True, return_inverse=True)
    if len(tx) < SETTINGS.min_repetitions * len(first):
        return transmitter
    period = firing_period(heard[first], int(np.gcd.reduce(heard - heard[first][row.ravel()])))
    if period is None or period > len(transmitter) // 2:
        return transmitter
    order = np.full(period, -1)
    order[heard % period] = tx
    return np.where(transmitter >= 0, transmitter, order[np.arange(len(transmitter)) % period])


def _with_silent_paths(log: Log, transmitter: Int[np.ndarray, " scans"]) -> Log:
    """The log with a silent reading for every pair that its transmitter reaches anywhere in the log, but not here."""
    pairs = np.unique(np.stack([log.tx, log.rx], axis=-1), axis=0)
    first, last = np.searchsorted(pairs[:, 0], transmitter), np.searchsorted(pairs[:, 0], transmitter, side="right")
    counts = last - first
    scan = np.repeat(np.arange(len(log)), counts)
    row = np.repeat(first - np.cumsum(counts) + counts, counts) + np.arange(len(scan))
    tx, rx = pairs[row].T
    return with_silent_readings(log, scan, tx, rx)


def _groups(log: Log, transmitter: Int[np.ndarray, " scans"]) -> Int[np.ndarray, " scans"]:
    """Number of the merged scan of each firing; firings of unknown transmitters (-1) join the scan before them."""
    has_pose = np.all(np.isfinite(log.pose), axis=1)
    group = np.zeros(len(log), np.int64)
    fired: set[int] = set()
    first = current = 0
    for row, tx in enumerate(transmitter.tolist()):
        late = log.stamp[row] - log.stamp[first]  # NaN without stamps
        joins = tx not in fired and has_pose[row] == has_pose[first] and 0 <= late <= SETTINGS.max_scan_duration
        if row and not joins:
            current, first, fired = current + 1, row, set()
        if tx >= 0:
            fired.add(tx)
        group[row] = current
    return group
