"""What a person says about a recording that its file does not say itself."""

from collections.abc import Mapping
from dataclasses import dataclass, field

FORMATS = ("csv", "parquet", "record", "bag")
"""Formats that can be named as ``InputOptions.format``."""


@dataclass(frozen=True)
class InputOptions:
    """How to read a recording. The defaults fit files that say everything themselves."""

    format: str | None = None
    """Format of the file (``--from``); None: its content decides."""
    sensors: Mapping[str, int] = field(default_factory=dict)
    """Sensor index of each frame or topic, where names do not tell it (``--sensor NAME=INDEX``)."""
    odometry: str | None = None
    """Topic of the odometry (``--odometry``); None: the only one, or chosen by frame."""
    no_echo: tuple[float, ...] = ()
    """Ranges, metres, that mean no echo (``--no-echo``)."""
