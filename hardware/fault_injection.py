"""Fault injection for tests and ``jaxsonar emulate``: corrupted, lost, reordered or delayed frames, seeded."""

import math
import re
from dataclasses import dataclass

import numpy as np

from .errors import SonarError

CORRUPTIONS = ("flip", "insert", "cut")
"""Kinds of corruption of a frame: flipped bits, inserted bytes, removed bytes."""
STALL_PERIOD = 10.0
"""Default time between the starts of two stalls, seconds."""


@dataclass(frozen=True)
class FaultSettings:
    """Which faults are injected, and how often."""

    corrupt: float = 0.0
    """Probability that a frame is corrupted: bits flipped, bytes inserted, or bytes removed."""
    drop: float = 0.0
    """Probability that a frame is lost."""
    reorder: float = 0.0
    """Probability that a frame is swapped with the next one."""
    stall: float = 0.0
    """Duration of a periodic stall, seconds. Frames that are due during a stall are sent after it."""
    every: float = STALL_PERIOD
    """Time between the starts of two stalls, seconds."""
    seed: int = 0
    """Seed of the random numbers."""

    def __post_init__(self):
        for name in ("corrupt", "drop", "reorder"):
            if not 0 <= getattr(self, name) <= 1:
                raise SonarError(f"--{name}: {getattr(self, name):g} came; allowed is a probability from 0 to 1")
        if not 0 <= self.stall <= 3600 or not self.stall < self.every <= 1e6:
            came = f"{self.stall:g}@{self.every:g}"
            raise SonarError(f"--stall: {came} came; allowed is SECONDS[@EVERY], up to 3600 and shorter than EVERY")
        if self.seed < 0:
            raise SonarError(f"--seed: {self.seed} came; allowed is 0 or more")


def parse_stall(text: str) -> tuple[float, float]:
    """Parse ``SECONDS`` or ``SECONDS@EVERY``, as in ``--stall 2@10``.

    Returns:
        Duration and period, seconds. The default period is 10 s, or twice the duration if that is longer.

    Raises:
        SonarError: another text.
    """
    number = r"(\d+\.?\d*|\.\d+)"
    match = re.fullmatch(rf"{number}(?:@{number})?", text)
    if not match:
        raise SonarError(f"--stall: '{text[:40]}' came; allowed is SECONDS[@EVERY], as in 2 or 2@10")
    seconds = float(match[1])
    return seconds, float(match[2]) if match[2] else max(STALL_PERIOD, 2 * seconds)


class FaultInjector:
    """Simulates a faulty link, frame by frame."""

    def __init__(self, faults: FaultSettings):
        self.faults = faults
        self.damaged = self.dropped = self.swapped = self.stalls = 0
        """Numbers of injected faults."""
        self._random = np.random.default_rng(faults.seed)
        self._held: bytes | None = None
        self._next_stall = faults.every

    def transmit(self, frame: bytes) -> list[bytes]:
        """Send a frame over the faulty link.

        Args:
            frame: with its final 0x00.

        Returns:
            The frames that arrive now: none, one, or two.
        """
        faults = self.faults
        lost, corrupted, late = self._random.random(3) < (faults.drop, faults.corrupt, faults.reorder)
        if lost:
            self.dropped += 1
            return []
        if corrupted:
            self.damaged += 1
            frame = corrupt_frame(self._random, frame)
        if self._held is not None:
            earlier, self._held = self._held, None
            return [frame, earlier]
        if late:
            self.swapped += 1
            self._held = frame
            return []
        return [frame]

    def flush(self) -> list[bytes]:
        """The frame that was held back for reordering, if any. Call after the last frame."""
        held, self._held = self._held, None
        return [] if held is None else [held]

    def stall_duration(self, elapsed: float) -> float:
        """Duration of a stall that is due now, seconds; 0 if none is due.

        Args:
            elapsed: seconds since the first message was sent.
        """
        if not self.faults.stall or elapsed < self._next_stall:
            return 0.0
        self.stalls += 1
        self._next_stall += self.faults.every * max(1, math.ceil((elapsed - self._next_stall) / self.faults.every))
        return self.faults.stall


def corrupt_frame(random: np.random.Generator, frame: bytes) -> bytes:
    """A copy of a frame with a random corruption. It always differs from the original.

    Args:
        random: random number generator.
        frame: at least one byte.
    """
    kind = CORRUPTIONS[random.integers(len(CORRUPTIONS))]
    at = int(random.integers(len(frame)))
    size = int(min(random.geometric(0.3), 64))
    if kind == "flip":
        data = bytearray(frame)
        for bit in np.unique(random.integers(8 * len(frame), size=size)).tolist():  # flipping a bit twice would undo it
            data[bit // 8] ^= 1 << bit % 8
        return bytes(data)
    if kind == "insert":
        return frame[:at] + random.bytes(size) + frame[at:]
    return frame[:at] + frame[at + size :]
