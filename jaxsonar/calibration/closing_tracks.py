"""Scale of the ranges from closing tracks: a sensor approaches a static target, and odometry tells by how much.

A track is a series of direct echoes of one sensor at one target: its ranges change by about as much as the sensor moves
along its axis. The slope of the ranges over that motion is the scale, whatever the target and the range offset are.
Only a common offset of all ranges remains invisible.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.calibration.settings import TRACK_SETTINGS as SETTINGS
from jaxsonar.geometry.robust_statistics import student_weights
from jaxsonar.geometry.se2 import transform_points, unit, wrap_angle
from jaxsonar.registration.wall_readings import distance_travelled
from jaxsonar.scans.firing_poses import reading_poses
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


class Track(NamedTuple):
    """Slope of one track."""

    log_scale: float
    """Logarithm of measured divided by true change of the range."""
    sd: float
    """Standard deviation, from the noise and from the unknown direction of the target in the cone."""
    start: Float[np.ndarray, "2"]
    """Where the robot was at its first echo: number of the log, and distance travelled (metres)."""


@dataclass(frozen=True)
class ScaleEstimate:
    """Scale of the ranges relative to a ring."""

    log_scale: float
    """Logarithm of the scale: corrected range divided by true range."""
    sd: float
    """Standard deviation: the larger one of the fit and of the jackknife over stretches of the trajectory; infinite if
    there are too few tracks."""
    tracks: int
    """Number of tracks."""
    spread: float
    """Standard deviation between tracks in excess of their own."""
    stretches: int
    """Number of stretches of the trajectory in which tracks begin."""


def estimate_scale(ring: Ring, logs: Sequence[Log]) -> ScaleEstimate:
    """Scale of the ranges relative to a ring, from all closing tracks of logs.

    Args:
        ring: the sensors.
        logs: fresh readings with poses or odometry, whose drift over a metre or two does not matter.
    """
    tracks = [track for number, log in enumerate(logs) for track in find_tracks(ring, log, number)]
    if len(tracks) < SETTINGS.min_tracks:
        return ScaleEstimate(0.0, np.inf, len(tracks), 0.0, 0)
    value, sd = np.array([one.log_scale for one in tracks]), np.array([one.sd for one in tracks])
    mean, spread, model_sd = robust_mean(value, sd)
    # Errors of poses and targets are common to tracks of one place: leave out one stretch at a time.
    start = np.array([one.start for one in tracks])
    total = sum(float(distance_travelled(log.pose).max(initial=0.0)) for log in logs)
    length = max(SETTINGS.stretch, total / SETTINGS.most_stretches)
    _, stretch = np.unique(np.floor(start / [1, length]), axis=0, return_inverse=True)
    stretch = stretch.ravel()
    count = int(stretch.max()) + 1
    if count < SETTINGS.min_stretches:
        return ScaleEstimate(mean, np.inf, len(tracks), spread, count)
    others = [robust_mean(value[stretch != k], sd[stretch != k])[0] for k in range(count)]
    jackknife = float(np.sqrt(np.var(others) * (count - 1)))
    return ScaleEstimate(mean, max(model_sd, jackknife), len(tracks), spread, count)


def find_tracks(ring: Ring, log: Log, number: int = 0) -> list[Track]:
    """The closing tracks of a log, from the nearest echo of each measurement.

    Echoes beyond the maximum range of the ring count, too: a track shows by itself whether its echoes are sound.

    Args:
        ring: the sensors.
        log: fresh readings, with poses.
        number: number of the log.
    """
    pose, corrected = reading_poses(log), np.asarray(ring.corrected(log.range, log.tx, log.rx))
    travelled = distance_travelled(log.pose)
    usable = (log.tx == log.rx) & (corrected > 0) & np.isfinite(pose).all(axis=1)
    nearest, found = _nearest_echoes(log, corrected, np.flatnonzero(usable)), []
    for sensor in range(ring.count):
        row = nearest[log.tx[nearest] == sensor]
        if not len(row):
            continue
        position = transform_points(pose[row], np.asarray(ring.position)[sensor : sensor + 1])
        heading = pose[row, 2] + float(ring.heading[sensor])
        half_cone = float(ring.beam[sensor]) / 2
        for part in _parts(corrected[row], position, heading):
            slope = fit_slope(corrected[row[part]], position[part], heading[part], half_cone)
            if slope is not None:
                found.append(Track(*slope, np.array([number, travelled[log.echo_scan[row[part[0]]]]])))
    return found


def _nearest_echoes(
    log: Log, corrected: Float[np.ndarray, " echoes"], rows: Int[np.ndarray, " rows"]
) -> Int[np.ndarray, "_"]:
    """Of some direct echoes of a log, the row of the nearest one of each scan and sensor, ascending by scan."""
    order = rows[np.lexsort((corrected[rows], log.tx[rows], log.echo_scan[rows]))]
    same = (np.diff(log.echo_scan[order]) == 0) & (np.diff(log.tx[order]) == 0)
    return order[np.append(True, ~same)[: len(order)]]


def fit_slope(
    measured: Float[np.ndarray, " echoes"],
    position: Float[np.ndarray, "echoes 2"],
    heading: Float[np.ndarray, " echoes"],
    half_cone: float,
) -> tuple[float, float] | None:
    """Logarithm of the scale from one track, and its standard deviation; None if the track does not determine it.

    The target may be anywhere in the cone. If it is off the axis by b, the range changes by the motion along the axis
    times cos(b), plus the motion across times sin(b). The mean of the cosine is corrected; the second term is symmetric
    and adds to the standard deviation.

    Args:
        measured: ranges, metres.
        position: positions of the sensor, metres.
        heading: directions of its axis, radians.
        half_cone: half the width of the cone, radians.
    """
    axis = float(np.angle(np.exp(1j * heading).mean()))
    axes = np.stack([unit(axis), unit(axis + np.pi / 2)])
    along, across = axes @ (position.mean(axis=0) - position).T
    return _slope(measured, along, across, half_cone) if np.ptp(along) > SETTINGS.min_motion else None


def _slope(
    measured: Float[np.ndarray, " echoes"],
    along: Float[np.ndarray, " echoes"],
    across: Float[np.ndarray, " echoes"],
    half_cone: float,
) -> tuple[float, float] | None:
    """``fit_slope`` after the motion is resolved along and across the axis: robust regression."""
    design, scale = np.stack([np.ones(len(along)), along], axis=-1), SETTINGS.first_noise
    weight, value = np.ones(len(along)), np.zeros(2)
    for _ in range(SETTINGS.iterations):
        value = np.linalg.lstsq(design * np.sqrt(weight)[:, None], measured * np.sqrt(weight), rcond=None)[0]
        residual = measured - design @ value
        weight = student_weights((residual / scale) ** 2, SETTINGS.freedom)
        scale = float(np.sqrt((weight * residual**2).sum() / (len(along) - 2)))
        scale = max(scale, SETTINGS.min_noise)
    along, across = (one - np.average(one, weights=weight) for one in (along, across))
    variance = (weight * along**2).sum()
    bearing_sd = half_cone / np.sqrt(6)  # triangular distribution: a target must stay in the cone during the track
    slope = float(value[1]) / (1 - bearing_sd**2 / 2)
    if abs(slope - 1) > SETTINGS.max_error:
        return None
    turned = (weight * along * across).sum() / variance * bearing_sd
    sd = float(np.sqrt(scale**2 / variance + turned**2))
    return (float(np.log(slope)), sd) if sd < SETTINGS.max_sd else None


def _parts(
    measured: Float[np.ndarray, " echoes"],
    position: Float[np.ndarray, "echoes 2"],
    heading: Float[np.ndarray, " echoes"],
) -> list[Int[np.ndarray, "_"]]:
    """Rows of the echoes of each possible track of one sensor."""
    step = np.diff(position, axis=0)
    expected, distance = -(step * unit(heading[:-1])).sum(axis=-1), np.hypot(*step.T)
    jump = np.abs(np.diff(measured) - expected) > SETTINGS.max_jump + SETTINGS.max_jump_share * distance
    ends = jump | (distance > SETTINGS.max_gap)
    found = []
    for part in np.split(np.arange(len(measured)), np.flatnonzero(ends) + 1):
        turned = np.abs(wrap_angle(heading[part] - heading[part[len(part) // 2]]))
        part = part[turned < SETTINGS.max_turn]
        if len(part) >= SETTINGS.min_echoes:
            found.append(part)
    return found


def robust_mean(value: Float[np.ndarray, " tracks"], sd: Float[np.ndarray, " tracks"]) -> tuple[float, float, float]:
    """Mean of values that follow Student's t distribution about it, and have a spread beyond their own errors.

    Args:
        value: the values.
        sd: their standard deviations.

    Returns:
        The mean, the most likely spread, and the standard deviation of the mean.
    """
    best, likelihood = (0.0, 0.0, np.inf), -np.inf
    for spread in SETTINGS.spreads:
        scale, mean, weight = np.hypot(sd, spread), float(np.median(value)), np.ones(len(value))
        for _ in range(SETTINGS.iterations):
            weight = student_weights(((value - mean) / scale) ** 2, SETTINGS.freedom) / scale**2
            mean = float(np.average(value, weights=weight))
        tails = np.log1p(((value - mean) / scale) ** 2 / SETTINGS.freedom)
        now = float((-np.log(scale) - (SETTINGS.freedom + 1) / 2 * tails).sum())
        if now > likelihood:
            best, likelihood = (mean, float(spread), float(weight.sum() ** -0.5)), now
    return best
