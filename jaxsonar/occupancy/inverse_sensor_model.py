"""The inverse sensor model: the evidence of the direct echoes of one scan for the grid cells around the robot."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, QhullError

from jaxsonar.geometry.se2 import compose, rotation, transform_points, wrap_angle
from jaxsonar.occupancy.settings import SETTINGS
from jaxsonar.occupancy.wall_visibility import WallMap, estimate_extensions, explained_by_walls, visible_range
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

LAYERS = ("free", "occluded", "arcs", "walls", "footprint")
"""What is counted for each cell; see the properties of ``OccupancyGrid``."""


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


class CellEvidence(NamedTuple):
    """Cells that one scan observed, as indices into a flat grid. A cell is repeated for each beam that observed it."""

    free: Int[np.ndarray, " free"]
    """A beam passed through."""
    occluded: Int[np.ndarray, " occluded"]
    """A beam ended in front of it."""
    arcs: Int[np.ndarray, " arcs"]
    """The arc of an unexplained echo crosses it."""
    arc_sensor: Int[np.ndarray, " arcs"]
    """The sensor that received this echo."""


def inverse_sensor_model(
    sensors: TransducerArrays,
    robot: Float[np.ndarray, "sensors 3"],
    first_echo: Float[np.ndarray, " sensors"],
    measured: Bool[np.ndarray, " sensors"],
    walls: WallMap,
    low: Int[np.ndarray, " 2"],
    columns: int,
) -> CellEvidence:
    """Cells that one scan observed.

    Args:
        sensors: the ring.
        robot: world_from_robot when each sensor fired, metres and radians.
        first_echo: range of the first echo of each sensor, metres; inf for none.
        measured: which sensors fired and listened.
        walls: the known walls around the robot.
        low: first cell (column, row) of the grid, in cells of the world.
        columns: number of columns of the grid.
    """
    resolution, max_range = walls.resolution, sensors.max_range
    sensor = np.flatnonzero(measured)
    position = transform_points(robot[sensor], sensors.position[sensor])
    heading = sensors.heading[sensor] + robot[sensor, 2]
    half_width, first_echo = sensors.half_width[sensor], first_echo[sensor]
    explained = explained_by_walls(position, heading, half_width, first_echo, walls) | (first_echo <= 0)

    # Cells of each beam. An echo of a known wall is no evidence for the cells behind the wall, so the beam ends there.
    limit = np.where(explained, np.minimum(first_echo, max_range), max_range)
    width = half_width + SETTINGS.shadow
    polar, in_grid = _polar_cells(max_range, resolution), position / resolution - low
    beam, cell, distance, off_axis = _cells_in_beams(polar, in_grid, heading, width, limit, columns)
    # A beam sees a cell only in front of the known walls, including their possible extensions.
    certain = SETTINGS.certain * half_width
    extension = estimate_extensions(position, heading, certain, np.minimum(first_echo, max_range), walls)
    visible_until = visible_range(position, heading, width, max_range, walls, extension)
    sectors = visible_until.shape[1]
    half_width, first_echo, certain = half_width[beam], first_echo[beam], certain[beam]
    visible = np.ones(len(beam), bool)
    if sectors:
        sector = ((off_axis / width[beam] + 1) * (sectors / 2)).astype(int)
        visible = distance < visible_until[beam, np.minimum(sector, sectors - 1)]
    off_axis, unexplained = np.abs(off_axis), visible & ~explained[beam]
    # Half the diagonal of a cell: the largest distance of a curve through a cell from the cell's center.
    tolerance = resolution / np.sqrt(2)
    # Cells that the inner cone touches count as free, so that no ring of unknown cells remains around the robot.
    touched = distance * np.sin(np.maximum(off_axis - certain, 0)) <= tolerance
    free = visible & touched & (distance < first_echo - tolerance - SETTINGS.range_margin)
    arcs = unexplained & (off_axis <= half_width) & (np.abs(distance - first_echo) <= tolerance)
    # Occluded cells lie beyond the tangent of the arc; outside of the cone, beyond the tangent at the arc's end.
    depth = distance * np.cos(np.maximum(off_axis - half_width, 0))
    occluded = unexplained & (depth > first_echo + tolerance)
    return CellEvidence(cell[free], cell[occluded], cell[arcs], sensor[beam[arcs]])


class _PolarCells(NamedTuple):
    """The cells around a point, sorted by direction so that a cone is a slice.

    Each row belongs to one of 4 x 4 positions of the point within its own cell.
    """

    angle: np.ndarray  # (16, 2 cells) directions, radians, ascending over two turns
    distance: np.ndarray  # (16, 2 cells) metres
    column: np.ndarray  # (16, 2 cells) relative to the point's own cell
    row: np.ndarray  # (16, 2 cells)


@lru_cache(maxsize=2)
def _polar_cells(max_range: float, resolution: float) -> _PolarCells:
    far = max_range / resolution + 1
    column, row = np.meshgrid(*[np.arange(-int(far), int(far) + 1)] * 2)
    inside = np.hypot(column, row) <= far
    column, row = column[inside], row[inside]
    quarter = np.arange(16)[:, None]
    dx = (column + 0.5 - (quarter % 4 + 0.5) / 4) * resolution
    dy = (row + 0.5 - (quarter // 4 + 0.5) / 4) * resolution
    angle = np.arctan2(dy, dx)
    order = np.argsort(angle, axis=1, kind="stable")
    angle, distance = (np.take_along_axis(values, order, axis=1) for values in (angle, np.hypot(dx, dy)))
    column, row = (np.tile(values.astype(np.int32)[order], 2) for values in (column, row))
    return _PolarCells(np.concatenate([angle, angle + 2 * np.pi], axis=1), np.tile(distance, 2), column, row)


def _cells_in_beams(
    polar: _PolarCells,
    position: Float[np.ndarray, "beams 2"],
    heading: Float[np.ndarray, " beams"],
    half_width: Float[np.ndarray, " beams"],
    limit: Float[np.ndarray, " beams"],
    columns: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Cells of each beam: (beam, cell of the grid, distance in metres, angle off the axis in radians).

    Args:
        polar: cells around a point.
        position: of the sensors, in cells from the first cell of the grid; used to a quarter of a cell.
        heading: of the sensors, radians.
        half_width: of the beams, radians.
        limit: end of each beam, metres.
        columns: number of columns of the grid.
    """
    own = np.floor(position)
    quarter = np.floor((position - own) * 4).astype(int)
    quarter = quarter[:, 1] * 4 + quarter[:, 0]
    begin = wrap_angle(heading - half_width)
    end = begin + 2 * half_width
    slices = [np.searchsorted(polar.angle[k], (a, b)) for k, a, b in zip(quarter, begin, end, strict=True)]
    first, last = np.array(slices, dtype=int).reshape(-1, 2).T
    beam = np.repeat(np.arange(len(quarter)), last - first)
    before = np.cumsum(last - first) - (last - first)
    index = np.arange(len(beam)) + (quarter * polar.angle.shape[1] + first - before)[beam]
    distance = polar.distance.ravel()[index]
    near = distance <= limit[beam]
    beam, index, distance = beam[near], index[near], distance[near]
    off_axis = polar.angle.ravel()[index] - (begin + half_width)[beam]
    own = (own @ (1, columns)).astype(int)
    cell = polar.row.ravel()[index] * columns + polar.column.ravel()[index] + own[beam]
    return beam, cell, distance, off_axis


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
