"""Where a robot was, and when: trajectories as TUM files, and how far one is from another.

TUM is what evo and its kin read: a line a pose, ``stamp x y z qx qy qz qw``, metres and a unit quaternion.
"""

import os
import re
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.fileio.atomic_files import DECIMAL, open_output, read_bytes, shown
from jaxsonar.geometry.se2 import composed, inverse, relative, rotation, to_world, wrap_angle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.scan_log import Log

COLUMNS = "stamp x y z qx qy qz qw"
MOST_TILT = float(np.radians(1.0))
"""Radians; a pose that leans more than this is none of a robot on a floor."""
NORM_WITHIN = 1e-3
"""How far the length of a quaternion may be from 1: a file of three digits still is one."""
_NUMBER = re.compile(DECIMAL)

Align = Literal["best", "first", "none"]


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
    def way(self) -> Float[np.ndarray, " poses"]:
        """Metres driven up to each pose, 0 at the first."""
        steps = np.linalg.norm(np.diff(self.poses[:, :2], axis=0), axis=-1)
        return np.concatenate([np.zeros(min(len(self), 1)), np.cumsum(steps)])

    def moved(self, new_from_world: Float[np.ndarray, "3"]) -> "Trajectory":
        """The same in another frame."""
        turn = np.eye(3)
        turn[:2, :2] = rotation(float(new_from_world[2]))
        covariance = None if self.covariance is None else turn @ self.covariance @ turn.T
        return replace(self, poses=composed(new_from_world, self.poses), covariance=covariance)


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


@dataclass(frozen=True)
class TrajectoryErrors:
    """How far an estimate is from the truth; root mean squares over the poses that both have."""

    poses: int
    """How many were compared."""
    ate: float
    """Absolute trajectory error: distance of the aligned positions, metres."""
    ate_heading: float
    """The same of the headings, radians."""
    worst: float
    """Largest distance of the aligned positions, metres."""
    worst_heading: float
    """Largest difference of the headings, radians."""
    relative: float
    """Relative pose error: how far a robot that was in the right place is from it one metre on, metres per metre;
    NaN where the truth is shorter than that."""
    relative_heading: float
    """The same of the heading, radians per metre."""
    nees: float
    """Normalised squared error of the poses over its 3 degrees of freedom, the mean over them; 1 is right, more is
    overconfident, infinite where a covariance is none. NaN where there is none. Neighboring poses share their errors:
    of one run it is far from 1 by chance."""
    truth_from_estimate: Float[np.ndarray, "3"]
    """The alignment: x, y (m), theta (rad)."""


def errors(
    estimate: Trajectory, truth: Trajectory, *, align: Align = "best", tolerance: float = 0.01, way: float = 1.0
) -> TrajectoryErrors:
    """Absolute and relative errors of a trajectory.

    Args:
        estimate: what is judged; its covariance, if it has one, with respect to its first pose.
        truth: what it should be.
        align: "best": turned and shifted (not scaled) so that the squared distances of the positions are least
            (Umeyama), as ``evo_ape --align`` does; "first": so that the first pose that both have is the same;
            "none": as they are. NEES is of the poses with the first one in its place, since their covariances are; but
            with "none" as they are.
        tolerance: poses belong together whose stamps are each other's nearest and this near, seconds.
        way: over which relative errors are taken, metres.

    Raises:
        SonarError: no pose of the two belongs to the other.
    """
    own, other = associated(estimate.stamp, truth.stamp, tolerance=tolerance)
    if not len(own):
        raise SonarError(f"errors: no two stamps within {tolerance:g} s; allowed are trajectories of the same time")
    estimate, truth = estimate[own], truth[other]
    truth_from_estimate = alignment(estimate.poses, truth.poses, align=align)
    off = _difference(composed(truth_from_estimate, estimate.poses), truth.poses)
    distance, turn = np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])
    step, step_heading = _relative_errors(estimate.poses, truth, way)
    return TrajectoryErrors(
        poses=len(own),
        ate=_rms(distance),
        ate_heading=_rms(turn),
        worst=float(distance.max()),
        worst_heading=float(turn.max()),
        relative=_rms(step),
        relative_heading=_rms(step_heading),
        nees=_nees(estimate, truth.poses, "none" if align == "none" else "first"),
        truth_from_estimate=truth_from_estimate,
    )


def associated(
    stamps: Float[np.ndarray, " a"], others: Float[np.ndarray, " b"], *, tolerance: float
) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """Rows of both that are each other's nearest in time, not further apart than ``tolerance`` (seconds)."""
    if not (len(stamps) and len(others)):
        return np.zeros(0, dtype=int), np.zeros(0, dtype=int)
    there, back = _nearest(stamps, others), _nearest(others, stamps)
    own = np.arange(len(stamps))
    kept = (back[there] == own) & (np.abs(stamps - others[there]) <= tolerance)
    return own[kept], there[kept]


def _nearest(stamps: np.ndarray, others: np.ndarray) -> np.ndarray:
    """For every stamp the row of the nearest of the others."""
    order = np.argsort(others, kind="stable")
    ordered = others[order]
    after = np.clip(np.searchsorted(ordered, stamps), 0, len(others) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(ordered[before] - stamps) < np.abs(ordered[after] - stamps)
    return order[np.where(nearer, before, after)]


def alignment(
    poses: Float[np.ndarray, "poses 3"], onto: Float[np.ndarray, "poses 3"], *, align: Align = "best"
) -> Float[np.ndarray, "3"]:
    """onto_from_poses: the motion that brings poses onto those of another frame, row by row.

    With "best" the positions decide; where they are all one place, the headings do.
    """
    if align == "none":
        return np.zeros(3)
    if align == "first":
        return composed(onto[0], inverse(poses[0]))
    middle, other = poses[:, :2].mean(axis=0), onto[:, :2].mean(axis=0)
    a, b = poses[:, :2] - middle, onto[:, :2] - other
    along, across = float((a * b).sum()), float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    if np.hypot(along, across) <= 1e-12 * max(1.0, float((other**2).sum())):
        apart = onto[:, 2] - poses[:, 2]
        along, across = float(np.cos(apart).sum()), float(np.sin(apart).sum())
    turn = float(np.arctan2(across, along))
    return np.append(other - to_world(np.array([0.0, 0.0, turn]), middle), turn)


def _difference(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    off = poses - truth
    off[:, 2] = wrap_angle(off[:, 2])
    return off


def _relative_errors(poses: np.ndarray, truth: Trajectory, way: float) -> tuple[np.ndarray, np.ndarray]:
    """Of every stretch of at least ``way`` metres, one from each pose that has so much before it: errors per metre."""
    driven = truth.way
    last = np.searchsorted(driven, driven + way)
    first = np.flatnonzero(last < len(driven))
    last = last[first]
    off = relative(relative(truth.poses[first], truth.poses[last]), relative(poses[first], poses[last]))
    length = driven[last] - driven[first]
    return np.hypot(off[:, 0], off[:, 1]) / length, np.abs(off[:, 2]) / length


def _nees(estimate: Trajectory, truth: np.ndarray, align: Align) -> float:
    """Mean over the poses; those that are known (the first one, no covariance at all) say nothing."""
    if estimate.covariance is None:
        return np.nan
    estimate_from_truth = alignment(truth, estimate.poses, align=align)
    off = _difference(estimate.poses.copy(), composed(estimate_from_truth, truth))
    unknown = np.abs(estimate.covariance).reshape(len(estimate), 9).max(axis=1) > 1e-18
    unknown[0] &= align == "none"
    if not unknown.any():
        return np.nan
    off, covariance = off[unknown], estimate.covariance[unknown]
    if np.linalg.eigvalsh(covariance)[:, 0].min() <= 0:
        return np.inf
    return float((off * np.linalg.solve(covariance, off[..., None])[..., 0]).sum(-1).mean() / 3)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else np.nan
