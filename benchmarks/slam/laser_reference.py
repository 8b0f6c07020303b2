"""SLAM on a recorded run with a laser: how thick the laser draws the walls, and how far the map is from them.

Run ``python -m benchmarks.slam.laser_reference FOLDER``; FOLDER holds a recording as corridor8 is: ``measurement.txt``,
``laser.txt``, ``poses.txt``. Nobody surveyed the place, so the laser is the judge: drawn at good poses, what it saw of
one wall from everywhere is thin. Told are the two lines with the most returns, and how far the sonar map is from the
walls that the laser has (``reference_map``), at the poses of the odometry and at those of ``slam``.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from jaxsonar import Log, Ring, build_map, evaluate, load_ring, slam
from jaxsonar.evaluation.laser_map import laser_points, reference_map
from jaxsonar.hardware.laser_datasets import LaserRecording, read_corridor8_laser
from jaxsonar.scans.convert import read_scans

NEAR = 0.15
"""Metres from a wall's line up to which a return is of it."""
WALLS = 2
"""Lines with the most returns that are judged: the sides of a corridor."""
_APART, _TURN, _CELL, _EVERY = 0.3, np.radians(0.25), 0.02, 7  # m between lines; rad, m of the votes; returns, one in
WINDOW = 1.5
"""Metres of path of a local model, for so few sonars."""


@dataclass(frozen=True)
class Judged:
    """One set of poses."""

    thickness: Float[np.ndarray, " walls"]
    """RMS distance of the returns from the line through them, metres."""
    returns: tuple[int, ...]
    """How many there are near each."""
    distance: float
    """RMS distance of the sonar map's walls from the laser's, metres."""
    angle: float
    """The same in direction, radians."""
    recall: float
    """Share of the laser's walls (by length) that the map has."""


def judged(ring: Ring, log: Log, laser: LaserRecording, poses: Float[np.ndarray, "scans 3"]) -> Judged:
    """Laser and sonar at these poses of the log's scans."""
    row = np.clip(np.searchsorted(log.stamp, laser.stamp), 0, len(log) - 1)
    known = (log.stamp[row] == laser.stamp) & np.isfinite(poses[row]).all(axis=1)
    drawn = replace(laser, stamp=laser.stamp[known], pose=poses[row][known], ranges=laser.ranges[known])
    walls = reference_map(drawn)
    thick = thicknesses(laser_points(drawn))
    at = replace(log, pose=poses)
    found = evaluate(np.array(build_map(ring, at, window=WINDOW).segments), walls)
    return Judged(
        thickness=np.array([rms for rms, _ in thick]),
        returns=tuple(count for _, count in thick),
        distance=float(np.sqrt(np.mean(found.distance**2))),
        angle=float(np.sqrt(np.mean(found.angle**2))),
        recall=found.recall_length,
    )


def thicknesses(points: Float[np.ndarray, "points 2"]) -> list[tuple[float, int]]:
    """RMS distance of returns from the lines with the most of them, metres, and how many are near each."""
    centre, out = points.mean(axis=0), []
    points = points - centre
    theta = np.arange(0.0, np.pi, _TURN)
    for _ in range(WALLS):
        some = points[::_EVERY]
        cells = np.round(some @ np.stack([np.cos(theta), np.sin(theta)]) / _CELL).astype(np.int64)
        cells -= cells.min()
        votes = np.bincount((cells + np.arange(len(theta)) * (cells.max() + 1)).ravel())
        best, cell = divmod(int(votes.argmax()), int(cells.max()) + 1)
        near = some[cells[:, best] == cell]
        for within in (2 * NEAR, NEAR, NEAR, NEAR):
            middle = near.mean(axis=0)
            normal = np.linalg.svd(near - middle, full_matrices=False)[2][1]
            off = (points - middle) @ normal
            near = points[np.abs(off) < within]
        out.append((float(np.sqrt(np.mean(off[np.abs(off) < NEAR] ** 2))), len(near)))
        points = points[np.abs(off) > _APART]
    return sorted(out, key=lambda one: -one[1])


def main() -> None:
    """Measure, print."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("folder", type=Path, help="a recording as corridor8 is")
    options.add_argument("--ring", default="corridor8", help="its ring; corridor8 if left out")
    options = options.parse_args()
    ring, log = load_ring(options.ring), read_scans(options.folder, from_="corridor8")
    laser = read_corridor8_laser(options.folder)
    stderr = Console(stderr=True)
    stderr.print(f"{len(log)} scans; slam takes minutes", highlight=False)
    found = slam(ring, log, window=WINDOW)
    caption = f"thickness: RMS of the laser's returns within {NEAR:g} m about the {WALLS} lines with the most of them; "
    caption += "map: RMS distance and direction from the laser's walls, and share of these that it has"
    shown = Table(caption=caption)
    for heading in ("poses", "thickness mm", "returns", "map mm", "deg", "recall"):
        shown.add_column(heading, justify="left" if heading == "poses" else "right")
    for name, poses in (("odometry", np.asarray(log.pose)), ("slam", found.poses)):
        one = judged(ring, log, laser, poses)
        shown.add_row(
            name,
            " ".join(f"{1e3 * value:.1f}" for value in one.thickness),
            " ".join(map(str, one.returns)),
            f"{1e3 * one.distance:.1f}",
            f"{np.degrees(one.angle):.2f}",
            f"{one.recall:.2f}",
        )
    Console().print(shown)


if __name__ == "__main__":
    main()
