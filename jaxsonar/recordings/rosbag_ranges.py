"""Values of ``sensor_msgs/Range``: echoes, silence, and readings that measured nothing (REP 117, and older drivers)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

ECHO, SILENT, NOT_MEASURED = 0, 1, 2


@dataclass(frozen=True)
class RangeValueSettings:
    """Constants of the meaning of ranges. Chosen by hand."""

    equal: float = 1e-5
    """Relative difference of a range to a limit that are equal; larger than the rounding of 32-bit floats."""
    absurd_minimum: float = 0.5
    """A minimum that a larger share of the echoes stays below is no limit."""
    different_values: int = 10
    """A maximum that no echo stays below, but that so many different ranges exceed, is no limit."""
    farthest: float = 20.0
    """No ultrasound sensor hears farther in air, metres; 40 kHz loses over 1 dB per metre."""
    repetitions: int = 3
    """A range beyond the ring's maximum that is repeated exactly so often means no echo."""


SETTINGS = RangeValueSettings()


def reading_kinds(
    reported: Float[np.ndarray, " readings"],
    low: Float[np.ndarray, " readings"],
    high: Float[np.ndarray, " readings"],
    *,
    ring_max_range: float | None,
    note: Callable[[str], None],
) -> np.ndarray:
    """What each reading means: ``ECHO``, ``SILENT`` or ``NOT_MEASURED``.

    - +inf, and ranges of at least the maximum, mean that nothing was heard.
    - NaN, -inf, and positive ranges below the minimum measured nothing: the object is too close, or the reading is
      invalid.
    - 0, negative ranges, and the minimum itself measured nothing if the bag marks silence in one of the ways above.
      Otherwise they mean that nothing was heard.
    - Without a maximum, a range that is repeated exactly and is beyond the ring's maximum means that nothing was heard.

    Limits that are not set (0, not finite) or that contradict the echoes are no limits.

    Args:
        reported: ranges of the messages, metres.
        low: minimum ranges of the messages, metres.
        high: maximum ranges of the messages, metres.
        ring_max_range: maximum range of the ring, metres; None if it is unknown.
        note: called with one line about silent and invalid readings, about limits that are no limits, and with a
            warning about ranges that are not in metres.
    """
    positive = np.isfinite(reported) & (reported > 0)
    low, high = _limits(reported, low, high, positive, note)
    close = SETTINGS.equal * np.abs(reported)
    with np.errstate(invalid="ignore"):
        at_high = positive & (reported >= high - close)
        at_low = positive & ~at_high & (np.abs(reported - low) <= close)
        below = positive & ~at_high & ~at_low & (reported < low)
    beyond = _repeated_beyond(reported, positive & np.isinf(high), ring_max_range)
    infinite, zero = np.isposinf(reported), np.isfinite(reported) & (reported <= 0)
    kind = np.full(len(reported), ECHO)
    kind[at_high | infinite | beyond] = SILENT
    marks_silence = bool((kind == SILENT).any())
    kind[zero] = NOT_MEASURED if marks_silence else SILENT
    kind[at_low] = NOT_MEASURED if marks_silence or zero.any() else SILENT
    kind[below | np.isnan(reported) | np.isneginf(reported)] = NOT_MEASURED
    names = {
        "+inf": infinite,
        "max_range and more": at_high,
        "repeated beyond the ring's maximum range": beyond,
        "0 or negative": zero,
        "min_range": at_low,
        "less than min_range": below,
        "NaN": np.isnan(reported),
        "-inf": np.isneginf(reported),
    }
    echoes = reported[kind == ECHO]
    if len(echoes) and np.median(echoes) > SETTINGS.farthest:
        came = f"ranges of {echoes.min():.4g} to {echoes.max():.4g} m came"
        note(f"warning: {came}; the driver probably sends cm or mm, not metres; correct the driver, or scale the bag")
    for value, meaning in ((SILENT, "no echo"), (NOT_MEASURED, "not measured")):
        parts = [f"{what} ({int(rows.sum())})" for what, rows in names.items() if (rows & (kind == value)).any()]
        if parts:
            note(f"{meaning}: {', '.join(parts)}")
    return kind


def _limits(
    reported: Float[np.ndarray, " readings"],
    low: Float[np.ndarray, " readings"],
    high: Float[np.ndarray, " readings"],
    positive: Bool[np.ndarray, " readings"],
    note: Callable[[str], None],
) -> tuple[Float[np.ndarray, " readings"], Float[np.ndarray, " readings"]]:
    """Minimum and maximum ranges; 0 and infinity where they are no limits."""
    has_high = np.isfinite(high) & (high > 0) & ~(high <= low)
    if (positive & ~has_high).any():
        note(f"max_range is {_values(high[~has_high])} in {int((~has_high).sum())} messages, which is no limit")
    inside = positive & has_high & (reported < high)
    outside = positive & has_high & (reported >= high)
    if outside.any() and not inside.any() and len(np.unique(reported[outside])) > SETTINGS.different_values:
        note(f"max_range is {_values(high[outside])}, less than all ranges, so it is no limit")
        has_high &= False
    has_low = np.isfinite(low) & (low > 0) & (~has_high | (low < high))
    below = positive & has_low & (reported < low)
    if below.sum() > SETTINGS.absurd_minimum * max(int(positive.sum()), 1):
        note(f"min_range is {_values(low[below])}, more than most ranges, so it is no limit")
        has_low &= False
    return np.where(has_low, low, 0.0), np.where(has_high, high, np.inf)


def _repeated_beyond(
    reported: Float[np.ndarray, " readings"], candidates: Bool[np.ndarray, " readings"], ring_max_range: float | None
) -> Bool[np.ndarray, " readings"]:
    """Ranges beyond the ring's maximum that are repeated exactly."""
    far = candidates & (reported > (np.inf if ring_max_range is None else ring_max_range))
    value, inverse, count = np.unique(reported, return_inverse=True, return_counts=True)
    return far & (count[inverse] >= SETTINGS.repetitions) if len(value) else far


def _values(limit: np.ndarray) -> str:
    """The different values of a limit."""
    different = np.unique(limit)
    listed = ", ".join(f"{value:.4g}" for value in different[:3])
    return listed + (" ..." if len(different) > 3 else "")
