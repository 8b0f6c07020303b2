"""Whether and how the newest submap lies on an earlier one: a relative pose, and what else might be true.

Agreement alone proves little in buildings, where rooms and doors repeat. So a pose is held against two kinds of doubt:
every other pose that lays much on much, and every place within reach of the drift at which nothing contradicts the
newest submap, because there a room like the known one may stand that was never seen (``COPY``).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsonar import kernels
from jaxsonar.geometry.se2 import unit, wrap_angle
from jaxsonar.loop_closure.negative_evidence import Vicinity, against, surroundings
from jaxsonar.loop_closure.perceptual_aliasing import CERTAIN, NEAR, Doubts, Field, elsewhere, log_density, log_sum
from jaxsonar.loop_closure.pose_candidates import SIGMAS, Prior, starts
from jaxsonar.loop_closure.submap import Submap
from jaxsonar.loop_closure.submap_matching import Fit, Pairs, compatible, gains, nearest
from jaxsonar.registration.feature_map import quarter, tangent_of

REACH = 1.5
"""Walls as near as this are heard, metres."""
HONEST = 1.5
"""Standard deviations of the prior are taken this much larger than they claim."""
ROUGH = np.diag(np.square([0.04, 0.04, np.radians(1.5)]))
"""Covariance of a pose before its pairs are fitted."""
COPY, BESIDE = 0.3, 5.0
"""Probability that a place is built like another one, and how far apart such places stand, metres."""
ENOUGH, LEAST = 8.0, 4
"""Nats by which pairs must beat chance, and least number of pairs."""
MARGIN = 4.0
"""Nats by which the best pose must beat all others that lay something on something."""
LEVELS = 0.3
"""Pairs nearer to each other than this, metres, are at one level."""
CLEAN = 4.0
"""Most nats that may speak against a closure."""
ALIKE = 0.4
"""Another pose counts fully if its pairs have this share of the best one's nats: what repeats is no wonder."""
TIGHT = 0.1
"""Slack of contradictions at a fitted pose, metres."""


class Closure(NamedTuple):
    """How the newest submap lies on an earlier one."""

    relative: Float[np.ndarray, "3"]
    """earlier_from_newest."""
    information: Float[np.ndarray, "3 3"]
    """Inverse covariance; zero along parallel walls."""
    free: Float[np.ndarray, "2"] | None
    """The direction that is not determined, earlier frame, or None."""
    pairs: Pairs
    chi2: float
    freedom: int
    nats: float
    """By which the pairs beat chance."""
    weight: float
    """Logarithm of the prior's density there, less what speaks against it."""
    odds: float
    """Nats by which this beats all doubts together."""
    doubts: Doubts
    field: Field

    @property
    def basis(self) -> Float[np.ndarray, "3 rank"]:
        """Unit vectors of (x, y, theta) that are determined."""
        return _basis(self.free)


class _Laid(NamedTuple):
    """One way to lay them on one another."""

    pairs: Pairs
    fit: Fit
    nats: float
    against: float
    redundant: bool
    """Whether either way there are pairs at more than one level."""


def closure(
    newest: Submap,
    earlier: Submap,
    expected: Float[np.ndarray, "3"],
    covariance: Float[np.ndarray, "3 3"],
    *,
    reach: float = REACH,
    around: tuple[Vicinity, Vicinity] | None = None,
) -> Closure | None:
    """How the newest submap lies on the earlier one, or None where that is open.

    Args:
        newest: the submap that is moved.
        earlier: the submap that stays.
        expected: earlier_from_newest by what is known without them, metres and radians.
        covariance: of this.
        reach: walls as near as this to the robot are heard, metres.
        around: what is known about both, and about those along the path beside them; if left out, only of both.
    """
    if min(len(newest), len(earlier)) < 2:
        return None
    prior = Prior(expected, HONEST**2 * covariance + np.diag([1e-4, 1e-4, 1e-5]))
    around = around or (Vicinity(surroundings(earlier)), Vicinity(surroundings(newest)))
    own = around[0].own, around[1].own
    ways: dict[bytes, tuple[Pairs, Fit]] = {}
    for pose in starts(earlier, newest, prior):
        way = _laid(earlier, newest, pose, prior)
        if way is not None:
            ways.setdefault(np.stack(way[0]).tobytes(), way)
    if not ways:
        return None
    poses = np.array([fit.pose for _, fit in ways.values()])
    spoken = against(*own, poses, slack=TIGHT, reach=reach)
    laid = [
        _Laid(pairs, fit, _nats(earlier, newest, pairs, fit, prior), float(nats), redundant(earlier, pairs))
        for (pairs, fit), nats in zip(ways.values(), spoken, strict=True)
    ]
    best = max(laid, key=lambda one: one.nats - one.against)
    found = _judged(best, laid, around, prior, reach)
    if found is None and best.fit.free is None:
        # Where doors repeat, the walls of a corridor still say how far the robot is from them.
        walls = _corridor(earlier, newest, around, best, prior, reach)
        found = None if walls is None else _judged(walls, laid, around, prior, reach)
    return found


def _laid(earlier: Submap, newest: Submap, pose: Float[np.ndarray, "3"], prior: Prior) -> tuple[Pairs, Fit] | None:
    """Pairs near a pose, fitted, and looked for once more."""
    pairs = nearest(earlier, newest, pose, ROUGH)
    found = compatible(earlier, newest, pairs, pose, least=2)
    if found is not None:
        pose = found[1].pose
        again = nearest(earlier, newest, pose, np.linalg.inv(found[1].information + np.linalg.inv(ROUGH)))
        if not np.array_equal(np.stack(again), np.stack(found[0])):
            found = compatible(earlier, newest, again, pose, least=2)
    if found is None or prior.distance(found[1].pose[None])[0] > SIGMAS**2:
        return None
    return found


def redundant(earlier: Submap, pairs: Pairs) -> bool:
    """Whether along the longest wall and across it there are pairs at two levels or more.

    One jamb of a door looks like the other one; their distance does not.
    """
    row = pairs.earlier
    wall = row[earlier.kind[row] == kernels.PLANE]
    point = row[earlier.kind[row] != kernels.PLANE]
    at = earlier.anchor[point] + earlier.parameters[point]
    theta = earlier.parameters[wall, 1]
    foot = earlier.anchor[wall] + earlier.parameters[wall, :1] * unit(theta)
    longest = theta[np.diff(earlier.ends[wall], axis=-1)[:, 0].argmax()] if len(wall) else 0.0
    for way in (unit(float(longest)), tangent_of(float(longest))):
        facing = np.abs(unit(theta) @ way) > np.cos(np.radians(45.0))
        levels = np.concatenate([at @ way, foot[facing] @ way])
        if np.ptp(levels) < LEVELS if len(levels) else True:
            return False
    return True


def _nats(earlier: Submap, newest: Submap, pairs: Pairs, fit: Fit, prior: Prior) -> float:
    """By which pairs beat chance; less the room that the prior left for finding them by searching."""
    place = fit.information[:2, :2] - np.outer(fit.information[:2, 2], fit.information[2, :2]) / fit.information[2, 2]
    room = np.linalg.slogdet(np.eye(2) + prior.covariance[:2, :2] @ place)[1] / 2
    return float(gains(earlier, newest, pairs, fit.pose).sum() - fit.chi2 / 2 - room)


def _basis(free: Float[np.ndarray, "2"] | None) -> Float[np.ndarray, "3 rank"]:
    if free is None:
        return np.eye(3)
    return np.stack([np.append(quarter(free), 0.0), np.array([0.0, 0.0, 1.0])], axis=-1)


def _judged(
    best: _Laid, laid: list[_Laid], around: tuple[Vicinity, Vicinity], prior: Prior, reach: float
) -> Closure | None:
    """The closure, if nothing else that was laid comes near it; with its doubts."""
    fit, basis = best.fit, _basis(best.fit.free)
    enough = LEAST if fit.free is None else 2
    if best.nats < (ENOUGH if fit.free is None else 0.0) or len(best.pairs) < enough or best.against > CLEAN:
        return None
    if not (best.redundant if fit.free is None else _both_sides(best, around)):
        return None
    weight = float(log_density(prior, fit.pose[None], basis)[0]) - best.against
    rivals = [one for one in laid if one is not best and _apart(one.fit.pose, fit, basis)]
    poses = np.array([one.fit.pose for one in rivals]).reshape(-1, 3)
    nats = log_density(prior, poses, basis) - np.array([one.against for one in rivals])
    nats += np.array([min(0.0, one.nats - ALIKE * best.nats) for one in rivals])
    if log_sum(nats) > weight - MARGIN:
        return None
    place, density, field = elsewhere(fit, around, prior, reach)
    across = np.abs(place @ basis[:2]).max(axis=-1) if fit.free is not None else np.linalg.norm(place, axis=-1)
    out = across > NEAR
    unseen = density[out] + np.log(COPY) - (2 if fit.free is None else 1) * np.log(BESIDE)
    unseen += _rarer(place[out], _between_walls(best, around))
    doubts = Doubts(
        np.concatenate([poses[:, :2] - fit.pose[:2], place[out]]),
        np.concatenate([nats, unseen]),
        np.arange(len(rivals) + int(out.sum())) >= len(rivals),
    )
    odds = min(weight - log_sum(doubts.nats), CERTAIN)
    return Closure(
        fit.pose, fit.information, fit.free, best.pairs, fit.chi2, fit.freedom, best.nats, weight, odds, doubts, field
    )


def _both_sides(best: _Laid, around: tuple[Vicinity, Vicinity]) -> bool:
    """Whether walls on both sides of the robot are among the pairs."""
    walls = around[0].own.rows[:, None] == best.pairs.earlier
    theta = around[0].own.theta[walls.any(axis=1)]
    return bool((np.abs(wrap_angle(theta[:, None] - theta)) > np.pi / 2).any())


def _between_walls(best: _Laid, around: tuple[Vicinity, Vicinity]) -> Float[np.ndarray, "2"] | None:
    """Normal of the longest wall that is among the pairs, if there is one on the other side of the robot as well."""
    own = around[0].own
    walls = np.flatnonzero((own.rows[:, None] == best.pairs.earlier).any(axis=1))
    if not len(walls):
        return None
    longest = walls[own.half[walls].argmax()]
    opposite = np.abs(wrap_angle(own.theta[walls] - own.theta[longest])) > np.radians(150.0)
    return unit(own.theta[longest]) if opposite.any() else None


def _rarer(place: Float[np.ndarray, "places 2"], normal: Float[np.ndarray, "2"] | None) -> Float[np.ndarray, " places"]:
    """By how many nats places alike are rarer beside a corridor or room: they do not lie wall on wall."""
    if normal is None:
        return np.zeros(len(place))
    aside = np.abs(place @ normal)
    return np.where(aside > NEAR, np.log(-np.expm1(-np.square(np.maximum(aside, NEAR) / BESIDE))), 0.0)


def _apart(pose: Float[np.ndarray, "3"], fit: Fit, basis: Float[np.ndarray, "3 rank"]) -> bool:
    """Whether a pose is another one than that of a fit, as far as this is determined."""
    offset = pose - fit.pose
    offset[2] = wrap_angle(float(offset[2]))
    far = np.abs(basis.T @ offset) > np.append(np.full(basis.shape[1] - 1, 0.08), np.radians(3.0))
    return bool(far.any()) and bool(offset @ fit.information @ offset > 25.0)


def _corridor(
    earlier: Submap,
    newest: Submap,
    around: tuple[Vicinity, Vicinity],
    best: _Laid,
    prior: Prior,
    reach: float,
) -> _Laid | None:
    """Only those pairs of walls that run the way most of them do."""
    wall = np.flatnonzero(earlier.kind[best.pairs.earlier] == kernels.PLANE)
    if len(wall) < 2:
        return None
    row = best.pairs.earlier[wall]
    theta, length = earlier.parameters[row, 1], np.diff(earlier.ends[row], axis=-1)[:, 0]
    parallel = np.abs(np.sin(theta[:, None] - theta)) < np.sin(np.radians(5.0))
    kept = wall[parallel[(parallel @ length).argmax()]]
    pairs = Pairs(best.pairs.earlier[kept], best.pairs.newest[kept])
    found = compatible(earlier, newest, pairs, best.fit.pose, least=2)
    if found is None or found[1].free is None:
        return None
    pose = found[1].pose
    spoken = float(against(around[0].own, around[1].own, pose[None], slack=TIGHT, reach=reach)[0])
    return _Laid(*found, _nats(earlier, newest, *found, prior), spoken, True)
