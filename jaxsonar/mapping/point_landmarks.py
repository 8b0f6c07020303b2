"""Corners and edges in the world frame: their information, fusion and clustering."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jaxsonar.detection.local_model import LocalModel
from jaxsonar.geometry.se2 import perpendicular, tangent_of, transform_points, unit
from jaxsonar.mapping.observations import Observations, unique_pairs
from jaxsonar.mapping.segment_fusion import mutual_best
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.mapping.wall_segments import observation_times


@dataclass(frozen=True, eq=False)
class PointLandmarks(Observations):
    """Corners and edges, world frame, one per row. Corners are right-angled; thin poles count as edges."""

    position: Float[np.ndarray, "points 2"]
    """Position, metres."""
    information: Float[np.ndarray, "points 2 2"]
    """Inverse covariance of ``position``, 1 / m^2; much smaller across the line of sight than along it."""
    corner_log_odds: Float[np.ndarray, " points"]
    """Sum of the log odds of corner against edge, nats."""
    cell: Int[np.ndarray, "points 2"]
    """Cell of the floor in which the point was first observed; for a fusion, that of one of its members."""

    @property
    def cov(self) -> Float[np.ndarray, "points 2 2"]:
        """Covariance of ``position``, square metres."""
        return np.linalg.inv(self.information)

    @property
    def inflated_cov(self) -> Float[np.ndarray, "points 2 2"]:
        """Covariance of ``position``, multiplied by the variance factor that the scatter of the observations shows.

        The expected scatter enters as one more observation.
        """
        cov = ((self.chi_squared + 2) / (2 * self.count))[:, None, None] * self.cov
        return (cov + cov.swapaxes(1, 2)) / 2

    @property
    def kinds(self) -> tuple[str, ...]:
        """The more probable kind of each point, "corner" or "edge"."""
        return tuple("corner" if odds > 0 else "edge" for odds in self.corner_log_odds.tolist())

    def grid_cells(self) -> Int[np.ndarray, "points 2"]:
        """Cell of the floor (5 cm)."""
        return self.cell

    def fuse(self, group: Int[np.ndarray, " points"]) -> "PointLandmarks":
        """One point per group, the mean weighted by information; no group may be empty."""
        groups = int(group.max(initial=-1)) + 1
        if len(self) == groups:  # every group has one member
            return self.take(np.argsort(group, kind="stable"))
        # Positions relative to any member, which avoids cancellation far from the world's origin.
        first = np.zeros(groups, dtype=np.int64)
        first[group[::-1]] = np.arange(len(group))[::-1]
        offset = self.position - self.position[first][group]
        information = np.zeros((groups, 2, 2))
        np.add.at(information, group, self.information)
        weighted = np.zeros((groups, 2))
        np.add.at(weighted, group, np.einsum("pij,pj->pi", self.information, offset))
        mean = np.linalg.solve(information, weighted[..., None])[..., 0]
        residual = offset - mean[group]
        chi_squared = np.einsum("pi,pij,pj->p", residual, self.information, residual)

        def total(values: np.ndarray) -> np.ndarray:
            return np.bincount(group, values, groups)

        last_seen = np.full(groups, -np.inf)
        np.maximum.at(last_seen, group, self.last_seen)
        cell = self.cell[np.lexsort((*self.cell.T, group))]
        return PointLandmarks(
            position=self.position[first] + mean,
            information=information,
            corner_log_odds=total(self.corner_log_odds),
            chi_squared=total(self.chi_squared + chi_squared),
            count=np.rint(total(self.count)).astype(np.int64),
            echoes=np.rint(total(self.echoes)).astype(np.int64),
            last_seen=last_seen,
            cell=cell[np.searchsorted(np.sort(group), np.arange(groups))],
            scans=unique_pairs(group[self.scans[0]], self.scans[1]),
        )


def aggregate_points(models: Sequence[LocalModel], poses: Float[np.ndarray, "models 3"]) -> PointLandmarks:
    """The corners and edges of local models in the world frame; ``reflectors`` fits circles to the echoes of all scans.

    Args:
        models: local models, robot frame.
        poses: world_from_robot of each: x, y (m), theta (rad). Models with a NaN pose are left out.
    """
    has_pose = np.all(np.isfinite(poses), axis=1)
    found = [(k, p) for k, model in enumerate(models) if has_pose[k] for p in model.points if p.kind != "circle"]
    model = np.array([k for k, _ in found], dtype=np.int64)
    position = np.array([transform_points(poses[k], np.array([[p.x, p.y]]))[0] for k, p in found]).reshape(-1, 2)
    rotation = np.stack([unit(poses[model, 2]), tangent_of(poses[model, 2])], axis=-1)
    cov = rotation @ np.array([p.cov for _, p in found], dtype=np.float64).reshape(-1, 2, 2) @ rotation.swapaxes(1, 2)
    # The true uncertainty region is an arc around the robot. Its curvature turns a bearing error into a range error.
    sight = position - poses[model, :2]
    distance = np.maximum(np.linalg.norm(sight, axis=-1), SETTINGS.points.min_range)
    ray = sight / distance[:, None]
    across = perpendicular(ray)
    curvature = np.einsum("pi,pij,pj->p", across, cov, across) / (2 * distance)
    cov += 3 * curvature[:, None, None] ** 2 * ray[:, :, None] * ray[:, None, :]
    least = SETTINGS.points.min_kind_probability
    probability = np.clip([p.probability for _, p in found], least, 1 - least)
    sign = np.array([1.0 if p.kind == "corner" else -1.0 for _, p in found])
    seen = np.array([(row, models[k].scan) for row, (k, _) in enumerate(found)], dtype=np.int64).reshape(-1, 2)
    return PointLandmarks(
        position=position,
        information=np.linalg.inv(cov),
        corner_log_odds=np.log(probability / (1 - probability)) * sign,
        chi_squared=np.zeros(len(found)),
        count=np.ones(len(found), dtype=np.int64),
        echoes=np.array([p.echoes for _, p in found], dtype=np.int64),
        last_seen=observation_times(models)[model],
        cell=np.floor(position / SETTINGS.points.merge_cell).astype(np.int64),
        scans=unique_pairs(*seen.T),
    )


def cluster_points(observations: PointLandmarks) -> tuple[PointLandmarks, Int[np.ndarray, " observations"]]:
    """Corners and edges from their observations, by agglomerative clustering.

    In each iteration, observations that are each other's most likely match are fused. Two observations match if their
    Mahalanobis distance and their distance in metres pass the gates. The result does not depend on the order of the
    observations, and clustering it again does not change it.

    Returns:
        The points, and the row of the point that each observation belongs to.
    """
    settings = SETTINGS.points
    points, point_of = observations, np.arange(len(observations))
    while len(points) > 1:
        pairs = KDTree(points.position).query_pairs(settings.max_distance, output_type="ndarray").reshape(-1, 2)
        a, b = pairs.T
        cov = points.cov
        cov = cov[a] + cov[b] + settings.position_floor**2 * np.eye(2)
        squared = _mahalanobis_squared(points.position[b] - points.position[a], cov)
        match = squared <= settings.gate**2
        if not match.any():
            break
        negative_log_likelihood = squared[match] + np.log(np.linalg.det(cov[match]))
        group = mutual_best(pairs[match].astype(np.int64), negative_log_likelihood, len(points))
        points, point_of = points.fuse(group), group[point_of]
    return points, point_of


def is_static(
    points: PointLandmarks,
    observations: PointLandmarks,
    point_of: Int[np.ndarray, " observations"],
    *,
    systematic_error: float,
) -> Bool[np.ndarray, " points"]:
    """Which points keep their position while the robot moves.

    Two walls that do not meet at a right angle also reflect sound back to the robot, but that apparent point moves with
    the robot.

    Args:
        points: fusions of the observations.
        observations: single observations.
        point_of: row of the point that each observation belongs to.
        systematic_error: standard deviation of an observed position due to pose errors, metres.
    """
    offset = observations.position - points.position[point_of]
    cov = observations.cov + systematic_error**2 * np.eye(2)
    squared = _mahalanobis_squared(offset, cov) + observations.chi_squared
    degrees_of_freedom = 2 * np.maximum(points.count - 1, 1)
    scatter = np.bincount(point_of, squared, len(points))
    return scatter <= SETTINGS.points.max_normalized_misfit * degrees_of_freedom


def _mahalanobis_squared(
    offset: Float[np.ndarray, "points 2"], cov: Float[np.ndarray, "points 2 2"]
) -> Float[np.ndarray, " points"]:
    return (offset * np.linalg.solve(cov, offset[..., None])[..., 0]).sum(-1)
