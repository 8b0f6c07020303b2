"""Logs of Beesoft (RWI B14, B21; the ``.script`` files of many data sets) as scan logs.

Lines of the first format: ``@SENS 20-02-98 15:48:17.156918`` is the time of what follows, ``#ROBOT x y heading`` the
odometry in cm and degrees, counter-clockwise, and ``#SONAR 24: r0 r1 ...`` the ranges in cm. The second format has the
same values in blocks ``begin(pattern)`` ... ``end(pattern)`` with the lines ``time: seconds microseconds``,
``sonars 24: ...`` and ``position: x y heading``. Other lines are skipped.
"""

import math
import os
import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.datasets import text_lines
from jaxsonar.hardware.errors import SonarError
from jaxsonar.recordings.timed_readings import TimedReadings, listed_numbers
from jaxsonar.scans.scan_log import Log

SATURATED = 255 * 2.54
"""Range that means no echo, cm: the largest one of a sonar that reports 8 bits in inches."""
LARGEST = 1070.0
"""Largest range of the sonars (Polaroid, 35 ft), cm. Larger values mean no echo."""
NUMBERS = r"((?:\s+[-+\d.eE]+|\s+[-+]?(?:nan|inf))*)\s*$"
SONAR = re.compile(r"(?:#SONAR|sonars)\s+(\d+)\s*:" + NUMBERS)
POSE = re.compile(r"(#ROBOT|position:)" + NUMBERS)
TIME = re.compile(r"@(?:SENS|OPEN)\s+(\d+)-(\d+)-(\d+)\s+(\d+):(\d+):(\d+)(?:\.(\d+))?\s*$")
PATTERN_TIME = re.compile(r"time:\s*(\d+)\s+(\d+)\s*$")


class _Line(NamedTuple):
    """A line with data."""

    number: int
    kind: str
    """sonar, #ROBOT, position:, time, begin or end."""
    values: tuple[float, ...] = ()
    announced: int = 0
    """sonar: number of ranges that the line announces."""
    fraction: str = ""
    """time: digits after the decimal point."""


def load_beesoft(filename: str | os.PathLike[str], *, on_note: Callable[[str], None]) -> Log:
    """Load a Beesoft log. Sensors are numbered as in the file. The log holds direct echoes only.

    A range of 255 inches or more than 1070 cm means no echo; a range of 0 means that the sensor did not fire.

    Args:
        filename: the file.
        on_note: called with one line for each choice.

    Raises:
        SonarError: the file cannot be read, or a line is malformed; the message names it.
    """
    lines = list(_data_lines(filename))
    if not any(line.kind == "sonar" for line in lines):
        raise SonarError(f"{shown(filename)}: no line with sonar ranges came; needed is a Beesoft log (#SONAR 24: ...)")
    times = _times([line for line in lines if line.kind == "time"])
    readings, silent, fired = TimedReadings(), 0, set[int]()
    now, in_pattern, pending = math.nan, False, None
    for line in lines:
        if line.kind == "time":
            now = times[line.number]
        elif line.kind in ("begin", "end"):
            if line.kind == "end" and pending is not None:
                readings.add_scan(now, pending)
            in_pattern, pending = line.kind == "begin", None
        elif line.kind == "#ROBOT" or (line.kind == "position:" and in_pattern):
            if len(line.values) != 3 or not all(map(math.isfinite, line.values)):
                raise _fault(filename, line, "three numbers: x, y (cm), heading (deg)")
            x, y, heading = line.values
            readings.add_pose(now, x / 100, y / 100, math.remainder(math.radians(heading), math.tau))
        elif line.kind == "sonar":
            if len(line.values) != line.announced:
                raise _fault(filename, line, f"{line.announced} ranges, as the line announces")
            ranges = {k: _metres(value) for k, value in enumerate(line.values) if value > 0 or math.isnan(value)}
            silent += sum(map(math.isnan, ranges.values()))
            fired |= ranges.keys()
            if in_pattern:
                pending = ranges  # its position follows
            else:
                readings.add_scan(now, ranges)
    sensors = max(line.announced for line in lines if line.kind == "sonar")
    on_note(f"Beesoft: {len(readings.stamp)} scans of {sensors} sonars, numbered as in the file; ranges in cm")
    if silent:
        on_note(f"{silent} ranges of {SATURATED:.1f} cm (255 inches) or more than {LARGEST:.0f} cm mean no echo")
    if len(fired) < sensors:
        on_note(f"sensors {listed_numbers([*set(range(sensors)) - fired])} always report 0: they do not exist")
    return readings.as_log(on_note)


def _data_lines(filename: str | os.PathLike[str]) -> Iterator[_Line]:
    """The lines with data; an incomplete last line is skipped."""
    texts = text_lines(Path(filename))
    for number, text in enumerate(texts, 1):
        line = text.strip()
        if found := SONAR.match(line):
            values, count = _numbers(found[2]), int(found[1][:9])
            if number < len(texts) or len(values) == count:
                yield _Line(number, "sonar", values, count)
        elif found := POSE.match(line):
            yield _Line(number, found[1], _numbers(found[2]))
        elif found := TIME.match(line):
            yield _Line(number, "time", _date_time(filename, number, found), fraction=found[7] or "")
        elif found := PATTERN_TIME.match(line):
            yield _Line(number, "time", (float(found[1]) + float(found[2]) * 1e-6,))
        elif line.startswith(("begin(pattern)", "end(pattern)")):
            yield _Line(number, line.partition("(")[0])
        elif line.startswith(("#SONAR", "#ROBOT")) and number < len(texts):
            allowed = "#SONAR N: and N numbers, or #ROBOT and 3 numbers"
            raise SonarError(f"{shown(filename)}: row {number}: '{shown(line, 40)}' came; allowed is {allowed}")


def _date_time(filename: str | os.PathLike[str], number: int, found: re.Match[str]) -> tuple[float]:
    """Whole seconds since 1970 of day-month-year hour:minute:second; years have two digits, or count from 1900."""
    day, month, year, hour, minute, second = (int(text) for text in found.groups()[:6])
    year += 0 if year >= 1000 else 1900 if year >= 70 else 2000
    try:
        date = datetime(year, max(month, 1), max(day, 1), tzinfo=UTC)
        return ((date + timedelta(hours=hour, minutes=minute, seconds=second)).timestamp(),)
    except (ValueError, OverflowError):
        allowed = "day-month-year hour:minute:second"
        raise SonarError(
            f"{shown(filename)}: row {number}: '{shown(found[0], 40)}' came; allowed is {allowed}"
        ) from None


def _times(lines: list[_Line]) -> dict[int, float]:
    """Seconds of each line with a time.

    Beesoft prints microseconds without leading zeros (``57.65362`` is 57.065362 s); other programs print a decimal
    fraction. What makes the times fall more rarely is right.
    """
    micro = [line.values[0] + int(line.fraction[:9] or "0") * 1e-6 for line in lines]
    decimal = [line.values[0] + float(f"0.{line.fraction or '0'}") for line in lines]
    equal_length = len({len(line.fraction) for line in lines}) == 1 and len(lines) > 1
    falls = [sum(b < a for a, b in pairwise(times)) for times in (micro, decimal)]
    use_decimal = falls[1] < falls[0] or (falls[1] == falls[0] and equal_length)
    return {line.number: time for line, time in zip(lines, decimal if use_decimal else micro, strict=True)}


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(field) if _is_number(field) else math.nan for field in text.split())


def _is_number(field: str) -> bool:
    try:
        return math.isfinite(float(field))
    except ValueError:
        return False


def _metres(value: float) -> float:
    """Range in metres from cm; NaN for no echo."""
    is_echo = value <= LARGEST and abs(value - SATURATED) > 0.05
    return value / 100 if is_echo else math.nan


def _fault(filename: str | os.PathLike[str], line: _Line, allowed: str) -> SonarError:
    return SonarError(f"{shown(filename)}: row {line.number}: {len(line.values)} numbers came; allowed are {allowed}")
