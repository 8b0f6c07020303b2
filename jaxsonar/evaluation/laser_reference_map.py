"""Reference maps: walls from all laser scans along a trajectory, to evaluate sonar maps."""

import os
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.lib.stride_tricks import sliding_window_view

from jaxsonar.evaluation.laser_polygonal_model import (
    PolygonalModel,
    check_laser_scan,
    fit_segment,
    join_at_corners,
    split_and_merge,
)
from jaxsonar.evaluation.map_accuracy import evaluate
from jaxsonar.evaluation.settings import SETTINGS
from jaxsonar.fileio.geojson import feature, write_features
from jaxsonar.geometry.se2 import rotation, transform_points, unit
from jaxsonar.geometry.segments import cross, lengths
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.laser_datasets import LaserRecording

_LASER = SETTINGS.laser


def reference_map(
    laser: LaserRecording,
    *,
    reach: float = 3.5,
    max_deviation: float = 0.04,
    max_gap: float = 0.4,
    min_length: float = 0.3,
    min_scans: int = 8,
) -> Float[np.ndarray, "walls 2 2"]:
    """Walls along the trajectory of a robot from all its laser scans, world frame of the odometry, metres.

    The line with most returns is found by a Hough transform, and fitted to its profile: the medians of the returns in
    cells of 5 cm along the longest part without a gap. Its returns are removed, and the next line follows. Parts that
    few scans saw, people for instance, are left out. Single returns suffice, because glass reflects a laser beam only
    at a right angle, over the width of a hand in each scan. Each face of a wall is a segment of its own; the robot's
    side is to the left of start -> end. The longest wall comes first.

    Args:
        laser: scans with the poses at which they were taken.
        reach: returns farther than this from the robot are left out, metres.
        max_deviation: largest distance of a return from its wall, metres; odometry bends walls slightly.
        max_gap: gaps up to this length are closed, metres; a door is wider.
        min_length: least length of a wall, metres.
        min_scans: number of scans that must have seen every part of 0.45 m of a wall.

    Raises:
        SonarError: invalid scans, or a scan without a pose.
    """
    points, facing, scan = _near_returns(laser, reach)
    if not len(points):
        return np.zeros((0, 2, 2))
    # A local origin avoids large numbers of cells far from the world's origin.
    limit = _LASER.max_extent
    origin = np.round(np.median(points, axis=0) / limit) * limit
    points = points - origin
    extent = float(np.abs(points).max())
    if extent > 2 * limit or np.abs(origin).max() > 1e8:
        x, y = origin
        allowed = f"allowed are {limit:g} m for one reference, not beyond 1e8 m"
        raise SonarError(f"poses up to {extent:.3g} m from ({x:.3g}, {y:.3g}) came; {allowed}")
    # Extract lines, strongest first, until none is left.
    walls: list[np.ndarray] = []
    while (line := _strongest_line(points, facing, min_length)) is not None:
        more, done = _walls_on_line(line, points, facing, scan, max_deviation, max_gap, min_length, min_scans)
        walls += more
        points, facing, scan = points[~done], facing[~done], scan[~done]
    # Remove faces that were found twice, and join the rest at corners.
    found = np.array(walls).reshape(-1, 2, 2)
    found = _without_duplicates(found[np.argsort(-lengths(found), kind="stable")])
    before, after = np.indices((len(found), len(found))).reshape(2, -1)
    return join_at_corners(found, before, after)[0] + origin


def laser_points(laser: LaserRecording, *, reach: float = 8.0, every: int = 1) -> Float[np.ndarray, "points 2"]:
    """Positions of laser returns, world frame of the odometry, metres.

    Args:
        laser: scans with poses.
        reach: returns farther than this from the robot are left out, metres.
        every: use every n-th scan only.
    """
    some = slice(None, None, every)
    thinned = replace(laser, stamp=laser.stamp[some], pose=laser.pose[some], ranges=laser.ranges[some])
    return _near_returns(thinned, reach)[0]


def save_reference(walls: Float[np.ndarray, "walls 2 2"] | PolygonalModel, filename: str | os.PathLike[str]) -> None:
    """Write walls, or the polygonal model of a scan, as GeoJSON in metres; ``-`` is standard output.

    Walls are LineStrings of kind "reference", pseudo segments of kind "pseudo"; intersections are Points of kind
    "intersection".

    Raises:
        SonarError: the file cannot be written.
    """
    model = walls if isinstance(walls, PolygonalModel) else PolygonalModel(walls)
    features = [feature("LineString", ends, kind="reference") for ends in model.segments.tolist()]
    features += [feature("LineString", ends, kind="pseudo") for ends in model.pseudo.tolist()]
    features += [feature("Point", point, kind="intersection") for point in model.intersections.tolist()]
    write_features(features, filename)


def _near_returns(
    laser: LaserRecording, reach: float
) -> tuple[Float[np.ndarray, "returns 2"], Float[np.ndarray, "returns 2"], Int[np.ndarray, " returns"]]:
    """Returns within reach of the robot in the world frame, unit vectors from them to the laser, and their scans."""
    check_laser_scan(laser.bearing, laser.ranges)
    if not np.isfinite(laser.pose).all():
        raise SonarError("laser: a scan without a pose came; allowed are finite poses (x, y, theta)")
    beam = unit(laser.bearing)
    p_robot = transform_points(laser.mount, laser.ranges[..., None] * beam)
    scan, index = np.nonzero(np.linalg.norm(p_robot, axis=-1) <= reach)  # False for NaN
    heading = unit(laser.pose[:, 2])[scan]
    world_from_robot = np.stack([heading, heading[:, ::-1] * [-1, 1]], axis=-1)
    points = (world_from_robot @ p_robot[scan, index, :, None])[..., 0] + laser.pose[scan, :2]
    facing = -(world_from_robot @ (beam[index] @ rotation(float(laser.mount[2])).T)[..., None])[..., 0]
    return points, facing, scan


def _strongest_line(
    points: Float[np.ndarray, "returns 2"], facing: Float[np.ndarray, "returns 2"], min_length: float
) -> Float[np.ndarray, "2"] | None:
    """The line through most occupied cells: (theta of the normal toward the robot, rho); None if there are too few.

    Cells vote, not returns, so that the votes measure the length of a wall.
    """
    cells, cell = np.unique(np.floor(points / _LASER.cell).astype(np.int64), axis=0, return_inverse=True)
    count = np.bincount(cell.ravel(), minlength=len(cells))[:, None]
    mean = [np.stack([np.bincount(cell.ravel(), v) for v in xy.T], axis=-1) / count for xy in (points, facing)]
    theta = np.radians(np.arange(360.0))
    normal = unit(theta)
    rho = np.floor(mean[0] @ normal.T / _LASER.cell).astype(np.int64)
    low, seen = rho.min(initial=0), mean[1] @ normal.T > 0
    size = int(rho.max(initial=0) - low) + 2
    votes = np.bincount((rho - low + size * np.arange(360))[seen], minlength=360 * size).reshape(360, size)
    votes[:, :-1] += votes[:, 1:]  # a wall may lie on the border of two cells of rho
    best = np.unravel_index(votes.argmax(), votes.shape)
    if votes[best] * _LASER.cell < min_length:
        return None
    return np.array([theta[best[0]], (best[1] + 1 + low) * _LASER.cell])


def _walls_on_line(
    line: Float[np.ndarray, "2"],
    points: Float[np.ndarray, "returns 2"],
    facing: Float[np.ndarray, "returns 2"],
    scan: Int[np.ndarray, " returns"],
    max_deviation: float,
    max_gap: float,
    min_length: float,
    min_scans: int,
) -> tuple[list[Float[np.ndarray, "2 2"]], Bool[np.ndarray, " returns"]]:
    """The walls on the longest part of a line, with recesses separated, and the returns that are used up."""
    # The longest run of cells along the line that enough scans saw.
    normal = unit(float(line[0]))
    tangent = np.array([normal[1], -normal[0]])
    near = np.flatnonzero((np.abs(points @ normal - line[1]) <= _LASER.band) & (facing @ normal > 0))
    along = points[near] @ tangent
    cell = np.floor(along / _LASER.cell).astype(np.int64)
    cell -= cell.min(initial=0)
    run = _longest_run(_supported_cells(cell, scan[near], min_scans), int(max_gap / _LASER.cell))
    # Split its profile at steps and bends.
    profile = np.array([np.median(points[near[cell == k]], axis=0) for k in run]).reshape(-1, 2)
    used = np.zeros(len(points), dtype=bool)
    steps = _steps(profile @ normal, max_deviation)
    walls = []
    for a, b in zip([0, *steps.tolist()], [*steps.tolist(), len(run)], strict=True):
        for i, j in split_and_merge(profile, a, b, max_deviation) if b - a > 2 else []:
            if j - i < 3:
                continue
            # Fit each part to its profile, twice with the returns near it.
            inside = (cell >= run[i]) & (cell <= run[j - 1])
            here, cell_here = near[inside], cell[inside]
            start, end = fit_segment(profile[i:j])
            for _ in range(2):
                direction = (end - start) / np.hypot(*(end - start))
                close = np.abs(cross(direction, points[here] - start)) <= 1.5 * max_deviation
                if len(np.unique(cell_here[close])) < 3:
                    break
                start, end = fit_segment(_median_profile(points[here[close]], cell_here[close]))
            direction = (end - start) / np.hypot(*(end - start))
            of_wall = here[np.abs(cross(direction, points[here] - start)) <= 1.5 * max_deviation]
            position = (points[of_wall] - start) @ direction
            if len(position) and np.ptp(position) >= min_length:
                walls.append(start + np.array([[position.min()], [position.max()]]) * direction)
                used[of_wall] = True
    if not walls:
        # Remove what voted for this line, or it would be found again.
        used[near[np.isin(cell, run)] if len(run) else near] = True
    return walls, used


def _median_profile(
    points: Float[np.ndarray, "returns 2"], cell: Int[np.ndarray, " returns"]
) -> Float[np.ndarray, "cells 2"]:
    """Median of the returns in each cell. A long wall's end cells are left out: they may contain its neighbor."""
    cells = np.unique(cell)
    cells = cells[1:-1] if len(cells) > 4 else cells
    return np.array([np.median(points[cell == k], axis=0) for k in cells])


def _supported_cells(
    cell: Int[np.ndarray, " returns"], scan: Int[np.ndarray, " returns"], min_scans: int
) -> Int[np.ndarray, " cells"]:
    """Cells with a return for which at least ``min_scans`` scans have returns within four cells on either side."""
    if not len(cell):
        return np.zeros(0, dtype=np.int64)
    side = _LASER.window_cells
    seen = np.zeros((cell.max() + 1 + 2 * side, scan.max() + 1), dtype=bool)
    seen[cell + side, scan] = True
    scans = sliding_window_view(seen, 2 * side + 1, axis=0).any(axis=-1).sum(axis=1)
    return np.flatnonzero(seen[side:-side].any(axis=1) & (scans >= min_scans))


def _longest_run(cells: Int[np.ndarray, " cells"], max_gap: int) -> Int[np.ndarray, " run"]:
    """The longest run of ascending cells without a step larger than ``max_gap``."""
    runs = np.split(cells, np.flatnonzero(np.diff(cells) > max_gap) + 1)
    return max(runs, key=len)


def _steps(offset: Float[np.ndarray, " cells"], min_height: float) -> Int[np.ndarray, " steps"]:
    """Cells at which a profile has a step of at least ``min_height`` metres. A line across a step would be wrong."""
    side = _LASER.window_cells
    if len(offset) < 2 * side:
        return np.zeros(0, dtype=np.int64)
    mean = np.convolve(offset, np.full(side, 1 / side), mode="valid")
    step = np.abs(mean[side:] - mean[:-side])
    highest = np.max(sliding_window_view(np.pad(step, side), 2 * side + 1), axis=1)
    return np.flatnonzero((step >= min_height) & (step == highest)) + side


def _without_duplicates(walls: Float[np.ndarray, "walls 2 2"]) -> Float[np.ndarray, "kept 2 2"]:
    """Walls without those that mostly lie beside an earlier one: the same face, seen again after odometry drifted."""
    kept: list[int] = []
    along = walls[:, 1] - walls[:, 0]
    for index in range(len(walls)):
        same_face = walls[[k for k in kept if along[k] @ along[index] > 0]]
        if not evaluate(walls[index : index + 1], same_face).precision_length >= 0.5:
            kept.append(index)
    return walls[kept]
