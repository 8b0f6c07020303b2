"""Least squares on the ranges of a cluster of scans, and its log-evidence.

The kinds of the reflectors, and the poses with the reflectors, are estimated in turn: each reflector is of the kind
that explains all of its echoes best. The evidence is Laplace's approximation: the likelihood of the residuals, and the
volume of the posterior in relation to the volume of the prior.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.se2 import perpendicular, rotate, wrap_angle
from jaxsonar.registration.echo_groups import ScanObservations
from jaxsonar.registration.reflector_fit import fit_reflectors
from jaxsonar.registration.scan_cluster import ScanCluster
from jaxsonar.registration.settings import RANGE_SETTINGS as SETTINGS
from jaxsonar.sensors.range_models import plane_footpoint, predict_ranges


def single_scan(observations: ScanObservations, scan: int | np.integer) -> ScanCluster:
    """A cluster of one scan in its own frame, adjusted; every group of echoes is a reflector."""
    groups = observations.groups
    mine = np.flatnonzero(groups.scan == scan)
    poses = np.full((len(observations.ranges), 3), np.nan)
    reflector = np.full(len(groups.scan), -1)
    poses[scan], reflector[mine] = 0.0, np.arange(len(mine))
    parameters = np.stack([groups.plane[mine], groups.point[mine], groups.point[mine]], axis=1)
    kind = groups.log_prior[mine].argmax(axis=1).astype(np.int32)
    return adjust_cluster(observations, ScanCluster.unadjusted(poses, reflector, kind, parameters))


def adjust_cluster(observations: ScanObservations, cluster: ScanCluster, *, fixed: int | None = None) -> ScanCluster:
    """Estimate kinds, poses and reflectors.

    Args:
        observations: the echoes.
        cluster: start values, accurate to centimetres and degrees.
        fixed: scan whose pose is held; the first one if left out.
    """
    cluster, widest = _select_kinds(observations, cluster, SETTINGS.kind_steps[0]), 4 * SETTINGS.gate
    for _ in range(SETTINGS.alternations):
        cluster = adjust_poses(observations, cluster, steps=SETTINGS.joint_steps, widest=widest, fixed=fixed)
        again = _select_kinds(observations, cluster, SETTINGS.kind_steps[1])
        if (again.kind == cluster.kind).all():
            break
        cluster, widest = again, SETTINGS.gate
    else:
        return adjust_poses(observations, cluster, steps=SETTINGS.joint_steps, fixed=fixed)
    return replace(cluster, parameters_by_kind=again.parameters_by_kind, kind_evidence=again.kind_evidence)


def adjust_poses(
    observations: ScanObservations,
    cluster: ScanCluster,
    *,
    steps: int,
    widest: float = SETTINGS.gate,
    fixed: int | None = None,
) -> ScanCluster:
    """Gauss-Newton steps of poses and reflectors together; the kinds stay.

    Args:
        observations: the echoes.
        cluster: start values.
        steps: number of steps; in the last two an echo has weight 0 or 1.
        widest: scale of the first robust weights, in sigma; it is halved in every step until it reaches the gate.
        fixed: scan whose pose is held; the first one if left out.
    """
    echoes, rows = observations.grouped, cluster.rows
    mine = np.flatnonzero(cluster.reflector[echoes.group] >= 0)
    scan, group, measured = echoes.scan[mine], echoes.group[mine], echoes.range[mine]
    row, every = cluster.reflector[group], np.arange(len(mine))
    column = np.searchsorted(rows, scan)
    pose_size, size = 3 * len(rows), 3 * len(rows) + 2 * len(cluster.kind)
    prior = np.full(size, SETTINGS.landmark_information)
    prior[:pose_size] = np.tile(SETTINGS.pose_information, len(rows))
    first = 0 if fixed is None else int(np.searchsorted(rows, fixed))
    prior[3 * first : 3 * first + 3] = SETTINGS.fixed_information
    poses, parameters = cluster.poses.copy(), cluster.parameters
    jacobian, information = np.zeros((len(mine), size)), np.diag(prior)
    for step in range(steps):
        arm, midpoint, base = _transducers(poses, scan, echoes.midpoint[mine], echoes.half_baseline[mine])
        predicted = predict_ranges(cluster.kind[row], parameters[row], midpoint, base)
        residual = (measured - predicted.range) / observations.sigma
        robust = step < steps - 2
        weight = 1 / (1 + np.square(residual / widest)) if robust else (np.abs(residual) < SETTINGS.gate).astype(float)
        widest = max(widest / 2, SETTINGS.gate)
        root = weight[:, None] / observations.sigma
        jacobian[:] = 0
        jacobian[every, 3 * column], jacobian[every, 3 * column + 1] = (root * predicted.d_range_d_midpoint).T
        turn = (predicted.d_range_d_midpoint * perpendicular(arm)).sum(-1)
        turn = turn + (predicted.d_range_d_half_baseline * perpendicular(base)).sum(-1)
        jacobian[every, 3 * column + 2] = root[:, 0] * turn
        by_landmark = (root * predicted.d_range_d_landmark).T
        jacobian[every, pose_size + 2 * row], jacobian[every, pose_size + 2 * row + 1] = by_landmark
        information = jacobian.T @ jacobian + np.diag(prior)
        change = np.linalg.solve(information, jacobian.T @ (weight * residual))
        change = np.clip(change, -SETTINGS.max_step, SETTINGS.max_step)
        poses[rows] += change[:pose_size].reshape(-1, 3)
        parameters = parameters + change[pose_size:].reshape(-1, 2)
    poses[rows, 2] = wrap_angle(poses[rows, 2])
    # Residuals, evidence and covariances at the solution.
    _, midpoint, base = _transducers(poses, scan, echoes.midpoint[mine], echoes.half_baseline[mine])
    residual = (
        measured - predict_ranges(cluster.kind[row], parameters[row], midpoint, base).range
    ) / observations.sigma
    cost = np.minimum(np.square(residual), SETTINGS.gate**2)
    prior_volume = np.where(cluster.is_wall, np.log(SETTINGS.plane_range), np.log(SETTINGS.point_area))
    own = np.flatnonzero(cluster.reflector >= 0)
    log_prior = SETTINGS.kind_prior_weight * observations.groups.log_prior[own, cluster.kind[cluster.reflector[own]]]
    log_determinant = np.linalg.slogdet(information)[1] - 3 * np.log(SETTINGS.fixed_information)
    volume = (size - 3) / 2 * np.log(2 * np.pi) - log_determinant / 2
    parameters_by_kind, pose_covariance = cluster.parameters_by_kind.copy(), np.full((len(poses), 3, 3), np.nan)
    parameters_by_kind[np.arange(len(cluster.kind)), cluster.kind] = parameters
    cov = np.linalg.inv(information)
    blocks = 3 * np.arange(len(rows))[:, None] + np.arange(3)
    pose_covariance[rows] = cov[blocks[:, :, None], blocks[:, None]]
    blocks = pose_size + 2 * np.arange(len(cluster.kind))[:, None] + np.arange(2)
    squared = np.bincount(group, weights=cost, minlength=len(cluster.reflector)).astype(np.float64)
    return ScanCluster(
        poses=poses,
        reflector=cluster.reflector,
        kind=cluster.kind,
        parameters_by_kind=parameters_by_kind,
        kind_evidence=cluster.kind_evidence,
        covariance=cov[blocks[:, :, None], blocks[:, None]],
        pose_covariance=pose_covariance,
        squared_residuals=squared,
        observed=_observed_intervals(parameters[row], midpoint, base, group, len(cluster.reflector)),
        evidence=float(volume - cost.sum() / 2 - prior_volume.sum() + log_prior.sum()),
    )


def _transducers(
    poses: Float[np.ndarray, "scans 3"],
    scan: Int[np.ndarray, " echoes"],
    midpoint: Float[np.ndarray, "echoes 2"],
    half_baseline: Float[np.ndarray, "echoes 2"],
) -> tuple[Float[np.ndarray, "echoes 2"], Float[np.ndarray, "echoes 2"], Float[np.ndarray, "echoes 2"]]:
    """Vectors from the robots to the midpoints, midpoints, and half baselines, in the frame of the poses."""
    pose = poses[scan]
    arm = rotate(midpoint, pose[:, 2])
    return arm, pose[:, :2] + arm, rotate(half_baseline, pose[:, 2])


def _observed_intervals(
    plane: Float[np.ndarray, "echoes 2"],
    midpoint: Float[np.ndarray, "echoes 2"],
    half_baseline: Float[np.ndarray, "echoes 2"],
    group: Int[np.ndarray, " echoes"],
    group_count: int,
) -> Float[np.ndarray, "groups 2"]:
    """Intervals between the outermost points of reflection of each group on its wall (``ScanCluster.observed``)."""
    along = plane_footpoint(plane, midpoint, half_baseline, min_height=SETTINGS.corner_tolerance)
    out = np.tile([np.inf, -np.inf], (group_count, 1))
    np.minimum.at(out[:, 0], group, along)
    np.maximum.at(out[:, 1], group, along)
    return out


def _select_kinds(observations: ScanObservations, cluster: ScanCluster, steps: int) -> ScanCluster:
    """Fit each reflector as every kind, with the poses held, and select the kind with the largest evidence."""
    echoes = observations.grouped
    mine = np.flatnonzero(cluster.reflector[echoes.group] >= 0)
    _, midpoint, base = _transducers(
        cluster.poses, echoes.scan[mine], echoes.midpoint[mine], echoes.half_baseline[mine]
    )
    row, gate = cluster.reflector[echoes.group[mine]], SETTINGS.gate
    fit = fit_reflectors(
        cluster.parameters_by_kind,
        row,
        echoes.range[mine],
        midpoint,
        base,
        sigma=observations.sigma,
        steps=steps,
        scales=(3 * gate, gate),
    )
    member = np.zeros((len(cluster.kind), len(mine)))
    member[row, np.arange(len(mine))] = 1.0
    cost = member @ np.minimum(np.square(fit.residual), gate**2).T
    evidence = -cost / 2 - np.linalg.slogdet(fit.information)[1] / 2
    evidence -= np.log([SETTINGS.plane_range, SETTINGS.point_area, SETTINGS.point_area])
    own = np.flatnonzero(cluster.reflector >= 0)
    log_prior = SETTINGS.kind_prior_weight * observations.groups.log_prior[own]
    np.add.at(evidence, cluster.reflector[own], log_prior)
    kind = evidence.argmax(axis=1).astype(np.int32)
    return replace(cluster, parameters_by_kind=fit.parameters, kind_evidence=evidence, kind=kind)
