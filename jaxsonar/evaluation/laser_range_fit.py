"""Range offset and scale of a ring from the laser that rides along: the reference for a calibration without one.

The walls that the laser sees along the trajectory give the true range of every echo whose cone contains the foot of a
perpendicular on a wall. Measured ranges are a linear function of the true ones, with heavy-tailed errors.
"""

import os
from dataclasses import dataclass, replace

import numpy as np
import tomli_w
from jaxtyping import Float, Int

from jaxsonar.evaluation.laser_reference_map import reference_map
from jaxsonar.evaluation.settings import SETTINGS as EVALUATION
from jaxsonar.fileio.atomic_files import open_output
from jaxsonar.geometry.robust_statistics import robust_deviation, student_weights
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.laser_datasets import LaserRecording
from jaxsonar.hardware.messages import REFERENCE_SPEED_OF_SOUND
from jaxsonar.registration.wall_readings import fresh_readings, nearest_faces
from jaxsonar.scans.firing_poses import poses_at, reading_poses
from jaxsonar.scans.measured_paths import path_rows
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_toml import ring_toml

SETTINGS = EVALUATION.ranges


@dataclass(frozen=True, eq=False)
class LaserRanges:
    """Echoes of a run whose true range the laser tells."""

    sensor: Int[np.ndarray, " echoes"]
    """Transmitter."""
    receiver: Int[np.ndarray, " echoes"]
    """Receiver."""
    reported: Float[np.ndarray, " echoes"]
    """Range as in the log, metres."""
    true: Float[np.ndarray, " echoes"]
    """Distance of the path's midpoint from the wall of the laser, metres."""
    off_axis: Float[np.ndarray, " echoes"]
    """Angle from the axis of the path to the normal of the wall, radians."""
    wall: Int[np.ndarray, " echoes"]
    """Row of the wall."""

    def residual(self, ring: Ring) -> Float[np.ndarray, " echoes"]:
        """Range corrected by a ring minus true range, metres."""
        return np.asarray(ring.corrected(self.reported, self.sensor, self.receiver)) - self.true

    def robust_sigma(self, ring: Ring) -> float:
        """Robust standard deviation of the residuals about their median, metres; NaN without echoes.

        It contains no common offset, and echoes of other things than the wall hardly change it. The echoes are the same
        for every ring.
        """
        residual = self.residual(ring)
        return robust_deviation(residual) if len(residual) else float("nan")


@dataclass(frozen=True, eq=False)
class LaserRangeFit:
    """Offset and scale of the ranges of a ring against a laser."""

    ring: Ring
    """The ring with these offsets and this speed of sound."""
    nominal: Ring
    """The ring that was given."""
    scale: float
    """Measured divided by true range, with the offset removed, relative to the given ring."""
    scale_sd: float
    """Its standard deviation, from a jackknife over walls."""
    offset: float
    """Mean range offset of the sensors relative to the given ring, metres, as reported."""
    offset_sd: float
    """Its standard deviation, metres, from a jackknife over walls."""
    sensor_offset: Float[np.ndarray, " sensors"]
    """Range offset of every sensor relative to their mean, metres; 0 for sensors that see no wall."""
    sensor_echoes: Int[np.ndarray, " sensors"]
    """Number of echoes from which each of them follows."""
    ranges: LaserRanges
    """The echoes."""

    def summary(self) -> tuple[str, ...]:
        """Summary of the result, line by line."""
        before, after = (1e3 * self.ranges.robust_sigma(ring) for ring in (self.nominal, self.ring))
        return (
            f"{len(self.ranges.true)} echoes at {len(np.unique(self.ranges.wall))} walls of the laser; "
            f"robust sigma {before:.1f} mm before, {after:.1f} mm after",
            f"range scale {self.scale:.4f} ± {self.scale_sd:.4f}: speed of sound {float(self.ring.speed_of_sound):.2f} "
            f"m/s ± {self.scale_sd / self.scale * float(self.ring.speed_of_sound):.2f}",
            f"mean range offset {1e3 * self.offset:.1f} mm ± {1e3 * self.offset_sd:.1f}",
        )


def save_laser_fit(fit: LaserRangeFit, filename: str | os.PathLike[str]) -> None:
    """Write the fitted ring and a table ``[calibration]`` atomically.

    Args:
        fit: the result to write.
        filename: the file; ``-`` is standard output.

    Raises:
        SonarError: the file cannot be written.
    """
    table = {
        "estimated": ["offset", "speed"],
        "reference": "laser",
        "echoes": len(fit.ranges.true),
        "walls": len(np.unique(fit.ranges.wall)),
        "scale": round(fit.scale, 6),
        "scale_sd": round(fit.scale_sd, 6),
        "mean_offset": round(fit.offset, 6),
        "mean_offset_sd": round(fit.offset_sd, 6),
        "sensor_echoes": fit.sensor_echoes.tolist(),
        "robust_sigma_before": round(fit.ranges.robust_sigma(fit.nominal), 6),
        "robust_sigma_after": round(fit.ranges.robust_sigma(fit.ring), 6),
    }
    text = ring_toml(fit.ring, each=True) + "\n" + tomli_w.dumps({"calibration": table})
    with open_output(filename) as file:
        file.write(text)


def laser_ranges(ring: Ring, log: Log, laser: LaserRecording) -> LaserRanges:
    """The fresh echoes of a log whose cone contains the foot of a perpendicular on a wall of the laser.

    Args:
        ring: the sensors.
        log: scans with poses; they are taken for the laser, too.
        laser: scans of the same run.

    Raises:
        SonarError: the log and the recording do not overlap in time, or the laser sees no wall.
    """
    fresh = fresh_readings(ring, log)
    walls = reference_map(at_poses_of(laser, log))
    if not len(walls):
        raise SonarError(
            "laser: it sees no wall along the trajectory; allowed are scans of a place with straight walls"
        )
    path = path_rows(ring, fresh.tx, fresh.rx)
    pose = reading_poses(fresh)
    row = np.flatnonzero((path >= 0) & np.isfinite(fresh.range) & np.isfinite(pose).all(axis=1))
    faces = nearest_faces(ring, path[row], pose[row], walls)
    corrected = np.asarray(ring.corrected(fresh.range[row], fresh.tx[row], fresh.rx[row]))
    gate = SETTINGS.gate + SETTINGS.gate_share * faces.distance
    near = (faces.wall >= 0) & (np.abs(corrected - faces.distance) < gate)
    near &= faces.distance < ring.max_range
    row = row[near]
    return LaserRanges(
        fresh.tx[row], fresh.rx[row], fresh.range[row], faces.distance[near], faces.off_axis[near], faces.wall[near]
    )


def at_poses_of(laser: LaserRecording, log: Log) -> LaserRecording:
    """The laser scans at the poses of a log of the same run; those outside the log are left out.

    If the clocks of the two do not overlap, both begin at the same time.

    Raises:
        SonarError: the log has no poses or no stamps, the recording has no scans, or the two runs differ in length.
    """
    samples = log.pose_samples
    samples = samples[np.isfinite(samples).all(axis=1)]
    samples = samples[np.unique(samples[:, 0], return_index=True)[1]]
    if not len(laser.stamp):
        raise SonarError("laser: a recording without scans came; allowed is a recording of the run of the log")
    if len(samples) < 2:
        posed, stamped = np.isfinite(log.pose).all(axis=1).sum(), np.isfinite(log.stamp).sum()
        raise SonarError(
            f"laser: a log with {len(samples)} poses at different times came ({posed} of {len(log)} scans have a pose, "
            f"{stamped} a stamp); needed are 2, poses and stamps"
        )
    time = laser.stamp
    if time[0] > samples[-1, 0] or time[-1] < samples[0, 0]:
        time = time - time[0] + samples[0, 0]
        length, other = float(np.ptp(time)), float(np.ptp(samples[:, 0]))
        if abs(length - other) > SETTINGS.max_clock_difference:
            raise SonarError(
                f"laser: {length:.1f} s of laser scans and {other:.1f} s of sonar scans at other times came; allowed "
                "are recordings of one run"
            )
    inside = (time >= samples[0, 0] - 1e-6) & (time <= samples[-1, 0] + 1e-6)
    pose = poses_at(samples[:, 0], samples[:, 1:], time[inside])
    pose[:, 2] = wrap_angle(pose[:, 2])
    return replace(laser, stamp=laser.stamp[inside], pose=pose, ranges=laser.ranges[inside])


def fit_ranges_to_laser(ring: Ring, log: Log, laser: LaserRecording) -> LaserRangeFit:
    """Fit offset and scale of the ranges of a log to the laser of the same run.

    Args:
        ring: the sensors.
        log: scans with poses.
        laser: scans of the same run.

    Raises:
        SonarError: as for ``laser_ranges``; too few echoes at walls of the laser.
    """
    ranges = laser_ranges(ring, log, laser)
    walls = np.unique(ranges.wall)
    if len(ranges.true) < SETTINGS.min_echoes or len(walls) < SETTINGS.min_walls:
        raise SonarError(
            f"laser: {len(ranges.true)} echoes at {len(walls)} walls of the laser; needed are {SETTINGS.min_echoes} "
            f"echoes at {SETTINGS.min_walls} walls (is it the laser of this run, are the poses right?)"
        )
    factor = REFERENCE_SPEED_OF_SOUND / float(ring.speed_of_sound)
    nominal = np.asarray(ring.range_offset)
    measured = ranges.reported - (nominal[ranges.sensor] + nominal[ranges.receiver]) / 2
    sensors = (np.eye(ring.count)[ranges.sensor] + np.eye(ring.count)[ranges.receiver]) / 2
    everything = np.ones(len(measured), dtype=bool)
    value = _robust_line(factor * ranges.true, measured, sensors, everything)
    # Echoes of one wall have common errors: leave out one wall at a time.
    others = [_robust_line(factor * ranges.true, measured, sensors, ranges.wall != wall)[:2] for wall in walls]
    sd = np.sqrt(np.var(others, axis=0) * (len(walls) - 1))
    offset, scale, relative = float(value[0]), float(value[1]), value[2:]
    fitted = replace(ring, range_offset=nominal + offset + relative, speed_of_sound=float(ring.speed_of_sound) / scale)
    echoes = np.bincount(ranges.sensor, minlength=ring.count)
    return LaserRangeFit(fitted, ring, scale, float(sd[1]), offset, float(sd[0]), relative, echoes, ranges)


def _robust_line(
    true: Float[np.ndarray, " echoes"],
    measured: Float[np.ndarray, " echoes"],
    sensors: Float[np.ndarray, "echoes sensors"],
    kept: np.ndarray,
) -> Float[np.ndarray, " parameters"]:
    """Offset, scale and relative offsets of sensors: regression with errors of Student's t distribution."""
    count = sensors.shape[1]
    design = np.concatenate([np.ones((len(true), 1)), true[:, None], sensors], axis=1)[kept]
    prior = np.zeros((count + 2, count + 2))
    prior[2:, 2:] = np.eye(count) / SETTINGS.sensor_offset_sd**2 + 1e6  # their sum is zero
    value, sigma = np.append([0.0, 1.0], np.zeros(count)), SETTINGS.first_noise
    for _ in range(SETTINGS.iterations):
        residual = measured[kept] - design @ value
        weight = student_weights((residual / sigma) ** 2, SETTINGS.freedom)
        sigma = max(float(np.sqrt(np.mean(weight * residual**2))), SETTINGS.min_noise)
        information = design.T @ (weight[:, None] * design) / sigma**2
        value = np.linalg.solve(information + prior, design.T @ (weight * measured[kept]) / sigma**2)
    return value
