"""Ranges that a sensor reports again and again: fractions of repeated and of identical ranges."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.diagnostics.settings import SETTINGS
from jaxsonar.scans.readings import is_repeated
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.sliding_windows import has_moved


class RepeatedRanges(NamedTuple):
    """Repeated direct ranges of each sensor while the robot moved: a robot at rest reads the same again and again.

    All scans count if the log has no poses.
    """

    repeats: Float[np.ndarray, " sensors"]
    """Fraction of first direct echoes with exactly the range of the previous scan; NaN without such pairs."""
    pairs: Int[np.ndarray, " sensors"]
    """Number of pairs of consecutive scans that were compared."""
    constant: Float[np.ndarray, "sensors 2"]
    """Most frequent range, metres, and the fraction of the direct echoes with that range; NaN for fewer echoes than a
    fraction needs (``FindingSettings.min_samples``)."""

    @classmethod
    def of(cls, log: Log, sensors: int) -> "RepeatedRanges":
        """Count the repeated ranges of a log. Readings that are marked as old (``Log.age``) do not count again."""
        if np.isfinite(log.pose).all(axis=1).any():
            moved = has_moved(log.pose) | ~np.isfinite(log.pose).all(axis=1)
        else:
            moved = np.ones(len(log), bool)
        own = np.flatnonzero((log.tx == log.rx) & np.isfinite(log.range) & ~is_repeated(log))
        first = np.full((len(log), sensors), np.inf)
        np.minimum.at(first, (log.echo_scan[own], log.tx[own]), log.range[own])
        both = np.isfinite(first[1:]) & np.isfinite(first[:-1]) & moved[1:, None]
        pairs = both.sum(axis=0)
        same = (both & (first[1:] == first[:-1])).sum(axis=0)
        constant = np.full((sensors, 2), np.nan)
        own = own[moved[log.echo_scan[own]]]
        for k in range(sensors):
            values, times = np.unique(log.range[own[log.tx[own] == k]], return_counts=True)
            if times.sum() >= SETTINGS.findings.min_samples:
                constant[k] = values[times.argmax()], times.max() / times.sum()
        return cls(np.where(pairs > 0, same / np.maximum(pairs, 1), np.nan), pairs, constant)
