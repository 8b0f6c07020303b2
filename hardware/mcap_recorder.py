"""Raw records: every message as a frame, with the host's and the device's clock, in an MCAP file (extra ``live``).

Chunks are small and closed at least every half second: of a file that was cut off, all but the last of them can be
read from the beginning on.
"""

import json
import os
import threading
import time
from collections.abc import Iterator
from typing import Any

from .errors import SonarError
from .messages import Message
from .protocol import encode
from .recorder_base import FLUSHED, Recorder
from .transport_base import EndOfStream, Event, Source, Url, shown

CHUNK = 16 * 1024
"""Bytes."""
MESSAGES, EVENTS = "jaxsonar/messages", "jaxsonar/events"
"""Topics: frames of the wire protocol, with their final 0x00; what became of the link, as JSON."""
ENCODING = "jaxsonar-frame"
_LONGEST_WAIT = 0.05


class McapRecorder(Recorder):
    """Messages and events as they come. Log time is the host's clock, publish time the device's."""

    def __init__(self, path: str | os.PathLike[str]):
        """Begin a record; the file is replaced at once.

        Raises:
            SonarError: it cannot be written, or the extra is missing.
        """
        _, writing = _mcap(path)
        self._path = path
        try:
            self._file: Any = open(path, "wb")  # noqa: SIM115  closed by close()
        except OSError as failure:
            raise SonarError(
                f"{shown(path)}: cannot write: {failure.strerror}; allowed is a file you may write"
            ) from None
        self._writer: Any = writing.Writer(self._file, chunk_size=CHUNK)
        self._writer.start(profile="jaxsonar")
        self._messages = self._writer.register_channel(MESSAGES, ENCODING, 0)
        self._events = self._writer.register_channel(EVENTS, "json", 0)
        self._flushed = 0.0

    def message(self, message: Message, received: float) -> None:
        """See ``Recorder``."""
        self._add(self._messages, received, encode(message), message.time_us * 1000, message.sequence)

    def event(self, event: Event) -> None:
        """See ``Recorder``."""
        said = {"kind": event.kind, "text": event.text, "time": event.time}
        self._add(self._events, event.time, json.dumps(said).encode(), int(event.time * 1e9), 0)

    def tick(self, now: float) -> None:
        """See ``Recorder``."""
        if now - self._flushed >= FLUSHED:
            self._flushed = now
            self._told(self._writer.flush)

    def close(self) -> None:
        """See ``Recorder``."""
        if self._file is not None:
            file, self._file = self._file, None
            self._told(self._writer.finish)
            self._told(file.close)

    def _add(self, channel: int, received: float, data: bytes, device: int, sequence: int) -> None:
        def add() -> None:
            self._writer.add_message(channel, int(received * 1e9), data, min(device, (1 << 64) - 1), sequence)

        self._told(add)

    def _told(self, write: Any) -> None:
        try:
            write()
        except OSError as failure:
            raise SonarError(f"{shown(self._path)}: {failure.strerror}; needed is room for the record") from None


def read_mcap(path: str | os.PathLike[str]) -> Iterator[tuple[str, float, bytes]]:
    """What a raw record holds, from its beginning; one that was cut off as far as it can be read.

    Yields:
        Topic, host clock in seconds since 1970, and the frame or the JSON text.

    Raises:
        SonarError: the file cannot be read or is no raw record, or the extra is missing.
    """
    reading, _ = _mcap(path)
    try:
        with open(path, "rb") as file:
            topics: dict[int, str] = {}
            began = False
            try:
                for record in reading.StreamReader(file, record_size_limit=1 << 28).records:
                    began = True
                    if isinstance(record, reading.Channel):
                        topics[record.id] = record.topic
                    elif isinstance(record, reading.Message) and record.channel_id in topics:
                        yield topics[record.channel_id], record.log_time * 1e-9, record.data
            except OSError:
                raise
            except Exception:  # whatever a library says of bytes that stop in the middle
                if not began:
                    raise SonarError(f"{shown(path)}: this is no MCAP file; needed is a record (MCAP)") from None
            if topics and MESSAGES not in topics.values():
                others = shown(", ".join(sorted(topics.values())))
                raise SonarError(f"{shown(path)}: topics {others}; needed is {MESSAGES}, which a record has")
    except OSError as failure:
        raise SonarError(f"{shown(path)}: {failure.strerror}; needed is a readable file with a record (MCAP)") from None


class McapPlayer(Source):
    """A raw record as a source of bytes, with the times between its messages."""

    def __init__(self, url: Url, *, speed: float):
        """Open a record.

        Args:
            url: its ``path`` is the file.
            speed: how many times as fast as it was recorded; 0: as fast as it goes.

        Raises:
            SonarError: it cannot be read.
        """
        self.url = url.text
        self._speed = speed
        self._frames = ((when, data) for topic, when, data in read_mcap(url.path) if topic == MESSAGES)
        self._next = next(self._frames, None)  # so that a file that is none is refused here
        self._zero: tuple[float, float] | None = None
        self._closed = threading.Event()

    def read(self, timeout: float) -> bytes | None:
        """See ``Source``."""
        if self._next is None or self._closed.is_set():
            raise EndOfStream(f"{self.url}: the record ends here")
        when, data = self._next
        if self._speed:
            now = time.monotonic()
            self._zero = self._zero or (now, when)
            wait = self._zero[0] + (when - self._zero[1]) / self._speed - now
            if wait > 0:
                self._closed.wait(min(wait, timeout))
            if wait > timeout:
                return None
        self._next = next(self._frames, None)
        return data

    def close(self) -> None:
        """See ``Source``."""
        self._closed.set()


def _mcap(path: str | os.PathLike[str]) -> tuple[Any, Any]:
    try:
        import mcap.records
        import mcap.stream_reader
        import mcap.writer
    except ImportError:
        raise SonarError(f"{shown(path)}: records need the extra live: pip install 'jaxsonar[live]'") from None

    class Reading:
        StreamReader = mcap.stream_reader.StreamReader
        Channel, Message = mcap.records.Channel, mcap.records.Message

    return Reading, mcap.writer
