"""Poses without odometry from the ranges: whole assignments of scans to places, compared as they grow.

One scan alone may lie at more than one place, the next two decide. So the best assignments so far are kept, each with
a map of its own (``tracking``); a scan is laid on it wherever walls and corners let it, or left out. What speaks for an
assignment is its evidence in nats: echoes that known reflectors explain, which would else need new ones, against the
room that the pose has left, the robot's usual motion, silence and walls in the way. A scan is placed where all
assignments that are nearly as likely as the best one agree.
"""

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
from .placing_map import Places, Seen, seen_of
from .poses import relative, wrap_angle
from .ring import Ring
from .tracking import Track, _Echoes, begin, update

WIDTH, TRIED = 8, 6
"""Assignments that are kept, and places that each tries for a scan."""
BEHIND = 14.0
"""Nats by which an assignment may be behind the best one, and a place behind the best place, to be looked at."""
UNRELATED = 3.0
"""Nats that it costs to leave a scan out: a robot seldom comes among walls of which it knows none."""
DOUBT = 0.02
"""Largest probability that a placed scan is elsewhere."""
TEMPER = 1.5
"""Nats are worth so much less than they claim."""
SURE = (0.04, float(np.radians(2.5)))
"""Largest standard deviation of a pose that counts as placed, metres and radians."""
_FOUND = np.array([0.08, 0.08, np.radians(5.0)])  # m, rad; of a hypothesis before its ranges are looked at
_BLUR = 0.2  # of local models, for a ring that is calibrated
_SQUARE = 2.0  # nats; walls are often parallel
_UNDECIDED = 7.0  # nats that a reflector is worth whose kind is open
_ALONE = 0.5  # and an echo of none
_ROOM = 16  # reflectors; powers of two from there on are compiled
_GATE = 4.0  # sigma
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
        return Run(fit.known, poses, 0.0)

    def taken(self, run: Run, prior: Known, nats: float) -> Run:
        """The assignment with this scan, from where it lies."""
        fit = update(self.ring, Track(prior), self.scan, self.model, row=self.row, sigma=self.noise)
        poses = run.poses.copy()
        poses[self.row] = fit.pose
        return Run(fit.known, poses, nats)

    def places(self, run: Run) -> list[tuple[Known, float]]:
        """Where it may lie, and the nats for that, against none of what it sees being known."""
        places, prior = _places(run.known), _prior(run.poses, self.row)
        reach = _REACH * float(self.ring.max_range)
        near = places.near(prior.pose[:2], 3 * prior.sigma[0] + 2 * self.seen.radius)
        poses, nats, _ = refined(self.seen, near, prior, reach)
        some: list[Float[np.ndarray, 3]] = []
        for k in np.argsort(-nats, kind="stable"):
            if len(some) == TRIED or nats[k] < nats.max() - BEHIND:
                break
            if not some or not _alike(np.array(some), np.broadcast_to(poses[k], (len(some), 3))).any():
                some.append(poses[k])
        judged = [self._judged(run, places, prior, pose, reach) for pose in some]
        return [one for one in judged if one is not None]

    def _judged(
        self, run: Run, places: Places, prior: Prior, pose: Float[np.ndarray, "3"], reach: float
    ) -> tuple[Known, float] | None:
        """A belief before this scan is taken in there, and nats; None where the ranges leave the pose open."""
        covariance = run.known.covariance.copy()
        covariance[:3], covariance[:, :3] = 0.0, 0.0
        covariance[:3, :3] = np.diag(_FOUND**2)
        before = replace(run.known, pose=pose, covariance=covariance)
        fit = update(self.ring, Track(before), self.scan, self.model, row=self.row, sigma=self.noise, grow=False)
        now, cov = fit.known, fit.covariance
        if np.linalg.eigvalsh(cov[:2, :2])[-1] > SURE[0] ** 2 or cov[2, 2] > SURE[1] ** 2:
            return None
        moved = (now.parameters - before.parameters).ravel()
        strain = moved @ np.linalg.solve(covariance[3:, 3:], moved)
        room = np.linalg.slogdet(now.covariance)[1] - np.linalg.slogdet(covariance[3:, 3:])[1]
        off = self._off(now) / self.noise
        explains = off < _GATE
        fits = (self.worth * explains).sum() - ((off**2 - 1) * explains).sum() / 2
        at = now.pose[None].copy()
        wall = explained(places, self.seen, at).wall
        against = contradictions(
            places, self.seen, at, wall, reach=reach, came=prior.pose[:2] if prior.path else None
        )
        motion = prior.log_density(at)
        nats = fits + float(motion[0]) + 1.5 * np.log(2 * np.pi) + (room - strain) / 2 - float(against[0])
        return before, float(nats)


    def _off(self, known: Known) -> Float[np.ndarray, " echoes"]:
        """How far each echo is off the nearest reflector that its path would hear, metres; infinite for none."""
        room = power_of_two(len(known), least=_ROOM)
        short = room - len(known)
        scene = jax.tree.map(lambda leaf: np.pad(leaf, [(0, short)] + [(0, 0)] * (leaf.ndim - 1)), known.scene)
        scene = replace(scene, kind=np.append(known.kind, np.full(short, -1, np.int32)))
        with jax.enable_x64(True):
            expected = np.asarray(kernels.expected_ranges(known.pose, scene, self.echoes.path))
        return np.abs(expected - self.echoes.ranges).min(axis=0)[: len(self.echoes)]


def _prior(poses: Float[np.ndarray, "scans 3"], row: int) -> Prior:
    """Where a scan is expected, from the placed scans before and after it."""
    placed: Int[np.ndarray, " placed"] = np.flatnonzero(np.isfinite(poses[:, 0]))
    split = int(np.searchsorted(placed, row))
    motion = Motion(np.full(poses.shape, np.nan), 0.0)
    return motion.priors(poses, placed[max(split - 1, 0) : split + 1], row)[-1]


def _places(known: Known) -> Places:
    """A map as what scans are laid on."""
    wall, point = (np.flatnonzero((known.kind == kernels.PLANE) == flag) for flag in (True, False))
    own = 3 + 2 * np.arange(len(known))[:, None] + [0, 1]
    cov = known.covariance[own[:, :, None], own[:, None, :]]
    places = Places()
    places.reference, places.theta = known.anchor[wall], known.parameters[wall, 1]
    places.offset, places.cov, places.extent = known.parameters[wall, 0], cov[wall], known.ends[wall]
    places.sightings = known.scans[wall].astype(np.float64)
    places.point, places.kind = known.anchor[point] + known.parameters[point], known.kind[point] == kernels.CORNER
    places.spread = np.sqrt(np.trace(cov[point], axis1=1, axis2=2) / 2)
    return places
