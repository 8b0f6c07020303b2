"""Accuracy of a trajectory against the truth: absolute and relative errors, and consistency (NEES)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.estimation.trajectory import Trajectory
from jaxsonar.geometry.se2 import compose, inverse, relative, subtract_poses, transform_points
from jaxsonar.geometry.segments import cross
from jaxsonar.hardware.errors import SonarError

Alignment = Literal["best", "first", "none"]
"""How an estimate is aligned with the truth; see ``trajectory_errors``."""

MIN_VARIANCE = 1e-18
"""Covariances with no larger element are those of fixed poses, square metres and radians."""


@dataclass(frozen=True)
class TrajectoryErrors:
    """Errors of an estimate: root mean squares over the poses that estimate and truth have in common."""

    poses: int
    """Number of compared poses."""
    ate: float
    """Absolute trajectory error: distance of the aligned positions, metres."""
    ate_heading: float
    """Absolute error of the aligned headings, radians."""
    worst: float
    """Largest distance of the aligned positions, metres."""
    worst_heading: float
    """Largest difference of the aligned headings, radians."""
    relative: float
    """Relative pose error: error of the motion over about one metre, metres per metre; NaN for a shorter truth."""
    relative_heading: float
    """Relative error of the heading, radians per metre."""
    nees: float
    """Normalized estimation error squared, the mean over poses and 3 degrees of freedom: 1 is consistent, more is
    overconfident; infinite for a singular covariance, NaN without covariances. Neighboring poses have common errors, so
    the value of a single run is far from 1 by chance."""
    truth_from_estimate: Float[np.ndarray, "3"]
    """The alignment: x, y (m), theta (rad)."""


def trajectory_errors(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    align: Alignment = "best",
    tolerance: float = 0.01,
    distance: float = 1.0,
) -> TrajectoryErrors:
    """Absolute and relative errors of a trajectory, and its consistency.

    Args:
        estimate: the trajectory to evaluate; its covariances are with respect to its first pose.
        truth: the true trajectory.
        align: "best": rotation and translation that minimize the squared distances of the positions (Umeyama, without
            scale), as ``evo_ape --align``; "first": the first common poses coincide; "none": no alignment. NEES uses
            "first", to which the covariances refer, unless "none" is chosen.
        tolerance: poses are compared if their stamps are mutual nearest neighbors within this, seconds.
        distance: length of the motions for relative errors, metres.

    Raises:
        SonarError: no two stamps within the tolerance.
    """
    own, other = associate_stamps(estimate.stamp, truth.stamp, tolerance=tolerance)
    if not len(own):
        raise SonarError(f"errors: no two stamps within {tolerance:g} s; allowed are trajectories of the same time")
    estimate, truth = estimate[own], truth[other]
    truth_from_estimate = align_poses(estimate.poses, truth.poses, align=align)
    error = subtract_poses(compose(truth_from_estimate, estimate.poses), truth.poses)
    position_error, heading_error = np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])
    relative_error, relative_heading_error = _relative_errors(estimate.poses, truth, distance)
    return TrajectoryErrors(
        poses=len(own),
        ate=_rms(position_error),
        ate_heading=_rms(heading_error),
        worst=float(position_error.max()),
        worst_heading=float(heading_error.max()),
        relative=_rms(relative_error),
        relative_heading=_rms(relative_heading_error),
        nees=_nees(estimate, truth.poses, "none" if align == "none" else "first"),
        truth_from_estimate=truth_from_estimate,
    )


def associate_stamps(
    stamps: Float[np.ndarray, " a"], others: Float[np.ndarray, " b"], *, tolerance: float
) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """Rows of mutual nearest neighbors in time, not farther apart than ``tolerance`` (seconds)."""
    if not (len(stamps) and len(others)):
        return np.zeros(0, dtype=int), np.zeros(0, dtype=int)
    forward, back = _nearest(stamps, others), _nearest(others, stamps)
    own = np.arange(len(stamps))
    kept = (back[forward] == own) & (np.abs(stamps - others[forward]) <= tolerance)
    return own[kept], forward[kept]


def _nearest(stamps: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Row of the nearest of the others for every stamp."""
    order = np.argsort(others, kind="stable")
    ordered = others[order]
    after = np.clip(np.searchsorted(ordered, stamps), 0, len(others) - 1)
    before = np.maximum(after - 1, 0)
    is_before = np.abs(ordered[before] - stamps) < np.abs(ordered[after] - stamps)
    return order[np.where(is_before, before, after)]


def align_poses(
    poses: Float[np.ndarray, "poses 3"], onto: Float[np.ndarray, "poses 3"], *, align: Alignment = "best"
) -> Float[np.ndarray, "3"]:
    """The transformation onto_from_poses that aligns poses with those of another frame, row by row.

    "best" uses the positions; if they all coincide, it uses the headings.
    """
    if align == "none":
        return np.zeros(3)
    if align == "first":
        return compose(onto[0], inverse(poses[0]))
    mean, mean_onto = poses[:, :2].mean(axis=0), onto[:, :2].mean(axis=0)
    a, b = poses[:, :2] - mean, onto[:, :2] - mean_onto
    cosine, sine = float((a * b).sum()), float(cross(a, b).sum())
    if np.hypot(cosine, sine) <= 1e-12 * max(1.0, float((mean_onto**2).sum())):
        rotation = onto[:, 2] - poses[:, 2]
        cosine, sine = float(np.cos(rotation).sum()), float(np.sin(rotation).sum())
    angle = float(np.arctan2(sine, cosine))
    return np.append(mean_onto - transform_points(np.array([0.0, 0.0, angle]), mean), angle)


def _relative_errors(poses: np.ndarray, truth: Trajectory, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Errors per metre of every motion that starts at a pose and is at least ``distance`` metres long."""
    driven = truth.distance_traveled
    last = np.searchsorted(driven, driven + distance)
    first = np.flatnonzero(last < len(driven))
    last = last[first]
    error = relative(relative(truth.poses[first], truth.poses[last]), relative(poses[first], poses[last]))
    length = driven[last] - driven[first]
    return np.hypot(error[:, 0], error[:, 1]) / length, np.abs(error[:, 2]) / length


def _nees(estimate: Trajectory, truth: np.ndarray, align: Alignment) -> float:
    """Mean NEES over the poses with a covariance above ``MIN_VARIANCE``; the first one is the reference."""
    if estimate.covariance is None:
        return np.nan
    estimate_from_truth = align_poses(truth, estimate.poses, align=align)
    error = subtract_poses(estimate.poses, compose(estimate_from_truth, truth))
    is_free = np.abs(estimate.covariance).reshape(len(estimate), 9).max(axis=1) > MIN_VARIANCE
    is_free[0] &= align == "none"
    if not is_free.any():
        return np.nan
    error, covariance = error[is_free], estimate.covariance[is_free]
    if np.linalg.eigvalsh(covariance)[:, 0].min() <= 0:
        return np.inf
    return float((error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(-1).mean() / 3)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else np.nan
