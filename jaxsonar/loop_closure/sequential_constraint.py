"""Consecutive submaps share walls: these tell better than the path alone how the one lies on the other."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import chdtri

from jaxsonar.estimation.pose_graph import Link
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.loop_closure.pose_candidates import Prior, starts
from jaxsonar.loop_closure.submap import Submap
from jaxsonar.loop_closure.submap_matching import UNLIKELY, Pairs, covariance_of, gains, misfit, nearest, spread

STEPS = 3
NEAR = np.diag(np.square([0.02, 0.02, np.radians(1.0)]))
"""Covariance of a pose at which something was laid on something."""
APART = np.array([0.04, 0.04, np.radians(1.5)])
"""Metres and radians by which two ways to join differ."""
ALIKE = 0.5
"""Another way counts fully if its pairs have this share of the best one's nats."""
MARGIN = 4.0
"""Nats by which one way must beat those that differ."""


def joined(previous: Submap, following: Submap, number: int = 0) -> Link:
    """The chain link from a submap to the next one, with what both have seen.

    An iterated Kalman step: the exit and the reflectors of the previous submap are known jointly, and the next one
    measures its reflectors anew, independently, from its own frame.

    Args:
        previous: the submap that was left at ``exit``.
        following: the one that begins there.
        number: of the previous submap's node.

    Returns:
        The link from node ``number`` to ``number + 1``; by the exit alone where nothing is shared.
    """
    exit_cov = previous.covariance[:3, :3]
    alone = Link(number, number + 1, previous.exit, np.linalg.inv(exit_cov))
    if not (len(previous) and len(following)):
        return alone
    # Pairs are looked for around every pose that lays something on something, so that they agree from the beginning.
    ways: list[_Way] = []
    for pose in starts(previous, following, Prior(previous.exit, exit_cov)):
        way = _way(previous, following, pose)
        if way is not None:
            ways.append(way)
    if not ways:
        return alone
    best = max(ways, key=lambda way: way.gain - way.chi2 / 2)
    for way in ways:
        off = np.append(way.pose[:2] - best.pose[:2], wrap_angle(float(way.pose[2] - best.pose[2])))
        # Fewer pairs are no proof against a way where doors repeat: what counts is how far it is from the exit.
        less = min(0.0, way.gain - ALIKE * best.gain) - way.chi2 / 2 + best.chi2 / 2
        if (np.abs(off) > APART).any() and less > -MARGIN:
            return alone
    return Link(number, number + 1, best.pose, np.linalg.inv(best.covariance))


class _Way(NamedTuple):
    """One way to join two submaps."""

    pose: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    gain: float
    """Nats by which the pairs would beat chance if they fitted perfectly."""
    chi2: float


def _way(previous: Submap, following: Submap, pose: Float[np.ndarray, "3"]) -> _Way | None:
    """With the pairs that are near each other at a pose, as many as fit together and to the exit."""
    pairs = nearest(previous, following, pose, NEAR)
    fewest = max(1, int(np.ceil(2 * len(pairs) / 3)))
    while len(pairs) >= fewest:
        found, cov, chi2, share = _updated(previous, following, pairs)
        if chi2 <= chdtri(2 * len(pairs), UNLIKELY):
            return _Way(found, cov, float(gains(previous, following, pairs, found).sum()), chi2)
        pairs = pairs.without(int(share.argmax()))
    return None


def _updated(
    previous: Submap, following: Submap, pairs: Pairs
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"], float, Float[np.ndarray, " pairs"]]:
    """Exit after the pairs were used, its covariance, chi2 of all pairs before that, and the share of each in it."""
    count = len(pairs)
    unknown = np.concatenate([np.arange(3), (3 + 2 * pairs.earlier[:, None] + np.arange(2)).ravel()])
    known = previous.covariance[np.ix_(unknown, unknown)]
    mine = covariance_of(following, pairs.newest)
    pose, moved = previous.exit, np.zeros(len(unknown))
    chi2, share, cov = 0.0, np.zeros(count), known
    for step in range(STEPS):
        seen = misfit(previous, following, pairs.earlier, pairs.newest, pose)
        design = np.concatenate([seen.by_pose.reshape(-1, 3), -np.eye(2 * count)], axis=1)
        # The misfit was taken at the reflectors' places of before.
        surprise = seen.residual.ravel() - seen.by_pose.reshape(-1, 3) @ moved[:3]
        innovation = design @ known @ design.T + spread(seen.by_newest, mine)
        gain = np.linalg.solve(innovation, design @ known).T
        if not step:
            pulled = np.linalg.solve(innovation, surprise)
            chi2, share = float(surprise @ pulled), (surprise * pulled).reshape(-1, 2).sum(-1)
        moved = -gain @ surprise
        pose = previous.exit + moved[:3]
        cov = known - gain @ design @ known
    pose = np.append(pose[:2], wrap_angle(float(pose[2])))
    cov = cov[:3, :3]
    return pose, (cov + cov.T) / 2, chi2, share
