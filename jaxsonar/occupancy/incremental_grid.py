"""Grids of logs, and grids that grow while the robot drives."""

import numpy as np
from jaxtyping import Float

from jaxsonar.geometry.se2 import transform_points
from jaxsonar.geometry.segments import lengths, sample_segments
from jaxsonar.hardware.errors import SonarError
from jaxsonar.occupancy.direct_readings import DirectReadings
from jaxsonar.occupancy.grid_evidence import GridEvidence, GridMethod
from jaxsonar.occupancy.known_reflectors import KnownReflectors
from jaxsonar.occupancy.occupancy_grid import NO_WALLS, OccupancyGrid, assemble_grid
from jaxsonar.occupancy.settings import SETTINGS, BayesSettings
from jaxsonar.occupancy.wall_profile import FacingReadings, profile_walls
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.single_firings import group_firings
from jaxsonar.sensors.ring import Ring


class IncrementalGrid:
    """A grid that grows with the scans. Its memory grows with the area of the floor, not with the number of scans."""

    def __init__(
        self, ring: Ring, *, resolution: float = 0.05, method: GridMethod = "counts", certain: float | None = None
    ):
        """Without any scan.

        Args:
            ring: the sensors.
            resolution: side of a cell, metres.
            method: how echoes become obstacles, see ``occupancy``.
            certain: angle off the axis up to which walls are heard for sure, radians; a part of the cone if omitted.

        Raises:
            SonarError: a resolution out of range, or an unknown method.
        """
        self.evidence = GridEvidence(ring, resolution=resolution, method=method, certain=certain)
        self._pending: list[Log] = []
        self._readings: list[FacingReadings] = []
        self._poses = np.zeros((0, 4))

    def set_ring(self, ring: Ring) -> None:
        """Use another ring for the scans that are added from now on, and for those that are pending."""
        self.evidence.set_ring(ring)

    def add(self, log: Log) -> None:
        """Add scans; those without a pose are counted and skipped.

        They become part of the grid with the next ``update``, so that its walls can explain their echoes.

        Raises:
            SonarError: poses too far apart for a grid; a sensor number that the ring does not have. Then nothing of
                the log is added.
        """
        if not len(log):
            return
        log = group_firings(log)
        self.evidence.reserve(log)
        self._pending.append(log)
        posed = np.isfinite(log.pose).all(axis=-1)
        poses = np.column_stack([log.stamp, log.pose])[posed]
        self._poses = np.concatenate([self._poses, poses])[-SETTINGS.max_readings :]

    def update(
        self,
        walls: Float[np.ndarray, "walls 2 2"] | KnownReflectors = NO_WALLS,
        *,
        parameters: BayesSettings | None = None,
    ) -> OccupancyGrid:
        """The grid of all scans so far.

        Args:
            walls: what is known now, world frame, metres: end points of walls, or walls and points with their
                uncertainty.
            parameters: of the Bayesian model; those of the method in ``settings`` if omitted.

        Raises:
            SonarError: a wall that is not finite.
        """
        given = walls.walls if isinstance(walls, KnownReflectors) else np.asarray(walls, np.float64)
        _check(given)
        known = walls if isinstance(walls, KnownReflectors) else KnownReflectors.of_walls(given)
        self._readings.extend(_facing_readings(self.evidence, log) for log in self._pending)
        max_range = self.evidence.ring.max_range
        readings = FacingReadings.concatenate(self._readings, max_range).latest(SETTINGS.max_readings)
        self._readings = [readings]
        readings = readings._replace(driven=_way(self._poses, self.evidence.resolution))
        profile = profile_walls(known, readings, resolution=self.evidence.resolution)
        while self._pending:
            self.evidence.add(self._pending.pop(0), profile.parts)
        return assemble_grid(self.evidence, profile, readings, parameters=parameters)


def occupancy(
    ring: Ring,
    log: Log,
    *,
    walls: Float[np.ndarray, "walls 2 2"] | KnownReflectors = NO_WALLS,
    resolution: float = 0.05,
    method: GridMethod = "counts",
    certain: float | None = None,
) -> OccupancyGrid:
    """The occupancy grid of a log.

    A cell is free if readings exclude walls of the likely directions in it, or if the robot stood there: a sensor that
    heard nothing nearer excludes walls that face it, and no others. A sensor that a scan did not measure is no evidence
    (``measured_paths``). Every reading counts at the pose of the robot when it was measured. Firings that stand in
    scans of their own are grouped (``group_firings``).

    Args:
        ring: the sensors.
        log: scans; those without a pose are counted and skipped.
        walls: what is known, world frame, metres: end points of walls, or walls and points with their uncertainty.
        resolution: side of a cell, metres.
        method: how echoes become obstacles. "counts": echoes that no known reflector explains, each shared among the
            cells of its arc by expectation maximization. "em": the same with all echoes. "logodds": log-odds of
            independent cells from all direct and cross echoes. "wilkes": from all direct echoes (Wilkes et al.).
            "elfes": from the first direct echo of each sensor (Matthies and Elfes 1988).
        certain: angle off the axis up to which walls are heard for sure, radians, for example that of a calibration
            (``certain_angle``); a part of the cone if omitted.

    Raises:
        SonarError: poses too far apart, or cells too small, for a grid; a wall that is not finite; a sensor number that
            the ring does not have; an unknown method.
    """
    grid = IncrementalGrid(ring, resolution=resolution, method=method, certain=certain)
    grid.add(log)
    return grid.update(walls)


def _facing_readings(evidence: GridEvidence, log: Log) -> FacingReadings:
    """The direct readings of a log; scans without a pose are skipped."""
    ring, sensors = evidence.ring, evidence.sensors
    readings = DirectReadings.of(ring, log)
    posed = np.asarray(np.isfinite(log.pose).all(axis=-1))
    used = readings.measured & posed[:, None]
    robot, sensor = readings.robot[used], np.nonzero(used)[1]
    return FacingReadings(
        transform_points(robot, sensors.position[sensor]),
        sensors.heading[sensor] + robot[:, 2],
        evidence.certain[sensor],
        readings.quiet_range(ring.max_range)[used],
        np.zeros((0, 2)),
        ring.max_range,
    )


def _way(poses: Float[np.ndarray, "poses 4"], resolution: float) -> Float[np.ndarray, "points 2"]:
    """Points of the robot's way, half a cell apart between scans near each other.

    Args:
        poses: stamp (s), x, y (m), theta (rad), in any order; poses without a stamp are points of their own.
        resolution: side of a cell, metres.
    """
    poses = poses[np.lexsort(poses.T[::-1])]
    legs = np.stack([poses[:-1, 1:3], poses[1:, 1:3]], axis=1)
    length = lengths(legs)
    driven = (length > 0) & (length <= SETTINGS.max_step) & np.isfinite(poses[:-1, 0]) & np.isfinite(poses[1:, 0])
    between, _ = sample_segments(legs[driven], (2 * length[driven] / resolution).astype(int) + 2)
    return np.unique(np.concatenate([poses[:, 1:3], between]), axis=0)


def _check(walls: Float[np.ndarray, "walls 2 2"]) -> None:
    """Raise a SonarError for walls that are not finite, or too far away."""
    limit = SETTINGS.max_wall_coordinate
    bad = ~(np.abs(walls) <= limit).all(axis=(1, 2))
    if bad.any():
        k = int(np.argmax(bad))
        raise SonarError(f"grid: wall {k} is {walls[k].tolist()}; allowed are finite coordinates up to {limit:g} m")
