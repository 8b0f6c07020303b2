"""Range offsets of all sensors, estimated jointly with small corrections of all walls."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.diagnostics.echo_residuals import ResidualTable
from jaxsonar.diagnostics.settings import SETTINGS


class OffsetEstimate(NamedTuple):
    """Range offsets, and the residuals that remain."""

    offset: Float[np.ndarray, " sensors"]
    """What each sensor reports too much, metres; NaN where it has too few echoes."""
    error: Float[np.ndarray, " sensors"]
    """Standard error of the offset, metres."""
    sigma: float
    """Robust standard deviation of the residuals, metres; NaN without residuals."""
    row: Int[np.ndarray, " used"]
    """Rows of the table that were used."""
    residual: Float[np.ndarray, " used"]
    """Residual of each row against a wall that is determined without it (leave-one-out), metres."""


def estimate_offsets(table: ResidualTable, sensors: int, min_noise: float) -> OffsetEstimate:
    """Robust least squares over all offsets and all walls jointly, so that a bad sensor does not spoil its neighbors.

    Args:
        table: residuals of the echoes.
        sensors: number of sensors.
        min_noise: lower limit of the noise, metres, for walls with so few echoes that their residuals are too small.
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
    _, wall = np.unique(table.wall[row], return_inverse=True)
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
        noise = max(1.4826 * float(np.median(np.abs(left))), min_noise)
        weight = np.clip(1 - (left / (settings.tukey * noise)) ** 2, 0, None) ** 2 / noise**2
        # Normal equations; the walls are eliminated one by one (Schur complement).
        info_wall = _sum_groups(wall, weight[:, None, None] * d_wall[:, :, None] * d_wall[:, None, :], walls)
        info_wall = info_wall + prior * np.eye(2)
        coupling = _sum_groups(wall, weight[:, None, None] * d_wall[:, :, None] * d_offset[:, None, :], walls)
        gradient_wall = _sum_groups(wall, (weight * residual)[:, None] * d_wall, walls)
        wall_cov = np.linalg.inv(info_wall)
        information = d_offset.T @ (weight[:, None] * d_offset) + prior * np.eye(sensors)
        information = information - np.einsum("wik,wij,wjl->kl", coupling, wall_cov, coupling)
        gradient = d_offset.T @ (weight * residual) - np.einsum("wik,wij,wj->k", coupling, wall_cov, gradient_wall)
        offset, error = remove_gauge_freedom(np.linalg.solve(information, gradient), information, has_echoes)
        correction = np.einsum("wij,wj->wi", wall_cov, gradient_wall - np.einsum("wik,k->wi", coupling, offset))
    left = residual - (d_wall * correction[wall]).sum(axis=1) - (offset[tx] + offset[rx]) / 2
    leverage = weight * np.einsum("ei,eij,ej->e", d_wall, wall_cov[wall], d_wall)
    left = left / np.maximum(1 - leverage, 0.1)
    used = weight > 0
    enough = np.bincount(tx[used], minlength=sensors) + np.bincount(rx[used], minlength=sensors) >= settings.min_echoes
    offset, error = (np.where(enough, values, np.nan) for values in (offset, error))
    return OffsetEstimate(offset, error, noise if len(row) else np.nan, row, left)


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
    observable = mode[:, ~unobservable] / np.sqrt(eigenvalue[~unobservable])
    return project @ offset, np.linalg.norm(project @ observable, axis=1)


def _sum_groups(group: np.ndarray, values: np.ndarray, groups: int) -> np.ndarray:
    flat = values.reshape(len(values), -1)
    total = np.stack([np.bincount(group, column, minlength=groups) for column in flat.T], axis=-1)
    return total.reshape(groups, *values.shape[1:])


def _median(values: Float[np.ndarray, " echoes"]) -> float:
    return float(np.median(values)) if len(values) else 0.0
