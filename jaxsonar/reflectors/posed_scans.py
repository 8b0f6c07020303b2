"""Scans with poses, a few for each place of the robot: what the search for reflectors needs of a growing log."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from jaxsonar.reflectors.range_measurements import RangeMeasurements
from jaxsonar.reflectors.settings import SETTINGS
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.sensors.ring import Ring

Place = tuple[int, int, int]
"""Cell of a position and of a heading."""


@dataclass(frozen=True, eq=False)
class PosedScans:
    """The latest scans of each place. The size grows with the floor, not with the number of scans."""

    ring: Ring | None = None
    """The sensors; None without scans."""
    places: Mapping[Place, tuple[Scan, ...]] = field(default_factory=dict)
    """Scans of each place, the latest first."""

    @classmethod
    def of(cls, ring: Ring, scans: Iterable[Scan]) -> "PosedScans":
        """The scans of a log; those without a pose are left out."""
        places: dict[Place, tuple[Scan, ...]] = {}
        for scan in scans:
            if np.isfinite(scan.pose).all():
                place = _place(scan)
                places[place] = _latest((*places.get(place, ()), scan))
        return cls(ring, places)

    def union(self, other: "PosedScans") -> "PosedScans":
        """The scans of both."""
        places = dict(self.places)
        for place, scans in other.places.items():
            places[place] = _latest((*places.get(place, ()), *scans))
        return PosedScans(self.ring if other.ring is None else other.ring, places)

    def measurements(self) -> RangeMeasurements | None:
        """The independent measurements of all scans; None without scans."""
        scans = {scan.scan: scan for of_place in self.places.values() for scan in of_place}
        if self.ring is None or not scans:
            return None
        return RangeMeasurements.from_log(self.ring, Log.from_scans(sorted(scans.values(), key=_order)))


def _place(scan: Scan) -> Place:
    settings = SETTINGS.places
    x, y = np.floor(scan.pose[:2] / settings.cell).astype(np.int64).tolist()
    return x, y, int(np.floor(scan.pose[2] % (2 * np.pi) / settings.angle))


def _order(scan: Scan) -> tuple[float, int]:
    return (float(scan.scan if np.isnan(scan.stamp) else scan.stamp), int(scan.scan))


def _latest(scans: tuple[Scan, ...]) -> tuple[Scan, ...]:
    return tuple(sorted(scans, key=_order, reverse=True)[: SETTINGS.places.scans])
