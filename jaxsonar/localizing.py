"""Where the robot is in a known map: followed from a rough pose, or found from nothing by a few scans of a short path.

Every place where walls and corners of a scan could lie on those of the map is a hypothesis; each is followed through
the first scans by the ranges of the echoes. Rooms that look alike leave more than one: then nothing is guessed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import logsumexp

from jaxsonar import kernels
from jaxsonar.hardware.errors import SonarError

from .explained import check_sigma
from .local import LocalModel, local_models
from .logs import Log
from .maps import GlobalMap
from .matching import Known, features_of
from .motion import moved, step_variance
from .placing import place_parts
from .placing_evidence import explained
from .placing_hypotheses import hypotheses
from .placing_map import Places, seen_of
from .poses import composed, relative, unit, wrap_angle
from .ring import Ring
from .slip import Slip
from .tracking import Track, update
from .trajectory import Trajectory, stamps_of

ROUGH = (0.25, float(np.radians(10.0)))
"""Standard deviation of a pose that a person gives, metres and radians."""
TRIED = 12
"""Scans by which the first pose is found."""
STARTS = 4
"""Scans whose hypotheses are looked at."""
KEPT = 48
"""Hypotheses that are followed."""
MARGIN = 12.0
"""Nats by which the best one must beat all others together; echoes of one wall are not independent."""
LEAST = 0.3
"""Share of the echoes that the map must explain at the best one."""
SAME = (0.25, float(np.radians(8.0)))
"""Metres and radians; hypotheses that are nearer are one."""
_MAP = (0.002, float(np.radians(0.1)))  # m, rad; of walls whose map does not say how good they are
_BLUR = 0.5  # of local models, against the covariance of their walls
_FOUND = (0.05, float(np.radians(3.0)))  # m, rad; of a hypothesis before its ranges are looked at
_SECOND = 6.0  # nats; a place that so nearly is as good is told of


class Place(NamedTuple):
    """Where the first scan may have been taken."""

    pose: Float[np.ndarray, "3"]
    """world_from_robot, metres and radians."""
    nats: float
    """How well the ranges of the first scans agree, against chance."""
    explained: float
    """Share of their echoes that the map explains."""


@dataclass(frozen=True, eq=False)
class Localized:
    """Poses in a known map."""

    poses: Float[np.ndarray, "scans 3"]
    """world_from_robot; NaN where it is not certain."""
    covariance: Float[np.ndarray, "scans 3 3"]
    """In the world frame, that of the map accounted for scan by scan."""
    stamp: Float[np.ndarray, " scans"]
    places: tuple[Place, ...]
    """Where the first scan may have been taken, the likeliest first."""
    certain: bool
    """Whether there is only one such place."""
    why: str
    """That, in words."""

    @property
    def trajectory(self) -> Trajectory:
        """Of the scans that have a pose."""
        known = np.isfinite(self.poses).all(axis=1)
        return Trajectory(self.stamp[known], self.poses[known], self.covariance[known])


def localize(
    ring: Ring,
    world: GlobalMap,
    log: Log,
    *,
    start: Sequence[float] | None = None,
    sigma: float | None = None,
    slip: Slip | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Localized:
    """Poses of scans in a map that is known.

    Args:
        ring: the sensors.
        world: the map.
        log: scans of a path; their poses are odometry. Without odometry those are used that can be laid on each other.
        start: about where the first scan was taken, world_from_robot: x, y (m), theta (rad); anywhere if left out.
        sigma: noise of the ranges, metres; estimated if left out.
        slip: how wrong the odometry is.
        progress: told what is being done, and (scans done, scans) of it.

    Raises:
        SonarError: no scan, a map without walls, arguments out of range.
    """
    check_sigma(sigma)
    if not len(log):
        raise SonarError("localize: no scan in the log; allowed is a log with one or more")
    if not len(world) + len(world.points):
        raise SonarError("localize: the map has no wall; allowed is one with walls in reach")
    if start is not None and not (len(start) == 3 and np.isfinite(np.asarray(start, dtype=np.float64)).all()):
        raise SonarError(f"localize: start {tuple(start)}; allowed are x, y (m) and theta (rad)")
    say = progress or (lambda text, done, total: None)
    models = []
    for model in local_models(ring, log, sigma=sigma):
        models.append(model)
        say("local models", len(models), len(log))
    path = _Path(ring, _Map.of(world), log, models, _odometry(log, models), sigma, slip or Slip())
    if not len(path.rows):
        raise SonarError(
            "localize: no scan could be laid on another; allowed are scans with odometry, or near each other"
        )
    # 1. Where the first scan may be.
    sd = np.array([ROUGH[0], ROUGH[0], ROUGH[1]]) if start is not None else np.array([_FOUND[0], _FOUND[0], _FOUND[1]])
    begins = [np.array(start, dtype=np.float64)] if start is not None else path.begins(world)
    # 2. Each is followed through the first scans.
    tried = path.rows[:TRIED]
    followed = []
    for number, begin in enumerate(begins):
        followed.append(path.followed(begin, sd, tried))
        say("hypotheses", number + 1, len(begins))
    places = _different([run.place for run in followed])
    certain, why = _judged(places, len(path.rows))
    poses, cov = np.full((len(log), 3), np.nan), np.full((len(log), 3, 3), np.nan)
    # 3. The only one, through all scans.
    if certain:
        best = max(followed, key=lambda run: run.place.nats)
        run = path.followed(best.begin, sd, path.rows)
        poses[path.rows], cov[path.rows] = run.poses, run.covs
    return Localized(poses, cov, stamps_of(log), places, certain, why)


def _odometry(log: Log, models: Sequence[LocalModel]) -> Float[np.ndarray, "scans 3"]:
    """Of the log, or from the scans themselves where there is none; NaN where a scan has no place."""
    known = np.isfinite(log.pose).all(axis=1)
    if known.any():
        return np.where(known[:, None], log.pose, np.nan)
    parts = place_parts(models, None, blur=_BLUR) if len(models) > 1 else []
    if parts and np.isfinite(parts[0][:, 0]).sum() > 1:
        return parts[0]
    alone = np.full((len(log), 3), np.nan)  # the scan that sees most must do
    alone[int(np.argmax([len(model.lines) + len(model.points) for model in models]))] = 0.0
    return alone


def _different(places: Sequence[Place]) -> tuple[Place, ...]:
    """The best of those that are at the same place, the likeliest first."""
    kept: list[Place] = []
    for place in sorted(places, key=lambda one: -one.nats):
        near = [
            np.hypot(*(place.pose - one.pose)[:2]) < SAME[0] and abs(wrap_angle(place.pose[2] - one.pose[2])) < SAME[1]
            for one in kept
        ]
        if not any(near):
            kept.append(place)
    return tuple(kept)


def _judged(places: Sequence[Place], scans: int) -> tuple[bool, str]:
    """Whether there is one place only, and what there is to say."""
    of = f"{scans} scan{'' if scans == 1 else 's'}"
    if not places or places[0].explained < LEAST:
        share = f": at the best place {100 * places[0].explained:.0f} % of their echoes fit" if places else ""
        return False, f"{of}: no place in the map fits{share}; needed are {100 * LEAST:.0f} %"
    best, others = places[0], [place.nats for place in places[1:]]
    margin = best.nats - float(logsumexp(others)) if others else np.inf
    if margin < MARGIN:
        alike = [place for place in places if place.nats > best.nats - MARGIN - _SECOND][:4]
        said = "; ".join(f"{p.pose[0]:.2f}, {p.pose[1]:.2f} m, {np.degrees(p.pose[2]):.0f} deg" for p in alike)
        return False, f"{of}: ambiguous, {len(alike)} places look alike: {said}; a longer path may tell"
    by = "no other place fits" if not others else f"{margin:.0f} nats better than any other place"
    x, y, theta = best.pose
    return True, (
        f"{of}: the first one at {x:.3f}, {y:.3f} m, {np.degrees(theta):.2f} deg, {by}; "
        f"{100 * best.explained:.0f} % of the echoes fit"
    )


class _Map(NamedTuple):
    """The known map as reflectors; a wall may be seen from both sides."""

    kind: Int[np.ndarray, " reflectors"]
    anchor: Float[np.ndarray, "reflectors 2"]
    theta: Float[np.ndarray, " reflectors"]
    half: Float[np.ndarray, " reflectors"]
    cov: Float[np.ndarray, "reflectors 2 2"]

    @classmethod
    def of(cls, world: GlobalMap) -> "_Map":
        middle = world.segments.mean(axis=1)
        half = world.length / 2
        # The distance at the middle is better known than that of the line from the far origin of the world.
        lever = (middle * unit(world.theta + np.pi / 2)).sum(axis=-1)
        turn = np.where(np.isfinite(world.sigma_theta), world.sigma_theta, _MAP[1])
        across = np.where(np.isfinite(world.sigma_rho), world.sigma_rho**2 - (lever * turn) ** 2, 0.0)
        wall_cov = np.zeros((len(world), 2, 2))
        wall_cov[:, 0, 0] = np.maximum(across, _MAP[0] ** 2)
        wall_cov[:, 1, 1] = turn**2
        point_cov = np.where(np.isfinite(world.point_cov), world.point_cov, np.eye(2) * _MAP[0] ** 2)
        kinds = [kernels.CORNER if kind == "corner" else kernels.EDGE for kind in world.point_kinds]
        none = np.zeros(len(kinds))
        return cls(
            np.array([kernels.PLANE] * len(world) + kinds, dtype=np.int32),
            np.concatenate([middle, world.points]),
            np.concatenate([world.theta, none]),
            np.concatenate([half, none]),
            np.concatenate([wall_cov, point_cov]),
        )

    def around(self, pose: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "3 3"], reach: float) -> Known:
        """What may be heard from a pose, walls with their normals away from it."""
        offset = self.anchor - pose[:2]
        wall = self.kind == kernels.PLANE
        along = (offset * unit(self.theta + np.pi / 2)).sum(axis=-1)
        across = (offset * unit(self.theta)).sum(axis=-1)
        beyond = np.maximum(np.abs(along) - self.half, 0.0)
        near = np.where(wall, np.hypot(across, beyond), np.linalg.norm(offset, axis=-1))
        rows = np.flatnonzero(near < reach + 3 * np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
        rows = rows[np.argsort(near[rows], kind="stable")][:48]
        behind = (across < 0) & wall
        theta = np.where(wall, wrap_angle(self.theta + np.pi * behind), 0.0)[rows]
        size = 3 + 2 * len(rows)
        whole = np.zeros((size, size))
        whole[:3, :3] = covariance
        for k, row in enumerate(rows):
            whole[3 + 2 * k : 5 + 2 * k, 3 + 2 * k : 5 + 2 * k] = self.cov[row]
        return Known(
            pose=pose,
            kind=self.kind[rows],
            parameters=np.stack([np.zeros(len(rows)), theta], axis=-1),
            anchor=self.anchor[rows],
            ends=self.half[rows, None] * [-1.0, 1.0],
            covariance=whole,
            scans=np.full(len(rows), 2, np.int64),
        )


class _Followed(NamedTuple):
    """A hypothesis through some scans."""

    begin: Float[np.ndarray, "3"]
    place: Place
    poses: Float[np.ndarray, "scans 3"]
    covs: Float[np.ndarray, "scans 3 3"]


@dataclass(frozen=True)
class _Path:
    """The scans, and what is known of the way between them."""

    ring: Ring
    map: _Map
    log: Log
    models: Sequence[LocalModel]
    odometry: Float[np.ndarray, "scans 3"]
    sigma: float | None
    slip: Slip

    @property
    def rows(self) -> Int[np.ndarray, " rows"]:
        """Scans of which the way to each other is known."""
        return np.flatnonzero(np.isfinite(self.odometry[:, 0]))

    @property
    def noise(self) -> float:
        """Of the ranges, metres."""
        known = [model.sigma for model in self.models if model.sigma > 0]
        return self.sigma or (float(np.median(known)) if known else 0.003)

    def begins(self, world: GlobalMap) -> list[Float[np.ndarray, "3"]]:
        """Poses of the first scan at which walls or corners of one of the first scans lie on some of the map."""
        places, rows = _places(self.map), self.rows
        first = self.odometry[rows[0]]
        poses, score = [], []
        richest = sorted(rows[:TRIED], key=lambda row: -len(features_of(self.models[row]).kind))[:STARTS]
        for row in richest:
            seen = seen_of(self.models[row], blur=_BLUR)
            if len(seen.theta) + len(seen.point) < 2:
                continue
            # Two features fix a pose; what one wall alone allows is a whole line of them.
            found = hypotheses(seen, places, np.zeros(3))[1 + len(seen.theta) * len(places.theta) :]
            if not len(found):
                continue
            found = _thinned(found)
            evidence = np.concatenate(
                [explained(places, seen, part).evidence for part in np.array_split(found, -(-len(found) // 4096))]
            )
            best = np.argsort(-evidence, kind="stable")[: 4 * KEPT]
            back = relative(self.odometry[row], first)
            poses += [composed(pose, back) for pose in found[best]]
            score += evidence[best].tolist()
        order = np.argsort(-np.array(score), kind="stable")
        kept: list[Float[np.ndarray, 3]] = []
        for k in order:
            off = [poses[k] - one for one in kept]
            if all(np.hypot(*one[:2]) > SAME[0] / 2 or abs(wrap_angle(one[2])) > SAME[1] / 2 for one in off):
                kept.append(poses[k])
            if len(kept) == KEPT:
                break
        return kept

    def followed(
        self, begin: Float[np.ndarray, "3"], sd: Float[np.ndarray, "3"], rows: Int[np.ndarray, " rows"]
    ) -> _Followed:
        """A hypothesis through scans, by odometry and the ranges of the echoes."""
        noise = self.noise
        pose, cov = begin, np.diag(sd**2)
        poses, covs, first = [], [], None
        nats = heard = fits = 0.0
        for k, row in enumerate(rows):
            if k:
                step = relative(self.odometry[rows[k - 1]], self.odometry[row])
                pose, cov = moved(pose, cov, step, step_variance(self.slip, step))
            known = self.map.around(pose, cov, self.ring.max_range + 0.3)
            scan = self.log[int(row)]
            fit = update(self.ring, Track(known), scan, self.models[row], row=int(row), sigma=noise, grow=False)
            pose, cov = np.append(fit.pose[:2], wrap_angle(fit.pose[2])), fit.covariance
            # An explained echo is so much likelier than one that lies anywhere; those of one wall say the same.
            heard += len(scan.range)
            fits += fit.explained
            nats += float(np.log(self.ring.max_range / (noise * np.sqrt(2 * np.pi)))) * fit.explained / 4
            nats -= fit.squared / 8
            poses.append(pose)
            covs.append(cov)
            first = pose if first is None else first
        assert first is not None
        return _Followed(begin, Place(first, nats, fits / max(heard, 1)), np.array(poses), np.array(covs))


def _places(known: _Map) -> Places:
    """The map as what scans are laid on, every wall from both sides."""
    wall = np.flatnonzero(known.kind == kernels.PLANE)
    point = np.flatnonzero(known.kind != kernels.PLANE)
    places = Places()
    places.reference = np.tile(known.anchor[wall], (2, 1))
    places.theta = np.concatenate([known.theta[wall], wrap_angle(known.theta[wall] + np.pi)])
    places.offset = np.zeros(2 * len(wall))
    places.extent = np.tile(known.half[wall, None] * [-1.0, 1.0], (2, 1))
    places.cov = np.tile(known.cov[wall], (2, 1, 1))
    places.sightings = np.full(2 * len(wall), 4.0)
    places.point, places.kind = known.anchor[point], known.kind[point] == kernels.CORNER
    places.spread = np.sqrt(np.trace(known.cov[point], axis1=1, axis2=2) / 2)
    return places


def _thinned(poses: Float[np.ndarray, "poses 3"]) -> Float[np.ndarray, "kept 3"]:
    """One pose of each cell of 10 cm and 4 deg."""
    cell = np.round(np.concatenate([poses[:, :2] / 0.1, wrap_angle(poses[:, 2:]) / np.radians(4.0)], axis=-1))
    return poses[np.sort(np.unique(cell, axis=0, return_index=True)[1])]
