"""Replay of scan logs and raw recordings: the source ``file:LOG?speed=1``, and messages for ``jaxsonar emulate``."""

import os
from collections.abc import Callable, Iterator
from itertools import chain

from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.frame_player import FramePlayer
from jaxsonar.hardware.mcap_recorder import MESSAGES, read_mcap
from jaxsonar.hardware.messages import Message
from jaxsonar.hardware.protocol import Decoder, encode
from jaxsonar.hardware.recorder import open_recording, playback_speed
from jaxsonar.hardware.transport_base import LinkEvent, OnEvent, Source, Url
from jaxsonar.plausibility.prepared_log import prepared_log
from jaxsonar.recordings.file_content import file_content
from jaxsonar.recordings.input_options import InputOptions
from jaxsonar.recordings.load_log import load_log
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.simulation.device_messages import log_messages


def messages_of(
    filename: str | os.PathLike[str],
    ring: Ring,
    *,
    options: InputOptions = InputOptions(),  # noqa: B008  immutable
    on_note: Callable[[str], None] | None = None,
) -> Iterator[Message]:
    """The messages of a device that would give this log or raw recording.

    Args:
        filename: a raw recording, or another file that ``load_log`` reads.
        ring: the sensors; its firing groups split the scans of a log into messages.
        options: how a log is read.
        on_note: called with one line for each choice and each warning about a log, as in ``prepared_log``.

    Raises:
        SonarError: the file cannot be read, or holds values that no device can report.
    """
    if _is_raw_recording(filename):
        messages = _raw_messages(filename, ring)
        first = next(messages, None)  # reports an unreadable file here
        return messages if first is None else chain([first], messages)
    try:
        return messages_of_log(load_log(filename, ring=ring, options=options, on_note=on_note), ring, on_note=on_note)
    except SonarError as error:
        text = str(error)
        raise SonarError(text if text.startswith(shown(filename)) else f"{shown(filename)}: {text}") from None


def messages_of_log(log: Log, ring: Ring, *, on_note: Callable[[str], None] | None = None) -> Iterator[Message]:
    """The messages of a device that would give this log, which is prepared as for all computations (``prepared_log``).

    Args:
        log: the scans, as they were recorded.
        ring: the sensors; its firing groups split the scans into messages.
        on_note: as in ``prepared_log``.

    Raises:
        SonarError: the log holds values that no device can report.
    """
    return log_messages(prepared_log(ring, log, on_note=on_note or _no_note), ring)


def _no_note(text: str) -> None:
    """Drop a note."""


def _raw_messages(filename: str | os.PathLike[str], ring: Ring) -> Iterator[Message]:
    decoder = Decoder(sensors=ring.count)
    for topic, _, frame in read_mcap(filename):
        if topic == MESSAGES:
            yield from decoder.feed(frame)
            if decoder.counts.out_of_ring:
                raise SonarError(
                    f"{shown(filename)}: a sensor beyond the ring came; allowed with it is 0 to {ring.count - 1}"
                )


def file_opener(ring: Ring, options: InputOptions = InputOptions()):  # noqa: B008  immutable
    """An opener of ``file:`` URLs for scan logs and raw recordings, for ``register_transport``.

    Args:
        ring: the sensors; see ``messages_of``.
        options: how a log is read.
    """

    def open_log(url: Url, *, on_event: OnEvent, reconnect: bool, silence: float) -> Source:
        if _is_raw_recording(url.path):
            return open_recording(url, on_event=on_event, reconnect=reconnect, silence=silence)
        return LogPlayer(url, ring, options, on_event)

    return open_log


def _is_raw_recording(filename: str | os.PathLike[str]) -> bool:
    """Whether a file holds raw messages (``stream --record x.mcap``)."""
    return os.path.isfile(filename) and file_content(filename).format == "record"


class LogPlayer(FramePlayer):
    """Replays a scan log or a raw recording as a device."""

    def __init__(self, url: Url, ring: Ring, options: InputOptions, on_event: OnEvent):
        """Read the log.

        Args:
            url: ``file:LOG?speed=1``; speed 0 is as fast as possible.
            ring: the sensors; see ``messages_of``.
            options: how the log is read.
            on_event: called with a ``note`` for each choice and each warning about the log.

        Raises:
            SonarError: as in ``messages_of``, or an invalid option.
        """
        speed = playback_speed(url)
        messages = messages_of(url.path, ring, options=options, on_note=lambda text: on_event(LinkEvent("note", text)))
        frames = ((message.time_us * 1e-6, encode(message)) for message in messages)
        super().__init__(url, frames, speed=speed)
