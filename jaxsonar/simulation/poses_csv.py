"""Trajectories for the simulator: poses in CSV files."""

import os

import numpy as np
from jaxtyping import Float

from jaxsonar.fileio.atomic_files import atomic_write
from jaxsonar.simulation.csv_columns import load_columns
from jaxsonar.simulation.simulator import SCAN_PERIOD


def save_poses(
    poses: Float[np.ndarray, "poses 3"], stamps: Float[np.ndarray, " poses"], filename: str | os.PathLike[str]
) -> None:
    """Write poses and stamps so that ``load_poses`` restores them exactly."""
    with atomic_write(filename) as file:
        file.write("stamp,x,y,theta\n")
        for stamp, pose in zip(stamps.tolist(), poses.tolist(), strict=True):
            file.write(",".join(map(repr, (stamp, *pose))) + "\n")


def load_poses(
    filename: str | os.PathLike[str],
) -> tuple[Float[np.ndarray, "poses 3"], Float[np.ndarray, " poses"]]:
    """Load poses and stamps from CSV with the columns x, y (metres), theta (radians) and optionally stamp (seconds).

    Args:
        filename: the file; its first row contains the column names, in any order.

    Returns:
        poses: world_from_robot (x, y, theta).
        stamps: seconds; 0.1 s apart if the file has no such column.

    Raises:
        SonarError: no such file, no pose, other columns, or an invalid value; the message names row and column.
    """
    column_of = load_columns(filename, what="poses", entry="pose", required=("x", "y", "theta"), optional=("stamp",))
    poses = np.stack([column_of["x"], column_of["y"], column_of["theta"]], axis=-1)
    return poses, column_of.get("stamp", np.arange(len(poses)) * SCAN_PERIOD)
