"""Range offsets of a ring from echoes at walls, at a given scale: robust least squares with errors from a jackknife.

A wall takes up what is common to the sensors that see it. What remains are the differences between these sensors. The
mean range offset is not determined: walls that are farther away give the same ranges.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.calibration.settings import SPARSE_SETTINGS as SETTINGS
from jaxsonar.calibration.wall_echoes import WallEchoes
from jaxsonar.geometry.robust_statistics import student_weights
from jaxsonar.geometry.se2 import rotate, transform_points
from jaxsonar.hardware.messages import REFERENCE_SPEED_OF_SOUND
from jaxsonar.sensors.range_models import plane_range

_HELD = 1e-7
"""Standard deviation of a parameter that is held, metres or relative."""


@dataclass(frozen=True, eq=False)
class OffsetFit:
    """Range offsets relative to the nominal ring."""

    offset: Float[np.ndarray, " sensors"]
    """Change of the range offset of every sensor, metres; their mean is 0."""
    covariance: Float[np.ndarray, "parameters parameters"]
    """Covariance of the offsets (metres) and of the logarithm of the speed of sound, as far as it is uncertain."""
    mean_offset_sd: float
    """Standard deviation of the mean range offset if it were estimated, metres."""
    plane: Float[np.ndarray, "walls 2"]
    """Shift (metres) and rotation (radians) of every wall of ``WallEchoes``."""
    residual: Float[np.ndarray, " echoes"]
    """Reported minus predicted ranges, metres."""
    distance: Float[np.ndarray, " echoes"]
    """Predicted half path lengths, metres."""
    sigma: float
    """Scale of the t distribution of the residuals, metres."""


class _Elimination(NamedTuple):
    """Normal equations of the offsets and of the log speed after the walls are eliminated."""

    information: Float[np.ndarray, "parameters parameters"]
    gradient: Float[np.ndarray, " parameters"]
    inverse: Float[np.ndarray, "walls 2 2"]
    coupling: Float[np.ndarray, "walls 2 parameters"]
    pull: Float[np.ndarray, "walls 2"]


def fit_offsets(
    echoes: WallEchoes, *, log_speed: float, log_speed_sd: float = 0.0, free: bool, sigma: float | None
) -> OffsetFit:
    """Range offsets at a given scale, whose error is taken into account.

    Args:
        echoes: echoes at walls.
        log_speed: logarithm of the speed of sound relative to the nominal ring.
        log_speed_sd: its standard deviation. Otherwise offsets would take up the error of the scale.
        free: whether offsets are estimated; otherwise only the walls are.
        sigma: scale of the residuals, metres; None: estimated.
    """
    system, count = _WallSystem(echoes, log_speed), echoes.ring.count
    prior = _prior(count, free=free, mean_sd=_HELD, log_speed_sd=log_speed_sd)
    # 1. Least squares, and the overdispersion of the offsets by a jackknife over stretches of the trajectory.
    value, scale = system.solve(np.zeros(count + 1), prior, 1.0, sigma)
    dispersion = _dispersion(system, value, scale, prior) if free else 1.0
    # 2. Least squares with the errors that the jackknife shows: offsets that rest on single walls stay near the prior.
    value, scale = system.solve(value, prior, dispersion, sigma)
    information = system.eliminate(value, scale).information / dispersion
    free_mean = _prior(count, free=free, mean_sd=SETTINGS.mean_offset_sd, log_speed_sd=log_speed_sd)
    # 3. The walls that go with these offsets and the given scale.
    value[-1] = 0
    scale = system.settle(value, sigma)
    return OffsetFit(
        value[:-1],
        np.linalg.inv(information + prior),
        float(np.sqrt(np.linalg.inv(information + free_mean)[:-1, :-1].mean())),
        system.plane,
        system.residual(value),
        system.distance,
        scale,
    )


def _dispersion(
    system: "_WallSystem",
    value: Float[np.ndarray, " parameters"],
    scale: float,
    prior: Float[np.ndarray, "parameters parameters"],
) -> float:
    """Variance of the estimated offsets between stretches of the trajectory, divided by that of independent errors."""
    travelled = system.echoes.travelled
    length = max(SETTINGS.jackknife, float(np.ptp(travelled)) / SETTINGS.most_stretches)
    stretch = np.floor(travelled / length).astype(int)
    others = []
    for one in np.unique(stretch).tolist():
        rest = system.eliminate(value, scale, stretch != one)
        others.append(np.linalg.solve(rest.information + prior, rest.gradient - prior @ value)[:-1])
    data = system.eliminate(value, scale).information
    covariance = np.linalg.inv(data + prior)
    expected = float(np.trace((covariance @ data @ covariance)[:-1, :-1]))
    found = float(np.var(others, axis=0).sum() * (len(others) - 1))
    return max(found / max(expected, 1e-12), 1.0)


class _WallSystem:
    """Echoes at walls with exact poses, and the state of the walls."""

    def __init__(self, echoes: WallEchoes, log_speed: float):
        """Compute what does not change in the iterations."""
        self.echoes, paths = echoes, echoes.ring.exact_paths
        midpoint = transform_points(echoes.pose, np.asarray(paths.midpoint)[echoes.path])
        # The frame of a wall has the axes of the world and its middle as origin.
        self.midpoint = midpoint - echoes.center[echoes.wall]
        self.half_baseline = rotate(np.asarray(paths.half_baseline)[echoes.path], echoes.pose[:, 2])
        self.sensors: Float[np.ndarray, "echoes sensors"] = np.eye(echoes.ring.count)[
            echoes.ring.paths[echoes.path]
        ].mean(axis=1)
        self.nominal_offset = self.sensors @ np.asarray(echoes.ring.range_offset)
        self.factor = REFERENCE_SPEED_OF_SOUND / float(echoes.ring.speed_of_sound) * np.exp(-log_speed)
        self.plane = np.zeros((len(echoes.center), 2))

    def solve(
        self,
        value: Float[np.ndarray, " parameters"],
        prior: Float[np.ndarray, "parameters parameters"],
        dispersion: float,
        sigma: float | None,
    ) -> tuple[Float[np.ndarray, " parameters"], float]:
        """Robust least squares over ring and walls. Returns the parameters of the ring and the scale of the residuals.

        Args:
            value: parameters at the beginning: offsets (metres), and change of the log speed of sound.
            prior: their prior information.
            dispersion: factor of the variance that the echoes give them.
            sigma: scale of the residuals, metres; None: estimated.
        """
        scale = SETTINGS.first_noise if sigma is None else sigma
        for _ in range(SETTINGS.iterations):
            # Eliminate the walls, solve for the ring, and substitute back.
            found = self.eliminate(value, scale)
            gradient = found.gradient / dispersion - prior @ value
            step = np.linalg.solve(found.information / dispersion + prior, gradient)
            self._move(found, step)
            value = value + step
            scale = self._scale(value, scale) if sigma is None else sigma
        return value, scale

    def settle(self, value: Float[np.ndarray, " parameters"], sigma: float | None) -> float:
        """Robust least squares over the walls for a given ring. Returns the scale of the residuals, metres."""
        scale = SETTINGS.first_noise if sigma is None else sigma
        for _ in range(SETTINGS.iterations):
            self._move(self.eliminate(value, scale), np.zeros_like(value))
            scale = self._scale(value, scale) if sigma is None else sigma
        return scale

    @property
    def distance(self) -> Float[np.ndarray, " echoes"]:
        """Half path lengths to the walls, metres."""
        return self._predict()[0]

    def residual(self, value: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " echoes"]:
        """Reported minus predicted ranges, metres."""
        return self._residual(value, self._predict()[0])

    def eliminate(
        self, value: Float[np.ndarray, " parameters"], sigma: float, kept: Bool[np.ndarray, " echoes"] | None = None
    ) -> _Elimination:
        """Normal equations of the ring; the walls are eliminated (Schur complement).

        Args:
            value: parameters of the ring.
            sigma: scale of the residuals, metres.
            kept: the echoes that count; all if omitted.
        """
        distance, d_plane = self._predict()
        residual, wall, factor = self._residual(value, distance), self.echoes.wall, self.factor * np.exp(-value[-1])
        weight = student_weights((residual / sigma) ** 2, SETTINGS.freedom) / sigma**2
        if kept is not None:
            weight = weight * kept
        ring = np.concatenate([self.sensors, -factor * distance[:, None]], axis=1)
        plane, walls = factor * d_plane, len(self.plane)
        of_plane = np.zeros((walls, 2, 2))
        np.add.at(of_plane, wall, weight[:, None, None] * plane[:, :, None] * plane[:, None, :])
        coupling = np.zeros((walls, 2, ring.shape[1]))
        np.add.at(coupling, wall, weight[:, None, None] * plane[:, :, None] * ring[:, None, :])
        pull = np.zeros((walls, 2))
        np.add.at(pull, wall, (weight * residual)[:, None] * plane)
        of_plane[:, 0, 0] += SETTINGS.mean_offset_sd**-2 * 1e-3  # only keeps walls without echoes regular
        of_plane[:, 1, 1] += SETTINGS.direction_sd**-2
        pull[:, 1] -= self.plane[:, 1] * SETTINGS.direction_sd**-2
        inverse = np.linalg.inv(of_plane)
        eliminated = inverse @ coupling
        return _Elimination(
            ring.T @ (weight[:, None] * ring) - np.einsum("wip,wiq->pq", coupling, eliminated),
            ring.T @ (weight * residual) - np.einsum("wip,wi->p", eliminated, pull),
            inverse,
            coupling,
            pull,
        )

    def _move(self, found: _Elimination, step: Float[np.ndarray, " parameters"]) -> None:
        """Change the walls after a step of the ring."""
        self.plane = self.plane + (found.inverse @ (found.pull - found.coupling @ step)[..., None])[..., 0]

    def _scale(self, value: Float[np.ndarray, " parameters"], scale: float) -> float:
        """The next scale of the residuals, metres (expectation maximization of the t distribution)."""
        residual = self.residual(value)
        weight = student_weights((residual / scale) ** 2, SETTINGS.freedom)
        return max(float(np.sqrt(np.mean(weight * residual**2))), SETTINGS.min_noise)

    def _predict(self) -> tuple[Float[np.ndarray, " echoes"], Float[np.ndarray, "echoes 2"]]:
        """Half path lengths, and their derivatives by shift and rotation of the walls."""
        plane = self.plane + np.stack([np.zeros(len(self.plane)), self.echoes.theta], axis=-1)
        predicted = plane_range(plane[self.echoes.wall], self.midpoint, self.half_baseline)
        return predicted.range, predicted.d_range_d_landmark

    def _residual(
        self, value: Float[np.ndarray, " parameters"], distance: Float[np.ndarray, " echoes"]
    ) -> Float[np.ndarray, " echoes"]:
        expected = self.nominal_offset + self.sensors @ value[:-1] + self.factor * np.exp(-value[-1]) * distance
        return self.echoes.reported - expected


def _prior(
    sensors: int, *, free: bool, mean_sd: float, log_speed_sd: float
) -> Float[np.ndarray, "parameters parameters"]:
    """Prior information: of the deviations of the offsets from their mean, of the mean, and of the log speed."""
    mean = np.full((sensors, sensors), 1 / sensors)
    relative = SETTINGS.relative_offset_sd if free else _HELD
    information = np.zeros((sensors + 1, sensors + 1))
    information[:-1, :-1] = (np.eye(sensors) - mean) / relative**2 + mean / (sensors * mean_sd**2)
    information[-1, -1] = max(log_speed_sd, _HELD) ** -2
    return information


def shared_wall_sensors(echoes: WallEchoes) -> Int[np.ndarray, " sensors"]:
    """Number of echoes of every sensor at walls that other sensors see as well."""
    sensor, count = echoes.ring.paths[echoes.path][:, 0], echoes.ring.count
    seen = np.zeros((len(echoes.center), count), dtype=bool)
    seen[echoes.wall, sensor] = True
    shared = seen.sum(axis=1)[echoes.wall] > 1
    return np.bincount(sensor[shared], minlength=count)
