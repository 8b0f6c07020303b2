"""Echoes and silences of paths in the world frame, one row each."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.se2 import compose, rotate, tangent_of, unit, wrap_angle
from jaxsonar.reflectors.settings import SETTINGS
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.sliding_windows import independent_measurements
from jaxsonar.sensors.ring import Ring

_SETTINGS = SETTINGS.measurements


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
    """Time of the scan, seconds; the scan number where the scan has no time stamp."""
    section: Int[np.ndarray, " rows"]
    """Number of the path and of the section of the trajectory: measurements with the same number are not independent,
    because an obstacle in front of the sensor affects all of them."""
    measurement: Int[np.ndarray, " rows"]
    """Number of the measurement, in ascending order: the echoes of one path in one scan."""
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
        return distance, slope / np.maximum(distance, _SETTINGS.min_distance)[:, None]

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
            time=np.where(np.isnan(log.stamp), log.scan, log.stamp)[scan],
            section=_sections(log.pose)[scan] * len(ring.paths) + path,
            measurement=np.unique(scan * len(ring.paths) + path, return_inverse=True)[1].ravel(),
            max_range=ring.max_range,
        )


def _sections(pose: Float[np.ndarray, "scans 3"]) -> Int[np.ndarray, " scans"]:
    """Number of the section of the trajectory of each scan."""
    known = np.all(np.isfinite(pose), axis=1)
    both = (known[1:] & known[:-1])[:, None]
    step = np.where(both, np.diff(pose, axis=0), 0.0)
    moved = np.hypot(*step[:, :2].T) + _SETTINGS.turn_length * np.abs(wrap_angle(step[:, 2]))
    return np.append(0, (np.cumsum(moved) / _SETTINGS.section).astype(np.int64))[: len(pose)]


def independent_weights(section: Int[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
    """Weights of measurements that sum to one for each section (``RangeMeasurements.section``)."""
    _, number, count = np.unique(section, return_inverse=True, return_counts=True)
    return 1 / count[number.ravel()]
