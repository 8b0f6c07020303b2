"""A known map as landmarks with covariances: for the EKF update around a pose, and as features for pose hypotheses."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar import kernels
from jaxsonar.estimation.landmark_map import LANDMARK_KINDS, map_landmarks
from jaxsonar.geometry.landmarks import concatenate_landmarks, landmarks_from_points, pad_landmarks, wall_segments
from jaxsonar.geometry.se2 import tangent_of, unit, wrap_angle
from jaxsonar.geometry.segments import perpendicular_intersections, point_to_segments
from jaxsonar.kernels.shape_buckets import next_power_of_two, pad_rows
from jaxsonar.localization.scan_update import MapArrays
from jaxsonar.localization.settings import SETTINGS, MapTrust
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.registration.features import Features, landmark_features


@dataclass(frozen=True, eq=False)
class KnownMap:
    """Landmarks of a known map. A wall may be seen from both of its sides."""

    landmarks: kernels.Landmarks
    """Walls are anchored in their middle."""
    covariance: Float[np.ndarray, "landmarks 2 2"]
    """Of the parameters of each landmark."""
    opening: Float[np.ndarray, "landmarks 2 2"]
    """Directions of the two walls of a corner that was added where walls meet; 0 for all other landmarks."""

    @classmethod
    def of(cls, world: GlobalMap, map_sd: tuple[float, float] | None = None) -> "KnownMap":
        """Landmarks of a map; a map without corners and edges gets corners where its walls meet, a plan also edges.

        The uncertainty of the radius of a circle counts as one of its position.

        Args:
            world: the map.
            map_sd: least standard deviations of its walls: across (m), direction (rad); None: those of a floor plan if
                it is one, else those of the map.
        """
        world = world.with_kinds(*LANDMARK_KINDS)
        is_plan = is_floor_plan(world)
        if map_sd is None:
            map_sd = SETTINGS.plan_sd if is_plan else SETTINGS.min_map_sd
        wall_covariance = _wall_covariances(world, map_sd)
        default = np.eye(2) * SETTINGS.default_map_sd[0] ** 2
        point_covariance = np.where(np.isfinite(world.point_cov), world.point_cov, default)
        point_covariance += np.nan_to_num(world.point_circle_cov[:, 2, 2])[:, None, None] * np.eye(2)
        if is_plan:  # poles and columns are drawn as well as walls
            point_covariance += np.eye(2) * map_sd[0] ** 2
        landmarks = map_landmarks(world)
        opening = np.zeros((len(landmarks.kind), 2, 2))
        if is_plan or not {"corner", "edge"} & set(world.point_kinds):
            corners, corner_covariance, directions = _wall_corners(world, wall_covariance)
            point_covariance = np.concatenate([point_covariance, corner_covariance])
            kind = np.full(len(corners), kernels.CORNER)
            landmarks = concatenate_landmarks([landmarks, landmarks_from_points(kind, corners)])
            opening = np.concatenate([opening, directions])
        if is_plan:
            ends = _free_ends(world)
            landmarks = concatenate_landmarks(
                [landmarks, landmarks_from_points(np.full(len(ends), kernels.EDGE), ends)]
            )
            opening = np.concatenate([opening, np.zeros((len(ends), 2, 2))])
            end_covariance = np.tile(np.eye(2) * map_sd[0] ** 2, (len(ends), 1, 1))
            point_covariance = np.concatenate([point_covariance, end_covariance])
        return cls(landmarks, np.concatenate([wall_covariance, point_covariance]), opening)

    @property
    def is_wall(self) -> Bool[np.ndarray, " landmarks"]:
        """Which landmarks are walls."""
        return np.asarray(self.landmarks.kind) == kernels.PLANE

    @cached_property
    def arrays(self) -> MapArrays:
        """The map for ``update_hypotheses``, padded so that maps of similar sizes share one compiled program."""
        size = next_power_of_two(len(self.covariance), least=SETTINGS.min_landmarks)
        covariance = np.tile(np.eye(2), (size, 1, 1))
        covariance[: len(self.covariance)] = self.covariance
        landmarks = pad_landmarks(self.landmarks, size)
        return MapArrays(landmarks, covariance, pad_rows(self.opening, size))

    @cached_property
    def segments(self) -> Float[np.ndarray, "walls 2 2"]:
        """Endpoints of the walls, metres."""
        return wall_segments(self.landmarks.take(np.flatnonzero(self.is_wall)))

    @cached_property
    def bounds(self) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
        """Lowest and highest coordinates of the map, metres."""
        points = (self.landmarks.anchor + self.landmarks.parameters)[~self.is_wall]
        ends = np.concatenate([self.segments.reshape(-1, 2), points])
        return ends.min(axis=0), ends.max(axis=0)

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

    def seen_features(self, evidence: Float[np.ndarray, " rows"], positions: Float[np.ndarray, "scans 2"]) -> Features:
        """The walls and points with the most evidence, each wall from the side from which it was seen.

        Args:
            evidence: of each landmark, in the rows of ``arrays``.
            positions: of the robot.
        """
        evidence = evidence[: len(self.covariance)]
        order = np.argsort(-evidence, kind="stable")
        walls = [row for row in order if self.is_wall[row] and evidence[row] > 0][: SETTINGS.seen_walls]
        points = [row for row in order if not self.is_wall[row] and evidence[row] > 0][: SETTINGS.seen_points]
        rows = np.array([*walls, *points], dtype=np.int64)
        scans = np.full(len(rows), SETTINGS.wall_scans)
        seen = landmark_features(self.landmarks.take(rows), self.covariance[rows], scans)
        # Normals point away from the robot where it was nearest to the wall.
        offset = positions[:, None] - seen.reference
        nearest = offset[np.linalg.norm(offset, axis=-1).argmin(axis=0), np.arange(len(walls))]
        is_behind = (nearest * seen.normal).sum(-1) > seen.offset
        return seen._replace(
            theta=np.where(is_behind, wrap_angle(seen.theta + np.pi), seen.theta),
            offset=np.where(is_behind, -seen.offset, seen.offset),
            extent=np.where(is_behind[:, None], -seen.extent[:, ::-1], seen.extent),
        )


def _free_ends(world: GlobalMap) -> Float[np.ndarray, "ends 2"]:
    """Ends of walls that touch no other wall, such as those beside the gap of a door: they diffract sound."""
    ends = world.segments.reshape(-1, 2)
    distance = point_to_segments(ends, world.segments)
    distance[np.arange(len(ends)), np.arange(len(ends)) // 2] = np.inf
    return ends[distance.min(axis=1, initial=np.inf) > SETTINGS.corner_gap]


def is_floor_plan(world: GlobalMap) -> bool:
    """Whether a map is a drawing: its walls and points count as exact (``map_from_room``)."""
    sd = np.concatenate([world.sigma_rho, np.sqrt(world.point_cov[:, 0, 0])])
    return bool((sd < SETTINGS.exact_sd).all())


def trust_in(world: GlobalMap) -> MapTrust:
    """How far a map is trusted: as a floor plan, as a map of another sensor (no scan observed it), or of echoes."""
    if is_floor_plan(world):
        return SETTINGS.plan_trust
    observed = any(len(scans) > 0 for scans in (*world.scans, *world.point_scans))
    return SETTINGS.map_trust if observed else SETTINGS.laser_trust


def _wall_covariances(world: GlobalMap, least: tuple[float, float]) -> Float[np.ndarray, "walls 2 2"]:
    """Covariances of (distance at the middle, theta): that distance is better known than that from the origin."""
    arm = (world.segments.mean(axis=1) * tangent_of(world.theta)).sum(axis=-1)
    (default_across, default_turn), (min_across, min_turn) = SETTINGS.default_map_sd, least
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
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2 2"], Float[np.ndarray, "points 2 2"]]:
    """Points where walls meet at right angles, their covariances, and the directions of their walls."""
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
    pairs = np.stack([crossing.first[meet], crossing.second[meet]], axis=-1)
    away = middle[pairs] - crossing.point[meet][:, None]
    directions = away / np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-12)
    return crossing.point[meet], np.array(covariances).reshape(-1, 2, 2), directions
