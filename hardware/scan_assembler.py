"""Firing groups to scans: put together what belongs together, whatever a link loses, repeats, mixes or delays.

A scan is handed on when all its groups are there, when the scan after it is, when a group of the scan after that
comes, or when nothing has come for a while. What comes later than that is counted and dropped.
"""

from bisect import bisect_left, insort
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, Shaped

from .messages import ECHO, Group, Message, Pose

REFERENCE_SPEED_OF_SOUND = 343.2
"""Metres a second; what a log's ranges are times of flight at, whatever the air was."""
MOST_GROUPS = 256
"""Groups of one scan; a sender that claims more is not believed."""
WAITED = 0.5
"""Seconds without a word after which an incomplete scan is handed on."""
MOST_ECHOES = 1 << 14
"""Echoes of one scan, likewise."""
_LATE = 64  # messages; older ones come from a sender that started anew, or are lost
_LATE_US = 2_000_000  # device time, likewise
_REMEMBERED = 256  # messages, to tell repeated ones and gaps
_CLOSED = 64  # scans that were handed on, to tell late groups
_HOLD = 3  # messages that a complete scan waits for one that should have come before
_WRAP = 1 << 32


@dataclass(frozen=True, eq=False)
class RawScan:
    """One scan as the device told it: times of flight, its own clock, and a pose for each firing group."""

    scan: int
    """The device's number; where a device starts anew, its numbers are made to go on."""
    stamp: float
    """Device clock when the first group fired, seconds; made to go on likewise."""
    pose: Float[np.ndarray, " 3"]
    """world_from_robot of the last group: x, y (m), theta (rad); NaN where it is not known for certain."""
    group_pose: Float[np.ndarray, "groups 3"]
    """The same of each group; NaN where the group is missing or its pose is not known."""
    echoes: Shaped[np.ndarray, " echoes"]
    """``messages.ECHO``, group by group; of a ring of known size in the order of its paths, nearest first."""
    group: Int[np.ndarray, " echoes"]
    """Group of each echo."""
    temperature: float
    """Of the air, degrees Celsius, the mean of what the groups say; NaN where none does."""
    missing: int
    """Groups that did not come."""
    received: float
    """Host clock when the last group came, seconds (``time.monotonic``)."""

    @property
    def ranges(self) -> Float[np.ndarray, " echoes"]:
        """Half path lengths as a log has them, metres: the one place where times of flight become ranges."""
        return self.echoes["time_us"].astype(np.float64) * (1e-6 * REFERENCE_SPEED_OF_SOUND / 2)


@dataclass
class AssemblyCounts:
    """What an assembler met."""

    scans: int = 0
    """Scans handed on."""
    echoes: int = 0
    """Echoes in them."""
    missing: int = 0
    """Groups that those scans lack."""
    repeated: int = 0
    """Messages that came more than once."""
    late: int = 0
    """Messages that came after their scan was handed on."""
    restarts: int = 0
    """Times that the sender started anew."""
    impossible: int = 0
    """Groups that do not fit their scan, or claim more than ``MOST_GROUPS`` or ``MOST_ECHOES``."""
    lost: int = 0
    """Sequence numbers that never came, of messages that were lost, damaged or unknown."""


@dataclass
class _Open:
    """A scan that is being put together."""

    groups: int
    parts: dict[int, tuple[int, Group]] = field(default_factory=dict)
    """Sequence number and group, by number of the group."""
    last: float = 0.0
    """Host clock of the latest group."""
    echoes: int = 0
    """Of all parts."""

    @property
    def complete(self) -> bool:
        return len(self.parts) == self.groups


class Assembler:
    """Messages of ONE sender in, scans out; holds at most three scans and the latest messages' numbers."""

    def __init__(self, *, sensors: int | None = None, waited: float = WAITED):
        """A new assembler.

        Args:
            sensors: of the ring, for the order of the echoes; None: as they came.
            waited: seconds without a group after which ``expire`` hands an incomplete scan on.
        """
        self.counts = AssemblyCounts()
        self.skipped = False
        """The sender also says what the decoder does not know, so that a gap in the numbers need not be a lost pose."""
        self._sensors, self._waited = sensors, waited
        self._suspect: Message | None = None
        self._anew = False
        self._scan_offset, self._clock_offset = 0, 0.0
        self._last_stamp, self._last_received = 0.0, 0.0
        self._lost_before = 0
        self._forget()

    def _forget(self) -> None:
        """What is only known of one run of the sender."""
        self._open: dict[int, _Open] = {}
        self._closed: deque[int] = deque(maxlen=_CLOSED)
        self._seen: dict[int, tuple[int, int | None]] = {}  # sequence -> device time, and count of groups up to it
        self._poses: list[tuple[int, Pose]] = []  # by sequence
        self._first = self._newest = -1
        self._distinct = 0
        self._newest_time = 0
        self._newest_scan = -1

    def push(self, message: Message, received: float) -> list[RawScan]:
        """Take in one message.

        Args:
            message: in the order of arrival.
            received: host clock, seconds (``time.monotonic``).

        Returns:
            The scans that this completes or closes, oldest first.
        """
        if self._newest >= 0 and self._is_from_before(message):
            suspect, self._suspect = self._suspect, message
            if suspect is None or not _follows(suspect, message):
                self.counts.late += suspect is not None
                return []
            # Two in a row: the sender has started anew, its numbers and perhaps its clock with it.
            closed = self._start_anew(suspect, received)
            return [*closed, *self._taken(suspect, received), *self._taken(message, received)]
        if self._suspect is not None:
            self.counts.late += 1
            self._suspect = None
        return self._taken(message, received)

    def expire(self, now: float) -> list[RawScan]:
        """Scans whose groups have not come for too long.

        Args:
            now: host clock, seconds (``time.monotonic``).
        """
        stale = [number for number, scan in self._open.items() if now - scan.last > self._waited]
        return self._handed_on(max(stale)) if stale else []

    def flush(self) -> list[RawScan]:
        """Everything that is left, at the end of a stream."""
        self.counts.late += self._suspect is not None
        self._suspect = None
        return self._handed_on(max(self._open, default=-1))

    def _is_from_before(self, message: Message) -> bool:
        sequence = self._unwrapped(message.sequence)
        known = self._seen.get(sequence)
        return (
            sequence <= self._newest - _LATE
            or message.time_us < self._newest_time - _LATE_US
            or (known is not None and known[0] != message.time_us)
        )

    def _unwrapped(self, sequence: int) -> int:
        """A sequence number that goes on beyond 2^32."""
        if self._newest < 0:
            return sequence
        return self._newest + (sequence - self._newest + _WRAP // 2) % _WRAP - _WRAP // 2

    def _start_anew(self, message: Message, received: float) -> list[RawScan]:
        closed = self._handed_on(max(self._open, default=-1))
        newest, self._lost_before, self._suspect = self._newest_scan, self.counts.lost, None
        self.counts.restarts += 1
        self._forget()
        self._anew, self._newest_scan = True, newest
        # The stamps say how long nothing came.
        stamp = self._last_stamp + max(0.0, received - self._last_received)
        self._clock_offset = stamp - message.time_us * 1e-6
        return closed

    def _taken(self, message: Message, received: float) -> list[RawScan]:
        sequence = self._unwrapped(message.sequence)
        if sequence in self._seen:
            self.counts.repeated += 1
            return []
        self._first = sequence if self._newest < 0 else min(self._first, sequence)
        self._newest = max(self._newest, sequence)
        self._distinct += 1
        self.counts.lost = self._lost_before + self._newest - self._first + 1 - self._distinct
        self._newest_time = max(self._newest_time, message.time_us)
        rank = None
        if isinstance(message, Group):
            rank = message.scan * message.groups + message.group
        self._seen[sequence] = (message.time_us, rank)
        if len(self._seen) > _REMEMBERED:
            del self._seen[next(iter(self._seen))]
        if isinstance(message, Pose):
            insort(self._poses, (sequence, message), key=_sequence)
            del self._poses[:-_REMEMBERED]
            return self._due()
        return self._put(sequence, message, received)

    def _put(self, sequence: int, group: Group, received: float) -> list[RawScan]:
        closed: list[RawScan] = []
        number = group.scan + self._scan_offset
        if self._anew or (number < self._newest_scan - _CLOSED and sequence == self._newest):
            # Scans are counted anew; a number is left out, so that no number comes twice.
            closed, self._anew = self._handed_on(max(self._open, default=-1)), False
            self._scan_offset = self._newest_scan + 2 - group.scan
            number = group.scan + self._scan_offset
        if number in self._closed:
            self.counts.late += 1
            return closed
        scan = self._open.get(number, _Open(group.groups))
        if group.groups > MOST_GROUPS or group.groups != scan.groups:
            self.counts.impossible += 1
            return closed
        if group.group in scan.parts:
            self.counts.repeated += 1
            return closed
        if scan.echoes + len(group.echoes) > MOST_ECHOES:
            self.counts.impossible += 1
            return closed
        self._open[number] = scan
        scan.echoes += len(group.echoes)
        scan.parts[group.group] = (sequence, group)
        scan.last = self._last_received = received
        self._newest_scan = max(self._newest_scan, number)
        return closed + self._due()

    def _due(self) -> list[RawScan]:
        """Hand on what is complete, and what comes before it or too far behind."""
        due = [
            number
            for number, scan in self._open.items()
            if number <= self._newest_scan - 2 or (scan.complete and not self._waits(scan))
        ]
        return self._handed_on(max(due)) if due else []

    def _waits(self, scan: _Open) -> bool:
        """Whether a pose of a complete scan may still be on its way: a number just before a group has not come."""
        sequences = [sequence for sequence, _ in scan.parts.values()]
        if self.skipped or self._newest >= max(sequences) + _HOLD:
            return False
        return any(s - 1 not in self._seen and s - 1 >= self._first for s in sequences)

    def _handed_on(self, up_to: int) -> list[RawScan]:
        numbers = sorted(number for number in self._open if number <= up_to)
        scans = [self._raw(number, self._open.pop(number)) for number in numbers]
        self._closed.extend(numbers)
        return scans

    def _raw(self, number: int, scan: _Open) -> RawScan:
        order = sorted(scan.parts)
        groups = [scan.parts[k][1] for k in order]
        poses = np.full((scan.groups, 3), np.nan)
        for k in order:
            poses[k] = self._pose_before(scan.parts[k][0])
        last = max(order, key=lambda k: (scan.parts[k][1].time_us, k))
        stamp = min(part.time_us for part in groups) * 1e-6 + self._clock_offset
        self._last_stamp = max(stamp, scan.parts[last][1].time_us * 1e-6 + self._clock_offset)
        echoes = np.frombuffer(bytearray().join(part.echoes.tobytes() for part in groups), ECHO)
        group = np.repeat(np.array(order, dtype=np.int64), [len(part.echoes) for part in groups])
        if self._sensors is not None:
            by_path = _path_order(echoes, self._sensors)
            echoes, group = echoes[by_path], group[by_path]
        measured = [part.temperature for part in groups if not np.isnan(part.temperature)]
        missing = scan.groups - len(groups)
        self.counts.scans += 1
        self.counts.echoes += len(echoes)
        self.counts.missing += missing
        return RawScan(
            scan=number,
            stamp=stamp,
            pose=poses[last].copy(),
            group_pose=poses,
            echoes=echoes,
            group=group,
            temperature=float(np.mean(measured)) if measured else float("nan"),
            missing=missing,
            received=scan.last,
        )

    def _pose_before(self, sequence: int) -> tuple[float, float, float]:
        """The latest pose sent before a message; NaN where a later one may have been lost."""
        before = bisect_left(self._poses, sequence, key=_sequence)
        if not before:
            return (np.nan, np.nan, np.nan)
        number, pose = self._poses[before - 1]
        if not self.skipped and self._pose_lost(number, sequence):
            return (np.nan, np.nan, np.nan)
        return (pose.x, pose.y, pose.theta)

    def _pose_lost(self, pose: int, group: int) -> bool:
        """Whether more messages are missing between a pose and a group than there are groups missing around it."""
        if group - pose > _REMEMBERED // 2 or all(s in self._seen for s in range(pose + 1, group)):
            return False
        own = self._seen.get(group, (0, None))[1]
        before = max((s for s, (_, rank) in self._seen.items() if rank is not None and s < pose), default=None)
        first = pose if before is None else before
        known = [rank for s, (_, rank) in self._seen.items() if first < s < group]
        messages = group - first - 1 - len(known)
        rank = None if before is None else self._seen[before][1]
        if own is None or rank is None:
            return True
        groups = own - rank - 1 - sum(between is not None for between in known)
        return messages > groups


def _sequence(entry: tuple[int, Pose]) -> int:
    return entry[0]


def _follows(earlier: Message, later: Message) -> bool:
    """Whether two messages can be neighbors of one run of a sender."""
    step = (later.sequence - earlier.sequence) % _WRAP
    return 0 < step <= _LATE and 0 <= later.time_us - earlier.time_us <= 10 * _LATE_US


def _path_order(echoes: Shaped[np.ndarray, " echoes"], sensors: int) -> Int[np.ndarray, " echoes"]:
    """The order of a ring's paths: by neighbor 0, +1, -1, +2, -2, ..., then by transmitter, then nearest first."""
    tx, rx = echoes["tx"].astype(np.int64), echoes["rx"].astype(np.int64)
    offset = (rx - tx) % sensors
    behind = 2 * offset > sensors
    rank = np.where(behind, 2 * (sensors - offset), 2 * offset - 1)
    return np.lexsort([echoes["time_us"], tx, rank])
