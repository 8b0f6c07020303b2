"""Mean, median and root mean square over the known values of several runs; NaN counts as unknown."""

from collections.abc import Sequence

import numpy as np


def _known(values: Sequence[float] | np.ndarray) -> np.ndarray:
    array = np.asarray(values, dtype=float)
    return array[np.isfinite(array)]


def rms(values: Sequence[float] | np.ndarray) -> float:
    """Root mean square; NaN without known values."""
    known = _known(values)
    return float(np.sqrt(np.mean(np.square(known)))) if len(known) else np.nan


def mean(values: Sequence[float] | np.ndarray) -> float:
    """Mean; NaN without known values."""
    known = _known(values)
    return float(np.mean(known)) if len(known) else np.nan


def median(values: Sequence[float] | np.ndarray) -> float:
    """Median; NaN without known values."""
    known = _known(values)
    return float(np.median(known)) if len(known) else np.nan
