"""Arrays and the pairs of transmitter and receiver that they measure, from one receiver to a whole ring."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from jaxsonar.observability.reflectors import ArrayPaths
from jaxsonar.sensors.ring import Ring

FAR = 10.0
"""Range of the arrays, metres: no surface of the table is out of range."""
OFFSET = 0.15
"""Distance between neighbors of the arrays of three sensors, metres."""
SPACING = 0.45
"""Distance between neighbors of the bumper, metres."""


@dataclass(frozen=True, eq=False)
class Configuration:
    """One row of the table."""

    name: str
    ring: Ring
    pairs: Int[np.ndarray, "paths 2"]
    """Transmitter and receiver of each path that is measured."""

    @property
    def paths(self) -> ArrayPaths:
        """Geometry of the measured paths."""
        return ArrayPaths.of(self.ring, self.pairs)


def sensor_line(count: int, spacing: float, beam_deg: float) -> Ring:
    """Sensors on a line across x that face forward."""
    across = (np.arange(count) - (count - 1) / 2) * spacing
    position = np.stack([np.zeros(count), across], axis=-1)
    beam = np.radians(beam_deg)
    return Ring(position, np.zeros(count), beam=beam, neighbors=count - 1, max_range=FAR, closed=False)


def ring_of_24(beam_deg: float, neighbors: int) -> Ring:
    """The ring of the paper, with any cones."""
    return Ring.circular(beam=np.radians(beam_deg), neighbors=neighbors, max_range=FAR)


def all_pairs(tx: list[int], rx: list[int], count: int) -> Int[np.ndarray, "paths 2"]:
    """Every transmitter with every receiver; negative numbers count from the end."""
    return np.array([(a % count, b % count) for a in tx for b in rx])


def neighbor_pairs(ring: Ring) -> Int[np.ndarray, "paths 2"]:
    """The paths of a ring, sorted by transmitter, then by the offset of the receiver from -neighbors on."""
    offsets = list(range(-ring.neighbors, ring.neighbors + 1))
    return np.array([(tx, (tx + offset) % ring.count) for tx in range(ring.count) for offset in offsets])


def configurations() -> list[Configuration]:
    """The rows of the table, in the order in which their surfaces and noise are drawn."""
    narrow, wide, direct = ring_of_24(60, 3), ring_of_24(120, 7), ring_of_24(60, 0)
    three, bumper = sensor_line(3, OFFSET, 60), sensor_line(4, SPACING, 120)
    around = [(narrow, "ring 60 deg", 3), (wide, "ring 120 deg", 7)]
    shots = [
        Configuration(f"multi-aural, {name}, one shot", ring, all_pairs([0], list(range(-reach, reach + 1)), 24))
        for ring, name, reach in around
    ]
    return [
        Configuration("monaural", narrow, all_pairs([0], [0], 24)),
        Configuration("binaural, ring 73 mm", narrow, all_pairs([0], [0, 1], 24)),
        Configuration("binaural, ±150 mm", three, all_pairs([1], [0, 2], 3)),
        Configuration("triaural, ring", narrow, all_pairs([0], [-1, 0, 1], 24)),
        Configuration("triaural, ±150 mm", three, all_pairs([1], [0, 1, 2], 3)),
        *shots,
        Configuration("2 tx 2 rx, ±150 mm", three, all_pairs([0, 2], [0, 2], 3)),
        Configuration("ring 60 deg, direct only, scan", direct, neighbor_pairs(direct)),
        Configuration("ring 60 deg, scan", narrow, neighbor_pairs(narrow)),
        Configuration("ring 120 deg, scan", wide, neighbor_pairs(wide)),
        Configuration("bumper of four at 45 cm, one shot", bumper, all_pairs([1], [0, 1, 2, 3], 4)),
        Configuration("bumper of four at 45 cm, scan", bumper, all_pairs([0, 1, 2, 3], [0, 1, 2, 3], 4)),
    ]


CODED = {"ring 60 deg, scan": "coded, ring 60 deg, one shot = a scan"}
"""Rows that are repeated under another name: transmitters with separable codes measure in one shot what a scan does."""
