"""The pairs of sensors that every scan of a log measured, whether or not it holds a reading of them."""

import numpy as np
from jaxtyping import Bool, Int

IN_TURN_SHARE = 0.5
"""Sensors fire in turn if more than this share of consecutive scans have different transmitters. Chosen by hand."""


class AskedPairs:
    """Derives ``Log.asked`` from the readings of a log, part by part, in memory bounded by the number of pairs.

    - None, if the log is explicit: it holds a reading without a range, so all that was measured has a reading.
    - None, if sensors fire in turn: every scan holds one transmitter at most, and the log holds several.
    - Otherwise all pairs that are heard anywhere in the log. A pair that is never heard was not measured.
    """

    def __init__(self):
        self._explicit, self._one_transmitter = False, True
        self._changes = self._scans = 0
        self._last = np.zeros((0, 2), np.int64)
        """Scan and transmitter of the last reading."""
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
        self._last = each[-1:]
        self._one_transmitter = self._one_transmitter and bool((new_scan | ~other).all())
        self._changes += int((new_scan & other).sum())
        self._scans += int(new_scan.sum())
        if not self._explicit:
            self._codes = np.union1d(self._codes, tx.astype(np.int64) << 32 | rx)

    @property
    def in_turn(self) -> bool:
        """Every scan holds one transmitter at most, and the log holds several."""
        return self._one_transmitter and self._changes > IN_TURN_SHARE * self._scans

    def pairs(self) -> Int[np.ndarray, "pairs 2"]:
        """The (tx, rx) pairs, in ascending order."""
        if self._explicit or self.in_turn:
            return np.zeros((0, 2), np.int64)
        return np.stack([self._codes >> 32, self._codes & 0xFFFFFFFF], axis=-1)
