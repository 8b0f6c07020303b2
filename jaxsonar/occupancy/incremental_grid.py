"""Grids of logs, and grids that grow while the robot drives."""

import numpy as np
from jaxtyping import Float

from jaxsonar.geometry.se2 import transform_points
from jaxsonar.hardware.errors import SonarError
from jaxsonar.occupancy.direct_readings import DirectReadings, TransducerArrays
from jaxsonar.occupancy.grid_evidence import METHODS, GridEvidence, GridMethod
from jaxsonar.occupancy.known_reflectors import KnownReflectors
from jaxsonar.occupancy.occupancy_grid import NO_WALLS, OccupancyGrid, assemble_grid
from jaxsonar.occupancy.settings import SETTINGS, BayesSettings
from jaxsonar.occupancy.wall_profile import FacingReadings, profile_walls
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.single_firings import group_firings
from jaxsonar.sensors.ring import Ring


class IncrementalGrid:
    """A grid that grows with the scans. Its memory grows with the area of the floor, not with the number of scans."""

    def __init__(self, ring: Ring, *, resolution: float = 0.05, method: GridMethod = "counts"):
        """Without any scan.

        Args:
            ring: the sensors.
            resolution: side of a cell, metres.
            method: how echoes become obstacles, see ``occupancy``.

        Raises:
            SonarError: a resolution out of range, or an unknown method.
        """
        if method not in METHODS:
            raise SonarError(f"grid: method {method!r}; allowed are {', '.join(METHODS)}")
        self.ring = ring
        self.evidence = GridEvidence(ring, resolution=resolution, method=method)
        self._pending: list[Log] = []
        self._readings: list[FacingReadings] = []

    def add(self, log: Log) -> None:
        """Add scans; those without a pose are counted and skipped.

        They become part of the grid with the next ``update``, so that its walls can explain their echoes.
        """
        if len(log):
            self._pending.append(group_firings(log))

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
            SonarError: poses too far apart for a grid; a wall that is not finite; a sensor number that the ring does
                not have.
        """
        known = walls if isinstance(walls, KnownReflectors) else KnownReflectors.of_walls(_checked(walls))
        self._readings.extend(_facing_readings(self.ring, log) for log in self._pending)
        readings = FacingReadings.concatenate(self._readings, self.ring.max_range).latest(SETTINGS.max_readings)
        self._readings = [readings]
        profile = profile_walls(known, readings, resolution=self.evidence.resolution)
        for log in self._pending:
            self.evidence.add(log, profile.parts)
        self._pending = []
        return assemble_grid(self.evidence, profile, readings, parameters=parameters)


def occupancy(
    ring: Ring,
    log: Log,
    *,
    walls: Float[np.ndarray, "walls 2 2"] | KnownReflectors = NO_WALLS,
    resolution: float = 0.05,
    method: GridMethod = "counts",
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

    Raises:
        SonarError: poses too far apart, or cells too small, for a grid; a wall that is not finite; a sensor number that
            the ring does not have; an unknown method.
    """
    grid = IncrementalGrid(ring, resolution=resolution, method=method)
    grid.add(log)
    return grid.update(walls)


def _facing_readings(ring: Ring, log: Log) -> FacingReadings:
    """The direct readings of a log; scans without a pose are skipped."""
    sensors, readings = TransducerArrays.of(ring), DirectReadings.of(ring, log)
    posed = np.asarray(np.isfinite(log.pose).all(axis=-1))
    used = readings.measured & posed[:, None]
    robot, sensor, first = readings.robot[used], np.nonzero(used)[1], readings.first_echo[used]
    return FacingReadings(
        transform_points(robot, sensors.position[sensor]),
        sensors.heading[sensor] + robot[:, 2],
        SETTINGS.free.certain * sensors.half_width[sensor],
        np.where(np.isfinite(first), first, SETTINGS.free.reach * ring.max_range),
        log.pose[posed, :2],
        ring.max_range,
    )


def _checked(walls: Float[np.ndarray, "walls 2 2"]) -> Float[np.ndarray, "walls 2 2"]:
    limit = SETTINGS.max_wall_coordinate
    bad = ~(np.abs(walls) <= limit).all(axis=(1, 2))
    if bad.any():
        k = int(np.argmax(bad))
        raise SonarError(f"grid: wall {k} is {walls[k].tolist()}; allowed are finite coordinates up to {limit:g} m")
    return walls
