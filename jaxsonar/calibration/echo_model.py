"""Noise and detection probability of the echoes of a run: core and tails of the residuals, misses over the angle."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.calibration.settings import ECHO_SETTINGS as SETTINGS
from jaxsonar.registration.wall_readings import fresh_readings, nearest_faces
from jaxsonar.scans.firing_poses import reading_poses
from jaxsonar.scans.measured_paths import measured_paths, path_rows
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.sliding_windows import has_moved
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True, eq=False)
class EchoStatistics:
    """How echoes scatter about the walls of a map, and how often walls are heard.

    The walls were found from the same echoes. Walls that are never heard are therefore not counted.
    """

    core_sd: float
    """Standard deviation of the normally distributed core of the residuals, metres."""
    tail_share: float
    """Share of the echoes in the tails, which follow a Laplace distribution."""
    tail_scale: float
    """Mean absolute deviation in the tails, metres."""
    too_short: float
    """Share of the echoes that are shorter than the wall by more than 3 standard deviations of the core."""
    too_long: float
    """Share of the echoes that are longer by more than that."""
    echoes: int
    """Number of echoes with a wall in their cone."""
    off_axis: Float[np.ndarray, " edges"]
    """Edges of the bins of the angle between the axis of a path and the normal of a wall, radians, from 0."""
    expected: Int[np.ndarray, " bins"]
    """Number of measurements with a wall at this angle."""
    heard: Int[np.ndarray, " bins"]
    """Number of those in which the wall was heard."""

    @property
    def detection(self) -> Float[np.ndarray, " bins"]:
        """Share of the walls that are heard, over the angle; NaN without a measurement."""
        return np.divide(self.heard, self.expected, out=np.full(len(self.heard), np.nan), where=self.expected > 0)

    def describe(self) -> tuple[str, str]:
        """Two lines: the noise, and the detection probability."""
        edges = np.degrees(self.off_axis)
        bins = [
            f"{low:.0f}-{high:.0f} deg {share:.0%} of {count}"
            for low, high, share, count in zip(edges, edges[1:], self.detection, self.expected, strict=False)
            if count
        ]
        core, scale = 1e3 * self.core_sd, 1e3 * self.tail_scale
        return (
            f"noise: core {core:.1f} mm, tails {self.tail_share:.0%} with {scale:.0f} mm; "
            f"{self.too_short:.0%} too short, {self.too_long:.0%} too long",
            f"walls heard, off axis: {', '.join(bins)}",
        )


def measure_echo_model(ring: Ring, logs: Sequence[Log], walls: Sequence[Float[np.ndarray, "_ 2 2"]]) -> EchoStatistics:
    """Noise and detection probability of a calibrated ring.

    Args:
        ring: the calibrated sensors.
        logs: scans with poses.
        walls: endpoints of the walls of a map of each log, metres, made with the same ring and poses.
    """
    parts = [_residuals(ring, log, segments) for log, segments in zip(logs, walls, strict=True)]
    residual = np.concatenate([np.zeros(0), *parts])
    core, share, scale = fit_core_and_tails(residual)
    expected, heard = np.zeros((2, SETTINGS.bins), dtype=int)
    for log, segments in zip(logs, walls, strict=True):
        counts = _detections(ring, log, segments)
        expected, heard = expected + counts[0], heard + counts[1]
    return EchoStatistics(
        core_sd=core,
        tail_share=share,
        tail_scale=scale,
        too_short=float(np.mean(residual < -SETTINGS.outlier * core)) if len(residual) else 0.0,
        too_long=float(np.mean(residual > SETTINGS.outlier * core)) if len(residual) else 0.0,
        echoes=len(residual),
        off_axis=SETTINGS.bin * np.arange(SETTINGS.bins + 1),
        expected=expected,
        heard=heard,
    )


def fit_core_and_tails(residual: Float[np.ndarray, " echoes"]) -> tuple[float, float, float]:
    """Core (standard deviation, metres), share of the tails, and their scale (metres): expectation maximization.

    The core is normally distributed, the tails follow a Laplace distribution about the same mean 0.
    """
    core, share, scale = SETTINGS.first_core, 0.2, SETTINGS.first_tail
    if not len(residual):
        return core, 0.0, scale
    for _ in range(SETTINGS.iterations):
        normal = (1 - share) * np.exp(-0.5 * (residual / core) ** 2) / (core * np.sqrt(2 * np.pi))
        tail = share * np.exp(-np.abs(residual) / scale) / (2 * scale)
        in_core = normal / np.maximum(normal + tail, 1e-300)
        core = float(np.sqrt((in_core * residual**2).sum() / max(in_core.sum(), 1e-9)))
        core = max(core, SETTINGS.min_core)
        share = float(1 - in_core.mean())
        # Tails that are no wider than the core would only share it.
        scale = float(((1 - in_core) * np.abs(residual)).sum() / max((1 - in_core).sum(), 1e-9))
        scale = max(scale, 2 * core)
    return core, share, scale


def _residuals(ring: Ring, log: Log, segments: Float[np.ndarray, "_ 2 2"]) -> Float[np.ndarray, " echoes"]:
    """Corrected range minus distance of the wall in the cone, metres, of fresh echoes."""
    log = fresh_readings(ring, log)
    path, pose = path_rows(ring, log.tx, log.rx), reading_poses(log)
    row = np.flatnonzero((path >= 0) & np.isfinite(log.range) & np.isfinite(pose).all(axis=1))
    faces = nearest_faces(ring, path[row], pose[row], segments)
    corrected = np.asarray(ring.corrected(log.range[row], log.tx[row], log.rx[row]))
    residual = corrected[faces.wall >= 0] - faces.distance[faces.wall >= 0]
    return residual[np.abs(residual) < SETTINGS.gate]


def _detections(
    ring: Ring, log: Log, segments: Float[np.ndarray, "_ 2 2"]
) -> tuple[Int[np.ndarray, " bins"], Int[np.ndarray, " bins"]]:
    """Number of measurements with a wall in each bin of the angle off axis, and of those that heard it."""
    scan, path = np.nonzero(measured_paths(ring, log) & has_moved(log.pose)[:, None])
    widest = SETTINGS.bin * SETTINGS.bins
    faces = nearest_faces(ring, path, log.pose[scan], segments, half_cone=widest)
    seen = (faces.wall >= 0) & (faces.distance < SETTINGS.detection_range * ring.max_range)
    scan, path, distance = scan[seen], path[seen], faces.distance[seen]
    bin_of = np.minimum((np.abs(faces.off_axis[seen]) / SETTINGS.bin).astype(int), SETTINGS.bins - 1)
    # The reading of each measurement that is closest to the wall.
    nearest = np.full((len(log), len(ring.paths)), np.inf)
    expected = np.full_like(nearest, np.nan)
    expected[scan, path] = distance
    rows = path_rows(ring, log.tx, log.rx)
    used = np.flatnonzero((rows >= 0) & np.isfinite(log.range))
    corrected = np.asarray(ring.corrected(log.range[used], log.tx[used], log.rx[used]))
    error = np.abs(corrected - expected[log.echo_scan[used], rows[used]])
    np.fmin.at(nearest, (log.echo_scan[used], rows[used]), error)
    heard = nearest[scan, path] < SETTINGS.detection_gate
    return (
        np.bincount(bin_of, minlength=SETTINGS.bins),
        np.bincount(bin_of[heard], minlength=SETTINGS.bins),
    )
