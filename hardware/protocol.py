"""Frames on the wire: COBS, ended by 0x00, little-endian, CRC-32 (``docs/protocol.md``, ``jaxsonar_wire.h``).

A frame that a link damaged, or that says what no device can say, is counted and never becomes an echo.
"""

import struct
import zlib
from dataclasses import dataclass

import numpy as np
from cobs import cobs

from .errors import SonarError
from .messages import ECHO, Group, Message, Pose

MAJOR, MINOR = 1, 0
"""The version of the protocol. Each type of message carries the version that its layout first had."""
GROUP, POSE, END = 1, 2, 3
"""Types of messages."""
LARGEST_GROUP = 4096
"""Echoes in one frame."""
LONGEST_TIME_US = 1e6
"""Time of flight: 171 m there and 171 m back."""
COLDEST, HOTTEST = -100.0, 200.0
"""Degrees Celsius."""
FARTHEST = 1e8
"""Metres, of an odometry."""
LARGEST_ANGLE = 1e6
"""Radians, of an odometry that does not wrap."""

_HEAD = struct.Struct("<BBBBIQ")
_GROUP = struct.Struct("<BBBBIQIHHfHH")
_POSE = struct.Struct("<BBBBIQddd")
_CRC = struct.Struct("<I")
LONGEST_PAYLOAD = _GROUP.size + LARGEST_GROUP * ECHO.itemsize + _CRC.size
LONGEST_FRAME = LONGEST_PAYLOAD + LONGEST_PAYLOAD // 254 + 1
"""Bytes of a frame on the wire, without the 0x00 that ends it; it fits a UDP datagram."""


@dataclass
class Counts:
    """What a decoder met."""

    frames: int = 0
    """Frames understood."""
    damaged: int = 0
    """Pieces between two 0x00 that are no whole frame, or whose CRC is wrong."""
    oversized: int = 0
    """Pieces longer than any frame, thrown away as they came."""
    impossible: int = 0
    """Frames with a right CRC that hold what no device can mean: counts, times or numbers out of bounds."""
    out_of_ring: int = 0
    """Frames with sensors that the ring does not have."""
    unknown: int = 0
    """Frames of a type that this version does not know."""
    newer: int = 0
    """Frames of a newer minor version, skipped."""
    refused: int = 0
    """Frames of a newer major version."""

    @property
    def rejected(self) -> int:
        """Everything that did not become a message."""
        return sum(vars(self).values()) - self.frames


def encode(message: Message) -> bytes:
    """A message as a frame, with the 0x00 that ends it.

    Args:
        message: floats of a ``Group`` are rounded to 32 bits; those of a ``Pose`` stay as they are.

    Raises:
        SonarError: a value that no frame can hold, named with what is allowed.
    """
    _whole("sequence", message.sequence, 32)
    _whole("time_us", message.time_us, 64)
    if isinstance(message, Pose):
        pose = (message.x, message.y, message.theta)
        if not _possible_pose(*pose):
            allowed = f"x and y up to {FARTHEST:g} m, theta up to {LARGEST_ANGLE:g} rad, or NaN for all three"
            raise SonarError(f"pose message: {pose} came; allowed are {allowed}")
        return frame(_POSE.pack(MAJOR, MINOR, POSE, 0, message.sequence, message.time_us, *pose))
    _check_group(message)
    head = (message.sequence, message.time_us, message.scan, message.group, message.groups, message.temperature)
    return frame(_GROUP.pack(MAJOR, MINOR, GROUP, 0, *head, len(message.echoes), 0) + message.echoes.tobytes())


def encode_end(sequence: int, time_us: int) -> bytes:
    """The frame of a sender that says no more: how a stream ends on lines that cannot be closed (udp, serial, pty).

    Args:
        sequence: as in every message.
        time_us: device clock, microseconds.

    Raises:
        SonarError: a value that no frame can hold.
    """
    _whole("sequence", sequence, 32)
    _whole("time_us", time_us, 64)
    return frame(_HEAD.pack(MAJOR, MINOR, END, 0, sequence, time_us))


def frame(record: bytes) -> bytes:
    """Any record as a frame: CRC-32 behind it, COBS, 0x00. What it holds is not looked at."""
    return cobs.encode(record + _CRC.pack(zlib.crc32(record))) + b"\0"


class Decoder:
    """Bytes of any source, in pieces of any size, to messages. Holds at most one frame's worth of bytes.

    How the bytes are cut into pieces makes no difference to messages and counts.
    """

    def __init__(self, *, sensors: int | None = None):
        """A decoder for one sender.

        Args:
            sensors: sensors of the ring; a frame with a number beyond is counted as ``out_of_ring``. None: any number.
        """
        self.counts = Counts()
        self.ended = False
        """The sender's last frame said that it was the last; a later frame takes that back."""
        self.version = (MAJOR, MINOR)
        """The newest version that the sender used, (major, minor)."""
        self._sensors = 1 << 16 if sensors is None else sensors
        self._held = bytearray()
        self._skipping = False

    def feed(self, data: bytes) -> list[Message]:
        """The messages that these bytes complete, in their order.

        Args:
            data: what came, a part of a frame or many of them.
        """
        messages = []
        *ends, rest = data.split(b"\0")
        for piece in ends:
            if self._held:
                piece = bytes(self._held + piece)
                self._held.clear()
            if self._skipping:
                self._skipping = False  # counted when it grew too long
            elif len(piece) > LONGEST_FRAME:
                self.counts.oversized += 1
            elif piece:  # nothing between two 0x00 is how a sender makes sure that a new frame begins
                message = self._message(piece)
                if message is not None:
                    messages.append(message)
        if not self._skipping:
            self._held += rest[: LONGEST_FRAME + 1]
            if len(self._held) > LONGEST_FRAME:
                self.counts.oversized += 1
                self._held.clear()
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
        *_, sequence, time_us, scan, group, groups, temperature, count, zero = _GROUP.unpack_from(payload)
        # The length must be what the count says: with it, damage that a CRC lets through has to be right twice.
        if (
            size != _GROUP.size + count * ECHO.itemsize
            or zero
            or count > LARGEST_GROUP
            or group >= groups
            or temperature < COLDEST
            or temperature > HOTTEST
        ):
            counts.impossible += 1
            return None
        echoes = np.frombuffer(payload, ECHO, count, _GROUP.size)
        if count and not _possible_echoes(echoes):
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
        if not _possible_pose(x, y, theta):
            self.counts.impossible += 1
            return None
        self.counts.frames += 1
        self.ended = False
        return Pose(sequence, time_us, x, y, theta)


def _possible_pose(x: float, y: float, theta: float) -> bool:
    if x != x and y != y and theta != theta:  # NaN, all of them: not known
        return True
    return abs(x) <= FARTHEST and abs(y) <= FARTHEST and abs(theta) <= LARGEST_ANGLE


def _possible_echoes(echoes: np.ndarray) -> bool:
    time = echoes["time_us"]
    # min and max of anything with NaN are NaN, which compares as False
    return bool(time.min() > 0 and time.max() <= LONGEST_TIME_US and not np.isinf(echoes["amplitude"]).any())


def _whole(name: str, value: int, bits: int) -> None:
    if not 0 <= value < 1 << bits:
        raise SonarError(f"message: {name} {value} came; allowed is a whole number of {bits} bits, 0 or more")


def _check_group(message: Group) -> None:
    _whole("scan", message.scan, 32)
    _whole("groups", message.groups, 16)
    place = f"group message (scan {message.scan}, group {message.group})"
    if not 0 <= message.group < message.groups:
        allowed = f"0 to groups - 1, which is {message.groups - 1}"
        raise SonarError(f"{place}: group {message.group} came; allowed is {allowed}")
    if message.temperature < COLDEST or message.temperature > HOTTEST:
        allowed = f"{COLDEST:g} to {HOTTEST:g} deg C, or NaN"
        raise SonarError(f"{place}: temperature {message.temperature:g} came; allowed is {allowed}")
    echoes = message.echoes
    if echoes.dtype != ECHO:
        raise SonarError(f"{place}: echoes of type {echoes.dtype} came; allowed is messages.ECHO")
    if len(echoes) > LARGEST_GROUP:
        raise SonarError(f"{place}: {len(echoes)} echoes came; allowed are up to {LARGEST_GROUP}")
    if len(echoes) and not _possible_echoes(echoes):
        allowed = f"times above 0 and up to {LONGEST_TIME_US:g} us, amplitudes finite or NaN"
        raise SonarError(f"{place}: an echo that no device can report came; allowed are {allowed}")
