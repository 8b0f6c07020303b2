"""The inputs of commands: ring and log, the options that say how a log is read, notes and warnings.

Nothing heavy is imported with this module, so that ``--help`` is fast.
"""

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from jaxsonar.floor_plans.room import Room
    from jaxsonar.recordings.input_options import InputOptions
    from jaxsonar.scans.scan_log import Log
    from jaxsonar.sensors.ring import Ring

from jaxsonar.cli.arguments import filename, finite
from jaxsonar.cli.console import errors_in, print_status
from jaxsonar.hardware.errors import SonarError
from jaxsonar.reports.text import plural

LOG_HELP = "scan log (CSV, Parquet), raw record (MCAP, extra live), ROS bag (extra ros), or what --from names"

_TABLE_OPTIONS = {"ranges": "range_columns", "time": "time_column", "pose": "pose_columns"}
"""Options of fields of ``TableFormat`` that have another name."""


def add_log_arguments(
    parser: argparse.ArgumentParser,
    *,
    name: str = "log",
    metavar: str = "LOG",
    nargs: str | None = None,
    help: str = LOG_HELP,
) -> None:
    """Add a log as positional argument, and the options that say how it is read."""
    parser.add_argument(name, nargs=nargs, type=filename, metavar=metavar, help=help)
    add_reading_options(parser, metavar)


def add_reading_options(parser: argparse.ArgumentParser, metavar: str = "LOG") -> None:
    """Add the options that say how a log is read: ``--from``, ``--sensor``, ``--odometry-topic`` and others."""
    from jaxsonar.recordings.input_options import FORMATS

    reading = parser.add_argument_group(f"how {metavar} is read")
    reading.add_argument(
        "--from", dest="from_", choices=FORMATS, metavar="FORMAT", help=f"{', '.join(FORMATS)} (default: by content)"
    )
    reading.add_argument(
        "--sensor",
        action="append",
        default=[],
        type=sensor_name,
        metavar="NAME=INDEX",
        help="bag: the sensor of the ring that a frame or topic belongs to; table: that of a column; once for each",
    )
    reading.add_argument(
        "--odometry-topic", metavar="TOPIC", help="bag: topic of the odometry (default: by its name, if that is clear)"
    )
    reading.add_argument(
        "--no-echo",
        action="append",
        default=[],
        type=finite(-1e9),
        metavar="METRES",
        help="a range that means no echo, in metres or in the unit of a table; can be repeated",
    )
    add_strict(reading)
    _add_table_options(parser)


def add_strict(parser: "argparse._ActionsContainer") -> None:
    """Add ``--strict``."""
    parser.add_argument("--strict", action="store_true", help="a warning about the input is an error (exit code 2)")


def _add_table_options(parser: argparse.ArgumentParser) -> None:
    """Add the fields of ``TableFormat`` as options."""
    from jaxsonar.recordings.input_options import ANGLE_UNITS, LENGTH_UNITS, RANGE_UNITS, TIME_UNITS

    table = parser.add_argument_group(
        "a table (--from table)",
        "One row for each scan. Columns are named by their headers or numbers, from 1: a,b,7 or 3-18 or sonar_*.",
    )
    columns = {
        "--range-columns": ("COLUMNS", "ranges of the sensors 0, 1, 2, ..."),
        "--time-column": ("COLUMN", "time (default: unknown)"),
        "--pose-columns": ("COLUMNS", "x, y and heading of the robot (default: unknown)"),
        "--delimiter": ("CHARACTER", "between columns (default: by content)"),
    }
    units = {
        "--unit": (RANGE_UNITS, "m", "of the ranges; us: time of flight, out and back"),
        "--pose-unit": (tuple(LENGTH_UNITS), "m", "of x and y"),
        "--angle-unit": (ANGLE_UNITS, "rad", "of the heading"),
        "--time-unit": (tuple(TIME_UNITS), "s", "of the time"),
    }
    flags = {
        "--round-trip": "ranges are lengths out and back",
        "--clockwise": "the heading grows from x away from y",
        "--compass": "the heading grows from y (north) towards x (east)",
        "--y-right": "y grows to the right of x",
    }
    for option, (metavar, text) in columns.items():
        table.add_argument(option, metavar=metavar, help=text)
    for option, (choices, default, text) in units.items():
        table.add_argument(option, choices=choices, help=f"{text} (default: {default})")
    for option, text in flags.items():
        table.add_argument(option, action="store_true", default=None, help=text)


def sensor_name(text: str) -> tuple[str, int]:
    """An argparse type: the name of a sensor and its index, as NAME=INDEX."""
    name, _, index = text.rpartition("=")
    if not name or not index.isascii() or not index.isdigit() or len(index) > 9:
        raise argparse.ArgumentTypeError(f"{text!r} came; allowed is NAME=INDEX, such as sonar_front=0")
    return name, int(index)


def input_options(options: argparse.Namespace) -> "InputOptions":
    """How a log is read, from the options of a command.

    Raises:
        SonarError: two indices for one name, or options of a table for something else.
    """
    from dataclasses import fields

    from jaxsonar.recordings.input_options import InputOptions, TableFormat

    table = {}
    for one in fields(TableFormat):
        option = _TABLE_OPTIONS.get(one.name, one.name)
        if (value := getattr(options, option)) is not None:
            table[one.name] = value
            if options.from_ != "table":
                raise SonarError(f"--{option.replace('_', '-')} came without --from table; allowed is it with a table")
    sensors: dict[str, int] = {}
    for name, index in options.sensor:
        if sensors.setdefault(name, index) != index:
            raise SonarError(f"--sensor {name}={index}: {name}={sensors[name]} came, too; allowed is one index a name")
    return InputOptions(
        format=options.from_,
        sensors=sensors,
        odometry=options.odometry_topic,
        no_echo=tuple(options.no_echo),
        table=TableFormat(**table),
    )


class InputMessages:
    """Prints notes and warnings about inputs on standard error, and counts the warnings."""

    def __init__(self, *, strict: bool):
        self.strict = strict
        """Whether a warning ends the command."""
        self.warnings: list[str] = []
        """The warnings so far."""

    def note(self, text: str) -> None:
        """Print a note; one that begins with ``warning:`` is a warning."""
        if text.startswith("warning: "):
            self.warn(text.removeprefix("warning: "))
        else:
            print_status(text)

    def warn(self, text: str) -> None:
        """Print a warning: what, likely cause, what to do."""
        self.warnings.append(text)
        print_status(f"warning: {text}")

    def warn_of_noise(self, sigma: float | None = None, **errors: float | None) -> None:
        """Warn of probable mistakes in options that describe errors, as ``implausible_noise``."""
        from jaxsonar.plausibility.implausible_noise import implausible_noise

        for found in implausible_noise(sigma, **errors):
            self.warn(str(found))

    def warn_of_room(self, room: "Room", poses: "np.ndarray | None" = None, stamps: "np.ndarray | None" = None) -> None:
        """Warn of probable mistakes in a floor plan, and in the poses (x, y, theta) and stamps of a robot in it."""
        from jaxsonar.plausibility.implausible_room import implausible_room, implausible_trajectory
        from jaxsonar.plausibility.implausible_stamps import implausible_times

        found = [*implausible_room(room, None if poses is None else poses[:, :2])]
        if poses is not None:
            # A room in another unit makes every position implausible; the headings can be judged nevertheless.
            found += implausible_trajectory(None if found else room, poses)
            if stamps is not None:
                found += implausible_times(stamps, poses)
        for one in found:
            self.warn(str(one))

    def warn_of_walls(self, name: str, walls: "np.ndarray") -> None:
        """Warn of probable mistakes in the walls of a map or a reference."""
        from jaxsonar.fileio.atomic_files import shown
        from jaxsonar.plausibility.implausible_room import implausible_walls

        for found in implausible_walls(walls):
            self.warn(f"{shown(name)}: {found}")

    def warn_of_stamps(self, log: "Log") -> None:
        """Warn of probable mistakes in the stamps of a log."""
        from jaxsonar.plausibility.implausible_stamps import implausible_stamps

        for found in implausible_stamps(log):
            self.warn(str(found))

    def warn_of_scale(self, ring: "Ring", log: "Log") -> None:
        """Warn of ranges that do not go with the motion of the robot, for a ring with few sensors.

        Raises:
            SonarError: they do not, and the command is strict.
        """
        from jaxsonar.calibration.implausible_scale import implausible_scale
        from jaxsonar.scans.sliding_windows import automatic_window

        if automatic_window(ring, log) is not None:
            for found in implausible_scale(ring, log):
                self.warn(str(found))
            self.check()

    def check(self) -> None:
        """Check that there was no warning, if there must be none.

        Raises:
            SonarError: there was one, and the command is strict.
        """
        if self.strict and self.warnings:
            raise SonarError(
                f"--strict: {plural(len(self.warnings), 'warning')} came; allowed is input without warnings"
            )


def load_inputs(
    options: argparse.Namespace, *, as_recorded: bool = False, messages: InputMessages | None = None
) -> tuple["Ring", "Log"]:
    """Load the ring and the log of a command; print notes and warnings.

    The log is prepared for computations (``prepared_log``).

    Args:
        options: the options of the command.
        as_recorded: return the log as it was recorded, for a command that reports itself what is wrong with it.
        messages: count the warnings together with earlier ones.

    Raises:
        SonarError: an input cannot be read, or there was a warning and ``--strict`` was given.
    """
    ring, logs = load_all_inputs(options, [options.log], as_recorded=as_recorded, messages=messages)
    return ring, logs[0]


def load_all_inputs(
    options: argparse.Namespace,
    filenames: Sequence[str],
    *,
    as_recorded: bool = False,
    messages: InputMessages | None = None,
) -> tuple["Ring", list["Log"]]:
    """Load the ring of a command and several logs, as ``load_inputs``."""
    from jaxsonar.plausibility.prepared_log import prepared_log

    messages = messages or InputMessages(strict=options.strict)
    ring, logs = load_checked_ring(options.ring, messages), []
    messages.warn_of_noise(getattr(options, "sigma", None))
    for name in filenames:
        log = read_log(name, options, messages, ring=ring)
        with errors_in(name):
            if options.strict or not as_recorded:
                prepared = prepared_log(ring, log, on_note=messages.note)
                log = log if as_recorded else prepared
        logs.append(log)
    messages.check()
    return ring, logs


def load_checked_ring(name: str, messages: InputMessages) -> "Ring":
    """Load the ring of a command; warn of probable mistakes in it.

    Raises:
        SonarError: it cannot be read.
    """
    from jaxsonar.plausibility.implausible_ring import implausible_ring
    from jaxsonar.sensors.ring_toml import load_ring

    ring = load_ring(name)
    for found in implausible_ring(ring):
        messages.warn(str(found))
    return ring


def _check_names_are_used(name: str, options: argparse.Namespace) -> None:
    """Check that options with names of sensors or topics belong to the format of a log.

    Raises:
        SonarError: they do not.
    """
    if not options.sensor and options.odometry_topic is None:
        return
    from jaxsonar.fileio.atomic_files import shown
    from jaxsonar.recordings.file_content import file_content

    content = file_content(name)
    if (options.from_ or content.format) in ("csv", "parquet", "record", "beesoft", "corridor8", "scitos24", "sew-amr"):
        option = "--sensor" if options.sensor else "--odometry-topic"
        raise SonarError(f"{shown(name)}: {option} came with {content.description}; allowed is it with a ROS bag")


def nothing_used(ring: "Ring", log: "Log", name: str, *, with_poses: bool = False) -> bool:
    """Whether no echo of a log can be used, or none of a scan with a pose (``with_poses``); prints the reason."""
    from jaxsonar.fileio.atomic_files import shown
    from jaxsonar.plausibility.unused_echoes import EchoCounts

    with errors_in(name):
        reason = EchoCounts.of(ring, log, with_poses=with_poses).why_none_is_used(ring)
    if reason:
        print_status(f"nothing found: {shown(name)}: {reason}")
    return bool(reason)


def read_log(name: str, options: argparse.Namespace, messages: InputMessages, *, ring: "Ring | None" = None) -> "Log":
    """Read a log as its options say; nothing is changed in it.

    Raises:
        SonarError: it cannot be read, or an option does not belong to its format.
    """
    from jaxsonar.recordings.load_log import load_log_with_warnings

    reading = input_options(options)
    _check_names_are_used(name, options)
    return load_log_with_warnings(name, ring=ring, options=reading, on_note=messages.note)
