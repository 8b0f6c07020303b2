"""Noise models of odometry: standard deviations of the steps between scans."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.se2 import relative
from jaxsonar.hardware.errors import SonarError

OdometryNoiseModel = Callable[[Float[np.ndarray, "scans 3"], Int[np.ndarray, " rows"]], Float[np.ndarray, "_ 3"]]
"""Standard deviations of odometry steps.

Arguments: measured poses of all scans (NaN where there are none), and the rows of the scans that are used. Result:
for each step between used scans, in its first frame, the standard deviations forward and to the left (metres) and of
the rotation (radians)."""


@dataclass(frozen=True)
class ProportionalNoise:
    """Errors in proportion to displacement and rotation of a step, regardless of how a motion is divided into steps."""

    fraction: float
    """Standard deviation as a fraction of displacement and rotation."""
    min_position_sd: float = 0.0005
    """Standard deviation of the displacement of a robot that stands still, metres. Chosen by hand."""
    min_heading_sd: float = 0.001
    """Standard deviation of the rotation of a robot that stands still, radians. Chosen by hand."""
    rotation_per_meter: float = 0.5
    """Rotation, in radians, whose error equals the heading error of a straight metre. Chosen by hand."""

    def __call__(
        self, measured: Float[np.ndarray, "scans 3"], rows: Int[np.ndarray, " rows"]
    ) -> Float[np.ndarray, "_ 3"]:
        """See ``OdometryNoiseModel``."""
        step = relative(measured[rows[:-1]], measured[rows[1:]])
        distance, rotation = np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2])
        position = self.fraction * distance + self.min_position_sd
        heading = self.fraction * (rotation + self.rotation_per_meter * distance) + self.min_heading_sd
        return np.stack([position, position, heading], axis=-1)


@dataclass(frozen=True)
class OdometryNoise:
    """Odometry as a random walk: variances grow with the distance, so that the division into steps is irrelevant.

    Raises:
        SonarError: a value outside the allowed range.
    """

    position_per_meter: float = 0.03
    """Standard deviation of the forward displacement after one metre, metres; half as much sideways, as wheels roll."""
    heading_per_meter: float = float(np.radians(1.5))
    """Standard deviation of the heading after one metre, radians."""
    heading_per_radian: float = 0.03
    """Standard deviation of the heading after a rotation by one radian, radians."""
    minimum: tuple[float, float] = (2e-4, 2e-4)
    """Smallest standard deviations of displacement and rotation of any step, metres and radians."""

    def __post_init__(self):
        for name in ("position_per_meter", "heading_per_meter", "heading_per_radian"):
            value = getattr(self, name)
            if not 0 <= value <= 10:  # False for NaN
                raise SonarError(f"odometry_noise: {name} {value:g}; allowed is 0 to 10 (metres or radians)")
        if not all(0 < value <= 1 for value in self.minimum):
            raise SonarError(f"odometry_noise: minimum {self.minimum}; allowed are metres and radians in (0, 1]")

    def __call__(
        self, measured: Float[np.ndarray, "scans 3"], rows: Int[np.ndarray, " rows"]
    ) -> Float[np.ndarray, "_ 3"]:
        """See ``OdometryNoiseModel``. Distances are measured along all scans, whether they are used or not."""
        known = np.flatnonzero(np.isfinite(measured).all(axis=1))
        step = relative(measured[known[:-1]], measured[known[1:]])
        increments = np.zeros((len(measured), 2))
        increments[known[1:], 0], increments[known[1:], 1] = np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2])
        distance, rotation = np.diff(np.cumsum(increments, axis=0)[rows], axis=0).T
        variance = self.position_per_meter**2 * distance
        forward = np.sqrt(variance + self.minimum[0] ** 2)
        left = np.sqrt(variance / 4 + self.minimum[0] ** 2)
        heading_variance = self.heading_per_meter**2 * distance + self.heading_per_radian**2 * rotation
        return np.stack([forward, left, np.sqrt(heading_variance + self.minimum[1] ** 2)], axis=-1)


UNKNOWN_STEP_SD = (0.3, 0.3)
"""Standard deviations of the motion between scans without odometry, metres and radians. Chosen by hand."""


def step_variance(odometry_noise: OdometryNoise, step: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Variances of one odometry step in its first frame: (forward, left) in square metres, and square radians.

    Args:
        odometry_noise: noise model of the odometry.
        step: the next pose in the frame of the one before; NaN where it was not measured.
    """
    if not np.isfinite(step).all():
        return np.square([UNKNOWN_STEP_SD[0], UNKNOWN_STEP_SD[0], UNKNOWN_STEP_SD[1]])
    sd = odometry_noise(np.stack([np.zeros(3), step]), np.arange(2))[0]
    return np.square(sd)
