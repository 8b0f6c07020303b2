"""Raw recordings: every message as a wire frame, with host and device clock, in an MCAP file (extra ``live``).

Chunks are small and closed at least every half second. Of a truncated file everything but the last chunk is readable.
"""

import json
import os
from collections.abc import Callable, Iterator
from typing import Any

from .errors import SonarError, shown
from .frame_player import FramePlayer
from .messages import Message
from .protocol import encode
from .recorder_base import FLUSH_INTERVAL, Recorder
from .transport_base import LinkEvent, Source, Url

CHUNK_SIZE = 16 * 1024
"""Size of an MCAP chunk, bytes. Small, because a truncated file loses its last chunk."""
MESSAGES, EVENTS = "jaxsonar/messages", "jaxsonar/events"
"""Topics: frames of the wire protocol with their final 0x00; link events as JSON."""
ENCODING = "jaxsonar-frame"
PROFILE = "jaxsonar"
"""Profile in the header of a raw recording."""


class McapRecorder(Recorder):
    """Records messages and link events. MCAP's log time is the host clock, its publish time the device clock."""

    def __init__(self, filename: str | os.PathLike[str]):
        """Start a recording; an existing file is replaced at once.

        Raises:
            SonarError: the file cannot be written, or the extra is missing.
        """
        _, writer_module = _mcap(filename)
        self._filename = filename
        try:
            self._file: Any = open(filename, "wb")  # noqa: SIM115  closed by close()
        except OSError as failure:
            raise SonarError(
                f"{shown(filename)}: cannot write: {failure.strerror}; allowed is a file you may write"
            ) from None
        self._writer: Any = writer_module.Writer(self._file, chunk_size=CHUNK_SIZE)
        self._writer.start(profile=PROFILE)
        self._messages = self._writer.register_channel(MESSAGES, ENCODING, 0)
        self._events = self._writer.register_channel(EVENTS, "json", 0)
        self._flushed_at = 0.0

    def message(self, message: Message, received: float) -> None:
        """See ``Recorder``."""
        self._add(self._messages, received, encode(message), message.time_us * 1000, message.sequence)

    def event(self, event: LinkEvent) -> None:
        """See ``Recorder``."""
        record = {"kind": event.kind, "text": event.text, "time": event.time}
        self._add(self._events, event.time, json.dumps(record).encode(), int(event.time * 1e9), 0)

    def tick(self, now: float) -> None:
        """See ``Recorder``."""
        if now - self._flushed_at >= FLUSH_INTERVAL:
            self._flushed_at = now
            self._write(self._writer.flush)

    def close(self) -> None:
        """See ``Recorder``."""
        if self._file is not None:
            file, self._file = self._file, None
            self._write(self._writer.finish)
            self._write(file.close)

    def _add(self, channel: int, received: float, data: bytes, device_ns: int, sequence: int) -> None:
        def add() -> None:
            self._writer.add_message(channel, int(received * 1e9), data, min(device_ns, (1 << 64) - 1), sequence)

        self._write(add)

    def _write(self, write: Callable[[], Any]) -> None:
        """Call a function of the writer; report its I/O error as a SonarError."""
        try:
            write()
        except OSError as failure:
            needed = "enough disk space for the recording"
            raise SonarError(f"{shown(self._filename)}: {failure.strerror}; needed is {needed}") from None


def read_mcap(
    filename: str | os.PathLike[str], *, on_damage: Callable[[], None] | None = None
) -> Iterator[tuple[str, float, bytes]]:
    """Read a raw recording from its beginning, a truncated or damaged one as far as possible.

    Args:
        filename: the file.
        on_damage: called if the file is truncated or damaged, after everything before was yielded.

    Yields:
        Topic, host clock in seconds since 1970, and the frame or the JSON text.

    Raises:
        SonarError: the file cannot be read, is not a raw recording, or the extra is missing.
    """
    mcap_records, _ = _mcap(filename)
    try:
        with open(filename, "rb") as file:
            topics: dict[int, str] = {}
            started, whole = False, False
            try:
                for record in mcap_records.StreamReader(file, record_size_limit=1 << 28).records:
                    started = True
                    if isinstance(record, mcap_records.Channel):
                        topics[record.id] = record.topic
                    elif isinstance(record, mcap_records.Message) and record.channel_id in topics:
                        yield topics[record.channel_id], record.log_time * 1e-9, record.data
                    whole = isinstance(record, mcap_records.Footer)
            except OSError:
                raise
            except Exception:  # the library raises many types on truncated data
                if not started:
                    raise SonarError(f"{shown(filename)}: this is no MCAP file; needed is a record (MCAP)") from None
            if not whole and on_damage is not None:
                on_damage()
            if topics and MESSAGES not in topics.values():
                others = shown(", ".join(sorted(topics.values())))
                raise SonarError(f"{shown(filename)}: topics {others}; needed is {MESSAGES}, which a record has")
    except OSError as failure:
        needed = "a readable file with a record (MCAP)"
        raise SonarError(f"{shown(filename)}: {failure.strerror}; needed is {needed}") from None


def play_mcap(url: Url, *, speed: float) -> Source:
    """Replay a raw recording.

    Args:
        url: its ``path`` is the filename.
        speed: playback speed; 0: as fast as possible.

    Raises:
        SonarError: the file cannot be read.
    """
    frames = ((time_s, data) for topic, time_s, data in read_mcap(url.path) if topic == MESSAGES)
    return FramePlayer(url, frames, speed=speed)


def _mcap(filename: str | os.PathLike[str]) -> tuple[Any, Any]:
    """The classes for reading, and the module for writing, of the library ``mcap``."""
    try:
        import mcap.records
        import mcap.stream_reader
        import mcap.writer
    except ImportError:
        raise SonarError(f"{shown(filename)}: records need the extra live: pip install 'jaxsonar[live]'") from None

    class McapRecords:
        StreamReader = mcap.stream_reader.StreamReader
        Channel, Message, Footer = mcap.records.Channel, mcap.records.Message, mcap.records.Footer

    return McapRecords, mcap.writer
