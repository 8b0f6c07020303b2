"""Poses without odometry from the ranges: whole assignments of scans to places, compared as they grow.

One scan alone may lie at more than one place, the next two decide. So the best assignments so far are kept, each with
a map of its own (``tracking``); a scan is laid on it wherever walls and corners let it, or left out. What speaks for an
assignment is its evidence in nats: echoes that known reflectors explain, which would else need new ones, against the
room that the pose has left, the robot's usual motion, silence and walls in the way. A scan is placed where all
assignments that are nearly as likely as the best one agree.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import logsumexp

from jaxsonar import kernels

from .echoes import power_of_two
from .local import LocalModel
from .logs import Log
from .matching import Known, features_of
from .placing_evidence import LINE_ROOM, POINT_ROOM, contradictions, explained
from .placing_hypotheses import ELSEWHERE, Motion, Prior, refined
from .placing_map import Places, Seen, quarter, seen_of, turned
from .poses import relative, to_world, unit, wrap_angle
from .ring import Ring
from .tracking import Track, _Echoes, begin, update

WIDTH, TRIED = 16, 16
"""Assignments that are kept, and places that each tries for a scan."""
BEHIND = 14.0
"""Nats by which an assignment may be behind the best one, and a place behind the best place, to be looked at."""
UNRELATED = 3.0
"""Nats that it costs to leave a scan out: a robot seldom comes among walls of which it knows none."""
DOUBT = 0.02
"""Largest probability that a placed scan is elsewhere."""
TEMPER = 1.5
"""Nats are worth so much less than they claim."""
SURE = (0.3, float(np.radians(3.0)))
"""Largest standard deviation of a pose that counts as placed, metres and radians."""
_FOUND = np.array([0.08, 0.08, np.radians(5.0)])  # m, rad; of a hypothesis before its ranges are looked at
_BLUR = 0.2  # of local models, for a ring that is calibrated
_SQUARE = 2.0  # nats; walls are often parallel
_UNDECIDED = 7.0  # nats that a reflector is worth whose kind is open
_ALONE = 0.5  # and an echo of none
_ROOM = 16  # reflectors; powers of two from there on are compiled
_MAY_BE = 0.25  # probability
_BEYOND = 0.5  # m
_WAS, _FINE = -1, 1e-3  # kind of a place where the robot was, and metres by which it is a place of its own
_GATE = 4.0  # sigma
_GATES = 12.0, 8.0, 5.0, 4.0, 4.0
_REACH = 0.85  # of the maximum range; nearer than that walls are surely heard


def place_ranges(
    ring: Ring,
    log: Log,
    models: Sequence[LocalModel],
    *,
    sigma: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Float[np.ndarray, "scans 3"]:
    """Poses of scans without odometry; what may lie elsewhere is left out.

    Args:
        ring: the sensors, calibrated.
        log: the echoes, in the order of the way; its poses are not looked at.
        models: local models of its scans.
        sigma: noise of the ranges, metres; that of the local models if left out.
        progress: called with (scans looked at, scans).

    Returns:
        (scans, 3) world_from_robot (x, y, theta), metres and radians; one scan is at the origin, NaN: no place.
    """
    runs = followed(ring, log, models, sigma=sigma, progress=progress)
    return agreed(runs)


class Run(NamedTuple):
    """One assignment of scans to places."""

    known: Known
    """The map that goes with it."""
    poses: Float[np.ndarray, "scans 3"]
    """NaN where a scan is left out."""
    nats: float
    order: tuple[int, ...]
    """Scans in the order in which they were placed, which is that of their places in the map."""

    def same(self, other: "Run") -> bool:
        """Whether both place the same scans, at the same places."""
        return bool(np.all(_alike(self.poses, other.poses) | np.isnan(self.poses[:, 0]) & np.isnan(other.poses[:, 0])))


def followed(
    ring: Ring,
    log: Log,
    models: Sequence[LocalModel],
    *,
    sigma: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Run]:
    """The likeliest assignments, the best one first; arguments as ``place_ranges``."""
    count = len(models)
    worth = np.array([len(model.lines) + len(model.points) for model in models])
    known = [model.sigma for model in models if model.sigma > 0]
    noise = sigma or (float(np.median(known)) if known else 0.003)
    views = [_View(ring, log, model, row, noise) for row, model in enumerate(models)]
    # From the scan that sees most, to both sides of the way; of the two next scans the one that sees more.
    start = low = high = int(worth.argmax())
    runs = [views[start].begun(count)]
    for done in range(1, count):
        ahead = low == 0 or (high + 1 < count and worth[high + 1] > worth[low - 1])
        low, high = (low, high + 1) if ahead else (low - 1, high)
        runs = _extended(runs, views[high if ahead else low])
        if progress is not None:
            progress(done, count)
    # More is known now: what was left out may find its place.
    for _ in range(2):
        for row in np.flatnonzero(np.isnan(runs[0].poses[:, 0])):
            runs = _extended(runs, views[row])
    return runs


def agreed(runs: Sequence[Run]) -> Float[np.ndarray, "scans 3"]:
    """The best assignment, less the scans that lie elsewhere in others that are hardly worse."""
    best = runs[0].poses
    share = np.array([run.nats for run in runs]) / TEMPER
    share = np.exp(share - logsumexp(share))
    placed = np.flatnonzero(np.isfinite(best[:, 0]))
    sure: Bool[np.ndarray, " scans"] = np.zeros(len(best), dtype=bool)
    for row in placed:  # as that scan sees the others
        mine = relative(best[row], best)
        agree = sum(
            (weight * _alike(mine, relative(run.poses[row], run.poses)) for run, weight in zip(runs, share, strict=True)),
            np.zeros(len(best)),
        )
        now = agree > 1 - DOUBT
        sure = now if now.sum() > sure.sum() else sure
    sure[placed[0]] |= not sure.any()
    return np.where(sure[:, None], best, np.nan)


def _alike(a: Float[np.ndarray, "scans 3"], b: Float[np.ndarray, "scans 3"]) -> Bool[np.ndarray, " scans"]:
    off = a - b
    with np.errstate(invalid="ignore"):
        return (np.hypot(off[:, 0], off[:, 1]) < ELSEWHERE[0]) & (np.abs(wrap_angle(off[:, 2])) < ELSEWHERE[1])


def _extended(runs: Sequence[Run], view: "_View") -> list[Run]:
    """Each assignment with one scan more, at every place that it may have, or without it."""
    free = [run for run in runs if np.isnan(run.poses[view.row, 0])]
    left = [(run, run.nats - UNRELATED, None) for run in free]
    left += [(run, run.nats, None) for run in runs if not np.isnan(run.poses[view.row, 0])]
    tried = [(run, run.nats + nats, prior) for run in free for prior, nats in view.places(run)]
    ways = sorted([*left, *tried], key=lambda way: -way[1])
    kept: list[Run] = []
    for run, nats, prior in ways:
        if len(kept) == WIDTH or nats < ways[0][1] - BEHIND:
            break
        now = run._replace(nats=nats) if prior is None else view.taken(run, prior, nats)
        if not any(now.same(other) for other in kept):
            kept.append(now)
    return kept


class _View:
    """One scan, and what it makes of maps."""

    def __init__(self, ring: Ring, log: Log, model: LocalModel, row: int, noise: float):
        self.ring, self.scan, self.model, self.row, self.noise = ring, log[row], model, row, noise
        self.seen: Seen = seen_of(model, blur=_BLUR)
        self.guessed = _with_undecided(self.seen, model)
        self.echoes = _Echoes.of(ring, self.scan, None)
        features = features_of(model)
        claimed = self.echoes.claimed(features, noise)
        room = np.where(features.kind == kernels.PLANE, 2 * LINE_ROOM / np.exp(_SQUARE), POINT_ROOM / (2 * np.pi))
        nats = np.log(room) - np.linalg.slogdet(features.cov)[1] / 2
        number = np.maximum(np.bincount(claimed[claimed >= 0], minlength=len(nats)), 1)
        self.worth = np.append(nats / number, _ALONE)[claimed]
        reach = np.asarray(ring.corrected(self.scan.range, self.scan.tx, self.scan.rx))
        valid = (ring.path_index[self.scan.tx, self.scan.rx] >= 0) & (reach > 0) & (reach < ring.max_range)
        heard = np.stack([self.scan.tx, self.scan.rx], axis=-1)[valid]
        for one in model.undecided:
            its = (heard[:, None] == one.paths).all(axis=-1).any(axis=-1) & (claimed < 0)
            self.worth[its] = _UNDECIDED / max(int(its.sum()), 1)

    def begun(self, scans: int) -> Run:
        """A map of this scan alone."""
        poses = np.full((scans, 3), np.nan)
        poses[self.row] = 0.0
        fit = update(self.ring, begin(), self.scan, self.model, row=self.row, sigma=self.noise)
        return Run(_remembered(fit.known), poses, 0.0, (self.row,))

    def taken(self, run: Run, prior: Known, nats: float) -> Run:
        """The assignment with this scan, from where it lies."""
        # A wall goes on beyond what was seen of it; how far is known when it was seen there.
        fit = update(self.ring, Track(_longer(prior)), self.scan, self.model, row=self.row, sigma=self.noise)
        known, ends = fit.known, fit.known.ends.copy()
        ends[: len(prior)] = prior.ends
        wall = np.flatnonzero(known.kind == kernels.PLANE)
        matched = explained(_places(known), self.seen, known.pose[None]).wall[0]
        for line in np.flatnonzero(matched >= 0):
            own = wall[matched[line]]
            tangent = unit(known.parameters[own, 1] + np.pi / 2)
            along = (to_world(known.pose, self.seen.segment[line]) - known.anchor[own]) @ tangent
            ends[own] = min(ends[own, 0], along.min()), max(ends[own, 1], along.max())
        return self._now(run, replace(known, ends=ends), nats)

    def _now(self, run: Run, known: Known, nats: float) -> Run:
        """With the poses so far where the map has them now."""
        poses = run.poses.copy()
        order = [*run.order, self.row]
        known = _remembered(known)
        were = np.flatnonzero(known.kind == _WAS)
        poses[order, :2] = (known.anchor + known.parameters)[were]
        poses[self.row, 2] = known.pose[2]
        return Run(known, poses, nats, tuple(order))

    def places(self, run: Run) -> list[tuple[Known, float]]:
        """Where it may lie, and the nats for that, against none of what it sees being known."""
        places, prior = _places(run.known), _prior(run.poses, self.row)
        reach = _REACH * float(self.ring.max_range)
        near = places.near(prior.pose[:2], 3 * prior.sigma[0] + 2 * self.seen.radius)
        parts = [refined(seen, near, prior, reach) for seen in (self.seen, self.guessed)]
        poses, nats = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
        some: list[Float[np.ndarray, 3]] = []
        for k in np.argsort(-nats, kind="stable"):
            if len(some) == TRIED or nats[k] < nats.max() - 2 * BEHIND:
                break
            if not some or not _alike(np.array(some), np.broadcast_to(poses[k], (len(some), 3))).any():
                some.append(poses[k])
        return self._judged(run, places, prior, np.array(some).reshape(-1, 3), reach)

    def _judged(
        self, run: Run, places: Places, prior: Prior, poses: Float[np.ndarray, "poses 3"], reach: float
    ) -> list[tuple[Known, float]]:
        """Beliefs before this scan is taken in there, and nats; none where the ranges leave the pose open."""
        fits = _Fits.of(self.echoes, _longer(run.known), prior, poses, self.noise)
        spread = np.linalg.inv(fits.information)[:, :3, :3]
        sure = (np.linalg.eigvalsh(spread[:, :2, :2])[:, -1] < SURE[0] ** 2) & (spread[:, 2, 2] < SURE[1] ** 2)
        wall = explained(places, self.seen, fits.poses).wall
        came = prior.pose[:2] if prior.path else None
        against = contradictions(places, self.seen, fits.poses, wall, reach=reach, came=came)
        gain = np.where(fits.off < _GATE, self.worth - (fits.off**2 - 1) / 2, 0.0).sum(axis=1)
        room = 1.5 * np.log(2 * np.pi) - (np.linalg.slogdet(fits.information)[1] + fits.known) / 2
        nats = gain + prior.log_density(fits.poses) + room - fits.strain / 2 - against
        out = []
        for pose, cov, value in zip(fits.poses[sure], spread[sure], nats[sure], strict=True):
            covariance = run.known.covariance.copy()
            covariance[:3], covariance[:, :3] = 0.0, 0.0
            covariance[:3, :3] = np.diag(_FOUND**2) + 4 * cov
            out.append((replace(run.known, pose=pose, covariance=covariance), float(value)))
        return out


class _Fits(NamedTuple):
    """Poses adjusted to the ranges of a scan, the reflectors with them."""

    poses: Float[np.ndarray, "poses 3"]
    off: Float[np.ndarray, "poses echoes"]
    """Sigma by which echoes are off their nearest reflector; infinite where their paths hear none."""
    information: Float[np.ndarray, "poses unknowns unknowns"]
    """Of the pose and of the reflectors' parameters."""
    known: float
    """Logarithm of the determinant of the reflectors' covariance before."""
    strain: Float[np.ndarray, " poses"]
    """Squared distance of the reflectors from what was known of them, in standard deviations."""

    @classmethod
    def of(
        cls, echoes: _Echoes, known: Known, expected: Prior, poses: Float[np.ndarray, "poses 3"], noise: float
    ) -> "_Fits":
        """Gauss and Newton; the gate closes."""
        count, size = len(poses), len(known.covariance)
        start = np.linalg.inv(known.covariance[3:, 3:])
        prior = np.zeros((size, size))
        prior[:3, :3], prior[3:, 3:] = np.diag([*[expected.sigma[0] ** -2] * 2, 1.0]), start
        middle = np.asarray(echoes.path.midpoint)[: len(echoes)]
        poses, moved = poses.copy(), np.zeros((count, size - 3))
        off, information = np.zeros((count, len(echoes))), np.zeros((count, size, size))
        for gate in _GATES:
            reaches = _expected(echoes, known, poses)
            lever = turned(np.broadcast_to(middle, (count, len(echoes), 2)), poses[:, 2, None])
            at = poses[:, None, :2] + lever
            nearest = np.abs(reaches - echoes.ranges[: len(echoes)]).argmin(axis=1)
            reach = np.take_along_axis(reaches, nearest[:, None], axis=1)[:, 0]
            is_wall = (known.kind == kernels.PLANE)[nearest][..., None]
            theta = known.parameters[nearest, 1]
            away = known.anchor[nearest] - at
            spot = away + known.parameters[nearest]
            towards = np.where(is_wall, unit(theta), spot / np.linalg.norm(spot, axis=-1, keepdims=True))
            turn = (unit(theta + np.pi / 2) * away).sum(-1, keepdims=True)
            own = np.where(is_wall, np.concatenate([np.ones_like(turn), turn], -1), towards)
            slope = np.zeros((*reach.shape, size))
            slope[..., :2], slope[..., 2] = -towards, -(towards * quarter(lever)).sum(-1)
            rows = (np.arange(count)[:, None], np.arange(len(echoes)))
            slope[(*rows, 3 + 2 * nearest)], slope[(*rows, 4 + 2 * nearest)] = own[..., 0], own[..., 1]
            # The scene stays where it was; what it moved by is in the residual.
            with np.errstate(invalid="ignore"):
                residual = echoes.ranges[: len(echoes)] - reach - (slope[..., 3:] * moved[:, None]).sum(-1)
            off = np.where(np.isfinite(residual), np.abs(residual), np.inf) / noise
            used = off < gate
            residual = np.where(used, residual, 0.0)
            slope = slope * used[..., None] / noise
            information = prior + slope.transpose(0, 2, 1) @ slope
            gradient = (slope * (residual / noise)[..., None]).sum(axis=1)
            gradient[:, 3:] -= moved @ start
            gradient[:, :2] -= (poses[:, :2] - expected.pose[:2]) / expected.sigma[0] ** 2
            if gate == _GATES[-1]:
                break
            step = np.linalg.solve(information, gradient[..., None])[..., 0]
            poses = poses + step[:, :3]
            moved = moved + step[:, 3:]
        poses[:, 2] = wrap_angle(poses[:, 2])
        strain = ((moved @ start) * moved).sum(-1)
        return cls(poses, off, information, -float(np.linalg.slogdet(start)[1]), strain)


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, None, None))
def _all_expected(pose, scene, paths):
    return kernels.expected_ranges(pose, scene, paths)


def _expected(echoes: _Echoes, known: Known, poses: Float[np.ndarray, "poses 3"]) -> Float[np.ndarray, "poses rows echoes"]:
    """Ranges in which the paths of echoes would hear reflectors, metres; infinite where they would not."""
    short = power_of_two(len(known), least=_ROOM) - len(known)
    scene = jax.tree.map(lambda leaf: np.pad(leaf, [(0, short)] + [(0, 0)] * (leaf.ndim - 1)), known.scene)
    scene = replace(scene, kind=np.append(known.kind, np.full(short, -1, np.int32)))
    padded = np.zeros((TRIED, 3))
    padded[: len(poses)] = poses
    with jax.enable_x64(True):
        expected = np.asarray(_all_expected(padded, scene, echoes.path))
    return expected[: len(poses), : len(known), : len(echoes)]


def _with_undecided(seen: Seen, model: LocalModel) -> Seen:
    """With what may be a wall as one, and what may be a corner or an edge as that; good for guesses only."""
    walls = [one for one in model.undecided if one.probability["plane"] > _MAY_BE]
    theta = np.array([one.theta for one in walls], dtype=np.float64)
    foot = np.array([one.rho for one in walls], dtype=np.float64)[:, None] * unit(theta)
    points = [(one, kind) for one in model.undecided for kind in ("corner", "edge") if one.probability[kind] > _MAY_BE]
    place = np.array([(one.x, one.y) for one, _ in points], dtype=np.float64).reshape(-1, 2)
    return seen._replace(
        theta=np.append(seen.theta, theta),
        segment=np.concatenate([seen.segment, foot[:, None] + 0.1 * np.array([[-1.0], [1.0]]) * unit(theta + np.pi / 2)[:, None]]),
        sigma=np.concatenate([seen.sigma, np.tile([0.01, np.radians(2.0)], (len(theta), 1))]),
        trust=np.append(seen.trust, np.full(len(theta), 0.5)),
        point=np.concatenate([seen.point, place]),
        kind=np.append(seen.kind, np.array([kind == "corner" for _, kind in points], dtype=bool)),
        spread=np.append(seen.spread, np.full(len(place), 0.05)),
    )


def _remembered(known: Known) -> Known:
    """With the robot's place as one of the map that nothing hears, so that it moves with what becomes known later."""
    size = len(known.covariance)
    copy = np.concatenate([np.eye(size), np.eye(2, size)])
    covariance = copy @ known.covariance @ copy.T
    covariance[size:, size:] += _FINE**2 * np.eye(2)
    return Known(
        pose=known.pose,
        kind=np.append(known.kind, np.int32(_WAS)).astype(np.int32),
        parameters=np.concatenate([known.parameters, np.zeros((1, 2))]),
        anchor=np.concatenate([known.anchor, known.pose[None, :2]]),
        ends=np.concatenate([known.ends, np.zeros((1, 2))]),
        covariance=covariance,
        scans=np.append(known.scans, 1),
    )


def _longer(known: Known) -> Known:
    """Walls as far as they may go on."""
    return replace(known, ends=known.ends + (known.kind == kernels.PLANE)[:, None] * [-_BEYOND, _BEYOND])


def _prior(poses: Float[np.ndarray, "scans 3"], row: int) -> Prior:
    """Where a scan is expected, from the placed scans before and after it."""
    placed: Int[np.ndarray, " placed"] = np.flatnonzero(np.isfinite(poses[:, 0]))
    split = int(np.searchsorted(placed, row))
    motion = Motion(np.full(poses.shape, np.nan), 0.0)
    return motion.priors(poses, placed[max(split - 1, 0) : split + 1], row)[-1]


def _places(known: Known) -> Places:
    """A map as what scans are laid on."""
    wall, point = (np.flatnonzero(flag) for flag in (known.kind == kernels.PLANE, known.kind > kernels.PLANE))
    own = 3 + 2 * np.arange(len(known))[:, None] + [0, 1]
    cov = known.covariance[own[:, :, None], own[:, None, :]]
    places = Places()
    places.reference, places.theta = known.anchor[wall], known.parameters[wall, 1]
    places.offset, places.cov, places.extent = known.parameters[wall, 0], cov[wall], known.ends[wall]
    places.sightings = known.scans[wall].astype(np.float64)
    places.point, places.kind = known.anchor[point] + known.parameters[point], known.kind[point] == kernels.CORNER
    places.spread = np.sqrt(np.trace(cov[point], axis1=1, axis2=2) / 2)
    return places
