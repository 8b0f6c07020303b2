"""Cross echoes of each pair of sensors in both directions: by reciprocity, both have the same number of echoes."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxsonar.diagnostics.settings import SETTINGS
from jaxsonar.scans.measured_paths import measured_paths
from jaxsonar.scans.readings import is_repeated
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

_FINDINGS = SETTINGS.findings


class OneSidedSensor(NamedTuple):
    """A sensor with cross echoes in one role only."""

    sensor: int
    is_deaf: bool
    """True: it does not receive; False: it does not transmit."""
    sent: int
    """Cross echoes that others received from it."""
    received: int
    """Cross echoes that it received from others."""
    nats: float
    """Log-likelihood ratio to equal rates in both roles."""


def cross_counts(ring: Ring, log: Log) -> Int[np.ndarray, "sensors sensors"]:
    """Scans in which each transmitter (row) was heard by each receiver (column), on paths measured both ways.

    In a log that does not mark silence, paths that were never heard count as measured.
    """
    tx, rx = ring.paths.T
    measured = np.any(measured_paths(ring, log), axis=0)
    if not np.isnan(log.range).any():
        measured = np.ones_like(measured)
    both = np.zeros((ring.count, ring.count), bool)
    both[tx[measured], rx[measured]] = True
    both &= both.T & ~np.eye(ring.count, dtype=bool)
    heard = np.isfinite(log.range) & ~is_repeated(log)
    each = np.unique(np.stack([log.echo_scan, log.tx, log.rx])[:, heard], axis=1)
    count = np.zeros((ring.count, ring.count), np.int64)
    np.add.at(count, (each[1], each[2]), 1)
    return count * both


def one_sided_sensors(count: Int[np.ndarray, "sensors sensors"]) -> Iterator[OneSidedSensor]:
    """Deaf and mute sensors, the most certain first; a sensor is not accused of what its partners lack.

    Nothing is reported if the echoes of most pairs have one direction only: then the device does not listen both ways.
    """
    left = count.astype(np.float64)
    pairs = np.triu(left + left.T, 1)
    both_ways = np.minimum(left, left.T)[pairs > 0] > 0
    if not len(both_ways) or both_ways.mean() < _FINDINGS.min_reciprocal:
        return
    for _ in range(len(count)):
        sent, received = left.sum(axis=1), left.sum(axis=0)
        total, least = sent + received, np.minimum(sent, received)
        nats = total * np.log(2) - _entropy(sent, received)
        nats[least >= _FINDINGS.deaf_rate * np.maximum(sent, received)] = 0
        k = int(nats.argmax())
        if nats[k] < _FINDINGS.min_asymmetry:
            return
        yield OneSidedSensor(k, bool(received[k] < sent[k]), int(sent[k]), int(received[k]), float(nats[k]))
        left[k], left[:, k] = 0, 0


def _entropy(sent: np.ndarray, received: np.ndarray) -> np.ndarray:
    """Minus the logarithm of the likelihood of the counts, at their own rates."""
    total = np.maximum(sent + received, 1)
    both = np.stack([sent, received])
    return -(both * np.log(np.maximum(both, 1e-9) / total)).sum(axis=0)
