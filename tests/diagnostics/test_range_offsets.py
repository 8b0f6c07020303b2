"""Range offsets: each is attributed to its own sensor, and unobservable combinations are resolved sparsely."""

import dataclasses

import numpy as np
import pytest
from support.health_logs import RING, log_of

from jaxsonar.diagnostics.check_ring import check
from jaxsonar.diagnostics.range_offsets import remove_gauge_freedom


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
