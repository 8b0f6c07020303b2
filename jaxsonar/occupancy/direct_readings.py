"""Direct paths of a ring: where its sensors are, what each scan measured, and the cells under the robot."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, QhullError

from jaxsonar.geometry.se2 import compose, rotation, transform_points
from jaxsonar.occupancy.settings import SETTINGS
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


class TransducerArrays(NamedTuple):
    """The direct paths of a ring as NumPy arrays, and the outline of the robot."""

    position: Float[np.ndarray, "sensors 2"]
    """Robot frame, metres."""
    heading: Float[np.ndarray, " sensors"]
    """Robot frame, radians."""
    half_width: Float[np.ndarray, " sensors"]
    """Half of each cone, radians."""
    max_range: float
    """Maximum range, metres."""
    max_distance: float
    """Largest distance from the robot's origin at which a cell can be observed, metres."""
    outline: Float[np.ndarray, "edges 3"]
    """Convex hull of the sensors: (a, b, c) with a x + b y + c <= 0 inside. No edges if it encloses no area."""

    @classmethod
    def of(cls, ring: Ring) -> "TransducerArrays":
        """The arrays of a ring."""
        position, half_width = np.asarray(ring.position), np.minimum(np.asarray(ring.beam) / 2, np.pi / 2)
        try:
            outline = ConvexHull(position).equations
        except (QhullError, ValueError):  # sensors on a line, or fewer than three sensors
            outline = np.zeros((0, 3))
        max_distance = float(np.linalg.norm(position, axis=-1).max()) + ring.max_range
        return cls(position, np.asarray(ring.heading), half_width, ring.max_range, max_distance, outline)


class DirectReadings(NamedTuple):
    """What the direct paths of a ring measured in the scans of a log."""

    measured: Bool[np.ndarray, "scans sensors"]
    """Which sensors fired and listened."""
    first_echo: Float[np.ndarray, "scans sensors"]
    """Range of the first echo of each sensor, metres; inf without an echo within the maximum range."""
    robot: Float[np.ndarray, "scans sensors 3"]
    """world_from_robot when each sensor fired: x, y (m), theta (rad). May be a broadcast array."""

    @classmethod
    def of(cls, ring: Ring, log: Log) -> "DirectReadings":
        """The readings of a log.

        Raises:
            SonarError: the log contains a sensor index that the ring does not have.
        """
        flat, _ = FlatEchoes.from_log(ring, log)
        sensors = np.arange(ring.count)
        direct = ring.path_index[sensors, sensors]
        echo = np.flatnonzero(np.isin(flat.path, direct))
        sensor = ring.paths[flat.path[echo], 0]
        corrected = np.asarray(ring.corrected(flat.reported[echo], sensor, sensor))
        first = np.full((len(log), ring.count), np.inf)
        np.minimum.at(first, (flat.scan[echo], sensor), np.where(corrected < ring.max_range, corrected, np.inf))
        measured = np.ones(first.shape, bool) if flat.measured is None else flat.measured[:, direct]
        robot = np.broadcast_to(log.pose[:, None], (*first.shape, 3))
        if flat.path_pose is not None:
            robot = compose(robot, flat.path_pose[:, direct])
        return cls(measured, first, robot)

    def quiet_range(self, max_range: float) -> Float[np.ndarray, "scans sensors"]:
        """Range up to which each sensor heard nothing, metres: its first echo, or most of the maximum range."""
        return np.where(np.isfinite(self.first_echo), self.first_echo, SETTINGS.free.reach * max_range)


def footprint_cells(
    sensors: TransducerArrays, pose: Float[np.ndarray, " 3"], resolution: float
) -> Int[np.ndarray, "cells 2"]:
    """Cells (column, row) of the world under the robot.

    These are the cells inside the outline of the sensors; if there is none, the cells of the sensors.
    """
    if len(sensors.outline):
        half = int(np.ceil(np.linalg.norm(sensors.position, axis=-1).max() / resolution)) + 1
        around = np.stack(np.meshgrid(*[np.arange(-half, half + 1)] * 2), axis=-1).reshape(-1, 2)
        cells = np.floor(pose[:2] / resolution).astype(int) + around
        p_robot = ((cells + 0.5) * resolution - pose[:2]) @ rotation(pose[2])
        cells = cells[(p_robot @ sensors.outline[:, :2].T + sensors.outline[:, 2] <= 0).all(axis=1)]
        if len(cells):
            return cells
    return np.unique(np.floor(transform_points(pose, sensors.position) / resolution).astype(int), axis=0)


def certain_angle(
    off_axis: Float[np.ndarray, " edges"], expected: Int[np.ndarray, " bins"], heard: Int[np.ndarray, " bins"]
) -> float | None:
    """Angle off the axis up to which walls are heard for sure, by the detections of a calibration, radians.

    None if too few walls were expected near the axis, or they were not heard.

    Args:
        off_axis: edges of bins of the angle between the axis and the normal of a wall, ascending from 0, radians.
        expected: number of readings with a wall in each bin.
        heard: number of those that heard it.
    """
    free = SETTINGS.free
    sure = (expected >= free.min_expected) & (heard >= free.min_detection * expected)
    count = int(np.argmin(np.append(sure, False)))
    return float(off_axis[count]) if count else None
