"""Laser scans that come with recordings: what maps from echoes are held against (paper, section 4)."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from .datasets import Table, corridor8_poses, text_lines


@dataclass(frozen=True, eq=False)
class LaserRecording:
    """Scans of a laser range finder and where the robot was."""

    stamp: Float[np.ndarray, " scans"]
    """Seconds."""
    pose: Float[np.ndarray, "scans 3"]
    """world_from_robot: x, y (m), theta (rad, [-pi, pi)) from odometry; NaN where there is none."""
    ranges: Float[np.ndarray, "scans beams"]
    """Metres from the laser; NaN where nothing came back."""
    bearing: Float[np.ndarray, " beams"]
    """Direction of each beam in the laser's frame, radians, counter-clockwise, ascending."""
    mount: Float[np.ndarray, "3"]
    """robot_from_laser: x, y (m), yaw (rad)."""


def read_corridor8_laser(path: str | os.PathLike[str]) -> LaserRecording:
    """The laser of corridor8: ``laser.txt`` and ``poses.txt``, a line a scan, no headers.

    Beam i of 361 looks to -90 + 0.5 i deg. 81910 mm is no return; above 60000 and below 60 mm are none, either. The
    laser sits 0.109 m in front of the robot's origin (+- 0.04 m), turned by -0.4 deg: fitted, no document gives it.

    Args:
        path: the folder with both files, or its ``laser.txt``.

    Raises:
        SonarError: a file is missing, a row is malformed, or the two files do not agree.
    """
    file = Path(path) / "laser.txt" if Path(path).is_dir() else Path(path)
    beams = [f"range {k}" for k in range(361)]
    table = Table(file, text_lines(file), ("t_ms", *beams), separator=None)
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
