"""Data association of one scan's features with the landmarks of a submap.

Candidates are mutual nearest neighbors in Mahalanobis distance; those that are jointly compatible are accepted
(``estimation.joint_compatibility``).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.detection.local_model import LocalModel, Point
from jaxsonar.estimation.joint_compatibility import (
    chi2_bound,
    jointly_compatible_pairs,
    mutual_nearest_neighbors,
)
from jaxsonar.estimation.landmark_map import LANDMARK_KINDS
from jaxsonar.geometry.landmarks import (
    concatenate_landmarks,
    landmarks_from_points,
    landmarks_from_segments,
    landmarks_in_robot_frame,
)
from jaxsonar.geometry.se2 import tangent_of, transform_points, wrap_angle


@dataclass(frozen=True)
class AssociationSettings:
    """Constants of the association of features with landmarks; chosen by hand unless stated otherwise."""

    default_line_sd: tuple[float, float] = (0.01, float(np.radians(3.0)))
    """Standard deviations of (rho, theta) of lines without a covariance (method hough), metres and radians."""
    covariance_factor: float = 1.5
    """Inflation of the covariances of features; those of local models are lower bounds."""
    rejection_probability: float = 0.001
    """Probability with which the chi-square gate rejects a correct pair, or a correct set of pairs."""
    max_pairs: int = 40
    """Largest number of pairs of one scan."""
    wall_gap: float = 0.3
    """Metres that a feature may lie beyond the observed endpoints of its wall."""
    duplicate_distance: float = 0.02
    """Metres; a feature nearer than this to a landmark is not new."""
    duplicate_angle: float = float(np.radians(5.0))
    """Radians; the same for the directions of walls."""
    new_wall_echoes: float = 0.4
    """Least number of echoes of a new wall, as a fraction of the echoes of a long wall. A wall with fewer echoes may be
    mistaken for its edge, and a wrong wall rotates the robot."""
    new_point_echoes: int = 6
    """Least number of echoes of a new point."""
    max_radius_sd: float = 0.01
    """Circles whose radius one scan determines worse are no landmarks, metres. The radius of a landmark is constant:
    after a quarter of the way around a circle, the whole error of its radius is an error of ranges."""


SETTINGS = AssociationSettings()


class FeatureMeasurements(NamedTuple):
    """Walls, then corners, edges and circles, of one scan as measurements, robot frame."""

    kind: Int[np.ndarray, " features"]
    """``kernels.PLANE``, ``CORNER``, ``EDGE`` or ``CIRCLE``."""
    parameters: Float[np.ndarray, "features 2"]
    """(rho, theta) of walls, (x, y) of points, metres and radians."""
    covariance: Float[np.ndarray, "features 2 2"]
    """Of ``parameters``."""
    segment: Float[np.ndarray, "features 2 2"]
    """Endpoints of the observed part of a wall; the position of a point, twice. Metres."""
    echoes: Int[np.ndarray, " features"]
    """Number of echoes that each explains."""
    radius: Float[np.ndarray, " features"]
    """Radii of circles, metres; 0 for all other kinds."""

    def take(self, rows: np.ndarray) -> "FeatureMeasurements":
        """Select some of the features."""
        return FeatureMeasurements(*(column[rows] for column in self))

    @property
    def landmarks(self) -> kernels.Landmarks:
        """The features as landmarks of the robot frame; walls are anchored in their middle."""
        wall = self.kind == kernels.PLANE
        walls = landmarks_from_segments(self.parameters[wall, 0], self.parameters[wall, 1], self.segment[wall])
        points = landmarks_from_points(self.kind[~wall], self.parameters[~wall], self.radius[~wall])
        return concatenate_landmarks([walls, points])


def feature_measurements(model: LocalModel) -> FeatureMeasurements:
    """The lines and points of a local model as measurements."""
    lines = model.lines
    points = [one for one in model.points if one.kind != "circle" or one.cov[2, 2] < SETTINGS.max_radius_sd**2]
    default = np.diag(np.square(SETTINGS.default_line_sd))
    kind = [kernels.PLANE] * len(lines)
    kind += [LANDMARK_KINDS[point.kind] for point in points]
    parameters = [(line.rho, line.theta) for line in lines] + [(point.x, point.y) for point in points]
    cov = [default if line.cov is None else line.cov for line in lines] + [point.cov[:2, :2] for point in points]
    segment = [line.segment for line in lines] + [((point.x, point.y),) * 2 for point in points]
    return FeatureMeasurements(
        kind=np.array(kind, dtype=np.int32),
        parameters=np.array(parameters, dtype=np.float64).reshape(-1, 2),
        covariance=np.array(cov, dtype=np.float64).reshape(-1, 2, 2),
        segment=np.array(segment, dtype=np.float64).reshape(-1, 2, 2),
        echoes=np.array([feature.echoes for feature in (*lines, *points)], dtype=np.int64),
        radius=np.array([0.0] * len(lines) + [_radius(point) for point in points], dtype=np.float64),
    )


def _radius(point: Point) -> float:
    """Radius of a circle, metres; 0 for other points."""
    return point.radius if point.kind == "circle" else 0.0


class FeatureAssociation(NamedTuple):
    """The landmark of each feature of a scan."""

    landmark: Int[np.ndarray, " features"]
    """Row of the landmark; -1 for none."""
    is_new: Bool[np.ndarray, " features"]
    """Whether the feature is no known landmark, is far enough from all of them, and has enough echoes."""


def associate_features(
    belief: kernels.Belief, features: FeatureMeasurements, *, full_wall_echoes: float
) -> FeatureAssociation:
    """Associate the features of a scan with landmarks: individually and jointly compatible pairs.

    Args:
        belief: prior of the pose and the landmarks.
        features: of the scan.
        full_wall_echoes: number of echoes that a long wall causes with this ring.
    """
    landmarks, count = belief.landmarks, len(features.kind)
    unassociated = np.full(count, -1)
    least = np.where(
        features.kind == kernels.PLANE, SETTINGS.new_wall_echoes * full_wall_echoes, SETTINGS.new_point_echoes
    )
    enough_echoes = features.echoes >= least
    if not len(landmarks.kind) or not count:
        return FeatureAssociation(unassociated, enough_echoes)
    # Squared Mahalanobis distance of every feature from every landmark.
    expected, jacobian = landmarks_in_robot_frame(np.asarray(belief.pose), landmarks)
    expected_cov = jacobian @ _own_covariances(belief) @ jacobian.transpose(0, 2, 1)
    innovation = _innovations(features, expected)
    innovation_cov = expected_cov[None] + SETTINGS.covariance_factor * features.covariance[:, None]
    squared = np.einsum("fli,flij,flj->fl", innovation, np.linalg.inv(innovation_cov), innovation)
    # Candidates: same kind, on the observed part, on the observed side of the wall, within the gate.
    beside = _lies_along(belief, features)
    comparable = (features.kind[:, None] == landmarks.kind) & beside
    comparable &= (expected[:, 0] > 0) | (landmarks.kind != kernels.PLANE)
    within_gate = comparable & (squared < chi2_bound(2, SETTINGS.rejection_probability))
    # Mutual nearest neighbors, the best first.
    feature, landmark = mutual_nearest_neighbors(np.where(within_gate, squared, np.inf))
    order = np.argsort(squared[feature, landmark], kind="stable")[: SETTINGS.max_pairs]
    feature, landmark = feature[order], landmark[order]
    # Joint compatibility.
    joint = _joint_innovation_covariance(belief, features, jacobian, feature, landmark)
    accepted = jointly_compatible_pairs(innovation[feature, landmark], joint, SETTINGS.rejection_probability)
    associated = unassociated.copy()
    associated[feature[accepted]] = landmark[accepted]
    # A feature near a landmark is not new, although it is not associated with it.
    both_points = (features.kind != kernels.PLANE)[:, None] & (landmarks.kind != kernels.PLANE)
    is_near = within_gate | (_is_duplicate(innovation, landmarks) & beside & (comparable | both_points))
    return FeatureAssociation(associated, enough_echoes & (associated < 0) & ~is_near.any(axis=1))


def _own_covariances(belief: kernels.Belief) -> Float[np.ndarray, "landmarks 5 5"]:
    """Joint covariance of the pose (3) and the parameters (2) of each landmark."""
    count = len(belief.landmarks.kind)
    own = 3 + 2 * np.arange(count)[:, None] + [0, 1]
    column = np.concatenate([np.tile(np.arange(3), (count, 1)), own], axis=1)
    return np.asarray(belief.covariance)[column[:, :, None], column[:, None, :]]


def _joint_innovation_covariance(
    belief: kernels.Belief,
    features: FeatureMeasurements,
    jacobian: Float[np.ndarray, "landmarks 2 5"],
    feature: Int[np.ndarray, " pairs"],
    landmark: Int[np.ndarray, " pairs"],
) -> Float[np.ndarray, "rows rows"]:
    """Joint covariance of the innovations of pairs, two rows for each."""
    pairs = len(feature)
    design = np.zeros((pairs, 2, len(belief.covariance)))
    design[:, :, :3] = jacobian[landmark, :, :3]
    for k in (0, 1):
        design[np.arange(pairs), :, 3 + 2 * landmark + k] = jacobian[landmark, :, 3 + k]
    design = design.reshape(2 * pairs, len(belief.covariance))
    joint = design @ belief.covariance @ design.T
    for k in range(pairs):
        joint[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += SETTINGS.covariance_factor * features.covariance[feature[k]]
    return joint


def _innovations(
    features: FeatureMeasurements, expected: Float[np.ndarray, "landmarks 2"]
) -> Float[np.ndarray, "features landmarks 2"]:
    """Measured minus expected parameters."""
    difference = features.parameters[:, None] - expected
    walls = features.kind == kernels.PLANE
    difference[walls, :, 1] = wrap_angle(difference[walls, :, 1])
    return difference


def _lies_along(belief: kernels.Belief, features: FeatureMeasurements) -> Bool[np.ndarray, "features landmarks"]:
    """Whether the middle of a feature lies beside the observed part of a wall; true for points."""
    landmarks = belief.landmarks
    middle = transform_points(np.asarray(belief.pose), features.segment.mean(axis=1))
    along = np.einsum(
        "flk,lk->fl", middle[:, None] - landmarks.anchor, tangent_of(np.asarray(landmarks.parameters)[:, 1])
    )
    gap = SETTINGS.wall_gap
    beside = (along > landmarks.extent[:, 0] - gap) & (along < landmarks.extent[:, 1] + gap)
    return beside | (landmarks.kind != kernels.PLANE)


def _is_duplicate(
    innovation: Float[np.ndarray, "features landmarks 2"], landmarks: kernels.Landmarks
) -> Bool[np.ndarray, "features landmarks"]:
    """Whether a feature could be a poor measurement of a landmark."""
    distance, angle = SETTINGS.duplicate_distance, SETTINGS.duplicate_angle
    walls = (np.abs(innovation[..., 0]) < distance) & (np.abs(innovation[..., 1]) < angle)
    points = np.linalg.norm(innovation, axis=-1) < distance
    return np.where((landmarks.kind == kernels.PLANE)[None], walls, points)
