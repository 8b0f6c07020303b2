"""Logs of Player (``writelog``, versions 2 and 3) as scan logs.

Each line is a message: ``time host robot interface index type subtype`` and its content. The ranges are messages
``sonar`` 1:1 (count, ranges in m), the odometry is ``position2d`` 1:1 (x, y in m, heading in rad, speeds). Lines that
begin with ``#`` and other messages are skipped.
"""

import math
import os
from collections.abc import Callable
from pathlib import Path

from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.datasets import text_lines
from jaxsonar.hardware.errors import SonarError
from jaxsonar.recordings.input_options import InputOptions
from jaxsonar.recordings.timed_readings import TimedReadings
from jaxsonar.scans.scan_log import Log

HEADER_FIELDS = 7


def load_player(filename: str | os.PathLike[str], *, options: InputOptions, on_note: Callable[[str], None]) -> Log:
    """Load a Player log. It holds direct echoes only; a range that is not above 0 or not finite means no echo.

    Args:
        filename: the file.
        options: ``odometry`` names the device with the odometry, such as ``position2d:0``; ``sensors`` gives the index
            of the first sensor of each sonar device, such as ``{"sonar:0": 0, "sonar:1": 16}``, if there are several.
        on_note: called with one line for each choice.

    Raises:
        SonarError: the file cannot be read, a line is malformed, or an option is missing; the message names it.
    """
    messages = _messages(filename)
    devices = sorted({device for _, _, device, _ in messages})
    first_sensor = _first_sensors(filename, [one for one in devices if _is(one, "sonar")], options)
    odometry = _odometry(filename, [one for one in devices if _is(one, "position")], options)
    readings, sensors = TimedReadings(), 0
    for number, time, device, values in messages:
        if device == odometry:
            if len(values) < 3:
                raise _fault(filename, number, f"{len(values)} numbers", "x, y, heading and speeds")
            readings.add_pose(time, *values[:3])
        elif device in first_sensor:
            count = int(values[0]) if values and values[0] >= 0 else -1
            if len(values) != count + 1:
                raise _fault(filename, number, f"{len(values)} numbers", "a count and that many ranges")
            begin = first_sensor[device]
            ranges = {begin + k: value if value > 0 else math.nan for k, value in enumerate(values[1:])}
            sensors = max(sensors, begin + count)
            readings.add_scan(time, ranges)
    source = f"odometry of {odometry}" if odometry else "no odometry (position2d)"
    on_note(f"Player: {len(readings.stamp)} scans of {sensors} sonars, ranges in m; {source}")
    return readings.as_log(on_note)


def _messages(filename: str | os.PathLike[str]) -> list[tuple[int, float, str, list[float]]]:
    """Line number, time, device and content of the sonar ranges and poses; an incomplete last line is skipped."""
    found: list[tuple[int, float, str, list[float]]] = []
    lines = text_lines(Path(filename))
    for number, line in enumerate(lines, 1):
        fields = line.split()
        if len(fields) < HEADER_FIELDS or line.lstrip().startswith("#") or not _is(fields[3], "sonar", "position"):
            continue
        try:
            time, index, kind, subtype = float(fields[0]), int(fields[4]), int(fields[5]), int(fields[6])
            values = [float(field) for field in fields[HEADER_FIELDS:]]
        except ValueError:
            if number == len(lines):
                break
            raise _fault(filename, number, f"'{shown(line, 40)}'", "a message of numbers") from None
        if (kind, subtype) == (1, 1):
            device = f"{fields[3]}:{index}"
            if number == len(lines) and _is_cut(device, values, found):
                break
            found.append((number, time, device, [v if math.isfinite(v) else math.nan for v in values]))
    if not any(_is(device, "sonar") for _, _, device, _ in found):
        needed = "messages 'sonar' of type 1, subtype 1"
        raise SonarError(f"{shown(filename)}: no sonar ranges came; needed is a Player log with {needed}")
    return found


def _is_cut(device: str, values: list[float], before: list[tuple[int, float, str, list[float]]]) -> bool:
    """Whether the last message of a log is shorter than it says, or than the others of its device."""
    if _is(device, "sonar"):
        return len(values) != (values[0] if values else 0) + 1
    usual = next((len(one) for _, _, other, one in reversed(before) if other == device), 3)
    return len(values) < usual


def _is(device: str, *interfaces: str) -> bool:
    """Whether a device, or the name of an interface, belongs to one of these interfaces; position2d is a position."""
    return device.partition(":")[0].removesuffix("2d") in interfaces


def _first_sensors(filename: str | os.PathLike[str], devices: list[str], options: InputOptions) -> dict[str, int]:
    """Index of the first sensor of each sonar device that is used."""
    unknown = [name for name in options.sensors if name not in devices]
    if unknown:
        came = f"--sensor {shown(unknown[0], 40)}: no such device"
        raise SonarError(f"{shown(filename)}: {came}; allowed are {', '.join(devices)}")
    if options.sensors:
        return {name: options.sensors[name] for name in devices if name in options.sensors}
    if len(devices) > 1:
        example = " ".join(f"--sensor {name}={16 * k}" for k, name in enumerate(devices))
        came = f"{len(devices)} sonar devices came: {', '.join(devices)}"
        raise SonarError(f"{shown(filename)}: {came}; name the first sensor of each, such as {example}")
    return {devices[0]: 0}


def _odometry(filename: str | os.PathLike[str], devices: list[str], options: InputOptions) -> str | None:
    """The device with the odometry."""
    if options.odometry is not None:
        if options.odometry not in devices:
            allowed = ", ".join(devices) or "none: the log has no position2d"
            came = f"--odometry-topic {shown(options.odometry, 40)}: no such device"
            raise SonarError(f"{shown(filename)}: {came}; allowed are {allowed}")
        return options.odometry
    if len(devices) > 1:
        came = f"{len(devices)} devices with poses came: {', '.join(devices)}"
        raise SonarError(f"{shown(filename)}: {came}; choose one: --odometry-topic {devices[0]}")
    return devices[0] if devices else None


def _fault(filename: str | os.PathLike[str], number: int, came: str, allowed: str) -> SonarError:
    return SonarError(f"{shown(filename)}: row {number}: {came} came; allowed is {allowed}")
