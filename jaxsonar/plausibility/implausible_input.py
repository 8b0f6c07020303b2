"""Probable mistakes of a log."""

from collections.abc import Iterator

from jaxsonar.plausibility.implausibility import Implausibility
from jaxsonar.plausibility.prepared_log import PreparedLog
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


def implausible_input(ring: Ring, log: Log) -> Iterator[Implausibility]:
    """Probable mistakes of a log. A sound log has none.

    The detectors test clocks, units of ranges, marks for no echo, held readings, and whether the echoes agree with the
    poses and with the numbering of the sensors.

    Args:
        ring: the sensors.
        log: the scans, as they were recorded.
    """
    yield from PreparedLog.of(ring, log).warnings
