"""Ranges that a sensor, or the whole driver, reports again and again."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.diagnostics.findings import Finding
from jaxsonar.diagnostics.settings import SETTINGS
from jaxsonar.geometry.se2 import transform_points, wrap_angle
from jaxsonar.plausibility.constant_ranges import range_resolution
from jaxsonar.scans.readings import is_repeated
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.sliding_windows import has_moved
from jaxsonar.sensors.ring import Ring


class RepeatedRanges(NamedTuple):
    """Repeated direct ranges of each sensor while the robot moved: a robot at rest reads the same again and again.

    If the ranges are coarse, only motions count that change the range of every wall in the cone. All scans count if the
    log has no poses.
    """

    repeats: Float[np.ndarray, " sensors"]
    """Fraction of first direct echoes with exactly the range of the previous scan; NaN without such pairs."""
    pairs: Int[np.ndarray, " sensors"]
    """Number of pairs of consecutive scans that were compared."""
    constant: Float[np.ndarray, "sensors 2"]
    """Most frequent range, metres, and the fraction of the direct echoes with that range; NaN for fewer echoes than a
    fraction needs (``FindingSettings.min_samples``)."""

    @classmethod
    def of(cls, ring: Ring, log: Log) -> "RepeatedRanges":
        """Count the repeated ranges of a log. Readings that are marked as old (``Log.age``) do not count again."""
        sensors = ring.count
        if np.isfinite(log.pose).all(axis=1).any():
            moved = has_moved(log.pose) | ~np.isfinite(log.pose).all(axis=1)
        else:
            moved = np.ones(len(log), bool)
        own = np.flatnonzero((log.tx == log.rx) & np.isfinite(log.range) & ~is_repeated(log))
        first = np.full((len(log), sensors), np.inf)
        np.minimum.at(first, (log.echo_scan[own], log.tx[own]), log.range[own])
        both = np.isfinite(first[1:]) & np.isfinite(first[:-1]) & moved[1:, None]
        resolution = range_resolution(log.range)
        if resolution >= SETTINGS.findings.fine_resolution:
            both &= ~(_least_change(ring, log.pose) <= resolution)  # without poses it is NaN
        pairs = both.sum(axis=0)
        same = (both & (first[1:] == first[:-1])).sum(axis=0)
        constant = np.full((sensors, 2), np.nan)
        own = own[moved[log.echo_scan[own]]]
        for k in range(sensors):
            values, times = np.unique(log.range[own[log.tx[own] == k]], return_counts=True)
            if times.sum() >= SETTINGS.findings.min_samples:
                constant[k] = values[times.argmax()], times.max() / times.sum()
        return cls(np.where(pairs > 0, same / np.maximum(pairs, 1), np.nan), pairs, constant)


def _least_change(ring: Ring, pose: Float[np.ndarray, "scans 3"]) -> Float[np.ndarray, "steps sensors"]:
    """Least change of the direct range of a wall in any direction of the cone, between consecutive scans, metres.

    The range changes by the motion of the sensor along the normal of the wall.
    """
    position = transform_points(pose[:, None], np.asarray(ring.position))
    motion = np.diff(position, axis=0)
    heading = pose[1:, None, 2] + np.asarray(ring.heading)
    aside = wrap_angle(np.arctan2(motion[..., 1], motion[..., 0]) - heading)
    half = np.asarray(ring.beam) / 2
    # The angle between the motion and the nearest direction of the cone to a right angle with it.
    off = np.maximum(np.abs(np.abs(aside) - np.pi / 2) - half, 0)
    return np.hypot(motion[..., 0], motion[..., 1]) * np.sin(off)


@dataclass(frozen=True)
class RepeatedScanSettings:
    """When repeated scans are reported. Chosen by hand."""

    motion: float = 0.02
    """Motion between two scans from which on they are compared, metres; a turn of 1 rad counts like 1 m."""
    least_readings: int = 3
    """Readings of a scan that is compared."""
    least_scans: int = 20
    """Repeated scans from which on it is reported, ..."""
    share: float = 0.2
    """... and their share of the compared ones."""
    most_pairs: int = 2000
    """Pairs of scans that are compared; more of them are thinned out evenly."""
    equal: float = 0.1
    """Largest share of equal ranges between the other scans: more of them come from coarse or resting readings."""


_WHOLE = RepeatedScanSettings()


def repeated_scans(log: Log) -> Finding | None:
    """The finding about scans that repeat all ranges of the one before although the robot moved; None if there is none.

    Independent echoes of a moving robot agree in a few ranges at most. Scans that agree in all of them, while the
    others agree in hardly any, were read once and reported several times. A log that marks old readings by their age is
    not judged.
    """
    if is_repeated(log).any():
        return None
    motion = np.hypot(*np.diff(log.pose[:, :2], axis=0).T) + np.abs(wrap_angle(np.diff(log.pose[:, 2])))
    count = np.diff(log.start)
    pair = np.flatnonzero((motion > _WHOLE.motion) & (count[1:] >= _WHOLE.least_readings))
    pair = pair[:: len(pair) // _WHOLE.most_pairs + 1]
    agreed = np.zeros((len(pair), 2))
    for k, scan in enumerate(pair.tolist()):
        before, after = (slice(log.start[row], log.start[row + 1]) for row in (scan, scan + 1))
        same = np.isin(log.range[after], log.range[before]) | ~np.isfinite(log.range[after])
        agreed[k] = same.mean(), count[scan] == count[scan + 1]
    whole = (agreed[:, 0] == 1) & (agreed[:, 1] == 1)
    if not whole.sum() >= max(_WHOLE.least_scans, _WHOLE.share * len(pair)):
        return None
    if whole.all() or agreed[~whole, 0].mean() > _WHOLE.equal:
        return None
    return Finding(
        "held readings",
        (),
        f"all sensors repeat their readings: {whole.sum()} of {len(pair)} scans of the moving robot are copies of the "
        "scan before",
        0.99,
        f"of the ranges of the other scans, {agreed[~whole, 0].mean():.0%} equal those of the scan before",
        "let the driver report each reading once, with the time at which it was measured",
    )
