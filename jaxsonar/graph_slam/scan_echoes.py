"""The echoes of one scan in the front end: assignment to features and to landmarks, and the update of the belief."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.estimation.robust_adjustment import SETTINGS as GNC_SETTINGS
from jaxsonar.geometry.landmarks import pad_landmarks
from jaxsonar.graph_slam.feature_association import FeatureMeasurements
from jaxsonar.kernels.shape_buckets import next_power_of_two, pad_rows
from jaxsonar.scans.flat_echoes import corrected_echoes
from jaxsonar.scans.scan_log import Scan
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class EchoAssignmentSettings:
    """Constants of the assignment of echoes; chosen by hand unless stated otherwise."""

    gate: float = GNC_SETTINGS.gate_sigmas
    """Standard deviations of a range within which an echo may come from a landmark or feature."""
    ambiguity: float = GNC_SETTINGS.ambiguity_sigmas
    """Standard deviations; an echo is ambiguous if a second landmark's range is as close as this to the first's."""
    max_prediction_sd: float = 2.0
    """Standard deviations of a range; an echo without a feature is assigned to a landmark only if the belief predicts
    its range at least this well. A worse prediction fits by chance."""
    min_features: int = 16
    """Smallest padded number of features; powers of two from there on are compiled."""
    min_landmarks: int = 32
    """The same for landmarks."""
    min_echoes: int = 64
    """The same for echoes."""
    wall_echo_tolerance: float = 0.1
    """Track loss: metres between the expected and the first measured range of a wall."""
    min_facing_sensors: int = 6
    """Track loss: least number of sensors that face known walls."""
    min_wall_scans: int = 2
    """Track loss: least number of scans that observed a wall."""
    reliable_range_fraction: float = 0.85
    """Fraction of the maximum range up to which walls are reliably detected; for track loss and loop closure."""


SETTINGS = EchoAssignmentSettings()


@dataclass(frozen=True, eq=False)
class ScanEchoes:
    """The echoes of one scan, padded, with the geometry of their paths."""

    paths: kernels.EchoPaths
    """(echoes,) in the robot frame of the scan's pose."""
    ranges: Float[np.ndarray, " echoes"]
    """Corrected ranges, metres; 0 for padding."""
    count: int
    """Number of echoes without padding."""

    @classmethod
    def of(cls, ring: Ring, scan: Scan, path_pose: Float[np.ndarray, "paths 3"] | None) -> "ScanEchoes":
        """Gather the echoes of a scan.

        Args:
            ring: the sensors.
            scan: its echoes.
            path_pose: pose of the robot when each path fired, relative to the scan's pose; None for a robot at rest.
        """
        path, ranges = corrected_echoes(ring, scan)
        size = next_power_of_two(len(path), least=SETTINGS.min_echoes)
        padded = pad_rows(path, size)
        paths = jax.tree.map(lambda leaf: leaf[padded], ring.exact_paths)
        if path_pose is not None:
            paths = _transform_paths(paths, pad_rows(path_pose[path], size))
        return cls(paths, pad_rows(ranges, size), len(path))

    def assign_to_features(self, features: FeatureMeasurements, sigma: float) -> Int[np.ndarray, " count"]:
        """Feature of this scan whose expected range is nearest to each echo; -1 if none is within the gate."""
        count = len(features.kind)
        if not count or not self.count:
            return np.full(self.count, -1)
        landmarks = pad_landmarks(features.landmarks, next_power_of_two(count, least=SETTINGS.min_features))
        expected = np.asarray(kernels.expected_ranges(np.zeros(3), landmarks, self.paths))[:count, : self.count]
        distance = np.abs(expected - self.ranges[: self.count])
        return np.where(distance.min(axis=0) < SETTINGS.gate * sigma, distance.argmin(axis=0), -1)

    def update(self, belief: kernels.Belief, landmark: np.ndarray, sigma: float) -> kernels.EkfUpdate:
        """Update a belief with the echoes that are assigned to landmarks (-1: none); the result is padded."""
        size = next_power_of_two(len(belief.landmarks.kind), least=SETTINGS.min_landmarks)
        used = len(belief.covariance)
        covariance = np.zeros((3 + 2 * size, 3 + 2 * size))
        covariance[:used, :used] = belief.covariance
        padded = kernels.Belief(belief.pose, pad_landmarks(belief.landmarks, size), covariance)
        rows = pad_rows(landmark.astype(np.int32), len(self.ranges), fill=-1)
        return kernels.ekf_update(padded, self.paths, self.ranges, rows, np.float64(sigma**2))

    def assign_to_landmarks(
        self, belief: kernels.Belief, by_feature: np.ndarray, sigma: float
    ) -> Int[np.ndarray, " count"]:
        """Landmark of every echo.

        An echo is assigned to the landmark of the nearest expected range. It is left out if a second landmark predicts
        nearly the same range. If no landmark with a good prediction is near, the assignment by features is kept.

        Args:
            belief: padded, updated by the echoes of the features.
            by_feature: landmark of each echo by the feature that explains it; -1 for none.
            sigma: standard deviation of the ranges, metres.
        """
        predicted = kernels.expected_ranges_with_variance(belief, self.paths)
        expected, variance = (np.asarray(part)[:, : self.count] for part in (predicted.expected, predicted.variance))
        well_predicted = np.where(variance < (SETTINGS.max_prediction_sd * sigma) ** 2, expected, np.inf)
        distance = np.abs(well_predicted - self.ranges[: self.count])
        best = distance.argmin(axis=0)
        is_near = distance.min(axis=0, initial=np.inf) < SETTINGS.gate * sigma
        nearest = np.where(is_near, np.take_along_axis(expected, best[None], axis=0)[0], 0.0)
        gap = np.abs(expected - nearest)
        gap[best, np.arange(self.count)] = np.inf
        is_unique = is_near & (gap.min(axis=0, initial=np.inf) > SETTINGS.ambiguity * sigma)
        return np.where(is_unique, best, np.where(is_near, -1, by_feature))


def without_padding(prior: kernels.Belief, padded: kernels.Belief) -> kernels.Belief:
    """An updated belief as NumPy arrays with the rows of its prior."""
    count, size = len(prior.landmarks.kind), len(prior.covariance)
    parameters = np.asarray(padded.landmarks.parameters)[:count]
    return kernels.Belief(
        pose=np.asarray(padded.pose),
        landmarks=replace(prior.landmarks, parameters=parameters),
        covariance=np.asarray(padded.covariance)[:size, :size],
    )


def known_walls_missed(
    ring: Ring,
    belief: kernels.Belief,
    scan_counts: Int[np.ndarray, " landmarks"],
    scan: Scan,
    path_pose: Float[np.ndarray, "paths 3"] | None,
    measured: Bool[np.ndarray, " paths"],
) -> bool:
    """Whether most of the sensors that face known walls receive no echo of them: the robot was moved by hand.

    That no feature of a scan is known proves nothing: around a corner everything is new, but few sensors face known
    walls there.

    Args:
        ring: the sensors.
        belief: after the prediction step.
        scan_counts: number of scans that observed each landmark.
        scan: its echoes.
        path_pose: as for ``ScanEchoes.of``.
        measured: paths that the scan measured; the others are neither detections nor missed ones.
    """
    direct = np.flatnonzero((ring.paths[:, 0] == ring.paths[:, 1]) & measured)
    paths = jax.tree.map(lambda leaf: leaf[direct], ring.exact_paths)
    if path_pose is not None:
        paths = _transform_paths(paths, path_pose[direct])
    # First range of every direct path.
    nearest = np.full(len(ring.paths), np.inf)
    path = ring.path_index[scan.tx, scan.rx]
    ranges = np.asarray(ring.corrected(scan.range, scan.tx, scan.rx), dtype=np.float64)
    np.minimum.at(nearest, path[path >= 0], np.where(ranges > 0, ranges, np.inf)[path >= 0])
    # Expected range of the nearest known wall.
    landmarks = belief.landmarks
    count = len(landmarks.kind)
    padded = pad_landmarks(landmarks, next_power_of_two(count, least=SETTINGS.min_landmarks))
    expected = np.asarray(kernels.expected_ranges(belief.pose, padded, paths))[:count]
    reliable = (landmarks.kind == kernels.PLANE) & (scan_counts >= SETTINGS.min_wall_scans)
    expected = np.where(reliable[:, None], expected, np.inf).min(axis=0)
    facing = expected < SETTINGS.reliable_range_fraction * float(ring.max_range)
    detected = np.abs(nearest[direct][facing] - expected[facing]) < SETTINGS.wall_echo_tolerance
    return int(facing.sum()) >= SETTINGS.min_facing_sensors and int((~detected).sum()) > int(detected.sum())


def _transform_paths(paths: kernels.EchoPaths, poses: Float[np.ndarray, "paths 3"]) -> kernels.EchoPaths:
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, jax.vmap(kernels.transform_path)(paths, jnp.asarray(poses)))
