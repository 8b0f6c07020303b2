"""The interface of a recorder: a sink for messages, scans and link events."""

import os
from pathlib import Path

from .messages import Message
from .scan_assembler import RawScan
from .transport_base import Event

FLUSHED = 0.5
"""Seconds after which everything is handed to the operating system."""


class Recorder:
    """Where a reader puts what comes; for one thread."""

    def message(self, message: Message, received: float) -> None:
        """A message as decoded, and when it came: host clock, seconds since 1970."""

    def scan(self, scan: RawScan) -> None:
        """A scan as it was put together."""

    def event(self, event: Event) -> None:
        """Something about the link: lost, back, silent."""

    def tick(self, now: float) -> None:
        """Called at least every 0.1 s, ``time.monotonic``."""

    def close(self) -> None:
        """Everything is on the disk; a second time does nothing."""


def mark_of(path: str | os.PathLike[str]) -> Path:
    """The file beside a log that says that it is being written, or was when its process was killed."""
    return Path(f"{os.fspath(path)}.recording")
