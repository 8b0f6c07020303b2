"""Detection of a loop closure: the relative pose of the newest submap and an earlier one, and its log-odds.

A pose is compared with two kinds of alternatives: every other pose at which many reflectors agree, and every position
within the prior that no negative evidence excludes, because there a similar place may exist that was never observed
(perceptual aliasing).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsonar import kernels
from jaxsonar.geometry.landmarks import landmark_positions
from jaxsonar.geometry.se2 import diagonal_covariance, perpendicular, subtract_poses, tangent_of, unit, wrap_angle
from jaxsonar.loop_closure.perceptual_aliasing import (
    AlternativeHypotheses,
    PenaltyGrid,
    enumerate_alternatives,
    log_sum_exp,
)
from jaxsonar.loop_closure.pose_candidates import PosePrior, pose_candidates
from jaxsonar.loop_closure.settings import SETTINGS
from jaxsonar.loop_closure.submap import Submap
from jaxsonar.loop_closure.submap_matching import (
    Pairs,
    PoseFit,
    fit_compatible_pairs,
    log_likelihood_ratios,
    nearest_pairs,
)
from jaxsonar.loop_closure.submap_negative_evidence import submap_negative_evidence
from jaxsonar.loop_closure.submap_view import SubmapNeighborhood, SubmapView


class ClosureMeasurement(NamedTuple):
    """Measured relative pose of the newest submap and an earlier one."""

    earlier_from_newest: Float[np.ndarray, "3"]
    """Metres and radians."""
    information: Float[np.ndarray, "3 3"]
    """Inverse covariance; zero along parallel walls."""
    undetermined_direction: Float[np.ndarray, "2"] | None
    """Direction that is not determined, a unit vector of the earlier frame, or None."""
    pairs: Pairs
    chi2: float
    dof: int
    log_likelihood_ratio: float
    """Log-likelihood ratio of the pairs against chance, nats."""
    log_weight: float
    """Log-density of the prior minus the negative evidence, nats."""
    log_odds: float
    """Log-odds against all alternatives together, nats."""
    alternatives: AlternativeHypotheses
    grid: PenaltyGrid

    @property
    def basis(self) -> Float[np.ndarray, "3 rank"]:
        """Orthonormal basis of the directions of (x, y, theta) that are determined."""
        return _basis(self.undetermined_direction)


class _AlignedPair(NamedTuple):
    """One alignment of the two submaps."""

    pairs: Pairs
    fit: PoseFit
    log_likelihood_ratio: float
    """Log-likelihood ratio of the pairs against chance, nats."""
    negative_evidence: float
    is_redundant: bool
    """Whether the pairs determine each axis at more than one position."""


def detect_closure(
    newest: Submap,
    earlier: Submap,
    expected: Float[np.ndarray, "3"],
    covariance: Float[np.ndarray, "3 3"],
    *,
    reliable_range: float = SETTINGS.reliable_range,
    neighborhoods: tuple[SubmapNeighborhood, SubmapNeighborhood] | None = None,
) -> ClosureMeasurement | None:
    """Measure the relative pose of two submaps; None where it is ambiguous.

    Args:
        newest: the submap that is moved.
        earlier: the submap that stays.
        expected: expected earlier_from_newest, from the pose graph, metres and radians.
        covariance: its covariance.
        reliable_range: walls within this distance of the robot are surely detected, metres.
        neighborhoods: views of the earlier and of the newest submap; without neighbors if left out.
    """
    if min(len(newest), len(earlier)) < 2:
        return None
    prior = PosePrior(expected, SETTINGS.inflation**2 * covariance + np.diag([1e-4, 1e-4, 1e-5]))
    views = neighborhoods or (SubmapNeighborhood(SubmapView.of(earlier)), SubmapNeighborhood(SubmapView.of(newest)))
    # 1. Pairs and fit from every candidate pose; each set of pairs once.
    fits: dict[bytes, tuple[Pairs, PoseFit]] = {}
    for pose in pose_candidates(earlier, newest, prior):
        found = _fit_from(earlier, newest, pose, prior)
        if found is not None:
            fits.setdefault(np.stack(found[0]).tobytes(), found)
    if not fits:
        return None
    # 2. Negative evidence against each.
    poses = np.array([fit.pose for _, fit in fits.values()])
    against = _negative_evidence(views, poses, reliable_range)
    aligned = [
        _AlignedPair(
            pairs,
            fit,
            _log_likelihood_ratio(earlier, newest, pairs, fit, prior),
            float(nats),
            _is_redundant(earlier, pairs),
        )
        for (pairs, fit), nats in zip(fits.values(), against, strict=True)
    ]
    # 3. The best against all others and against perceptual aliasing.
    best = max(aligned, key=lambda one: one.log_likelihood_ratio - one.negative_evidence)
    measured = _compare(best, aligned, views, prior, reliable_range)
    if measured is None and best.fit.undetermined_direction is None:
        # Where doors repeat, the walls of a corridor still determine the distance from them.
        corridor = _corridor_alignment(earlier, newest, views, best, prior, reliable_range)
        measured = None if corridor is None else _compare(corridor, aligned, views, prior, reliable_range)
    return measured


def _negative_evidence(
    views: tuple[SubmapNeighborhood, SubmapNeighborhood], poses: Float[np.ndarray, "poses 3"], reliable_range: float
) -> Float[np.ndarray, " poses"]:
    tolerance = SETTINGS.negative_evidence_tolerance
    return submap_negative_evidence(
        views[0].own, views[1].own, poses, tolerance=tolerance, reliable_range=reliable_range
    )


def _fit_from(
    earlier: Submap, newest: Submap, pose: Float[np.ndarray, "3"], prior: PosePrior
) -> tuple[Pairs, PoseFit] | None:
    """Pairs near a pose and their fit; the pairs are searched again at the fit."""
    rough = diagonal_covariance(SETTINGS.rough_pose_sd)
    pairs = nearest_pairs(earlier, newest, pose, rough)
    found = fit_compatible_pairs(earlier, newest, pairs, pose, least=2)
    if found is not None:
        pose = found[1].pose
        again = nearest_pairs(earlier, newest, pose, np.linalg.inv(found[1].information + np.linalg.inv(rough)))
        if not np.array_equal(np.stack(again), np.stack(found[0])):
            found = fit_compatible_pairs(earlier, newest, again, pose, least=2)
    if found is None or prior.distance(found[1].pose[None])[0] > SETTINGS.search_sd**2:
        return None
    return found


def _is_redundant(earlier: Submap, pairs: Pairs) -> bool:
    """Whether pairs determine the position at two or more levels, both along the longest wall and across it.

    One jamb of a door looks like the other one; their distance does not.
    """
    paired = earlier.landmarks.take(pairs.earlier)
    wall = paired.kind == kernels.PLANE
    positions = landmark_positions(paired)
    position, foot, theta = positions[~wall], positions[wall], np.asarray(paired.parameters)[wall, 1]
    longest = theta[np.diff(paired.extent[wall], axis=-1)[:, 0].argmax()] if wall.any() else 0.0
    for axis in (unit(float(longest)), tangent_of(float(longest))):
        facing = np.abs(unit(theta) @ axis) > np.cos(SETTINGS.facing_angle)
        levels = np.concatenate([position @ axis, foot[facing] @ axis])
        if np.ptp(levels) < SETTINGS.min_level_distance if len(levels) else True:
            return False
    return True


def _log_likelihood_ratio(earlier: Submap, newest: Submap, pairs: Pairs, fit: PoseFit, prior: PosePrior) -> float:
    """Log-likelihood ratio of pairs against chance, less the volume of the prior that was searched, nats."""
    information = fit.information
    position = information[:2, :2] - np.outer(information[:2, 2], information[2, :2]) / information[2, 2]
    volume = np.linalg.slogdet(np.eye(2) + prior.covariance[:2, :2] @ position)[1] / 2
    return float(log_likelihood_ratios(earlier, newest, pairs, fit.pose).sum() - fit.chi2 / 2 - volume)


def _basis(free: Float[np.ndarray, "2"] | None) -> Float[np.ndarray, "3 rank"]:
    if free is None:
        return np.eye(3)
    return np.stack([np.append(perpendicular(free), 0.0), np.array([0.0, 0.0, 1.0])], axis=-1)


def _compare(
    best: _AlignedPair,
    aligned: list[_AlignedPair],
    views: tuple[SubmapNeighborhood, SubmapNeighborhood],
    prior: PosePrior,
    reliable_range: float,
) -> ClosureMeasurement | None:
    """The closure with its alternatives, or None if another alignment comes near it."""
    fit, basis = best.fit, _basis(best.fit.undetermined_direction)
    # 1. Enough pairs that determine the pose redundantly, and little negative evidence.
    full = fit.undetermined_direction is None
    min_pairs = SETTINGS.min_pairs if full else SETTINGS.min_corridor_pairs
    if best.log_likelihood_ratio < (SETTINGS.min_log_likelihood_ratio if full else 0.0) or len(best.pairs) < min_pairs:
        return None
    if best.negative_evidence > SETTINGS.max_negative_evidence:
        return None
    if not (best.is_redundant if full else _has_both_sides(best, views[0].own)):
        return None
    # 2. Other alignments. Repeating structures have many pairs in common: enough of them count fully.
    log_weight = float(prior.log_density(fit.pose[None], basis)[0]) - best.negative_evidence
    rivals = [one for one in aligned if one is not best and _is_distinct(one.fit.pose, fit, basis)]
    poses = np.array([one.fit.pose for one in rivals]).reshape(-1, 3)
    nats = prior.log_density(poses, basis) - np.array([one.negative_evidence for one in rivals])
    ratio = np.array([one.log_likelihood_ratio for one in rivals])
    nats += np.minimum(0.0, ratio - SETTINGS.similarity * best.log_likelihood_ratio)
    if log_sum_exp(nats) > log_weight - SETTINGS.margin:
        return None
    # 3. Places that look alike and were never observed.
    offset, density, grid = enumerate_alternatives(fit, *views, prior, reliable_range=reliable_range)
    distance = np.linalg.norm(offset, axis=-1) if full else np.abs(offset @ basis[:2]).max(axis=-1)
    out = distance > SETTINGS.alternative_distance
    aliased = density[out] + np.log(SETTINGS.aliasing_probability)
    aliased -= (2 if full else 1) * np.log(SETTINGS.aliasing_spacing)
    aliased += _log_rarity(offset[out], _normal_between_walls(best, views[0].own))
    alternatives = AlternativeHypotheses(
        np.concatenate([poses[:, :2] - fit.pose[:2], offset[out]]),
        np.concatenate([nats, aliased]),
        np.arange(len(rivals) + int(out.sum())) >= len(rivals),
    )
    log_odds = min(log_weight - log_sum_exp(alternatives.log_weight), SETTINGS.max_log_odds)
    return ClosureMeasurement(
        earlier_from_newest=fit.pose,
        information=fit.information,
        undetermined_direction=fit.undetermined_direction,
        pairs=best.pairs,
        chi2=fit.chi2,
        dof=fit.dof,
        log_likelihood_ratio=best.log_likelihood_ratio,
        log_weight=log_weight,
        log_odds=log_odds,
        alternatives=alternatives,
        grid=grid,
    )


def _has_both_sides(best: _AlignedPair, earlier: SubmapView) -> bool:
    """Whether walls on both sides of the robot are among the pairs."""
    walls = earlier.row[:, None] == best.pairs.earlier
    theta = earlier.features.theta[walls.any(axis=1)]
    return bool((np.abs(wrap_angle(theta[:, None] - theta)) > np.pi / 2).any())


def _normal_between_walls(best: _AlignedPair, earlier: SubmapView) -> Float[np.ndarray, "2"] | None:
    """Normal of the longest paired wall, if a wall on the opposite side of the robot is paired as well."""
    walls = np.flatnonzero((earlier.row[:, None] == best.pairs.earlier).any(axis=1))
    if not len(walls):
        return None
    theta = earlier.features.theta
    longest = walls[earlier.features.half_length[walls].argmax()]
    opposite = np.abs(wrap_angle(theta[walls] - theta[longest])) > SETTINGS.opposite_angle
    return unit(theta[longest]) if opposite.any() else None


def _log_rarity(
    offset: Float[np.ndarray, "offsets 2"], normal: Float[np.ndarray, "2"] | None
) -> Float[np.ndarray, " offsets"]:
    """Log-factor by which similar places are rarer beside a corridor or room: their walls would overlap."""
    if normal is None:
        return np.zeros(len(offset))
    aside, least = np.abs(offset @ normal), SETTINGS.alternative_distance
    rarity = np.log(-np.expm1(-np.square(np.maximum(aside, least) / SETTINGS.aliasing_spacing)))
    return np.where(aside > least, rarity, 0.0)


def _is_distinct(pose: Float[np.ndarray, "3"], fit: PoseFit, basis: Float[np.ndarray, "3 rank"]) -> bool:
    """Whether a pose differs from a fit in the determined directions."""
    offset = subtract_poses(pose, fit.pose)
    position, heading = SETTINGS.distinct_pose
    far = np.abs(basis.T @ offset) > np.append(np.full(basis.shape[1] - 1, position), heading)
    return bool(far.any()) and bool(offset @ fit.information @ offset > SETTINGS.distinct_chi2)


def _corridor_alignment(
    earlier: Submap,
    newest: Submap,
    views: tuple[SubmapNeighborhood, SubmapNeighborhood],
    best: _AlignedPair,
    prior: PosePrior,
    reliable_range: float,
) -> _AlignedPair | None:
    """Alignment by the walls alone that are parallel to most of the paired walls."""
    paired = earlier.landmarks.take(best.pairs.earlier)
    wall = np.flatnonzero(paired.kind == kernels.PLANE)
    if len(wall) < 2:
        return None
    theta, length = paired.parameters[wall, 1], np.diff(paired.extent[wall], axis=-1)[:, 0]
    parallel = np.abs(np.sin(theta[:, None] - theta)) < np.sin(SETTINGS.corridor_angle)
    kept = wall[parallel[(parallel @ length).argmax()]]
    pairs = Pairs(best.pairs.earlier[kept], best.pairs.newest[kept])
    found = fit_compatible_pairs(earlier, newest, pairs, best.fit.pose, least=2)
    if found is None or found[1].undetermined_direction is None:
        return None
    against = float(_negative_evidence(views, found[1].pose[None], reliable_range)[0])
    return _AlignedPair(*found, _log_likelihood_ratio(earlier, newest, *found, prior), against, True)
