"""The pairs of sensors that every scan of a log measured, whether or not it holds a reading of them."""

import math

import numpy as np
from jaxtyping import Bool, Int

MAX_CHANCE = 0.01
"""Largest probability that echoes of scans in which all sensors fire agree with a firing order. Chosen by hand."""
MAX_PERIOD = 256
"""Longest firing order, firings."""
SUCCESSOR_SHARE = 0.5
"""Sensors fire in an order, too, if more than this share of echoes follow the echo of their usual predecessor, although
some firings or scans are missing. Chosen by hand."""
NO_PAIRS = np.zeros((0, 2), np.int64)
"""``Log.asked`` of a log in which only the readings were measured."""
NO_PAIRS.setflags(write=False)


class AskedPairs:
    """Derives ``Log.asked`` from the readings of a log, part by part, in memory bounded by the number of pairs.

    - No pairs, if the log is explicit: it holds a reading without a range, so all that was measured has a reading.
    - No pairs, if sensors fire in turn: every scan holds one transmitter at most, and the transmitters follow an order.
    - Otherwise, all pairs that are heard anywhere in the log. A pair that is never heard was not measured.
    """

    def __init__(self):
        self._explicit, self._one_transmitter = False, True
        self._scans = self._gcd = 0
        """Scans with readings; greatest common divisor of the numbers of scans between readings of a transmitter."""
        self._last = np.zeros((0, 2), np.int64)
        """Scan and transmitter of the last reading."""
        self._first: dict[int, int] = {}
        """First scan of each transmitter."""
        self._following = np.zeros(0, np.int64)
        self._counts = np.zeros(0, np.int64)
        """Codes of transmitters that follow each other, and how often they do."""
        self._codes = np.zeros(0, np.int64)

    def add(
        self,
        scan: Int[np.ndarray, " readings"],
        tx: Int[np.ndarray, " readings"],
        rx: Int[np.ndarray, " readings"],
        silent: Bool[np.ndarray, " readings"],
    ) -> None:
        """Add the readings that follow.

        Args:
            scan: row of the scan of each reading in the log, not decreasing.
            tx: transmitter.
            rx: receiver.
            silent: the path heard nothing.
        """
        self._explicit = self._explicit or bool(silent.any())
        if not len(tx):
            return
        each = np.concatenate([self._last, np.column_stack([scan, tx]).astype(np.int64)])
        new_scan, other = (each[1:] != each[:-1]).T
        self._one_transmitter = self._one_transmitter and bool((new_scan | ~other).all())
        if self._one_transmitter:
            begins = np.append(len(self._last) == 0, new_scan)  # of the first of these: it has no reading before it
            self._add_firings(each[begins])
        self._last = each[-1:]
        if not self._explicit:
            self._codes = np.union1d(self._codes, tx.astype(np.int64) << 32 | rx)

    def _add_firings(self, firings: Int[np.ndarray, "firings 2"]) -> None:
        """Add scans with readings of one transmitter: scan and transmitter."""
        before = np.concatenate([self._last[:, 1], firings[:, 1]])
        codes = before[:-1] << 32 | before[1:]
        self._following, row = np.unique(np.concatenate([self._following, codes]), return_inverse=True)
        counts = np.concatenate([self._counts, np.ones(len(codes), np.int64)])
        self._counts = np.bincount(row.ravel(), counts, minlength=len(self._following)).astype(np.int64)
        transmitters, first, row = np.unique(firings[:, 1], return_index=True, return_inverse=True)
        start = [
            self._first.setdefault(one, at)
            for one, at in zip(transmitters.tolist(), firings[first, 0].tolist(), strict=True)
        ]
        distance = firings[:, 0] - np.array(start, np.int64)[row.ravel()]
        self._gcd = math.gcd(self._gcd, int(np.gcd.reduce(distance, initial=0)))
        self._scans += len(firings)

    @property
    def in_turn(self) -> bool:
        """Every scan holds one transmitter at most, and the transmitters follow an order."""
        several = len(self._first) > 1
        return self._one_transmitter and several and (self._is_periodic() or self._is_succession())

    def _is_periodic(self) -> bool:
        """Whether each transmitter has readings at its place of a period only, and hardly by chance."""
        first = np.fromiter(self._first.values(), np.int64)
        period = firing_period(first, self._gcd)
        if period is None:
            return False
        confirmed, tried = self._scans - len(first), period - len(first) + 1
        return confirmed * math.log(period) >= math.log(tried / MAX_CHANCE)

    def _is_succession(self) -> bool:
        """Whether most readings follow those of the transmitter that usually precedes theirs, and hardly by chance."""
        sensors, earlier = len(self._first), self._following >> 32
        other = earlier != self._following & 0xFFFFFFFF
        _, row = np.unique(earlier, return_inverse=True)
        usual = np.zeros(sensors, np.int64)
        np.maximum.at(usual, row.ravel(), np.where(other, self._counts, 0))
        expected = self._counts.sum() * max(SUCCESSOR_SHARE, 1.5 / sensors)
        confirmed = usual.sum() - np.count_nonzero(usual)
        return bool(usual.sum() > expected and confirmed * math.log(sensors) >= -math.log(MAX_CHANCE))

    def pairs(self) -> Int[np.ndarray, "pairs 2"]:
        """The (tx, rx) pairs, in ascending order."""
        if self._explicit or self.in_turn:
            return NO_PAIRS
        return np.stack([self._codes >> 32, self._codes & 0xFFFFFFFF], axis=-1)


def firing_period(first: Int[np.ndarray, " transmitters"], divisor: int) -> int | None:
    """Shortest period, up to ``MAX_PERIOD``, in which each transmitter has a place of its own; None without any.

    Args:
        first: first firing of each transmitter, a row of the log.
        divisor: greatest common divisor of the distances between the firings of each transmitter, in rows; 0 if each
            of them has one firing only.
    """
    for period in range(len(first), min(divisor, MAX_PERIOD) + 1):
        if divisor % period == 0 and len(np.unique(first % period)) == len(first):
            return period
    return None
