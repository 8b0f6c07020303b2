"""Agglomerative registration by ranges: unambiguous scans are registered correctly, ambiguous ones stay separate."""

import numpy as np
import pytest

from jaxsonar import Ring, Room, kernels, local_models, simulate
from jaxsonar.geometry.se2 import compose, inverse, relative, wrap_angle
from jaxsonar.registration.agglomerative_registration import register_by_ranges
from jaxsonar.registration.cluster_adjustment import adjust_cluster, single_scan
from jaxsonar.registration.cluster_negative_evidence import cluster_negative_evidence
from jaxsonar.registration.echo_groups import ScanObservations
from jaxsonar.registration.scan_cluster import merge_clusters
from jaxsonar.simulation.office import load_office

SIGMA = 0.005
"""Metres; of a thresholded sensor, the hard case."""


def simulated_log(ring, room, poses, *, sigma=SIGMA, seed=0):
    """A log without odometry, and its local models."""
    log = simulate(ring, room, poses, sigma=sigma, seed=seed).as_log(ring, np.full(poses.shape, np.nan))
    return log, list(local_models(ring, log))


@pytest.fixture(scope="module")
def office():
    """Five scans around the bend of the trajectory through the office."""
    place = load_office()
    poses = place.poses[11:16]
    return place.ring, poses, *simulated_log(place.ring, place.room, poses)


@pytest.fixture(scope="module")
def observations(office):
    ring, _, log, models = office
    return ScanObservations.of(ring, log, models, SIGMA)


def test_every_echo_is_grouped_or_unassigned(office, observations):
    _, _, log, _ = office
    grouped, unassigned = len(observations.grouped.scan), len(observations.unassigned.scan)
    assert grouped + unassigned == sum(len(log[row].range) for row in range(len(log)))
    assert grouped > 0.9 * (grouped + unassigned)
    np.testing.assert_array_equal(observations.groups.scan[observations.grouped.group], observations.grouped.scan)


def test_a_change_of_frame_is_undone_by_its_inverse(observations, rng):
    """The negative evidence does not depend on the frame."""
    cluster, frame = single_scan(observations, 2), rng.uniform(-2, 2, 3)
    back = cluster.transform(frame).transform(inverse(frame))
    np.testing.assert_allclose(back.parameters_by_kind, cluster.parameters_by_kind, atol=1e-9)
    np.testing.assert_allclose(back.covariance, cluster.covariance, atol=1e-9)
    np.testing.assert_allclose(back.extent, cluster.extent, atol=1e-9)
    moved = cluster_negative_evidence(observations, cluster.transform(frame))
    assert moved == cluster_negative_evidence(observations, cluster)


def test_common_reflectors_increase_the_evidence(office, observations):
    """Two scans at their true poses: with walls in common the evidence is larger than that of both alone."""
    _, poses, _, _ = office
    a, b = single_scan(observations, 0), single_scan(observations, 1)
    b = b.transform(relative(poses[0], poses[1]))
    first, second = a.parameters_by_kind[:, None, 0], b.parameters_by_kind[:, 0]
    near = (np.abs(wrap_angle(first[..., 1] - second[:, 1])) < 0.1) & (np.abs(first[..., 0] - second[:, 0]) < 0.1)
    near &= (a.kind[:, None] == kernels.PLANE) & (b.kind == kernels.PLANE)
    together = adjust_cluster(observations, merge_clusters(a, b, [(int(i), int(j)) for i, j in np.argwhere(near)]))
    assert near.sum() >= 2
    assert together.evidence > a.evidence + b.evidence
    np.testing.assert_allclose(relative(together.poses[0], together.poses[1])[:2], relative(*poses[:2])[:2], atol=0.05)


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
