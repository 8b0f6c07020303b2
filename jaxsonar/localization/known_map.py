"""A known map as landmarks with covariances: for the EKF update around a pose, and as features for pose hypotheses."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar import kernels
from jaxsonar.estimation.landmark_map import map_landmarks
from jaxsonar.geometry.landmarks import concatenate_landmarks, landmarks_from_points
from jaxsonar.geometry.se2 import tangent_of, unit, wrap_angle
from jaxsonar.geometry.segments import perpendicular_intersections
from jaxsonar.localization.settings import SETTINGS
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.registration.features import Features, landmark_features


@dataclass(frozen=True, eq=False)
class KnownMap:
    """Landmarks of a known map. A wall may be seen from both of its sides."""

    landmarks: kernels.Landmarks
    """Walls are anchored in their middle."""
    covariance: Float[np.ndarray, "landmarks 2 2"]
    """Of the parameters of each landmark."""

    @classmethod
    def of(cls, world: GlobalMap) -> "KnownMap":
        """Landmarks of a map; a map without points, such as a floor plan, gets corners where its walls meet."""
        wall_covariance = _wall_covariances(world)
        default = np.eye(2) * SETTINGS.default_map_sd[0] ** 2
        point_covariance = np.where(np.isfinite(world.point_cov), world.point_cov, default)
        landmarks = map_landmarks(world)
        if not world.point_kinds:
            corners, point_covariance = _wall_corners(world, wall_covariance)
            kind = np.full(len(corners), kernels.CORNER)
            landmarks = concatenate_landmarks([landmarks, landmarks_from_points(kind, corners)])
        return cls(landmarks, np.concatenate([wall_covariance, point_covariance]))

    @property
    def is_wall(self) -> Bool[np.ndarray, " landmarks"]:
        """Which landmarks are walls."""
        return np.asarray(self.landmarks.kind) == kernels.PLANE

    def belief_at(
        self, pose: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "3 3"], max_range: float
    ) -> kernels.Belief:
        """Joint belief of a pose and the landmarks that may be detected from it; normals point away from the robot.

        Args:
            pose: world_from_robot, metres and radians.
            covariance: its covariance.
            max_range: range of the sensors, metres.
        """
        anchor, theta = np.asarray(self.landmarks.anchor), np.asarray(self.landmarks.parameters)[:, 1]
        half, wall = np.asarray(self.landmarks.extent)[:, 1], self.is_wall
        offset = anchor - pose[:2]
        along, across = (offset * tangent_of(theta)).sum(axis=-1), (offset * unit(theta)).sum(axis=-1)
        beyond = np.maximum(np.abs(along) - half, 0.0)
        distance = np.where(wall, np.hypot(across, beyond), np.linalg.norm(offset, axis=-1))
        uncertainty = 3 * np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])
        in_reach = distance < max_range + uncertainty
        rows = np.flatnonzero(in_reach & (~wall | (beyond < SETTINGS.wall_extension + uncertainty)))
        rows = rows[np.argsort(distance[rows], kind="stable")][: SETTINGS.max_landmarks]
        joint = np.zeros((3 + 2 * len(rows), 3 + 2 * len(rows)))
        joint[:3, :3] = covariance
        for k, row in enumerate(rows):
            joint[3 + 2 * k : 5 + 2 * k, 3 + 2 * k : 5 + 2 * k] = self.covariance[row]
        # The other side of a wall: the normal and the distance along it are reversed.
        parameters = np.asarray(self.landmarks.parameters)[rows]
        reversed_ = np.stack([-parameters[:, 0], wrap_angle(parameters[:, 1] + np.pi)], axis=-1)
        parameters = np.where((wall & (across < 0))[rows, None], reversed_, parameters)
        return kernels.Belief(pose, self.landmarks.take(rows).with_parameters(parameters), joint)

    @cached_property
    def features(self) -> Features:
        """Walls, each from both of its sides, and points."""
        scans = np.full(len(self.covariance), SETTINGS.wall_scans)
        one = landmark_features(self.landmarks, self.covariance, scans)
        return one._replace(
            reference=np.tile(one.reference, (2, 1)),
            theta=np.concatenate([one.theta, wrap_angle(one.theta + np.pi)]),
            offset=np.concatenate([one.offset, -one.offset]),
            covariance=np.tile(one.covariance, (2, 1, 1)),
            extent=np.concatenate([one.extent, -one.extent[:, ::-1]]),
            weight=np.tile(one.weight, 2),
            scans=np.tile(one.scans, 2),
        )


def _wall_covariances(world: GlobalMap) -> Float[np.ndarray, "walls 2 2"]:
    """Covariances of (distance at the middle, theta): that distance is better known than that from the origin."""
    arm = (world.segments.mean(axis=1) * tangent_of(world.theta)).sum(axis=-1)
    (default_across, default_turn), (min_across, min_turn) = SETTINGS.default_map_sd, SETTINGS.min_map_sd
    turn = np.where(np.isfinite(world.sigma_theta), world.sigma_theta, default_turn)
    across = np.where(np.isfinite(world.sigma_rho), world.sigma_rho**2 - (arm * turn) ** 2, default_across**2)
    # Echoes along the wall determine both: a smaller difference is a rounding error.
    across = np.maximum(across, (world.length / 2 * turn) ** 2 / 12)
    covariance = np.zeros((len(world), 2, 2))
    covariance[:, 0, 0] = np.maximum(across, min_across**2)
    covariance[:, 1, 1] = np.maximum(turn, min_turn) ** 2
    return covariance


def _wall_corners(
    world: GlobalMap, wall_covariance: Float[np.ndarray, "walls 2 2"]
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2 2"]]:
    """Points where walls meet at right angles, and their covariances."""
    crossing = perpendicular_intersections(world.theta, world.segments, max_skew=SETTINGS.corner_angle)
    middle, covariances = world.segments.mean(axis=1), []
    # At a right angle the distance between the ends is the hypotenuse of their distances from the intersection.
    meet = np.flatnonzero(np.hypot(*crossing.gap.T) < SETTINGS.corner_gap)
    for row in meet:
        pair = np.array([crossing.first[row], crossing.second[row]])
        along = ((crossing.point[row] - middle[pair]) * tangent_of(world.theta[pair])).sum(-1)
        across = wall_covariance[pair, 0, 0] + along**2 * wall_covariance[pair, 1, 1]
        inverse = np.linalg.inv(unit(world.theta[pair]))
        covariances.append(inverse @ np.diag(across) @ inverse.T)
    return crossing.point[meet], np.array(covariances).reshape(-1, 2, 2)
