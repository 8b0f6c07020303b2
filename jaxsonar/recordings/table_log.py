"""Tables with one row per scan as logs: a column for each sensor, and columns for time and pose."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.fileio.atomic_files import shown
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.messages import REFERENCE_SPEED_OF_SOUND
from jaxsonar.recordings.input_options import (
    ANGLE_UNITS,
    LENGTH_UNITS,
    RANGE_UNITS,
    TIME_UNITS,
    InputOptions,
    TableFormat,
)
from jaxsonar.recordings.table_text import MISSING, NUMBER, TableText, is_words
from jaxsonar.scans.no_echo_values import SETTINGS
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class TableSettings:
    """When the unit of the ranges of a table is implausible. Chosen by hand."""

    farthest: float = 50.0
    """Hardly any ultrasonic sensor in air hears an echo from beyond this range, metres, ..."""
    nearest: float = 0.005
    """... or from below this one, metres."""
    implausible: float = 0.9
    """Share of the ranges out of these limits from which on the unit is implausible."""
    least_ranges: int = 20
    """Tables with fewer ranges give no warning."""


TABLE_SETTINGS = TableSettings()


def load_table(
    filename: str | os.PathLike[str],
    *,
    ring: Ring | None = None,
    options: InputOptions,
    on_note: Callable[[str], None],
) -> Log:
    """Load a table: one row per scan, one column per sensor with the range of its direct echo.

    Every sensor of a row has fired. It heard nothing where the field is empty, a text without digits, not above 0, or
    one of ``options.no_echo``.

    Args:
        filename: text with any delimiter, with or without a header.
        ring: the sensors, to check their number; None: unknown.
        options: ``table``, ``sensors`` and ``no_echo``.
        on_note: called with one line for each choice.

    Raises:
        SonarError: the file is no such table, or an option is missing or invalid.
    """
    form = options.table
    _check_units(filename, form)
    table = TableText.read(filename, delimiter=form.delimiter)
    columns, sensors = _range_columns(table, options, ring)
    stamp = np.full(len(table.rows), np.nan)
    if form.time is not None:
        stamp = _stamps(table, _one_column(table, form.time, "--time-column"), form)
    pose = _poses(table, form)
    _check_overlap(table, form, columns)
    ranges = np.stack([table.numbers(column, texts=True) for column in columns], axis=1)
    _note_texts(table, columns, on_note)
    marked = np.zeros(ranges.shape, bool)
    for mark in options.no_echo:
        has_it = np.abs(ranges - mark) <= SETTINGS.equal * max(abs(mark), 1.0)
        if not has_it.any():
            on_note(f"--no-echo {mark:g}: no range has this value")
        marked |= has_it
    not_positive = (ranges <= 0) & ~marked
    if not_positive.any():
        values = ", ".join(f"{value:g}" for value in np.unique(ranges[not_positive])[:3])
        on_note(f"{int(not_positive.sum())} ranges that are not above 0 ({values}) mean no echo")
    ranges[marked | not_positive] = np.nan
    _note_columns(table, form, columns, sensors, on_note)
    metres = _metres(ranges, form)
    if (text := _implausible_unit(metres)) is not None:
        on_note(f"warning: {text}")
    sensor = np.tile(sensors, len(stamp))
    return Log.from_echoes(
        np.repeat(np.arange(len(stamp)), len(sensors)),
        sensor,
        sensor.copy(),
        metres.ravel(),
        stamp=stamp,
        pose=pose,
    )


def _check_units(filename: str | os.PathLike[str], form: TableFormat) -> None:
    for option, unit, known in (
        ("--unit", form.unit, RANGE_UNITS),
        ("--pose-unit", form.pose_unit, tuple(LENGTH_UNITS)),
        ("--angle-unit", form.angle_unit, ANGLE_UNITS),
        ("--time-unit", form.time_unit, tuple(TIME_UNITS)),
    ):
        if unit not in known:
            raise SonarError(f"{shown(filename)}: {option} {shown(unit, 40)} came; allowed are {', '.join(known)}")
    if form.unit == "us" and form.round_trip:
        came = "--unit us and --round-trip came; allowed is one of them"
        raise SonarError(f"{shown(filename)}: {came}: a time of flight is always out and back")
    if form.clockwise and form.compass:
        raise SonarError(f"{shown(filename)}: --clockwise and --compass came; allowed is one of them")


def _range_columns(
    table: TableText, options: InputOptions, ring: Ring | None
) -> tuple[list[int], Int[np.ndarray, " columns"]]:
    """Columns with ranges, and the sensor of each."""
    named = {column: index for name, index in options.sensors.items() for column in table.columns(name, "--sensor")}
    if options.table.ranges is None:
        if not named:
            came = f"no column with ranges was named; the columns are {table.listed()}"
            example = "--range-columns 4-11, or --sensor NAME=INDEX for each sensor"
            raise SonarError(f"{shown(table.filename)}: {came}; name them: {example}")
        columns, sensors = list(named), list(named.values())
    else:
        columns = table.columns(options.table.ranges, "--range-columns")
        if not columns:
            came = f"--range-columns '{shown(options.table.ranges, 40)}': no column came"
            raise SonarError(f"{shown(table.filename)}: {came}; allowed are {table.listed()}")
        unknown = [table.name(column) for column in columns if column not in named]
        if named and unknown:
            raise SonarError(
                f"{shown(table.filename)}: column {unknown[0]} has no sensor; allowed is --sensor for all or none"
            )
        sensors = [named[column] for column in columns] if named else list(range(len(columns)))
    if len(set(sensors)) < len(sensors):
        raise SonarError(f"{shown(table.filename)}: --sensor: two columns of one sensor came; allowed is one column")
    if ring is not None and sensors and max(sensors) >= ring.count:
        came = f"{len(columns)} columns with ranges came, up to sensor {max(sensors)}"
        raise SonarError(f"{shown(table.filename)}: {came}; the ring has the sensors 0 to {ring.count - 1}")
    return columns, np.array(sensors, np.int64)


def _check_overlap(table: TableText, form: TableFormat, ranges: list[int]) -> None:
    """Raise an error if one column has two meanings."""
    meaning = {column: "--range-columns or --sensor" for column in ranges}
    for option, wanted in (("--time-column", form.time), ("--pose-columns", form.pose)):
        for column in table.columns(wanted, option) if wanted is not None else []:
            if (other := meaning.setdefault(column, option)) != option:
                came = f"column {table.name(column)} came in {other} and in {option}"
                raise SonarError(f"{shown(table.filename)}: {came}; allowed is one of them")


def _one_column(table: TableText, wanted: str, option: str) -> int:
    columns = table.columns(wanted, option)
    if len(columns) != 1:
        raise SonarError(f"{shown(table.filename)}: {option} {shown(wanted, 40)}: {len(columns)} columns; allowed is 1")
    return columns[0]


def _stamps(table: TableText, column: int, form: TableFormat) -> Float[np.ndarray, " rows"]:
    """Time of each row, seconds: a number, or a date and time of ISO 8601 (in UTC if it names no zone)."""
    first = next((row[column] for row in table.rows if row[column].lower() not in MISSING), "0")
    if NUMBER.fullmatch(first) or table.decimal_comma:
        return table.numbers(column) * TIME_UNITS[form.time_unit]
    stamp = np.full(len(table.rows), np.nan)
    for k, row in enumerate(table.rows):
        if row[column].lower() not in MISSING:
            try:
                date = datetime.fromisoformat(row[column])
                stamp[k] = (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
            except ValueError:
                allowed = f"a number ({form.time_unit}), or a date and time such as 2024-05-31 12:00:00.25"
                raise table.fault(k, column, allowed) from None
    return stamp


def _poses(table: TableText, form: TableFormat) -> Float[np.ndarray, "rows 3"]:
    """world_from_robot of each row; NaN if any of its numbers is missing."""
    pose = np.full((len(table.rows), 3), np.nan)
    if form.pose is None:
        return pose
    columns = table.columns(form.pose, "--pose-columns")
    if len(columns) != 3:
        came = f"--pose-columns {shown(form.pose, 40)}: {len(columns)} columns"
        raise SonarError(f"{shown(table.filename)}: {came}; allowed are 3: x, y and heading")
    x, y, heading = (table.numbers(column) for column in columns)
    theta = np.radians(heading) if form.angle_unit == "deg" else heading
    if form.compass:
        theta = np.pi / 2 - theta
    elif form.clockwise:
        theta = -theta
    if form.y_right:
        y, theta = -y, -theta
    scale = LENGTH_UNITS[form.pose_unit]
    turned = form.angle_unit == "deg" or form.compass
    pose[:] = np.column_stack([x * scale, y * scale, wrap_angle(theta) if turned else theta])
    pose[np.isnan(pose).any(axis=1)] = np.nan
    return pose


def _metres(ranges: Float[np.ndarray, "rows columns"], form: TableFormat) -> Float[np.ndarray, "rows columns"]:
    """Half path lengths, metres."""
    if form.unit == "us":
        return ranges * 1e-6 * (REFERENCE_SPEED_OF_SOUND / 2)
    return ranges * LENGTH_UNITS[form.unit] / (2 if form.round_trip else 1)


def _implausible_unit(metres: Float[np.ndarray, "rows columns"]) -> str | None:
    """A warning in words if nearly all ranges are out of reach of an ultrasonic sensor; None if they are not."""
    heard = metres[np.isfinite(metres)]
    if len(heard) < TABLE_SETTINGS.least_ranges:
        return None
    far, near = np.mean(heard > TABLE_SETTINGS.farthest), np.mean(heard < TABLE_SETTINGS.nearest)
    if max(far, near) < TABLE_SETTINGS.implausible:
        return None
    what = f"{max(far, near):.0%} of the ranges are "
    what += f"above {TABLE_SETTINGS.farthest:g} m" if far > near else f"below {1000 * TABLE_SETTINGS.nearest:g} mm"
    return f"{what}, the median is {np.median(heard):.4g} m; they probably have another unit; give it with --unit"


def _note_texts(table: TableText, columns: list[int], on_note: Callable[[str], None]) -> None:
    """Report the texts that are read as no echo."""
    fields = [row[column] for row in table.rows for column in columns]
    texts = [field for field in fields if field.lower() not in MISSING and is_words(field)]
    if texts:
        listed = ", ".join(f"'{shown(one, 40)}'" for one in list(dict.fromkeys(texts))[:3])
        on_note(f"fields with a text ({listed}) mean no echo: {len(texts)}")


def _note_columns(
    table: TableText,
    form: TableFormat,
    columns: list[int],
    sensors: Int[np.ndarray, " columns"],
    on_note: Callable[[str], None],
) -> None:
    """Report how the table was read."""
    between = {" ": "blanks", "\t": "tabs"}.get(table.delimiter, f"'{table.delimiter}'")
    comma = ", decimal commas" if table.decimal_comma else ""
    unit = "us of flight" if form.unit == "us" else f"{form.unit}{' out and back' if form.round_trip else ''}"
    if len(columns) > 3 and np.array_equal(sensors, np.arange(len(columns))):
        listed = f"columns {table.name(columns[0])} to {table.name(columns[-1])} are sensors 0 to {len(columns) - 1}"
    else:
        pairs = zip(columns, sensors.tolist(), strict=True)
        listed = "columns " + ", ".join(f"{table.name(column)} = sensor {sensor}" for column, sensor in pairs)
    on_note(f"table separated by {between}{comma}; {listed} ({unit})")
