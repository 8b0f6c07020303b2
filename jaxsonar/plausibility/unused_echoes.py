"""Why no echo of a log can be used."""

from dataclasses import dataclass

import numpy as np

from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class EchoCounts:
    """Numbers of echoes of a log, from the log to the echoes that a detection uses."""

    scans: int
    """Scans."""
    echoes: int
    """Echoes."""
    on_paths: int
    """Echoes of pairs of sensors that are paths of the ring; a repeated old reading is not counted again."""
    in_range: int
    """Those of them within the maximum range."""
    with_pose: int | None = None
    """Those of them in scans with a pose; None if poses are not needed."""

    @classmethod
    def of(cls, ring: Ring, log: Log, *, with_poses: bool = False) -> "EchoCounts":
        """Count the echoes of a log.

        Args:
            ring: the sensors.
            log: the scans.
            with_poses: whether only echoes of scans with a pose can be used.

        Raises:
            SonarError: the log holds a sensor index that the ring does not have.
        """
        flat, _ = FlatEchoes.from_log(ring, log)
        distance = np.asarray(ring.corrected(flat.reported, *ring.paths[flat.path].T))
        in_range = (distance > 0) & (distance < ring.max_range)
        posed = int(np.isfinite(log.pose[flat.scan[in_range]]).all(axis=1).sum()) if with_poses else None
        return cls(len(log), log.echo_count, len(flat.path), int(in_range.sum()), posed)

    def why_none_is_used(self, ring: Ring) -> str:
        """Why no echo can be used; empty if one can."""
        scans = f"{self.scans} scan{'s' * (self.scans != 1)}"
        if self.scans == 0:
            return "no scan: the log is empty"
        if self.echoes == 0:
            return f"no echo in {scans}: every range is empty or means no echo"
        if self.on_paths == 0:
            listed = f"direct echoes and neighbors up to {ring.neighbors}" if ring.neighbors else "direct echoes only"
            return f"none of the {self.echoes} echoes is on a path of {ring.name!r}: the ring lists {listed}"
        if self.in_range == 0:
            reach = f"the maximum range of {ring.name!r}, {ring.max_range:g} m"
            return f"none of the {self.on_paths} echoes is within {reach}: are ranges half path lengths in metres?"
        if self.with_pose == 0:
            return f"none of the {self.in_range} echoes is in a scan with a pose: give x, y and theta"
        return ""
