"""Directions in which a scan would have detected a wall: only there can a missing detection be evidence."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.scans.firing_poses import path_poses
from jaxsonar.scans.measured_paths import measured_paths
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class MeasuredDirectionSettings:
    """Constants of measured directions. Chosen by hand."""

    directions: int = 180
    """Number of directions around the robot."""


SETTINGS = MeasuredDirectionSettings()


def measured_directions(ring: Ring, log: Log) -> Bool[np.ndarray, "scans directions"] | None:
    """Directions of normals of walls that the measured paths of each scan receive, robot frame of the scan.

    A direction that no path of the ring receives counts as measured; the callers know the ring.

    Args:
        ring: the sensors.
        log: the scans.

    Returns:
        A row per scan, one column for each of equal sectors from -pi to pi; None if every scan measured all paths.
    """
    measured = measured_paths(ring, log)
    if measured.all():
        return None
    motion = path_poses(ring, log)
    out = np.empty((len(log), SETTINGS.directions), dtype=bool)
    for row, paths in enumerate(measured):
        out[row] = directions_of_paths(ring, paths, None if motion is None else motion[row])
    return out


def directions_of_paths(
    ring: Ring, measured: Bool[np.ndarray, " paths"], path_pose: Float[np.ndarray, "paths 3"] | None = None
) -> Bool[np.ndarray, " directions"]:
    """The row of one scan in ``measured_directions``.

    Args:
        ring: the sensors.
        measured: the paths that were measured.
        path_pose: scan_from_robot when each path was measured; None: all at the pose of the scan.
    """
    angle = -np.pi + (np.arange(SETTINGS.directions) + 0.5) * (2 * np.pi / SETTINGS.directions)
    geometry = ring.exact_paths
    start, width = np.asarray(geometry.start), np.asarray(geometry.width)
    missing = ~(np.mod(angle[:, None] - start, 2 * np.pi) < width).any(axis=1)
    start = start if path_pose is None else start + path_pose[:, 2]
    received = np.mod(angle[:, None] - start[measured], 2 * np.pi) < width[measured]
    return np.asarray(missing | received.any(axis=1))


def direction_sector(angle: Float[np.ndarray, "*some"]) -> Int[np.ndarray, "*some"]:
    """Column of directions (radians) in ``measured_directions``."""
    count = SETTINGS.directions
    return np.floor(np.mod(angle + np.pi, 2 * np.pi) * (count / (2 * np.pi))).astype(np.int64) % count


def rotated_directions(directions: Bool[np.ndarray, " directions"], heading: float) -> Bool[np.ndarray, " directions"]:
    """The directions in the parent frame of a pose with this heading, radians."""
    count = len(directions)
    return np.roll(directions, int(np.round(heading * (count / (2 * np.pi)))) % count)


def stacked_directions(
    rows: Sequence[Bool[np.ndarray, " directions"] | None],
) -> Bool[np.ndarray, "scans directions"] | None:
    """Directions of several scans; None for a scan that measured all paths, and for all scans if each of them did."""
    if all(row is None for row in rows):
        return None
    return np.array([np.ones(SETTINGS.directions, bool) if row is None else row for row in rows])
