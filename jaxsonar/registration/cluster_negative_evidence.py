"""Evidence beside the assigned echoes of a cluster of scans: missed detections, blocked sight, unassigned echoes."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.geometry.se2 import perpendicular, rotate, tangent_of, unit
from jaxsonar.registration.echo_groups import ScanObservations
from jaxsonar.registration.scan_cluster import ScanCluster
from jaxsonar.registration.settings import RANGE_SETTINGS as SETTINGS
from jaxsonar.sensors.range_models import PredictedRange, predict_ranges


def cluster_negative_evidence(observations: ScanObservations, cluster: ScanCluster) -> float:
    """Evidence against a cluster, nats: missed detections, walls in the line of sight, and the robot on walls."""
    if not len(cluster.kind) or len(cluster.rows) < 2:
        return 0.0
    poses, wall = cluster.poses[cluster.rows], cluster.is_wall
    # Paths that should detect a reflector: it is inside the cones, in range, and not an edge, whose echoes are weak.
    wide = observations.wide_paths
    view = _ReflectorView.of(cluster, poses[:, None], observations.paths_at(wide))
    reliable_range = SETTINGS.reliable_range_fraction * float(observations.ring.max_range)
    due = view.in_front & (view.off_axis < SETTINGS.inner_cone) & (view.prediction.range < reliable_range)
    due &= ~wall[:, None, None] | _is_observed(cluster, view.along, SETTINGS.due_margin)
    due &= (cluster.kind != kernels.EDGE)[:, None, None]
    due &= observations.measured[cluster.rows][:, wide]
    # Paths that detected something there, or whose earlier echo masks it.
    behind = view.prediction.range[..., None] - observations.ranges[cluster.rows][:, wide]
    tolerance = SETTINGS.range_tolerance + 3 * observations.sigma
    detected = (np.abs(behind) < tolerance) | ((behind > 0) & (behind < SETTINGS.masked_range))
    missed, count = (due & ~detected.any(axis=-1)).sum(axis=-1), due.sum(axis=-1)
    own = np.zeros((len(cluster.kind), len(cluster.poses)), dtype=bool)
    mine = np.flatnonzero(cluster.reflector >= 0)
    own[cluster.reflector[mine], observations.groups.scan[mine]] = True
    own = own[:, cluster.rows]
    blocked = _sight_is_blocked(cluster, poses, _expected_reflection(cluster, poses, view.along, due))
    counts = (missed >= SETTINGS.min_due_paths) & (missed > SETTINGS.missed_fraction * count) & ~own & ~blocked
    nats = np.minimum(SETTINGS.missed_path_nats * missed, SETTINGS.max_missed_nats)
    nats = np.where(counts, nats, 0.0) * np.where(wall, 1.0, 0.5)[:, None]
    nats += np.where(own & blocked, SETTINGS.blocked_sight_nats, 0.0)
    total = float(np.minimum(nats.sum(axis=1), SETTINGS.max_reflector_nats).sum())
    return total + SETTINGS.blocked_sight_nats * _wall_conflicts(cluster, poses)


def unassigned_evidence(observations: ScanObservations, cluster: ScanCluster) -> float:
    """Log-likelihood ratio of unassigned echoes: from the cluster's reflectors against from anywhere, nats."""
    echoes = observations.unassigned
    mine = np.flatnonzero(cluster.registered[echoes.scan])
    if not len(mine) or not len(cluster.kind):
        return 0.0
    view = _ReflectorView.of(cluster, cluster.poses[echoes.scan[mine]], observations.paths_at(echoes.path[mine]))
    extent, margin = cluster.extent, SETTINGS.unassigned_margin
    beside = (view.along < extent[:, :1] - margin) | (view.along > extent[:, 1:] + margin)
    possible = view.in_front & (view.off_axis < SETTINGS.outer_cone) & ~(cluster.is_wall[:, None] & beside)
    predicted = view.prediction
    spread = np.einsum(
        "rei,rij,rej->re", predicted.d_range_d_landmark, cluster.covariance, predicted.d_range_d_landmark
    )
    variance = observations.sigma**2 + np.minimum(spread, SETTINGS.max_range_sd**2)
    squared = np.square(echoes.range[mine] - predicted.range)
    density = np.exp(-squared / variance / 2) / np.sqrt(2 * np.pi * variance)
    density = np.where(possible, density, 0.0) * float(observations.ring.max_range)
    density = density / np.maximum(possible.sum(axis=0), 2)
    odds = SETTINGS.unassigned_probability / (1 - SETTINGS.unassigned_probability)
    nats = np.log(1 + odds * density.sum(axis=0))
    both = echoes.scan[mine] * len(cluster.kind) + density.argmax(axis=0)
    return float(np.minimum(np.bincount(both, weights=nats), SETTINGS.max_unassigned_nats).sum())


class _ReflectorView(NamedTuple):
    """How paths observe reflectors; arrays are reflectors x (scans x paths, or echoes)."""

    in_front: Bool[np.ndarray, "reflectors *batch"]
    """Whether the transducers are in front of the wall; true for points."""
    off_axis: Float[np.ndarray, "reflectors *batch"]
    """Squared chord off the beam axis, relative to the cone edge; the larger of both transducers."""
    along: Float[np.ndarray, "reflectors *batch"]
    """Position along the wall, metres from the foot point of the origin."""
    prediction: PredictedRange

    @classmethod
    def of(cls, cluster: ScanCluster, pose: Float[np.ndarray, "... 3"], paths: kernels.EchoPaths) -> "_ReflectorView":
        heading = pose[..., 2]
        midpoint = (pose[..., :2] + rotate(np.asarray(paths.midpoint), heading))[None]
        base = rotate(np.asarray(paths.half_baseline), heading)[None]
        parameters = cluster.parameters.reshape(-1, *[1] * (midpoint.ndim - 2), 2)
        predicted = predict_ranges(cluster.kind, parameters, midpoint, base)
        axes, cones = np.moveaxis(np.asarray(paths.axes), -2, 0), paths.cone.T
        sides = zip((predicted.departure, predicted.arrival), axes, cones, strict=True)
        off = [np.square(direction - rotate(axis, heading)).sum(axis=-1) / cone for direction, axis, cone in sides]
        height = parameters[..., 0] - (midpoint * unit(parameters[..., 1])).sum(axis=-1)
        along = (midpoint * tangent_of(parameters[..., 1])).sum(axis=-1)
        wall = cluster.is_wall.reshape(-1, *[1] * (height.ndim - 1))
        return cls(~wall | (height > SETTINGS.front_margin), np.maximum(*off), along, predicted)


def _is_observed(
    cluster: ScanCluster,
    along: Float[np.ndarray, "some *batch"],
    margin: float,
    rows: Int[np.ndarray, " some"] | None = None,
) -> Bool[np.ndarray, "some *batch"]:
    """Whether positions along walls are inside the interval that any one scan observed.

    Args:
        cluster: the walls.
        along: positions along the tangent, metres from the foot point of the origin.
        margin: distance from the ends of the interval, metres.
        rows: reflectors of the positions; all of them if left out.
    """
    number = np.full(len(cluster.kind), -1)
    rows = np.arange(len(cluster.kind)) if rows is None else rows
    number[rows] = np.arange(len(rows))
    out = np.zeros(along.shape, dtype=bool)
    for echo_cluster in np.flatnonzero(cluster.reflector >= 0):
        row, (low, high) = number[cluster.reflector[echo_cluster]], cluster.observed[echo_cluster]
        if row >= 0:
            out[row] |= (along[row] > low + margin) & (along[row] < high - margin)
    return out


def _expected_reflection(
    cluster: ScanCluster,
    poses: Float[np.ndarray, "scans 3"],
    along: Float[np.ndarray, "reflectors scans paths"],
    due: Bool[np.ndarray, "reflectors scans paths"],
) -> Float[np.ndarray, "reflectors scans 2"]:
    """Points of reflection for each scan: of a wall, the mean of the due paths, or the nearest observed point."""
    tangent, extent = tangent_of(cluster.parameters[:, 1]), cluster.extent
    foot = tangent @ poses[:, :2].T
    mean = np.where(due.any(axis=-1), (along * due).sum(axis=-1) / np.maximum(due.sum(axis=-1), 1), foot)
    mean = np.clip(mean, extent[:, :1], extent[:, 1:])
    on_wall = (cluster.parameters[:, :1] * unit(cluster.parameters[:, 1]))[:, None]
    on_wall = on_wall + mean[..., None] * tangent[:, None]
    return np.where(cluster.is_wall[:, None, None], on_wall, cluster.parameters[:, None])


def _sight_is_blocked(
    cluster: ScanCluster, poses: Float[np.ndarray, "scans 3"], target: Float[np.ndarray, "reflectors scans 2"]
) -> Bool[np.ndarray, "reflectors scans"]:
    """Whether another wall lies between scans and points on reflectors."""
    wall, margin = np.flatnonzero(cluster.is_wall), SETTINGS.sight_margin
    normal = unit(cluster.parameters[wall, 1])
    tangent = perpendicular(normal)
    start = (cluster.parameters[wall, 0] - poses[:, :2] @ normal.T)[None]
    end = cluster.parameters[wall, 0] - target @ normal.T
    crossing = _crossing(start, end, (poses[:, :2] @ tangent.T)[None], target @ tangent.T)
    through = (np.minimum(start, end) < -margin) & (np.maximum(start, end) > margin)
    through &= np.moveaxis(_is_observed(cluster, np.moveaxis(crossing, -1, 0), margin, wall), 0, -1)
    return (through & (wall != np.arange(len(cluster.kind))[:, None, None])).any(axis=-1)


def _wall_conflicts(cluster: ScanCluster, poses: Float[np.ndarray, "scans 3"]) -> int:
    """How often the robot is on a wall, or passes through one between consecutive scans."""
    wall = np.flatnonzero(cluster.is_wall)
    normal = unit(cluster.parameters[wall, 1])
    height = cluster.parameters[wall, 0][:, None] - normal @ poses[:, :2].T
    along = perpendicular(normal) @ poses[:, :2].T
    on = _is_observed(cluster, along, 0.0, wall) & (np.abs(height) < SETTINGS.min_wall_distance)
    before, after = height[:, :-1], height[:, 1:]
    crossing = _crossing(before, after, along[:, :-1], along[:, 1:])
    through = (before * after < 0) & _is_observed(cluster, crossing, 0.02, wall)
    through &= np.diff(cluster.rows) <= SETTINGS.straight_scans
    return int(on.sum() + through.sum())


def _crossing(
    start_height: Float[np.ndarray, "..."],
    end_height: Float[np.ndarray, "..."],
    start: Float[np.ndarray, "..."],
    end: Float[np.ndarray, "..."],
) -> Float[np.ndarray, "..."]:
    """Positions along walls at which lines cross them, from heights above the wall and positions of both ends."""
    apart = np.where(np.abs(start_height - end_height) > 1e-9, start_height - end_height, 1e-9)
    return start + start_height / apart * (end - start)
