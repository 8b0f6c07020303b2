"""What a scan did not measure is no evidence against a pose."""

from dataclasses import replace

import numpy as np
import pytest

from jaxsonar.geometry.se2 import compose
from jaxsonar.registration.cluster_adjustment import single_scan
from jaxsonar.registration.cluster_negative_evidence import cluster_negative_evidence
from jaxsonar.registration.features import no_features
from jaxsonar.registration.scan_cluster import merge_clusters
from jaxsonar.registration.scan_negative_evidence import scan_negative_evidence
from jaxsonar.scans.measured_directions import SETTINGS, direction_sector

WALL = no_features()._replace(  # x = 1 m, normal along x
    reference=np.array([[1.0, 0.0]]),
    theta=np.zeros(1),
    offset=np.zeros(1),
    covariance=1e-4 * np.eye(2)[None],
    extent=np.array([[-1.0, 1.0]]),
    weight=np.ones(1),
    scans=np.full(1, 5.0),
)


def against(directions, heading):
    """Negative evidence of a scan at the origin without any detection, nats."""
    scan, pose = no_features()._replace(directions=directions), np.array([[0.0, 0.0, heading]])
    return scan_negative_evidence(WALL, scan, pose, np.zeros((1, 0), int), reliable_range=1.7, start=None)[0]


@pytest.mark.parametrize("heading", [0.0, 0.5, -2.0])
def test_a_wall_in_an_unmeasured_direction_is_not_missed(heading):
    every = np.ones(SETTINGS.directions, bool)
    assert against(None, heading) > 0.5
    assert against(every, heading) == against(None, heading)
    toward = direction_sector(np.array([-heading]))[0]
    assert against(np.arange(len(every)) == toward, heading) == against(None, heading)
    assert against(np.arange(len(every)) != toward, heading) == 0


def test_unmeasured_paths_miss_nothing(observations):
    """Two scans at a wrong relative pose."""
    first, second = single_scan(observations, 0), single_scan(observations, 1)
    wrong = second.transform(compose(np.array([0.4, 0.3, 0.0]), np.zeros(3)))
    cluster = merge_clusters(first, wrong, [])
    total = cluster_negative_evidence(observations, cluster)
    every, none = (np.full(observations.measured.shape, value) for value in (True, False))
    assert cluster_negative_evidence(replace(observations, measured=every), cluster) == total
    unmeasured = cluster_negative_evidence(replace(observations, measured=none), cluster)
    assert unmeasured < total
    # Only detections through walls remain; they do not depend on what else was measured.
    assert unmeasured >= 0
