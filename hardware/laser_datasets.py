"""Readers of the laser scans in published data sets. Sonar maps are compared with them (paper, section 4)."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from .datasets import NumericTable, corridor8_poses, text_lines


@dataclass(frozen=True, eq=False)
class LaserRecording:
    """Scans of a laser range finder, with poses of the robot."""

    stamp: Float[np.ndarray, " scans"]
    """Seconds."""
    pose: Float[np.ndarray, "scans 3"]
    """world_from_robot: x, y (m), theta (rad, [-pi, pi)) from odometry; NaN if unknown."""
    ranges: Float[np.ndarray, "scans beams"]
    """Metres from the laser; NaN without a return."""
    bearing: Float[np.ndarray, " beams"]
    """Direction of each beam in the laser frame, radians, counter-clockwise, ascending."""
    mount: Float[np.ndarray, "3"]
    """robot_from_laser: x, y (m), yaw (rad)."""


def read_corridor8_laser(filename: str | os.PathLike[str]) -> LaserRecording:
    """Read the laser of corridor8: ``laser.txt`` and ``poses.txt``, one line per scan, no headers.

    Beam i of 361 points to -90 + 0.5 i deg. 81910 mm means no return; ranges above 60000 mm and below 60 mm are treated
    as no return, too. The mount (0.109 m +- 0.04 m in front of the robot's origin, yaw -0.4 deg) was fitted to the
    data; no document states it.

    Args:
        filename: the folder with both files, or its ``laser.txt``.

    Raises:
        SonarError: a missing file, a malformed row, or files that contradict each other.
    """
    file = Path(filename) / "laser.txt" if Path(filename).is_dir() else Path(filename)
    beams = [f"range {k}" for k in range(361)]
    table = NumericTable(file, text_lines(file), ("t_ms", *beams), separator=None)
    reported = table.number[:, 1:]
    table.refuse((reported < 0) | (reported > 81910), beams, "a range of 0 to 81910 mm, which is no return")
    stamp, pose = corridor8_poses(table)
    return LaserRecording(
        stamp=stamp,
        pose=pose,
        ranges=np.where((reported > 60000) | (reported < 60), np.nan, reported / 1000),
        bearing=np.radians(-90 + 0.5 * np.arange(361)),
        mount=np.array([0.109, 0.0, np.radians(-0.4)]),
    )
