"""Replay of scan logs and raw recordings: the source ``file:LOG?speed=1``, and messages for ``jaxsonar emulate``."""

import os
from collections.abc import Iterator
from itertools import chain

from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.frame_player import FramePlayer
from jaxsonar.hardware.mcap_recorder import MESSAGES, read_mcap
from jaxsonar.hardware.messages import Message
from jaxsonar.hardware.protocol import Decoder, encode
from jaxsonar.hardware.recorder import open_recording, playback_speed
from jaxsonar.hardware.transport_base import OnEvent, Source, Url
from jaxsonar.recordings.file_content import file_content
from jaxsonar.recordings.load_log import load_log
from jaxsonar.scans.single_firings import group_firings
from jaxsonar.sensors.ring import Ring
from jaxsonar.simulation.device_messages import log_messages


def messages_of(filename: str | os.PathLike[str], ring: Ring) -> Iterator[Message]:
    """The messages of a device that would give this log or raw recording.

    Args:
        filename: a raw recording, or another file that ``load_log`` reads.
        ring: the sensors; its firing groups split the scans of a log into messages.

    Raises:
        SonarError: the file cannot be read, or holds values that no device can report.
    """
    if _is_raw_recording(filename):
        messages = _raw_messages(filename, ring)
        first = next(messages, None)  # reports an unreadable file here
        return messages if first is None else chain([first], messages)
    try:
        return log_messages(group_firings(load_log(filename, ring=ring)), ring)
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
        if _is_raw_recording(url.path):
            return open_recording(url, on_event=on_event, reconnect=reconnect, silence=silence)
        return LogPlayer(url, ring)

    return open_log


def _is_raw_recording(filename: str | os.PathLike[str]) -> bool:
    """Whether a file holds raw messages (``stream --record x.mcap``)."""
    return os.path.isfile(filename) and file_content(filename).format == "record"


class LogPlayer(FramePlayer):
    """Replays a scan log or a raw recording as a device."""

    def __init__(self, url: Url, ring: Ring):
        """Read the log.

        Args:
            url: ``file:LOG?speed=1``; speed 0 is as fast as possible.
            ring: the sensors; see ``messages_of``.

        Raises:
            SonarError: as in ``messages_of``, or an invalid option.
        """
        speed = playback_speed(url)
        frames = ((message.time_us * 1e-6, encode(message)) for message in messages_of(url.path, ring))
        super().__init__(url, frames, speed=speed)
