"""Warnings about logs that can be read but are probably not what the person means: clocks and units of ranges."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from jaxsonar.plausibility.implausibility import Implausibility
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class PlausibilitySettings:
    """When a log is implausible. Chosen by hand, such that no sound log of the tests and data sets gets a warning."""

    beyond: float = 0.8
    """Share of the echoes beyond the maximum range of the ring. In a large hall, half of them may be."""
    least_echoes: int = 20
    """Logs with fewer echoes give no warning about their ranges."""


SETTINGS = PlausibilitySettings()


def implausible_input(ring: Ring, log: Log) -> Iterator[Implausibility]:
    """Probable mistakes of a log.

    Args:
        ring: the sensors.
        log: the scans.
    """
    fall = np.flatnonzero(np.diff(log.stamp) < 0)  # False for NaN
    if len(fall):
        before, after = log.stamp[fall[0] : fall[0] + 2]
        times = "once" if len(fall) == 1 else f"{len(fall)} times, first"
        what = f"the stamps fall {times} from {before:.3f} s to {after:.3f} s"
        cause = "the clock was set, or logs were joined"
        yield Implausibility("stamps", what, cause, "give the scans the times at which they were taken")
    heard = log.range[np.isfinite(log.range)]
    if len(heard) >= SETTINGS.least_echoes and (share := float(np.mean(heard > ring.max_range))) > SETTINGS.beyond:
        what = f"{share:.0%} of the echoes are beyond the maximum range of the ring, {ring.max_range:g} m"
        cause = "the ranges have another unit, or the ring is another one"
        yield Implausibility("range unit", what, cause, "give half path lengths in metres")
