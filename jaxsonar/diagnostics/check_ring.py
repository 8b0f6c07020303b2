"""The health of a ring, told from a log: which sensors are dead, swapped, off or stuck, and how wide the cones are.

Every scan is explained for itself; poses are not needed. Each sensor is then asked what it reports of walls that other
echoes tell of. Rings too sparse for walls in one scan are compared with a map instead, if the log has poses.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.detection.settings import check_sigma
from jaxsonar.diagnostics.beam_width import cones, each_cone, fitted_cone
from jaxsonar.diagnostics.echo_residuals import Look, explained_share, looked
from jaxsonar.diagnostics.findings import findings_of
from jaxsonar.diagnostics.health_report import Health as Health
from jaxsonar.diagnostics.range_offsets import offsets_of
from jaxsonar.diagnostics.reference_scene import Scene, evenly, scene_of_map, scene_of_scans, thinned
from jaxsonar.diagnostics.swapped_sensors import exchanged
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_parameters import check_speed_of_sound

MOST_SCANS = 1000
"""Of longer logs so many scans are explained, evenly spread over it."""
OTHERS = 3
"""Echoes that must be left of a wall without those that are judged."""
_BLANKED = 0.06  # m behind an echo in which another one may go unnoticed


def check(
    ring: Ring,
    log: Log,
    *,
    sigma: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    on_left_out: Callable[[int], None] | None = None,
) -> Health:
    """The health of a ring, from what it heard.

    Args:
        ring: the sensors as they should be.
        log: scans; poses are used only where single scans carry no walls.
        sigma: standard deviation of the ranges, metres; estimated if left out.
        progress: called with (scans done, scans) now and then.
        on_left_out: told once how many echoes are of pairs (tx, rx) that this ring does not listen to.

    Raises:
        SonarError: a log without scans, a sensor number that the ring does not have, a speed of sound that no air has,
            or a sigma out of range.
    """
    check_sigma(sigma)
    check_speed_of_sound(ring)
    if not len(log):
        raise SonarError("check: the log holds no scan; allowed are one or more")
    _, left_out = FlatEchoes.from_log(ring, log)
    if left_out and on_left_out is not None:
        on_left_out(left_out)
    # Walls around the robot, from each scan alone or from a map.
    part, scene, source, empty = _walls(ring, log, sigma, progress)
    # What each sensor should have heard of them; again, if sensors turn out to be exchanged.
    look = before = looked(ring, scene, part)
    place = exchanged(ring, part, scene, sigma=sigma) if source else np.arange(ring.count)
    if (place != np.arange(ring.count)).any():
        renamed = replace(part, tx=place[part.tx], rx=place[part.rx])
        scene = scene if scene.fixed else scene_of_scans(ring, renamed, sigma, progress)
        look = looked(ring, scene, renamed)
    # What each sensor reports too much, on the scale of the noise.
    known = scene.sigma[scene.solid.any(axis=1)]
    floor = sigma or (float(np.median(known)) if np.isfinite(known).any() else 1e-4)
    offsets = offsets_of(look, ring.count, floor)
    noise = offsets.sigma if np.isfinite(offsets.sigma) else 0.005
    # Heard or not, at walls that other echoes tell of.
    correction = np.nan_to_num(offsets.offset)
    residual = look.residual - (correction[look.tx] + correction[look.rx]) / 2
    gate = 4 * noise + 0.003
    usable = look.open & (look.others >= OTHERS) & ~((residual > -_BLANKED) & (residual < -gate))
    heard = np.abs(residual) < gate
    expected, told = _sightings(look, usable, heard, ring.count)
    # Cones.
    asked, answered = cones(look, usable, heard, np.asarray(ring.beam))
    curve, error = fitted_cone(asked.sum(axis=0), answered.sum(axis=0))
    each, centre = each_cone(asked, answered, curve)
    stretch = np.asarray(ring.beam)[:, None] / np.mean(ring.beam)
    # Residuals a sensor.
    tx, rx, left = look.tx[offsets.row], look.rx[offsets.row], offsets.residual
    own = [left[(tx == k) & (rx == k)] + correction[k] for k in range(ring.count)]
    any_ = [left[(tx == k) | (rx == k)] for k in range(ring.count)]
    points = np.array([np.percentile(x, (5, 25, 50, 75, 95)) if len(x) >= 5 else np.full(5, np.nan) for x in own])
    spread = np.array([[_deviation(x), _deviation(y)] for x, y in zip(own, any_, strict=True)])
    # Echoes explained, as numbered and as they seem to be.
    gate = 3 * noise + 0.002
    fits = [explained_share(before, gate, ring.count), explained_share(look, gate, ring.count)[place]]
    repeats, pairs = _repeats(log, ring.count)
    cross = log.tx != log.rx
    health = Health(
        ring=ring,
        scans=len(log),
        used=len(part),
        walls=int(scene.solid.sum()) if source else 0,
        source=source,
        empty=empty,
        left_out=left_out,
        sigma=offsets.sigma if source else float("nan"),
        direct=np.bincount(log.tx[~cross], minlength=ring.count),
        cross=np.bincount(np.append(log.tx[cross], log.rx[cross]), minlength=ring.count),
        expected=expected[place],
        heard=told[place],
        place=place,
        fits=np.stack(fits, axis=-1),
        offset=offsets.offset[place],
        offset_error=offsets.error[place],
        median=points[place, 2],
        quartiles=points[place][:, [0, 1, 3, 4]],
        spread=spread[place],
        repeats=repeats,
        constant=_most_frequent(log, ring.count),
        beam=2 * np.array([curve[0], error]),
        curve=curve,
        asked=asked.sum(axis=0),
        answered=answered.sum(axis=0),
        beam_each=2 * each[place] * stretch[place],
        centre=centre[place] * stretch[place],
        remarks=("",) * ring.count,
        findings=(),
    )
    remarks, findings = findings_of(health, pairs, sigma)
    return replace(health, remarks=remarks, findings=findings)


def _walls(
    ring: Ring, log: Log, sigma: float | None, progress: Callable[[int, int], None] | None
) -> tuple[Log, Scene, str, str]:
    """The scans that are compared with walls, their scene, where it comes from, and why there is none if so."""
    part = thinned(log, evenly(len(log), MOST_SCANS))
    scene = scene_of_scans(ring, part, sigma, progress)
    if scene.solid.sum() >= max(5, len(part) // 10):
        return part, scene, "scans", ""
    if not (np.asarray(ring.corrected(part.range, part.tx, part.rx)) < ring.max_range).any():
        if not len(log.range):
            return part, scene, "", "no scan heard anything"
        reach = f"none of the {len(log.range)} echoes is within the maximum range, {ring.max_range:g} m"
        return part, scene, "", f"{reach}: are ranges half path lengths in metres?"
    if np.isfinite(part.pose).all(axis=1).sum() < 2:
        return part, scene, "", "single scans carry too few walls, and the log has no poses to gather them by"
    scene = scene_of_map(ring, log)
    if scene.solid.any():
        return log, scene, "map", ""
    return log, scene, "", "neither single scans nor windows of the path carry walls"


def _sightings(
    look: Look, usable: Bool[np.ndarray, " rows"], heard: Bool[np.ndarray, " rows"], count: int
) -> tuple[Int[np.ndarray, "sensors 3"], Int[np.ndarray, "sensors 3"]]:
    """Sightings of walls well inside the cones, and those heard: direct, as transmitter, as receiver."""
    central = usable & (look.share > 0.95) & (look.beyond <= 0.01)
    direct = look.tx == look.rx
    columns = ((look.tx, central & direct), (look.tx, central & ~direct), (look.rx, central & ~direct))
    expected = [np.bincount(sensor[rows], minlength=count) for sensor, rows in columns]
    told = [np.bincount(sensor[rows & heard], minlength=count) for sensor, rows in columns]
    return np.stack(expected, axis=-1), np.stack(told, axis=-1)


def _repeats(log: Log, count: int) -> tuple[Float[np.ndarray, " sensors"], Int[np.ndarray, " sensors"]]:
    """Shares of nearest direct ranges that are exactly those of the scan before, and how many could be."""
    own = np.flatnonzero(log.tx == log.rx)
    nearest = np.full((len(log), count), np.inf)
    np.minimum.at(nearest, (log.echo_scan[own], log.tx[own]), log.range[own])
    both = np.isfinite(nearest[1:]) & np.isfinite(nearest[:-1])
    pairs = both.sum(axis=0)
    same = (both & (nearest[1:] == nearest[:-1])).sum(axis=0)
    return np.where(pairs > 0, same / np.maximum(pairs, 1), np.nan), pairs


def _most_frequent(log: Log, count: int) -> Float[np.ndarray, "sensors 2"]:
    """Each sensor's most frequent range, metres, and the share of its direct echoes that have it."""
    constant = np.full((count, 2), np.nan)
    for k in range(count):
        values, times = np.unique(log.range[(log.tx == k) & (log.rx == k)], return_counts=True)
        if len(values):
            constant[k] = values[times.argmax()], times.max() / times.sum()
    return constant


def _deviation(values: Float[np.ndarray, " echoes"]) -> float:
    """1.4826 x median absolute deviation; NaN of fewer than five values."""
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) if len(values) >= 5 else float("nan")
