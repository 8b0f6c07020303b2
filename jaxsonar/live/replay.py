"""Replay of scan logs and raw recordings: the source ``file:LOG?speed=1``, and messages for ``jaxsonar emulate``."""

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
from jaxsonar.hardware.recorder import open_recording, playback_speed
from jaxsonar.hardware.transport_base import EndOfStream, OnEvent, Source, Url
from jaxsonar.scans.log_file import load_log
from jaxsonar.sensors.ring import Ring
from jaxsonar.simulation.device_messages import log_messages

MAX_MESSAGES = 64
"""Maximum number of messages returned by one read. Chosen by hand."""


def messages_of(filename: str | os.PathLike[str], ring: Ring) -> Iterator[Message]:
    """The messages of a device that would give this log or raw recording.

    Args:
        filename: ``.csv``, ``.parquet`` or ``.mcap``.
        ring: the sensors; its firing groups split the scans of a log into messages.

    Raises:
        SonarError: the file cannot be read, or holds values that no device can report.
    """
    if Path(filename).suffix.lower() == ".mcap":
        messages = _raw_messages(filename, ring)
        first = next(messages, None)  # reports an unreadable file here
        return messages if first is None else chain([first], messages)
    try:
        log = load_log(filename)
        return log_messages(log, ring)
    except SonarError as error:
        text = str(error)
        raise SonarError(text if text.startswith(shown(filename)) else f"{shown(filename)}: {text}") from None


def _raw_messages(filename: str | os.PathLike[str], ring: Ring) -> Iterator[Message]:
    decoder = Decoder(sensors=ring.count)
    for topic, _, frame in read_mcap(filename):
        if topic == MESSAGES:
            yield from decoder.feed(frame)
            if decoder.counts.out_of_ring:
                raise SonarError(
                    f"{shown(filename)}: a sensor beyond the ring came; allowed with it is 0 to {ring.count - 1}"
                )


def file_opener(ring: Ring):
    """An opener of ``file:`` URLs for scan logs and raw recordings, for ``register_transport``.

    Args:
        ring: the sensors; see ``messages_of``.
    """

    def open_log(url: Url, *, on_event: OnEvent, reconnect: bool, silence: float) -> Source:
        if Path(url.path).suffix.lower() == ".mcap":
            return open_recording(url, on_event=on_event, reconnect=reconnect, silence=silence)
        return LogPlayer(url, ring)

    return open_log


class LogPlayer(Source):
    """Replays a scan log as a source of bytes, with the recorded time between messages."""

    def __init__(self, url: Url, ring: Ring):
        """Read the log.

        Args:
            url: ``file:LOG?speed=1``; speed 0 is as fast as possible.
            ring: the sensors; see ``messages_of``.

        Raises:
            SonarError: as in ``messages_of``, or an invalid option.
        """
        self.url = url.text
        self._speed = playback_speed(url)
        self._messages = messages_of(url.path, ring)
        self._next = next(self._messages, None)
        self._start: tuple[float, int] | None = None
        """Host clock (``time.monotonic``) and device clock (microseconds) of the first message."""
        self._closed = threading.Event()

    def read(self, timeout: float) -> bytes | None:
        """See ``Source``."""
        if self._closed.is_set() or self._next is None:
            raise EndOfStream(f"{self.url}: the log ends here")
        now = time.monotonic()
        self._start = self._start or (now, self._next.time_us)
        wait = self._time_left(self._next, now)
        if wait > 0:
            self._closed.wait(min(wait, timeout))
            if wait > timeout:
                return None
            now = time.monotonic()
        frames = []
        while self._next is not None and len(frames) < MAX_MESSAGES and self._time_left(self._next, now) <= 0:
            frames.append(encode(self._next))
            self._next = next(self._messages, None)
        return b"".join(frames) or None

    def close(self) -> None:
        """See ``Source``."""
        self._closed.set()

    def _time_left(self, message: Message, now: float) -> float:
        """Seconds until a message is due."""
        if not self._speed or self._start is None:
            return 0.0
        start, first_us = self._start
        return start + (message.time_us - first_us) * 1e-6 / self._speed - now
