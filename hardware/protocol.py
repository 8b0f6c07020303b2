"""Wire protocol: COBS frames terminated by 0x00, little-endian, CRC-32 (``docs/protocol.md``, ``jaxsonar_wire.h``).

A damaged frame, or a frame with values that no device can report, is counted and discarded.
"""

import struct
import zlib
from dataclasses import dataclass

import numpy as np
from cobs import cobs

from .errors import SonarError
from .messages import ECHO, Group, Message, Pose

MAJOR, MINOR = 1, 0
"""Protocol version. Each message type carries the version in which its layout was introduced."""
GROUP, POSE, END = 1, 2, 3
"""Message types."""
MAX_GROUP_ECHOES = 4096
"""Maximum number of echoes in one frame."""
MAX_TIME_OF_FLIGHT_US = 1e6
"""Maximum two-way time of flight, microseconds: a range of 171 m."""
MIN_TEMPERATURE, MAX_TEMPERATURE = -100.0, 200.0
"""Limits of the air temperature, degrees Celsius."""
MAX_POSITION = 1e8
"""Maximum absolute odometry position, metres."""
MAX_ANGLE = 1e6
"""Maximum absolute odometry heading, radians; odometry need not wrap."""

_HEAD = struct.Struct("<BBBBIQ")
_GROUP = struct.Struct("<BBBBIQIHHfHH")
_POSE = struct.Struct("<BBBBIQddd")
_CRC = struct.Struct("<I")
MAX_PAYLOAD_BYTES = _GROUP.size + MAX_GROUP_ECHOES * ECHO.itemsize + _CRC.size
MAX_FRAME_BYTES = MAX_PAYLOAD_BYTES + MAX_PAYLOAD_BYTES // 254 + 1
"""Maximum size of a frame without its final 0x00; it fits a UDP datagram."""


@dataclass
class DecoderCounts:
    """Counters of a decoder."""

    frames: int = 0
    """Valid frames."""
    damaged: int = 0
    """Data between two 0x00 that is not valid COBS, too short, or has a wrong CRC."""
    oversized: int = 0
    """Data longer than any frame, discarded on arrival."""
    impossible: int = 0
    """Frames with a valid CRC but invalid content: counts, times or numbers out of bounds."""
    out_of_ring: int = 0
    """Frames with sensor numbers that the ring does not have."""
    unknown: int = 0
    """Frames of an unknown message type."""
    newer: int = 0
    """Frames of a newer minor version; skipped."""
    refused: int = 0
    """Frames of a newer major version; rejected."""

    @property
    def rejected(self) -> int:
        """Number of all frames that gave no message."""
        return sum(vars(self).values()) - self.frames


def encode(message: Message) -> bytes:
    """Encode a message as a frame with its final 0x00.

    Args:
        message: floats of a ``Group`` are rounded to 32 bits; those of a ``Pose`` stay 64 bits.

    Raises:
        SonarError: a value outside its range; the message names the allowed range.
    """
    _check_unsigned("sequence", message.sequence, 32)
    _check_unsigned("time_us", message.time_us, 64)
    if isinstance(message, Pose):
        pose = (message.x, message.y, message.theta)
        if not _is_valid_pose(*pose):
            allowed = f"x and y up to {MAX_POSITION:g} m, theta up to {MAX_ANGLE:g} rad, or NaN for all three"
            raise SonarError(f"pose message: {pose} came; allowed are {allowed}")
        return encode_frame(_POSE.pack(MAJOR, MINOR, POSE, 0, message.sequence, message.time_us, *pose))
    _check_group(message)
    head = (message.sequence, message.time_us, message.scan, message.group, message.groups, message.temperature)
    return encode_frame(_GROUP.pack(MAJOR, MINOR, GROUP, 0, *head, len(message.echoes), 0) + message.echoes.tobytes())


def encode_end(sequence: int, time_us: int) -> bytes:
    """Encode an end frame. It ends a stream on links that cannot be closed (udp, serial, pty).

    Args:
        sequence: sequence number, shared with all messages.
        time_us: device clock, microseconds.

    Raises:
        SonarError: a value outside its range.
    """
    _check_unsigned("sequence", sequence, 32)
    _check_unsigned("time_us", time_us, 64)
    return encode_frame(_HEAD.pack(MAJOR, MINOR, END, 0, sequence, time_us))


def encode_frame(record: bytes) -> bytes:
    """Encode any record as a frame: append CRC-32, apply COBS, append 0x00. The content is not checked."""
    return cobs.encode(record + _CRC.pack(zlib.crc32(record))) + b"\0"


class Decoder:
    """Decodes a stream of bytes to messages. Buffers at most one frame.

    Messages and counters do not depend on how the stream is split into chunks.
    """

    def __init__(self, *, sensors: int | None = None):
        """A decoder for one device.

        Args:
            sensors: number of sensors; frames with a larger sensor number count as ``out_of_ring``. None: no limit.
        """
        self.counts = DecoderCounts()
        self.ended = False
        """The latest frame was an end frame. A later frame resets this."""
        self.version = (MAJOR, MINOR)
        """The newest version seen, (major, minor)."""
        self.received_bytes = 0
        """Number of bytes so far."""
        self._sensors = 1 << 16 if sensors is None else sensors
        self._buffer = bytearray()
        self._skipping = False

    def feed(self, data: bytes) -> list[Message]:
        """Decode a chunk of bytes.

        Args:
            data: any number of bytes: a part of a frame, or several frames.

        Returns:
            The messages that were completed, in order.
        """
        messages = []
        self.received_bytes += len(data)
        *pieces, rest = data.split(b"\0")
        for piece in pieces:
            if self._buffer:
                piece = bytes(self._buffer + piece)
                self._buffer.clear()
            if self._skipping:
                self._skipping = False  # already counted as oversized
            elif len(piece) > MAX_FRAME_BYTES:
                self.counts.oversized += 1
            elif piece:  # an empty piece is allowed: a device may send an extra 0x00 to resynchronize
                message = self._message(piece)
                if message is not None:
                    messages.append(message)
        if not self._skipping:
            self._buffer += rest[: MAX_FRAME_BYTES + 1]
            if len(self._buffer) > MAX_FRAME_BYTES:
                self.counts.oversized += 1
                self._buffer.clear()
                self._skipping = True
        return messages

    def _message(self, piece: bytes) -> Message | None:
        counts = self.counts
        try:
            payload = cobs.decode(piece)
        except cobs.DecodeError:
            counts.damaged += 1
            return None
        size = len(payload) - _CRC.size
        if size < _HEAD.size or _CRC.unpack_from(payload, size)[0] != zlib.crc32(memoryview(payload)[:size]):
            counts.damaged += 1
            return None
        major, minor, kind = payload[:3]
        self.version = max(self.version, (major, minor))
        if major > MAJOR:
            counts.refused += 1
        elif major == MAJOR and minor > MINOR:
            counts.newer += 1
        elif major < MAJOR or payload[3]:
            counts.impossible += 1
        elif kind == GROUP:
            return self._group(payload, size)
        elif kind == POSE:
            return self._pose(payload, size)
        elif kind != END:
            counts.unknown += 1
        elif size != _HEAD.size:
            counts.impossible += 1
        else:
            counts.frames += 1
            self.ended = True
        return None

    def _group(self, payload: bytes, size: int) -> Group | None:
        counts = self.counts
        if size < _GROUP.size:
            counts.impossible += 1
            return None
        *_, sequence, time_us, scan, group, groups, temperature, count, reserved = _GROUP.unpack_from(payload)
        # The redundancy of length and count catches damage that the CRC misses.
        if (
            size != _GROUP.size + count * ECHO.itemsize
            or reserved
            or count > MAX_GROUP_ECHOES
            or group >= groups
            or temperature < MIN_TEMPERATURE
            or temperature > MAX_TEMPERATURE
        ):
            counts.impossible += 1
            return None
        echoes = np.frombuffer(payload, ECHO, count, _GROUP.size)
        if count and not _are_valid_echoes(echoes):
            counts.impossible += 1
            return None
        if count and max(echoes["tx"].max(), echoes["rx"].max()) >= self._sensors:
            counts.out_of_ring += 1
            return None
        counts.frames += 1
        self.ended = False
        return Group(sequence, time_us, scan, group, groups, temperature, echoes)

    def _pose(self, payload: bytes, size: int) -> Pose | None:
        if size != _POSE.size:
            self.counts.impossible += 1
            return None
        *_, sequence, time_us, x, y, theta = _POSE.unpack_from(payload)
        if not _is_valid_pose(x, y, theta):
            self.counts.impossible += 1
            return None
        self.counts.frames += 1
        self.ended = False
        return Pose(sequence, time_us, x, y, theta)


def _is_valid_pose(x: float, y: float, theta: float) -> bool:
    if x != x and y != y and theta != theta:  # all NaN: pose unknown
        return True
    return abs(x) <= MAX_POSITION and abs(y) <= MAX_POSITION and abs(theta) <= MAX_ANGLE


def _are_valid_echoes(echoes: np.ndarray) -> bool:
    time = echoes["time_us"]
    # With a NaN, min and max are NaN, and the comparisons are False.
    return bool(time.min() > 0 and time.max() <= MAX_TIME_OF_FLIGHT_US and not np.isinf(echoes["amplitude"]).any())


def _check_unsigned(name: str, value: int, bits: int) -> None:
    if not 0 <= value < 1 << bits:
        raise SonarError(f"message: {name} {value} came; allowed is a whole number of {bits} bits, 0 or more")


def _check_group(message: Group) -> None:
    _check_unsigned("scan", message.scan, 32)
    _check_unsigned("groups", message.groups, 16)
    where = f"group message (scan {message.scan}, group {message.group})"
    if not 0 <= message.group < message.groups:
        allowed = f"0 to groups - 1, which is {message.groups - 1}"
        raise SonarError(f"{where}: group {message.group} came; allowed is {allowed}")
    if message.temperature < MIN_TEMPERATURE or message.temperature > MAX_TEMPERATURE:
        allowed = f"{MIN_TEMPERATURE:g} to {MAX_TEMPERATURE:g} deg C, or NaN"
        raise SonarError(f"{where}: temperature {message.temperature:g} came; allowed is {allowed}")
    echoes = message.echoes
    if echoes.dtype != ECHO:
        raise SonarError(f"{where}: echoes of type {echoes.dtype} came; allowed is messages.ECHO")
    if len(echoes) > MAX_GROUP_ECHOES:
        raise SonarError(f"{where}: {len(echoes)} echoes came; allowed are up to {MAX_GROUP_ECHOES}")
    if len(echoes) and not _are_valid_echoes(echoes):
        allowed = f"times above 0 and up to {MAX_TIME_OF_FLIGHT_US:g} us, amplitudes finite or NaN"
        raise SonarError(f"{where}: an echo that no device can report came; allowed are {allowed}")
