"""Sequential constraints: walls that consecutive submaps share determine their relative pose better than odometry."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsonar.estimation.joint_compatibility import chi2_bound, remove_incompatible_pairs
from jaxsonar.estimation.pose_graph import BetweenFactor
from jaxsonar.geometry.se2 import diagonal_covariance, subtract_poses, wrap_pose
from jaxsonar.loop_closure.pose_candidates import PosePrior, pose_candidates
from jaxsonar.loop_closure.settings import SETTINGS
from jaxsonar.loop_closure.submap import Submap
from jaxsonar.loop_closure.submap_matching import Pairs, log_likelihood_ratios, nearest_pairs, pair_residuals


def odometry_factor(submap: Submap, number: int) -> BetweenFactor:
    """Constraint between a submap and the next one, by the exit pose alone.

    Args:
        submap: the submap.
        number: its node in the pose graph.
    """
    return BetweenFactor(number, number + 1, submap.exit_pose, np.linalg.inv(submap.covariance[:3, :3]))


def sequential_factor(previous: Submap, following: Submap, number: int = 0) -> BetweenFactor:
    """Constraint between a submap and the next one, by the exit pose and the reflectors that both observed.

    An iterated Kalman update: the exit pose and the reflectors of the previous submap have a joint covariance; the
    following submap is an independent measurement of its reflectors in its own frame.

    Args:
        previous: the submap that ends at ``exit``.
        following: the submap that begins there.
        number: node of the previous submap in the pose graph.

    Returns:
        Constraint between the nodes ``number`` and ``number + 1``; that of ``odometry_factor`` where no reflector is
        shared or where the pairs are ambiguous.
    """
    alone = odometry_factor(previous, number)
    if not (len(previous) and len(following)):
        return alone
    # 1. An update from every pose at which reflectors agree, with the pairs found there.
    prior = PosePrior(previous.exit_pose, previous.covariance[:3, :3])
    updates = [_update_from(previous, following, pose) for pose in pose_candidates(previous, following, prior)]
    updates = [one for one in updates if one is not None]
    if not updates:
        return alone
    # 2. The best must beat all that differ from it.
    best = max(updates, key=lambda one: one.log_likelihood_ratio - one.chi2 / 2)
    position, heading = SETTINGS.sequential_distinct
    for one in updates:
        differs = (np.abs(subtract_poses(one.pose, best.pose)) > np.array([position, position, heading])).any()
        # Where doors repeat, fewer pairs prove nothing; the distance from the exit pose does.
        advantage = (
            min(0.0, one.log_likelihood_ratio - SETTINGS.sequential_similarity * best.log_likelihood_ratio)
            - one.chi2 / 2
            + best.chi2 / 2
        )
        if differs and advantage > -SETTINGS.sequential_margin:
            return alone
    return BetweenFactor(number, number + 1, best.pose, np.linalg.inv(best.covariance))


class _Update(NamedTuple):
    """Relative pose after an update with some pairs."""

    pose: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    chi2: float
    """Of the innovation."""
    chi2_contribution: Float[np.ndarray, " pairs"]
    """Contribution of each pair to it."""
    log_likelihood_ratio: float = 0.0
    """Log-likelihood ratio of the pairs against chance if their residuals were zero, nats."""

    @property
    def is_compatible(self) -> bool:
        """Whether the pairs are jointly compatible."""
        return self.chi2 <= chi2_bound(2 * len(self.chi2_contribution), SETTINGS.rejection_probability)


def _update_from(previous: Submap, following: Submap, pose: Float[np.ndarray, "3"]) -> _Update | None:
    """Update with the jointly compatible pairs near a pose; None where there are too few."""
    pairs = nearest_pairs(previous, following, pose, diagonal_covariance(SETTINGS.sequential_pose_sd))
    found = remove_incompatible_pairs(
        len(pairs),
        lambda rows: _kalman_update(previous, following, pairs.take(rows)),
        least=1,
        least_fraction=SETTINGS.min_compatible_fraction,
    )
    if found is None:
        return None
    rows, update = found
    ratio = log_likelihood_ratios(previous, following, pairs.take(rows), update.pose).sum()
    return update._replace(log_likelihood_ratio=float(ratio))


def _kalman_update(previous: Submap, following: Submap, pairs: Pairs) -> _Update:
    """Exit pose after the iterated Kalman update with some pairs."""
    count = len(pairs)
    unknown = np.concatenate([np.arange(3), (3 + 2 * pairs.earlier[:, None] + np.arange(2)).ravel()])
    known = previous.covariance[np.ix_(unknown, unknown)]
    mine = following.joint_covariance(pairs.newest)
    pose, change = previous.exit_pose, np.zeros(len(unknown))
    chi2, contribution, cov = 0.0, np.zeros(count), known
    for step in range(SETTINGS.sequential_steps):
        found = pair_residuals(previous, following, pairs.earlier, pairs.newest, pose)
        by_pose = found.d_residual_d_pose.reshape(-1, 3)
        design = np.concatenate([by_pose, -np.eye(2 * count)], axis=1)
        # Only the pose is linearized anew; the reflectors stay at their prior mean.
        innovation = found.residual.ravel() - by_pose @ change[:3]
        innovation_cov = design @ known @ design.T + found.covariance_from_newest(mine)
        gain = np.linalg.solve(innovation_cov, design @ known).T
        if not step:
            weighted = np.linalg.solve(innovation_cov, innovation)
            chi2 = float(innovation @ weighted)
            contribution = (innovation * weighted).reshape(-1, 2).sum(-1)
        change = -gain @ innovation
        pose = previous.exit_pose + change[:3]
        cov = known - gain @ design @ known
    cov = cov[:3, :3]
    return _Update(wrap_pose(pose), (cov + cov.T) / 2, chi2, contribution)
