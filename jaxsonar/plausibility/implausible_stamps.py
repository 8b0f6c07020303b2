"""Probable mistakes of the stamps of a log: clocks that were set, and units other than seconds."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.plausibility.implausibility import Implausibility
from jaxsonar.scans.scan_log import Log


@dataclass(frozen=True)
class StampSettings:
    """When stamps are no seconds. Chosen by hand."""

    slow: float = 0.002
    """A robot that drives is faster than this, metres per second, in at least a tenth of its steps, ..."""
    slow_turn: float = float(np.radians(0.2))
    """... or turns faster than this, radians per second."""
    moved: float = 0.01
    """A robot drives if it moves by this, metres, ..."""
    turned: float = float(np.radians(1.0))
    """... or turns by this, radians, from scan to scan."""
    period: float = 5.0
    """Scans follow each other within this time, seconds, ..."""
    longest: float = 1000.0
    """... or, without poses, within this time, seconds."""
    latest: float = 1e11
    """Seconds since 1970 are below this value, of the year 5138."""
    steps: int = 5
    """Fewer steps give no warning."""


SETTINGS = StampSettings()

_UNITS = ((1e-3, "milliseconds"), (1e-6, "microseconds"), (1e-9, "nanoseconds"))


def implausible_stamps(log: Log) -> Iterator[Implausibility]:
    """Probable mistakes of the stamps of a log.

    Args:
        log: the scans.
    """
    yield from implausible_times(log.stamp, log.pose)


def implausible_times(
    stamp: Float[np.ndarray, " poses"], pose: Float[np.ndarray, "poses 3"]
) -> Iterator[Implausibility]:
    """Probable mistakes of the stamps of poses.

    Args:
        stamp: times, seconds; NaN: unknown.
        pose: world_from_robot x, y (metres), theta (radians) at these times; NaN: unknown.
    """
    fall = np.flatnonzero(np.diff(stamp) < 0)  # False for NaN
    if len(fall):
        before, after = stamp[fall[0] : fall[0] + 2]
        times = "once" if len(fall) == 1 else f"{len(fall)} times, first"
        what = f"the stamps run backwards {times} from {before:.3f} s to {after:.3f} s"
        cause = "the clock was set, or logs were joined"
        yield Implausibility("stamps", what, cause, "give the scans the times at which they were taken")
        return
    step = np.diff(stamp)
    known = np.isfinite(step) & (step > 0)
    if known.sum() < SETTINGS.steps:
        return
    period = float(np.median(step[known]))
    last = float(np.nanmax(np.abs(stamp)))
    moved = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    turned = np.abs(wrap_angle(np.diff(pose[:, 2])))
    moves = known & ((moved > SETTINGS.moved) | (turned > SETTINGS.turned))  # False for NaN
    cause = ""
    if last > SETTINGS.latest:
        what = f"the stamps reach {last:.4g} s"
    elif moves.sum() >= SETTINGS.steps and period > SETTINGS.period:
        speed, turn = (np.quantile(one[moves] / step[moves], 0.9) for one in (moved, turned))
        if speed > SETTINGS.slow or turn > SETTINGS.slow_turn:
            return
        what = f"the scans are {period:g} s apart, and the robot drives {speed * 1000:.2g} mm/s"
    elif period > SETTINGS.longest:
        what = f"the scans are {period:g} s apart"
    else:
        return
    fits = [unit for unit in _UNITS if period * unit[0] <= SETTINGS.period and last * unit[0] < SETTINGS.latest]
    if fits:
        cause = f"the stamps are probably {fits[0][1]}"
    yield Implausibility("stamps", what, cause or "the stamps have another unit", "give seconds")
