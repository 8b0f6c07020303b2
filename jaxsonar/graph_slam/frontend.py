"""SLAM front end: EKF-SLAM in the submap around the robot, scan by scan (paper, section 5, last paragraph).

For every scan: ``predict`` by odometry, then ``update``: associate the scan's walls and points with landmarks, update
pose and landmarks by the ranges of the echoes, and add new landmarks. The cost of a scan does not grow with the run.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.detection.local_model import LocalModel
from jaxsonar.detection.settings import DEFAULT_SIGMA
from jaxsonar.estimation.odometry_noise import OdometryNoise, step_variance
from jaxsonar.geometry.landmarks import concatenate_landmarks, transform_landmarks
from jaxsonar.geometry.se2 import diagonal_covariance, propagate, relative, tangent_of, transform_points
from jaxsonar.graph_slam.feature_association import FeatureMeasurements, associate_features, feature_measurements
from jaxsonar.graph_slam.scan_echoes import ScanEchoes, known_walls_missed, without_padding
from jaxsonar.loop_closure.submap import Submap
from jaxsonar.scans.measured_directions import directions_of_paths, stacked_directions
from jaxsonar.scans.measured_paths import full_wall_paths, measured_paths
from jaxsonar.scans.scan_log import Scan
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class FrontendSettings:
    """Constants of the front end; chosen by hand unless stated otherwise."""

    submap_length: float = 3.0
    """Metres from its origin at which a submap is finished."""
    max_landmarks: int = 48
    """Number of landmarks beyond which a submap is finished."""
    min_scans: int = 2
    """Least number of scans that observed a landmark of a finished submap."""
    max_dead_reckoned: int = 3
    """Longest run of scans without odometry that the odometry before and after it bridges."""
    track_loss_scans: int = 3
    """Scans in a row without a known feature, and with missed walls, after which the track is lost."""
    track_loss_sd: tuple[float, float] = (1.5, 1.0)
    """Standard deviations of the pose after a track loss, metres and radians."""
    new_landmark_sd: tuple[float, float] = (0.5, 0.3)
    """Standard deviations of a new landmark's (distance, theta) before its first update, metres and radians; the first
    one holds for both coordinates of points."""
    default_sigma: float = DEFAULT_SIGMA
    """Standard deviation of the ranges where the local model has no estimate, metres."""
    sigma_prior_echoes: float = 30.0
    """Number of echoes that the first estimate of the standard deviation of the ranges is worth."""
    min_sigma: float = 1e-5
    """Least standard deviation of the ranges, metres."""
    dof_per_echo: float = 7 / 8
    """Degrees of freedom that an echo adds; the rest is spent on pose and landmarks."""


SETTINGS = FrontendSettings()


def empty_belief() -> kernels.Belief:
    """A robot at the origin, exactly known, and no landmark."""
    return kernels.Belief(np.zeros(3), concatenate_landmarks([]), np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class SubmapState:
    """The submap around the robot: EKF state, and the scans taken in it."""

    belief: kernels.Belief
    """Pose and landmarks in the frame of the submap."""
    scan_counts: Int[np.ndarray, " landmarks"]
    """Number of scans that observed each landmark."""
    rows: tuple[int, ...] = ()
    """Row in the run of each scan taken in the submap."""
    poses: tuple[Float[np.ndarray, "3"], ...] = ()
    """submap_from_robot of each of these scans."""
    covariances: tuple[Float[np.ndarray, "3 3"], ...] = ()
    """Covariances of ``poses``."""
    directions: tuple[Bool[np.ndarray, " directions"] | None, ...] = ()
    """Directions that each of these scans measured (``directions_of_paths``); None: all paths were measured."""
    odometry: Float[np.ndarray, "3"] | None = None
    """Odometry of the scan to which the pose of the belief belongs; None if it had none."""
    dead_reckoned: int = 0
    """Scans without odometry since then, which did not change the belief."""
    sum_of_squares: float = 0.0
    """Sum of squared residuals of all updates, square metres."""
    dof: float = 0.0
    """Degrees of freedom of ``sum_of_squares``."""
    track_loss_count: int = 0
    """Scans in a row that contained no known feature and missed known walls."""
    explained: int = 0
    """Echoes of the last scan that landmarks explain."""
    normalized_squares: float = 0.0
    """Sum of their squared residuals, divided by the variance of the ranges."""

    @property
    def sigma(self) -> float:
        """Estimated standard deviation of the ranges, metres."""
        sigma = float(np.sqrt(self.sum_of_squares / self.dof) if self.dof else SETTINGS.default_sigma)
        return max(sigma, SETTINGS.min_sigma)

    @property
    def pose(self) -> Float[np.ndarray, "3"]:
        """submap_from_robot."""
        return np.asarray(self.belief.pose)

    @property
    def pose_covariance(self) -> Float[np.ndarray, "3 3"]:
        """Covariance of ``pose``."""
        return np.asarray(self.belief.covariance[:3, :3])

    @property
    def is_complete(self) -> bool:
        """Whether the submap is large enough to be finished."""
        far = bool(np.hypot(*self.pose[:2]) > SETTINGS.submap_length)
        return far or len(self.scan_counts) > SETTINGS.max_landmarks

    @property
    def track_lost(self) -> bool:
        """Whether the estimated pose is wrong, because the robot was moved by hand."""
        return self.track_loss_count >= SETTINGS.track_loss_scans


def start_submap(previous: SubmapState | None = None) -> SubmapState:
    """A submap with its origin at the robot; the noise estimate and odometry of the previous one are kept."""
    state = SubmapState(empty_belief(), np.zeros(0, np.int64))
    if previous is None:
        return state
    return replace(state, odometry=previous.odometry, sum_of_squares=previous.sum_of_squares, dof=previous.dof)


def predict(state: SubmapState, odometry: Float[np.ndarray, "3"], noise: OdometryNoise) -> SubmapState:
    """Prediction step: move the robot by the odometry since the last scan; without odometry only the covariance grows.

    Args:
        state: after the last scan.
        odometry: pose of the new scan by odometry; NaN where there is none.
        noise: of the odometry.
    """
    measured = bool(np.isfinite(odometry).all())
    step = relative(state.odometry, odometry) if measured and state.odometry is not None else np.full(3, np.nan)
    is_first_scan = state.odometry is None and not state.rows and not len(state.scan_counts)
    variance = np.zeros(3) if is_first_scan else step_variance(noise, step)
    if not measured:
        variance = variance * (1 + state.dead_reckoned)
    belief = state.belief
    pose, covariance = propagate(state.pose, np.asarray(belief.covariance), np.nan_to_num(step), np.diag(variance))
    return replace(
        state,
        belief=kernels.Belief(pose, belief.landmarks, covariance),
        odometry=odometry if measured else None,
        dead_reckoned=0,
    )


def update_pose_only(
    ring: Ring, state: SubmapState, scan: Scan, model: LocalModel, noise: OdometryNoise, *, row: int, **options: Any
) -> SubmapState:
    """Estimate the pose of a scan without odometry between scans with odometry; the belief stays as it was.

    The next odometry step starts at the last scan with odometry. If this scan moved the robot, its motion would count
    twice. Arguments as for ``predict`` and ``update``.
    """
    predicted = predict(state, np.full(3, np.nan), noise)
    updated = update(ring, predicted, scan, model, row=row, add_landmarks=False, **options)
    return replace(
        state,
        rows=updated.rows,
        poses=updated.poses,
        covariances=updated.covariances,
        directions=updated.directions,
        dead_reckoned=state.dead_reckoned + 1,
    )


def update(
    ring: Ring,
    state: SubmapState,
    scan: Scan,
    model: LocalModel,
    *,
    row: int,
    sigma: float | None = None,
    path_pose: Float[np.ndarray, "paths 3"] | None = None,
    add_landmarks: bool = True,
) -> SubmapState:
    """Update step: correct the pose and the landmarks by one scan, and add new landmarks.

    Args:
        ring: the sensors.
        state: after ``predict``.
        scan: its echoes.
        model: the local model of the scan.
        row: row of the scan in the run.
        sigma: standard deviation of the ranges, metres; estimated from all scans if left out.
        path_pose: pose of the robot when each path fired, as ``local_model`` takes it.
        add_landmarks: whether new features become landmarks.
    """
    if sigma is None and not state.dof:
        first = model.sigma if model.sigma > 0 else SETTINGS.default_sigma
        credit = SETTINGS.sigma_prior_echoes
        state = replace(state, sum_of_squares=credit * first**2, dof=credit)
    noise = state.sigma if sigma is None else sigma
    prior, features = state.belief, feature_measurements(model)
    echoes, measured = ScanEchoes.of(ring, scan, path_pose), measured_paths(ring, scan.as_log())[0]
    directions = None if measured.all() else directions_of_paths(ring, measured, path_pose)
    full_wall = float(np.asarray(ring.exact_paths.width).sum() / (2 * np.pi))
    if directions is not None:
        full_wall = float(full_wall_paths(ring, measured[None].astype(np.float64))[0])
    with jax.enable_x64(True):
        # 1. Associate features with landmarks; update the pose with the echoes of these features.
        first_association = associate_features(prior, features, full_wall_echoes=full_wall)
        feature_of_echo = echoes.assign_to_features(features, noise)
        found = echoes.update(prior, _landmark_of_echo(first_association.landmark, feature_of_echo), noise)
        # 2. Associate again from the better pose.
        association = associate_features(without_padding(prior, found.belief), features, full_wall_echoes=full_wall)
        # 3. If the track is lost, this place must not become part of the submap.
        unknown_place = len(features.kind) > 1 and len(state.scan_counts) > 1
        unknown_place = unknown_place and not (first_association.landmark >= 0).any()
        suspect = unknown_place and known_walls_missed(ring, prior, state.scan_counts, scan, path_pose, measured)
        # 4. Add new landmarks.
        new = np.flatnonzero(association.is_new & (add_landmarks and not suspect))
        belief = _with_new_landmarks(prior, features.take(new), np.asarray(found.belief.pose))
        landmark = association.landmark.copy()
        landmark[new] = len(prior.landmarks.kind) + np.arange(len(new))
        # 5. Assign all echoes to landmarks, and update the prior with them.
        by_feature = _landmark_of_echo(landmark, feature_of_echo)
        assigned = echoes.assign_to_landmarks(found.belief, by_feature, noise)
        found = echoes.update(belief, assigned, noise)
    belief = without_padding(belief, found.belief)
    # 6. Extend the observed parts of walls, count observations, and estimate the noise of the ranges.
    used = np.asarray(found.used)[: echoes.count] > 0
    observed = np.bincount(assigned[used], minlength=len(belief.landmarks.kind)) > 0
    belief = _with_extended_walls(belief, features, landmark)
    residual = np.asarray(found.residual)[: echoes.count][used]
    squares = float(residual @ residual)
    return replace(
        state,
        belief=belief,
        scan_counts=np.append(state.scan_counts, np.zeros(len(new), np.int64)) + observed,
        rows=(*state.rows, row),
        poses=(*state.poses, belief.pose),
        covariances=(*state.covariances, belief.covariance[:3, :3]),
        directions=(*state.directions, directions),
        sum_of_squares=state.sum_of_squares + squares,
        dof=state.dof + len(residual) * SETTINGS.dof_per_echo,
        track_loss_count=state.track_loss_count + 1 if suspect else 0,
        explained=len(residual),
        normalized_squares=squares / noise**2,
    )


def finish_submap(state: SubmapState) -> Submap:
    """The submap that ends here, without the landmarks that too few scans observed.

    If the track is lost, the covariance of the last pose is increased.
    """
    least = min(SETTINGS.min_scans, max(1, len(state.rows) - 1))
    kept = np.flatnonzero(state.scan_counts >= least)
    unknowns = np.concatenate([np.arange(3), (3 + 2 * kept[:, None] + [0, 1]).ravel()]).astype(np.int64)
    covariance = state.belief.covariance[np.ix_(unknowns, unknowns)]
    if state.track_lost:
        covariance[:3, :3] += diagonal_covariance(SETTINGS.track_loss_sd)
    return Submap(
        landmarks=state.belief.landmarks.take(kept),
        scan_counts=state.scan_counts[kept],
        exit_pose=state.pose,
        covariance=np.asarray(covariance),
        rows=np.array(state.rows, dtype=np.int64),
        poses=np.array(state.poses).reshape(-1, 3),
        pose_covariances=np.array(state.covariances).reshape(-1, 3, 3),
        directions=stacked_directions(state.directions),
    )


def _with_new_landmarks(
    belief: kernels.Belief, features: FeatureMeasurements, pose: Float[np.ndarray, "3"]
) -> kernels.Belief:
    """The belief with new landmarks at features observed from a pose; their covariances are wide and independent."""
    count, size = len(features.kind), len(belief.covariance)
    if not count:
        return belief
    covariance = np.zeros((size + 2 * count,) * 2)
    covariance[:size, :size] = belief.covariance
    sd = np.array(SETTINGS.new_landmark_sd)
    sd = np.where((features.kind == kernels.PLANE)[:, None], sd, sd[0]).ravel()
    covariance[np.arange(size, size + 2 * count), np.arange(size, size + 2 * count)] = sd**2
    new = transform_landmarks(pose, features.landmarks)
    return kernels.Belief(belief.pose, concatenate_landmarks([belief.landmarks, new]), covariance)


def _with_extended_walls(
    belief: kernels.Belief, features: FeatureMeasurements, landmark: Int[np.ndarray, " features"]
) -> kernels.Belief:
    """The belief with walls that extend as far as they were observed."""
    landmarks = belief.landmarks
    extent = np.array(landmarks.extent)
    for feature in np.flatnonzero((landmark >= 0) & (features.kind == kernels.PLANE)):
        wall = landmark[feature]
        segment = transform_points(np.asarray(belief.pose), features.segment[feature])
        along = (segment - landmarks.anchor[wall]) @ tangent_of(np.asarray(landmarks.parameters)[wall, 1])
        extent[wall] = min(extent[wall, 0], along.min()), max(extent[wall, 1], along.max())
    return replace(belief, landmarks=replace(landmarks, extent=extent))


def _landmark_of_echo(
    landmark: Int[np.ndarray, " features"], feature: Int[np.ndarray, " echoes"]
) -> Int[np.ndarray, " echoes"]:
    """Landmark of each echo's feature; -1 for none."""
    return np.append(landmark, -1)[feature]
