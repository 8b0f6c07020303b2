"""Noise of the ranges from consecutive readings of a path, without walls, poses, or a ring."""

from dataclasses import dataclass

import numpy as np

from jaxsonar.geometry.robust_statistics import robust_deviation
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.scans.measured_paths import path_rows
from jaxsonar.scans.readings import is_repeated
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class RangeNoiseSettings:
    """Constants of the estimate. Chosen by hand."""

    largest_change: float = 0.2
    """Consecutive readings that differ by more are echoes of different reflectors, metres."""
    largest_turn: float = float(np.radians(1.0))
    """Scans between which the robot turns more are left out, radians: ranges then change at changing rates."""
    max_scans: int = 5000
    """Scans that are looked at, from the first one on."""
    min_noise: float = 1e-5
    """Less is no measurement, metres: most readings are equal because their resolution is coarse."""
    min_samples: int = 50
    """Triples of readings that an estimate needs."""


SETTINGS = RangeNoiseSettings()


def range_noise(ring: Ring, log: Log) -> float:
    """Standard deviation of the ranges, metres, from the second differences of the nearest echo of each path.

    A robot that drives straight changes each range at a constant rate, so that the second difference of three
    consecutive readings is noise, with six times its variance. NaN if there are too few such readings, or if their
    resolution is too coarse.

    Args:
        ring: the sensors.
        log: the scans.
    """
    log = log[: SETTINGS.max_scans]
    nearest = np.full((len(log), len(ring.paths)), np.inf)
    path = path_rows(ring, log.tx, log.rx)
    row = np.flatnonzero((path >= 0) & np.isfinite(log.range) & ~is_repeated(log))
    np.minimum.at(nearest, (log.echo_scan[row], path[row]), log.range[row])
    nearest[np.isinf(nearest)] = np.nan
    step = np.diff(nearest, axis=0)
    step[~(np.abs(step) < SETTINGS.largest_change)] = np.nan
    step[np.abs(wrap_angle(np.diff(log.pose[:, 2]))) > SETTINGS.largest_turn] = np.nan
    second = np.diff(step, axis=0)
    second = second[np.isfinite(second)]
    if len(second) < SETTINGS.min_samples:
        return float("nan")
    noise = robust_deviation(second, center=0.0) / np.sqrt(6)
    return noise if noise > SETTINGS.min_noise else float("nan")
