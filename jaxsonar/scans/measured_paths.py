"""What a scan measured: the paths that fired and were listened to, whether or not they heard anything.

Only a path that was measured can be silent. A path without a measurement is no evidence at all.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class ReadingAgeSettings:
    """Constants for readings that were not renewed. Chosen by hand."""

    same_measurement: float = 2e-3
    """Readings of one path with equal ranges whose times of measurement differ by less are one measurement, seconds.
    It exceeds the rounding of milliseconds, and is shorter than the time between two firings of a sensor. Coarser
    columns have a larger tolerance (``_tolerance``)."""
    digits: tuple[int, ...] = (0, 1, 2, 3)
    """Decimal digits of coarse columns."""
    exact: float = 1e-5
    """Largest difference of a number of seconds from a decimal number that it shows; doubles hold stamps since 1970
    with 3e-7 s."""


SETTINGS = ReadingAgeSettings()


def measured_paths(ring: Ring, log: Log) -> Bool[np.ndarray, "scans paths"]:
    """Which paths of a ring each scan of a log measured.

    These are the paths with a reading in the scan, and those that every scan measured (``Log.asked``). A path that only
    has a repeated old reading (``is_repeated``) was not measured. The result may be a read-only broadcast array.

    Args:
        ring: the sensors; sensors and pairs that it does not have are ignored.
        log: the scans.
    """
    always, repeated = _asked_paths(ring, log.asked), is_repeated(log)
    if always.all() and not repeated.any():
        return np.broadcast_to(always, (len(log), len(always)))
    path = path_rows(ring, log.tx, log.rx)
    known = path >= 0
    if always[path[known]].all() and not repeated.any():
        return np.broadcast_to(always, (len(log), len(always)))
    measured = np.tile(always, (len(log), 1))
    scan = log.echo_scan
    old = known & repeated
    measured[scan[old], path[old]] = False
    new = known & ~repeated
    measured[scan[new], path[new]] = True
    return measured


def is_repeated(log: Log) -> Bool[np.ndarray, " readings"]:
    """Readings that were not renewed and whose original the log also holds, in an earlier scan.

    An unrenewed reading is evidence for the pose at which it was measured, once. If the log does not hold the original,
    the first repetition stands for it. In scans without a stamp, the original is known only to be in the scan before:
    there, a reading with an age is repeated if the scan before holds the same range of its path.
    """
    repeated = np.zeros(len(log.tx), bool)
    if not log.age.any():
        return repeated
    timed = np.isfinite(log.stamp)[log.echo_scan]
    measured_at = np.where(timed, measurement_times(log), np.nan)
    # One group for each path and range (silent readings have a group of their own), sorted by time of measurement.
    reported = np.where(np.isnan(log.range), -1.0, log.range)
    order = np.lexsort((measured_at, reported, log.rx, log.tx))
    alike = np.ones(len(order) - 1, bool)
    for column in (log.tx, log.rx, reported):
        alike &= column[order[1:]] == column[order[:-1]]
    same = alike & (np.diff(measured_at[order]) < _tolerance(log))
    begins = np.flatnonzero(np.append(True, ~same))
    # Of the readings of one measurement, those of the first scan stand for it.
    scan = log.echo_scan[order]
    first = np.repeat(np.minimum.reduceat(scan, begins), np.diff(np.append(begins, len(order))))
    repeated[order] = scan > first
    if not timed.all():
        code = np.cumsum(np.append(0, ~alike)) * (len(log) + 1) + scan + 1
        repeated[order] |= ~timed[order] & np.isin(code - 1, code)
    return repeated & (log.age > 0)


def _tolerance(log: Log) -> float:
    """Largest difference between two computed times of one measurement, seconds.

    It follows from the rounding of the columns: a stamp of each of two readings, and one age. It is at most half the
    usual time between scans.
    """
    stamp = log.stamp[np.isfinite(log.stamp)]
    rounding = _unit(stamp) + _unit(log.t) + _unit(log.age) / 2
    period = np.diff(stamp)
    period = float(np.median(period[period > 0])) if (period > 0).any() else np.inf
    return max(SETTINGS.same_measurement, min(rounding + SETTINGS.exact, period / 2))


def _unit(seconds: Float[np.ndarray, " values"]) -> float:
    """Unit of the last decimal digit that numbers show; 0 if they show more than ``SETTINGS.digits`` or are all 0."""
    if not seconds.any():
        return 0.0
    for digits in SETTINGS.digits:
        if (np.abs(seconds - np.round(seconds, digits)) < SETTINGS.exact).all():
            return 10.0**-digits
    return 0.0


def measurement_times(log: Log) -> Float[np.ndarray, " readings"]:
    """When each reading was measured: stamp + t - age, seconds. A scan without a stamp has its number as stamp."""
    stamp = np.where(np.isnan(log.stamp), log.scan, log.stamp)
    return stamp[log.echo_scan] + log.t - log.age


def unique_readings(log: Log) -> Log:
    """The log without readings that were not renewed and whose original it also holds; it is unchanged without ages.

    The paths of removed readings count as not measured. Therefore the result is explicit: it holds a row without a
    range for every other path that a scan measured and that heard nothing.
    """
    if not is_repeated(log).any():
        return log
    log = explicit_log(log)
    return without_readings(log, is_repeated(log))


def explicit_log(log: Log) -> Log:
    """The log with a silent reading for each path that a scan measured (``Log.asked``) and has no reading of.

    A silent reading has the time ``t`` of its transmitter (``firing_times``).
    """
    if not len(log.asked):
        return log
    scan = np.repeat(np.arange(len(log)), len(log.asked))
    tx, rx = np.tile(log.asked, (len(log), 1)).T
    return with_silent_readings(log, scan, tx, rx)


def firing_times(log: Log, group: Int[np.ndarray, " readings"], groups: int) -> Float[np.ndarray, "scans groups"]:
    """``Log.t`` of each group of transmitters in each scan, seconds.

    A group without a reading in a scan has the time of its last reading in the log; without any reading 0.

    Args:
        log: the scans.
        group: number of the group that fired, of each reading.
        groups: number of groups.
    """
    late = np.zeros(groups)
    late[group] = log.t
    late = np.tile(late, (len(log), 1))
    late[log.echo_scan, group] = log.t
    return late


def with_silent_readings(
    log: Log, scan: Int[np.ndarray, " paths"], tx: Int[np.ndarray, " paths"], rx: Int[np.ndarray, " paths"]
) -> Log:
    """The log with a silent reading for each of these paths of a scan that it holds no reading of.

    The result is explicit (``Log.asked``).

    Args:
        log: the scans.
        scan: row of the scan in the log.
        tx: transmitter.
        rx: receiver.
    """
    sensors = int(max(column.max(initial=0) for column in (log.tx, log.rx, tx, rx))) + 1
    silent = ~np.isin(_pair_codes(scan, tx, rx, sensors), _pair_codes(log.echo_scan, log.tx, log.rx, sensors))
    scan, tx, rx = scan[silent], tx[silent], rx[silent]
    nothing, t = np.full(len(scan), np.nan), np.zeros(len(scan))
    if log.t.any():
        transmitters, column = np.unique(np.concatenate([log.tx, tx]), return_inverse=True)
        read, added_to = np.split(column.ravel(), [len(log.tx)])
        t = firing_times(log, read, len(transmitters))[scan, added_to]
    added = {"tx": tx, "rx": rx, "range": nothing, "amplitude": nothing, "t": t, "age": np.zeros(len(scan))}
    rows = np.concatenate([log.echo_scan, scan])
    order = np.argsort(rows, kind="stable")
    columns = {name: np.concatenate([getattr(log, name), column])[order] for name, column in added.items()}
    start = np.searchsorted(rows[order], np.arange(len(log) + 1))
    return replace(log, start=start, **columns, asked=np.zeros((0, 2), np.int64))


def without_readings(log: Log, removed: Bool[np.ndarray, " readings"]) -> Log:
    """The log without some readings; what its scans measured stays as it is (``Log.asked``)."""
    start = np.searchsorted(log.echo_scan[~removed], np.arange(len(log) + 1))
    columns = {name: getattr(log, name)[~removed] for name in ("tx", "rx", "range", "amplitude", "t", "age")}
    return replace(log, start=start, **columns)


def full_wall_paths(
    ring: Ring, counts: Float[np.ndarray, "rows paths"], *, directions: int = 360
) -> Float[np.ndarray, " rows"]:
    """Number of measurements that receive a wide wall: the mean over all directions in which any of them receives it.

    For one measurement of every path it equals ``kernels.full_wall_paths``.

    Args:
        ring: the sensors.
        counts: number of measurements of each path, in the scan or window of each row.
        directions: number of directions of the mean.
    """
    geometry, key = ring.exact_paths, ("full_wall_paths", directions)
    if key not in ring.cache:
        angle = (np.arange(directions) + 0.5) * (2 * np.pi / directions)
        received = np.mod(angle - geometry.start[:, None], 2 * np.pi) < geometry.width[:, None]
        ring.cache[key] = received.astype(np.float32)
    covered = ((counts > 0).astype(np.float32) @ ring.cache[key] > 0).mean(axis=1)
    return counts @ geometry.width / (2 * np.pi * np.maximum(covered, 1 / directions))


def equivalent_scans(
    ring: Ring, counts: Num[np.ndarray, "rows paths"] | Bool[np.ndarray, "rows paths"]
) -> Float[np.ndarray, " rows"]:
    """Number of scans of all paths to which the measurements of each row amount.

    It is the ratio of the numbers of measurements that receive a wide wall (``full_wall_paths``). Where anything was
    measured, a wall is received by one measurement at least.

    Args:
        ring: the sensors.
        counts: number of measurements of each path, in the scan or window of each row.
    """
    whole = np.maximum(full_wall_paths(ring, np.ones((1, len(ring.paths)))), 1)
    if counts.dtype == bool and len(counts) > 1:  # few rows are distinct
        packed = np.packbits(counts, axis=1)
        _, first, row = np.unique(packed.view(f"V{packed.shape[1]}"), return_index=True, return_inverse=True)
        counts = counts[first]
    else:
        row = np.arange(len(counts))
    return (np.maximum(full_wall_paths(ring, counts.astype(np.float64)), 1) / whole)[row.ravel()]


def _asked_paths(ring: Ring, asked: Int[np.ndarray, "pairs 2"]) -> Bool[np.ndarray, " paths"]:
    """Mask of the pairs; the latest one is stored in ``Ring.cache``, because all parts of a log have the same pairs."""
    latest = ring.cache.get("asked_paths")
    if latest is None or not np.array_equal(latest[0], asked):
        always = np.zeros(len(ring.paths), bool)
        path = path_rows(ring, *asked.T)
        always[path[path >= 0]] = True
        always.setflags(write=False)
        ring.cache["asked_paths"] = latest = asked, always
    return latest[1]


def path_rows(ring: Ring, tx: Int[np.ndarray, " pairs"], rx: Int[np.ndarray, " pairs"]) -> Int[np.ndarray, " pairs"]:
    """Rows of ``Ring.paths``; -1 for pairs that are no paths of the ring, and for sensors that it does not have."""
    known = (tx < ring.count) & (rx < ring.count)
    path = np.full(len(tx), -1)
    path[known] = ring.path_index[tx[known], rx[known]]
    return path


def _pair_codes(
    scan: Int[np.ndarray, " rows"], tx: Int[np.ndarray, " rows"], rx: Int[np.ndarray, " rows"], sensors: int
) -> Int[np.ndarray, " rows"]:
    """One number for each scan and pair of sensors."""
    return (scan * sensors + tx) * sensors + rx
