"""The inverse sensor model: the evidence of the direct echoes of one scan for the grid cells around the robot."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, QhullError

from jaxsonar.geometry.se2 import rotation, transform_points, wrap_angle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.occupancy.settings import SETTINGS
from jaxsonar.occupancy.wall_visibility import WallMap, estimate_extensions, explained_by_walls, visible_range
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


def first_echoes(ring: Ring, log: Log) -> Float[np.ndarray, "scans sensors"]:
    """Range of the first direct echo of each sensor, metres; inf without an echo within the maximum range."""
    direct = log.tx == log.rx
    sensor, scan = log.tx[direct], log.echo_scan[direct]
    if sensor.max(initial=0) >= ring.count:
        raise SonarError(
            f"grid: echo of sensor {sensor.max()}; allowed are 0 to {ring.count - 1}, the sensors of {ring.name!r}"
        )
    corrected = np.asarray(ring.corrected(log.range[direct], sensor, sensor))
    first = np.full((len(log), ring.count), np.inf)
    np.minimum.at(first, (scan, sensor), np.where(corrected < ring.max_range, corrected, np.inf))
    return first


def inverse_sensor_model(
    sensors: TransducerArrays,
    pose: Float[np.ndarray, " 3"],
    first_echo: Float[np.ndarray, " sensors"],
    listening: Bool[np.ndarray, " sensors"],
    walls: WallMap,
    corner: Int[np.ndarray, " 2"],
    size: int,
) -> Int[np.ndarray, "5 size size"]:
    """Counts that one scan adds to the square of cells around the robot, one layer for each of ``LAYERS``.

    Args:
        sensors: the ring.
        pose: world_from_robot, metres and radians.
        first_echo: range of the first echo of each sensor, metres; inf for none.
        listening: which sensors were active.
        walls: the known walls around the robot.
        corner: first cell (column, row) of the square, in cells of the world.
        size: side of the square, cells.
    """
    resolution, max_range = walls.resolution, sensors.max_range
    position = transform_points(pose, sensors.position[listening])
    heading = sensors.heading[listening] + pose[2]
    half_width, first_echo = sensors.half_width[listening], first_echo[listening]
    explained = explained_by_walls(position, heading, half_width, first_echo, walls) | (first_echo <= 0)

    # Cells of each beam. An echo of a known wall is no evidence for the cells behind the wall, so the beam ends there.
    limit = np.where(explained, np.minimum(first_echo, max_range), max_range)
    polar, in_square = _polar_cells(max_range, resolution, size), position / resolution - corner
    width = half_width + SETTINGS.shadow
    beam, cell, distance, off_axis = _cells_in_beams(polar, in_square, heading, width, limit, size)
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
    counts = np.zeros((len(LAYERS), size, size), int)
    for layer, chosen in enumerate((free, occluded, arcs)):
        counts[layer] = np.bincount(cell[chosen], minlength=size**2).reshape(size, size)
    free_layer, _, _, wall_layer, footprint_layer = counts
    column, row = (walls.cells - corner).T
    free_layer[row, column] = 0
    wall_layer[row, column] = 1
    column, row = _footprint_cells(sensors, pose, corner, size, resolution).T
    footprint_layer[row, column] = 1
    return counts


class _PolarCells(NamedTuple):
    """The cells around a point, sorted by direction so that a cone is a slice.

    Each row belongs to one of 4 x 4 positions of the point within its own cell.
    """

    angle: np.ndarray  # (16, 2 cells) directions, radians, ascending over two turns
    distance: np.ndarray  # (16, 2 cells) metres
    cell: np.ndarray  # (16, 2 cells) flat index in a square with ``size`` columns, relative to the point's own cell


@lru_cache(maxsize=2)
def _polar_cells(max_range: float, resolution: float, size: int) -> _PolarCells:
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
    cell = (row * size + column)[order]
    return _PolarCells(
        np.concatenate([angle, angle + 2 * np.pi], axis=1), np.tile(distance, 2), np.tile(cell.astype(np.int64), 2)
    )


def _cells_in_beams(
    polar: _PolarCells,
    position: Float[np.ndarray, "beams 2"],
    heading: Float[np.ndarray, " beams"],
    half_width: Float[np.ndarray, " beams"],
    limit: Float[np.ndarray, " beams"],
    size: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Cells of each beam: (beam, cell of the square, distance in metres, angle off the axis in radians).

    Args:
        polar: cells around a point.
        position: of the sensors, in cells from the corner of the square; used to a quarter of a cell.
        heading: of the sensors, radians.
        half_width: of the beams, radians.
        limit: end of each beam, metres.
        size: side of the square, cells.
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
    return beam, polar.cell.ravel()[index] + (own @ (1, size)).astype(int)[beam], distance, off_axis


def _footprint_cells(
    sensors: TransducerArrays, pose: Float[np.ndarray, " 3"], corner: np.ndarray, size: int, resolution: float
) -> Int[np.ndarray, "cells 2"]:
    """Cells (column, row) under the robot, relative to ``corner``.

    These are the cells inside the outline of the sensors; if there is none, the cells of the sensors.
    """
    if len(sensors.outline):
        half = int(np.ceil(np.linalg.norm(sensors.position, axis=-1).max() / resolution)) + 1
        cells = np.stack(np.meshgrid(*[np.arange(size // 2 - half, size // 2 + half + 1)] * 2), axis=-1).reshape(-1, 2)
        p_robot = ((cells + corner + 0.5) * resolution - pose[:2]) @ rotation(pose[2])
        cells = cells[(p_robot @ sensors.outline[:, :2].T + sensors.outline[:, 2] <= 0).all(axis=1)]
        if len(cells):
            return cells
    return np.floor(transform_points(pose, sensors.position) / resolution).astype(int) - corner
