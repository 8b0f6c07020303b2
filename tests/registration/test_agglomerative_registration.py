"""Agglomerative registration by ranges: unambiguous scans are registered correctly, ambiguous ones stay separate."""

import numpy as np
import pytest
from support.scans_without_odometry import simulated_log

from jaxsonar import Ring, Room
from jaxsonar.geometry.se2 import compose, relative, wrap_angle
from jaxsonar.registration.agglomerative_registration import register_by_ranges


@pytest.mark.slow
def test_the_office_is_registered_correctly(office):
    ring, poses, log, models = office
    calls = []
    clusters = register_by_ranges(ring, log, models, progress=lambda *done: calls.append(done))
    found = clusters[0].poses
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[0], 0.0, atol=1e-12)
    off = found - relative(np.broadcast_to(poses[0], poses.shape), poses)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.08
    assert np.abs(wrap_angle(off[:, 2])).max() < np.radians(6)
    assert calls[0] == (0, len(poses))
    assert calls == sorted(calls)


@pytest.mark.slow
def test_scans_in_a_bare_corridor_stay_separate():
    """Two parallel walls do not determine the position along the corridor."""
    walls = np.array([[[-9.0, -1.0], [9.0, -1.0]], [[9.0, 1.0], [-9.0, 1.0]]])
    poses = np.stack([np.linspace(-0.5, 0.5, 4), np.zeros(4), np.zeros(4)], axis=-1)
    ring = Ring.circular()
    clusters = register_by_ranges(ring, *simulated_log(ring, Room(walls), poses))
    assert [len(one.rows) for one in clusters] == [1] * 4


def test_scans_without_echoes_stay_separate():
    ring, poses = Ring.circular(), np.zeros((3, 3))
    nothing = Room(np.array([[[50.0, 0.0], [50.0, 1.0]]]))
    clusters = register_by_ranges(ring, *simulated_log(ring, nothing, poses))
    assert [len(one.rows) for one in clusters] == [1] * 3
    assert compose(np.zeros(3), clusters[0].poses).shape == (3, 3)
