"""Readings of a run and the walls of a map: fresh measurements, and the wall that each path should hear."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.se2 import transform_points, unit, wrap_angle
from jaxsonar.scans.measured_paths import path_rows
from jaxsonar.scans.readings import is_repeated, without_readings
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.sliding_windows import independent_measurements
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class WallReadingSettings:
    """Constants of the assignment of readings to walls. Chosen by hand."""

    end_margin: float = 0.1
    """A foot of the perpendicular may lie this far beyond the end of a wall, metres."""


SETTINGS = WallReadingSettings()


class WallFaces(NamedTuple):
    """Where readings stand relative to the walls of a map: the nearest face in the detection cone."""

    wall: Int[np.ndarray, " readings"]
    """Row of the wall; -1 if no wall is in the cone."""
    side: Int[np.ndarray, " readings"]
    """1 if the normal of the wall points away from the sensor, else -1."""
    distance: Float[np.ndarray, " readings"]
    """Distance of the midpoint of the path from the wall, metres; infinite without a wall."""
    off_axis: Float[np.ndarray, " readings"]
    """Angle from the axis of the path to the normal of the wall, radians."""


def fresh_readings(ring: Ring, log: Log) -> Log:
    """The log with new measurements only: without readings that a driver repeats, and without those at rest.

    Which readings are new is known from their ages or from a list of all measurements, and guessed in other logs
    (``independent_measurements``).
    """
    found = independent_measurements(ring, log)
    removed = np.ones(len(log.range), dtype=bool)
    rows = np.flatnonzero((path_rows(ring, log.tx, log.rx) >= 0) & np.isfinite(log.range) & ~is_repeated(log))
    removed[rows[found.used]] = False
    return without_readings(log, removed)


def distance_travelled(poses: Float[np.ndarray, "scans 3"]) -> Float[np.ndarray, " scans"]:
    """Length of the trajectory up to each scan, metres, along the scans with a pose (the others: NaN)."""
    known = np.flatnonzero(np.isfinite(poses).all(axis=1))
    steps = np.zeros(len(poses))
    steps[known[1:]] = np.hypot(*np.diff(poses[known, :2], axis=0).T)
    return np.cumsum(steps)


def nearest_faces(
    ring: Ring,
    path: Int[np.ndarray, " readings"],
    pose: Float[np.ndarray, "readings 3"],
    segments: Float[np.ndarray, "walls 2 2"],
    *,
    half_cone: float | None = None,
) -> WallFaces:
    """The nearest wall whose foot of the perpendicular lies on it and in the detection cone of each reading.

    Args:
        ring: the sensors.
        path: row of ``Ring.paths`` of each reading.
        pose: world_from_robot of each reading.
        segments: endpoints of the walls, world frame, metres.
        half_cone: half the width of the cone, radians; that of the path if omitted.
    """
    paths = ring.exact_paths
    midpoint = transform_points(pose, np.asarray(paths.midpoint)[path])
    half = np.asarray(paths.width)[path] / 2
    axis = np.asarray(paths.start)[path] + half + pose[:, 2]
    if not len(segments):
        none = np.zeros(len(path))
        return WallFaces(np.full(len(path), -1), np.ones(len(path), int), none + np.inf, none)
    center, half_length, theta = wall_geometry(segments)
    normal, tangent = unit(theta), unit(theta - np.pi / 2)
    height = (center * normal).sum(axis=-1) - midpoint @ normal.T
    along = midpoint @ tangent.T - (center * tangent).sum(axis=-1)
    side = np.where(height > 0, 1, -1)
    off_axis = wrap_angle(np.where(side > 0, theta, theta + np.pi) - axis[:, None])
    limit = half[:, None] if half_cone is None else half_cone
    seen = (np.abs(along) < half_length + SETTINGS.end_margin) & (np.abs(off_axis) < limit)
    distance = np.where(seen, np.abs(height), np.inf)
    wall, row = distance.argmin(axis=1), np.arange(len(path))
    found = np.isfinite(distance[row, wall])
    return WallFaces(np.where(found, wall, -1), side[row, wall], distance[row, wall], off_axis[row, wall])


def wall_geometry(
    segments: Float[np.ndarray, "walls 2 2"],
) -> tuple[Float[np.ndarray, "walls 2"], Float[np.ndarray, " walls"], Float[np.ndarray, " walls"]]:
    """Middle (metres), half length (metres), and direction of the normal (radians) of walls."""
    along = segments[:, 1] - segments[:, 0]
    return segments.mean(axis=1), np.hypot(*along.T) / 2, np.arctan2(along[:, 0], -along[:, 1])
