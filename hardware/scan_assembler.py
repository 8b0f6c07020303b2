"""Assembles firing groups to scans, in the presence of lost, repeated, reordered and delayed messages.

A scan is emitted when all its groups have arrived, when a later scan is emitted, when a group of the scan after the
next arrives, or after a timeout. Groups that arrive later are counted and dropped.
"""

from bisect import bisect_left, insort
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, Shaped

from .firing_plan import FiringPlan
from .messages import ECHO, REFERENCE_SPEED_OF_SOUND, Group, Message, Pose


@dataclass(frozen=True)
class AssemblerSettings:
    """Limits of the scan assembler. All values are chosen by hand."""

    max_groups: int = 256
    """Maximum number of groups in a scan; a message that claims more is invalid."""
    max_echoes: int = 1 << 14
    """Maximum number of echoes in a scan; a message that exceeds it is invalid."""
    incomplete_timeout: float = 0.5
    """Seconds without a new group after which an incomplete scan is emitted."""
    max_reordering: int = 64
    """Messages older than this, in sequence numbers, are late or belong to a restarted device."""
    max_clock_step_back_us: int = 2_000_000
    """Messages older than this, in device time (microseconds), are late or belong to a restarted device."""
    message_history: int = 256
    """Sequence numbers kept to detect repeated and missing messages."""
    scan_history: int = 64
    """Numbers of emitted scans kept to detect late groups."""
    pose_hold: int = 3
    """Messages for which a complete scan waits for a missing message that may be a pose."""


SETTINGS = AssemblerSettings()
_SEQUENCE_RANGE = 1 << 32


@dataclass(frozen=True, eq=False)
class RawScan:
    """One scan as the device reported it: times of flight, device clock, and one pose per firing group."""

    scan: int
    """Scan number of the device; continued if the device restarts."""
    stamp: float
    """Device clock at the first firing, seconds; continued if the device restarts."""
    pose: Float[np.ndarray, " 3"]
    """world_from_robot at the first firing: x, y (m), theta (rad); NaN if not known for certain."""
    group_pose: Float[np.ndarray, "groups 3"]
    """world_from_robot of each group; NaN if the group is missing or its pose is unknown."""
    group_time: Float[np.ndarray, " groups"]
    """When each group fired, seconds after ``stamp``; NaN if the group is missing."""
    echoes: Shaped[np.ndarray, " echoes"]
    """Dtype ``messages.ECHO``. In the order of the ring's paths, nearest first, if the number of sensors is known;
    otherwise group by group."""
    group: Int[np.ndarray, " echoes"]
    """Firing group of each echo; that of its transmitter's last echo, if a transmitter fired several times."""
    silent: Int[np.ndarray, "silent 3"] | None
    """Firing group, transmitter and receiver of the paths that were measured and heard nothing; None if it is not known
    which paths the device measures."""
    temperature: float
    """Air temperature, degrees Celsius: mean over the groups that report one; NaN if none does."""
    missing: int
    """Number of missing groups."""
    received: float
    """Host clock when the last group arrived, seconds (``time.monotonic``)."""

    @property
    def ranges(self) -> Float[np.ndarray, " echoes"]:
        """Half path lengths as in a log, metres. The only conversion of times of flight to ranges."""
        return self.echoes["time_us"].astype(np.float64) * (1e-6 * REFERENCE_SPEED_OF_SOUND / 2)

    @property
    def times(self) -> Float[np.ndarray, " echoes"]:
        """When the transmitter of each echo fired, seconds after ``stamp``."""
        return self.group_time[self.group]


@dataclass
class AssemblerCounts:
    """Counters of an assembler."""

    scans: int = 0
    """Scans emitted."""
    echoes: int = 0
    """Echoes in them."""
    missing: int = 0
    """Groups missing in those scans."""
    repeated: int = 0
    """Messages received more than once."""
    late: int = 0
    """Messages that arrived after their scan was emitted."""
    restarts: int = 0
    """Restarts of the device."""
    impossible: int = 0
    """Groups that contradict their scan, or exceed ``max_groups`` or ``max_echoes``."""
    lost: int = 0
    """Missing sequence numbers: lost, damaged or unknown messages."""


@dataclass
class _PartialScan:
    """A scan that is being assembled."""

    groups: int
    parts: dict[int, tuple[int, Group]] = field(default_factory=dict)
    """Sequence number and message of each group, by group number."""
    received: float = 0.0
    """Host clock of the latest group, seconds."""
    echoes: int = 0
    """Number of echoes in all groups."""

    @property
    def complete(self) -> bool:
        return len(self.parts) == self.groups


class ScanAssembler:
    """Assembles the messages of one device. Keeps at most three partial scans and a history of sequence numbers."""

    def __init__(
        self,
        *,
        sensors: int | None = None,
        group_paths: Int[np.ndarray, "paths 3"] | None = None,
        timeout: float = SETTINGS.incomplete_timeout,
    ):
        """A new assembler.

        Args:
            sensors: number of sensors, to sort the echoes by path; None: order of arrival.
            group_paths: firing group, transmitter and receiver of every path of the ring, to report the paths that
                heard nothing (``FiringPlan``); needs ``sensors``.
            timeout: seconds without a group after which ``expire`` emits an incomplete scan.
        """
        self.counts = AssemblerCounts()
        self.unknown_messages = False
        """The device also sends messages that the decoder skips, so a gap in the sequence need not be a lost pose."""
        self._sensors, self._timeout = sensors, timeout
        self._plan = None if group_paths is None or sensors is None else FiringPlan(group_paths, sensors)
        self._suspect: Message | None = None
        self._renumber = False
        self._scan_offset, self._clock_offset = 0, 0.0
        self._last_stamp, self._last_received = 0.0, 0.0
        self._lost_before_restart = 0
        self._reset()

    def _reset(self) -> None:
        """Reset the state that belongs to one run of the device."""
        self._partial: dict[int, _PartialScan] = {}
        self._emitted: deque[int] = deque(maxlen=SETTINGS.scan_history)
        self._history: dict[int, tuple[int, int | None]] = {}  # sequence -> device time, index of the group
        self._poses: list[tuple[int, Pose]] = []  # by sequence
        self._first_sequence = self._newest = -1
        self._distinct_count = 0
        self._newest_time_us = 0
        self._newest_scan = -1
        self._forgotten = (-1, -1, 0)  # the last group that left the history: sequence, rank; poses that left after it
        self._pose_gap = -1  # sequence of the group after the last gap that left the history and may hide a pose

    def push(self, message: Message, received: float) -> list[RawScan]:
        """Add one message.

        Args:
            message: the message, in order of arrival.
            received: host clock, seconds (``time.monotonic``).

        Returns:
            The scans that are emitted, oldest first.
        """
        if self._newest >= 0 and self._is_stale(message):
            suspect, self._suspect = self._suspect, message
            if suspect is None or not _follows(suspect, message):
                self.counts.late += suspect is not None
                return []
            # Two consistent stale messages: the device restarted, and with it its numbers and perhaps its clock.
            emitted = self._restart(suspect, received)
            return [*emitted, *self._accept(suspect, received), *self._accept(message, received)]
        if self._suspect is not None:
            self.counts.late += 1
            self._suspect = None
        return self._accept(message, received)

    def expire(self, now: float) -> list[RawScan]:
        """Emit incomplete scans after the timeout.

        Args:
            now: host clock, seconds (``time.monotonic``).
        """
        stale = [number for number, scan in self._partial.items() if now - scan.received > self._timeout]
        return self._emit_up_to(max(stale)) if stale else []

    def flush(self) -> list[RawScan]:
        """Emit all remaining scans, at the end of a stream."""
        self.counts.late += self._suspect is not None
        self._suspect = None
        return self._emit_up_to(max(self._partial, default=-1))

    def _is_stale(self, message: Message) -> bool:
        """Whether a message is far too old: late, or from a restarted device."""
        sequence = self._unwrap(message.sequence)
        known = self._history.get(sequence)
        return (
            sequence <= self._newest - SETTINGS.max_reordering
            or message.time_us < self._newest_time_us - SETTINGS.max_clock_step_back_us
            or (known is not None and known[0] != message.time_us)
        )

    def _unwrap(self, sequence: int) -> int:
        """The sequence number without the wrap at 2^32."""
        if self._newest < 0:
            return sequence
        return self._newest + (sequence - self._newest + _SEQUENCE_RANGE // 2) % _SEQUENCE_RANGE - _SEQUENCE_RANGE // 2

    def _restart(self, message: Message, received: float) -> list[RawScan]:
        """Emit everything and start the numbering of a restarted device."""
        emitted = self._emit_up_to(max(self._partial, default=-1))
        newest, self._lost_before_restart, self._suspect = self._newest_scan, self.counts.lost, None
        self.counts.restarts += 1
        self._reset()
        self._renumber, self._newest_scan = True, newest
        # Continue the time stamps by the host time that passed.
        stamp = self._last_stamp + max(0.0, received - self._last_received)
        self._clock_offset = stamp - message.time_us * 1e-6
        return emitted

    def _accept(self, message: Message, received: float) -> list[RawScan]:
        sequence = self._unwrap(message.sequence)
        if sequence in self._history:
            self.counts.repeated += 1
            return []
        self._first_sequence = sequence if self._newest < 0 else min(self._first_sequence, sequence)
        self._newest = max(self._newest, sequence)
        self._distinct_count += 1
        self.counts.lost = self._lost_before_restart + self._newest - self._first_sequence + 1 - self._distinct_count
        self._newest_time_us = max(self._newest_time_us, message.time_us)
        rank = None
        if isinstance(message, Group):
            rank = message.scan * message.groups + message.group
        self._history[sequence] = (message.time_us, rank)
        if len(self._history) > SETTINGS.message_history:
            self._forget(min(self._history))
        if isinstance(message, Pose):
            insort(self._poses, (sequence, message), key=_sequence)
            del self._poses[: -SETTINGS.message_history]
            return self._emit_due()
        return self._add_group(sequence, message, received)

    def _add_group(self, sequence: int, group: Group, received: float) -> list[RawScan]:
        emitted: list[RawScan] = []
        number = group.scan + self._scan_offset
        if self._renumber or (number < self._newest_scan - SETTINGS.scan_history and sequence == self._newest):
            # The device restarted its scan numbers. Skip one number, so that no number is used twice.
            emitted, self._renumber = self._emit_up_to(max(self._partial, default=-1)), False
            self._scan_offset = self._newest_scan + 2 - group.scan
            number = group.scan + self._scan_offset
        if number in self._emitted:
            self.counts.late += 1
            return emitted
        scan = self._partial.get(number, _PartialScan(group.groups))
        if group.groups > SETTINGS.max_groups or group.groups != scan.groups:
            self.counts.impossible += 1
            return emitted
        if group.group in scan.parts:
            self.counts.repeated += 1
            return emitted
        if scan.echoes + len(group.echoes) > SETTINGS.max_echoes:
            self.counts.impossible += 1
            return emitted
        self._partial[number] = scan
        scan.echoes += len(group.echoes)
        scan.parts[group.group] = (sequence, group)
        scan.received = self._last_received = received
        self._newest_scan = max(self._newest_scan, number)
        return emitted + self._emit_due()

    def _emit_due(self) -> list[RawScan]:
        """Emit complete scans, all scans before them, and scans too far behind."""
        due = [
            number
            for number, scan in self._partial.items()
            if number <= self._newest_scan - 2 or (scan.complete and not self._may_lack_pose(scan))
        ]
        return self._emit_up_to(max(due)) if due else []

    def _may_lack_pose(self, scan: _PartialScan) -> bool:
        """Whether a pose of a complete scan may still arrive: the message before one of its groups is missing."""
        sequences = [sequence for sequence, _ in scan.parts.values()]
        if self.unknown_messages or self._newest >= max(sequences) + SETTINGS.pose_hold:
            return False
        return any(s - 1 not in self._history and s - 1 >= self._first_sequence for s in sequences)

    def _emit_up_to(self, up_to: int) -> list[RawScan]:
        numbers = sorted(number for number in self._partial if number <= up_to)
        scans = [self._assembled(number, self._partial.pop(number)) for number in numbers]
        self._emitted.extend(numbers)
        return scans

    def _assembled(self, number: int, scan: _PartialScan) -> RawScan:
        order = sorted(scan.parts)
        groups = [scan.parts[k][1] for k in order]
        poses = np.full((scan.groups, 3), np.nan)
        for k in order:
            poses[k] = self._pose_before(scan.parts[k][0])
        time_us = np.array([part.time_us for part in groups])
        first = order[int(np.argmin(time_us))]
        stamp, self._last_stamp = (
            round(int(time) / 1e6 + self._clock_offset, 6) for time in (time_us.min(), time_us.max())
        )
        group_time = np.full(scan.groups, np.nan)
        group_time[order] = (time_us - time_us.min()).astype(np.float64) / 1e6
        echoes = np.frombuffer(bytearray().join(part.echoes.tobytes() for part in groups), ECHO)
        group = np.repeat(np.array(order, dtype=np.int64), [len(part.echoes) for part in groups])
        tx, rx = echoes["tx"].astype(np.int64), echoes["rx"].astype(np.int64)
        group_of = np.zeros(int(tx.max(initial=0)) + 1, np.int64)
        group_of[tx] = group
        group = group_of[tx]
        silent = None if self._plan is None else self._plan.silent_paths(np.isfinite(group_time), tx, rx, group)
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
            pose=poses[first].copy(),
            group_pose=poses,
            group_time=group_time,
            echoes=echoes,
            group=group,
            silent=silent,
            temperature=float(np.mean(measured)) if measured else float("nan"),
            missing=missing,
            received=scan.received,
        )

    def _pose_before(self, sequence: int) -> tuple[float, float, float]:
        """The latest pose before a message, by sequence number; NaN if a later pose may have been lost."""
        before = bisect_left(self._poses, sequence, key=_sequence)
        if not before:
            return (np.nan, np.nan, np.nan)
        number, pose = self._poses[before - 1]
        if not self.unknown_messages and self._pose_lost(number, sequence):
            return (np.nan, np.nan, np.nan)
        return (pose.x, pose.y, pose.theta)

    def _pose_lost(self, pose: int, group: int) -> bool:
        """Whether a pose may be missing between a pose and a group: more missing messages than missing groups."""
        if pose < self._pose_gap:
            return True
        first, rank, poses = self._forgotten
        if all(s in self._history for s in range(max(pose, first + poses) + 1, group)):
            return False
        own = self._history.get(group, (0, None))[1]
        in_history = [s for s, (_, rank_) in self._history.items() if rank_ is not None]
        before = max((s for s in in_history if s < pose), default=-1)
        if before < 0 and first < 0:  # no group came before the pose: take the one after it
            after = min((s for s in in_history if s > pose), default=group)
            before = after if all(s in self._history for s in range(pose + 1, after)) else -1
        if before >= 0:
            first, rank, poses = before, self._history[before][1], 0
        if own is None or rank is None or first < 0:
            return True
        known = [r for s, (_, r) in self._history.items() if first < s < group]
        messages = group - first - 1 - len(known) - poses
        return messages > own - rank - 1 - sum(between is not None for between in known)

    def _forget(self, sequence: int) -> None:
        """Remove the oldest message from the history; remember whether a pose may be missing before it."""
        _, rank = self._history.pop(sequence)
        first, before, poses = self._forgotten
        if rank is None:
            self._forgotten = (first, before, poses + 1)
            return
        missing = sequence - max(first, self._first_sequence - 1) - 1 - poses
        if missing > (max(rank - before - 1, 0) if first >= 0 else 0):
            self._pose_gap = sequence
        self._forgotten = (sequence, rank, 0)


def _sequence(entry: tuple[int, Pose]) -> int:
    return entry[0]


def _follows(earlier: Message, later: Message) -> bool:
    """Whether two messages can be consecutive in one run of a device."""
    step = (later.sequence - earlier.sequence) % _SEQUENCE_RANGE
    return (
        0 < step <= SETTINGS.max_reordering
        and 0 <= later.time_us - earlier.time_us <= 10 * SETTINGS.max_clock_step_back_us
    )


def _path_order(echoes: Shaped[np.ndarray, " echoes"], sensors: int) -> Int[np.ndarray, " echoes"]:
    """Sort index in the order of a ring's paths: neighbor 0, +1, -1, +2, -2, ..., then transmitter, then nearest."""
    tx, rx = echoes["tx"].astype(np.int64), echoes["rx"].astype(np.int64)
    offset = (rx - tx) % sensors
    behind = 2 * offset > sensors
    rank = np.where(behind, 2 * (sensors - offset), 2 * offset - 1)
    return np.lexsort([echoes["time_us"], tx, rank])
