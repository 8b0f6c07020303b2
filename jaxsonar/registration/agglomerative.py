"""Poses without odometry from the ranges: parts are laid on one another, the surest first.

At first every scan is a part. Two parts whose scans follow one another are laid on each other in every way in which a
few of their reflectors agree; each way is adjusted with all echoes and weighed in nats: fewer reflectors explain the
same echoes, the motion is a usual one, nothing is silent that should be heard, no wall is in the way. What beats all
other ways is done, the surest of all pairs first, so that a scan that may lie in two places waits for those beside it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.detection.extract import LocalModel
from jaxsonar.geometry.se2 import composed, inverse, relative, unit, wrap_angle
from jaxsonar.registration.cluster_adjustment import (
    POINT_ROOM,
    Part,
    adjusted,
    merged,
    settled,
    single,
    where_walls_meet,
)
from jaxsonar.registration.echo_targets import Views
from jaxsonar.registration.feature_map import Places, Seen, tangent_of, turned
from jaxsonar.registration.negative_evidence import against, loose_explained
from jaxsonar.registration.pose_hypotheses import ANY_TURN, STEP, TURN, hypotheses, thinned
from jaxsonar.registration.pose_likelihood import explained
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

MARGIN = 6.0
"""Nats by which a way to lay two parts on each other must be likelier than all others."""
UNRELATED = 3.0
"""Nats that it costs not to know anything again: a robot hardly moves from a scan to the next."""
OPEN = 2.0
"""Nats less by which a way must beat one that leaves a direction open, and of which it is a part."""
GAP = 2
"""Scans that follow one another are at most so many apart."""
STEADY, GOES_ON = 0.4, (0.12, float(np.radians(12.0)))
"""Probability that a robot goes on as before, and standard deviations of that, metres and radians a scan."""
ELSEWHERE = (0.1, float(np.radians(5.0)))
"""Metres and radians between poses that are not the same."""
SURE = (0.1, float(np.radians(4.0)))
"""Largest standard deviations of a pose that is determined, metres and radians."""
KEPT, TRIED = 200, 12
"""Poses that are refined by features, and those that are then adjusted by the ranges."""
WORSE = 3.0
"""Nats that echoes may fit worse for two reflectors being one, before they are taken apart to see."""
_VIABLE = 6.0  # nats by which a kind may be behind the best one to be looked at
_TRUST = 0.3  # of the nats between the kinds
_FARTHEST = 3.0  # standard deviations of the motion
_CELL, _ALONG = (0.05, float(np.radians(2.0))), 0.08  # m, rad
_FINE = np.array([0.01, 0.01, 0.01])  # m, rad; nearer poses are the same
_FLOOR = (0.006, float(np.radians(0.4)), 0.01)  # m, rad, m; of walls across and in direction, and of points
_VAGUE = (0.02, 0.06, 0.05, 0.1)  # the same of what is more likely of another kind, and most of points
_AGREE, _BEYOND = 20.0, 2.5  # squared standard deviations; m between stretches of one wall
_ROUNDS, _STEPS = 5, 4
_ALONG_OPEN = np.linspace(-2.0, 2.0, 9)  # standard deviations


def place_ranges(
    ring: Ring,
    log: Log,
    models: Sequence[LocalModel],
    *,
    sigma: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Part]:
    """Poses of scans without odometry, in parts that could not be laid on one another.

    Args:
        ring: the sensors, calibrated.
        log: the echoes, in the order of the way; its poses are not looked at.
        models: local models of its scans.
        sigma: noise of the ranges, metres; that of the local models if left out.
        progress: called with (scans laid on others, scans).

    Returns:
        The parts, the one with the most scans first; each in the frame of its first scan, to which its covariances are.
    """
    noise = [model.sigma for model in models if model.sigma > 0]
    views = Views.of(ring, log, models, sigma or (float(np.median(noise)) if noise else 0.003))
    parts = [single(views, scan) for scan in range(len(models))]
    ways: dict[tuple[Part, Part], tuple[float, Way | None]] = {}
    while True:
        if progress is not None:
            progress(len(models) - len(parts), len(models))
        pairs = [(a, b) for k, a in enumerate(parts) for b in parts[k + 1 :] if _gap(a, b)[2] <= GAP]
        for a, b in pairs:
            if (a, b) not in ways:
                ways[a, b] = only_way(lay(views, a, b) if len(a.rows) >= len(b.rows) else lay(views, b, a))
        sure = [(ways[pair][0], pair) for pair in pairs if ways[pair][1] is not None]
        if not sure:
            break
        _, (a, b) = max(sure, key=lambda one: one[0])
        way = ways[a, b][1]
        assert way is not None
        parts = [part for part in parts if part is not a and part is not b] + [way.part]
    parts = [confirmed(views, part) for part in parts]
    parts.sort(key=lambda part: (-len(part.rows), part.rows[0]))
    return [_from_first(views, part) for part in parts]


def _from_first(views: Views, part: Part) -> Part:
    """The same in the frame of its first scan."""
    first = int(part.rows[0])
    part = adjusted(views, part, steps=3, held=first)
    part = part.moved(inverse(part.poses[first]))
    part.poses[first] = 0.0  # to the last digit
    return part


@dataclass(frozen=True, eq=False)
class Way:
    """One way to lay a part on another one."""

    part: Part
    """Both as one."""
    pose: Float[np.ndarray, "3"]
    """a_from_b of the scans at which they meet."""
    cov: Float[np.ndarray, "3 3"]
    pairs: tuple[tuple[int, int], ...]
    """Reflectors that are the same."""
    nats: float
    """For it, against the two having nothing in common, without what follows."""
    against: float
    """Nats of silence and walls in the way."""

    @property
    def gain(self) -> float:
        """All in all, nats."""
        return self.nats - self.against

    @property
    def open(self) -> bool:
        """Whether the pose is not determined."""
        return bool(np.linalg.eigvalsh(self.cov[:2, :2])[-1] > SURE[0] ** 2 or self.cov[2, 2] > SURE[1] ** 2)

    def covers(self, pose: Float[np.ndarray, "3"]) -> bool:
        """Whether a pose is within three standard deviations."""
        off = _offset(pose, self.pose)
        return bool(off @ np.linalg.solve(self.cov + np.diag(_FINE**2), off) < 9.0)


def only_way(ways: Sequence[Way]) -> tuple[float, Way | None]:
    """Nats by which the best way beats all others, and that way if it is the only one."""
    if not ways:
        return -np.inf, None
    best = max(ways, key=lambda way: way.gain)
    ahead = best.gain + UNRELATED
    for way in ways:
        if not _elsewhere(way.pose, best.pose):
            continue
        # Along what it leaves open it may lie where nothing is against it.
        within = way.covers(best.pose)
        ahead = min(ahead, best.nats - way.nats + OPEN if within else best.gain - way.gain)
    return ahead, best if ahead > MARGIN and not best.open else None


def confirmed(views: Views, part: Part) -> Part:
    """A part without the scans that the map of all others would place elsewhere."""
    for scan in part.rows if len(part.rows) > 2 else ():
        rest = settled(views, part.without(views.targets.scan, scan))
        ways = [way for way in lay(views, rest, single(views, scan)) if not way.open]
        near = _gap(rest, single(views, scan))[0]
        best = max(ways, key=lambda way: way.gain, default=None)
        if best is not None and _elsewhere(best.pose, relative(part.poses[near], part.poses[scan])):
            part = rest
    return part


def lay(views: Views, a: Part, b: Part) -> list[Way]:
    """Ways to lay a part on another one, at the scans that are nearest to each other on the way of the robot."""
    first, second, gap = _gap(a, b)
    a, b = (adjusted(views, part, steps=3, held=scan) for part, scan in ((a, first), (b, second)))
    a, b = a.moved(inverse(a.poses[first])), b.moved(inverse(b.poses[second]))
    link = _Link(views, a, b, first, second, gap)
    ways: list[Way] = []
    tried: list[tuple[frozenset[tuple[int, int]], np.ndarray]] = []
    for pose in _poses(a, b, gap):
        way = None
        for _ in range(_ROUNDS):  # nearer, other reflectors may agree
            pairs = _same(a, b.moved(pose))
            seen = any(set(pairs) == those and not _elsewhere(pose, there) for those, there in tried)
            known = any(way.open and set(pairs) == set(way.pairs) and way.covers(pose) for way in ways)
            if not pairs or seen or known:
                break
            tried.append((frozenset(pairs), pose))
            way = link.way(pose, pairs)
            pose = way.pose
        ways += [] if way is None else [way]
    best = max((way.gain for way in ways if not way.open), default=-np.inf)
    return [link.eased(way) if way.open and way.nats > best - MARGIN - OPEN else way for way in ways]


@dataclass(frozen=True)
class _Link:
    """Two parts, each in the frame of the scan at which they meet."""

    views: Views
    a: Part
    b: Part
    first: int
    second: int
    gap: int

    def way(self, pose: Float[np.ndarray, "3"], pairs: list[tuple[int, int]]) -> Way:
        """The way that begins with a pose and with reflectors that are the same; they are taken apart if that fits."""
        part = self._together(pose, pairs)
        before = np.where(self.a.owner >= 0, self.a.squares, self.b.squares)
        mine = np.flatnonzero(part.owner >= 0)
        while len(pairs) > 1:
            worse = np.bincount(part.owner[mine], (part.squares - before)[mine] / 2, minlength=len(part.kind))
            worse = worse[[row for row, _ in pairs]]
            fewer = [pair for k, pair in enumerate(pairs) if k != worse.argmax()]
            other = self._together(pose, fewer) if worse.max() > WORSE else part
            if other.evidence <= part.evidence:
                break
            part, pairs = other, fewer
        step = relative(part.poses[self.first], part.poses[self.second])
        nats = part.evidence - self.a.evidence - self.b.evidence + self._motion(part, step)
        nats += loose_explained(self.views, part) - self._alone[1]
        nats -= _no_news(part, pairs) + _beyond(self.a, self.b.moved(step), pairs)
        return Way(part, step, part.pose_cov[self.second], tuple(pairs), nats, self._against(part))

    def eased(self, way: Way) -> Way:
        """A way that leaves a direction open, where along it least is against it."""
        spread, axes = np.linalg.eigh(way.cov[:2, :2])
        along = min(float(np.sqrt(spread[-1])), 1.0) * axes[:, -1]
        least = way.against
        for sd in _ALONG_OPEN:
            there = merged(self.a, self.b.moved(way.pose + np.append(sd * along, 0.0)), way.pairs)
            part = adjusted(self.views, there, steps=1, held=self.first)
            least = min(least, self._against(part) + sd**2 / 2)
        return replace(way, against=least)

    def _together(self, pose: Float[np.ndarray, "3"], pairs: Sequence[tuple[int, int]]) -> Part:
        return settled(self.views, merged(self.a, self.b.moved(pose), pairs), held=self.first)

    def _against(self, part: Part) -> float:
        """What only both together contradict."""
        return against(self.views, part) - self._alone[0]

    @cached_property
    def _alone(self) -> tuple[float, float]:
        """What is against both parts alone, and what loose echoes say for them."""
        both = self.a, self.b
        return sum(against(self.views, one) for one in both), sum(loose_explained(self.views, one) for one in both)

    def _motion(self, part: Part, step: Float[np.ndarray, "3"]) -> float:
        """Log density of the motion, which may be as it was before or as it is afterwards."""
        wide = float(log_motion(step[None], self.gap)[0])
        way, led = int(np.sign(self.second - self.first)), []
        for near, far, moved in (
            (self.first, self.first - way, step),
            (self.second, self.second + way, inverse(step)),
        ):
            if 0 <= far < len(part.poses) and part.placed[far]:
                on = np.zeros(3)
                for _ in range(self.gap):
                    on = composed(on, relative(part.poses[far], part.poses[near]))
                sd = self.gap * np.array([GOES_ON[0], GOES_ON[0], GOES_ON[1]])
                off = _offset(moved, on) / sd
                led.append(-float(off @ off) / 2 - float(np.log(sd).sum()) - 1.5 * np.log(2 * np.pi))
        if not led:
            return wide
        return float(np.logaddexp(np.log(1 - STEADY) + wide, np.log(STEADY) + np.mean(led)))


def log_motion(step: Float[np.ndarray, "poses 3"], gap: int) -> Float[np.ndarray, " poses"]:
    """Log density of motions between two scans that are so many apart, m^-2 rad^-1."""
    place, turn = STEP * gap**0.75, min(TURN * gap**0.5, 2.0)
    near = np.exp(-np.square(wrap_angle(step[:, 2]) / turn) / 2) / (np.sqrt(2 * np.pi) * turn)
    heading = np.log((1 - ANY_TURN) * near + ANY_TURN / (2 * np.pi))
    return heading - np.square(step[:, :2] / place).sum(axis=1) / 2 - np.log(2 * np.pi * place**2)


def _gap(a: Part, b: Part) -> tuple[int, int, int]:
    """The scans of two parts that are nearest to each other on the way, and how far they are apart."""
    gaps = np.abs(a.rows[:, None] - b.rows)
    i, j = np.unravel_index(int(gaps.argmin()), gaps.shape)
    return int(a.rows[i]), int(b.rows[j]), int(gaps[i, j])


def _offset(pose: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return np.append((pose - other)[:2], wrap_angle(float(pose[2] - other[2])))


def _elsewhere(pose: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"], share: float = 1.0) -> bool:
    off = _offset(pose, other)
    return bool(np.hypot(off[0], off[1]) > share * ELSEWHERE[0] or abs(off[2]) > share * ELSEWHERE[1])


@dataclass(frozen=True)
class _Features:
    """Reflectors of a part, some of them as a wall and as a point."""

    wall: Int[np.ndarray, " walls"]
    """Rows of those that may be walls."""
    point: Int[np.ndarray, " points"]
    """Rows of those that may be points."""
    theta: Float[np.ndarray, " walls"]
    middle: Float[np.ndarray, "walls 2"]
    """Of what was seen."""
    half: Float[np.ndarray, " walls"]
    """Half of its length, metres."""
    sigma: Float[np.ndarray, "walls 2"]
    """Across the middle and of theta, metres and radians."""
    trust: Float[np.ndarray, " walls"]
    place: Float[np.ndarray, "points 2"]
    spread: Float[np.ndarray, " points"]
    """Of each coordinate, metres."""

    @classmethod
    def of(cls, part: Part) -> "_Features":
        behind = part.nats - part.nats.max(axis=1, keepdims=True)
        wall, point = (np.flatnonzero(those.max(axis=1) > -_VIABLE) for those in (behind[:, :1], behind[:, 1:]))
        is_wall, is_point = part.kind[wall] == kernels.PLANE, part.kind[point] != kernels.PLANE
        rho, theta = part.places[wall, 0].T
        tangent, cov = tangent_of(theta), part.cov[wall]
        # Of what is rather a point, the place where that is.
        about = (tangent * part.places[wall, 1]).sum(axis=-1)[:, None] + np.array([-0.1, 0.1])
        extent = np.where(is_wall[:, None], part.extent[wall], about)
        mid = extent.mean(axis=1)
        across = cov[:, 0, 0] - 2 * mid * cov[:, 0, 1] + mid**2 * cov[:, 1, 1]
        variance = np.where(is_wall, np.stack([across, cov[:, 1, 1]]), np.square([[_VAGUE[0]], [_VAGUE[1]]]))
        kind = part.nats[point, 1:].argmax(axis=1) + 1
        spread = np.sqrt(np.trace(part.cov[point], axis1=1, axis2=2) / 2)
        spread = np.minimum(np.where(is_point, spread, _VAGUE[2]), _VAGUE[3])
        return cls(
            wall=wall,
            point=point,
            theta=theta,
            middle=rho[:, None] * unit(theta) + mid[:, None] * tangent,
            half=(extent[:, 1] - extent[:, 0]) / 2,
            sigma=np.sqrt(variance.T + np.square(_FLOOR[:2])),
            trust=np.exp(_TRUST * behind[wall, 0]),
            place=part.places[point, kind],
            spread=np.hypot(spread, _FLOOR[2]),
        )

    @property
    def seen(self) -> Seen:
        """As if one scan saw them at the origin."""
        ends = self.half[:, None, None] * np.array([[-1.0], [1.0]]) * tangent_of(self.theta)[:, None]
        alike = np.ones(len(self.place), dtype=bool)
        nothing = np.zeros((0, 2))
        return Seen(
            self.theta, self.middle[:, None] + ends, self.sigma, self.trust, self.place, alike, self.spread, nothing
        )

    @property
    def places(self) -> Places:
        """As a map."""
        places = Places()
        places.reference, places.theta, places.offset = self.middle, self.theta, np.zeros(len(self.theta))
        places.cov = self.sigma[:, :, None] ** 2 * np.eye(2)
        places.extent = self.half[:, None] * np.array([-1.0, 1.0])
        places.sightings = np.full(len(self.theta), 2.0)
        places.point, places.kind, places.spread = self.place, np.ones(len(self.place), dtype=bool), self.spread
        return places


def _poses(a: Part, b: Part, gap: int) -> list[Float[np.ndarray, "3"]]:
    """Poses of one part in the frame of another that are worth a look, the likeliest by features first."""
    seen, places, sd = _Features.of(b).seen, _Features.of(a).places, STEP * gap**0.75
    poses = np.concatenate([hypotheses(seen, places, np.zeros(3)), _slid(seen, places, _FARTHEST * sd)])
    poses = thinned(poses[np.linalg.norm(poses[:, :2], axis=1) < _FARTHEST * sd], _CELL)
    several = np.array_split(poses, -(-max(len(poses), 1) // 1024))
    nats = np.concatenate([explained(places, seen, some).evidence for some in several]) + log_motion(poses, gap)
    poses = poses[np.argsort(-nats, kind="stable")[:KEPT]]
    held = np.diag([sd**-2, sd**-2, 1e-2])
    for _ in range(_STEPS):
        found = explained(places, seen, poses)
        step = np.linalg.solve(found.information + held, found.gradient[..., None])[..., 0]
        poses = poses - np.clip(step, -0.15, 0.15)
    found = explained(places, seen, poses)
    nats = found.evidence + log_motion(poses, gap) - np.linalg.slogdet(found.information + held)[1] / 2
    kept: list[Float[np.ndarray, 3]] = []
    for k in np.argsort(-nats, kind="stable"):
        if len(kept) < TRIED and all(_elsewhere(poses[k], one, 0.5) for one in kept):
            kept.append(poses[k])
    return kept


def _slid(seen: Seen, places: Places, farthest: float) -> Float[np.ndarray, "poses 3"]:
    """On one wall, all along it, metres from the origin."""
    line, wall = (index.ravel() for index in np.indices((len(seen.theta), len(places.theta))))
    heading = places.theta[wall] - seen.theta[line]
    middle = turned(seen.middle[line], heading)
    short = places.level[wall] - (places.normal[wall] * middle).sum(-1)
    along = np.arange(-farthest, farthest + _ALONG, _ALONG)
    at = (short[:, None] * places.normal[wall])[:, None] + along[:, None] * places.tangent[wall][:, None]
    return np.concatenate([at, np.broadcast_to(heading[:, None, None], (*at.shape[:2], 1))], axis=-1).reshape(-1, 3)


def _same(a: Part, b: Part) -> list[tuple[int, int]]:
    """Reflectors of two parts in one frame that agree, the nearest first, each with one other."""
    one, other = _Features.of(a), _Features.of(b)
    offset = other.middle - one.middle[:, None]
    across, along = ((offset * axis(one.theta)[:, None]).sum(-1) for axis in (unit, tangent_of))
    turn = wrap_angle(other.theta - one.theta[:, None])
    var_across, var_turn = np.moveaxis(one.sigma[:, None] ** 2 + other.sigma**2, -1, 0)
    # Halfway between what was seen of both, where their directions matter least.
    halfway = across - along / 2 * np.tan(np.clip(turn, -1.0, 1.0))
    off = halfway**2 / (var_across + along**2 / 4 * var_turn) + turn**2 / var_turn
    gap = np.abs(along) - one.half[:, None] - other.half
    walls = np.where((off < _AGREE) & (gap < _BEYOND), off + 2 * np.maximum(gap, 0.0), np.inf)
    points = np.square(other.place - one.place[:, None]).sum(-1) / (one.spread[:, None] ** 2 + other.spread**2)
    points = np.where(points < _AGREE, points, np.inf)
    rows = [(walls[i, j], one.wall[i], other.wall[j]) for i, j in np.argwhere(np.isfinite(walls))]
    rows += [(points[i, j], one.point[i], other.point[j]) for i, j in np.argwhere(np.isfinite(points))]
    pairs: list[tuple[int, int]] = []
    for _, i, j in sorted(rows):
        if all(i != mine and j != its for mine, its in pairs):
            pairs.append((int(i), int(j)))
    return pairs


def _no_news(part: Part, pairs: Sequence[tuple[int, int]]) -> float:
    """Nats of corners that are the same where two walls are, too: with these they had to be."""
    rows = np.array([row for row, _ in pairs])
    corner = rows[where_walls_meet(part.kind[rows], part.place[rows])]
    room = np.log(2 * np.pi) + np.linalg.slogdet(part.cov[corner])[1] / 2
    return float(np.maximum(np.log(POINT_ROOM) - room, 0.0).sum())


def _beyond(a: Part, b: Part, pairs: Sequence[tuple[int, int]]) -> float:
    """Metres, and so nats, between what both saw of walls that are the same."""
    mine, its = (np.array(rows) for rows in zip(*pairs, strict=True))
    wall = (a.kind[mine] == kernels.PLANE) & (b.kind[its] == kernels.PLANE)
    first, second = a.extent[mine[wall]], b.extent[its[wall]]
    return float(np.maximum(np.maximum(first[:, 0] - second[:, 1], second[:, 0] - first[:, 1]), 0.0).sum())
