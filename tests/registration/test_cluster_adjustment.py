"""Adjustment of a cluster: common reflectors increase its evidence."""

import numpy as np

from jaxsonar import kernels
from jaxsonar.geometry.se2 import relative, wrap_angle
from jaxsonar.registration.cluster_adjustment import adjust_cluster, single_scan
from jaxsonar.registration.scan_cluster import merge_clusters


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
