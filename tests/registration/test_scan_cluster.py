"""Clusters of scans: a change of frame is undone by its inverse."""

import numpy as np

from jaxsonar.geometry.se2 import inverse
from jaxsonar.registration.cluster_adjustment import single_scan
from jaxsonar.registration.cluster_negative_evidence import cluster_negative_evidence


def test_a_change_of_frame_is_undone_by_its_inverse(observations, rng):
    """The negative evidence does not depend on the frame."""
    cluster, frame = single_scan(observations, 2), rng.uniform(-2, 2, 3)
    back = cluster.transform(frame).transform(inverse(frame))
    np.testing.assert_allclose(back.parameters_by_kind, cluster.parameters_by_kind, atol=1e-9)
    np.testing.assert_allclose(back.covariance, cluster.covariance, atol=1e-9)
    np.testing.assert_allclose(back.extent, cluster.extent, atol=1e-9)
    moved = cluster_negative_evidence(observations, cluster.transform(frame))
    assert moved == cluster_negative_evidence(observations, cluster)
