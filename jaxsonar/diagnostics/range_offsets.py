"""Range offsets of all sensors, estimated jointly with small corrections of all walls.

If poses gather the walls, errors of the poses look like range offsets: drift moves a wall towards the sensors on one
side of the robot, and away from those on the other side. Therefore a wall is corrected in each stretch of the
trajectory anew, and standard errors are estimated from the differences between stretches.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from jaxsonar.diagnostics.echo_residuals import ResidualTable
from jaxsonar.diagnostics.settings import SETTINGS
from jaxsonar.geometry.robust_statistics import robust_deviation
from jaxsonar.plausibility.pose_agreement import select_groups
from jaxsonar.scans.scan_log import Log


class OffsetEstimate(NamedTuple):
    """Range offsets, and the residuals that remain."""

    offset: Float[np.ndarray, " sensors"]
    """What each sensor reports too much, metres; NaN where it has echoes in too few scans or stretches."""
    error: Float[np.ndarray, " sensors"]
    """Standard error of the offset, metres. If it comes from few stretches of the trajectory, it
    is larger, so that an offset of ``OffsetSettings.tail_sigmas`` errors is as improbable as one of a normal
    distribution."""
    sigma: float
    """Robust standard deviation of the residuals, metres; NaN without residuals."""
    row: Int[np.ndarray, " used"]
    """Rows of the table that were used."""
    residual: Float[np.ndarray, " used"]
    """Residual of each row against a wall that is determined without it (leave-one-out), metres."""


def stretches_of_scans(log: Log) -> Int[np.ndarray, " scans"]:
    """Stretch of the trajectory of each scan, numbered: about 1 m, or a right angle, in which poses drift little."""
    begin = np.array([group[0] for group in select_groups(log)], np.int64)
    return np.searchsorted(begin, np.arange(len(log)), side="right")


def estimate_offsets(
    table: ResidualTable, sensors: int, min_noise: float, stretch: Int[np.ndarray, " scans"] | None = None
) -> OffsetEstimate:
    """Robust least squares over all offsets and all walls jointly, so that a bad sensor does not spoil its neighbors.

    Args:
        table: residuals of the echoes.
        sensors: number of sensors.
        min_noise: lower limit of the noise, metres, for walls with so few echoes that their residuals are too small.
        stretch: number of the stretch of the trajectory of each scan (``stretches_of_scans``), if poses gather the
            walls; None if single scans show them.
    """
    settings = SETTINGS.offsets
    row = np.flatnonzero(
        (np.abs(table.residual) < settings.gate)
        & table.is_nearest
        & (table.visibility > settings.min_visibility)
        & table.unobstructed
        & (table.beyond_end <= SETTINGS.reference.end_margin)
        & (table.independent_echoes >= settings.min_independent_echoes)
    )
    tx, rx, residual = table.tx[row], table.rx[row], table.residual[row]
    part = None
    if stretch is None:
        _, wall = np.unique(table.wall[row], return_inverse=True)
    else:
        each, wall = np.unique(np.stack([stretch[table.scan[row]], table.wall[row]]), axis=1, return_inverse=True)
        part = np.unique(each[0], return_inverse=True)[1]
    walls, d_wall = int(wall.max(initial=-1)) + 1, table.d_range_d_wall[row]
    # The offset of a path is the mean of the offsets of its two sensors.
    d_offset = np.zeros((len(row), sensors))
    d_offset[np.arange(len(row)), tx] += 0.5
    d_offset[np.arange(len(row)), rx] += 0.5
    has_echoes = d_offset.sum(axis=0) > 0
    offset = np.array([_median(residual[(tx == k) & (rx == k)]) for k in range(sensors)])
    correction, noise = np.zeros((walls, 2)), settings.initial_noise
    wall_cov, error = np.zeros((walls, 2, 2)), np.full(sensors, np.nan)
    weight = np.ones(len(row))
    prior = settings.prior_information
    for _ in range(settings.iterations if len(row) else 0):
        left = residual - (d_wall * correction[wall]).sum(axis=1) - (offset[tx] + offset[rx]) / 2
        noise = max(robust_deviation(left, center=0.0), min_noise)
        weight = np.clip(1 - (left / (settings.tukey * noise)) ** 2, 0, None) ** 2 / noise**2
        # Normal equations; the walls are eliminated one by one (Schur complement).
        info_wall = _sum_groups(wall, weight[:, None, None] * d_wall[:, :, None] * d_wall[:, None, :], walls)
        info_wall = info_wall + prior * np.eye(2)
        coupling = _sum_groups(wall, weight[:, None, None] * d_wall[:, :, None] * d_offset[:, None, :], walls)
        gradient_wall = _sum_groups(wall, (weight * residual)[:, None] * d_wall, walls)
        wall_cov = np.linalg.inv(info_wall)
        information = _sum_groups(wall, weight[:, None, None] * d_offset[:, :, None] * d_offset[:, None, :], walls)
        information -= np.einsum("wik,wij,wjl->wkl", coupling, wall_cov, coupling)
        gradient = _sum_groups(wall, (weight * residual)[:, None] * d_offset, walls)
        gradient -= np.einsum("wik,wij,wj->wk", coupling, wall_cov, gradient_wall)
        offset, error = _solve(information, gradient, has_echoes, part)
        correction = np.einsum("wij,wj->wi", wall_cov, gradient_wall - np.einsum("wik,k->wi", coupling, offset))
    left = residual - (d_wall * correction[wall]).sum(axis=1) - (offset[tx] + offset[rx]) / 2
    leverage = weight * np.einsum("ei,eij,ej->e", d_wall, wall_cov[wall], d_wall)
    left = left / np.maximum(1 - leverage, 0.1)
    used = weight > 0
    enough = np.bincount(tx[used], minlength=sensors) + np.bincount(rx[used], minlength=sensors) >= settings.min_echoes
    enough &= np.isfinite(error)
    offset, error = (np.where(enough, values, np.nan) for values in (offset, error))
    return OffsetEstimate(offset, error, noise if len(row) else np.nan, row, left)


def _solve(
    information: Float[np.ndarray, "walls sensors sensors"],
    gradient: Float[np.ndarray, "walls sensors"],
    has_echoes: Bool[np.ndarray, " sensors"],
    stretch: Int[np.ndarray, " walls"] | None,
) -> tuple[Float[np.ndarray, " sensors"], Float[np.ndarray, " sensors"]]:
    """Offsets from the normal equations of each wall, and their standard errors.

    Args:
        information: matrix of each wall.
        gradient: right side of each wall.
        has_echoes: sensors with echoes.
        stretch: stretch of the trajectory of each wall, numbered without gaps; the offsets are determined without each
            of them, one after the other (jackknife). None if the errors of the walls are independent.
    """
    prior = SETTINGS.offsets.prior_information * np.eye(len(has_echoes))
    total, right = information.sum(axis=0) + prior, gradient.sum(axis=0)
    solution = np.linalg.solve(total, right)
    project, observable = _sparse_gauge(solution, total, has_echoes)
    offset, error = project @ solution, np.linalg.norm(project @ observable, axis=1)
    if stretch is None:
        return offset, error
    count = int(stretch.max(initial=0)) + 1
    part, part_right = (_sum_groups(stretch, values, count) for values in (information, gradient))
    without = np.linalg.solve(total - part, (right - part_right)[..., None])[..., 0]
    change = (without - solution) @ project.T
    jackknife = np.sqrt((count - 1) / count * (change**2).sum(axis=0))
    # Stretches that count: as many as there were if all of them told the same about the sensor.
    share = np.einsum("pkk->kp", part)
    stretches = share.sum(axis=1) ** 2 / np.maximum((share**2).sum(axis=1), 1e-12)
    sigmas, prior_freedom = SETTINGS.offsets.tail_sigmas, SETTINGS.offsets.pooled_stretches
    enough = stretches >= SETTINGS.offsets.min_stretches
    # The scatter between stretches is much the same for all sensors: their mean counts as several stretches.
    freedom = np.maximum(stretches - 1, 0.0)
    scatter = jackknife**2 * stretches
    pooled = float((freedom * scatter).sum() / max(freedom.sum(), 1e-12))
    scatter = (freedom * scatter + prior_freedom * pooled) / (freedom + prior_freedom)
    tail = stats.t.isf(stats.norm.sf(sigmas), freedom + prior_freedom) / sigmas
    spread = np.sqrt(scatter / np.maximum(stretches, 1)) * tail
    return offset, np.where(enough, np.maximum(error, spread), np.inf)


def remove_gauge_freedom(
    offset: Float[np.ndarray, " sensors"],
    information: Float[np.ndarray, "sensors sensors"],
    has_echoes: Bool[np.ndarray, " sensors"],
) -> tuple[Float[np.ndarray, " sensors"], Float[np.ndarray, " sensors"]]:
    """The equivalent offsets with the fewest sensors off, and their standard errors.

    Corrections of the walls can absorb offsets that vary slowly from sensor to sensor (a common offset; a translation
    of the ring). The echoes cannot determine these, so the sparsest solution (L1 norm) is chosen.

    Args:
        offset: offsets, metres.
        information: their information matrix.
        has_echoes: sensors with echoes.
    """
    project, observable = _sparse_gauge(offset, information, has_echoes)
    return project @ offset, np.linalg.norm(project @ observable, axis=1)


def _sparse_gauge(
    offset: Float[np.ndarray, " sensors"],
    information: Float[np.ndarray, "sensors sensors"],
    has_echoes: Bool[np.ndarray, " sensors"],
) -> tuple[Float[np.ndarray, "sensors sensors"], Float[np.ndarray, "sensors observable"]]:
    """The projection of ``remove_gauge_freedom``, and a square root of the covariance of what is observable."""
    settings = SETTINGS.offsets
    eigenvalue, mode = np.linalg.eigh(information)
    unobservable = eigenvalue < settings.weak_information * np.median(eigenvalue)
    unobservable[0] = True
    free = mode[:, unobservable]
    weight = has_echoes.astype(np.float64)
    project = np.eye(len(offset))
    for _ in range(settings.sparsity_iterations):
        normal = free.T @ (weight[:, None] * free) + 1e-9 * np.eye(free.shape[1])
        project = np.eye(len(offset)) - free @ np.linalg.solve(normal, (free * weight[:, None]).T)
        scale = settings.sparsity_scale
        weight = has_echoes / np.sqrt((project @ offset) ** 2 + scale**2) * scale
    return project, mode[:, ~unobservable] / np.sqrt(eigenvalue[~unobservable])


def _sum_groups(group: np.ndarray, values: np.ndarray, groups: int) -> np.ndarray:
    flat = values.reshape(len(values), -1)
    total = np.stack([np.bincount(group, column, minlength=groups) for column in flat.T], axis=-1)
    return total.reshape(groups, *values.shape[1:])


def _median(values: Float[np.ndarray, " echoes"]) -> float:
    return float(np.median(values)) if len(values) else 0.0
