"""Range offsets: each is attributed to its own sensor, and unobservable combinations are resolved sparsely."""

import dataclasses

import numpy as np
import pytest
from support.driven_logs import driven_log
from support.health_logs import RING, log_of

from jaxsonar.diagnostics.check_ring import check
from jaxsonar.diagnostics.echo_residuals import predict_and_match
from jaxsonar.diagnostics.local_scene import scene_from_groups
from jaxsonar.diagnostics.range_offsets import estimate_offsets, remove_gauge_freedom, stretches_of_scans


@pytest.mark.slow
def test_an_offset_is_attributed_to_its_sensor_only():
    offset = np.zeros(24)
    offset[3] = 0.01
    found = check(RING, log_of(7, dataclasses.replace(RING, range_offset=offset)))
    assert found.findings[0].sentence.startswith("sensor 3 reports")
    assert found.remarks[3] == "offset"
    assert sum(map(bool, found.remarks)) == 1
    assert abs(found.offset[3] - 0.01) < 0.003


def test_the_gauge_of_offsets_is_sparse():
    """Of equivalent offsets, the ones with the fewest sensors off."""
    angle = 2 * np.pi * np.arange(24) / 24
    modes = np.stack([np.ones(24), np.cos(angle), np.sin(angle)], axis=-1)
    frame = np.linalg.qr(np.concatenate([modes, np.eye(24)], axis=1))[0]
    held = frame @ np.diag(np.r_[np.full(3, 1e2), np.full(21, 1e6)]) @ frame.T
    sparse = np.zeros(24)
    sparse[5] = 0.008
    offset, error = remove_gauge_freedom(sparse + modes @ np.array([0.02, -0.01, 0.005]), held, np.ones(24, bool))
    np.testing.assert_allclose(offset, sparse, atol=3e-4)
    assert (error < 2e-3).all()


def measured_offsets(ring, log):
    scene = scene_from_groups(ring, log)
    return estimate_offsets(predict_and_match(ring, scene, log), ring.count, 0.002, stretches_of_scans(log))


@pytest.mark.parametrize("seed", range(3))
def test_drift_of_the_poses_is_no_offset(seed):
    """Drift moves a wall towards the sensors of one side: the errors tell. An offset of 40 mm shows nevertheless."""
    ring, log = driven_log(seed, 12, 0, scans=200)
    sound = measured_offsets(ring, log)
    assert not (np.abs(sound.offset) > 3.5 * sound.error).any()
    k = int(np.argmax(np.bincount(log.tx, minlength=12)))
    found = measured_offsets(ring, dataclasses.replace(log, range=log.range + 0.04 * (log.tx == k)))
    assert found.offset[k] > 3.5 * found.error[k]
    others = np.arange(12) != k
    assert not (np.abs(found.offset) > 3.5 * found.error)[others].any()
