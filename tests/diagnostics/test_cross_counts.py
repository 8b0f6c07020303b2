"""Deaf and mute sensors by reciprocity: the guilty sensor is named, not its partners."""

import numpy as np
import pytest

from jaxsonar import Log, Ring
from jaxsonar.diagnostics.cross_counts import cross_counts, one_sided_sensors


def counts(rng, *, sensors=12, neighbors=2, echoes=30):
    """Cross echoes of a sound ring: nearly as many in both directions."""
    offset = (np.arange(sensors)[:, None] - np.arange(sensors)) % sensors
    heard = np.isin(offset, [*range(1, neighbors + 1), *range(sensors - neighbors, sensors)])
    common = rng.integers(0, echoes, (sensors, sensors))
    return rng.binomial(np.maximum(common, common.T), 0.9) * heard


def test_a_sound_ring_has_no_one_sided_sensor(rng):
    for _ in range(200):
        assert list(one_sided_sensors(counts(rng))) == []


@pytest.mark.parametrize("neighbors", [1, 2, 3])
@pytest.mark.parametrize("deaf", [True, False])
def test_the_one_sided_sensor_is_named_and_not_its_partners(rng, neighbors, deaf):
    for sensor in range(12):
        heard = counts(rng, neighbors=neighbors, echoes=60)
        heard[(slice(None), sensor) if deaf else sensor] = 0
        (found,) = one_sided_sensors(heard)
        assert (found.sensor, found.is_deaf) == (sensor, deaf)
        assert min(found.sent, found.received) == 0
        assert found.nats > 10


def test_a_device_that_listens_one_way_has_no_one_sided_sensor(rng):
    assert list(one_sided_sensors(np.triu(counts(rng)))) == []


def test_only_paths_that_were_measured_both_ways_count():
    ring = Ring.circular(count=8, neighbors=1)
    tx, rx = np.array([0, 1, 2, 2, 3]), np.array([1, 0, 2, 3, 2])
    reported = np.array([1.0, 1.0, 1.0, 1.0, np.nan])
    one_way = Log.from_echoes(np.zeros(5, int), tx, rx, reported, stamp=np.zeros(1), pose=np.zeros((1, 3)))
    both = cross_counts(ring, one_way)
    assert both.sum() == 3  # 0 to 1, 1 to 0, and 2 to 3, whose other direction was silent
    columns = np.zeros(4, int), tx[:4], rx[:4], np.array([1.0, 1.0, np.nan, 1.0])
    missing = Log.from_echoes(*columns, stamp=np.zeros(1), pose=np.zeros((1, 3)))
    assert cross_counts(ring, missing).sum() == 2
