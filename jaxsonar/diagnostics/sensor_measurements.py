"""What the walls around the robot tell about every sensor: offsets, detection rates, cones, and unexplained echoes."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.diagnostics.beam_width import EachCone, count_by_angle, fit_cone, fit_each_cone
from jaxsonar.diagnostics.echo_residuals import ResidualTable, explained_fraction, predict_and_match
from jaxsonar.diagnostics.range_offsets import OffsetEstimate, estimate_offsets, stretches_of_scans
from jaxsonar.diagnostics.reference_scene import ReferenceScene
from jaxsonar.diagnostics.settings import SETTINGS
from jaxsonar.geometry.robust_statistics import robust_deviation
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


class SensorMeasurements(NamedTuple):
    """Measurements of the sensors at each position of a ring."""

    offsets: OffsetEstimate
    """Range offsets, and the noise of the ranges."""
    expected: Int[np.ndarray, "sensors 3"]
    """Expected echoes of walls well inside the cones: direct, cross as transmitter, cross as receiver."""
    heard: Int[np.ndarray, "sensors 3"]
    """Number of them that were detected."""
    without_worst: Int[np.ndarray, "sensors 2"]
    """Expected and detected direct echoes without the wall of which the sensor missed the most echoes: a wall that is
    hidden, or ends earlier, must not look like a weak sensor."""
    asked: Int[np.ndarray, " bins"]
    """Expected direct echoes by off-axis angle."""
    answered: Int[np.ndarray, " bins"]
    """Number of them that were detected."""
    beam: Float[np.ndarray, " 2"]
    """Full width of the cones and its standard deviation, radians."""
    curve: Float[np.ndarray, " 4"]
    """``Health.curve``."""
    cones: EachCone
    """The cone of each sensor."""
    quantiles: Float[np.ndarray, "sensors 5"]
    """5, 25, 50, 75 and 95 % quantiles of the residuals of direct echoes, metres."""
    spread: Float[np.ndarray, "sensors 2"]
    """Scatter of the residuals of its direct echoes, and of all its echoes, metres."""
    explained: Float[np.ndarray, " sensors"]
    """Fraction of its echoes that reflectors explain."""


def measure_sensors(ring: Ring, log: Log, scene: ReferenceScene, sigma: float | None) -> SensorMeasurements:
    """Compare the echoes of a log with the reflectors around the robot.

    Args:
        ring: the sensors.
        log: the scans, with sensors numbered as in the ring.
        scene: the reflectors of these scans.
        sigma: standard deviation of the ranges, metres; None estimates it.
    """
    table = predict_and_match(ring, scene, log)
    # Estimate range offsets and the noise of the ranges.
    min_noise = sigma or scene.noise(default=SETTINGS.reference.min_sigma)
    offsets = estimate_offsets(table, ring.count, min_noise, stretches_of_scans(log) if scene.by_poses else None)
    noise = offsets.sigma if np.isfinite(offsets.sigma) else SETTINGS.detection.default_sigma
    # Count which expected echoes were detected.
    usable, detected = _detections(table, np.nan_to_num(offsets.offset), noise)
    expected, heard, without_worst = _count_well_inside(table, usable, detected, ring.count)
    # Measure the cones.
    beam = np.asarray(ring.beam)
    expected_by_angle, detected_by_angle = count_by_angle(table, usable, detected, beam)
    asked, answered = expected_by_angle.sum(axis=0), detected_by_angle.sum(axis=0)
    curve, half_width_error = fit_cone(asked, answered)
    if 2 * curve[0] > SETTINGS.findings.most_beam * beam.mean():  # no cones, but wrong walls
        curve, half_width_error = np.full(4, np.nan), float("nan")
    cones = fit_each_cone(expected_by_angle, detected_by_angle, curve)
    scale = beam[:, None] / beam.mean()  # angles were counted on the scale of the mean cone
    # Summarize residuals and explained echoes.
    gate = SETTINGS.detection.explained_gate * noise + SETTINGS.detection.explained_margin
    return SensorMeasurements(
        offsets,
        expected,
        heard,
        without_worst,
        asked,
        answered,
        2 * np.array([curve[0], half_width_error]),
        curve,
        EachCone(cones.half_width * scale, cones.direction * scale, cones.nats),
        *_residual_statistics(table, offsets, ring.count),
        explained_fraction(table, gate, ring.count),
    )


def faced_walls(ring: Ring, log: Log, scene: ReferenceScene) -> Int[np.ndarray, " sensors"]:
    """Expected direct echoes of walls well inside the cone of each sensor, whether or not the log measured it.

    Args:
        ring: the sensors.
        log: the scans, with sensors numbered as in the ring.
        scene: the reflectors of these scans.
    """
    direct = np.repeat(np.arange(ring.count)[:, None], 2, axis=1)
    table = predict_and_match(ring, scene, replace(log, asked=np.concatenate([log.asked, direct])))
    usable, detected = _detections(table, np.zeros(ring.count), SETTINGS.detection.default_sigma)
    return _count_well_inside(table, usable, detected, ring.count)[0][:, 0]


def _detections(
    table: ResidualTable, offset: Float[np.ndarray, " sensors"], noise: float
) -> tuple[Bool[np.ndarray, " rows"], Bool[np.ndarray, " rows"]]:
    """Which rows are fair tests of detection, and which of all rows were detected.

    A test is fair if other echoes support the wall, nothing obstructs it, and no echo just in front of the expected one
    blanks it.
    """
    settings = SETTINGS.detection
    residual = table.residual - (offset[table.tx] + offset[table.rx]) / 2
    gate = settings.gate * noise + settings.gate_margin
    blanked = (residual > -settings.blanking) & (residual < -gate)
    usable = table.unobstructed & (table.independent_echoes >= settings.min_independent_echoes) & ~blanked
    return usable, np.abs(residual) < gate


def _count_well_inside(
    table: ResidualTable, usable: Bool[np.ndarray, " rows"], detected: Bool[np.ndarray, " rows"], sensors: int
) -> tuple[Int[np.ndarray, "sensors 3"], Int[np.ndarray, "sensors 3"], Int[np.ndarray, "sensors 2"]]:
    """Counts of walls well inside the cones: ``SensorMeasurements.expected``, ``heard``, ``without_worst``."""
    inside = usable & (table.visibility > SETTINGS.detection.min_visibility)
    inside &= (table.beyond_end <= SETTINGS.detection.max_beyond_end) & table.is_between
    direct = table.tx == table.rx
    columns = ((table.tx, inside & direct), (table.tx, inside & ~direct), (table.rx, inside & ~direct))
    expected = [np.bincount(sensor[rows], minlength=sensors) for sensor, rows in columns]
    detected_count = [np.bincount(sensor[rows & detected], minlength=sensors) for sensor, rows in columns]
    # Direct echoes by sensor and wall.
    row = np.flatnonzero(inside & direct)
    _, wall = np.unique(table.wall[row], return_inverse=True)
    key = table.tx[row] * (int(wall.max(initial=0)) + 1) + wall
    each, of = np.unique(key, return_inverse=True)
    number, found = np.bincount(of, minlength=len(each)), np.bincount(of[detected[row]], minlength=len(each))
    sensor = each // (int(wall.max(initial=0)) + 1)
    without_worst = np.stack([expected[0], detected_count[0]], axis=-1)
    order = np.lexsort((found - number, sensor))
    judged, first = np.unique(sensor[order], return_index=True)
    without_worst[judged] -= np.stack([number, found], axis=-1)[order[first]]
    return np.stack(expected, axis=-1), np.stack(detected_count, axis=-1), without_worst


def _residual_statistics(
    table: ResidualTable, offsets: OffsetEstimate, sensors: int
) -> tuple[Float[np.ndarray, "sensors 5"], Float[np.ndarray, "sensors 2"]]:
    """Quantiles (5, 25, 50, 75, 95 %) of each sensor's direct residuals, and the scatter of its direct and all ones."""
    tx, rx, residual = table.tx[offsets.row], table.rx[offsets.row], offsets.residual
    offset = np.nan_to_num(offsets.offset)
    least = SETTINGS.detection.min_residuals
    direct = [residual[(tx == k) & (rx == k)] + offset[k] for k in range(sensors)]
    both = [residual[(tx == k) | (rx == k)] for k in range(sensors)]
    quantiles = [np.percentile(x, (5, 25, 50, 75, 95)) if len(x) >= least else np.full(5, np.nan) for x in direct]
    spread = [[_deviation_of_many(x), _deviation_of_many(y)] for x, y in zip(direct, both, strict=True)]
    return np.array(quantiles), np.array(spread)


def _deviation_of_many(values: Float[np.ndarray, " echoes"]) -> float:
    """Robust standard deviation; NaN for fewer than five values."""
    if len(values) < SETTINGS.detection.min_residuals:
        return float("nan")
    return robust_deviation(values)
