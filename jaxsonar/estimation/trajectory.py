"""Where a robot was, and when: trajectories as TUM files, and how far one is from another.

TUM is what evo and its kin read: a line a pose, ``stamp x y z qx qy qz qw``, metres and a unit quaternion.
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
MOST_TILT = float(np.radians(1.0))
"""Radians; a pose that leans more than this is none of a robot on a floor."""
NORM_WITHIN = 1e-3
"""How far the length of a quaternion may be from 1: a file of three digits still is one."""
_NUMBER = re.compile(DECIMAL)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of a robot in the order they were taken; the arrays are read-only.

    Raises:
        SonarError: shapes that do not fit together, or a stamp or pose that is not finite.
    """

    stamp: Float[np.ndarray, " poses"]
    """Seconds (``stamps_of`` says what they are where a log has none)."""
    poses: Float[np.ndarray, "poses 3"]
    """world_from_robot: x, y (m), theta (rad)."""
    covariance: Float[np.ndarray, "poses 3 3"] | None = None
    """Of (x, y, theta) in the world frame, m and rad, with respect to the first pose; None where it is not known.
    A TUM file has no place for it."""

    def __post_init__(self):
        shapes = {"stamp": (len(self.stamp),), "poses": (len(self.stamp), 3), "covariance": (len(self.stamp), 3, 3)}
        for name, shape in shapes.items():
            given = getattr(self, name)
            if given is None:
                continue
            if given.shape != shape:
                raise SonarError(f"trajectory: {name} has shape {given.shape}; allowed is {shape}, a row a pose")
            if not np.isfinite(given).all():
                row = int(np.argmin(np.isfinite(given).reshape(len(given), -1).all(axis=1)))
                raise SonarError(f"trajectory: {name} {row} is {given[row].tolist()}; allowed are finite numbers")
            view = given.view()
            view.flags.writeable = False  # of our view only: the caller's own array stays as it was
            object.__setattr__(self, name, view)

    def __len__(self) -> int:
        return len(self.stamp)

    def __getitem__(self, rows: slice | Int[np.ndarray, " some"] | Bool[np.ndarray, " poses"]) -> "Trajectory":
        return Trajectory(
            self.stamp[rows], self.poses[rows], None if self.covariance is None else self.covariance[rows]
        )

    @property
    def distance_traveled(self) -> Float[np.ndarray, " poses"]:
        """Metres driven up to each pose, 0 at the first."""
        steps = np.linalg.norm(np.diff(self.poses[:, :2], axis=0), axis=-1)
        return np.concatenate([np.zeros(min(len(self), 1)), np.cumsum(steps)])

    def transform(self, new_from_world: Float[np.ndarray, "3"]) -> "Trajectory":
        """The same in another frame."""
        angle = float(new_from_world[2])
        covariance = None if self.covariance is None else rotate_covariance(angle, self.covariance)
        return replace(self, poses=compose(new_from_world, self.poses), covariance=covariance)


def stamps_of(log: Log) -> Float[np.ndarray, " scans"]:
    """Stamps for the poses of a log: its own, seconds, where every scan has one and they rise; else scan numbers."""
    rising = bool(np.isfinite(log.stamp).all() and (np.diff(log.stamp) > 0).all())
    return np.array(log.stamp if rising else log.scan, dtype=np.float64)


def save_trajectory(trajectory: Trajectory, path: str | os.PathLike[str]) -> None:
    """Write a TUM file, whole or not at all; ``-`` is standard output. Numbers read back as they are.

    Raises:
        SonarError: a place that cannot be written to.
    """
    half = wrap_angle(trajectory.poses[:, 2]) / 2
    columns = (trajectory.stamp, *trajectory.poses[:, :2].T, np.sin(half), np.cos(half))
    with open_output(path) as file:
        file.write(f"# {COLUMNS}\n")
        for stamp, x, y, qz, qw in zip(*(column.tolist() for column in columns), strict=True):
            file.write(f"{stamp!r} {x!r} {y!r} 0 0 0 {qz!r} {qw!r}\n")


def load_trajectory(path: str | os.PathLike[str]) -> Trajectory:
    """A trajectory on the floor from a TUM file; heights are left out.

    Args:
        path: the file; lines that begin with ``#`` and empty ones do not count.

    Raises:
        SonarError: no such file, no pose, a line that is not eight finite numbers, a quaternion that is no unit
            quaternion (lengths within 0.001 of 1 are made 1) or that leans more than 1 deg; with the line.
    """
    try:
        text = read_bytes(path, what="a trajectory (TUM)").decode("utf-8-sig")
    except UnicodeDecodeError:
        raise SonarError(f"{shown(path)}: this is no text; needed is a trajectory: lines of {COLUMNS}") from None
    lines = [(number, line.split()) for number, line in enumerate(text.splitlines(), start=1)]
    lines = [(number, fields) for number, fields in lines if fields and not fields[0].startswith("#")]
    if not lines:
        raise SonarError(f"{shown(path)}: no pose came; allowed is one or more, {COLUMNS}")
    values = np.array([_numbers(fields, f"{shown(path)}: line {number}") for number, fields in lines])
    quaternion = values[:, 4:]
    norm = np.linalg.norm(quaternion, axis=-1)
    tilt = 2 * np.arctan2(np.hypot(*quaternion[:, :2].T), np.hypot(*quaternion[:, 2:].T))
    for bad, came, allowed in (
        (np.abs(norm - 1) > NORM_WITHIN, norm, f"a quaternion of length 1, within {NORM_WITHIN:g}"),
        (tilt > MOST_TILT, np.degrees(tilt), "a pose on the floor, leaning at most 1 deg"),
    ):
        if bad.any():
            row = int(np.argmax(bad))
            what = f"{came[row]:.3g} deg of lean" if came is not norm else f"a quaternion of length {came[row]:.6g}"
            raise SonarError(f"{shown(path)}: line {lines[row][0]}: {what} came; allowed is {allowed}")
    theta = wrap_angle(2 * np.arctan2(quaternion[:, 2], quaternion[:, 3]))
    return Trajectory(values[:, 0].copy(), np.column_stack([values[:, 1:3], theta]))


def _numbers(fields: list[str], place: str) -> list[float]:
    """Eight finite numbers, or a message."""
    names = COLUMNS.split()
    if len(fields) != len(names):
        raise SonarError(f"{place}: {len(fields)} values came; allowed are {len(names)}: {COLUMNS}")
    for name, field in zip(names, fields, strict=True):
        if not (_NUMBER.fullmatch(field) and abs(float(field)) <= 1e18):  # 1e18: stamps in nanoseconds
            raise SonarError(f"{place}, {name}: {shown(field, 40)!r} came; allowed is a finite number")
    return [float(field) for field in fields]
