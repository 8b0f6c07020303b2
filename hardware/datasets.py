"""Readers of published sonar data sets, each in its own format. Result: flat arrays of readings in SI units.

All reported values are kept unchanged, including constant offsets; calibration and mapping handle these. A path that
fired and heard nothing has a reading without a range. Row numbers in messages are line numbers of the file, from 1.
"""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Bool, Float, Int

from .errors import SonarError, reason, shown


@dataclass(frozen=True, eq=False)
class Recording:
    """A recorded run. ``stamp`` and ``pose`` have one entry per scan, the other arrays one entry per reading."""

    stamp: Float[np.ndarray, " scans"]
    """Seconds."""
    pose: Float[np.ndarray, "scans 3"]
    """world_from_robot: x, y (m), theta (rad, [-pi, pi)) from odometry; NaN if unknown."""
    scan_index: Int[np.ndarray, " readings"]
    """Scan of each reading, 0 to scans - 1, non-decreasing."""
    tx: Int[np.ndarray, " readings"]
    """Transmitter of each reading."""
    rx: Int[np.ndarray, " readings"]
    """Receiver of each reading."""
    range: Float[np.ndarray, " readings"]
    """Half the echo path length as reported, metres; NaN: the path fired and heard nothing."""
    age: Float[np.ndarray, " readings"]
    """Time since the reading was renewed, seconds."""


def read_corridor8(filename: str | os.PathLike[str]) -> Recording:
    """Read corridor8: a robot with 8 sonars and odometry.

    ``measurement.txt`` and ``poses.txt`` have one line per scan and no header. Sensor k is column k + 2 of
    ``measurement.txt``, starting at the right side. Direct echoes only; 5110 mm means no echo.

    The device renews a sensor in about every second row. A reading that equals that of the row before therefore counts
    as renewed in every second row; in the others, it has an age.

    Args:
        filename: the folder with both files, or its ``measurement.txt``.

    Raises:
        SonarError: a missing file, a malformed row, or files that contradict each other.
    """
    measurements = Path(filename) / "measurement.txt" if Path(filename).is_dir() else Path(filename)
    sensors = [f"range {k}" for k in range(8)]
    sonar = NumericTable(measurements, text_lines(measurements), ("t_ms", *sensors), separator=None)
    reported = sonar.number[:, 1:]
    sonar.refuse((reported <= 0) | (reported > 5110), sensors, "a range above 0 and up to 5110 mm, which is no echo")
    stamp, pose = corridor8_poses(sonar)
    ranges = np.where(reported == 5110, np.nan, reported / 1000)
    return _direct(stamp, pose, ranges, _ages(stamp, reported))


def corridor8_poses(table: "NumericTable") -> tuple[Float[np.ndarray, " scans"], Float[np.ndarray, "scans 3"]]:
    """Read the ``poses.txt`` beside a corridor8 file whose first column is t_ms.

    Returns:
        Time (s) and odometry pose (m, rad) of every row of the table.

    Raises:
        SonarError: the file is missing or malformed, or contradicts the table.
    """
    poses = table.file.with_name("poses.txt")
    odometry = NumericTable(poses, text_lines(poses), ("t_ms", "x_mm", "y_mm", "heading"), separator=None)
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


def read_scitos24(filename: str | os.PathLike[str]) -> Recording:
    """Read scitos24: a ring of 24 sonars at 9 Hz, without poses.

    ``sensor_readings_24.data`` is CSV with the header ``S1,...,S24,OUTPUT``. Sensor k is column S(k + 1). Direct echoes
    only; 5.0 m and more means no echo. OUTPUT, the command of a wall follower, is ignored.

    Args:
        filename: the file, or its folder.

    Raises:
        SonarError: a missing file or a malformed row.
    """
    file = Path(filename) / "sensor_readings_24.data" if Path(filename).is_dir() else Path(filename)
    lines = text_lines(file)
    sensors = [f"S{k}" for k in range(1, 25)]
    header = (*sensors, "OUTPUT")
    if not lines or tuple(lines[0].split(",")) != header:
        came = f"'{shown(lines[0])}'" if lines else "nothing"
        raise SonarError(f"{shown(file)}: row 1: {came} came; allowed is the header S1,...,S24,OUTPUT")
    table = NumericTable(file, lines[1:], header, separator=",", first_row=2, text_columns=1)
    table.refuse(table.number <= 0, sensors, "a range above 0 m; 5.0 and more is no echo")
    scans = len(table.number)
    unknown_pose = np.full((scans, 3), np.nan)
    return _direct(np.arange(scans) / 9.0, unknown_pose, np.where(table.number >= 5.0, np.nan, table.number))


def read_sew_amr(filename: str | os.PathLike[str]) -> Recording:
    """Read the ultrasonic messages of the SEW-Eurodrive Multimodal AMR data set: four sensors, all 16 paths.

    A message is 48 rows of 4 columns in mm: 12 rows per transmitter, one column per receiver. The 12 distances of a
    path are start and end of up to 6 objects, alternating; 65535 means no object. The starts are the echoes. There is a
    message every 0.1 s: four firings of 25 ms each. The format contains neither time nor pose.

    Args:
        filename: a ``dist.csv`` (a header, then one or more messages), or a folder. In a folder all files
            ``dist*.csv`` at any depth are read, sorted by filename (numbers by value).

    Raises:
        SonarError: a missing file or a malformed row.
    """
    files = [Path(filename)]
    if Path(filename).is_dir():
        files = sorted(Path(filename).rglob("dist*.csv"), key=_natural_sort_key)
        if not files:
            raise SonarError(f"{shown(filename)}: no dist.csv in this folder; needed is at least one")
    messages = np.concatenate([_sew_messages(file) for file in files])
    starts = messages[:, :, 0::2, :].swapaxes(2, 3)  # (messages, tx, rx, objects)
    heard = starts != 65535
    heard[..., 0] |= ~heard.any(axis=-1)  # one reading without a range for a path that heard nothing
    scan_index, tx, rx, echo = np.nonzero(heard)
    reported = starts[scan_index, tx, rx, echo]
    return Recording(
        stamp=np.arange(len(messages)) * 0.1,
        pose=np.full((len(messages), 3), np.nan),
        scan_index=scan_index,
        tx=tx,
        rx=rx,
        range=np.where(reported == 65535, np.nan, reported / 1000),
        age=np.zeros(len(tx)),
    )


def _sew_messages(file: Path) -> Float[np.ndarray, "messages 4 12 4"]:
    """Distances in mm: message, tx, start or end, rx."""
    lines = text_lines(file)
    if not lines:
        raise SonarError(f"{shown(file)}: row 1: nothing came; allowed is a header and 48 rows a message")
    if len(lines[0].split(",")) != 4 or re.fullmatch(r"[\d.,\s+-]+", lines[0]):
        raise SonarError(f"{shown(file)}: row 1: '{shown(lines[0])}' came; allowed is a header of 4 column names")
    columns = [f"{name.strip()} (rx {rx})" for rx, name in enumerate(lines[0].split(","))]
    table = NumericTable(file, lines[1:], tuple(columns), separator=",", first_row=2)
    table.refuse(
        (table.number <= 0) | (table.number > 65535), columns, "above 0 and up to 65535 mm, which means no object"
    )
    if len(table.number) % 48 or not len(table.number):
        came = f"{len(table.number)} rows below the header"
        raise SonarError(
            f"{shown(file)}: {came} came; allowed are 48 a message (12 a transmitter), one message or more"
        )
    return table.number.reshape(-1, 4, 12, 4)


def _direct(
    stamp: Float[np.ndarray, " scans"],
    pose: Float[np.ndarray, "scans 3"],
    ranges: Float[np.ndarray, "scans sensors"],
    age: Float[np.ndarray, "scans sensors"] | None = None,
) -> Recording:
    """A recording of direct echoes: one range per scan and sensor, metres, NaN where the sensor heard nothing."""
    scans, sensors = ranges.shape
    sensor = np.tile(np.arange(sensors), scans)
    return Recording(
        stamp=stamp,
        pose=pose,
        scan_index=np.repeat(np.arange(scans), sensors),
        tx=sensor,
        rx=sensor.copy(),
        range=ranges.ravel(),
        age=np.zeros(ranges.size) if age is None else age.ravel(),
    )


def _ages(
    stamp: Float[np.ndarray, " scans"], reported: Float[np.ndarray, "scans sensors"], *, period: int = 2
) -> Float[np.ndarray, "scans sensors"]:
    """Ages of readings, seconds: of equal readings in consecutive rows, those with this period are renewed ones."""
    row = np.arange(len(reported))[:, None]
    changed = np.ones(reported.shape, bool)
    changed[1:] = reported[1:] != reported[:-1]
    first = np.maximum.accumulate(np.where(changed, row, 0), axis=0)  # first row with the same reading
    return stamp[:, None] - stamp[row - (row - first) % period]


class NumericTable:
    """The numbers of a text file, with the positions of all fields for error messages."""

    def __init__(
        self,
        file: Path,
        lines: Sequence[str],
        columns: tuple[str, ...],
        *,
        separator: str | None,
        first_row: int = 1,
        text_columns: int = 0,
    ):
        """Split and convert to ``number`` (rows, columns), without the last ``text_columns`` columns."""
        self.file, self.columns, self.first_row = file, columns, first_row
        self.fields = [line.split(separator) for line in lines]
        for row, fields in enumerate(self.fields):
            if len(fields) != len(columns):
                names = ", ".join(columns) if len(columns) < 10 else f"{columns[0]} to {columns[-1]}"
                place = f"{shown(file)}: row {first_row + row}"
                raise SonarError(f"{place}: {len(fields)} columns came; allowed are {len(columns)}: {names}")
        count = len(columns) - text_columns
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
        raise AssertionError("the conversion failed, but every field is a number")

    def refuse(self, bad: Bool[np.ndarray, "..."], column: str | list[str], allowed: str) -> None:
        """Raise an error for the first bad row, if any. ``bad`` is per row, or per row and named column."""
        if bad.any():
            row, *rest = np.argwhere(bad)[0]
            self._fail(int(row), column[rest[0]] if isinstance(column, list) else column, allowed)

    def _fail(self, row: int, column: str, allowed: str) -> NoReturn:
        came = shown(self.fields[row][self.columns.index(column)])
        place = f"{shown(self.file)}: row {self.first_row + row}, column {shown(column)}"
        raise SonarError(f"{place}: '{came}' came; allowed is {allowed}")


def text_lines(file: Path) -> list[str]:
    """The lines of a text file, without their line ends (LF or CRLF)."""
    try:
        text = file.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError:
        raise SonarError(f"{shown(file)}: this is no text; needed is a recording as text") from None
    except (OSError, ValueError) as failure:
        raise SonarError(f"{shown(file)}: {reason(failure)}; needed is a readable file of the recording") from None
    return text.replace("\r\n", "\n").removesuffix("\n").split("\n") if text else []


def _natural_sort_key(file: Path) -> list[tuple[int, str]]:
    """Sort key that orders message 10 after message 9."""
    pieces = re.split(r"(\d+)", str(file))
    return [(int(piece), "") if piece.isdecimal() else (-1, piece) for piece in pieces]
