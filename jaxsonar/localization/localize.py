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
from jaxsonar.detection.extract import local_models
from jaxsonar.detection.local_map import LocalModel
from jaxsonar.detection.settings import check_sigma
from jaxsonar.estimation.odometry_noise import OdometryNoise, step_variance
from jaxsonar.estimation.trajectory import Trajectory, stamps_of
from jaxsonar.geometry.se2 import propagate, relative, rotate, unit, wrap_angle
from jaxsonar.graph_slam.frontend import Track, update
from jaxsonar.graph_slam.joint_compatibility import Known, features_of
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.registration.features import Features, scan_features
from jaxsonar.registration.pose_hypotheses import pose_hypotheses, thin_poses
from jaxsonar.registration.pose_likelihood import pose_log_likelihood, refine_poses
from jaxsonar.registration.sequential import register_scans
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

ROUGH = (0.25, float(np.radians(10.0)))
"""Standard deviation of a pose that a person gives, metres and radians."""
TRIED = 12
"""Scans by which the first pose is found."""
STARTS = 4
"""Scans whose hypotheses are looked at."""
KEPT = 24
"""Hypotheses that are followed."""
BEHIND = 30.0, 0.2
"""Nats, and share of those of the best one, by which a hypothesis may be behind it to be followed further."""
MARGIN = 20.0, 0.05
"""Nats, and share of its own, by which the best one must beat all others together; echoes of one wall are not
independent."""
LEAST = 0.5
"""Share of the echoes that the map must explain at the best one."""
MARGIN_NEAR, LEAST_NEAR = (6.0, 0.03), 0.2
"""The same of hypotheses near a rough pose."""
SAME = (0.25, float(np.radians(8.0)))
"""Metres and radians; hypotheses that are nearer are one, if they cannot be told apart."""
SURE = (0.03, float(np.radians(2.0)))
"""Largest standard deviation of a pose that was found from nothing, metres and radians."""
_MAP = (0.002, float(np.radians(0.1)))  # m, rad; of walls whose map does not say how good they are
_FINE = (1e-4, float(np.radians(0.005)))  # m, rad; no map is better
_BLUR = 0.5  # of local models, against the covariance of their walls
_FOUND = (0.05, float(np.radians(3.0)))  # m, rad; of a hypothesis before its ranges are looked at
_TOGETHER = 6  # scans whose walls and corners choose among the hypotheses
_CLOSER = 4  # steps of Gauss and Newton before that
_NEAR = 3.5  # standard deviations of a rough pose within which hypotheses are looked for
_BESIDE = 0.3  # m; a wall is heard only where it was seen
_MEETS, _SQUARE = 0.05, float(np.radians(3.0))  # m, rad; walls whose ends are so near and so square make a corner
_CELL = (0.1, float(np.radians(4.0)))  # m, rad; hypotheses so near are one before they are scored
_MOST = 32  # reflectors that are looked at from a pose


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
    odometry_noise: OdometryNoise | None = None,
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
    path = _Path(ring, _Map.of(world), log, models, _odometry(log, models), sigma, odometry_noise or OdometryNoise())
    if not len(path.rows):
        raise SonarError(
            "localize: no scan could be laid on another; allowed are scans with odometry, or near each other"
        )
    # 1. Where the first scan may be.
    found = np.array([_FOUND[0], _FOUND[0], _FOUND[1]])
    if start is None:
        begins = [_Run(pose, np.diag(found**2)) for pose in path.begins()]
    else:
        rough, near = np.array(start, dtype=np.float64), np.array([ROUGH[0], ROUGH[0], ROUGH[1]])
        begins = [_Run(rough, np.diag(near**2), rough=True)]
        begins += [_Run(pose, np.diag(found**2)) for pose in path.begins(rough)]
    # 2. Each is followed through the first scans, as long as it is not far behind the best one.
    runs = path.followed(begins, say)
    if start is not None:
        runs = path.near(runs, np.array(start, dtype=np.float64))
    places = tuple(Place(path.smoothed(run)[0][0], run.nats, run.explained) for run in runs)
    needed = (MARGIN, LEAST) if start is None else (MARGIN_NEAR, LEAST_NEAR)
    certain, why = _judged(places, len(path.rows), *needed)
    if certain and start is None and not runs[0].sure:
        certain, why = False, f"{len(path.rows)} scans: what they see leaves a direction open; a longer path may tell"
    poses, cov = np.full((len(log), 3), np.nan), np.full((len(log), 3, 3), np.nan)
    # 3. The only one, through all scans.
    if certain:
        run = runs[0]
        for number in range(len(run.poses), len(path.rows)):
            run = path.after(run, number)
            say("localizing", number + 1, len(path.rows))
        poses[path.rows], cov[path.rows] = path.smoothed(run)
    return Localized(poses, cov, stamps_of(log), places, certain, why)


def _odometry(log: Log, models: Sequence[LocalModel]) -> Float[np.ndarray, "scans 3"]:
    """Of the log, or from the scans themselves where there is none; NaN where a scan has no place."""
    known = np.asarray(np.isfinite(log.pose).all(axis=1))
    if known.any():
        return np.where(known[:, None], log.pose, np.nan)
    parts = register_scans(models, None, noise_scale=_BLUR) if len(models) > 1 else []
    if parts and np.isfinite(parts[0][:, 0]).sum() > 1:
        return parts[0]
    alone = np.full((len(log), 3), np.nan)  # the scan that sees most must do
    alone[int(np.argmax([len(model.lines) + len(model.points) for model in models]))] = 0.0
    return alone


def _judged(places: Sequence[Place], scans: int, margins: tuple[float, float], least: float) -> tuple[bool, str]:
    """Whether there is one place only, and what there is to say."""
    of = f"{scans} scan{'' if scans == 1 else 's'}"
    if not places or places[0].explained < least:
        share = f": at the best place {100 * places[0].explained:.0f} % of their echoes fit" if places else ""
        return False, f"{of}: no place in the map fits{share}; needed are {100 * least:.0f} %"
    best, others = places[0], [place.nats for place in places[1:]]
    margin = best.nats - float(np.asarray(logsumexp(others))) if others else np.inf
    needed = margins[0] + margins[1] * max(best.nats, 0.0)
    if margin < needed:
        alike = [place for place in places if place.nats > best.nats - needed]
        alike = alike if len(alike) > 1 else list(places[:2])
        shown = "; ".join(f"{p.pose[0]:.2f}, {p.pose[1]:.2f} m, {np.degrees(p.pose[2]):.0f} deg" for p in alike[:4])
        more = f"; {len(alike) - 4} more" if len(alike) > 4 else ""
        return False, f"{of}: ambiguous, {len(alike)} places look alike: {shown}{more}; a longer path may tell"
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
        across = np.where(np.isfinite(world.sigma_rho), world.sigma_rho**2 - (lever * turn) ** 2, _MAP[0] ** 2)
        # Echoes spread over its length tell both: were the rest smaller than this, it would be rounding.
        across = np.maximum(across, (half * turn) ** 2 / 12)
        wall_cov = np.zeros((len(world), 2, 2))
        wall_cov[:, 0, 0] = np.maximum(across, _FINE[0] ** 2)
        wall_cov[:, 1, 1] = np.maximum(turn, _FINE[1]) ** 2
        points = world.points
        point_cov = np.where(np.isfinite(world.point_cov), world.point_cov, np.eye(2) * _MAP[0] ** 2)
        kinds = [kernels.CORNER if kind == "corner" else kernels.EDGE for kind in world.point_kinds]
        if not kinds:  # a floor plan, say
            points, point_cov = _corners(world, middle, wall_cov)
            kinds = [kernels.CORNER] * len(points)
        none = np.zeros(len(kinds))
        return cls(
            np.array([kernels.PLANE] * len(world) + kinds, dtype=np.int32),
            np.concatenate([middle, points]),
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
        room = 3 * np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])
        rows = np.flatnonzero((near < reach + room) & (~wall | (beyond < _BESIDE + room)))
        rows = rows[np.argsort(near[rows], kind="stable")][:_MOST]
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


def _corners(
    world: GlobalMap, middle: Float[np.ndarray, "walls 2"], wall_cov: Float[np.ndarray, "walls 2 2"]
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2 2"]]:
    """Where walls of a map meet at right angles, and how well that is known."""
    gap = np.linalg.norm(world.segments[:, None, :, None] - world.segments[None, :, None], axis=-1).min(axis=(2, 3))
    square = np.abs(np.cos(world.theta[:, None] - world.theta)) < np.sin(_SQUARE)
    points, covs = [], []
    for pair in np.argwhere(np.triu((gap < _MEETS) & square, 1)):
        normal = unit(world.theta[pair])
        point = np.linalg.solve(normal, (normal * middle[pair]).sum(-1))
        along = ((point - middle[pair]) * unit(world.theta[pair] + np.pi / 2)).sum(-1)
        across = wall_cov[pair, 0, 0] + along**2 * wall_cov[pair, 1, 1]
        turned_back = np.linalg.inv(normal)
        points.append(point)
        covs.append(turned_back @ np.diag(across) @ turned_back.T)
    return np.array(points).reshape(-1, 2), np.array(covs).reshape(-1, 2, 2)


class _Run(NamedTuple):
    """A hypothesis, followed so far."""

    pose: Float[np.ndarray, "3"]
    """Of the latest scan, or of the first one before that is looked at."""
    cov: Float[np.ndarray, "3 3"]
    poses: tuple[Float[np.ndarray, "3"], ...] = ()
    covs: tuple[Float[np.ndarray, "3 3"], ...] = ()
    nats: float = 0.0
    heard: int = 0
    fits: int = 0
    """Echoes, and those that the map explains."""
    rough: bool = False
    """Whether it began with what a person said."""

    @property
    def explained(self) -> float:
        """Share of the echoes that the map explains."""
        return self.fits / max(self.heard, 1)

    @property
    def sure(self) -> bool:
        """Whether the scans, and not what was assumed, say where the robot is at last."""
        place = np.linalg.eigvalsh(self.cov[:2, :2])[-1]
        return bool(place < SURE[0] ** 2 and self.cov[2, 2] < SURE[1] ** 2)

    def same(self, other: "_Run") -> bool:
        """Whether two cannot be told apart."""
        off = self.pose - other.pose
        off[2] = wrap_angle(off[2])
        if np.hypot(off[0], off[1]) > SAME[0] or abs(off[2]) > SAME[1]:
            return False
        return bool(off @ np.linalg.solve(self.cov + other.cov + np.diag(_ONE) ** 2, off) < 16.0)


_ONE = np.array([0.02, 0.02, np.radians(1.0)])  # m, rad; nearer than this nothing is looked at twice


@dataclass(frozen=True)
class _Path:
    """The scans, and what is known of the way between them."""

    ring: Ring
    map: _Map
    log: Log
    models: Sequence[LocalModel]
    odometry: Float[np.ndarray, "scans 3"]
    sigma: float | None
    odometry_noise: OdometryNoise

    @property
    def rows(self) -> Int[np.ndarray, " rows"]:
        """Scans of which the way to each other is known."""
        return np.flatnonzero(np.isfinite(self.odometry[:, 0]))

    @property
    def noise(self) -> float:
        """Of the ranges, metres."""
        known = [model.sigma for model in self.models if model.sigma > 0]
        return self.sigma or (float(np.median(known)) if known else 0.003)

    def begins(self, rough: Float[np.ndarray, "3"] | None = None) -> list[Float[np.ndarray, "3"]]:
        """Poses of the first scan at which walls or corners of the first scans lie on those of the map.

        Args:
            rough: where the first scan was taken, about; anywhere if left out.
        """
        places, rows = _places(self.map), self.rows[:TRIED]
        held = np.diag(np.array([*_FOUND[:1] * 2, _FOUND[1]]) ** -2.0)
        first = self.odometry[rows[0]]
        richest = sorted(rows, key=lambda row: -len(features_of(self.models[row]).kind))
        views = {row: scan_features(self.models[row], noise_scale=_BLUR) for row in richest[:_TOGETHER]}
        steps = {row: relative(first, self.odometry[row]) for row in views}
        some = []
        for row in richest[:STARTS]:
            seen, back = views[row], relative(self.odometry[row], first)
            if len(seen.theta) + len(seen.point) < 2:
                continue
            # Two features fix a pose; what one wall alone allows is a whole line of them.
            found = pose_hypotheses(seen, places, np.zeros(3))[1 + len(seen.theta) * len(places.theta) :]
            if rough is not None:
                away = _followed_by(found, back) - rough
                near = np.hypot(away[:, 0], away[:, 1]) < _NEAR * ROUGH[0]
                found = found[near & (np.abs(wrap_angle(away[:, 2])) < _NEAR * ROUGH[1])]
            if not len(found):
                continue
            found = thin_poses(found, _CELL)
            parts = np.array_split(found, -(-len(found) // 4096))
            evidence = np.concatenate([pose_log_likelihood(places, seen, part).log_likelihood for part in parts])
            best = found[np.argsort(-evidence, kind="stable")[: 4 * KEPT]]
            some.append(_followed_by(refine_poses(places, seen, best, held, prior_mean=best, steps=_CLOSER), back))
        if not some:
            return []
        # What all of these scans say of them, as odometry has them.
        poses = thin_poses(np.concatenate(some), _CELL)
        evidence = sum(pose_log_likelihood(places, views[row], _followed_by(poses, steps[row])).log_likelihood for row in views)
        kept: list[Float[np.ndarray, 3]] = []
        for k in np.argsort(-np.asarray(evidence), kind="stable"):
            off = [poses[k] - one for one in kept]
            if all(np.hypot(*one[:2]) > SAME[0] / 2 or abs(wrap_angle(one[2])) > SAME[1] / 2 for one in off):
                kept.append(poses[k])
            if len(kept) == KEPT:
                break
        return kept

    def followed(self, begins: Sequence[_Run], say: Callable[[str, int, int], None]) -> list[_Run]:
        """Hypotheses through the first scans, the likeliest first; those far behind only as far as that shows."""
        tried = min(TRIED, len(self.rows))
        alive, dropped = list(begins), []
        for number in range(tried):
            alive = sorted((self.after(run, number) for run in alive), key=lambda run: -run.nats)
            alive = _different(alive)
            best = alive[0].nats if alive else 0.0
            behind = BEHIND[0] + BEHIND[1] * max(best, 0.0)
            # They would have gone on as they began.
            dropped += [(run, max(run.nats, 0.0) / max(best, 1e-9)) for run in alive if run.nats < best - behind]
            alive = [run for run in alive if run.nats >= best - behind]
            say("hypotheses", number + 1, tried)
        best = alive[0].nats if alive else 0.0
        fallen = [run._replace(nats=best * share) for run, share in dropped]
        return [*alive, *sorted(fallen, key=lambda run: -run.nats)]

    def near(self, runs: Sequence[_Run], rough: Float[np.ndarray, "3"]) -> list[_Run]:
        """Those near a rough pose, the likeliest first; what leaves a direction open is in that which began with it."""
        sd, judged = np.array([ROUGH[0], ROUGH[0], ROUGH[1]]), []
        for run in runs:
            away = self.smoothed(run)[0][0] - rough
            away[2] = wrap_angle(away[2])
            if run.rough or run.sure:
                judged.append(run._replace(nats=run.nats - float(np.square(away / sd).sum()) / 2))
        return sorted(judged, key=lambda run: -run.nats)

    def after(self, run: _Run, number: int) -> _Run:
        """A hypothesis one scan on, by odometry and the ranges of the echoes."""
        row, noise = int(self.rows[number]), self.noise
        pose, cov = run.pose, run.cov
        if number:
            pose, cov = self._moved(pose, cov, number)
        known = self.map.around(pose, cov, self.ring.max_range)
        scan = self.log[row]
        fit = update(self.ring, Track(known), scan, self.models[row], row=row, sigma=noise, grow=False)
        pose, cov = np.append(fit.pose[:2], wrap_angle(fit.pose[2])), fit.covariance
        # An explained echo is so much likelier than one that lies anywhere; those of one wall say the same.
        worth = float(np.log(self.ring.max_range / (noise * np.sqrt(2 * np.pi))))
        return _Run(
            pose,
            cov,
            (*run.poses, pose),
            (*run.covs, cov),
            run.nats + worth * fit.explained / 4 - fit.squared / 8,
            run.heard + len(scan.range),
            run.fits + fit.explained,
            run.rough,
        )

    def smoothed(self, run: _Run) -> tuple[Float[np.ndarray, "scans 3"], Float[np.ndarray, "scans 3 3"]]:
        """Poses of a hypothesis and their covariances, with what later scans tell of earlier ones.

        (Rauch, Tung and Striebel 1965.)
        """
        poses, covs = np.array(run.poses), np.array(run.covs)
        for k in reversed(range(len(poses) - 1)):
            # What the next pose was expected to be, and how that hangs on this one.
            ahead, both = self._moved(poses[k], np.tile(covs[k], (2, 2)), k + 1)
            gain = np.linalg.solve(both[:3, :3], both[:3, 3:]).T
            off = poses[k + 1] - ahead
            off[2] = wrap_angle(off[2])
            poses[k] += gain @ off
            poses[k, 2] = wrap_angle(poses[k, 2])
            covs[k] += gain @ (covs[k + 1] - both[:3, :3]) @ gain.T
        return poses, covs

    def _moved(
        self, pose: Float[np.ndarray, "3"], cov: Float[np.ndarray, "unknowns unknowns"], number: int
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "unknowns unknowns"]]:
        """A pose and what hangs on it, by odometry, at a scan from the one before."""
        step = relative(self.odometry[self.rows[number - 1]], self.odometry[self.rows[number]])
        return propagate(pose, cov, step, np.diag(step_variance(self.odometry_noise, step)))


def _different(runs: Sequence[_Run]) -> list[_Run]:
    """The first of those that are at the same place; that which began with what a person said assumes least."""
    kept: list[_Run] = []
    for run in runs:
        twin = next((k for k, one in enumerate(kept) if run.same(one)), None)
        if twin is None:
            kept.append(run)
        elif run.rough:
            kept[twin] = run
    return kept


def _followed_by(poses: Float[np.ndarray, "poses 3"], step: Float[np.ndarray, "3"]) -> Float[np.ndarray, "poses 3"]:
    """All of them after the same step."""
    place = poses[:, :2] + rotate(np.broadcast_to(step[:2], (len(poses), 2)), poses[:, 2])
    return np.column_stack([place, wrap_angle(poses[:, 2] + step[2])])


def _places(known: _Map) -> Features:
    """The map as what scans are laid on, every wall from both sides."""
    wall = np.flatnonzero(known.kind == kernels.PLANE)
    point = np.flatnonzero(known.kind != kernels.PLANE)
    return Features(
        reference=np.tile(known.anchor[wall], (2, 1)),
        theta=np.concatenate([known.theta[wall], wrap_angle(known.theta[wall] + np.pi)]),
        offset=np.zeros(2 * len(wall)),
        covariance=np.tile(known.cov[wall], (2, 1, 1)),
        extent=np.tile(known.half[wall, None] * [-1.0, 1.0], (2, 1)),
        weight=np.ones(2 * len(wall)),
        scans=np.full(2 * len(wall), 4.0),
        point=known.anchor[point],
        is_corner=known.kind[point] == kernels.CORNER,
        point_sd=np.sqrt(np.trace(known.cov[point], axis1=1, axis2=2) / 2),
    )
