"""How well single measurements support a wall: echoes that fit it, echoes from behind it, and silence."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jaxsonar.geometry.se2 import compose, rotate, tangent_of, unit, wrap_angle
from jaxsonar.mapping.map_evidence import scan_times
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.sliding_windows import independent_measurements
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True, eq=False)
class RangeMeasurements:
    """Echoes and silences of paths, world frame; one row each."""

    origin: Float[np.ndarray, "rows 2"]
    """Midpoint of transmitter and receiver at the time of the measurement, metres."""
    half_baseline: Float[np.ndarray, "rows 2"]
    """Half the vector from transmitter to receiver, metres; zero for direct echoes."""
    axis: Float[np.ndarray, " rows"]
    """Middle of the directions in which the path detects a plane, radians."""
    half_width: Float[np.ndarray, " rows"]
    """Half the width of these directions, radians."""
    distance: Float[np.ndarray, " rows"]
    """Corrected half path length, metres; inf where the path heard nothing within its maximum range."""
    is_first: Bool[np.ndarray, " rows"]
    """Whether no nearer echo belongs to the same measurement."""
    scan: Int[np.ndarray, " rows"]
    """Scan number."""
    time: Float[np.ndarray, " rows"]
    """Time as in ``WallSegments.last_seen``."""
    section: Int[np.ndarray, " rows"]
    """Number of the path and of the section of the trajectory: measurements with the same number are not independent,
    because an obstacle in front of the sensor affects all of them."""
    max_range: float
    """Largest distance of an echo, metres."""

    def __len__(self) -> int:
        return len(self.distance)

    def take(self, rows: Int[np.ndarray, " some"] | Bool[np.ndarray, " rows"]) -> "RangeMeasurements":
        """The given rows (numbers or mask)."""
        columns = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "max_range"}
        return RangeMeasurements(**columns, max_range=self.max_range)

    def predicted(
        self, center: Float[np.ndarray, "2"], theta: float
    ) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows 2"]]:
        """Range of a wall on a line, metres, and its derivatives by the line's offset (along the normal) and direction.

        Args:
            center: a point on the line, metres.
            theta: direction of the normal, radians.
        """
        normal, tangent = unit(theta), tangent_of(theta)
        offset = center - self.origin
        ahead, beside = offset @ normal, offset @ tangent
        across, along = self.half_baseline @ normal, self.half_baseline @ tangent
        distance = np.hypot(ahead, along)
        slope = np.stack([ahead, ahead * beside - along * across], axis=-1)
        return distance, slope / np.maximum(distance, SETTINGS.support.min_distance)[:, None]

    @classmethod
    def from_log(cls, ring: Ring, log: Log) -> "RangeMeasurements":
        """The independent measurements of a log, as windows use them (``independent_measurements``).

        Args:
            ring: the sensors.
            log: scans; those without a pose are left out.
        """
        found = independent_measurements(ring, log)
        flat = found.echoes
        # Echoes, nearest first in each measurement; those beyond the maximum range are silence.
        distance = np.asarray(ring.corrected(flat.reported, *ring.paths[flat.path].T), dtype=np.float64)
        heard = np.flatnonzero(found.used & (distance > 0) & (distance < ring.max_range))
        heard = heard[np.lexsort((distance[heard], flat.path[heard], flat.scan[heard]))]
        key = flat.scan[heard] * len(ring.paths) + flat.path[heard]
        is_first = np.append(True, key[1:] != key[:-1])[: len(key)]
        silent = found.independent.copy()
        near = distance < ring.max_range
        silent[flat.scan[near], flat.path[near]] = False
        silent_scan, silent_path = np.nonzero(silent)
        scan = np.append(flat.scan[heard], silent_scan)
        path = np.append(flat.path[heard], silent_path)
        # World frame.
        robot = log.pose[scan]
        if flat.path_pose is not None:
            robot = compose(robot, flat.path_pose[scan, path])
        geometry = ring.exact_paths
        columns = (geometry.midpoint, geometry.half_baseline, geometry.start, geometry.width)
        midpoint, half_baseline, start, width = (np.asarray(values)[path] for values in columns)
        return cls(
            origin=robot[:, :2] + rotate(midpoint, robot[:, 2]),
            half_baseline=rotate(half_baseline, robot[:, 2]),
            axis=wrap_angle(start + width / 2 + robot[:, 2]),
            half_width=width / 2,
            distance=np.append(distance[heard], np.full(len(silent_scan), np.inf)),
            is_first=np.append(is_first, np.ones(len(silent_scan), dtype=bool)),
            scan=log.scan[scan],
            time=scan_times(log)[scan],
            section=_sections(log.pose)[scan] * len(ring.paths) + path,
            max_range=ring.max_range,
        )


def _sections(pose: Float[np.ndarray, "scans 3"]) -> Int[np.ndarray, " scans"]:
    """Number of the section of the trajectory of each scan."""
    known = np.all(np.isfinite(pose), axis=1)
    both = (known[1:] & known[:-1])[:, None]
    step = np.where(both, np.diff(pose, axis=0), 0.0)
    moved = np.hypot(*step[:, :2].T) + SETTINGS.support.arm * np.abs(wrap_angle(step[:, 2]))
    return np.append(0, (np.cumsum(moved) / SETTINGS.support.section).astype(np.int64))[: len(pose)]


def independent_weights(section: Int[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
    """Weights of measurements that sum to one for each section (``RangeMeasurements.section``)."""
    _, number, count = np.unique(section, return_inverse=True, return_counts=True)
    return 1 / count[number.ravel()]


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
