"""Which sensors and which kinds of paths a log measured. What was not measured tells nothing about a sensor."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxsonar.plausibility.unheard_paths import neighbor_offsets, unheard_offsets
from jaxsonar.scans.measured_paths import measured_paths
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


class MeasuredSensors(NamedTuple):
    """Paths of each sensor that a log measured in any scan."""

    any: Bool[np.ndarray, " sensors"]
    """Whether any path of the sensor was measured."""
    cross: Bool[np.ndarray, "sensors 2"]
    """Whether any cross path was measured with the sensor as transmitter, as receiver; True if it has no such path, or
    if such paths were measured for no sensor."""
    certain: bool
    """Whether the log marks paths that heard nothing. Otherwise a path that is never heard may be silent or unmeasured,
    and it counts as unmeasured."""
    kinds: tuple[str, ...]
    """Names of the kinds of paths that were never measured."""
    absent: tuple[int, ...]
    """Sensors that were never measured, if others were."""

    @property
    def unmeasured(self) -> tuple[str, ...]:
        """Names of the kinds of paths, and of the sensors, that were never measured."""
        return self.unmeasured_without(set())

    def unmeasured_without(self, known: set[int]) -> tuple[str, ...]:
        """The same without the sensors that are known to be silent."""
        absent = [k for k in self.absent if k not in known]
        return (*self.kinds, f"sensor{'s' * (len(absent) > 1)} {_listed(absent)}") if absent else self.kinds

    @classmethod
    def of(cls, ring: Ring, log: Log) -> "MeasuredSensors":
        """Find what a log measured of a ring."""
        tx, rx = ring.paths.T
        measured, offset = np.any(measured_paths(ring, log), axis=0), neighbor_offsets(ring)
        audible = np.greater(ring.exact_paths.width, 0)
        missing = unheard_offsets(ring, log)
        kinds = ["direct echoes"] if 0 in missing else []
        if neighbors := [k for k in missing if k]:
            kinds.append(f"echoes from neighbor{'s' * (len(neighbors) > 1)} {_listed(neighbors)}")
        # A sensor is judged by the kinds of paths that were measured at all.
        exists = np.logical_and(audible, ~np.isin(offset, missing))
        cross = np.logical_and(exists, tx != rx)

        def has(which: Bool[np.ndarray, " paths"], sensor: np.ndarray) -> Bool[np.ndarray, " sensors"]:
            return np.bincount(sensor[which], minlength=ring.count) > 0

        either = has(measured, tx) | has(measured, rx)
        absent = np.flatnonzero(~either & (has(exists, tx) | has(exists, rx)))
        absent = tuple(absent.tolist()) if len(absent) < ring.count else ()
        roles = np.stack([~has(cross, sensor) | has(cross & measured, sensor) for sensor in (tx, rx)], axis=-1)
        return cls(either, roles, bool(np.isnan(log.range).any()), tuple(kinds), absent)


def _listed(numbers: list[int]) -> str:
    """Numbers as text: "1, 2 and 3"."""
    *most, last = map(str, numbers)
    return f"{', '.join(most)} and {last}" if most else last
