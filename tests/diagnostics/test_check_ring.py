"""The health check: no findings for a healthy ring, reasons for missing results, and refused input."""

import dataclasses

import numpy as np
import pytest
from support.health_logs import RING, SIGMA, only, written

from jaxsonar import Log, Ring, SonarError
from jaxsonar.diagnostics.check_ring import check
from jaxsonar.reports.plot_health import health_figure


@pytest.mark.slow
def test_a_healthy_ring_has_no_findings(log, healthy):
    assert healthy.findings == ()
    assert not any(healthy.remarks)
    assert healthy.source == "scans"
    assert healthy.empty == ""
    assert (healthy.place == np.arange(24)).all()
    assert healthy.direct.sum() == (log.tx == log.rx).sum()
    assert healthy.cross.sum() == 2 * (log.tx != log.rx).sum()
    assert (healthy.heard <= healthy.expected).all()
    assert 0.5 * SIGMA < healthy.sigma < 3 * SIGMA


@pytest.mark.slow
def test_the_reason_for_missing_walls_is_reported(log, rng):
    silent = check(RING, only(log, log.tx < 0))
    far = check(RING, dataclasses.replace(log, range=log.range + 3))
    assert silent.empty == "no echo in any scan"
    assert "within the maximum range, 2 m: are ranges half path lengths in metres?" in far.empty
    fullest = only(log, log.echo_scan == np.bincount(log.echo_scan).argmax())
    few = check(RING, dataclasses.replace(fullest, range=rng.uniform(0.3, 2, len(fullest.range))))
    assert few.empty.startswith("single scans show too few walls")
    assert few.source == ""
    assert few.walls == 0
    for found in (silent, far, few):
        assert [one.cause for one in found.findings] == ["range unit"] * (found is far)
        assert np.isnan(found.sigma)
        assert written(found)["beam"] == [None, None]
        health_figure(found)


@pytest.mark.slow
def test_left_out_echoes_are_reported(log):
    """For a device that listens to more neighbors than the ring specifies."""
    seen, reported, far = [], [], np.flatnonzero(log.tx == log.rx)[::4]
    index = np.insert(log.echo_scan, far, log.echo_scan[far])
    tx, rx = np.insert(log.tx, far, log.tx[far]), np.insert(log.rx, far, (log.rx[far] + 4) % 24)
    more = Log.from_echoes(index, tx, rx, np.insert(log.range, far, log.range[far]), stamp=log.stamp, pose=log.pose)
    found = check(RING, more, on_left_out=reported.append, progress=lambda *done: seen.append(done))
    assert reported == [len(far)]
    assert seen[-1] == (len(log), len(log))
    assert found.left_out == len(far)
    assert any("does not listen to" in finding.sentence for finding in found.findings)


@pytest.mark.slow
def test_wrong_input_is_refused_in_one_line(log):
    with pytest.raises(SonarError, match="allowed are 0 to 7"):
        check(Ring.circular(count=8), log)
    with pytest.raises(SonarError, match="sigma"):
        check(RING, log, sigma=2.0)
