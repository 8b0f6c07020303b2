"""Agglomerative registration: scans without odometry are merged into clusters by their ranges, the surest pair first.

At first every scan is a cluster. Two clusters with consecutive scans are aligned in every way in which some of their
reflectors agree. Each alignment is adjusted with all echoes and gets a log-evidence: few reflectors explain the echoes,
the motion is a usual one, expected detections are present, no wall is in the way. A pair is merged only if one
alignment beats all others, and of all pairs the surest is merged first: an ambiguous scan waits until the map around it
has grown.
"""

from collections.abc import Callable, Sequence

import numpy as np

from jaxsonar.detection.local_model import LocalModel
from jaxsonar.geometry.se2 import inverse, relative
from jaxsonar.registration.cluster_adjustment import adjust_cluster, adjust_poses, single_scan
from jaxsonar.registration.cluster_alignment import Alignment, align_clusters, nearest_scans, unambiguous_alignment
from jaxsonar.registration.cluster_matching import are_distinct
from jaxsonar.registration.echo_groups import ScanObservations
from jaxsonar.registration.scan_cluster import ScanCluster
from jaxsonar.registration.settings import RANGE_SETTINGS as SETTINGS
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


def register_by_ranges(
    ring: Ring,
    log: Log,
    models: Sequence[LocalModel],
    *,
    sigma: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[ScanCluster]:
    """Poses of scans without odometry, in clusters that could not be registered to each other.

    Args:
        ring: the sensors, calibrated.
        log: the echoes, in the order of the trajectory; its poses are ignored.
        models: local models of its scans.
        sigma: standard deviation of the ranges, metres; that of the local models if left out.
        progress: called with (scans merged into others, scans).

    Returns:
        The clusters, the one with the most scans first. Each is in the frame of its first scan, to which its
        covariances refer.
    """
    noise = [model.sigma for model in models if model.sigma > 0]
    sigma = sigma or (float(np.median(noise)) if noise else SETTINGS.default_sigma)
    observations = ScanObservations.of(ring, log, models, sigma)
    # 1. Every scan is a cluster.
    clusters = [single_scan(observations, scan) for scan in range(len(models))]
    # 2. Merge the surest pair of clusters, until no alignment is unambiguous. Alignments of unchanged pairs are kept.
    found: dict[tuple[ScanCluster, ScanCluster], tuple[float, Alignment | None]] = {}
    while True:
        if progress is not None:
            progress(len(models) - len(clusters), len(models))
        pairs = [
            (a, b)
            for k, a in enumerate(clusters)
            for b in clusters[k + 1 :]
            if nearest_scans(a, b)[2] <= SETTINGS.max_scan_gap
        ]
        for a, b in pairs:
            if (a, b) not in found:
                larger, smaller = (a, b) if len(a.rows) >= len(b.rows) else (b, a)
                found[a, b] = unambiguous_alignment(align_clusters(observations, larger, smaller))
        sure = [pair for pair in pairs if found[pair][1] is not None]
        if not sure:
            break
        a, b = max(sure, key=lambda pair: found[pair][0])
        alignment = found[a, b][1]
        assert alignment is not None
        clusters = [one for one in clusters if one is not a and one is not b] + [alignment.cluster]
    # 3. Remove scans that the map of all others would register elsewhere.
    clusters = [_confirmed(observations, one) for one in clusters]
    clusters.sort(key=lambda one: (-len(one.rows), one.rows[0]))
    return [_in_first_frame(observations, one) for one in clusters]


def _confirmed(observations: ScanObservations, cluster: ScanCluster) -> ScanCluster:
    """The cluster without the scans that the map of its other scans registers elsewhere."""
    for scan in cluster.rows if len(cluster.rows) > 2 else ():
        rest, alone = cluster.without(observations.groups.scan, scan), single_scan(observations, scan)
        rest = adjust_cluster(observations, rest)
        alignments = [one for one in align_clusters(observations, rest, alone) if not one.is_undetermined]
        near = nearest_scans(rest, alone)[0]
        best = max(alignments, key=lambda one: one.total_evidence, default=None)
        if best is not None and are_distinct(best.pose, relative(cluster.poses[near], cluster.poses[scan])):
            cluster = rest
    return cluster


def _in_first_frame(observations: ScanObservations, cluster: ScanCluster) -> ScanCluster:
    """The cluster in the frame of its first scan."""
    first = int(cluster.rows[0])
    cluster = adjust_poses(observations, cluster, steps=3, fixed=first)
    cluster = cluster.transform(inverse(cluster.poses[first]))
    cluster.poses[first] = 0.0  # exactly
    return cluster
