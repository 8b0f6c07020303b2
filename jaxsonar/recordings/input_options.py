"""What a person says about a recording that its file does not say itself. Nothing heavy is imported."""

from collections.abc import Mapping
from dataclasses import dataclass, field

FORMATS = ("csv", "parquet", "record", "bag", "table", "beesoft", "player", "corridor8", "scitos24", "sew-amr")
"""Formats that can be named as ``InputOptions.format``."""

LENGTH_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Metres of each unit of length."""
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Seconds of each unit of time."""
RANGE_UNITS = (*LENGTH_UNITS, "us")
"""Units of ranges; us: time of flight, out and back."""
ANGLE_UNITS = ("rad", "deg")


@dataclass(frozen=True)
class TableFormat:
    """Columns, units and conventions of a table with one row per scan (``--from table``).

    A column is named by its header or by its number, counted from 1. Several columns are named as a list (``a,b,7``), a
    run of numbers (``3-18``) or a pattern (``sonar_*``).
    """

    ranges: str | None = None
    """Columns with the ranges of the sensors 0, 1, 2, ... in this order (``--range-columns``)."""
    time: str | None = None
    """Column with the time (``--time-column``); None: unknown."""
    pose: str | None = None
    """Columns with x, y and heading of the robot (``--pose-columns``); None: unknown."""
    unit: str = "m"
    """Unit of the ranges (``--unit``), one of ``RANGE_UNITS``."""
    round_trip: bool = False
    """Ranges are lengths out and back, not to the wall (``--round-trip``)."""
    pose_unit: str = "m"
    """Unit of x and y (``--pose-unit``), one of ``LENGTH_UNITS``."""
    angle_unit: str = "rad"
    """Unit of the heading (``--angle-unit``), one of ``ANGLE_UNITS``."""
    clockwise: bool = False
    """The heading grows from the x axis away from the y axis (``--clockwise``); default: towards the y axis."""
    compass: bool = False
    """The heading grows from the y axis towards the x axis (``--compass``): y is north, x is east."""
    y_right: bool = False
    """y grows to the right of the x axis, not to the left (``--y-right``): y and heading change their signs."""
    time_unit: str = "s"
    """Unit of the time (``--time-unit``), one of ``TIME_UNITS``."""
    delimiter: str | None = None
    """Character between columns (``--delimiter``); None: found out."""


@dataclass(frozen=True)
class InputOptions:
    """How to read a recording. The defaults fit files that say everything themselves."""

    format: str | None = None
    """Format of the file (``--from``), one of ``FORMATS``; None: its content decides."""
    sensors: Mapping[str, int] = field(default_factory=dict)
    """Sensor index of each frame or topic of a bag, column of a table or device of a Player log, where names do not
    tell it (``--sensor NAME=INDEX``)."""
    odometry: str | None = None
    """Topic of the odometry (``--odometry-topic``), or its device in a Player log; None: the only one, or chosen."""
    no_echo: tuple[float, ...] = ()
    """Ranges that mean no echo (``--no-echo``), in metres; of a table, in the unit of its ranges."""
    table: TableFormat = TableFormat()
    """How to read a table."""
