"""Recordings of real devices, each in its makers' own format, as flat echoes in SI units.

Whatever a device reported is kept as it reported it, stale readings and constant offsets included: the ring and the map
know what to make of them. Row numbers in messages are lines of the file, from 1.
"""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Bool, Float, Int

from .errors import SonarError


@dataclass(frozen=True, eq=False)
class Recording:
    """What a device heard: one entry a scan in ``stamp`` and ``pose``, one entry an echo in the others."""

    stamp: Float[np.ndarray, " scans"]
    """Seconds."""
    pose: Float[np.ndarray, "scans 3"]
    """world_from_robot: x, y (m), theta (rad, [-pi, pi)) from odometry; NaN where there is none."""
    scan_index: Int[np.ndarray, " echoes"]
    """Scan of each echo, 0 to scans - 1, never falling; a scan that is absent heard nothing."""
    tx: Int[np.ndarray, " echoes"]
    """Sensor that fired."""
    rx: Int[np.ndarray, " echoes"]
    """Sensor that heard it."""
    range: Float[np.ndarray, " echoes"]
    """Half path length as reported, metres."""
    amplitude: Float[np.ndarray, " echoes"]
    """NaN: none of these devices reports one."""


def read_corridor8(path: str | os.PathLike[str]) -> Recording:
    """A robot with 8 sonars and odometry: ``measurement.txt`` and ``poses.txt``, a line a scan, no headers.

    Sensor k is column k + 2 of ``measurement.txt``, the right side first. Direct echoes only; 5110 mm is no echo.

    Args:
        path: the folder with both files, or its ``measurement.txt``.

    Raises:
        SonarError: a file is missing, a row is malformed, or the two files do not agree.
    """
    measurements = Path(path) / "measurement.txt" if Path(path).is_dir() else Path(path)
    sensors = [f"range {k}" for k in range(8)]
    sonar = Table(measurements, text_lines(measurements), ("t_ms", *sensors), separator=None)
    reported = sonar.number[:, 1:]
    sonar.refuse((reported <= 0) | (reported > 5110), sensors, "a range above 0 and up to 5110 mm, which is no echo")
    stamp, pose = corridor8_poses(sonar)
    return _direct(stamp, pose, np.where(reported == 5110, np.nan, reported / 1000))


def corridor8_poses(table: "Table") -> tuple[Float[np.ndarray, " scans"], Float[np.ndarray, "scans 3"]]:
    """Time (s) and odometry (m, rad) of every row of a corridor8 file that starts with t_ms, from its ``poses.txt``.

    Raises:
        SonarError: that file is missing or malformed, or the two do not agree.
    """
    poses = table.file.with_name("poses.txt")
    odometry = Table(poses, text_lines(poses), ("t_ms", "x_mm", "y_mm", "heading"), separator=None)
    time, heading = table.number[:, 0], odometry.number[:, 3]
    odometry.refuse((heading < 0) | (heading > 3600), "heading", "0 to 3600 tenths of a degree")
    table.refuse(np.append(False, np.diff(time) <= 0), "t_ms", "a later time than in the row before")
    if len(time) != len(heading):
        counts = f"{len(heading)} rows beside {len(time)} in {table.file.name}"
        raise SonarError(f"{shown(poses)}: {counts} came; allowed is a pose for every measurement")
    odometry.refuse(odometry.number[:, 0] != time, "t_ms", f"the time in the same row of {table.file.name}")
    angle = np.radians(heading / 10)
    pose = np.column_stack([odometry.number[:, 1:3] / 1000, np.mod(angle + np.pi, 2 * np.pi) - np.pi])
    return time / 1000, pose


def read_scitos24(path: str | os.PathLike[str]) -> Recording:
    """A ring of 24 sonars at 9 Hz: ``sensor_readings_24.data``, CSV with header ``S1,...,S24,OUTPUT``.

    Sensor k is column S(k + 1). Direct echoes only; 5.0 m and more is no echo. There are no poses; OUTPUT, what the
    robot's wall following chose, is left out.

    Args:
        path: the file, or the folder it is in.

    Raises:
        SonarError: the file is missing or a row is malformed.
    """
    file = Path(path) / "sensor_readings_24.data" if Path(path).is_dir() else Path(path)
    lines = text_lines(file)
    sensors = [f"S{k}" for k in range(1, 25)]
    header = (*sensors, "OUTPUT")
    if not lines or tuple(lines[0].split(",")) != header:
        came = f"'{shown(lines[0])}'" if lines else "nothing"
        raise SonarError(f"{shown(file)}: row 1: {came} came; allowed is the header S1,...,S24,OUTPUT")
    table = Table(file, lines[1:], header, separator=",", first_row=2, words=1)
    table.refuse(table.number <= 0, sensors, "a range above 0 m; 5.0 and more is no echo")
    scans = len(table.number)
    nowhere = np.full((scans, 3), np.nan)
    return _direct(np.arange(scans) / 9.0, nowhere, np.where(table.number >= 5.0, np.nan, table.number))


def read_sew_amr(path: str | os.PathLike[str]) -> Recording:
    """The ultrasonic messages of the SEW-Eurodrive Multimodal AMR data set: four sensors that all hear each other.

    A message is 48 rows of 4 columns in mm: 12 rows a transmitter, a column a receiver. The 12 distances of a pair are
    begin and end of up to 6 objects in turn, 65535 where there is none; the begins are its echoes. Messages come every
    0.1 s: four firings, 25 ms each. The format carries neither time nor pose.

    Args:
        path: a ``dist.csv`` (a header, then one or more messages), or a folder with such files at any depth, each named
            ``dist`` and whatever, read in the order of their paths (numbers by value).

    Raises:
        SonarError: no such file, or a row is malformed.
    """
    files = [Path(path)]
    if Path(path).is_dir():
        files = sorted(Path(path).rglob("dist*.csv"), key=_by_value)
        if not files:
            raise SonarError(f"{shown(path)}: no dist.csv in this folder; needed is at least one")
    messages = np.concatenate([_sew_messages(file) for file in files])
    begins = messages[:, :, 0::2, :].swapaxes(2, 3)  # (messages, tx, rx, objects)
    scan_index, tx, rx, nearest_first = np.nonzero(begins != 65535)
    return Recording(
        stamp=np.arange(len(messages)) * 0.1,
        pose=np.full((len(messages), 3), np.nan),
        scan_index=scan_index,
        tx=tx,
        rx=rx,
        range=begins[scan_index, tx, rx, nearest_first] / 1000,
        amplitude=np.full(len(tx), np.nan),
    )


def _sew_messages(file: Path) -> Float[np.ndarray, "messages 4 12 4"]:
    """Distances in mm: message, tx, begin or end, rx."""
    lines = text_lines(file)
    if not lines:
        raise SonarError(f"{shown(file)}: row 1: nothing came; allowed is a header and 48 rows a message")
    if len(lines[0].split(",")) != 4 or re.fullmatch(r"[\d.,\s+-]+", lines[0]):
        raise SonarError(f"{shown(file)}: row 1: '{shown(lines[0])}' came; allowed is a header of 4 column names")
    columns = [f"{name.strip()} (rx {rx})" for rx, name in enumerate(lines[0].split(","))]
    table = Table(file, lines[1:], tuple(columns), separator=",", first_row=2)
    table.refuse((table.number <= 0) | (table.number > 65535), columns, "above 0 and up to 65535 mm, which is none")
    if len(table.number) % 48 or not len(table.number):
        came = f"{len(table.number)} rows below the header"
        raise SonarError(
            f"{shown(file)}: {came} came; allowed are 48 a message (12 a transmitter), one message or more"
        )
    return table.number.reshape(-1, 4, 12, 4)


def _direct(
    stamp: Float[np.ndarray, " scans"], pose: Float[np.ndarray, "scans 3"], heard: Float[np.ndarray, "scans sensors"]
) -> Recording:
    """A recording of direct echoes from one range a sensor and scan, metres, NaN where nothing was heard."""
    scan_index, sensor = np.nonzero(~np.isnan(heard))
    return Recording(
        stamp=stamp,
        pose=pose,
        scan_index=scan_index,
        tx=sensor,
        rx=sensor.copy(),
        range=heard[scan_index, sensor],
        amplitude=np.full(len(sensor), np.nan),
    )


class Table:
    """The numbers in a file's rows, each of which can be named once it turns out to be wrong."""

    def __init__(
        self,
        file: Path,
        lines: Sequence[str],
        columns: tuple[str, ...],
        *,
        separator: str | None,
        first_row: int = 1,
        words: int = 0,
    ):
        """Split and convert; the last ``words`` columns are text and left out of ``number`` (rows, columns)."""
        self.file, self.columns, self.first_row = file, columns, first_row
        self.fields = [line.split(separator) for line in lines]
        for row, fields in enumerate(self.fields):
            if len(fields) != len(columns):
                names = ", ".join(columns) if len(columns) < 10 else f"{columns[0]} to {columns[-1]}"
                place = f"{shown(file)}: row {first_row + row}"
                raise SonarError(f"{place}: {len(fields)} columns came; allowed are {len(columns)}: {names}")
        count = len(columns) - words
        try:
            self.number = np.array([fields[:count] for fields in self.fields], dtype=np.float64).reshape(-1, count)
        except ValueError:
            self._refuse_text(count)
        self.refuse(~np.isfinite(self.number), list(columns[:count]), "a finite number")

    def _refuse_text(self, count: int) -> NoReturn:
        for row, fields in enumerate(self.fields):
            for k, field in enumerate(fields[:count]):
                try:
                    float(field)
                except ValueError:
                    self._fail(row, self.columns[k], "a finite number")
        raise AssertionError("a table that did not convert holds a field that does not")

    def refuse(self, bad: Bool[np.ndarray, "..."], column: str | list[str], allowed: str) -> None:
        """An error about the first bad row, if any: of one column, or of several named columns (rows, columns)."""
        if bad.any():
            row, *rest = np.argwhere(bad)[0]
            self._fail(int(row), column[rest[0]] if isinstance(column, list) else column, allowed)

    def _fail(self, row: int, column: str, allowed: str) -> NoReturn:
        came = shown(self.fields[row][self.columns.index(column)])
        place = f"{shown(self.file)}: row {self.first_row + row}, column {shown(column)}"
        raise SonarError(f"{place}: '{came}' came; allowed is {allowed}")


def text_lines(file: Path) -> list[str]:
    """The lines of a text file, without their ends (LF or CRLF)."""
    try:
        text = file.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError:
        raise SonarError(f"{shown(file)}: this is no text; needed is a recording as text") from None
    except (OSError, ValueError) as failure:
        reason = getattr(failure, "strerror", None) or str(failure)
        raise SonarError(f"{shown(file)}: {reason}; needed is a readable file of the recording") from None
    return text.replace("\r\n", "\n").removesuffix("\n").split("\n") if text else []


def _by_value(file: Path) -> list[tuple[int, str]]:
    """Sort key under which message 10 follows message 9."""
    pieces = re.split(r"(\d+)", str(file))
    return [(int(piece), "") if piece.isdecimal() else (-1, piece) for piece in pieces]


def shown(text: object) -> str:
    """One printable line for a message."""
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text))
    return line if len(line) <= 200 else f"{line[:40]}..."
