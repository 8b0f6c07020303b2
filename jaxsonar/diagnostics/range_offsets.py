"""What each sensor reports too much or too little: all offsets and all walls at once."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsonar.diagnostics.echo_residuals import MARGIN, Look

GATE = 0.1
"""Metres; an echo farther than this from where a wall is expected does not come from it."""


class Offsets(NamedTuple):
    """What each sensor reports too much, metres, and how far its echoes lie from walls that others tell of."""

    offset: np.ndarray
    error: np.ndarray
    sigma: float
    row: np.ndarray  # rows of the look
    residual: np.ndarray  # m, each without its own pull on the wall


def offsets_of(look: Look, count: int, floor: float) -> Offsets:
    """Robust least squares over all offsets and all walls at once: a bad sensor does not blame its neighbors.

    Args:
        look: what was heard.
        count: number of sensors.
        floor: noise, metres, below which residuals of walls with few echoes do not count as small.
    """
    row = np.flatnonzero(
        (np.abs(look.residual) < GATE) & look.mine & (look.share > 0.2) & look.open & (look.beyond <= MARGIN)
    )
    tx, rx, residual = look.tx[row], look.rx[row], look.residual[row]
    _, wall = np.unique(look.wall[row], return_inverse=True)
    walls, slope = int(wall.max(initial=-1)) + 1, look.slope[row]
    mix = np.zeros((len(row), count))
    mix[np.arange(len(row)), tx] += 0.5
    mix[np.arange(len(row)), rx] += 0.5
    seen = mix.sum(axis=0) > 0
    offset = np.array([_median(residual[(tx == k) & (rx == k)]) for k in range(count)])
    move, noise = np.zeros((walls, 2)), 0.01
    inverse, error = np.zeros((walls, 2, 2)), np.full(count, np.nan)
    weight = np.ones(len(row))
    for _ in range(12 if len(row) else 0):
        left = residual - (slope * move[wall]).sum(axis=1) - (offset[tx] + offset[rx]) / 2
        noise = max(1.4826 * float(np.median(np.abs(left))), floor)
        weight = np.clip(1 - (left / (4.685 * noise)) ** 2, 0, None) ** 2 / noise**2
        # Walls are eliminated one by one (Schur complement); both are held by wide priors, 50 mm and 0.05 rad.
        a = _summed(wall, weight[:, None, None] * slope[:, :, None] * slope[:, None, :], walls) + 400 * np.eye(2)
        b = _summed(wall, weight[:, None, None] * slope[:, :, None] * mix[:, None, :], walls)
        right = _summed(wall, (weight * residual)[:, None] * slope, walls)
        inverse = np.linalg.inv(a)
        held = mix.T @ (weight[:, None] * mix) + 400 * np.eye(count) - np.einsum("wik,wij,wjl->kl", b, inverse, b)
        pull = mix.T @ (weight * residual) - np.einsum("wik,wij,wj->k", b, inverse, right)
        offset = np.linalg.solve(held, pull)
        offset, error = without_gauge(offset, held, seen)
        move = np.einsum("wij,wj->wi", inverse, right - np.einsum("wik,k->wi", b, offset))
    left = residual - (slope * move[wall]).sum(axis=1) - (offset[tx] + offset[rx]) / 2
    own = weight * np.einsum("ei,eij,ej->e", slope, inverse[wall], slope)
    left = left / np.maximum(1 - own, 0.1)
    enough = np.bincount(tx, minlength=count) + np.bincount(rx, minlength=count) * 1 >= 16
    offset, error = (np.where(enough, values, np.nan) for values in (offset, error))
    return Offsets(offset, error, noise if len(row) else np.nan, row, left)


def without_gauge(offset: np.ndarray, held: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Offsets that are the same for the echoes, with as few sensors off as can be, and their standard errors.

    Walls move with offsets that change slowly from sensor to sensor (all the same; a ring moved aside), so that the
    echoes cannot tell these apart.
    """
    information, mode = np.linalg.eigh(held)
    vague = information < 0.03 * np.median(information)
    vague[0] = True
    free = mode[:, vague]
    weight = seen.astype(np.float64)
    project = np.eye(len(offset))
    for _ in range(30):
        normal = free.T @ (weight[:, None] * free) + 1e-9 * np.eye(free.shape[1])
        project = np.eye(len(offset)) - free @ np.linalg.solve(normal, (free * weight[:, None]).T)
        weight = seen / np.sqrt((project @ offset) ** 2 + 0.0005**2) * 0.0005
    certain = mode[:, ~vague] / np.sqrt(information[~vague])
    return project @ offset, np.linalg.norm(project @ certain, axis=1)


def _summed(group: np.ndarray, values: np.ndarray, groups: int) -> np.ndarray:
    flat = values.reshape(len(values), -1)
    total = np.stack([np.bincount(group, column, minlength=groups) for column in flat.T], axis=-1)
    return total.reshape(groups, *values.shape[1:])


def _median(values: Float[np.ndarray, " echoes"]) -> float:
    return float(np.median(values)) if len(values) else 0.0
