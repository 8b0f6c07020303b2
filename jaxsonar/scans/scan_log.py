"""Scan log: the readings of consecutive scans in columns. Imports NumPy only, so that tools start fast.

A reading is an echo, or a path that fired and heard nothing; the latter has the range NaN.
"""

import operator
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsIndex, overload

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.asked_pairs import AskedPairs
from jaxsonar.scans.readings import READING_COLUMNS, unique_readings

LARGEST_SENSOR = 2**31 - 1
"""Largest sensor index; sensor indices have 32 bits in Parquet."""

ALLOWED = {
    "scan": "a whole number that no earlier scan has",
    "stamp": "a finite number of seconds, or nothing",
    "pose": "finite x, y (m) and theta (rad), all three or none of them",
    "tx": f"a sensor index, a whole number from 0 to {LARGEST_SENSOR}",
    "rx": f"a sensor index, a whole number from 0 to {LARGEST_SENSOR}",
    "range": "a finite number of metres above 0, or nothing for a path that heard nothing",
    "amplitude": "a finite number, or nothing; nothing if the path heard nothing",
    "silent": "a path with one row without a range, or with rows that all have one",
    "age": "seconds, 0 or more, the same in all rows of a path in a scan",
    "t": "seconds, 0 or more, the same in all rows of a path in a scan",
}
"""Allowed values of each column, as stated in error messages."""

if TYPE_CHECKING:
    _Seconds = Float[np.ndarray, " readings"]
    _Pairs = Int[np.ndarray, "pairs 2"]
else:  # the constructor replaces None
    _Seconds = Float[np.ndarray, " readings"] | None
    _Pairs = Int[np.ndarray, "pairs 2"] | None
_DERIVED: Any = None
"""Default of columns that the constructor fills."""


class InvalidLogValue(SonarError):
    """An invalid value of a log. Readers convert its position in the log to a position in their file."""

    def __init__(self, scan: int, echo: int | None, column: str, value: object, allowed: str | None = None):
        self.allowed = ALLOWED[column] if allowed is None else allowed
        """Allowed values."""
        self.scan = scan
        """Row of the scan in the log, from 0."""
        self.echo = echo
        """Row of the reading in the log's columns, from 0; None for a value of the scan."""
        self.column = column
        self.value = value
        place = f"scans[{scan}]" if echo is None else f"scans[{scan}], echoes[{echo}]"
        super().__init__(f"log: {place}, {column}: {value} came; allowed is {self.allowed}")


@dataclass(frozen=True, eq=False)
class Scan:
    """The readings of one scan."""

    scan: int
    """Scan number."""
    stamp: float
    """Seconds; NaN if unknown."""
    pose: Float[np.ndarray, " 3"]
    """world_from_robot: x, y (m), theta (rad); NaN if unknown."""
    tx: Int[np.ndarray, " readings"]
    """Transmitter."""
    rx: Int[np.ndarray, " readings"]
    """Receiver."""
    range: Float[np.ndarray, " readings"]
    """Half path length as reported, metres at the reference speed of sound; NaN: the path fired and heard nothing."""
    amplitude: Float[np.ndarray, " readings"]
    """Amplitude of the echo in the unit of the device; NaN if unknown."""
    t: Float[np.ndarray, " readings"] | None = None
    """When the transmitter fired, seconds after the stamp; None: 0 for all."""
    age: Float[np.ndarray, " readings"] | None = None
    """Time since the reading was renewed, seconds; None: 0 for all."""
    asked: Int[np.ndarray, "pairs 2"] | None = None
    """As in ``Log``; None: unknown, ``as_log`` and ``Log.from_scans`` derive it from the readings."""
    odometry: Float[np.ndarray, "samples 4"] | None = None
    """``Log.motion`` of the log of the scan."""

    @property
    def echo_count(self) -> int:
        """Number of echoes: readings that heard something."""
        return int(np.isfinite(self.range).sum())

    def as_log(self) -> "Log":
        """A log with this scan only."""
        return Log(
            scan=np.array([self.scan]),
            stamp=np.array([self.stamp], dtype=np.float64),
            pose=np.asarray(self.pose)[None],
            start=np.array([0, np.size(self.tx)]),
            tx=self.tx,
            rx=self.rx,
            range=self.range,
            amplitude=self.amplitude,
            t=_DERIVED if self.t is None else self.t,
            age=_DERIVED if self.age is None else self.age,
            asked=_DERIVED if self.asked is None else self.asked,
            odometry=self.odometry,
        )


@dataclass(frozen=True, eq=False, repr=False)
class Log:
    """Scans in chronological order, one read-only array per column.

    The constructor checks every value against ``ALLOWED``. Therefore every log can be written and read again.
    ``len(log)`` is the number of scans, ``log[i]`` is a ``Scan``, and ``log[a:b]`` is a shorter ``Log``. A single scan
    leaves out readings that only repeat an older one of the log (``readings.is_repeated``), because it does not
    know that they were counted before; a shorter log keeps them.
    """

    scan: Int[np.ndarray, " scans"]
    """Scan number, unique, in any order."""
    stamp: Float[np.ndarray, " scans"]
    """Seconds; NaN if unknown."""
    pose: Float[np.ndarray, "scans 3"]
    """world_from_robot: x, y (m), theta (rad) from odometry; NaN if unknown."""
    start: Int[np.ndarray, " scans+1"]
    """The readings of scan i have the indices start[i]:start[i + 1]."""
    tx: Int[np.ndarray, " readings"]
    """Transmitter."""
    rx: Int[np.ndarray, " readings"]
    """Receiver."""
    range: Float[np.ndarray, " readings"]
    """Half path length as reported, metres at the reference speed of sound; ``Ring.corrected`` corrects it. NaN: the
    path fired and heard nothing."""
    amplitude: Float[np.ndarray, " readings"]
    """Amplitude of the echo in the unit of the device; NaN if unknown."""
    t: _Seconds = _DERIVED
    """When the transmitter fired, seconds after the scan's stamp; 0 for all if omitted."""
    age: _Seconds = _DERIVED
    """Time since the reading was renewed, seconds; 0 for all if omitted. A reading with an age belongs to the pose of
    the robot at stamp + t - age."""
    asked: _Pairs = _DERIVED
    """The (tx, rx) pairs that every scan measured, whether or not it holds a reading of them; derived from the readings
    if omitted (``AskedPairs``). Parts of a log keep the pairs of the whole log."""
    odometry: Float[np.ndarray, "samples 4"] | None = None
    """Stamp (s), x, y (m), theta (rad) of odometry at its own rate, in ascending order; None: only the poses of the
    scans are known. Motion between the readings of a scan is interpolated in it. Files do not hold it. Parts of a log
    have the ``motion`` of the whole log."""

    def __post_init__(self):
        scans, readings = np.size(self.scan), np.size(self.tx)
        for name in ("t", "age"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.zeros(readings))
        self._set("scan", np.int64, (scans,))
        self._set("stamp", np.float64, (scans,))
        self._set("pose", np.float64, (scans, 3))
        self._set("start", np.int64, (scans + 1,))
        self._set("tx", np.int64, (readings,))
        self._set("rx", np.int64, (readings,))
        self._set("range", np.float64, (readings,))
        self._set("amplitude", np.float64, (readings,))
        self._set("t", np.float64, (readings,))
        self._set("age", np.float64, (readings,))
        if self.odometry is not None:
            self._set("odometry", np.float64, (len(self.odometry), 4))
        if self.start[0] != 0 or self.start[-1] != readings or (np.diff(self.start) < 0).any():
            raise SonarError(f"log: start must not fall and go from 0 to the number of readings, {readings}")
        self._check()
        if self.asked is None:
            pairs = AskedPairs()
            pairs.add(self.echo_scan, self.tx, self.rx, np.isnan(self.range))
            object.__setattr__(self, "asked", pairs.pairs())
        self._set("asked", np.int64, (np.size(self.asked) // 2, 2))

    def _set(self, name: str, dtype: type, shape: tuple[int, ...]) -> None:
        array = np.asarray(getattr(self, name))
        if array.shape != shape:
            raise SonarError(f"log: {name} has shape {array.shape}; allowed is {shape} to go with the other columns")
        if not np.can_cast(array.dtype, dtype, casting="same_kind") and array.size:
            raise SonarError(f"log: {name} holds {array.dtype}; allowed is what converts safely to {np.dtype(dtype)}")
        array = array.astype(dtype, copy=False).view()
        array.flags.writeable = False  # only this view; the caller's array stays writable
        object.__setattr__(self, name, array)

    def _check(self) -> None:
        for column in ("tx", "rx"):
            sensor = getattr(self, column)
            self._check_echoes((sensor < 0) | (sensor > LARGEST_SENSOR), column)
        silent = np.isnan(self.range)
        self._check_echoes(~silent & ~(np.isfinite(self.range) & (self.range > 0)), "range")
        self._check_echoes(np.isinf(self.amplitude) | (silent & ~np.isnan(self.amplitude)), "amplitude")
        for column in ("t", "age"):
            seconds = getattr(self, column)
            self._check_echoes(~(np.isfinite(seconds) & (seconds >= 0)), column)
        self._check_paths(silent)
        self._check_scans(np.isinf(self.stamp), "stamp")
        self._check_scans(~(np.all(np.isfinite(self.pose), axis=-1) | np.all(np.isnan(self.pose), axis=-1)), "pose")
        if len(self) < 2:
            return
        order = np.argsort(self.scan, kind="stable")
        repeated = np.zeros(len(self), dtype=bool)
        repeated[order[1:]] = np.diff(self.scan[order]) == 0
        self._check_scans(repeated, "scan")

    def _check_paths(self, silent: np.ndarray) -> None:
        """Check that all readings of a path in a scan agree on t and age, and that a silent one stands alone."""
        if not (silent.any() or self.t.any() or self.age.any()):
            return
        order = np.lexsort((self.rx, self.tx, self.echo_scan))
        same = (np.diff(self.echo_scan[order]) == 0) & (np.diff(self.tx[order]) == 0) & (np.diff(self.rx[order]) == 0)
        for column in ("t", "age"):
            bad = np.zeros(len(order), dtype=bool)
            bad[order[1:]] = same & (np.diff(getattr(self, column)[order]) != 0)
            self._check_echoes(bad, column)
        bad = np.zeros(len(order), dtype=bool)
        bad[order[1:]] = same & (silent[order[1:]] | silent[order[:-1]])
        if bad.any():
            echo = int(np.argmax(bad))
            raise InvalidLogValue(int(self.echo_scan[echo]), echo, "rx", int(self.rx[echo]), ALLOWED["silent"])

    def _check_scans(self, bad: np.ndarray, column: str) -> None:
        if bad.any():
            i = int(np.argmax(bad))
            raise InvalidLogValue(i, None, column, getattr(self, column)[i].tolist())

    def _check_echoes(self, bad: np.ndarray, column: str) -> None:
        if bad.any():
            echo = int(np.argmax(bad))
            i = int(np.searchsorted(self.start, echo, side="right")) - 1
            raise InvalidLogValue(i, echo, column, getattr(self, column)[echo].tolist())

    @classmethod
    def from_echoes(
        cls,
        scan_index: Int[np.ndarray, " echoes"],
        tx: Int[np.ndarray, " echoes"],
        rx: Int[np.ndarray, " echoes"],
        range: Float[np.ndarray, " echoes"],
        *,
        amplitude: Float[np.ndarray, " echoes"] | None = None,
        t: Float[np.ndarray, " echoes"] | None = None,
        age: Float[np.ndarray, " echoes"] | None = None,
        stamp: Float[np.ndarray, " scans"],
        pose: Float[np.ndarray, "scans 3"],
        scan: Int[np.ndarray, " scans"] | None = None,
        asked: Int[np.ndarray, "pairs 2"] | None = None,
        odometry: Float[np.ndarray, "samples 4"] | None = None,
    ) -> "Log":
        """A log from flat readings with the index of their scan.

        Args:
            scan_index: row of the scan of each reading, 0 to scans - 1, not decreasing; scans without readings are
                skipped.
            tx: transmitter.
            rx: receiver.
            range: half path length as reported, metres; NaN: the path fired and heard nothing.
            amplitude: amplitude, NaN if unknown; all unknown if omitted.
            t: when the transmitter fired, seconds after the scan's stamp; 0 if omitted.
            age: time since the reading was renewed, seconds; 0 if omitted.
            stamp: seconds, NaN if unknown; its length is the number of scans.
            pose: world_from_robot x, y (m), theta (rad), NaN if unknown.
            scan: scan numbers; 0, 1, 2, ... if omitted.
            asked: as the field; derived from the readings if omitted.
            odometry: as the field.

        Raises:
            SonarError: columns of inconsistent length, or an invalid value.
        """
        scans = len(stamp)
        index = np.asarray(scan_index)
        if index.size and (index[0] < 0 or index[-1] >= scans or (np.diff(index) < 0).any()):
            raise SonarError(f"log: scan_index must not fall and stay within 0 to {scans - 1}, the rows of stamp")
        if index.shape != np.shape(tx):
            raise SonarError(f"log: scan_index has shape {index.shape}; allowed is that of tx, {np.shape(tx)}")
        return cls(
            scan=np.arange(scans) if scan is None else scan,
            stamp=stamp,
            pose=pose,
            start=np.searchsorted(index, np.arange(scans + 1)),
            tx=tx,
            rx=rx,
            range=range,
            amplitude=np.full(np.shape(range), np.nan) if amplitude is None else amplitude,
            t=_DERIVED if t is None else t,
            age=_DERIVED if age is None else age,
            asked=_DERIVED if asked is None else asked,
            odometry=odometry,
        )

    @classmethod
    def from_scans(cls, scans: Sequence[Scan]) -> "Log":
        """A log of these scans, in this order, with all of their odometry."""
        columns = {
            name: np.concatenate([np.zeros(0), *(_column(scan, name) for scan in scans)]) for name in READING_COLUMNS
        }
        asked = [scan.asked for scan in scans if scan.asked is not None]
        return cls.from_echoes(
            np.repeat(np.arange(len(scans)), [len(scan.tx) for scan in scans]),
            columns["tx"].astype(np.int64),
            columns["rx"].astype(np.int64),
            columns["range"],
            amplitude=columns["amplitude"],
            t=columns["t"],
            age=columns["age"],
            stamp=np.array([scan.stamp for scan in scans], dtype=np.float64),
            pose=np.array([scan.pose for scan in scans], dtype=np.float64).reshape(-1, 3),
            scan=np.array([scan.scan for scan in scans], dtype=np.int64),
            asked=_same_or_union(asked) if scans and len(asked) == len(scans) else None,
            odometry=_all_odometry(scans),
        )

    @property
    def echo_scan(self) -> Int[np.ndarray, " echoes"]:
        """Row of the scan of each reading, 0 to len(log) - 1."""
        return np.repeat(np.arange(len(self)), np.diff(self.start))

    @property
    def echo_count(self) -> int:
        """Number of echoes: readings that heard something."""
        return int(np.isfinite(self.range).sum())

    @cached_property
    def motion(self) -> Float[np.ndarray, "samples 4"] | None:
        """``odometry``, or else the stamps and poses of the scans, if a reading has a time of its own; otherwise None.

        Keep it as ``odometry`` before changing the poses: the motion between the readings of a scan does not change.
        """
        if self.odometry is not None or not (self.t.any() or self.age.any()):
            return self.odometry
        return self.pose_samples

    @property
    def pose_samples(self) -> Float[np.ndarray, "samples 4"]:
        """``odometry``, or else stamp (s) and pose (m, m, rad) of the scans that have both."""
        if self.odometry is not None:
            return self.odometry
        known = np.isfinite(self.stamp) & np.isfinite(self.pose).all(axis=1)
        return np.column_stack([self.stamp, self.pose])[known]

    @cached_property
    def _unique(self) -> "Log":
        """The log without repeated old readings, of which its single scans are parts."""
        if not self.age.any():
            return self
        return unique_readings(self)

    def __len__(self) -> int:
        return len(self.scan)

    @overload
    def __getitem__(self, key: SupportsIndex) -> Scan: ...
    @overload
    def __getitem__(self, key: slice) -> "Log": ...
    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, slice):
            return self._part(np.arange(len(self))[key])
        i = operator.index(key)
        if not -len(self) <= i < len(self):
            raise IndexError(f"scan {i} of a log with {len(self)} scans")
        i %= len(self)
        log = self._unique
        echoes = slice(log.start[i], log.start[i + 1])
        return Scan(
            scan=int(log.scan[i]),
            stamp=float(log.stamp[i]),
            pose=log.pose[i],
            **{name: getattr(log, name)[echoes] for name in READING_COLUMNS},
            asked=log.asked,
            odometry=self.motion,
        )

    def _part(self, rows: Int[np.ndarray, " part"]) -> "Log":
        counts = np.diff(self.start)[rows]
        start = np.concatenate([[0], np.cumsum(counts)])
        echoes = np.repeat(self.start[rows] - start[:-1], counts) + np.arange(start[-1])
        return type(self)(
            scan=self.scan[rows],
            stamp=self.stamp[rows],
            pose=self.pose[rows],
            start=start,
            **{name: getattr(self, name)[echoes] for name in READING_COLUMNS},
            asked=self.asked,
            odometry=self.motion,
        )

    def __iter__(self) -> Iterator[Scan]:
        return (self[i] for i in range(len(self)))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Log):
            return NotImplemented
        exact = all(np.array_equal(getattr(self, c), getattr(other, c)) for c in ("scan", "start", "tx", "rx"))
        floats = ("stamp", "pose", "range", "amplitude", "t", "age")
        return exact and all(np.array_equal(getattr(self, c), getattr(other, c), equal_nan=True) for c in floats)

    def __repr__(self) -> str:
        silent = len(self.tx) - self.echo_count
        return f"Log({len(self)} scans, {self.echo_count} echoes{f', {silent} silent readings' if silent else ''})"


def _column(scan: Scan, name: str) -> np.ndarray:
    column = getattr(scan, name)
    return np.zeros(len(scan.tx)) if column is None else column


def _all_odometry(scans: Sequence[Scan]) -> Float[np.ndarray, "samples 4"] | None:
    """The odometry of scans: the shared array of one log, or all samples in order of time."""
    parts = list({id(scan.odometry): scan.odometry for scan in scans if scan.odometry is not None}.values())
    if len(parts) < 2:
        return parts[0] if parts else None
    samples = np.concatenate(parts)
    return samples[np.unique(samples[:, 0], return_index=True)[1]]


def _same_or_union(asked: Sequence[Int[np.ndarray, "_ 2"]]) -> Int[np.ndarray, "pairs 2"]:
    """The pairs of scans of one log, which share an array, or the union of those of several logs."""
    if all(pairs is asked[0] for pairs in asked):
        return asked[0]
    return np.unique(np.concatenate(asked), axis=0)


def log_format(filename: str | os.PathLike[str]) -> str:
    """Format of a log, "csv" or "parquet", from the suffix of its filename.

    Raises:
        SonarError: any other suffix.
    """
    suffix = Path(filename).suffix.lower()
    if suffix not in (".csv", ".parquet"):
        came = f"suffix '{shown(suffix)}'" if suffix else "no suffix"
        raise SonarError(f"{shown(filename)}: {came} came; allowed for a scan log is .csv or .parquet")
    return suffix[1:]
