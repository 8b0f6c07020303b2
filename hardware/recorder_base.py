"""The interface of a recorder: a sink for messages, scans and link events."""

import os
from pathlib import Path

from .messages import Message
from .scan_assembler import RawScan
from .transport_base import LinkEvent

FLUSH_INTERVAL = 0.5
"""Seconds between two flushes to the operating system. Bounds what a killed process loses."""


class Recorder:
    """Receives everything that a reader receives. Not thread-safe. The base class ignores all of it."""

    def message(self, message: Message, received: float) -> None:
        """Record a decoded message and its time of arrival (host clock, seconds since 1970)."""

    def scan(self, scan: RawScan) -> None:
        """Record an assembled scan."""

    def event(self, event: LinkEvent) -> None:
        """Record a link event."""

    def tick(self, now: float) -> None:
        """Called at least every 0.1 s with ``time.monotonic()``; a recorder flushes here."""

    def close(self) -> None:
        """Write everything to disk. Idempotent."""


def recording_marker(log: str | os.PathLike[str]) -> Path:
    """The marker file beside a log: the log is being recorded, or its recording process was killed."""
    return Path(f"{os.fspath(log)}.recording")
