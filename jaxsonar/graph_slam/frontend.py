"""The robot's pose scan by scan, in a submap that grows with it (paper, section 5, last paragraph).

A scan's walls and points are matched to what is known, their echoes and all others that a known reflector explains are
taken in by their ranges, and what is new becomes known. Nothing here depends on how long the run is.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.detection.local_map import LocalModel
from jaxsonar.estimation.odometry_noise import OdometryNoise, step_variance
from jaxsonar.geometry.se2 import propagate, relative, transform_points, unit
from jaxsonar.graph_slam.joint_compatibility import Features, Known, features_of, match
from jaxsonar.kernels.shape_buckets import next_power_of_two, pad_rows
from jaxsonar.loop_closure.submap import Submap
from jaxsonar.scans.flat_echoes import corrected_echoes
from jaxsonar.scans.scan_log import Scan
from jaxsonar.sensors.ring import Ring

LENGTH = 3.0
"""Metres from its beginning at which a submap ends."""
MOST = 48
"""Reflectors of a submap."""
SEEN_TWICE = 2
"""Scans that see a reflector that is kept."""
BRIDGED = 3
"""Scans in a row without odometry over which that of the scan before leads to the next one."""
LOST = 3
"""Scans in a row that know nothing of what they see, after which the robot is elsewhere than odometry says."""
ELSEWHERE = (1.5, 1.0)
"""Standard deviation of where that is, metres and radians."""
GATE, DOUBT = 4.0, 5.0
"""Sigma; how far an echo may be off its reflector, and how near to its range another one's makes it doubtful."""
SURE = 2.0
"""Sigma; how well a range must be known from the scan's own features, to take in an echo that none of them has."""
HEARD = 0.85
"""Of the ring's maximum range; walls nearer than this are heard."""
_OFF, _FACING = 0.1, 6  # m; a wall's echo may be so far from where it is due; sensors that face walls, to tell
_NEW = np.array([0.5, 0.3])  # m, rad; a reflector before its first echoes are taken in
_SEEN, _ROOM, _ECHOES = 16, 32, 64  # features, reflectors, echoes; powers of two from there on are compiled
_SIGMA, _CREDIT = 0.003, 30.0  # m; noise before any is known, and the echoes that this is worth
_LEAST_SIGMA = 1e-5
_LEFT = 7 / 8  # of the echoes of a scan, the rest is what is estimated of it


@dataclass(frozen=True, eq=False)
class Track:
    """What the robot remembers of the submap that it is in."""

    known: Known
    """Robot and reflectors, in the frame of the submap."""
    rows: tuple[int, ...] = ()
    """Scans taken in it, in order (numbers of the run)."""
    poses: tuple[Float[np.ndarray, "3"], ...] = ()
    """submap_from_robot of each."""
    covs: tuple[Float[np.ndarray, "3 3"], ...] = ()
    """Their covariances."""
    odometry: Float[np.ndarray, "3"] | None = None
    """Of the last scan, where the pose is; None where it had none."""
    bridged: int = 0
    """Scans without odometry since then, which moved nothing."""
    squares: float = 0.0
    """Sum of squared residuals so far, square metres."""
    free: float = 0.0
    """Echoes that went into it, less what was estimated of them."""
    strange: int = 0
    """Scans in a row that knew nothing of what they saw."""
    explained: int = 0
    """Echoes of the last scan that a reflector explains."""
    squared: float = 0.0
    """Their squared residuals over the variance of the ranges, summed."""

    @property
    def sigma(self) -> float:
        """Noise of the ranges as far as known, metres."""
        return max(float(np.sqrt(self.squares / self.free) if self.free else _SIGMA), _LEAST_SIGMA)

    @property
    def pose(self) -> Float[np.ndarray, "3"]:
        """submap_from_robot."""
        return self.known.pose

    @property
    def covariance(self) -> Float[np.ndarray, "3 3"]:
        """Of the pose, with respect to the submap."""
        return self.known.covariance[:3, :3]

    @property
    def ends(self) -> bool:
        """Whether this submap is large enough."""
        return bool(np.hypot(*self.pose[:2]) > LENGTH) or len(self.known) > MOST


def begin(before: Track | None = None) -> Track:
    """A submap that begins where the robot is now.

    Args:
        before: the one that ends there.
    """
    known = _nothing_known()
    if before is None:
        return Track(known)
    return Track(known, odometry=before.odometry, squares=before.squares, free=before.free)


def _nothing_known() -> Known:
    none = np.zeros((0, 2))
    return Known(np.zeros(3), np.zeros(0, np.int32), none, none, none, np.zeros((3, 3)), np.zeros(0, np.int64))


def advance(track: Track, odometry: Float[np.ndarray, "3"], odometry_noise: OdometryNoise) -> Track:
    """The belief after the robot's motion from where the pose is; without odometry it is somewhere near."""
    here = np.isfinite(odometry).all()
    unknown = np.full(3, np.nan)
    step = relative(track.odometry, odometry) if here and track.odometry is not None else unknown
    first = track.odometry is None and not track.rows and not len(track.known)
    variance = np.zeros(3) if first else step_variance(odometry_noise, step)
    if not here:
        variance = variance * (1 + track.bridged)
    pose, covariance = propagate(track.known.pose, track.known.covariance, np.nan_to_num(step), np.diag(variance))
    known = replace(track.known, pose=pose, covariance=covariance)
    return replace(track, known=known, odometry=odometry if here else None, bridged=0)


def aside(ring: Ring, track: Track, scan: Scan, model: LocalModel, odometry_noise: OdometryNoise, *, row: int, **given: Any) -> Track:
    """Look at a scan that has no odometry, between others that do: its pose is told, nothing else hangs on it.

    What the odometry of the next scan leads on from is the pose before; if this scan moved it, its motion would count
    twice. Arguments as for ``advance`` and ``update``.
    """
    seen = update(ring, advance(track, np.full(3, np.nan), odometry_noise), scan, model, row=row, grow=False, **given)
    return replace(track, rows=seen.rows, poses=seen.poses, covs=seen.covs, bridged=track.bridged + 1)


def update(
    ring: Ring,
    track: Track,
    scan: Scan,
    model: LocalModel,
    *,
    row: int,
    sigma: float | None = None,
    path_pose: Float[np.ndarray, "paths 3"] | None = None,
    grow: bool = True,
) -> Track:
    """Take in one scan, whose motion is accounted for.

    Args:
        ring: the sensors.
        track: the belief before.
        scan: its echoes.
        model: what it sees.
        row: number of the scan in the run.
        sigma: noise of the ranges, metres; learned on the way if left out.
        path_pose: where the robot was when each path fired, as ``local_model`` takes it.
        grow: whether what is new becomes known.
    """
    if sigma is None and not track.free:
        track = replace(track, squares=_CREDIT * (model.sigma if model.sigma > 0 else _SIGMA) ** 2, free=_CREDIT)
    noise = track.sigma if sigma is None else sigma
    echoes = _Echoes.of(ring, scan, path_pose)
    seen = features_of(model)
    full = float(np.asarray(ring.exact_paths.width).sum() / (2 * np.pi))
    with jax.enable_x64(True):
        # Where the robot is by what it knows again; then, with that, what is new and what else was heard.
        first = match(track.known, seen, full=full)
        feature = echoes.claimed(seen, noise)
        found = echoes.tracked(track.known, _of(first.reflector, feature), noise)
        matches = match(echoes.known(track.known, found), seen, full=full)
        strange = len(seen.kind) > 1 and len(track.known) > 1 and not (first.reflector >= 0).any()
        strange = strange and _silent(ring, track.known, scan, path_pose)
        # What a robot sees that is elsewhere must not become known here.
        fresh = np.flatnonzero(matches.fresh & (grow and not strange))
        known = _with_new(track.known, seen.take(fresh), np.asarray(found.belief.pose))
        reflector = matches.reflector.copy()
        reflector[fresh] = len(track.known) + np.arange(len(fresh))
        every = echoes.explained(found, _of(reflector, feature), noise)
        found = echoes.tracked(known, every, noise)
    known = echoes.known(known, found)
    used = np.asarray(found.used)[: len(echoes)] > 0
    explains = np.bincount(every[used], minlength=len(known)) > 0
    known = _seen_farther(known, seen, reflector, explains)
    residual = np.asarray(found.residual)[: len(echoes)][used]
    squares = float(residual @ residual)
    return replace(
        track,
        known=known,
        rows=(*track.rows, row),
        poses=(*track.poses, known.pose),
        covs=(*track.covs, known.covariance[:3, :3]),
        squares=track.squares + squares,
        free=track.free + len(residual) * _LEFT,
        strange=track.strange + 1 if strange else 0,
        explained=len(residual),
        squared=squares / noise**2,
    )


def finished(track: Track, *, lost: bool = False) -> Submap:
    """The submap that ends here, without what only one scan saw.

    Args:
        track: the belief.
        lost: whether the robot is not where its pose says.
    """
    known = track.known
    twice = min(SEEN_TWICE, max(1, len(track.rows) - 1))
    kept = np.flatnonzero(known.scans >= twice)
    unknown = np.concatenate([np.arange(3), (3 + 2 * kept[:, None] + [0, 1]).ravel()]).astype(np.int64)
    covariance = known.covariance[np.ix_(unknown, unknown)]
    if lost:
        covariance[:3, :3] += np.diag(np.square([ELSEWHERE[0], ELSEWHERE[0], ELSEWHERE[1]]))
    return Submap(
        kind=known.kind[kept],
        parameters=known.parameters[kept],
        anchor=known.anchor[kept],
        ends=known.ends[kept],
        scans=known.scans[kept],
        exit=known.pose,
        covariance=covariance,
        rows=np.array(track.rows, dtype=np.int64),
        poses=np.array(track.poses).reshape(-1, 3),
        pose_cov=np.array(track.covs).reshape(-1, 3, 3),
    )


def _silent(ring: Ring, known: Known, scan: Scan, path_pose: Float[np.ndarray, "paths 3"] | None) -> bool:
    """Whether most of the sensors that face known walls hear nothing from there.

    That a scan knows nothing of what it sees is no proof that the robot is elsewhere: around a corner all is new, and
    few of the walls that are known are faced.
    """
    room = next_power_of_two(len(known), least=_ROOM)
    direct = np.flatnonzero(ring.paths[:, 0] == ring.paths[:, 1])
    paths = jax.tree.map(lambda leaf: leaf[direct], ring.exact_paths)
    if path_pose is not None:
        paths = _moved(paths, path_pose[direct])
    first = np.full(len(ring.paths), np.inf)
    row = ring.path_index[scan.tx, scan.rx]
    reach = np.asarray(ring.corrected(scan.range, scan.tx, scan.rx), dtype=np.float64)
    np.minimum.at(first, row[row >= 0], np.where(reach > 0, reach, np.inf)[row >= 0])
    due = np.asarray(kernels.expected_ranges(known.pose, _in_room(known.scene, room), paths))[: len(known)]
    often = (known.kind == kernels.PLANE) & (known.scans >= SEEN_TWICE)
    due = np.where(often[:, None], due, np.inf).min(axis=0)
    due = np.where(due < HEARD * float(ring.max_range), due, np.inf)
    facing = np.isfinite(due)
    first, due = first[direct][facing], due[facing]
    heard = int((np.abs(first - due) < _OFF).sum())
    return len(due) >= _FACING and len(due) - heard > heard


@dataclass(frozen=True, eq=False)
class _Echoes:
    """Echoes of one scan, padded, with the geometry of their paths."""

    path: kernels.EchoPaths
    ranges: Float[np.ndarray, " room"]
    """Corrected, metres; 0 for padding."""
    count: int

    def __len__(self) -> int:
        return self.count

    @classmethod
    def of(cls, ring: Ring, scan: Scan, path_pose: Float[np.ndarray, "paths 3"] | None) -> "_Echoes":
        row, reach = corrected_echoes(ring, scan)
        room = next_power_of_two(len(row), least=_ECHOES)
        paths = ring.exact_paths
        padded = pad_rows(row, room)
        own = jax.tree.map(lambda leaf: leaf[padded], paths)
        if path_pose is not None:
            own = _moved(own, pad_rows(path_pose[row], room))
        return cls(own, pad_rows(reach, room), len(row))

    def claimed(self, seen: Features, noise: float) -> Int[np.ndarray, " echoes"]:
        """Feature of the echoes that the scan's own features explain; -1 for all others."""
        count = len(seen.kind)
        if not count or not self.count:
            return np.full(self.count, -1)
        room = next_power_of_two(count, least=_SEEN)
        scene = _in_room(scene_of(seen, np.zeros(3)), room)
        expected = np.asarray(kernels.expected_ranges(np.zeros(3), scene, self.path))[:count, : self.count]
        off = np.abs(expected - self.ranges[: self.count])
        best = off.argmin(axis=0)
        near = off.min(axis=0) < GATE * noise
        return np.where(near, best, -1)

    def tracked(self, known: Known, row: np.ndarray, noise: float) -> kernels.EkfUpdate:
        """The belief after echoes of these reflectors."""
        room = next_power_of_two(len(known), least=_ROOM)
        size, used = 3 + 2 * room, len(known.covariance)
        covariance = np.zeros((size, size))
        covariance[:used, :used] = known.covariance
        belief = kernels.Belief(
            known.pose,
            _in_room(known.scene, room),
            covariance,
        )
        rows = pad_rows(row.astype(np.int32), len(self.ranges), fill=-1)
        return kernels.ekf_update(belief, self.path, self.ranges, rows, np.float64(noise**2))

    def explained(self, found: kernels.EkfUpdate, claimed: np.ndarray, noise: float) -> np.ndarray:
        """Reflector of every echo that one surely explains, and no other one nearly so; else what claims it."""
        predicted = kernels.predict_ranges(found.belief, self.path)
        expected, variance = (np.asarray(one)[:, : self.count] for one in (predicted.expected, predicted.variance))
        # Where the belief leaves room, anything may happen to fit.
        room = np.where(variance < (SURE * noise) ** 2, expected, np.inf)
        off = np.abs(room - self.ranges[: self.count])
        best = off.argmin(axis=0)
        near = off.min(axis=0, initial=np.inf) < GATE * noise
        nearest = np.where(near, np.take_along_axis(expected, best[None], axis=0)[0], 0.0)
        apart = np.abs(expected - nearest)
        apart[best, np.arange(self.count)] = np.inf
        sure = near & (apart.min(axis=0, initial=np.inf) > DOUBT * noise)
        return np.where(sure, best, np.where(near, -1, claimed))

    def known(self, before: Known, found: kernels.EkfUpdate) -> Known:
        """The belief without padding."""
        count, size = len(before), len(before.covariance)
        belief = found.belief
        return replace(
            before,
            pose=np.asarray(belief.pose),
            parameters=np.asarray(belief.landmarks.parameters)[:count],
            covariance=np.asarray(belief.covariance)[:size, :size],
        )


def _moved(paths: kernels.EchoPaths, pose: Float[np.ndarray, "echoes 3"]) -> kernels.EchoPaths:
    moved_paths = jax.vmap(kernels.transform_path)(paths, jnp.asarray(pose))
    return jax.tree.map(np.asarray, moved_paths)


def scene_of(seen: Features, pose: Float[np.ndarray, "3"]) -> kernels.Landmarks:
    """What a scan sees as reflectors of the frame that its pose is of; walls are anchored in their middle."""
    segment = transform_points(pose, seen.segment)
    middle, half = segment.mean(axis=1), np.linalg.norm(segment[:, 1] - segment[:, 0], axis=-1) / 2
    theta = seen.place[:, 1] + pose[2]
    normal = unit(theta)
    distance = seen.place[:, 0] + normal @ pose[:2] - (normal * middle).sum(-1)
    wall = (seen.kind == kernels.PLANE)[:, None]
    return kernels.Landmarks(
        kind=seen.kind,
        parameters=np.where(wall, np.stack([distance, theta], -1), 0.0),
        anchor=np.where(wall, middle, transform_points(pose, seen.place)),
        extent=np.where(wall, half[:, None] * [-1.0, 1.0], 0.0),
    )


def _in_room(scene: kernels.Landmarks, room: int) -> kernels.Landmarks:
    """With room for so many reflectors."""
    rest = (pad_rows(np.asarray(leaf), room) for leaf in (scene.parameters, scene.anchor, scene.extent))
    return kernels.Landmarks(pad_rows(np.asarray(scene.kind), room, fill=-1), *rest)


def _with_new(known: Known, new: Features, pose: Float[np.ndarray, "3"]) -> Known:
    """Reflectors that are seen for the first time, as wide as before their first echo."""
    count = len(new.kind)
    if not count:
        return known
    scene = scene_of(new, pose)
    size = len(known.covariance)
    covariance = np.zeros((size + 2 * count,) * 2)
    covariance[:size, :size] = known.covariance
    wide = np.where((new.kind == kernels.PLANE)[:, None], _NEW, _NEW[0]).ravel()
    covariance[np.arange(size, size + 2 * count), np.arange(size, size + 2 * count)] = wide**2
    return Known(
        pose=known.pose,
        kind=np.concatenate([known.kind, scene.kind]).astype(np.int32),
        parameters=np.concatenate([known.parameters, scene.parameters]),
        anchor=np.concatenate([known.anchor, scene.anchor]),
        ends=np.concatenate([known.ends, scene.extent]),
        covariance=covariance,
        scans=np.concatenate([known.scans, np.zeros(count, np.int64)]),
    )


def _seen_farther(known: Known, seen: Features, reflector: Int[np.ndarray, " features"], explains: np.ndarray) -> Known:
    """Walls reach as far as they were seen; whatever explains an echo was seen once more."""
    ends = known.ends.copy()
    for feature in np.flatnonzero((reflector >= 0) & (seen.kind == kernels.PLANE)):
        wall = reflector[feature]
        tangent = unit(known.parameters[wall, 1] + np.pi / 2)
        along = (transform_points(known.pose, seen.segment[feature]) - known.anchor[wall]) @ tangent
        ends[wall] = min(ends[wall, 0], along.min()), max(ends[wall, 1], along.max())
    return replace(known, ends=ends, scans=known.scans + explains)


def _of(reflector: Int[np.ndarray, " features"], feature: Int[np.ndarray, " echoes"]) -> Int[np.ndarray, " echoes"]:
    """Reflector of each echo by the feature that claims it; -1 for none."""
    return np.append(reflector, -1)[feature]
