"""Plays recorded frames as a source of bytes, in real time or at another speed."""

import threading
import time
from collections.abc import Iterator

from .transport_base import EndOfStream, Source, Url

MAX_FRAMES = 64
"""Maximum number of frames returned by one read. Chosen by hand."""


class FramePlayer(Source):
    """A source of frames, with the recorded time between them."""

    def __init__(self, url: Url, frames: Iterator[tuple[float, bytes]], *, speed: float):
        """Read the first frame.

        Args:
            url: URL of the file.
            frames: recorded time (seconds, ascending) and bytes of each frame.
            speed: playback speed; 0: as fast as possible.

        Raises:
            SonarError: raised by ``frames``, for an unreadable file.
        """
        self.url = url.text
        self._speed = speed
        self._frames = frames
        self._next = next(frames, None)
        self._start: tuple[float, float] | None = None
        """Time now (``time.monotonic``) and recorded time, of the first frame."""
        self._closed = threading.Event()

    def read(self, timeout: float) -> bytes | None:
        """See ``Source``."""
        if self._closed.is_set() or self._next is None:
            raise EndOfStream(f"{self.url}: the recording ends here")
        now = time.monotonic()
        self._start = self._start or (now, self._next[0])
        wait = self._time_left(self._next[0], now)
        if wait > 0:
            self._closed.wait(min(wait, timeout))
            if wait > timeout:
                return None
            now = time.monotonic()
        frames = []
        while self._next is not None and len(frames) < MAX_FRAMES and self._time_left(self._next[0], now) <= 0:
            frames.append(self._next[1])
            self._next = next(self._frames, None)
        return b"".join(frames) or None

    def close(self) -> None:
        """See ``Source``."""
        self._closed.set()

    def _time_left(self, recorded_time: float, now: float) -> float:
        """Seconds until a frame is due."""
        if not self._speed or self._start is None:
            return 0.0
        start, first = self._start
        return start + (recorded_time - first) / self._speed - now
