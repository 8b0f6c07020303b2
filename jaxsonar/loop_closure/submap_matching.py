"""Reflectors of two submaps: residuals, matched pairs, and the least-squares fit of the relative pose.

The pose is earlier_from_newest: (x, y, theta), metres and radians. Pairs must be jointly compatible
(``estimation.joint_compatibility``).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.estimation.joint_compatibility import chi2_bound, mutual_nearest_neighbors, remove_incompatible_pairs
from jaxsonar.geometry.landmarks import transform_parameters, wall_segments
from jaxsonar.geometry.se2 import tangent_of, transform_points, wrap_angle, wrap_pose
from jaxsonar.loop_closure.settings import SETTINGS
from jaxsonar.loop_closure.submap import Submap
from jaxsonar.registration.settings import FEATURE_SETTINGS


class Pairs(NamedTuple):
    """Rows of two submaps that are the same reflector."""

    earlier: Int[np.ndarray, " pairs"]
    newest: Int[np.ndarray, " pairs"]

    def __len__(self) -> int:
        return len(self.earlier)

    def take(self, rows: Int[np.ndarray, " some"]) -> "Pairs":
        """Select some of the pairs."""
        return Pairs(self.earlier[rows], self.newest[rows])


class PairResiduals(NamedTuple):
    """Differences of the newest submap's reflectors from the earlier submap's, in the parameters of the latter."""

    residual: Float[np.ndarray, "*pairs 2"]
    d_residual_d_pose: Float[np.ndarray, "*pairs 2 3"]
    """Derivative by earlier_from_newest."""
    d_residual_d_newest: Float[np.ndarray, "*pairs 2 2"]
    """Derivative by the newest submap's parameters; that by the earlier submap's is minus the identity."""

    def covariance_from_newest(self, joint: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
        """Covariance of all residuals due to the newest submap, from the joint covariance of its parameters."""
        count = len(self.d_residual_d_newest)
        blocks = joint.reshape(count, 2, count, 2)
        return np.einsum("aij,ajbk,blk->aibl", self.d_residual_d_newest, blocks, self.d_residual_d_newest).reshape(
            joint.shape
        )


class PoseFit(NamedTuple):
    """Least-squares fit of the relative pose."""

    pose: Float[np.ndarray, "3"]
    """earlier_from_newest."""
    information: Float[np.ndarray, "3 3"]
    """Zero in the direction that the pairs do not determine."""
    undetermined_direction: Float[np.ndarray, "2"] | None
    """This direction, a unit vector of the earlier frame, or None."""
    chi2: float
    dof: int
    """Degrees of freedom of the chi-square."""
    chi2_contribution: Float[np.ndarray, " pairs"]
    """Contribution of each pair to the chi-square."""

    @property
    def is_compatible(self) -> bool:
        """Whether the pairs are jointly compatible."""
        return self.chi2 <= chi2_bound(max(self.dof, 1), SETTINGS.rejection_probability)


def pair_residuals(
    earlier: Submap,
    newest: Submap,
    rows: Int[np.ndarray, "*#pairs"],
    others: Int[np.ndarray, "*#pairs"],
    pose: Float[np.ndarray, "3"],
) -> PairResiduals:
    """Residuals of pairs of reflectors, and their derivatives.

    Args:
        earlier: the submap that stays.
        newest: the submap that is moved.
        rows: rows of the earlier submap.
        others: rows of the newest submap, of the same kinds.
        pose: earlier_from_newest.
    """
    rows, others = np.broadcast_arrays(rows, others)
    known = earlier.landmarks.take(rows)
    found = transform_parameters(pose, newest.landmarks.take(others), np.asarray(known.anchor))
    residual = found.parameters - known.parameters
    residual[..., 1] = np.where(known.kind == kernels.PLANE, wrap_angle(residual[..., 1]), residual[..., 1])
    return PairResiduals(residual, found.by_transform, found.by_parameters)


def log_likelihood_ratios(
    earlier: Submap, newest: Submap, pairs: Pairs, pose: Float[np.ndarray, "3"]
) -> Float[np.ndarray, " pairs"]:
    """Log-likelihood ratio of each pair against chance, nats, if its residual were zero."""
    found = pair_residuals(earlier, newest, pairs.earlier, pairs.newest, pose)
    mine = newest.landmark_covariances[pairs.newest]
    cov = (
        found.d_residual_d_newest @ mine @ found.d_residual_d_newest.swapaxes(1, 2)
        + earlier.landmark_covariances[pairs.earlier]
    )
    wall = np.log(2 * FEATURE_SETTINGS.wall_offset_range) - np.log(2 * np.pi * cov[:, 0, 0]) / 2
    point = np.log(FEATURE_SETTINGS.point_area / (2 * np.pi)) - np.linalg.slogdet(cov)[1] / 2
    is_wall = newest.landmarks.kind[pairs.newest] == kernels.PLANE
    return np.minimum(
        np.where(is_wall, wall, FEATURE_SETTINGS.point_weight * point), SETTINGS.max_pair_log_likelihood_ratio
    )


def nearest_pairs(
    earlier: Submap, newest: Submap, pose: Float[np.ndarray, "3"], pose_covariance: Float[np.ndarray, "3 3"]
) -> Pairs:
    """Reflectors of one kind that are mutual nearest neighbors in Mahalanobis distance, within the gate.

    Args:
        earlier: the submap that stays.
        newest: the submap that is moved.
        pose: earlier_from_newest.
        pose_covariance: its covariance.
    """
    if not (len(earlier) and len(newest)):
        return Pairs(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    rows, others = np.arange(len(earlier))[:, None], np.arange(len(newest))
    found = pair_residuals(earlier, newest, rows, others, pose)
    cov = found.d_residual_d_newest @ newest.landmark_covariances @ found.d_residual_d_newest.swapaxes(-1, -2)
    cov = cov + earlier.landmark_covariances[:, None]
    cov = cov + found.d_residual_d_pose @ pose_covariance @ found.d_residual_d_pose.swapaxes(-1, -2)
    distance = (found.residual * np.linalg.solve(cov, found.residual[..., None])[..., 0]).sum(-1)
    distance[earlier.landmarks.kind[:, None] != newest.landmarks.kind] = np.inf
    distance[_wall_gaps(earlier, newest, pose) > SETTINGS.max_wall_gap] = np.inf
    distance[distance >= SETTINGS.pair_gate] = np.inf
    paired, mine = mutual_nearest_neighbors(distance.T)
    return Pairs(mine, paired)


def _wall_gaps(earlier: Submap, newest: Submap, pose: Float[np.ndarray, "3"]) -> Float[np.ndarray, "earlier newest"]:
    """Gaps between the observed parts of walls, along them, metres; 0 where they overlap, and for points."""
    known, mine = earlier.landmarks, newest.landmarks
    theta = np.asarray(known.parameters)[:, 1]
    ends = transform_points(pose, wall_segments(mine))
    offset = ends.reshape(1, -1, 2) - known.anchor[:, None]
    along = np.einsum("etk,ek->et", offset, tangent_of(theta))
    along = along.reshape(len(earlier), -1, 2)
    gap = np.maximum(along.min(-1) - known.extent[:, 1:], known.extent[:, :1] - along.max(-1))
    walls = (known.kind[:, None] == kernels.PLANE) & (mine.kind == kernels.PLANE)
    return np.where(walls, np.maximum(gap, 0.0), 0.0)


def fit_pose(earlier: Submap, newest: Submap, pairs: Pairs, pose: Float[np.ndarray, "3"]) -> PoseFit:
    """Least-squares fit of the relative pose; along parallel walls it stays where it is.

    Args:
        earlier: the submap that stays.
        newest: the submap that is moved.
        pairs: at least one.
        pose: earlier_from_newest, near the solution.
    """
    free = _undetermined_direction(earlier, newest, pairs)
    projection = np.eye(3)
    if free is not None:
        projection[:2, :2] -= np.outer(free, free)
    known = earlier.joint_covariance(pairs.earlier)
    mine = newest.joint_covariance(pairs.newest)
    step, information, residual, weighted_residual = np.ones(3), np.zeros((3, 3)), np.zeros(0), np.zeros(0)
    for _ in range(SETTINGS.fit_steps):
        found = pair_residuals(earlier, newest, pairs.earlier, pairs.newest, pose)
        design, residual = found.d_residual_d_pose.reshape(-1, 3) @ projection, found.residual.ravel()
        weighted = np.linalg.solve(known + found.covariance_from_newest(mine), np.column_stack([design, residual]))
        information, weighted_residual = design.T @ weighted[:, :3], weighted[:, 3]
        if np.abs(step).max() < SETTINGS.fit_tolerance:
            break
        step = -np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ (design.T @ weighted_residual)
        pose = pose + step
    rank = 3 if free is None else 2
    return PoseFit(
        pose=wrap_pose(pose),
        information=(information + information.T) / 2,
        undetermined_direction=free,
        chi2=float(residual @ weighted_residual),
        dof=2 * len(pairs) - rank,
        chi2_contribution=(residual * weighted_residual).reshape(-1, 2).sum(-1),
    )


def _undetermined_direction(earlier: Submap, newest: Submap, pairs: Pairs) -> Float[np.ndarray, "2"] | None:
    """Direction along walls that are all parallel; None if a point or another wall determines it."""
    if not (newest.landmarks.kind[pairs.newest] == kernels.PLANE).all():
        return None
    theta = earlier.landmarks.parameters[pairs.earlier, 1]
    if (np.abs(np.sin(theta[:, None] - theta)) > np.sin(SETTINGS.parallel_angle)).any():
        return None
    double = np.exp(2j * theta).sum()
    return tangent_of(float(np.angle(double)) / 2)


def fit_compatible_pairs(
    earlier: Submap, newest: Submap, pairs: Pairs, pose: Float[np.ndarray, "3"], *, least: int
) -> tuple[Pairs, PoseFit] | None:
    """Remove the worst pair until the rest is jointly compatible, and fit the pose.

    None where fewer than ``least`` pairs remain, or a smaller fraction than ``min_compatible_fraction``.
    """
    found = remove_incompatible_pairs(
        len(pairs),
        lambda rows: fit_pose(earlier, newest, pairs.take(rows), pose),
        least=least,
        least_fraction=SETTINGS.min_compatible_fraction,
    )
    return None if found is None else (pairs.take(found[0]), found[1])
