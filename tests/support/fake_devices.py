"""A device that tests make up, and a source that gives what it says; loads no JAX, so that processes start fast."""

import time

import numpy as np

from jaxsonar.hardware.messages import ECHO, Group, Pose
from jaxsonar.hardware.transport_base import EndOfStream, Source


def messages(scans=5, groups=4, echoes=6, start_us=1_000_000):
    """Of a device whose every number is another one; scan 2 is silent."""
    rng = np.random.default_rng(scans)
    sequence, time_us = 0, start_us
    for scan in range(scans):
        yield Pose(sequence, time_us, *rng.normal(size=3).tolist())
        sequence += 1
        for group in range(groups):
            heard = np.zeros(0 if scan == 2 else echoes, ECHO)
            heard["tx"], heard["rx"] = group, rng.integers(0, 24, len(heard))
            heard["time_us"], heard["amplitude"] = rng.uniform(500, 11000, (2, len(heard)))
            yield Group(sequence, time_us, scan, group, groups, 20.0 + scan % 100, heard)
            sequence, time_us = sequence + 1, time_us + 11_700


class Given(Source):
    """A source of given pieces; None is a time without any."""

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
