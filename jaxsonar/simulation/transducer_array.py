"""A ring as plain arrays: its sensors in the world, and the pairs of sensors whose echoes its paths receive."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.hardware.messages import REFERENCE_SPEED_OF_SOUND
from jaxsonar.sensors.ring import Ring
from jaxsonar.simulation.traced_echoes import EchoColumns


class TransducerArray(NamedTuple):
    """A ring as plain arrays. (i, j) and (j, i) give the same echoes, so each unordered pair is traced once."""

    position: Float[np.ndarray, "sensors 2"]
    """Robot frame, metres."""
    heading: Float[np.ndarray, " sensors"]
    """Directions of the axes, robot frame, radians."""
    half_beam: Float[np.ndarray, " sensors"]
    """Half the width of each cone, radians."""
    offset: Float[np.ndarray, " sensors"]
    """Range offsets, metres."""
    max_range: float
    """Largest half path length, metres."""
    speed: float
    """Speed of sound, metres per second."""
    paths: Int[np.ndarray, "paths 2"]
    """``Ring.paths``."""
    overlapping: Int[np.ndarray, " overlapping"]
    """Paths whose cones overlap."""
    pairs: Int[np.ndarray, "pairs 2"]
    """Unordered pairs of sensors, the lower index first."""
    reported_on: Int[np.ndarray, "pairs 2"]
    """Path that reports the echoes of a pair if its first or its second sensor transmits; -1 if none does."""
    is_crosstalk: Bool[np.ndarray, " pairs"]
    """Whether that path belongs to another transmitter of the same firing group."""

    @classmethod
    def of(cls, ring: Ring, *, crosstalk: bool) -> "TransducerArray":
        """The arrays of a ring.

        Args:
            ring: the sensors.
            crosstalk: include pairs with the other transmitters of a firing group. Each receiver listens to at most one
                sensor of a group, so that no pair is an echo path as well.
        """
        heading, beam, offset = (np.asarray(x, dtype=np.float64) for x in (ring.heading, ring.beam, ring.range_offset))
        tx, rx = ring.paths.T
        path, other = np.zeros((2, 0), dtype=int)
        if crosstalk:
            group = ring.firing_group_of_sensor
            path, other = np.nonzero((group[tx, None] == group) & (tx[:, None] != np.arange(ring.count)))
        directed = np.concatenate([ring.paths, np.stack([other, rx[path]], axis=-1)])
        pairs, pair = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True)
        reported_on = np.full((len(pairs), 2), -1)
        reported_on[pair, (directed[:, 0] > directed[:, 1]).astype(int)] = np.append(np.arange(len(tx)), path)
        is_crosstalk = np.ones(len(pairs), dtype=bool)
        is_crosstalk[pair[: len(tx)]] = False
        between_axes = np.abs(wrap_angle(heading[tx] - heading[rx]))
        return cls(
            position=np.asarray(ring.position, dtype=np.float64),
            heading=heading,
            half_beam=beam / 2,
            offset=offset,
            max_range=ring.max_range,
            speed=float(ring.speed_of_sound),
            paths=ring.paths,
            overlapping=np.flatnonzero(between_axes < (beam[tx] + beam[rx]) / 2),
            pairs=pairs,
            reported_on=reported_on,
            is_crosstalk=is_crosstalk,
        )

    def in_world(
        self, poses: Float[np.ndarray, "scans 3"]
    ) -> tuple[Float[np.ndarray, "scans sensors 2"], Float[np.ndarray, "scans sensors 2"]]:
        """Positions (metres) and unit vectors of the axes of all sensors in the world frame, for poses of the robot."""
        cos, sin = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
        x, y = self.position.T
        sensors = poses[:, None, :2] + np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
        heading = poses[:, 2, None] + self.heading
        return sensors, np.stack([np.cos(heading), np.sin(heading)], axis=-1)

    def reported(self, echoes: EchoColumns, error: Float[np.ndarray, " echoes"] | float) -> EchoColumns:
        """Echoes with reported ranges instead of half path lengths."""
        scale = REFERENCE_SPEED_OF_SOUND / self.speed
        offset = (self.offset[echoes.transmitter] + self.offset[self.paths[echoes.path, 1]]) / 2
        return echoes._replace(range=echoes.range * scale + offset + error)
