"""SLAM on a recorded run with a laser: thickness of the walls in the laser points, and errors of the sonar map.

Run ``python -m benchmarks.slam.laser_reference FOLDER``; FOLDER holds a recording in the format of corridor8:
``measurement.txt``, ``laser.txt``, ``poses.txt``. The true poses are unknown. The laser serves as reference: with good
poses, the laser points of a wall seen from everywhere form a thin line. The table shows the two lines with the most
points, and the errors of the sonar map against the walls of the laser (``reference_map``), at the poses of the odometry
and at those of ``slam``.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from jaxsonar import Log, Ring, build_map, evaluate, load_ring, slam
from jaxsonar.evaluation.laser_reference_map import laser_points, reference_map
from jaxsonar.hardware.laser_datasets import LaserRecording, read_corridor8_laser
from jaxsonar.recordings.input_options import InputOptions
from jaxsonar.recordings.load_log import load_log

NEAR = 0.15
"""Maximum distance of a laser point from its line, metres."""
WALLS = 2
"""Number of lines, those with the most points: the two sides of a corridor."""
_LINE_DISTANCE, _THETA_STEP, _RHO_STEP, _SUBSAMPLE = (
    0.3,
    np.radians(0.25),
    0.02,
    7,
)  # m between lines; rad, m of the votes; returns, one in
WINDOW = 1.5
"""Length of the trajectory in one local model, metres; one scan has too few echoes."""


@dataclass(frozen=True)
class PoseMeasures:
    """Measures of one set of poses."""

    thickness: Float[np.ndarray, " walls"]
    """RMS distance of the laser points from their line, metres."""
    points: tuple[int, ...]
    """Number of laser points near each line."""
    distance: float
    """RMS distance of the walls of the sonar map from those of the laser, metres."""
    angle: float
    """RMS difference of their directions, radians."""
    recall: float
    """Share of the length of the laser's walls that the map has."""


def measures_at(ring: Ring, log: Log, laser: LaserRecording, poses: Float[np.ndarray, "scans 3"]) -> PoseMeasures:
    """Measures of laser and sonar at these poses of the scans."""
    row = np.clip(np.searchsorted(log.stamp, laser.stamp), 0, len(log) - 1)
    with_pose = (log.stamp[row] == laser.stamp) & np.isfinite(poses[row]).all(axis=1)
    laser_at_poses = replace(
        laser, stamp=laser.stamp[with_pose], pose=poses[row][with_pose], ranges=laser.ranges[with_pose]
    )
    walls = reference_map(laser_at_poses)
    thickness = thicknesses(laser_points(laser_at_poses))
    at = replace(log, pose=poses)
    result = evaluate(np.array(build_map(ring, at, window=WINDOW).segments), walls)
    return PoseMeasures(
        thickness=np.array([rms for rms, _ in thickness]),
        points=tuple(count for _, count in thickness),
        distance=float(np.sqrt(np.mean(result.distance**2))),
        angle=float(np.sqrt(np.mean(result.angle**2))),
        recall=result.recall_length,
    )


def thicknesses(points: Float[np.ndarray, "points 2"]) -> list[tuple[float, int]]:
    """RMS distance (metres) and number of the points near each of the lines with the most points."""
    center, thickness_and_count = points.mean(axis=0), []
    points = points - center
    theta = np.arange(0.0, np.pi, _THETA_STEP)
    for _ in range(WALLS):
        sample = points[::_SUBSAMPLE]
        cells = np.round(sample @ np.stack([np.cos(theta), np.sin(theta)]) / _RHO_STEP).astype(np.int64)
        cells -= cells.min()
        votes = np.bincount((cells + np.arange(len(theta)) * (cells.max() + 1)).ravel())
        best, cell = divmod(int(votes.argmax()), int(cells.max()) + 1)
        near = sample[cells[:, best] == cell]
        for gate in (2 * NEAR, NEAR, NEAR, NEAR):
            middle = near.mean(axis=0)
            normal = np.linalg.svd(near - middle, full_matrices=False)[2][1]
            distance = (points - middle) @ normal
            near = points[np.abs(distance) < gate]
        thickness_and_count.append((float(np.sqrt(np.mean(distance[np.abs(distance) < NEAR] ** 2))), len(near)))
        points = points[np.abs(distance) > _LINE_DISTANCE]
    return sorted(thickness_and_count, key=lambda row_values: -row_values[1])


def main() -> None:
    """Measure and print."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("folder", type=Path, help="a recording in the format of corridor8")
    options.add_argument("--ring", default="corridor8", help="its ring (default: corridor8)")
    options = options.parse_args()
    ring, log = load_ring(options.ring), load_log(options.folder, options=InputOptions(format="corridor8"))
    laser = read_corridor8_laser(options.folder)
    stderr = Console(stderr=True)
    stderr.print(f"{len(log)} scans; slam takes minutes", highlight=False)
    result = slam(ring, log, window=WINDOW)
    caption = f"thickness: RMS of the laser points within {NEAR:g} m of the {WALLS} lines with the most points; "
    caption += "map: RMS distance and direction from the walls of the laser; recall: share of these that the map has"
    shown = Table(caption=caption)
    for heading in ("poses", "thickness (mm)", "points", "map (mm)", "(deg)", "recall"):
        shown.add_column(heading, justify="left" if heading == "poses" else "right")
    for name, poses in (("odometry", np.asarray(log.pose)), ("slam", result.poses)):
        row_values = measures_at(ring, log, laser, poses)
        shown.add_row(
            name,
            " ".join(f"{1e3 * value:.1f}" for value in row_values.thickness),
            " ".join(map(str, row_values.points)),
            f"{1e3 * row_values.distance:.1f}",
            f"{np.degrees(row_values.angle):.2f}",
            f"{row_values.recall:.2f}",
        )
    Console().print(shown)


if __name__ == "__main__":
    main()
