"""Comparison of what explains the echoes of each sensor, by walls that the poses of the log gather."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxsonar.diagnostics.echo_residuals import predict_and_match
from jaxsonar.diagnostics.range_offsets import estimate_offsets, stretches_of_scans
from jaxsonar.diagnostics.reference_scene import ReferenceScene
from jaxsonar.diagnostics.sensor_alternatives import SensorAlternative, sensor_alternatives, suspects
from jaxsonar.diagnostics.settings import SETTINGS
from jaxsonar.scans.readings import without_readings
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


class Comparison(NamedTuple):
    """What explains the echoes of the sensors of a ring."""

    alternatives: tuple[SensorAlternative | None, ...]
    """What explains the echoes of each sensor better than a sound sensor; None where nothing does. Empty if the walls
    explain too little to judge any sensor."""
    offset: dict[int, tuple[float, float]]
    """Range offset and its standard error, metres, of sensors that do not fit, by the walls of the others."""


def compare_sensors(
    ring: Ring, log: Log, walls_without: Callable[[Int[np.ndarray, " _"]], ReferenceScene], known: Int[np.ndarray, " _"]
) -> Comparison:
    """Compare explanations of the direct echoes of each sensor.

    The echoes of a faulty sensor may have spoiled the walls. Therefore a sensor that does not fit is judged by walls
    without its echoes, too, and a fault must show with both.

    Args:
        ring: the sensors.
        log: scans with poses, with sensors numbered as in the ring.
        walls_without: gives the reflectors of these scans without the echoes of some sensors.
        known: sensors whose fault is known.
    """
    half_width = np.asarray(ring.beam) / 2
    table, stretch = predict_and_match(ring, walls_without(known), log), stretches_of_scans(log)
    estimate = estimate_offsets(table, ring.count, SETTINGS.reference.min_sigma, stretch)
    noise = estimate.sigma if np.isfinite(estimate.sigma) else SETTINGS.detection.default_sigma
    alternatives, offset = sensor_alternatives(table, half_width, noise, ring.max_range), {}
    for k in set(suspects(table, half_width, noise)) - set(known.tolist()):
        table = predict_and_match(ring, walls_without(np.append(known, k)), log)
        again = sensor_alternatives(table, half_width, noise, ring.max_range)
        by_others = estimate_offsets(table, ring.count, noise, stretch)
        if np.isfinite(by_others.offset[k]):
            offset[k] = float(by_others.offset[k]), float(by_others.error[k])
        # A wall that only this sensor hears is missing now.
        given, new = alternatives[k], again[k] if again else None
        alternatives[k] = new if given is not None and new is not None and given.cause == new.cause else None
    return Comparison(tuple(alternatives), offset)


def without_sensors(log: Log, sensors: Int[np.ndarray, " sensors"]) -> Log:
    """The log without all readings of these sensors."""
    return without_readings(log, np.isin(log.tx, sensors) | np.isin(log.rx, sensors))
