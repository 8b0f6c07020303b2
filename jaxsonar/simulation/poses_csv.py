"""Trajectories for the simulator: poses in CSV files."""

import os
import re

import numpy as np
from jaxtyping import Float

from jaxsonar.fileio.atomic_files import DECIMAL, atomic_write, read_bytes, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.simulation.simulator import SCAN_PERIOD

NUMBER = re.compile(DECIMAL)


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
    try:
        text = read_bytes(filename, what="poses (CSV)").decode("utf-8-sig")
    except UnicodeDecodeError:
        raise SonarError(f"{shown(filename)}: this is no text; needed is a CSV file of poses") from None
    lines = enumerate(text.splitlines(), start=1)
    rows = [(number, line.split(",")) for number, line in lines if line.strip()]
    header = [name.strip() for name in rows[0][1]] if rows else []
    if sorted(header) not in (["theta", "x", "y"], ["stamp", "theta", "x", "y"]):
        came = shown(",".join(header), 80) or "nothing"
        if len(header) == 1 and (found := re.search("[;\t]", header[0])):
            came = "tabs between the columns" if found[0] == "\t" else "semicolons between the columns"
            raise SonarError(
                f"{shown(filename)}: row 1: {came} came; allowed are commas between columns and points, not decimal "
                "commas, in numbers: x, y, theta and optionally stamp"
            )
        raise SonarError(
            f"{shown(filename)}: row 1: {came} came; allowed are the columns x, y, theta and optionally stamp"
        )
    values = np.empty((len(rows) - 1, len(header)))
    for index, (number, row) in enumerate(rows[1:]):
        if len(row) != len(header):
            raise SonarError(
                f"{shown(filename)}: row {number}: {len(row)} values came; allowed are {len(header)}, as in row 1"
                + "; are these decimal commas? allowed are points in numbers" * (len(row) > len(header))
            )
        for column, text in enumerate(row):
            values[index, column] = float(text) if NUMBER.fullmatch(text.strip()) else np.nan
            if not abs(values[index, column]) <= 1e9:  # nor NaN
                place = f"{shown(filename)}: row {number}, column {header[column]}"
                raise SonarError(f"{place}: {shown(text, 40)!r} came; allowed is a finite number up to 1e9")
    if not len(values):
        raise SonarError(f"{shown(filename)}: no pose came; allowed is one or more")
    column_of = {name: values[:, column] for column, name in enumerate(header)}
    decreases = np.flatnonzero(np.diff(column_of.get("stamp", np.zeros(1))) < 0)
    if len(decreases):
        number, row = rows[decreases[0] + 2]  # the header is the first row
        came = shown(row[header.index("stamp")], 40)
        place = f"{shown(filename)}: row {number}, column stamp"
        raise SonarError(f"{place}: {came} came; allowed is no earlier than in the row before")
    poses = np.stack([column_of["x"], column_of["y"], column_of["theta"]], axis=-1)
    return poses, column_of.get("stamp", np.arange(len(poses)) * SCAN_PERIOD)
