"""A robot's way through a room: poses from a CSV file, for the simulator."""

import csv
import os
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxsonar.hardware.errors import SonarError

SECONDS_PER_POSE = 0.1
"""Between the stamps of poses that come without: about the rate of a full scan of the paper's ring."""


def load_path(
    path: str | os.PathLike[str],
) -> tuple[Float[np.ndarray, "poses 3"], Float[np.ndarray, " poses"]]:
    """Poses and stamps from CSV with the columns x, y (metres), theta (radians) and optionally stamp (seconds).

    Args:
        path: the file; its first row names the columns, in any order.

    Returns:
        poses: world_from_robot (x, y, theta).
        stamps: seconds; 0.1 s apart if the file has none.

    Raises:
        SonarError: no such file, no pose, other columns, or a value that is no finite number, with row and column.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "not a text file"
        raise SonarError(f"{path}: {why}; allowed is a CSV file of poses") from None
    rows = [(number, row) for number, row in enumerate(csv.reader(text.splitlines()), start=1) if row]
    header = [name.strip() for name in rows[0][1]] if rows else []
    if sorted(header) not in (["theta", "x", "y"], ["stamp", "theta", "x", "y"]):
        came = ",".join(header)[:80] or "nothing"
        raise SonarError(f"{path}: row 1: {came} came; allowed are the columns x, y, theta and optionally stamp")
    values = np.empty((len(rows) - 1, len(header)))
    for index, (number, row) in enumerate(rows[1:]):
        if len(row) != len(header):
            raise SonarError(f"{path}: row {number}: {len(row)} values came; allowed are {len(header)}, as in row 1")
        for column, text in enumerate(row):
            try:
                values[index, column] = float(text)
            except ValueError:
                values[index, column] = np.nan
            if not np.isfinite(values[index, column]):
                raise SonarError(
                    f"{path}: row {number}, column {header[column]}: {text!r} came; allowed is a finite number"
                )
    if not len(values):
        raise SonarError(f"{path}: no pose came; allowed is one or more")
    column_of = {name: values[:, column] for column, name in enumerate(header)}
    poses = np.stack([column_of["x"], column_of["y"], column_of["theta"]], axis=-1)
    return poses, column_of.get("stamp", np.arange(len(poses)) * SECONDS_PER_POSE)
