"""Raw recordings of ``jaxsonar stream --record`` (MCAP) as scans."""

import os
import warnings
from collections.abc import Iterator

from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.mcap_recorder import MESSAGES, read_mcap
from jaxsonar.hardware.protocol import Decoder
from jaxsonar.hardware.scan_assembler import ScanAssembler
from jaxsonar.scans.raw_scans import group_paths, scan_from_raw
from jaxsonar.scans.recording_journal import TruncatedRecording
from jaxsonar.scans.scan_log import Scan
from jaxsonar.sensors.ring import Ring


def recorded_scans(
    filename: str | os.PathLike[str], *, ring: Ring | None = None, name: str | None = None
) -> Iterator[Scan]:
    """The scans of a raw recording, each at the pose of its first firing.

    Args:
        filename: the MCAP file.
        ring: the sensors, which order the echoes and know which paths a firing group measures; None: any sensor is
            allowed, in order of arrival, and only paths with an echo count as measured.
        name: name of the file in error messages; the filename if omitted.

    Warns with ``TruncatedRecording`` if the file ends early or is damaged.

    Raises:
        SonarError: the file cannot be read or holds no message of a device, a sensor is not in the ring, or the extra
            is missing.
    """
    name = os.fspath(filename) if name is None else name
    sensors = None if ring is None else ring.count
    paths = None if ring is None else group_paths(ring)
    decoder, assembler = Decoder(sensors=sensors), ScanAssembler(sensors=sensors, group_paths=paths)
    frames, damage = 0, list[bool]()
    for topic, received, frame in read_mcap(filename, on_damage=lambda: damage.append(True)):
        if topic == MESSAGES:
            frames += 1
            for message in decoder.feed(frame):
                assembler.unknown_messages = decoder.counts.unknown + decoder.counts.newer > 0
                yield from map(scan_from_raw, assembler.push(message, received))
            if decoder.counts.out_of_ring and sensors is not None:
                raise SonarError(f"{shown(name)}: an unknown sensor came; allowed is 0 to {sensors - 1}")
    if not frames:
        raise SonarError(f"{shown(name)}: no message of a device can be read; needed is a whole raw recording (MCAP)")
    yield from map(scan_from_raw, assembler.flush())
    if damage or decoder.counts.damaged:
        lost = f", {decoder.counts.damaged} damaged ones are left out" if decoder.counts.damaged else ""
        message = f"{shown(name)}: the recording is incomplete or damaged: {frames} messages are read{lost}"
        warnings.warn(message, TruncatedRecording, stacklevel=2)
