"""Adjustment of poses and walls to echoes of real rooms: heavy tails, uneven walls, correlated echoes.

Walls of real rooms are not plane: door frames, skirting and posters stand out by some centimetres. Echoes of one path
from one stretch of a wall have this error in common, so that many of them determine the wall hardly better than one.
Persons and reflections are tails of the distribution of the ranges (Student's t); slipping wheels are tails of that of
the odometry.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.estimation.adjustment_state import AdjustmentResult, AdjustmentState
from jaxsonar.estimation.batch_data import BatchData
from jaxsonar.estimation.robust_adjustment import SETTINGS as GNC_SETTINGS
from jaxsonar.estimation.robust_adjustment import RobustAdjustment
from jaxsonar.geometry.robust_statistics import robust_deviation, student_weights
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_parameters import ParameterBasis


@dataclass(frozen=True)
class HeavyTailSettings:
    """Constants of the adjustment. Chosen by hand on the parts of one recorded run, and checked on those of another."""

    gate: float = 0.3
    """Largest residual of an echo of a wall, metres."""
    range_dof: float = 3.0
    """Degrees of freedom of Student's distribution of the ranges."""
    odometry_dof: float = 4.0
    """The same of the rotations of the odometry."""
    relief: float = 0.025
    """Usual standard deviation of the surface of a wall from a plane, metres, ..."""
    relief_groups: float = 4.0
    """... which counts like that of so many groups of echoes."""
    relief_factor: float = 2.0
    """Standard deviation of the surface over that of the mean residuals of groups: walls and poses adapt to them."""
    stretch: tuple[float, float] = (0.6, float(np.radians(30.0)))
    """Motion of the robot, metres or radians, during which it sees the same surface."""
    iterations: int = 6
    """Reweighted least-squares adjustments, with a new association each."""
    min_sigma: float = 1e-5
    """Least standard deviation of the ranges, metres; it is at least that of their rounding."""


SETTINGS = HeavyTailSettings()


class _Weights(NamedTuple):
    """Echoes of walls, and their inverse variances."""

    weight: Float[np.ndarray, "scans echoes"]
    """1 / square metres."""
    sigma: float
    """Robust standard deviation of the ranges, metres."""
    pairs: int
    """Number of pairs of echoes that it was estimated from; 0 if it was given."""
    relief: float
    """Estimated standard deviation of the surface of walls from planes, metres."""


def heavy_tailed_adjust(
    ring: Ring,
    data: BatchData,
    basis: ParameterBasis,
    state: AdjustmentState,
    *,
    sigma: float | None = None,
    settings: HeavyTailSettings = SETTINGS,
) -> AdjustmentResult:
    """Adjust ring parameters, poses and walls. To be called with 64-bit floats enabled.

    Args:
        ring: the ring at coordinates 0.
        data: the measurements of one log, with odometry.
        basis: basis of the ring parameters.
        state: initial values; the landmarks are walls.
        sigma: standard deviation of the range noise, metres; estimated if left out.
        settings: constants of the algorithm.
    """
    stretch = _stretches(data, settings)
    least = max(settings.min_sigma, _resolution(data.reported) / np.sqrt(12))
    information, relief, result = data.odometry_information, settings.relief, None
    for _ in range(settings.iterations):
        job = RobustAdjustment(ring, data, basis, poses_free=True, settings=GNC_SETTINGS)
        # 1. The wall of each echo, and the weight of the echo.
        used, candidate, reflection, _, _ = job.associate(state, gate=settings.gate, ambiguity=0.0)
        residual = job.residual(state, reflection)
        group = stretch[:, None], np.asarray(reflection.first), data.path
        found = _weights(residual, used, group, sigma, least, relief, settings)
        relief = found.relief
        # 2. Least squares.
        state, problem, solution = job.adjust(state, reflection, found.weight)
        # 3. Rotations that the odometry measures badly count less.
        turn = np.asarray(kernels.odometry_residuals(problem, solution.unknowns))[:, 2]
        heading = information.copy()
        heading[: len(turn), 2] *= student_weights(turn**2 * information[: len(turn), 2], settings.odometry_dof)
        data = replace(data, odometry_information=heading)
        residual = np.where(used, job.residual(state, reflection), 0)
        result = AdjustmentResult(state, problem, solution, used, candidate, residual, found.sigma, found.pairs)
    assert result is not None
    return result


def _weights(
    residual: Float[np.ndarray, "scans echoes"],
    used: Bool[np.ndarray, "scans echoes"],
    group: tuple[Int[np.ndarray, "scans #echoes"], ...],
    sigma: float | None,
    least: float,
    relief: float,
    settings: HeavyTailSettings,
) -> _Weights:
    """Inverse variances of the echoes that walls explain.

    ``count`` echoes of one path, wall and stretch have the variance sigma^2 / count + relief^2 together. They have the
    error of the wall and of the poses in common, so that their differences show the noise of the ranges.
    """
    key = np.stack([np.broadcast_to(one, used.shape)[used] for one in group])
    _, same, count = np.unique(key, axis=1, return_inverse=True, return_counts=True)
    same, off = same.ravel(), residual[used]
    order = np.argsort(same, kind="stable")  # the echoes of a group in the order of the scans
    change = np.diff(off[order])[np.diff(same[order]) == 0]
    noise, pairs = sigma, 0
    if noise is None:
        noise, pairs = max(robust_deviation(change, center=0.0) / float(np.sqrt(2)), least), len(change)
    tail = student_weights(off**2 / (noise**2 + relief**2), settings.range_dof)
    mean = np.bincount(same, tail * off) / np.maximum(np.bincount(same, tail), 1e-12)
    relief = _relief(mean, relief, settings)
    weight = np.zeros(residual.shape)
    weight[used] = tail / (noise**2 + count[same] * relief**2)
    return _Weights(weight, noise, pairs, relief)


def _relief(mean: Float[np.ndarray, " groups"], start: float, settings: HeavyTailSettings) -> float:
    """Standard deviation of the surface of walls, metres, from the mean residuals of groups of echoes."""
    spread = start / settings.relief_factor
    for _ in range(settings.iterations):
        weight = student_weights((mean / spread) ** 2, settings.range_dof)
        squares = settings.relief_groups * (settings.relief / settings.relief_factor) ** 2 + (weight * mean**2).sum()
        spread = float(np.sqrt(squares / (settings.relief_groups + len(mean))))
    return settings.relief_factor * spread


def _resolution(reported: Float[np.ndarray, "scans echoes"]) -> float:
    """Step to which ranges are rounded, metres: the smallest difference of two of them, as far as floats show it."""
    steps = np.diff(np.unique(np.round(reported[np.isfinite(reported)], 6)))
    return float(steps.min(initial=np.inf)) if len(steps) else 0.0


def _stretches(data: BatchData, settings: HeavyTailSettings) -> Int[np.ndarray, " scans"]:
    """Number of the stretch of the trajectory of each scan, by the odometry."""
    length = np.hypot(data.odometry[:, 0], data.odometry[:, 1]) / settings.stretch[0]
    turn = np.abs(wrap_angle(data.odometry[:, 2])) / settings.stretch[1]
    motion = np.append(0.0, np.cumsum(length + turn)[:-1])
    return np.floor(motion).astype(np.int64)
