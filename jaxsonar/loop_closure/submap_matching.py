"""Walls and points of two submaps laid on one another: least squares on their parameters with both covariances.

What is looked for is earlier_from_newest: (x, y, theta), metres and radians. Pairs must fit together, not only each by
itself (joint compatibility, Neira and Tardos 2001): the chi2 of all of them under their joint covariance.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import chdtri

from jaxsonar import kernels
from jaxsonar.geometry.se2 import unit, wrap_angle
from jaxsonar.loop_closure.submap import Submap
from jaxsonar.registration.feature_map import quarter, tangent_of, turned
from jaxsonar.registration.pose_likelihood import LINE_ROOM, POINT_ROOM, POINT_TRUST

UNLIKELY = 0.005
"""Probability that pairs that belong together are taken for incompatible."""
GATE = 14.0
"""Largest squared Mahalanobis distance of one pair."""
GAP = 1.0
"""Walls that are the same overlap, or leave at most this gap, metres."""
SAME_WAY = np.radians(10.0)
"""Walls nearer than this to parallel do not say where along them the robot is."""
GAIN = 4.0
"""Most nats that one reflector is worth."""
STEPS, STILL = 8, 1e-5
"""Most steps of a fit, and the step in metres and radians that ends it."""


class Pairs(NamedTuple):
    """Rows of two submaps that are the same reflector."""

    earlier: Int[np.ndarray, " pairs"]
    newest: Int[np.ndarray, " pairs"]

    def __len__(self) -> int:
        return len(self.earlier)

    def without(self, row: int) -> "Pairs":
        """All but one."""
        return Pairs(np.delete(self.earlier, row), np.delete(self.newest, row))


class Misfit(NamedTuple):
    """By how much the newest submap's reflectors miss the earlier one's, in the parameters of the latter."""

    residual: Float[np.ndarray, "*pairs 2"]
    by_pose: Float[np.ndarray, "*pairs 2 3"]
    """Derivative by earlier_from_newest."""
    by_newest: Float[np.ndarray, "*pairs 2 2"]
    """Derivative by the newest submap's parameters; that by the earlier one's is minus one."""


class Fit(NamedTuple):
    """Where pairs put the newest submap."""

    pose: Float[np.ndarray, "3"]
    """earlier_from_newest."""
    information: Float[np.ndarray, "3 3"]
    """Zero in the direction that the pairs do not determine."""
    free: Float[np.ndarray, "2"] | None
    """This direction, a unit vector of the earlier frame, or None."""
    chi2: float
    freedom: int
    """Degrees of freedom of chi2."""
    share: Float[np.ndarray, " pairs"]
    """Of each pair in the chi2."""

    @property
    def compatible(self) -> bool:
        """Whether the pairs fit together."""
        return bool(self.chi2 <= chdtri(max(self.freedom, 1), UNLIKELY))


def misfit(
    earlier: Submap,
    newest: Submap,
    rows: Int[np.ndarray, "*#pairs"],
    others: Int[np.ndarray, "*#pairs"],
    pose: Float[np.ndarray, "3"],
) -> Misfit:
    """Of these rows of the earlier and others of the newest submap, which are of one kind pair by pair."""
    rows, others = np.broadcast_arrays(rows, others)
    heading = np.asarray(pose[2])
    mine, known = newest.parameters[others], earlier.parameters[rows]
    lever = turned(newest.anchor[others], heading)
    offset = lever + pose[:2] - earlier.anchor[rows]
    theta = mine[..., 1] + pose[2]
    normal, tangent = unit(theta), tangent_of(theta)
    along = (tangent * offset).sum(-1)
    line = np.stack([mine[..., 0] + (normal * offset).sum(-1) - known[..., 0], wrap_angle(theta - known[..., 1])], -1)
    arm = lever + turned(mine, heading)
    point = arm + pose[:2] - earlier.anchor[rows] - known
    wall = (earlier.kind[rows] == kernels.PLANE)[..., None]
    by_pose = np.zeros((*rows.shape, 2, 3))
    by_pose[..., 0, :2] = np.where(wall, normal, [1.0, 0.0])
    by_pose[..., 1, :2] = np.where(wall, 0.0, [0.0, 1.0])
    swing = np.stack([along + (normal * quarter(lever)).sum(-1), np.ones(rows.shape)], axis=-1)
    by_pose[..., 2] = np.where(wall, swing, quarter(arm))
    c, s = np.cos(pose[2]), np.sin(pose[2])
    by_line = np.zeros((*rows.shape, 2, 2))
    by_line[..., 0, 0] = by_line[..., 1, 1] = 1.0
    by_line[..., 0, 1] = along
    by_newest = np.where(wall[..., None], by_line, np.array([[c, -s], [s, c]]))
    return Misfit(np.where(wall, line, point), by_pose, by_newest)


def blocks(submap: Submap) -> Float[np.ndarray, "reflectors 2 2"]:
    """Covariance of the parameters of each reflector by itself."""
    count, row = len(submap), np.arange(len(submap))
    return submap.covariance[3:, 3:].reshape(count, 2, count, 2)[row, :, row]


def covariance_of(submap: Submap, rows: Int[np.ndarray, " rows"]) -> Float[np.ndarray, "unknowns unknowns"]:
    """Joint covariance of the parameters of these reflectors."""
    unknown = (3 + 2 * rows[:, None] + np.arange(2)).ravel()
    return submap.covariance[np.ix_(unknown, unknown)]


def spread(design: Float[np.ndarray, "pairs 2 2"], joint: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """A joint covariance of pairs after each went through its own derivative."""
    count = len(design)
    return np.einsum("aij,ajbk,blk->aibl", design, joint.reshape(count, 2, count, 2), design).reshape(joint.shape)


def gains(earlier: Submap, newest: Submap, pairs: Pairs, pose: Float[np.ndarray, "3"]) -> Float[np.ndarray, " pairs"]:
    """Nats by which each pair would beat chance if it fitted perfectly."""
    seen = misfit(earlier, newest, pairs.earlier, pairs.newest, pose)
    cov = seen.by_newest @ blocks(newest)[pairs.newest] @ seen.by_newest.swapaxes(1, 2) + blocks(earlier)[pairs.earlier]
    line = np.log(2 * LINE_ROOM) - np.log(2 * np.pi * cov[:, 0, 0]) / 2
    point = POINT_TRUST * (np.log(POINT_ROOM / (2 * np.pi)) - np.linalg.slogdet(cov)[1] / 2)
    return np.minimum(np.where(newest.kind[pairs.newest] == kernels.PLANE, line, point), GAIN)


def nearest(earlier: Submap, newest: Submap, pose: Float[np.ndarray, "3"], pose_cov: Float[np.ndarray, "3 3"]) -> Pairs:
    """Reflectors of one kind that are each other's nearest in Mahalanobis distance, within the gate.

    Args:
        earlier: its reflectors stay.
        newest: its reflectors are moved.
        pose: earlier_from_newest.
        pose_cov: its covariance.
    """
    if not (len(earlier) and len(newest)):
        return Pairs(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    rows, others = np.arange(len(earlier))[:, None], np.arange(len(newest))
    seen = misfit(earlier, newest, rows, others, pose)
    cov = seen.by_newest @ blocks(newest) @ seen.by_newest.swapaxes(-1, -2) + blocks(earlier)[:, None]
    cov = cov + seen.by_pose @ pose_cov @ seen.by_pose.swapaxes(-1, -2)
    distance = (seen.residual * np.linalg.solve(cov, seen.residual[..., None])[..., 0]).sum(-1)
    distance[earlier.kind[:, None] != newest.kind] = np.inf
    distance[gaps(earlier, newest, pose) > GAP] = np.inf
    best, back = distance.argmin(axis=0), distance.argmin(axis=1)
    mutual = (back[best] == others) & (distance[best, others] < GATE)
    return Pairs(best[mutual], others[mutual])


def gaps(earlier: Submap, newest: Submap, pose: Float[np.ndarray, "3"]) -> Float[np.ndarray, "earlier newest"]:
    """How far apart along them walls end that are on one line, metres; 0 where they overlap, and for points."""
    theta = newest.parameters[:, 1]
    foot = newest.anchor + newest.parameters[:, :1] * unit(theta)
    ends = foot[:, None] + newest.ends[..., None] * tangent_of(theta)[:, None]
    ends = turned(ends, np.asarray(pose[2])) + pose[:2]
    along = np.einsum(
        "etk,ek->et", (ends.reshape(1, -1, 2) - earlier.anchor[:, None]), tangent_of(earlier.parameters[:, 1])
    )
    along = along.reshape(len(earlier), -1, 2)
    gap = np.maximum(along.min(-1) - earlier.ends[:, 1:], earlier.ends[:, :1] - along.max(-1))
    walls = (earlier.kind[:, None] == kernels.PLANE) & (newest.kind == kernels.PLANE)
    return np.where(walls, np.maximum(gap, 0.0), 0.0)


def fitted(earlier: Submap, newest: Submap, pairs: Pairs, pose: Float[np.ndarray, "3"]) -> Fit:
    """Where these pairs put the newest submap; along parallel walls it stays where it is.

    Args:
        earlier: the submap that stays.
        newest: the submap that is moved.
        pairs: at least one.
        pose: earlier_from_newest, near the solution.
    """
    free = _free_direction(earlier, newest, pairs, pose)
    held = np.eye(3)
    if free is not None:
        held[:2, :2] -= np.outer(free, free)
    known = covariance_of(earlier, pairs.earlier)
    mine = covariance_of(newest, pairs.newest)
    step, information, residual, pulled = np.ones(3), np.zeros((3, 3)), np.zeros(0), np.zeros(0)
    for _ in range(STEPS):
        seen = misfit(earlier, newest, pairs.earlier, pairs.newest, pose)
        design, residual = seen.by_pose.reshape(-1, 3) @ held, seen.residual.ravel()
        weighted = np.linalg.solve(known + spread(seen.by_newest, mine), np.column_stack([design, residual]))
        information, pulled = design.T @ weighted[:, :3], weighted[:, 3]
        if np.abs(step).max() < STILL:
            break
        step = -np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ (design.T @ pulled)
        pose = pose + step
    rank = 3 if free is None else 2
    return Fit(
        pose=np.append(pose[:2], wrap_angle(float(pose[2]))),
        information=(information + information.T) / 2,
        free=free,
        chi2=float(residual @ pulled),
        freedom=2 * len(pairs) - rank,
        share=(residual * pulled).reshape(-1, 2).sum(-1),
    )


def _free_direction(
    earlier: Submap, newest: Submap, pairs: Pairs, pose: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "2"] | None:
    """The way along walls that are all parallel, if there is no point to hold it."""
    wall = newest.kind[pairs.newest] == kernels.PLANE
    if not wall.all():
        return None
    theta = earlier.parameters[pairs.earlier, 1]
    if (np.abs(np.sin(theta[:, None] - theta)) > np.sin(SAME_WAY)).any():
        return None
    double = np.exp(2j * theta).sum()
    return tangent_of(float(np.angle(double)) / 2)


def compatible(
    earlier: Submap, newest: Submap, pairs: Pairs, pose: Float[np.ndarray, "3"], *, least: int
) -> tuple[Pairs, Fit] | None:
    """The pairs that fit together, and where they put the newest submap: what fits least is left out until all does.

    None where fewer than ``least`` pairs remain, or fewer than two thirds of them.
    """
    fewest = max(least, int(np.ceil(2 * len(pairs) / 3)))
    while len(pairs) >= fewest:
        fit = fitted(earlier, newest, pairs, pose)
        if fit.compatible:
            return pairs, fit
        pairs = pairs.without(int(fit.share.argmax()))
    return None
