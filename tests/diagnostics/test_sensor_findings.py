"""Findings of the health check: dead, deaf, mute and stuck sensors are named."""

import numpy as np
import pytest
from support.health_logs import RING, only

from jaxsonar import Log
from jaxsonar.diagnostics.check_ring import check


@pytest.mark.slow
def test_a_dead_sensor_is_named(log):
    found = check(RING, only(log, (log.tx != 11) & (log.rx != 11)))
    assert found.findings[0].sentence.startswith("sensor 11 hears nothing")
    assert found.remarks[11] == "dead"
    assert sum(map(bool, found.remarks)) == 1


@pytest.mark.slow
def test_deaf_and_mute_sensors_are_distinguished(log):
    deaf = check(RING, only(log, log.rx != 11))
    mute = check(RING, only(log, log.tx != 11))
    assert not deaf.heard[11, 2]
    assert deaf.heard[11, 1]
    assert not mute.heard[11, 1]
    assert mute.heard[11, 2]
    assert deaf.remarks[11] == "deaf"
    assert mute.remarks[11] == "mute"


@pytest.mark.slow
def test_a_stuck_sensor_is_named(log):
    own = (log.tx == 4) & (log.rx == 4)
    stuck = only(log, ~own)
    scans = np.arange(len(log))
    index = np.concatenate([stuck.echo_scan, scans])
    order = np.argsort(index, kind="stable")
    columns = (
        np.concatenate([column, np.full(len(log), filler)])[order]
        for column, filler in ((stuck.tx, 4), (stuck.rx, 4), (stuck.range, 0.777))
    )
    found = check(RING, Log.from_echoes(index[order], *columns, stamp=log.stamp, pose=log.pose))
    assert any(finding.sentence.startswith("sensor 4 repeats the range") for finding in found.findings)
    assert found.repeats[4] == 1
    np.testing.assert_allclose(found.constant[4], [0.777, 1])
