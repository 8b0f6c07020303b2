"""A bad link on demand: frames that are damaged, lost, swapped or held up, the same ones for the same seed."""

import math
import re
from dataclasses import dataclass

import numpy as np

from .errors import SonarError

KINDS = ("flip", "insert", "cut")
"""Ways to damage a frame."""
EVERY = 10.0
"""Seconds between two stalls, unless told."""


@dataclass(frozen=True)
class Faults:
    """What goes wrong, and how often."""

    corrupt: float = 0.0
    """Probability that a frame is damaged: bits flipped, bytes inserted, or bytes cut out."""
    drop: float = 0.0
    """Probability that a frame is lost."""
    reorder: float = 0.0
    """Probability that a frame comes after the one that follows it."""
    stall: float = 0.0
    """Seconds that the device says nothing, again and again; what it had to say comes after that, late."""
    every: float = EVERY
    """Seconds between the beginnings of two stalls."""
    seed: int = 0
    """Of the random numbers."""

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
    """``SECONDS`` or ``SECONDS@EVERY``, as in ``--stall 2@10``; EVERY is 10 s where it is left out, or more if needed.

    Raises:
        SonarError: it is neither.
    """
    number = r"(\d+\.?\d*|\.\d+)"
    match = re.fullmatch(rf"{number}(?:@{number})?", text)
    if not match:
        raise SonarError(f"--stall: '{text[:40]}' came; allowed is SECONDS[@EVERY], as in 2 or 2@10")
    seconds = float(match[1])
    return seconds, float(match[2]) if match[2] else max(EVERY, 2 * seconds)


class BadLink:
    """Takes frames and gives what arrives."""

    def __init__(self, faults: Faults):
        self.faults = faults
        self.damaged = self.dropped = self.swapped = self.stalls = 0
        """What was done so far."""
        self._random = np.random.default_rng(faults.seed)
        self._held: bytes | None = None
        self._next_stall = faults.every

    def pass_on(self, frame: bytes) -> list[bytes]:
        """What arrives once this frame was sent: none, one or two.

        Args:
            frame: with the 0x00 that ends it.
        """
        faults = self.faults
        lost, bad, late = self._random.random(3) < (faults.drop, faults.corrupt, faults.reorder)
        if lost:
            self.dropped += 1
            return []
        if bad:
            self.damaged += 1
            frame = damage(self._random, frame)
        if self._held is not None:
            earlier, self._held = self._held, None
            return [frame, earlier]
        if late:
            self.swapped += 1
            self._held = frame
            return []
        return [frame]

    def rest(self) -> list[bytes]:
        """A frame that waits for one to follow, if any, once there will be none."""
        held, self._held = self._held, None
        return [] if held is None else [held]

    def pause(self, elapsed: float) -> float:
        """How long to say nothing now, seconds.

        Args:
            elapsed: seconds since the device began.
        """
        if not self.faults.stall or elapsed < self._next_stall:
            return 0.0
        self.stalls += 1
        self._next_stall += self.faults.every * max(1, math.ceil((elapsed - self._next_stall) / self.faults.every))
        return self.faults.stall


def damage(random: np.random.Generator, frame: bytes) -> bytes:
    """A frame with a random fault: never as it was.

    Args:
        random: where the fault comes from.
        frame: at least one byte.
    """
    kind = KINDS[random.integers(len(KINDS))]
    at = int(random.integers(len(frame)))
    size = int(min(random.geometric(0.3), 64))
    if kind == "flip":
        data = bytearray(frame)
        for bit in np.unique(random.integers(8 * len(frame), size=size)).tolist():  # a bit flipped twice is none
            data[bit // 8] ^= 1 << bit % 8
        return bytes(data)
    if kind == "insert":
        return frame[:at] + random.bytes(size) + frame[at:]
    return frame[:at] + frame[at + size :]
