"""Synthetic device messages, and a source with given content. Imports no JAX, so that test processes start fast."""

import time

import numpy as np

from jaxsonar.hardware.messages import ECHO, Group, Pose
from jaxsonar.hardware.transport_base import EndOfStream, Source


def messages(scans=5, groups=4, echoes=6, start_us=1_000_000):
    """Messages of a device in which every number is different; scan 2 has no echoes."""
    rng = np.random.default_rng(scans)
    sequence, time_us = 0, start_us
    for scan in range(scans):
        yield Pose(sequence, time_us, *rng.normal(size=3).tolist())
        sequence += 1
        for group in range(groups):
            received = np.zeros(0 if scan == 2 else echoes, ECHO)
            received["tx"], received["rx"] = group, rng.integers(0, 24, len(received))
            received["time_us"], received["amplitude"] = rng.uniform(500, 11000, (2, len(received)))
            yield Group(sequence, time_us, scan, group, groups, 20.0 + scan % 100, received)
            sequence, time_us = sequence + 1, time_us + 11_700


class Given(Source):
    """A source that returns the given pieces; None means no data in time."""

    url = "given:"

    def __init__(self, pieces, pause=0.0):
        self.pieces, self.pause, self.closed = iter(pieces), pause, False

    def read(self, timeout: float) -> bytes | None:
        time.sleep(self.pause)
        piece = next(self.pieces, EndOfStream("given: no more"))
        if isinstance(piece, BaseException):
            raise piece
        return piece

    def close(self) -> None:
        self.closed = True
