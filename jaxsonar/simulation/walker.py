"""A walking person for the simulator: a circle that moves along a trajectory."""

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.simulation.csv_columns import load_columns

WALKER_RADIUS = 0.2
"""Radius of a person at the height of the sensors, metres: half the width of a body; chosen by hand."""
MAX_RADIUS = 2.0
"""Largest radius of a walker, metres; larger values are probably in other units."""


@dataclass(frozen=True, eq=False)
class Walker:
    """A walking person: a circle that moves with constant velocity from each position to the next.

    The person stands at the first position before its stamp, and at the last position after its stamp. It reflects and
    occludes like a circle of the room.

    Raises:
        SonarError: no position, values that are not finite, stamps that do not increase, or a radius out of range.
    """

    stamps: Float[np.ndarray, " positions"]
    """Seconds, increasing; on the same clock as the stamps of the scans."""
    positions: Float[np.ndarray, "positions 2"]
    """Centers (x, y), world frame, metres."""
    radius: float = WALKER_RADIUS
    """Metres, more than 0 and at most 2."""

    def __post_init__(self):
        stamps = np.array(self.stamps, dtype=np.float64).reshape(-1)
        positions = np.array(self.positions, dtype=np.float64).reshape(-1, 2)
        if not len(stamps) or len(stamps) != len(positions):
            came = f"{len(stamps)} stamps and {len(positions)} positions"
            raise SonarError(f"walker: {came} came; allowed is one each, at least one")
        if not (np.isfinite(stamps).all() and np.isfinite(positions).all()):
            raise SonarError("walker: a stamp or position is not finite; allowed are finite seconds and metres")
        if not (np.diff(stamps) > 0).all():
            row = int(np.argmin(np.diff(stamps) > 0)) + 1
            raise SonarError(f"walker: stamp {stamps[row]:g} of position {row}; allowed is later than the one before")
        if not 0 < self.radius <= MAX_RADIUS:
            unit = "; is it in mm or cm?" if self.radius > MAX_RADIUS else ""
            allowed = f"allowed is more than 0 and at most {MAX_RADIUS:g} m{unit}"
            raise SonarError(f"walker: radius {self.radius:g} m; {allowed}")
        stamps.setflags(write=False)
        positions.setflags(write=False)
        object.__setattr__(self, "stamps", stamps)
        object.__setattr__(self, "positions", positions)

    def position_at(self, stamps: Float[np.ndarray, " times"]) -> Float[np.ndarray, "times 2"]:
        """Centers at some times (seconds), world frame, metres."""
        return np.stack([np.interp(stamps, self.stamps, axis) for axis in self.positions.T], axis=-1)


def load_walker(filename: str | os.PathLike[str], radius: float = WALKER_RADIUS) -> Walker:
    """Load the trajectory of a person from CSV with the columns stamp (seconds), x, y (metres).

    Args:
        filename: the file; its first row contains the column names, in any order.
        radius: of the person, metres.

    Raises:
        SonarError: no such file, no position, other columns, an invalid value, stamps that do not increase, or a radius
            out of range; the message names row and column.
    """
    column_of = load_columns(
        filename, what="the trajectory of a person", entry="position", required=("stamp", "x", "y"), increasing=True
    )
    try:
        return Walker(column_of["stamp"], np.stack([column_of["x"], column_of["y"]], axis=-1), radius)
    except SonarError as error:
        raise SonarError(f"{shown(filename)}: {error}") from None


def circles_of_walkers(
    walkers: Sequence[Walker], stamps: Float[np.ndarray, " scans"]
) -> Float[np.ndarray, "scans walkers 3"]:
    """Center x, y and radius of each walker at the stamp (seconds) of each scan, world frame, metres."""
    circles = np.empty((len(stamps), len(walkers), 3))
    for k, walker in enumerate(walkers):
        circles[:, k, :2] = walker.position_at(stamps)
        circles[:, k, 2] = walker.radius
    return circles


def distances_to_robot(
    walker: Walker, poses: Float[np.ndarray, "scans 3"], stamps: Float[np.ndarray, " scans"]
) -> Float[np.ndarray, " scans"]:
    """Distance of the origin of the robot from the surface of a person at each scan, metres; negative inside.

    Args:
        walker: the person.
        poses: world_from_robot of the scans.
        stamps: of the scans, seconds.
    """
    return np.linalg.norm(walker.position_at(stamps) - poses[:, :2], axis=-1) - walker.radius
