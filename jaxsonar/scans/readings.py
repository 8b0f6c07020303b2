"""Readings of a log: which of them repeat an older one, when they were measured, and silence as readings.

``Log`` itself uses these functions. Therefore they take any object with its columns.
"""

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.scans.asked_pairs import NO_PAIRS

READING_COLUMNS = ("tx", "rx", "range", "amplitude", "t", "age")
"""Columns of a log with one entry per reading."""


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


@runtime_checkable
class _LogColumns(Protocol):
    """The columns of a ``Log``."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __len__(self) -> int: ...
    @property
    def scan(self) -> Int[np.ndarray, " scans"]: ...
    @property
    def stamp(self) -> Float[np.ndarray, " scans"]: ...
    @property
    def start(self) -> Int[np.ndarray, " scans+1"]: ...
    @property
    def tx(self) -> Int[np.ndarray, " readings"]: ...
    @property
    def rx(self) -> Int[np.ndarray, " readings"]: ...
    @property
    def range(self) -> Float[np.ndarray, " readings"]: ...
    @property
    def amplitude(self) -> Float[np.ndarray, " readings"]: ...
    @property
    def t(self) -> Float[np.ndarray, " readings"]: ...
    @property
    def age(self) -> Float[np.ndarray, " readings"]: ...
    @property
    def asked(self) -> Int[np.ndarray, "pairs 2"]: ...
    @property
    def echo_scan(self) -> Int[np.ndarray, " readings"]: ...


AnyLog = TypeVar("AnyLog", bound=_LogColumns)
"""A ``Log``."""


@np.errstate(over="ignore", invalid="ignore")  # stamps and ages may have any finite value
def is_repeated(log: _LogColumns) -> Bool[np.ndarray, " readings"]:
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


def _tolerance(log: _LogColumns) -> float:
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


@np.errstate(over="ignore")
def measurement_times(log: _LogColumns) -> Float[np.ndarray, " readings"]:
    """When each reading was measured: stamp + t - age, seconds. A scan without a stamp has its number as stamp."""
    stamp = np.where(np.isnan(log.stamp), log.scan, log.stamp)
    return stamp[log.echo_scan] + log.t - log.age


def unique_readings(log: AnyLog) -> AnyLog:
    """The log without readings that were not renewed and whose original it also holds; it is unchanged without ages.

    The paths of removed readings count as not measured. Therefore the result is explicit: it holds a row without a
    range for every other path that a scan measured and that heard nothing.
    """
    if not is_repeated(log).any():
        return log
    log = explicit_log(log)
    return without_readings(log, is_repeated(log))


def explicit_log(log: AnyLog) -> AnyLog:
    """The log with a silent reading for each path that a scan measured (``Log.asked``) and has no reading of.

    A silent reading has the time ``t`` of its transmitter (``firing_times``).
    """
    if not len(log.asked):
        return log
    scan = np.repeat(np.arange(len(log)), len(log.asked))
    tx, rx = np.tile(log.asked, (len(log), 1)).T
    return with_silent_readings(log, scan, tx, rx)


def firing_times(
    log: _LogColumns, group: Int[np.ndarray, " readings"], groups: int
) -> Float[np.ndarray, "scans groups"]:
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
    log: AnyLog, scan: Int[np.ndarray, " paths"], tx: Int[np.ndarray, " paths"], rx: Int[np.ndarray, " paths"]
) -> AnyLog:
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
    return replace(log, start=start, **columns, asked=NO_PAIRS)


def without_readings(log: AnyLog, removed: Bool[np.ndarray, " readings"]) -> AnyLog:
    """The log without some readings; what its scans measured stays as it is (``Log.asked``)."""
    start = np.searchsorted(log.echo_scan[~removed], np.arange(len(log) + 1))
    columns = {name: getattr(log, name)[~removed] for name in READING_COLUMNS}
    return replace(log, start=start, **columns)


def _pair_codes(
    scan: Int[np.ndarray, " rows"], tx: Int[np.ndarray, " rows"], rx: Int[np.ndarray, " rows"], sensors: int
) -> Int[np.ndarray, " rows"]:
    """One number for each scan and pair of sensors."""
    return (scan * sensors + tx) * sensors + rx


def counts_from_one(tx: Int[np.ndarray, " readings"], rx: Int[np.ndarray, " readings"], sensors: int) -> bool:
    """Whether the sensors seem to be counted from 1: half of the numbers from 1 to ``sensors`` or more occur.

    Args:
        tx: transmitters of one reading or more.
        rx: receivers.
        sensors: number of sensors of the ring.
    """
    if min(tx.min(), rx.min()) < 1 or max(tx.max(), rx.max()) != sensors:
        return False
    occurs = np.bincount(tx, minlength=sensors + 1) + np.bincount(rx, minlength=sensors + 1) > 0
    return bool(2 * occurs.sum() >= sensors)
