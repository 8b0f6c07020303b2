"""Scale of the ranges and time offset between echoes and poses, estimated jointly with local walls."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar.geometry.se2 import perpendicular, wrap_angle
from jaxsonar.registration.local_reflectors import (
    LocalReflectors,
    PosedEchoes,
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
    rounds: int = 2
    """... after which the echoes are assigned again, this many times."""
    time_step: float = 0.02
    """Half the time over which the motion of the robot is differentiated, seconds."""
    prior_information: float = 1e-2
    """Added to the information of walls, points and poses."""
    most_fitted: float = 0.5
    """Largest share of the degrees of freedom that walls, points and poses take from the residuals."""
    min_noise: float = 0.002
    """Least standard deviation of the ranges, metres."""
    first_noise: float = 0.02
    """Standard deviation of the residuals at the beginning, metres."""
    odometry: tuple[float, float] = (0.01, float(np.radians(0.5)))
    """Errors of odometry after one metre, standard deviations, metres and radians."""
    odometry_floor: tuple[float, float] = (0.0005, float(np.radians(0.05)))
    """Errors of a short step of it."""
    slip: float = 0.01
    """Error of a turn, as a share of it."""
    known_errors: float = 10.0
    """Confidence in these errors of odometry: they count like this many errors that were observed."""
    min_information: float = 1.0
    """Information (inverse variance) from which on a parameter is observable."""
    largest_step: tuple[float, float] = (0.1, 0.2)
    """Largest change of scale and time offset (seconds) in one iteration."""
    min_groups: int = 4
    """Groups of scans that an estimate needs."""


SETTINGS = MotionFitSettings()


@dataclass(frozen=True, eq=False)
class MotionFit:
    """Scale of the ranges and time offset that make the echoes of a moving robot agree."""

    estimate: Float[np.ndarray, " 2"]
    """Corrected range divided by true range, minus 1; and the time after an echo at which the poses of the log fit,
    seconds. NaN where it cannot be estimated."""
    error: Float[np.ndarray, " 2"]
    """Standard errors, from the noise, the odometry, and the scatter between groups of scans."""
    groups: Float[np.ndarray, " 2"]
    """Number of groups of scans that the estimates rest on, each counted by its share of the information."""
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


def fit_motion(
    groups: PosedEchoes, *, scale: float = 0.0, lag: float = 0.0, free: tuple[bool, bool] = (True, True)
) -> MotionFit | None:
    """Estimate the scale of the ranges and the time offset between echoes and poses.

    Args:
        groups: echoes of groups of scans.
        scale: scale error at which the search begins.
        lag: time offset at which it begins, seconds.
        free: whether each of the two is estimated; the others stay ``scale`` and ``lag``.

    Returns:
        The estimates; None if there are too few groups with walls.
    """
    value, fit, everything = np.array([scale, lag]), None, np.arange(len(groups.path))
    for _ in range(SETTINGS.rounds):
        found = find_reflectors(
            replace(groups, range=groups.range / (1 + value[SCALE])), groups.poses_after(value[LAG], everything)
        )
        if len(np.unique(found.group)) < SETTINGS.min_groups:
            return None
        fit = _solve(groups, found, value, np.array(free))
        value = np.where(np.isfinite(fit.estimate), fit.estimate, value)
    return fit


def _solve(
    groups: PosedEchoes, found: LocalReflectors, start: Float[np.ndarray, " 2"], free: Bool[np.ndarray, " 2"]
) -> MotionFit:
    """Robust least squares over reflectors, poses and the two parameters."""
    value, parts = start.copy(), [_Part(groups, found, number) for number in np.unique(found.group).tolist()]
    noise, drift, residual = SETTINGS.first_noise, 1.0, np.zeros(0)
    reduced: list[tuple[np.ndarray, np.ndarray]] = []
    for _ in range(SETTINGS.iterations):
        reduced = [part.reduced_system(value, noise, drift) for part in parts]
        total, pull = (np.sum(one, axis=0) for one in zip(*reduced, strict=True))
        step = _solution(total, pull, free)
        for part in parts:
            part.move(step)
        value += step
        residual = np.concatenate([part.residual(value) for part in parts])
        # Reflectors and poses adapt to the noise: the residuals are smaller than it.
        left = 1 - min(sum(part.fitted for part in parts) / len(residual), SETTINGS.most_fitted)
        noise = max(residual_noise(residual) / np.sqrt(left), SETTINGS.min_noise)
        # The corrections of the poses show how good the odometry is, as far as they are observed.
        strain, observed = sum(part.strain for part in parts), sum(part.observed for part in parts)
        drift = max((strain + SETTINGS.known_errors) / (observed + SETTINGS.known_errors), 1.0)
    scatter = residual_noise(residual)
    explained = int((biweight(residual, scatter) > 0).sum())
    information, gradient = (np.array(one) for one in zip(*reduced, strict=True))
    estimate, error, count = _errors(information, gradient, value, free)
    return MotionFit(estimate, error, count, scatter, explained, len(groups.path), groups.ring.max_range)


class _Part:
    """One group of scans: its echoes, reflectors, and corrections of its poses."""

    def __init__(self, groups: PosedEchoes, found: LocalReflectors, number: int):
        """Take the echoes and the reflectors of a group."""
        own = found.group == number
        self.groups, self.kind, self.landmark = groups, found.kind[own], found.parameters[own].copy()
        of_group = own[found.reflector]
        self.echo = found.echo[of_group]
        self.reflector = np.cumsum(own)[found.reflector[of_group]] - 1
        self.path, self.measured = groups.path[self.echo], groups.range[self.echo]
        rows, first, self.scan = np.unique(groups.scan[self.echo], return_index=True, return_inverse=True)
        self.correction = np.zeros((len(rows), 3))
        self.prior = _odometry_information(groups.pose[self.echo[first]])
        self.fitted = 0.0
        self.observed = 0.0
        self.system: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def residual(self, value: Float[np.ndarray, " 2"]) -> Float[np.ndarray, " echoes"]:
        """Measured minus predicted ranges, metres."""
        return self.measured - (1 + value[SCALE]) * self._predict(value[LAG])[0].range

    @property
    def strain(self) -> float:
        """Weighted sum of squares of the corrections of the poses."""
        return float(self.correction.ravel() @ self.prior @ self.correction.ravel())

    def _predict(self, lag: float) -> tuple[PredictedRange, Float[np.ndarray, "echoes 3"]]:
        pose = self.groups.poses_after(lag, self.echo) + self.correction[self.scan]
        geometry = self.groups.geometry(pose, self.path)
        predicted = predict_ranges(self.kind[self.reflector], self.landmark[self.reflector], *geometry)
        lever = perpendicular(geometry[0] - pose[:, :2])
        turning = (predicted.d_range_d_midpoint * lever).sum(axis=-1)
        turning += (predicted.d_range_d_half_baseline * perpendicular(geometry[1])).sum(axis=-1)
        return predicted, np.column_stack([predicted.d_range_d_midpoint, turning])

    def reduced_system(
        self, value: Float[np.ndarray, " 2"], noise: float, drift: float
    ) -> tuple[Float[np.ndarray, "2 2"], Float[np.ndarray, " 2"]]:
        """Normal equations of the two parameters; reflectors and poses are eliminated (Schur complement).

        ``drift`` is the variance of the odometry divided by the assumed one.
        """
        predicted, d_pose = self._predict(value[LAG])
        factor, row = 1 + value[SCALE], np.arange(len(self.echo))
        residual = self.measured - factor * predicted.range
        weight = biweight(residual, noise) / noise**2
        poses, landmarks = self.correction.size, self.landmark.size
        jacobian = np.zeros((len(row), poses + landmarks + 2))
        for k in range(3):
            jacobian[row, 3 * self.scan + k] = factor * d_pose[:, k]
        for k in range(2):
            jacobian[row, poses + 2 * self.reflector + k] = factor * predicted.d_range_d_landmark[:, k]
        # Not the measured range: its noise would bias the estimate.
        jacobian[:, poses + landmarks + SCALE] = predicted.range
        if self.groups.has_times:
            step = SETTINGS.time_step
            change = self._predict(value[LAG] + step)[0].range - self._predict(value[LAG] - step)[0].range
            jacobian[:, poses + landmarks + LAG] = factor * change / (2 * step)
        information = jacobian.T @ (weight[:, None] * jacobian)
        gradient = jacobian.T @ (weight * residual)
        own, rest = slice(0, poses + landmarks), slice(poses + landmarks, None)
        data = information[own, own].copy()
        prior = self.prior / drift
        information[:poses, :poses] += prior
        gradient[:poses] -= prior @ self.correction.ravel()
        information[own, own] += SETTINGS.prior_information * np.eye(poses + landmarks)
        cov = np.linalg.inv(information[own, own])
        self.fitted = float((cov * data).sum())
        self.observed = poses - float((cov[:poses, :poses] * prior).sum())
        coupling = information[own, rest]
        self.system = cov, coupling, gradient[own]
        return information[rest, rest] - coupling.T @ cov @ coupling, gradient[rest] - coupling.T @ cov @ gradient[own]

    def move(self, step: Float[np.ndarray, " 2"]) -> None:
        """Change reflectors and poses after a step of the two parameters."""
        if self.system is None:
            return
        cov, coupling, gradient = self.system
        change = cov @ (gradient - coupling @ step)
        self.correction += change[: self.correction.size].reshape(-1, 3)
        self.landmark += change[self.correction.size :].reshape(-1, 2)


def _odometry_information(pose: Float[np.ndarray, "scans 3"]) -> Float[np.ndarray, "corrections corrections"]:
    """Information of the corrections of consecutive poses with odometry between them; the middle one is fixed."""
    total = np.zeros((3 * len(pose), 3 * len(pose)))
    middle = 3 * (len(pose) // 2) + np.arange(3)
    total[middle, middle] = 1 / np.array(SETTINGS.odometry_floor)[[0, 0, 1]] ** 2
    for k, (before, after) in enumerate(pairwise(pose)):
        way = after[:2] - before[:2]
        travelled, turn = np.hypot(*way), abs(wrap_angle(after[2] - before[2]))
        place = SETTINGS.odometry_floor[0] ** 2 + SETTINGS.odometry[0] ** 2 * travelled
        angle = SETTINGS.odometry_floor[1] ** 2 + SETTINGS.odometry[1] ** 2 * travelled + (SETTINGS.slip * turn) ** 2
        jacobian = np.zeros((3, 6))
        jacobian[:, 3:] = np.eye(3)
        jacobian[:, :3] = -np.eye(3)
        jacobian[:2, 2] = -perpendicular(way)
        total[3 * k : 3 * k + 6, 3 * k : 3 * k + 6] += (
            jacobian.T @ np.diag([1 / place, 1 / place, 1 / angle]) @ jacobian
        )
    return total


def _solution(
    information: Float[np.ndarray, "2 2"], gradient: Float[np.ndarray, " 2"], free: Bool[np.ndarray, " 2"]
) -> Float[np.ndarray, " 2"]:
    """Step of the free parameters that are observable; 0 for the others."""
    step = np.zeros(2)
    which = np.flatnonzero(free & (np.diag(information) > SETTINGS.min_information))
    step[which] = np.linalg.solve(information[np.ix_(which, which)], gradient[which]) if len(which) else 0
    return np.clip(step, -np.array(SETTINGS.largest_step), SETTINGS.largest_step)


def _errors(
    information: Float[np.ndarray, "groups 2 2"],
    gradient: Float[np.ndarray, "groups 2"],
    value: Float[np.ndarray, " 2"],
    free: Bool[np.ndarray, " 2"],
) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]:
    """Estimates, standard errors, and the number of groups that they rest on; NaN where not observable.

    Errors of the poses are common to a group. The groups are therefore the independent observations: the standard
    errors are the larger ones of the least squares and of the jackknife, which leaves out one group after the other.
    """
    total = information.sum(axis=0)
    known = np.diag(total) > SETTINGS.min_information
    which, error, groups = np.flatnonzero(free & known), np.zeros(2), np.full(2, np.inf)
    if len(which):
        own, pull = information[:, which[:, None], which], gradient[:, which]
        cov = np.linalg.inv(total[np.ix_(which, which)])
        rest = total[np.ix_(which, which)] - own + 1e-9 * np.eye(len(which))
        without = np.linalg.solve(rest, (pull.sum(axis=0) - pull)[..., None])[..., 0]
        spread = ((without - without.mean(axis=0)) ** 2).sum(axis=0) * (1 - 1 / len(own))
        error[which] = np.sqrt(np.maximum(np.diag(cov), spread))
        share = np.einsum("ij,gji->gi", cov, own)
        groups[which] = 1 / np.maximum((share**2).sum(axis=0), 1e-12)
    absent = free & ~known
    return np.where(absent, np.nan, value), np.where(absent, np.nan, error), np.where(absent, 0, groups)
