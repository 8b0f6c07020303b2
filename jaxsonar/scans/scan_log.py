"""Scan log: the echoes of consecutive scans in columns. Imports NumPy only, so that tools start fast."""

import operator
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, SupportsIndex, overload

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.errors import SonarError

LARGEST_SENSOR = 2**31 - 1
"""Largest sensor index; sensor indices have 32 bits in Parquet."""

ALLOWED = {
    "scan": "a whole number that no earlier scan has",
    "stamp": "a finite number of seconds, or nothing",
    "pose": "finite x, y (m) and theta (rad), all three or none of them",
    "tx": f"a sensor index, a whole number from 0 to {LARGEST_SENSOR}",
    "rx": f"a sensor index, a whole number from 0 to {LARGEST_SENSOR}",
    "range": "a finite number of metres above 0",
    "amplitude": "a finite number, or nothing",
}
"""Allowed values of each column, as stated in error messages."""


class InvalidLogValue(SonarError):
    """An invalid value of a log. Readers convert its position in the log to a position in their file."""

    def __init__(self, scan: int, echo: int | None, column: str, value: object):
        self.scan = scan
        """Row of the scan in the log, from 0."""
        self.echo = echo
        """Row of the echo in the log's echo columns, from 0; None for a value of the scan."""
        self.column = column
        self.value = value
        place = f"scans[{scan}]" if echo is None else f"scans[{scan}], echoes[{echo}]"
        super().__init__(f"log: {place}, {column}: {value} came; allowed is {ALLOWED[column]}")


@dataclass(frozen=True, eq=False)
class Scan:
    """The echoes of one scan."""

    scan: int
    """Scan number."""
    stamp: float
    """Seconds; NaN if unknown."""
    pose: Float[np.ndarray, " 3"]
    """world_from_robot: x, y (m), theta (rad); NaN if unknown."""
    tx: Int[np.ndarray, " echoes"]
    """Transmitter."""
    rx: Int[np.ndarray, " echoes"]
    """Receiver."""
    range: Float[np.ndarray, " echoes"]
    """Half path length as reported, metres at the reference speed of sound."""
    amplitude: Float[np.ndarray, " echoes"]
    """Amplitude of the echo in the unit of the device; NaN if unknown."""

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
        )


@dataclass(frozen=True, eq=False, repr=False)
class Log:
    """Scans in chronological order, one read-only array per column.

    The constructor checks every value against ``ALLOWED``. Therefore every log can be written and read again.
    ``len(log)`` is the number of scans, ``log[i]`` is a ``Scan``, and ``log[a:b]`` is a shorter ``Log``.
    """

    scan: Int[np.ndarray, " scans"]
    """Scan number, unique, in any order."""
    stamp: Float[np.ndarray, " scans"]
    """Seconds; NaN if unknown."""
    pose: Float[np.ndarray, "scans 3"]
    """world_from_robot: x, y (m), theta (rad) from odometry; NaN if unknown."""
    start: Int[np.ndarray, " scans+1"]
    """The echoes of scan i have the indices start[i]:start[i + 1]."""
    tx: Int[np.ndarray, " echoes"]
    """Transmitter."""
    rx: Int[np.ndarray, " echoes"]
    """Receiver."""
    range: Float[np.ndarray, " echoes"]
    """Half path length as reported, metres at the reference speed of sound; ``Ring.corrected`` corrects it."""
    amplitude: Float[np.ndarray, " echoes"]
    """Amplitude of the echo in the unit of the device; NaN if unknown."""

    def __post_init__(self):
        scans, echoes = np.size(self.scan), np.size(self.tx)
        self._set("scan", np.int64, (scans,))
        self._set("stamp", np.float64, (scans,))
        self._set("pose", np.float64, (scans, 3))
        self._set("start", np.int64, (scans + 1,))
        self._set("tx", np.int64, (echoes,))
        self._set("rx", np.int64, (echoes,))
        self._set("range", np.float64, (echoes,))
        self._set("amplitude", np.float64, (echoes,))
        if self.start[0] != 0 or self.start[-1] != echoes or (np.diff(self.start) < 0).any():
            raise SonarError(f"log: start must not fall and go from 0 to the number of echoes, {echoes}")
        self._check()

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
        self._check_echoes(~(np.isfinite(self.range) & (self.range > 0)), "range")
        self._check_echoes(np.isinf(self.amplitude), "amplitude")
        self._check_scans(np.isinf(self.stamp), "stamp")
        self._check_scans(~(np.all(np.isfinite(self.pose), axis=-1) | np.all(np.isnan(self.pose), axis=-1)), "pose")
        if len(self) < 2:
            return
        order = np.argsort(self.scan, kind="stable")
        repeated = np.zeros(len(self), dtype=bool)
        repeated[order[1:]] = np.diff(self.scan[order]) == 0
        self._check_scans(repeated, "scan")

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
        stamp: Float[np.ndarray, " scans"],
        pose: Float[np.ndarray, "scans 3"],
        scan: Int[np.ndarray, " scans"] | None = None,
    ) -> "Log":
        """A log from flat echoes with the index of their scan.

        Args:
            scan_index: row of the scan of each echo, 0 to scans - 1, not decreasing; scans without echoes are skipped.
            tx: transmitter.
            rx: receiver.
            range: half path length as reported, metres.
            amplitude: amplitude, NaN if unknown; all unknown if omitted.
            stamp: seconds, NaN if unknown; its length is the number of scans.
            pose: world_from_robot x, y (m), theta (rad), NaN if unknown.
            scan: scan numbers; 0, 1, 2, ... if omitted.

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
        )

    @classmethod
    def from_scans(cls, scans: Sequence[Scan]) -> "Log":
        """A log of these scans, in this order."""
        columns = {
            name: np.concatenate([np.zeros(0), *(getattr(scan, name) for scan in scans)])
            for name in ("tx", "rx", "range", "amplitude")
        }
        return cls.from_echoes(
            np.repeat(np.arange(len(scans)), [len(scan.tx) for scan in scans]),
            columns["tx"].astype(np.int64),
            columns["rx"].astype(np.int64),
            columns["range"],
            amplitude=columns["amplitude"],
            stamp=np.array([scan.stamp for scan in scans], dtype=np.float64),
            pose=np.array([scan.pose for scan in scans], dtype=np.float64).reshape(-1, 3),
            scan=np.array([scan.scan for scan in scans], dtype=np.int64),
        )

    @property
    def echo_scan(self) -> Int[np.ndarray, " echoes"]:
        """Row of the scan of each echo, 0 to len(log) - 1."""
        return np.repeat(np.arange(len(self)), np.diff(self.start))

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
        echoes = slice(self.start[i], self.start[i + 1])
        return Scan(
            scan=int(self.scan[i]),
            stamp=float(self.stamp[i]),
            pose=self.pose[i],
            tx=self.tx[echoes],
            rx=self.rx[echoes],
            range=self.range[echoes],
            amplitude=self.amplitude[echoes],
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
            tx=self.tx[echoes],
            rx=self.rx[echoes],
            range=self.range[echoes],
            amplitude=self.amplitude[echoes],
        )

    def __iter__(self) -> Iterator[Scan]:
        return (self[i] for i in range(len(self)))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Log):
            return NotImplemented
        exact = all(np.array_equal(getattr(self, c), getattr(other, c)) for c in ("scan", "start", "tx", "rx"))
        floats = ("stamp", "pose", "range", "amplitude")
        return exact and all(np.array_equal(getattr(self, c), getattr(other, c), equal_nan=True) for c in floats)

    def __repr__(self) -> str:
        return f"Log({len(self)} scans, {len(self.tx)} echoes)"


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
