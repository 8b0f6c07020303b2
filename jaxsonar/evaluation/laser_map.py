"""The reference of a whole run: walls from all laser scans along a robot's path, to hold its map against."""

import os
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.lib.stride_tricks import sliding_window_view

from jaxsonar.evaluation.laser_segments import PolygonalModel, check_scan, fitted, joined, lengths, split
from jaxsonar.evaluation.map_accuracy import evaluate
from jaxsonar.fileio.geojson import feature, write_features
from jaxsonar.floor_plans.room import cross
from jaxsonar.geometry.se2 import rotation, to_world, unit
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.laser_datasets import LaserRecording

_BIN = 0.05  # m; pitch of the cells that vote, and at which the profile of a wall is sampled
_BAND = 0.15  # m; what is nearer than this to a line is looked at together: a wall with its recesses
_FARTHEST = 1000.0  # m; the accumulator of one reference covers no more
_SIDE = 4  # cells on each side of a step that tell its height, and of a cell that tell how many scans saw it


def reference_map(
    laser: LaserRecording,
    *,
    reach: float = 3.5,
    max_deviation: float = 0.04,
    max_gap: float = 0.4,
    min_length: float = 0.3,
    min_scans: int = 8,
) -> Float[np.ndarray, "walls 2 2"]:
    """Walls along the path of a robot from all its laser scans, world frame of the odometry, metres.

    The line with the most returns near it is found by a Hough transform, and fitted to its profile: the median of the
    returns every 5 cm along the longest piece without a gap. Those returns are taken out, and the next line follows.
    What few scans saw, people for instance, is left out. Single returns suffice, because glass answers a laser only
    where the beam meets it square, a hand's breadth a scan. There is one segment a face; the robot's side is to the
    left of start -> end. The longest comes first.

    Args:
        laser: the scans with the poses at which they were taken.
        reach: returns farther than this from the robot are left out, metres: what remains was near and visible.
        max_deviation: how far a return may be from its wall, metres; odometry bends walls a little.
        max_gap: gaps up to this many metres are bridged; a door is wider.
        min_length: metres that a wall needs.
        min_scans: scans that every stretch of 0.45 m of a wall needs.

    Raises:
        SonarError: scans that are none, or a scan without a pose.
    """
    points, facing, scan = _near_returns(laser, reach)
    if not len(points):
        return np.zeros((0, 2, 2))
    origin = np.round(np.median(points, axis=0) / _FARTHEST) * _FARTHEST  # near enough, wherever the world's is
    points = points - origin
    extent = float(np.abs(points).max())
    if extent > 2 * _FARTHEST or np.abs(origin).max() > 1e8:
        x, y = origin
        allowed = f"allowed are {_FARTHEST:g} m for one reference, not beyond 1e8 m"
        raise SonarError(f"poses up to {extent:.3g} m from ({x:.3g}, {y:.3g}) came; {allowed}")
    walls: list[np.ndarray] = []
    while (line := _strongest(points, facing, min_length)) is not None:
        more, done = _walls_on(line, points, facing, scan, max_deviation, max_gap, min_length, min_scans)
        walls += more
        points, facing, scan = points[~done], facing[~done], scan[~done]
    found = np.array(walls).reshape(-1, 2, 2)
    found = _once(found[np.argsort(-lengths(found), kind="stable")])
    before, after = np.indices((len(found), len(found))).reshape(2, -1)
    return joined(found, before, after)[0] + origin


def laser_points(laser: LaserRecording, *, reach: float = 8.0, every: int = 1) -> Float[np.ndarray, "points 2"]:
    """Where the laser saw something, world frame of the odometry, metres.

    Args:
        laser: scans with poses.
        reach: returns farther than this from the robot are left out, metres.
        every: take one scan in so many.
    """
    some = slice(None, None, every)
    thinned = replace(laser, stamp=laser.stamp[some], pose=laser.pose[some], ranges=laser.ranges[some])
    return _near_returns(thinned, reach)[0]


def save_reference(walls: Float[np.ndarray, "walls 2 2"] | PolygonalModel, path: str | os.PathLike[str]) -> None:
    """Write walls, or the model of a scan, as GeoJSON in metres; ``-`` is standard output.

    Walls are LineStrings of kind "reference", pseudo segments of kind "pseudo"; intersections are Points of kind
    "intersection".

    Raises:
        SonarError: the file cannot be written.
    """
    model = walls if isinstance(walls, PolygonalModel) else PolygonalModel(walls)
    features = [feature("LineString", ends, kind="reference") for ends in model.segments.tolist()]
    features += [feature("LineString", ends, kind="pseudo") for ends in model.pseudo.tolist()]
    features += [feature("Point", point, kind="intersection") for point in model.intersections.tolist()]
    write_features(features, path)


def _near_returns(
    laser: LaserRecording, reach: float
) -> tuple[Float[np.ndarray, "returns 2"], Float[np.ndarray, "returns 2"], Int[np.ndarray, " returns"]]:
    """Returns within reach of the robot in the world, unit vectors from there to the laser, and their scans."""
    check_scan(laser.bearing, laser.ranges)
    if not np.isfinite(laser.pose).all():
        raise SonarError("laser: a scan without a pose came; allowed are finite poses (x, y, theta)")
    beam = unit(laser.bearing)
    p_robot = to_world(laser.mount, laser.ranges[..., None] * beam)
    scan, index = np.nonzero(np.linalg.norm(p_robot, axis=-1) <= reach)  # NaN is not
    turn = unit(laser.pose[:, 2])[scan]
    turn = np.stack([turn, turn[:, ::-1] * [-1, 1]], axis=-1)  # world_from_robot
    points = (turn @ p_robot[scan, index, :, None])[..., 0] + laser.pose[scan, :2]
    facing = -(turn @ (beam[index] @ rotation(float(laser.mount[2])).T)[..., None])[..., 0]
    return points, facing, scan


def _strongest(
    points: Float[np.ndarray, "returns 2"], facing: Float[np.ndarray, "returns 2"], min_length: float
) -> Float[np.ndarray, "2"] | None:
    """The line (theta of the normal towards the robot, rho) on which most cells of the plane lie; None: too few."""
    cells, cell = np.unique(np.floor(points / _BIN).astype(np.int64), axis=0, return_inverse=True)
    count = np.bincount(cell.ravel(), minlength=len(cells))[:, None]
    mean = [np.stack([np.bincount(cell.ravel(), v) for v in xy.T], axis=-1) / count for xy in (points, facing)]
    theta = np.radians(np.arange(360.0))
    normal = unit(theta)
    rho = np.floor(mean[0] @ normal.T / _BIN).astype(np.int64)
    low, seen = rho.min(initial=0), mean[1] @ normal.T > 0
    size = int(rho.max(initial=0) - low) + 2
    votes = np.bincount((rho - low + size * np.arange(360))[seen], minlength=360 * size).reshape(360, size)
    votes[:, :-1] += votes[:, 1:]  # a wall on the border of two rows
    best = np.unravel_index(votes.argmax(), votes.shape)
    return None if votes[best] * _BIN < min_length else np.array([theta[best[0]], (best[1] + 1 + low) * _BIN])


def _walls_on(
    line: Float[np.ndarray, "2"],
    points: Float[np.ndarray, "returns 2"],
    facing: Float[np.ndarray, "returns 2"],
    scan: Int[np.ndarray, " returns"],
    max_deviation: float,
    max_gap: float,
    min_length: float,
    min_scans: int,
) -> tuple[list[Float[np.ndarray, "2 2"]], Bool[np.ndarray, " returns"]]:
    """The walls of the longest piece along a line, recesses told apart, and which returns are done with."""
    normal = unit(float(line[0]))
    tangent = np.array([normal[1], -normal[0]])
    near = np.flatnonzero((np.abs(points @ normal - line[1]) <= _BAND) & (facing @ normal > 0))
    position = points[near] @ tangent
    cell = np.floor(position / _BIN).astype(np.int64)
    cell -= cell.min(initial=0)
    run = _longest(_supported(cell, scan[near], min_scans), int(max_gap / _BIN))
    profile = np.array([np.median(points[near[cell == k]], axis=0) for k in run]).reshape(-1, 2)
    done = np.zeros(len(points), dtype=bool)
    steps = _steps(profile @ normal, max_deviation)
    walls = []
    for a, b in zip([0, *steps.tolist()], [*steps.tolist(), len(run)], strict=True):
        for i, j in split(profile, a, b, max_deviation) if b - a > 2 else []:
            if j - i < 3:
                continue
            inside = (cell >= run[i]) & (cell <= run[j - 1])
            here, at = near[inside], cell[inside]
            start, end = fitted(profile[i:j])
            for _ in range(2):
                along = (end - start) / np.hypot(*(end - start))
                close = np.abs(cross(along, points[here] - start)) <= 1.5 * max_deviation
                if len(np.unique(at[close])) < 3:
                    break
                start, end = fitted(_profile(points[here[close]], at[close]))
            along = (end - start) / np.hypot(*(end - start))
            of_wall = here[np.abs(cross(along, points[here] - start)) <= 1.5 * max_deviation]
            share = (points[of_wall] - start) @ along
            if len(share) and np.ptp(share) >= min_length:
                walls.append(start + np.array([[share.min()], [share.max()]]) * along)
                done[of_wall] = True
    if not walls:
        # What voted for the line must not do so again.
        done[near[np.isin(cell, run)] if len(run) else near] = True
    return walls, done


def _profile(points: Float[np.ndarray, "returns 2"], cell: Int[np.ndarray, " returns"]) -> Float[np.ndarray, "cells 2"]:
    """The median of the returns in every cell; of a long wall without the ends, where its neighbors' returns are."""
    cells = np.unique(cell)
    cells = cells[1:-1] if len(cells) > 4 else cells
    return np.array([np.median(points[cell == k], axis=0) for k in cells])


def _supported(
    cell: Int[np.ndarray, " returns"], scan: Int[np.ndarray, " returns"], min_scans: int
) -> Int[np.ndarray, " cells"]:
    """Cells with a return, around which enough scans saw something: within four cells on both sides."""
    if not len(cell):
        return np.zeros(0, dtype=np.int64)
    seen = np.zeros((cell.max() + 1 + 2 * _SIDE, scan.max() + 1), dtype=bool)
    seen[cell + _SIDE, scan] = True
    around = sliding_window_view(seen, 2 * _SIDE + 1, axis=0).any(axis=-1).sum(axis=1)
    return np.flatnonzero(seen[_SIDE:-_SIDE].any(axis=1) & (around >= min_scans))


def _longest(cells: Int[np.ndarray, " cells"], gap: int) -> Int[np.ndarray, " run"]:
    """The longest run of ascending cells without a gap of more than so many."""
    runs = np.split(cells, np.flatnonzero(np.diff(cells) > gap) + 1)
    return max(runs, key=len)


def _steps(across: Float[np.ndarray, " cells"], least: float) -> Int[np.ndarray, " steps"]:
    """Where a profile steps by ``least`` metres or more: a line through both sides would be neither."""
    if len(across) < 2 * _SIDE:
        return np.zeros(0, dtype=np.int64)
    mean = np.convolve(across, np.full(_SIDE, 1 / _SIDE), mode="valid")
    step = np.abs(mean[_SIDE:] - mean[:-_SIDE])
    highest = np.max(sliding_window_view(np.pad(step, _SIDE), 2 * _SIDE + 1), axis=1)
    return np.flatnonzero((step >= least) & (step == highest)) + _SIDE


def _once(walls: Float[np.ndarray, "walls 2 2"]) -> Float[np.ndarray, "kept 2 2"]:
    """Without walls that mostly lie beside an earlier one: the same face, seen again after the odometry drifted."""
    kept: list[int] = []
    along = walls[:, 1] - walls[:, 0]
    for index in range(len(walls)):
        same_face = walls[[k for k in kept if along[k] @ along[index] > 0]]
        if not evaluate(walls[index : index + 1], same_face).precision_length >= 0.5:
            kept.append(index)
    return walls[kept]
