"""How well single measurements support a wall: echoes that fit it, echoes from behind it, and silence."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jaxsonar.geometry.se2 import tangent_of, unit, wrap_angle
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.reflectors.range_measurements import RangeMeasurements


class MeasurementIndex:
    """Measurements that can be searched by position."""

    def __init__(self, measurements: RangeMeasurements):
        self.measurements = measurements
        self._tree = KDTree(measurements.origin) if len(measurements) else None

    def near(self, segment: Float[np.ndarray, "2 2"], beyond: float) -> Int[np.ndarray, " rows"]:
        """Rows of the measurements that may meet a wall on the line of a segment.

        Args:
            segment: both ends, metres.
            beyond: length by which the wall may extend beyond them, metres.
        """
        if self._tree is None:
            return np.zeros(0, dtype=np.int64)
        reach = float(np.hypot(*(segment[1] - segment[0]))) / 2 + beyond
        radius = float(np.hypot(reach, self.measurements.max_range))
        return np.sort(np.array(self._tree.query_ball_point(segment.mean(axis=0), radius), dtype=np.int64))


@dataclass(frozen=True, eq=False)
class LineEvidence:
    """What measurements say about a wall on one line, each about the place where it meets the line."""

    foot: Float[np.ndarray, " rows"]
    """Position along the line at which a wall would reflect the measurement, metres from the line's center."""
    residual: Float[np.ndarray, " rows"]
    """Measured minus predicted range, metres; inf for silence."""
    log_ratio: Float[np.ndarray, " rows"]
    """Logarithm of the likelihood ratio of a wall at the foot to none, nats; 0 if the measurement says nothing."""
    fits: Bool[np.ndarray, " rows"]
    """Echoes that the wall probably caused."""
    missed: Bool[np.ndarray, " rows"]
    """Measurements in which the wall caused no echo, although nothing was in front of it."""
    near_axis: Bool[np.ndarray, " rows"]
    """Measurements of sensors that almost face the line."""


@dataclass(frozen=True)
class EchoModel:
    """Properties of the echoes of a log."""

    sigma: float
    """Standard deviation of the ranges about a wall, metres."""
    detection: float = SETTINGS.support.detection
    """Probability of an echo from a wall that a sensor faces exactly."""

    def largest_log_ratio(self, max_range: float) -> float:
        """Log-likelihood ratio of an echo that fits exactly, from a wall that the sensor faces exactly, nats.

        Args:
            max_range: largest distance of an echo, metres.
        """
        settings = SETTINGS.support
        core = (1 - settings.too_short) / (np.sqrt(2 * np.pi) * self.sigma)
        return float(np.log(1 - self.detection + self.detection * core * max_range / settings.heard))


def line_evidence(
    measurements: RangeMeasurements, center: Float[np.ndarray, "2"], theta: float, model: EchoModel
) -> LineEvidence:
    """The evidence of each measurement for a wall on a line.

    A wall at the foot causes an echo with a probability that falls with the angle between the wall's normal and the
    axis of the path. The echo has Gaussian noise, or it is too short, because something stands in front of the wall.
    Otherwise, and without a wall, any range and silence have the probabilities of the background. A nearer echo is
    therefore hardly evidence against a wall, a farther one and silence are.

    Args:
        measurements: echoes and silences.
        center: a point on the line, metres.
        theta: direction of the normal, away from the robot, radians.
        model: properties of the echoes.
    """
    settings = SETTINGS.support
    offset = measurements.origin - center
    ahead, foot = -(offset @ unit(theta)), offset @ tangent_of(theta)
    predicted, _ = measurements.predicted(center, theta)
    angle = np.abs(wrap_angle(theta - measurements.axis))
    width = np.maximum(measurements.half_width, 1e-6)
    detected = model.detection * np.exp(-((angle / (settings.beam_factor * width)) ** 2))
    in_view = (ahead > settings.min_distance) & (measurements.half_width > 0)
    in_view &= angle <= measurements.half_width + settings.beam_margin
    in_view &= predicted < settings.certain * measurements.max_range
    # Likelihood ratios.
    silent = np.isinf(measurements.distance)
    residual = measurements.distance - predicted
    background = settings.heard / measurements.max_range
    deviation = np.where(silent, np.inf, residual) / model.sigma
    core = np.exp(-0.5 * deviation**2) / (np.sqrt(2 * np.pi) * model.sigma)
    too_short = (residual < 0) / np.maximum(predicted, settings.min_distance)
    wall = (1 - settings.too_short) * core + settings.too_short * too_short
    ratio = 1 - detected + np.where(silent, 0.0, detected * wall / background)
    log_ratio = np.where(in_view, np.log(ratio), 0.0)
    fits = in_view & (np.abs(deviation) <= settings.gate)
    # Of several echoes of one measurement only the first one proves that there is nothing in front of it.
    log_ratio[~measurements.is_first & ~fits] = 0.0
    missed = in_view & measurements.is_first & (deviation > settings.gate)
    near_axis = angle <= measurements.half_width / 2
    return LineEvidence(foot, np.where(silent, np.inf, residual), log_ratio, fits, missed, near_axis)
