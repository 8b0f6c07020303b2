"""Trajectories of a robot, and their files in TUM format.

A TUM file has a line per pose, ``stamp x y z qx qy qz qw``: seconds, metres and a unit quaternion. Tools such as evo
read it.
"""

import os
import re
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.fileio.atomic_files import DECIMAL, open_output, read_bytes, shown
from jaxsonar.geometry.se2 import compose, rotate_covariance, wrap_angle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.scan_log import Log

COLUMNS = "stamp x y z qx qy qz qw"
_NUMBER = re.compile(DECIMAL)


@dataclass(frozen=True)
class TumFileSettings:
    """Tolerances for TUM files. Both were chosen by hand."""

    max_tilt: float = float(np.radians(1.0))
    """Largest tilt of a pose, radians: the robot moves on a floor."""
    norm_tolerance: float = 1e-3
    """Largest deviation of the norm of a quaternion from 1: files with three digits are accepted."""


SETTINGS = TumFileSettings()


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of a robot in chronological order; the arrays are read-only.

    Raises:
        SonarError: inconsistent shapes, or a value that is not finite.
    """

    stamp: Float[np.ndarray, " poses"]
    """Times of the poses, seconds; scan numbers for a log without times (``stamps_of``)."""
    poses: Float[np.ndarray, "poses 3"]
    """world_from_robot: x, y (metres), theta (radians)."""
    covariance: Float[np.ndarray, "poses 3 3"] | None = None
    """Covariances of (x, y, theta) relative to the first pose, world frame, metres and radians; None: unknown.
    TUM files do not contain them."""

    def __post_init__(self):
        shapes = {"stamp": (len(self.stamp),), "poses": (len(self.stamp), 3), "covariance": (len(self.stamp), 3, 3)}
        for name, shape in shapes.items():
            given = getattr(self, name)
            if given is None:
                continue
            if given.shape != shape:
                raise SonarError(f"trajectory: {name} has shape {given.shape}; allowed is {shape}, a row per pose")
            if not np.isfinite(given).all():
                row = int(np.argmin(np.isfinite(given).reshape(len(given), -1).all(axis=1)))
                raise SonarError(f"trajectory: {name} {row} is {given[row].tolist()}; allowed are finite numbers")
            view = given.view()
            view.flags.writeable = False  # of this view only; the array of the caller stays writable
            object.__setattr__(self, name, view)

    def __len__(self) -> int:
        return len(self.stamp)

    def __getitem__(self, rows: slice | Int[np.ndarray, " some"] | Bool[np.ndarray, " poses"]) -> "Trajectory":
        return Trajectory(
            self.stamp[rows], self.poses[rows], None if self.covariance is None else self.covariance[rows]
        )

    @property
    def distance_traveled(self) -> Float[np.ndarray, " poses"]:
        """Length of the trajectory up to each pose, metres; 0 at the first."""
        steps = np.linalg.norm(np.diff(self.poses[:, :2], axis=0), axis=-1)
        return np.concatenate([np.zeros(min(len(self), 1)), np.cumsum(steps)])

    def transform(self, new_from_world: Float[np.ndarray, "3"]) -> "Trajectory":
        """The trajectory in another frame."""
        angle = float(new_from_world[2])
        covariance = None if self.covariance is None else rotate_covariance(angle, self.covariance)
        return replace(self, poses=compose(new_from_world, self.poses), covariance=covariance)


def stamps_of(log: Log) -> Float[np.ndarray, " scans"]:
    """Times of the scans in seconds if all have one and they increase strictly; otherwise scan numbers."""
    rising = bool(np.isfinite(log.stamp).all() and (np.diff(log.stamp) > 0).all())
    return np.array(log.stamp if rising else log.scan, dtype=np.float64)


def save_trajectory(trajectory: Trajectory, filename: str | os.PathLike[str]) -> None:
    """Write a TUM file atomically. Numbers are read back exactly.

    Args:
        trajectory: the poses.
        filename: the file; ``-`` is standard output.

    Raises:
        SonarError: the file cannot be written.
    """
    half = wrap_angle(trajectory.poses[:, 2]) / 2
    columns = (trajectory.stamp, *trajectory.poses[:, :2].T, np.sin(half), np.cos(half))
    with open_output(filename) as file:
        file.write(f"# {COLUMNS}\n")
        for stamp, x, y, qz, qw in zip(*(column.tolist() for column in columns), strict=True):
            file.write(f"{stamp!r} {x!r} {y!r} 0 0 0 {qz!r} {qw!r}\n")


def load_trajectory(filename: str | os.PathLike[str]) -> Trajectory:
    """Read a planar trajectory from a TUM file; z is ignored.

    Args:
        filename: the file; empty lines and lines that begin with ``#`` are ignored.

    Raises:
        SonarError: no such file, no pose, a line that is not eight finite numbers, a quaternion whose norm is not 1
            within 0.001, or a tilt of more than 1 deg. The message names the line.
    """
    try:
        text = read_bytes(filename, what="a trajectory (TUM)").decode("utf-8-sig")
    except UnicodeDecodeError:
        raise SonarError(f"{shown(filename)}: not a text file; allowed is a trajectory: lines of {COLUMNS}") from None
    lines = [(number, line.split()) for number, line in enumerate(text.splitlines(), start=1)]
    lines = [(number, fields) for number, fields in lines if fields and not fields[0].startswith("#")]
    if not lines:
        raise SonarError(f"{shown(filename)}: no pose came; allowed is one or more, {COLUMNS}")
    values = np.array([_numbers(fields, f"{shown(filename)}: line {number}") for number, fields in lines])
    quaternion = values[:, 4:]
    norm = np.linalg.norm(quaternion, axis=-1)
    tilt = 2 * np.arctan2(np.hypot(*quaternion[:, :2].T), np.hypot(*quaternion[:, 2:].T))
    for bad, came, allowed in (
        (
            np.abs(norm - 1) > SETTINGS.norm_tolerance,
            norm,
            f"a quaternion of length 1, within {SETTINGS.norm_tolerance:g}",
        ),
        (tilt > SETTINGS.max_tilt, np.degrees(tilt), "a pose on the floor, tilted by at most 1 deg"),
    ):
        if bad.any():
            row = int(np.argmax(bad))
            what = f"{came[row]:.3g} deg of tilt" if came is not norm else f"a quaternion of length {came[row]:.6g}"
            raise SonarError(f"{shown(filename)}: line {lines[row][0]}: {what} came; allowed is {allowed}")
    theta = wrap_angle(2 * np.arctan2(quaternion[:, 2], quaternion[:, 3]))
    return Trajectory(values[:, 0].copy(), np.column_stack([values[:, 1:3], theta]))


def _numbers(fields: list[str], location: str) -> list[float]:
    """The eight numbers of a line; a SonarError if they are not finite numbers."""
    names = COLUMNS.split()
    if len(fields) != len(names):
        raise SonarError(f"{location}: {len(fields)} values came; allowed are {len(names)}: {COLUMNS}")
    for name, field in zip(names, fields, strict=True):
        if not (_NUMBER.fullmatch(field) and abs(float(field)) <= 1e18):  # 1e18: stamps in nanoseconds
            raise SonarError(f"{location}, {name}: {shown(field, 40)!r} came; allowed is a finite number")
    return [float(field) for field in fields]
