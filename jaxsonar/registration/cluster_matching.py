"""Features of clusters of scans: initial poses of one cluster in the frame of another, and reflectors that agree."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.geometry.se2 import subtract_poses, tangent_of, unit, wrap_angle
from jaxsonar.registration.features import Features
from jaxsonar.registration.motion_prior import usual_motion
from jaxsonar.registration.pose_hypotheses import pose_hypotheses, poses_along_walls, thin_poses
from jaxsonar.registration.pose_likelihood import pose_log_likelihood, refine_poses
from jaxsonar.registration.scan_cluster import ScanCluster, corners_of_walls
from jaxsonar.registration.settings import RANGE_SETTINGS as SETTINGS


class ClusterFeatures(NamedTuple):
    """Reflectors of a cluster as features; a reflector of undecided kind is both a wall and a point."""

    features: Features
    wall: Int[np.ndarray, " walls"]
    """Row of the reflector of each wall."""
    point: Int[np.ndarray, " points"]
    """Row of the reflector of each point."""

    @classmethod
    def of(cls, cluster: ScanCluster) -> "ClusterFeatures":
        """Features of a cluster in its frame."""
        behind = cluster.kind_evidence - cluster.kind_evidence.max(axis=1, keepdims=True)
        wall, point = (
            np.flatnonzero(those.max(axis=1) > -SETTINGS.viable_nats) for those in (behind[:, :1], behind[:, 1:])
        )
        is_wall, is_point = cluster.is_wall[wall], ~cluster.is_wall[point]
        rho, theta = cluster.parameters_by_kind[wall, 0].T
        normal, tangent = unit(theta), tangent_of(theta)
        # A reflector that is rather a point is a short wall at the position of that point.
        short = (tangent * cluster.parameters_by_kind[wall, 1]).sum(axis=-1)[:, None] + np.array([-0.1, 0.1])
        extent = np.where(is_wall[:, None], cluster.extent[wall], short)
        mid, half = extent.mean(axis=1), (extent[:, 1] - extent[:, 0]) / 2
        cov, vague = cluster.covariance[wall], np.square(SETTINGS.uncertain_kind_sd)
        across = cov[:, 0, 0] - 2 * mid * cov[:, 0, 1] + mid**2 * cov[:, 1, 1]
        variance = np.where(is_wall, np.stack([across, cov[:, 1, 1]]), vague[:2, None]).T
        variance = variance + np.square(SETTINGS.feature_sd_floor[:2])
        kind = cluster.kind_evidence[point, 1:].argmax(axis=1) + 1
        point_sd = np.sqrt(np.trace(cluster.covariance[point], axis1=1, axis2=2) / 2)
        point_sd = np.minimum(np.where(is_point, point_sd, SETTINGS.uncertain_kind_sd[2]), SETTINGS.max_point_sd)
        features = Features(
            reference=rho[:, None] * normal + mid[:, None] * tangent,
            theta=theta,
            offset=np.zeros(len(theta)),
            covariance=variance[:, :, None] * np.eye(2),
            extent=np.stack([-half, half], axis=-1),
            weight=np.exp(SETTINGS.kind_weight * behind[wall, 0]),
            scans=np.full(len(theta), 2.0),
            point=cluster.parameters_by_kind[point, kind],
            is_corner=np.ones(len(point), dtype=bool),
            point_sd=np.hypot(point_sd, SETTINGS.feature_sd_floor[2]),
        )
        return cls(features, wall, point)


def initial_poses(a: ScanCluster, b: ScanCluster, gap: int) -> list[Float[np.ndarray, "3"]]:
    """Different poses of cluster b in the frame of cluster a, the most likely by features first.

    Args:
        a: cluster in the frame of the scan at which both meet.
        b: the same.
        gap: difference of the numbers of these scans.
    """
    scan, known, prior = ClusterFeatures.of(b).features, ClusterFeatures.of(a).features, usual_motion(gap)
    farthest = SETTINGS.max_motion * prior.sd[0]
    poses = pose_hypotheses(scan, known, np.zeros(3))
    poses = np.concatenate([poses, poses_along_walls(scan, known, extent=farthest, step=SETTINGS.slide_step)])
    poses = thin_poses(poses[np.linalg.norm(poses[:, :2], axis=1) < farthest], SETTINGS.pose_cell)
    batches = np.array_split(poses, -(-max(len(poses), 1) // 1024))
    likelihood = np.concatenate([pose_log_likelihood(known, scan, some).log_likelihood for some in batches])
    nats = likelihood + prior.log_density(poses)
    poses = poses[np.argsort(-nats, kind="stable")[: SETTINGS.refined_poses]]
    information = np.diag([prior.sd[0] ** -2, prior.sd[0] ** -2, 1e-2])
    poses = refine_poses(
        known, scan, poses, information, steps=SETTINGS.feature_steps, max_step=SETTINGS.feature_max_step
    )
    found = pose_log_likelihood(known, scan, poses)
    volume = np.linalg.slogdet(found.information + information)[1] / 2
    nats = found.log_likelihood + prior.log_density(poses) - volume
    kept: list[Float[np.ndarray, 3]] = []
    for k in np.argsort(-nats, kind="stable"):
        if len(kept) < SETTINGS.adjusted_poses and all(are_distinct(poses[k], one, 0.5) for one in kept):
            kept.append(poses[k])
    return kept


def are_distinct(pose: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"], factor: float = 1.0) -> bool:
    """Whether poses differ by more than the tolerance of ``distinct_pose``, times a factor."""
    off = subtract_poses(pose, other)
    position, heading = SETTINGS.distinct_pose
    return bool(np.hypot(off[0], off[1]) > factor * position or abs(off[2]) > factor * heading)


def matching_reflectors(a: ScanCluster, b: ScanCluster) -> list[tuple[int, int]]:
    """Rows of reflectors of two clusters in one frame that agree, nearest first; each occurs at most once."""
    one, other = ClusterFeatures.of(a), ClusterFeatures.of(b)
    first, second = one.features, other.features
    offset = second.reference - first.reference[:, None]
    across, along = ((offset * axis[:, None]).sum(-1) for axis in (first.normal, first.tangent))
    turn = wrap_angle(second.theta - first.theta[:, None])
    var_across, var_turn = (first.covariance[:, None, k, k] + second.covariance[:, k, k] for k in (0, 1))
    # Halfway between the observed parts the errors of the directions matter least.
    halfway = across - along / 2 * np.tan(np.clip(turn, -1.0, 1.0))
    distance = halfway**2 / (var_across + along**2 / 4 * var_turn) + turn**2 / var_turn
    gap = np.abs(along) - first.half_length[:, None] - second.half_length
    agree = (distance < SETTINGS.match_gate) & (gap < SETTINGS.max_match_gap)
    walls = np.where(agree, distance + 2 * np.maximum(gap, 0.0), np.inf)
    variance = first.point_sd[:, None] ** 2 + second.point_sd**2
    points = np.square(second.point - first.point[:, None]).sum(-1) / variance
    points = np.where(points < SETTINGS.match_gate, points, np.inf)
    rows = [(walls[i, j], one.wall[i], other.wall[j]) for i, j in np.argwhere(np.isfinite(walls))]
    rows += [(points[i, j], one.point[i], other.point[j]) for i, j in np.argwhere(np.isfinite(points))]
    pairs: list[tuple[int, int]] = []
    for _, i, j in sorted(rows):
        if all(i != mine and j != its for mine, its in pairs):
            pairs.append((int(i), int(j)))
    return pairs


def implied_corner_evidence(cluster: ScanCluster, pairs: Sequence[tuple[int, int]]) -> float:
    """Evidence of common corners on two common walls, nats; it is not independent of the evidence of the walls."""
    rows = np.array([row for row, _ in pairs])
    corner = rows[corners_of_walls(cluster.kind[rows], cluster.parameters[rows])]
    volume = np.log(2 * np.pi) + np.linalg.slogdet(cluster.covariance[corner])[1] / 2
    return float(np.maximum(np.log(SETTINGS.point_area) - volume, 0.0).sum())


def total_wall_gap(a: ScanCluster, b: ScanCluster, pairs: Sequence[tuple[int, int]]) -> float:
    """Sum of the gaps between the observed parts of common walls of two clusters in one frame, metres."""
    mine, its = (np.array(rows) for rows in zip(*pairs, strict=True))
    wall = (a.kind[mine] == kernels.PLANE) & (b.kind[its] == kernels.PLANE)
    first, second = a.extent[mine[wall]], b.extent[its[wall]]
    return float(np.maximum(np.maximum(first[:, 0] - second[:, 1], second[:, 0] - first[:, 1]), 0.0).sum())
