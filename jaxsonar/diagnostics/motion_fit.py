"""Scale of the ranges and time offset between echoes and poses, estimated jointly with local walls."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar.diagnostics.local_reflectors import (
    EchoGroups,
    LocalReflectors,
    biweight,
    find_reflectors,
    residual_noise,
)
from jaxsonar.sensors.range_models import PredictedRange, predict_ranges

SCALE, LAG = 0, 1


@dataclass(frozen=True)
class MotionFitSettings:
    """Constants of the estimation. Chosen by hand."""

    iterations: int = 6
    """Iterations of the reweighted least squares, ..."""
    rounds: int = 3
    """... after which the echoes are assigned again, this many times."""
    time_step: float = 0.02
    """Half the time over which the motion of the robot is differentiated, seconds."""
    prior_information: float = 1e-3
    """Added to the information of walls and points."""
    min_information: float = 1e-2
    """Information (sum of squared derivatives) from which on a parameter is observable."""
    largest_step: tuple[float, float] = (0.1, 0.2)
    """Largest change of scale and time offset (seconds) in one iteration."""
    min_groups: int = 4
    """Groups of scans that an estimate needs; their scatter gives its standard error."""


SETTINGS = MotionFitSettings()


@dataclass(frozen=True, eq=False)
class MotionFit:
    """Scale of the ranges and time offset that make the echoes of a moving robot agree."""

    estimate: Float[np.ndarray, " 2"]
    """Corrected range divided by true range, minus 1; and the time after an echo at which the poses of the log fit,
    seconds. NaN where it cannot be estimated."""
    error: Float[np.ndarray, " 2"]
    """Standard errors by the scatter between groups of scans (jackknife)."""
    noise: float
    """Robust standard deviation of the residuals, metres."""
    explained: int
    """Echoes that walls and points explain."""
    echoes: int
    """All echoes."""
    max_range: float
    """Maximum range of the ring, metres."""

    @property
    def log_likelihood(self) -> float:
        """Explained echoes are normally distributed, the others have any range; nats."""
        return self.explained * float(np.log(self.max_range / (self.noise * np.sqrt(2 * np.pi * np.e))))


def fit_motion(groups: EchoGroups, *, lag: float = 0.0, free: tuple[bool, bool] = (True, True)) -> MotionFit | None:
    """Estimate the scale of the ranges and the time offset between echoes and poses.

    Args:
        groups: echoes of groups of scans.
        lag: time offset at which the search begins, seconds.
        free: whether each of the two is estimated; the others stay 0 and ``lag``.

    Returns:
        The estimates; None if there are too few groups with walls.
    """
    value, fit = np.array([0.0, lag]), None
    for _ in range(SETTINGS.rounds):
        found = find_reflectors(replace(groups, range=groups.range / (1 + value[SCALE])), _poses(groups, value[LAG]))
        if len(np.unique(found.group)) < SETTINGS.min_groups:
            return None
        fit = _solve(groups, found, value, np.array(free))
        value = np.where(np.isfinite(fit.estimate), fit.estimate, value)
    return fit


def _poses(groups: EchoGroups, lag: float) -> Float[np.ndarray, "echoes 3"]:
    return groups.poses_after(lag) if lag and groups.has_times else groups.pose


def _solve(
    groups: EchoGroups, found: LocalReflectors, start: Float[np.ndarray, " 2"], free: Bool[np.ndarray, " 2"]
) -> MotionFit:
    """Robust least squares over all reflectors and the two parameters; the reflectors are eliminated (Schur)."""
    value, landmark, echo = start.copy(), found.parameters.copy(), found.echo
    kind, path, measured = found.kind[found.reflector], groups.path[echo], groups.range[echo]
    count, group = groups.count, found.group[found.reflector]
    information, gradient, noise, weight = np.zeros((count, 2, 2)), np.zeros((count, 2)), 0.0, np.ones(len(echo))

    def predict(lag: float) -> PredictedRange:
        pose = _poses(groups, lag)[echo]
        return predict_ranges(kind, landmark[found.reflector], *groups.geometry(pose, path))

    for _ in range(SETTINGS.iterations):
        predicted = predict(value[LAG])
        factor = 1 + value[SCALE]
        residual = measured - factor * predicted.range
        noise = residual_noise(residual)
        weight = biweight(residual, noise)
        d_landmark, d_value = factor * predicted.d_range_d_landmark, np.zeros((len(echo), 2))
        d_value[:, SCALE] = predicted.range  # not the measured range: its noise would bias the estimate
        if groups.has_times:
            step = SETTINGS.time_step
            change = predict(value[LAG] + step).range - predict(value[LAG] - step).range
            d_value[:, LAG] = factor * change / (2 * step)
        block = _sum_by(found.reflector, weight[:, None, None] * _outer(d_landmark, d_landmark), len(landmark))
        coupling = _sum_by(found.reflector, weight[:, None, None] * _outer(d_landmark, d_value), len(landmark))
        pull = _sum_by(found.reflector, (weight * residual)[:, None] * d_landmark, len(landmark))
        cov = np.linalg.inv(block + SETTINGS.prior_information * np.eye(2))
        reduced = np.einsum("wik,wij->wkj", coupling, cov)
        information = _sum_by(group, weight[:, None, None] * _outer(d_value, d_value), count)
        information -= _sum_by(found.group, reduced @ coupling, count)
        gradient = _sum_by(group, (weight * residual)[:, None] * d_value, count)
        gradient -= _sum_by(found.group, (reduced @ pull[..., None])[..., 0], count)
        step = _solution(information.sum(axis=0), gradient.sum(axis=0), free)
        landmark += np.einsum("wij,wj->wi", cov, pull - coupling @ step)
        value += step
    estimate, error = _jackknife(information, gradient, value, free)
    return MotionFit(estimate, error, noise, int((weight > 0).sum()), len(groups.path), groups.ring.max_range)


def _solution(
    information: Float[np.ndarray, "2 2"], gradient: Float[np.ndarray, " 2"], free: Bool[np.ndarray, " 2"]
) -> Float[np.ndarray, " 2"]:
    """Step of the free parameters that are observable; 0 for the others."""
    step = np.zeros(2)
    which = np.flatnonzero(free & (np.diag(information) > SETTINGS.min_information))
    step[which] = np.linalg.solve(information[np.ix_(which, which)], gradient[which]) if len(which) else 0
    return np.clip(step, -np.array(SETTINGS.largest_step), SETTINGS.largest_step)


def _jackknife(
    information: Float[np.ndarray, "groups 2 2"],
    gradient: Float[np.ndarray, "groups 2"],
    value: Float[np.ndarray, " 2"],
    free: Bool[np.ndarray, " 2"],
) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]:
    """Estimates, and their standard errors from the estimates without one group each; NaN where not observable."""
    total, pull = information.sum(axis=0), gradient.sum(axis=0)
    count = len(information)
    left = np.array([_solution(total - a, pull - g, free) for a, g in zip(information, gradient, strict=True)])
    error = np.sqrt((count - 1) / count * ((left - left.mean(axis=0)) ** 2).sum(axis=0))
    known = ~free | (np.diag(total) > SETTINGS.min_information)
    return np.where(known, value, np.nan), np.where(known, error, np.nan)


def _outer(a: Float[np.ndarray, "rows n"], b: Float[np.ndarray, "rows m"]) -> Float[np.ndarray, "rows n m"]:
    return a[:, :, None] * b[:, None, :]


def _sum_by(group: np.ndarray, values: np.ndarray, groups: int) -> np.ndarray:
    total = np.zeros((groups, *values.shape[1:]))
    np.add.at(total, group, values)
    return total
