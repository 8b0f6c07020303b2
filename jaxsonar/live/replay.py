"""Scan logs and raw records as devices: ``file:LOG?speed=1``, and what ``jaxsonar emulate`` sends."""

import os
import threading
import time
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.mcap_recorder import MESSAGES, read_mcap
from jaxsonar.hardware.messages import Message
from jaxsonar.hardware.protocol import Decoder, encode
from jaxsonar.hardware.recorder import open_file, speed_of
from jaxsonar.hardware.transport_base import EndOfStream, OnEvent, Source, Url
from jaxsonar.scans.log_file import load_log
from jaxsonar.sensors.ring import Ring
from jaxsonar.simulation.device_messages import log_messages

AT_ONCE = 64
"""Messages handed over in one piece where there is no time to keep."""


def messages_of(path: str | os.PathLike[str], ring: Ring) -> Iterator[Message]:
    """What the device said whose log or raw record this is.

    Args:
        path: ``.csv``, ``.parquet`` or ``.mcap``.
        ring: which sensors fire together, for logs.

    Raises:
        SonarError: the file cannot be read, or holds what no device can say.
    """
    if Path(path).suffix.lower() == ".mcap":
        recorded = _recorded(path, ring)
        first = next(recorded, None)  # so that a file that is none is refused here
        return recorded if first is None else chain([first], recorded)
    try:
        log = load_log(path)
        return log_messages(log, ring)
    except SonarError as error:
        text = str(error)
        raise SonarError(text if text.startswith(shown(path)) else f"{shown(path)}: {text}") from None


def _recorded(path: str | os.PathLike[str], ring: Ring) -> Iterator[Message]:
    decoder = Decoder(sensors=ring.count)
    for topic, _, frame in read_mcap(path):
        if topic == MESSAGES:
            yield from decoder.feed(frame)
            if decoder.counts.out_of_ring:
                raise SonarError(
                    f"{shown(path)}: a sensor beyond the ring came; allowed with it is 0 to {ring.count - 1}"
                )


def file_opener(ring: Ring):
    """An opener for ``file:`` URLs that knows scan logs, too; for ``transports.register``.

    Args:
        ring: which sensors fire together.
    """

    def open_any(url: Url, *, on_event: OnEvent, reconnect: bool, silence: float) -> Source:
        if Path(url.path).suffix.lower() == ".mcap":
            return open_file(url, on_event=on_event, reconnect=reconnect, silence=silence)
        return LogPlayer(url, ring)

    return open_any


class LogPlayer(Source):
    """A scan log as a source of bytes, with the device's times between its messages."""

    def __init__(self, url: Url, ring: Ring):
        """Read the log.

        Args:
            url: ``file:LOG?speed=1``; speed 0 is as fast as it goes.
            ring: which sensors fire together.

        Raises:
            SonarError: as ``messages_of``, or an option that is none.
        """
        self.url = url.text
        self._speed = speed_of(url)
        self._messages = messages_of(url.path, ring)
        self._next = next(self._messages, None)
        self._zero: tuple[float, int] | None = None
        self._closed = threading.Event()

    def read(self, timeout: float) -> bytes | None:
        """See ``Source``."""
        if self._closed.is_set() or self._next is None:
            raise EndOfStream(f"{self.url}: the log ends here")
        now = time.monotonic()
        self._zero = self._zero or (now, self._next.time_us)
        wait = self._wait(self._next, now)
        if wait > 0:
            self._closed.wait(min(wait, timeout))
            if wait > timeout:
                return None
            now = time.monotonic()
        frames = []
        while self._next is not None and len(frames) < AT_ONCE and self._wait(self._next, now) <= 0:
            frames.append(encode(self._next))
            self._next = next(self._messages, None)
        return b"".join(frames) or None

    def close(self) -> None:
        """See ``Source``."""
        self._closed.set()

    def _wait(self, message: Message, now: float) -> float:
        """Seconds until a message is due."""
        if not self._speed or self._zero is None:
            return 0.0
        began, first = self._zero
        return began + (message.time_us - first) * 1e-6 / self._speed - now
