"""Echoes of a run and the walls that explain them: the data of a calibration of rings with few sensors."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.calibration.settings import SPARSE_SETTINGS as SETTINGS
from jaxsonar.geometry.se2 import transform_points, unit
from jaxsonar.registration.wall_readings import nearest_faces, wall_geometry
from jaxsonar.scans.firing_poses import reading_poses
from jaxsonar.scans.measured_paths import path_rows
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True, eq=False)
class WallEchoes:
    """Echoes of a run, each assigned to one face of a wall. The two faces of a wall are different walls."""

    ring: Ring
    """The nominal ring."""
    path: Int[np.ndarray, " echoes"]
    """Row of ``Ring.paths``."""
    reported: Float[np.ndarray, " echoes"]
    """Range as in the log, metres."""
    pose: Float[np.ndarray, "echoes 3"]
    """world_from_robot when the echo was received: x, y (m), theta (rad)."""
    travelled: Float[np.ndarray, " echoes"]
    """Length of the trajectory up to there, metres."""
    wall: Int[np.ndarray, " echoes"]
    """Row of ``center`` and ``theta``."""
    off_axis: Float[np.ndarray, " echoes"]
    """Angle from the axis of the path to the normal of the wall, radians."""
    center: Float[np.ndarray, "walls 2"]
    """Middle of each wall, world frame, metres."""
    theta: Float[np.ndarray, " walls"]
    """Direction of its normal, away from the sensors that see this face, radians."""

    def take(self, rows: Bool[np.ndarray, " echoes"] | Int[np.ndarray, " rows"]) -> "WallEchoes":
        """Some of the echoes, with all walls."""
        columns = ("path", "reported", "pose", "travelled", "wall", "off_axis")
        return replace(self, **{name: getattr(self, name)[rows] for name in columns})


def assign_echoes(
    ring: Ring,
    log: Log,
    travelled: Float[np.ndarray, " scans"],
    segments: Float[np.ndarray, "walls 2 2"],
    calibrated: Ring,
    *,
    stretch: float = np.inf,
) -> WallEchoes:
    """The echoes of a log that walls of a map explain.

    Walls that hardly determine their own direction are left out: a wall that is turned looks like a wrong scale.

    Args:
        ring: the nominal ring.
        log: fresh readings, with poses.
        travelled: length of the trajectory up to each scan, metres.
        segments: walls of the map, which was made with ``calibrated``; world frame, metres.
        calibrated: the ring as far as it is known.
        stretch: length of trajectory in which a wall is one wall, metres.
    """
    path, pose = path_rows(ring, log.tx, log.rx), reading_poses(log)
    row = np.flatnonzero((path >= 0) & np.isfinite(log.range) & np.isfinite(pose).all(axis=1))
    corrected = np.asarray(calibrated.corrected(log.range[row], log.tx[row], log.rx[row]))
    faces = nearest_faces(ring, path[row], pose[row], segments)
    near = (faces.wall >= 0) & (np.abs(corrected - faces.distance) < SETTINGS.gate) & (corrected < ring.max_range)
    row, scan = row[near], log.echo_scan[row[near]]
    part = np.floor(travelled[scan] / stretch).astype(int)
    code = np.stack([faces.wall[near], faces.side[near], part], axis=1)
    codes, wall = np.unique(code, axis=0, return_inverse=True)
    center, _, theta = wall_geometry(segments)
    index = codes[:, 0]
    echoes = WallEchoes(
        ring,
        path[row],
        log.range[row],
        pose[row],
        travelled[scan],
        wall.ravel(),
        faces.off_axis[near],
        center[index],
        np.where(codes[:, 1] > 0, theta[index], theta[index] + np.pi),
    )
    return echoes.take(_has_direction(echoes)[echoes.wall])


def _has_direction(echoes: WallEchoes) -> Bool[np.ndarray, " walls"]:
    """Walls whose direction their own echoes determine."""
    midpoint = transform_points(echoes.pose, np.asarray(echoes.ring.exact_paths.midpoint)[echoes.path])
    tangent, size = unit(echoes.theta - np.pi / 2)[echoes.wall], len(echoes.center)
    along = (midpoint * tangent).sum(axis=-1)
    count = np.bincount(echoes.wall, minlength=size)
    mean = np.bincount(echoes.wall, along, size) / np.maximum(count, 1)
    spread = np.bincount(echoes.wall, (along - mean[echoes.wall]) ** 2, size)
    return (count >= SETTINGS.min_echoes) & (spread * SETTINGS.max_direction_sd**2 > SETTINGS.first_noise**2)
