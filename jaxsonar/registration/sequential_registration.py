"""Sequential registration: each scan is registered to the map of the scans before it, by walls, corners and edges.

The only method that uses odometry, and the only one for long logs. Every way to align a scan with the map is a
hypothesis. Its evidence (Laplace approximation, nats) is the sum of the log-likelihood of the features, the prior of
the motion, the volume of the posterior, and negative evidence. A scan is registered only if one hypothesis beats all
others.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar.detection.local_model import LocalModel
from jaxsonar.geometry.se2 import compose, inverse, subtract_poses, wrap_pose
from jaxsonar.hardware.errors import SonarError
from jaxsonar.registration.feature_map import fuse_scan, map_as_scan
from jaxsonar.registration.features import Features, no_features, scan_features
from jaxsonar.registration.motion_prior import MotionModel, MotionPrior
from jaxsonar.registration.pose_hypotheses import pose_hypotheses
from jaxsonar.registration.pose_likelihood import pose_log_likelihood, refine_poses
from jaxsonar.registration.scan_negative_evidence import scan_negative_evidence
from jaxsonar.registration.settings import FEATURE_SETTINGS as SETTINGS


def register_scans(
    models: Sequence[LocalModel],
    odometry: Float[np.ndarray, "scans 3"] | None = None,
    *,
    odometry_sd: float = SETTINGS.odometry_sd,
    margin: float = SETTINGS.margin,
    noise_scale: float = 1.0,
    directions: Bool[np.ndarray, "scans directions"] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Float[np.ndarray, "scans 3"]]:
    """Poses of the scans of an unknown place, accurate to centimetres and degrees: a start for an adjustment.

    Scans whose pose is ambiguous are left out. Without odometry a scan needs two walls that are not parallel, or a wall
    and a point, in common with the map.

    Args:
        models: local models in the order of the trajectory, lines and points in the robot frame.
        odometry: (scans, 3) world_from_robot (x, y, theta), metres and radians, drifting; NaN where there is none.
        odometry_sd: standard deviation of odometry as a fraction of the distance and of the rotation.
        margin: log-likelihood ratio, in nats, by which a pose must beat every other pose. A smaller margin registers
            more scans, but some of them wrongly.
        noise_scale: factor on the noise added to features: 1 for a ring that may be centimetres off, less for a
            calibrated one.
        directions: directions that each scan measured (``measured_directions``); None: all of them.
        progress: called with (scans processed, scans) now and then.

    Returns:
        One array per cluster of scans that could not be registered to each other, the largest cluster first. Each is
        (scans, 3) world_from_robot in a world of its own, metres and radians: the first scan of the cluster is at the
        origin, or at its odometry pose; NaN where a scan is not in the cluster. Empty if there is no usable scan.

    Raises:
        SonarError: odometry of another shape.
    """
    count = len(models)
    given = np.full((count, 3), np.nan) if odometry is None else np.array(odometry, dtype=np.float64)
    if given.shape != (count, 3):
        raise SonarError(
            f"register_scans: odometry of shape {given.shape}; allowed is ({count}, 3): x, y, theta for every scan"
        )
    given[~np.isfinite(given).all(axis=1)] = np.nan
    scans = _features(models, noise_scale, directions)
    registration = _Registration(scans, MotionModel(given, odometry_sd), margin)
    # 1. Scan after scan; a new cluster is started where the robot is lost.
    clusters = registration.clusters(progress)
    # 2. Clusters that align unambiguously are merged; then the remaining scans are tried again.
    clusters = registration.merged(sorted(clusters, key=lambda one: -one.count))
    clusters = sorted(clusters, key=lambda one: -one.count)
    # 3. The first pose of each cluster defines its world.
    return [_from_first(cluster.poses, given) for cluster in clusters]


def register_remaining(
    models: Sequence[LocalModel],
    poses: Float[np.ndarray, "scans 3"],
    odometry: Float[np.ndarray, "scans 3"] | None = None,
    *,
    odometry_sd: float = SETTINGS.odometry_sd,
    margin: float = SETTINGS.margin,
    noise_scale: float = 1.0,
    directions: Bool[np.ndarray, "scans directions"] | None = None,
) -> Float[np.ndarray, "scans 3"]:
    """Register scans without a pose to the map of the scans that have one.

    Args:
        models: as for ``register_scans``.
        poses: (scans, 3) world_from_robot of the registered scans, metres and radians; NaN for the others.
        odometry: as for ``register_scans``.
        odometry_sd: as for ``register_scans``.
        margin: as for ``register_scans``.
        noise_scale: as for ``register_scans``.
        directions: as for ``register_scans``.

    Returns:
        (scans, 3): the given poses, unchanged, and those that were found; NaN for the remaining scans.
    """
    given = np.full((len(models), 3), np.nan) if odometry is None else np.array(odometry, dtype=np.float64)
    scans = _features(models, noise_scale, directions)
    registration = _Registration(scans, MotionModel(given, odometry_sd), margin)
    base = _FeatureCluster(len(models))
    for scan in np.flatnonzero(np.isfinite(poses[:, 0])):
        base.add(int(scan), scans[scan], poses[scan])
    free = ~base.registered
    registration.fill(base, free)
    others = [one for one in registration.clusters(None, free & ~base.registered) if one.count > 1]
    return registration.merged([base, *others])[0].poses


def _features(
    models: Sequence[LocalModel], noise_scale: float, directions: Bool[np.ndarray, "scans directions"] | None
) -> list[Features]:
    """Features of all scans."""
    rows = [None] * len(models) if directions is None else list(directions)
    pairs = zip(models, rows, strict=True)
    return [scan_features(model, noise_scale=noise_scale, directions=row) for model, row in pairs]


def _from_first(
    poses: Float[np.ndarray, "scans 3"], odometry: Float[np.ndarray, "scans 3"]
) -> Float[np.ndarray, "scans 3"]:
    """Poses in the world in which the first registered scan is at its odometry pose, or at the origin."""
    first = int(np.flatnonzero(np.isfinite(poses[:, 0]))[0])
    start = odometry[first] if np.isfinite(odometry[first, 0]) else np.zeros(3)
    return compose(compose(start, inverse(poses[first])), poses)


class _FeatureCluster:
    """Scans that are registered to each other, and their map."""

    def __init__(self, scans: int) -> None:
        self.poses = np.full((scans, 3), np.nan)
        self.map = no_features()

    @property
    def registered(self) -> Bool[np.ndarray, " scans"]:
        return np.isfinite(self.poses[:, 0])

    @property
    def count(self) -> int:
        return int(self.registered.sum())

    def add(self, scan: int, features: Features, pose: Float[np.ndarray, "3"]) -> None:
        """Add a scan at a pose, and fuse its features with the map."""
        self.poses[scan] = pose
        match = pose_log_likelihood(self.map, features, pose[None])
        self.map = fuse_scan(self.map, features, pose, match.wall[0], match.point[0])


class _Registration:
    """The scans of a log, and how they are added to clusters."""

    def __init__(self, scans: list[Features], motion: MotionModel, margin: float):
        self.scans, self.motion, self.margin = scans, motion, margin
        distance = np.concatenate([np.zeros(1), *(one.detections[:, 0] for one in scans)])
        self.reliable_range = SETTINGS.reliable_range_fraction * float(np.quantile(distance, SETTINGS.range_quantile))

    def clusters(
        self, progress: Callable[[int, int], None] | None, free: Bool[np.ndarray, " scans"] | None = None
    ) -> list[_FeatureCluster]:
        """Clusters of the free scans (all if left out), each from its first scan on."""
        count, clusters = len(self.scans), []
        free = np.ones(count, dtype=bool) if free is None else free.copy()
        for start in range(count):
            if not free[start] or not self._can_start(start):
                continue
            cluster = self._grown_from(start, free, progress)
            self.fill(cluster, free)
            free &= ~cluster.registered
            clusters.append(cluster)
        if progress is not None:
            progress(count, count)
        return [one for one in clusters if one.count > 1] or clusters[:1]

    def _can_start(self, scan: int) -> bool:
        """Whether a scan determines a frame: by two directions, or by one and odometry."""
        features = self.scans[scan]
        walls, points = len(features.theta), len(features.point)
        sine = np.abs(np.sin(features.theta[:, None] - features.theta)).max(initial=0.0)
        enough = sine > SETTINGS.crossing_sine or (walls and points) or points > 1
        return bool(enough) or bool(walls and self.motion.has_odometry(scan))

    def _grown_from(
        self, start: int, free: Bool[np.ndarray, " scans"], progress: Callable[[int, int], None] | None
    ) -> _FeatureCluster:
        """A cluster from one scan on, until the robot is lost."""
        count, lost = len(self.scans), 0
        cluster = _FeatureCluster(count)
        cluster.add(start, self.scans[start], np.zeros(3))
        for scan in range(start + 1, count):
            found = free[scan] and self._register(cluster, scan)
            lost = 0 if found else lost + 1
            if progress is not None:
                progress(scan, count)
            if lost >= SETTINGS.max_unregistered:
                break
        return cluster

    def _register(self, cluster: _FeatureCluster, scan: int) -> bool:
        """Add a scan to a cluster if its pose is unambiguous; whether it was."""
        features = self.scans[scan]
        if not len(features.theta) + len(features.point):
            return False
        inside = np.flatnonzero(cluster.registered)
        split = int(np.searchsorted(inside, scan))
        anchors = inside[max(split - 1, 0) : split + 1]
        priors = self.motion.priors(cluster.poses, anchors, scan)
        margin = self.margin + SETTINGS.margin_per_gap * (int(np.abs(anchors - scan).min()) - 1)
        pose = unambiguous_pose(features, cluster.map, priors, reliable_range=self.reliable_range, margin=margin)
        if pose is not None:
            cluster.add(scan, features, pose)
        return pose is not None

    def fill(self, cluster: _FeatureCluster, free: Bool[np.ndarray, " scans"]) -> None:
        """Try the free scans near a cluster again, backward and forward, until none is added."""
        for turn in range(4):
            inside, scans = np.flatnonzero(cluster.registered), np.arange(len(free))
            behind = np.searchsorted(inside, scans)
            beside = inside[np.clip(np.stack([behind - 1, behind]), 0, len(inside) - 1)]
            gap = np.abs(beside - scans).min(axis=0)
            wanted = np.flatnonzero(free & ~cluster.registered & (gap <= SETTINGS.max_unregistered))
            added = [self._register(cluster, int(scan)) for scan in (wanted if turn % 2 else wanted[::-1])]
            if turn and not any(added):
                break

    def merged(self, clusters: list[_FeatureCluster]) -> list[_FeatureCluster]:
        """Merge the other clusters into the first one wherever the alignment is unambiguous."""
        number = 1
        while number < len(clusters):
            base = clusters[0]
            moved = self._aligned(base, clusters[number])
            if moved is None:
                number += 1
                continue
            for scan in np.flatnonzero(np.isfinite(moved[:, 0])):
                base.add(int(scan), self.scans[scan], moved[scan])
            clusters = clusters[:number] + clusters[number + 1 :]
            taken = np.any([one.registered for one in clusters], axis=0)
            self.fill(base, ~taken)
            # The map has grown: clusters that were ambiguous may not be any more.
            number = 1
        return clusters

    def _aligned(self, base: _FeatureCluster, other: _FeatureCluster) -> Float[np.ndarray, "scans 3"] | None:
        """Poses of another cluster in the frame of the base, or None where the alignment is ambiguous."""
        mine, theirs = np.flatnonzero(base.registered), np.flatnonzero(other.registered)
        gap = np.abs(mine[:, None] - theirs)
        a, b = np.unravel_index(int(gap.argmin()), gap.shape)
        anchor = int(theirs[b])
        priors = self.motion.priors(base.poses, mine[a : a + 1], anchor)
        margin = self.margin + SETTINGS.margin_per_gap * min(int(gap[a, b]), SETTINGS.max_unregistered)
        other_from_anchor = other.poses[anchor]
        scan = map_as_scan(other.map, other_from_anchor)
        pose = unambiguous_pose(scan, base.map, priors, reliable_range=0.0, margin=margin)
        return None if pose is None else compose(compose(pose, inverse(other_from_anchor)), other.poses)


def unambiguous_pose(
    scan: Features, known: Features, priors: list[MotionPrior], *, reliable_range: float, margin: float
) -> Float[np.ndarray, "3"] | None:
    """The only pose at which a scan agrees with a map, map_from_robot, or None.

    Args:
        scan: features of the scan in the robot frame.
        known: the map.
        priors: components of the prior, the widest one last.
        reliable_range: distance within which walls are surely detected, metres; 0: no negative evidence.
        margin: nats by which the best hypothesis must beat every different one.
    """
    widest = priors[-1]
    near = known.within(widest.pose[:2], 3 * widest.sd[0] + 2 * scan.radius)
    candidates = [_refined_hypotheses(scan, near, prior, reliable_range) for prior in priors]
    poses, nats, information = (np.concatenate(part) for part in zip(*candidates, strict=True))
    if not len(poses):
        return None
    best = int(nats.argmax())
    offset = subtract_poses(poses, poses[best])
    different = np.linalg.norm(offset[:, :2], axis=1) > SETTINGS.distinct_pose[0]
    different |= np.abs(offset[:, 2]) > SETTINGS.distinct_pose[1]
    if nats[different].max(initial=-np.inf) > nats[best] - margin:
        return None
    cov = np.linalg.inv(information[best])
    position_sd, heading_sd = SETTINGS.max_pose_sd
    if np.linalg.eigvalsh(cov[:2, :2])[-1] > position_sd**2 or cov[2, 2] > heading_sd**2:
        return None
    return wrap_pose(poses[best])


def _refined_hypotheses(
    scan: Features, known: Features, prior: MotionPrior, reliable_range: float
) -> tuple[Float[np.ndarray, "poses 3"], Float[np.ndarray, " poses"], Float[np.ndarray, "poses 3 3"]]:
    """The best hypotheses under a prior: poses, their evidence in nats, and their information."""
    poses = pose_hypotheses(scan, known, prior.pose)
    poses = poses[np.linalg.norm(poses[:, :2] - prior.pose[:2], axis=1) < 3.5 * prior.sd[0]]
    score = pose_log_likelihood(known, scan, poses).log_likelihood + prior.log_density(poses)
    poses = poses[np.argsort(-score, kind="stable")[: SETTINGS.refined_poses]]
    # Odometry is a measurement; the usual motion of robots only damps the steps.
    mean = None if prior.any_turn else prior.pose
    poses = refine_poses(known, scan, poses, prior.information(), prior_mean=mean)
    found = pose_log_likelihood(known, scan, poses)
    information = found.information + prior.information()
    volume = 1.5 * np.log(2 * np.pi) - np.linalg.slogdet(information)[1] / 2
    start = prior.pose[:2] if prior.straight else None
    against = scan_negative_evidence(known, scan, poses, found.wall, reliable_range=reliable_range, start=start)
    return poses, found.log_likelihood + prior.log_density(poses) + volume - against, information
