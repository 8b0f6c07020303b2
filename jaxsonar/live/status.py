"""The status of a stream, and its text for the user."""

from dataclasses import dataclass, field

import numpy as np

from jaxsonar.plausibility.implausibility import Implausibility
from jaxsonar.plausibility.unused_echoes import EchoCounts
from jaxsonar.sensors.ring import Ring

_REJECTED = ("oversized", "impossible", "out_of_ring", "unknown", "newer", "refused")
"""Counters of rejected frames that are named in the text."""
_COUNTERS = {
    "missing": "groups missing",
    "lost": "messages lost",
    "late": "late",
    "repeated": "repeated",
    "restarts": "restarts",
    "gaps": "gaps",
}
"""Further counters of the reader, and their text; shown if they are not 0."""


@dataclass
class Status:
    """Status of a stream. One object per stream, updated in place."""

    scans: int = 0
    """Number of processed scans."""
    echoes: int = 0
    """Number of echoes in those scans."""
    left_out: int = 0
    """Number of those echoes that are on no path of the ring."""
    in_range: int = 0
    """Number of echoes on paths of the ring within its maximum range."""
    lines: int = 0
    """Number of lines in those scans."""
    rate: float = 0.0
    """Scans per second over the last seconds."""
    queued: int = 0
    """Scans in the queue."""
    counts: dict[str, int] = field(default_factory=dict)
    """Counters of the reader (``ReaderThread.counts``)."""
    without_pose: int = 0
    """Scans without a pose. Their lines are detected, but they are not in the map."""
    p50: float = float("nan")
    """Median latency from the last group of a scan to its lines, seconds. Scans that arrived during compilation do not
    count."""
    p99: float = float("nan")
    """99th percentile of the latency, seconds."""
    event: str = ""
    """The latest link event; empty while the link works."""
    warm: bool = False
    """Everything is compiled."""
    no_grid: str = ""
    """The reason why no grid was written at the end; empty if one was, or none was requested."""
    ending: bool = False
    """The stream was stopped during compilation; queued scans are still to be processed for the map."""

    def unknown_protocol(self) -> Implausibility | None:
        """A warning if bytes came, but no frame; None otherwise."""
        counts = {"bytes": 0, "frames": 0, "rejected": 0, **self.counts}
        if counts["frames"] or not counts["bytes"]:
            return None
        damaged = f", {counts['rejected']} damaged{self._rejected_text()}" if counts["rejected"] else ""
        what = f"no frame of the wire protocol in {counts['bytes']} bytes{damaged}"
        cause = "the device probably speaks another protocol, or has another baud rate"
        return Implausibility("protocol", what, cause, "let the device send frames of the wire protocol")

    def why_nothing_is_used(self, ring: Ring) -> str:
        """Why no echo of a finished stream could be used; empty if one was."""
        counts = {"bytes": 0, "frames": 0, "rejected": 0, "scans": 0, "echoes": 0, **self.counts}
        if not counts["bytes"]:
            return "no data came: is the device on, and does it send?"
        if unknown := self.unknown_protocol():
            return str(unknown)
        if not counts["scans"]:
            return f"no firing group in {counts['frames']} frames"
        if not self.warm:  # the scans were only recorded
            return "" if counts["echoes"] else f"no echo in {counts['scans']} scans"
        return EchoCounts(self.scans, self.echoes, self.echoes - self.left_out, self.in_range).why_none_is_used(ring)

    def text(self) -> str:
        """One line for the user."""
        scans = max(self.scans, 1)
        parts = [
            f"{self.scans} scans" if self.warm else f"{self.scans} scans, compiling",
            f"{self.rate:.1f} scans/s",
            f"{self.echoes / scans:.0f} echoes/scan",
            f"{self.lines / scans:.1f} lines/scan",
            f"{self.counts.get('dropped', 0)} dropped",
            f"{self.counts.get('rejected', 0)} damaged{self._rejected_text()}",
        ]
        if np.isfinite(self.p50):
            parts.append(f"latency {1e3 * self.p50:.1f} ms, p99 {1e3 * self.p99:.1f} ms")
        parts += [f"{self.counts[name]} {text}" for name, text in _COUNTERS.items() if self.counts.get(name)]
        if self.without_pose:
            parts.append(f"{self.without_pose} without a pose")
        if self.queued > 1:
            parts.append(f"{self.queued} waiting")
        ending = "; ending when these are in the map (Ctrl-C again: at once)" if self.ending else ""
        return ", ".join(parts) + (f"; {self.event}" if self.event else "") + ending

    def _rejected_text(self) -> str:
        kinds = [f"{self.counts[name]} {name.replace('_', ' ')}" for name in _REJECTED if self.counts.get(name)]
        return f" ({', '.join(kinds)})" if kinds else ""
