"""The health check of a ring: which sensors are dead, exchanged, off or stuck, and how wide the cones are."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.detection.settings import check_sigma
from jaxsonar.diagnostics.beam_width import count_by_angle, fit_cone, fit_each_cone
from jaxsonar.diagnostics.echo_residuals import ResidualTable, explained_fraction, predict_and_match
from jaxsonar.diagnostics.findings import Finding
from jaxsonar.diagnostics.health_report import Health as Health
from jaxsonar.diagnostics.measured_sensors import MeasuredSensors
from jaxsonar.diagnostics.range_offsets import OffsetEstimate, estimate_offsets
from jaxsonar.diagnostics.reference_scene import (
    ReferenceScene,
    evenly_spaced,
    renumber,
    scene_from_map,
    scene_from_scans,
    select_scans,
)
from jaxsonar.diagnostics.repeated_ranges import RepeatedRanges
from jaxsonar.diagnostics.sensor_findings import describe_findings
from jaxsonar.diagnostics.settings import SETTINGS
from jaxsonar.diagnostics.swapped_sensors import find_exchanged_sensors
from jaxsonar.hardware.errors import SonarError
from jaxsonar.plausibility.held_readings import find_held_readings, with_ages
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.no_echo_values import find_no_echo_values, without_no_echo_values
from jaxsonar.scans.readings import is_repeated
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.single_firings import group_firings
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_parameters import check_speed_of_sound


def check(
    ring: Ring,
    log: Log,
    *,
    sigma: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    on_left_out: Callable[[int], None] | None = None,
) -> Health:
    """Check the health of a ring.

    Args:
        ring: the ring as it should be.
        log: scans. Poses are used only if single scans show too few walls.
        sigma: standard deviation of the ranges, metres; None estimates it.
        progress: called with (scans done, scans) from time to time.
        on_left_out: called once with the number of echoes of pairs (tx, rx) that this ring does not listen to.

    Raises:
        SonarError: a log without scans, a sensor number that the ring does not have, an impossible speed of sound, or a
            sigma out of range.
    """
    check_sigma(sigma)
    check_speed_of_sound(ring)
    if not len(log):
        raise SonarError("check: the log holds no scan; allowed are one or more")
    # Prepare the log: no marks for no echo, ages of held readings, firings grouped into scans.
    log, faults = _prepared(ring, log)
    _, left_out = FlatEchoes.from_log(ring, log)
    if left_out and on_left_out is not None:
        on_left_out(left_out)
    # Find reference walls, from each scan alone or from a map.
    part, scene, source, empty = _reference_walls(ring, log, sigma, progress)
    # Match the predicted echoes with the reported ones; again, if sensors are exchanged.
    table = as_numbered = predict_and_match(ring, scene, part)
    in_place = np.arange(ring.count)
    place = find_exchanged_sensors(ring, part, scene, sigma=sigma) if source else in_place
    if (place != in_place).any():
        renumbered = renumber(part, place)
        scene = scene if scene.from_map else scene_from_scans(ring, renumbered, sigma, progress)
        table = predict_and_match(ring, scene, renumbered)
    # Estimate range offsets and the noise of the ranges.
    min_noise = sigma or scene.noise(default=SETTINGS.reference.min_sigma)
    offsets = estimate_offsets(table, ring.count, min_noise)
    noise = offsets.sigma if np.isfinite(offsets.sigma) else SETTINGS.detection.default_sigma
    # Count which expected echoes were detected.
    usable, detected = _detections(table, np.nan_to_num(offsets.offset), noise)
    expected_count, detected_count = _count_well_inside(table, usable, detected, ring.count)
    # Measure the cones.
    beam = np.asarray(ring.beam)
    expected_by_angle, detected_by_angle = count_by_angle(table, usable, detected, beam)
    expected_in_all, detected_in_all = expected_by_angle.sum(axis=0), detected_by_angle.sum(axis=0)
    curve, half_width_error = fit_cone(expected_in_all, detected_in_all)
    half_width, direction = fit_each_cone(expected_by_angle, detected_by_angle, curve)
    scale = beam[:, None] / np.mean(ring.beam)  # angles were counted on the scale of the mean cone
    # Summarize residuals, explained echoes and repeated ranges.
    quantiles, spread = _residual_statistics(table, offsets, ring.count)
    gate = SETTINGS.detection.explained_gate * noise + SETTINGS.detection.explained_margin
    explained = explained_fraction(as_numbered, gate, ring.count), explained_fraction(table, gate, ring.count)[place]
    repeated, measured = RepeatedRanges.of(log, ring.count), MeasuredSensors.of(ring, log)
    heard = np.isfinite(log.range) & ~is_repeated(log)
    direct, cross = heard & (log.tx == log.rx), heard & (log.tx != log.rx)
    # Report by the sensor numbers of the log.
    health = Health(
        ring=ring,
        scans=len(log),
        used=len(part),
        walls=int(scene.is_wall.sum()) if source else 0,
        source=source,
        empty=empty,
        left_out=left_out,
        sigma=offsets.sigma if source else float("nan"),
        direct=np.bincount(log.tx[direct], minlength=ring.count),
        cross=np.bincount(np.append(log.tx[cross], log.rx[cross]), minlength=ring.count),
        expected=expected_count[place],
        heard=detected_count[place],
        place=place,
        fits=np.stack(explained, axis=-1),
        offset=offsets.offset[place],
        offset_error=offsets.error[place],
        median=quantiles[place, 2],
        quartiles=quantiles[place][:, [0, 1, 3, 4]],
        spread=spread[place],
        repeats=repeated.repeats,
        constant=repeated.constant,
        beam=2 * np.array([curve[0], half_width_error]),
        curve=curve,
        asked=expected_in_all,
        answered=detected_in_all,
        beam_each=2 * half_width[place] * scale[place],
        centre=direction[place] * scale[place],
        remarks=("",) * ring.count,
        findings=(),
        unmeasured=measured.unmeasured,
    )
    remarks, findings = describe_findings(health, measured, repeated.pairs, sigma, faults)
    return replace(health, remarks=remarks, findings=findings)


def _prepared(ring: Ring, log: Log) -> tuple[Log, list[Finding]]:
    """The log as the check needs it, and what had to be changed: faults of the driver."""
    faults = []
    if values := find_no_echo_values(log):
        listed = ", ".join(map(str, values))
        faults.append(
            Finding(
                "no-echo value",
                (),
                f"most sensors read {listed}, wherever the robot is: a mark for no echo, which counts as silence",
                0.99,
                "most sensors share the value, and it does not change while the robot moves",
                "let the driver report nothing instead",
            )
        )
        log = without_no_echo_values(log, values)
    log = group_firings(log)
    if held := find_held_readings(ring, log):
        faults.append(
            Finding(
                "held readings",
                (),
                held.describe(),
                0.99,
                "no wall or point in the detection cone can keep its range during these motions",
                "let the driver report nothing instead of the last range",
            )
        )
    return with_ages(log, held), faults


def _reference_walls(
    ring: Ring, log: Log, sigma: float | None, progress: Callable[[int, int], None] | None
) -> tuple[Log, ReferenceScene, str, str]:
    """The scans to analyse, their reference scene, its source, and the reason if there are no walls."""
    settings = SETTINGS.reference
    part = select_scans(log, evenly_spaced(len(log), settings.max_scans))
    scene = scene_from_scans(ring, part, sigma, progress)
    if scene.is_wall.sum() >= max(settings.min_walls, len(part) // 10):
        return part, scene, "scans", ""
    if not (np.asarray(ring.corrected(part.range, part.tx, part.rx)) < ring.max_range).any():
        if not log.echo_count:
            return part, scene, "", "no echo in any scan"
        reach = f"none of the {log.echo_count} echoes is within the maximum range, {ring.max_range:g} m"
        return part, scene, "", f"{reach}: are ranges half path lengths in metres?"
    if np.isfinite(part.pose).all(axis=1).sum() < 2:
        return part, scene, "", "single scans show too few walls, and the log has no poses to gather them by"
    scene = scene_from_map(ring, log)
    if scene.is_wall.any():
        return log, scene, "map", ""
    return log, scene, "", "neither single scans nor windows of the trajectory show walls"


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
) -> tuple[Int[np.ndarray, "sensors 3"], Int[np.ndarray, "sensors 3"]]:
    """Expected and detected echoes of walls well inside the cones: direct, cross as transmitter, cross as receiver."""
    inside = usable & (table.visibility > SETTINGS.detection.min_visibility)
    inside &= table.beyond_end <= SETTINGS.detection.max_beyond_end
    direct = table.tx == table.rx
    columns = ((table.tx, inside & direct), (table.tx, inside & ~direct), (table.rx, inside & ~direct))
    expected = [np.bincount(sensor[rows], minlength=sensors) for sensor, rows in columns]
    detected_count = [np.bincount(sensor[rows & detected], minlength=sensors) for sensor, rows in columns]
    return np.stack(expected, axis=-1), np.stack(detected_count, axis=-1)


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
    spread = [[_scaled_mad(x), _scaled_mad(y)] for x, y in zip(direct, both, strict=True)]
    return np.array(quantiles), np.array(spread)


def _scaled_mad(values: Float[np.ndarray, " echoes"]) -> float:
    """1.4826 x median absolute deviation; NaN for fewer than five values."""
    if len(values) < SETTINGS.detection.min_residuals:
        return float("nan")
    return float(1.4826 * np.median(np.abs(values - np.median(values))))
