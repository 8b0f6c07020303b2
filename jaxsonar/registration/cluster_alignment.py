"""Alignments of two clusters of scans: every hypothesis is adjusted by ranges, and the best must beat all others."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from jaxsonar.geometry.se2 import compose, inverse, relative, subtract_poses
from jaxsonar.registration.cluster_adjustment import adjust_cluster, adjust_poses
from jaxsonar.registration.cluster_matching import (
    are_distinct,
    implied_corner_evidence,
    initial_poses,
    matching_reflectors,
    total_wall_gap,
)
from jaxsonar.registration.cluster_negative_evidence import cluster_negative_evidence, unassigned_evidence
from jaxsonar.registration.echo_groups import ScanObservations
from jaxsonar.registration.motion_prior import usual_motion
from jaxsonar.registration.scan_cluster import ScanCluster, merge_clusters
from jaxsonar.registration.settings import RANGE_SETTINGS as SETTINGS


@dataclass(frozen=True, eq=False)
class Alignment:
    """One hypothesis for the relative pose of two clusters."""

    cluster: ScanCluster
    """Both clusters, merged and adjusted."""
    pose: Float[np.ndarray, "3"]
    """a_from_b of the scans at which they meet, metres and radians."""
    covariance: Float[np.ndarray, "3 3"]
    pairs: tuple[tuple[int, int], ...]
    """Rows of the common reflectors."""
    evidence: float
    """Log-evidence against the two clusters being unrelated, without the negative evidence, nats."""
    negative_evidence: float
    """Nats of missed detections and walls in the way."""

    @property
    def total_evidence(self) -> float:
        """Log-evidence including the negative evidence, nats."""
        return self.evidence - self.negative_evidence

    @property
    def is_undetermined(self) -> bool:
        """Whether a direction of the pose is not determined."""
        position, heading = SETTINGS.max_pose_sd
        variance = np.linalg.eigvalsh(self.covariance[:2, :2])[-1]
        return bool(variance > position**2 or self.covariance[2, 2] > heading**2)

    def contains(self, pose: Float[np.ndarray, "3"]) -> bool:
        """Whether a pose is within three standard deviations."""
        off = subtract_poses(pose, self.pose)
        cov = self.covariance + np.diag(np.square(SETTINGS.pose_resolution))
        return bool(off @ np.linalg.solve(cov, off) < 9.0)


def unambiguous_alignment(alignments: Sequence[Alignment]) -> tuple[float, Alignment | None]:
    """Nats by which the best alignment beats all others, and that alignment if it is the only one."""
    if not alignments:
        return -np.inf, None
    best = max(alignments, key=lambda one: one.total_evidence)
    margin = best.total_evidence + SETTINGS.unrelated_cost
    for one in alignments:
        if not are_distinct(one.pose, best.pose):
            continue
        # In its undetermined direction the other one may lie where it has no negative evidence.
        if one.contains(best.pose):
            margin = min(margin, best.evidence - one.evidence + SETTINGS.undetermined_cost)
        else:
            margin = min(margin, best.total_evidence - one.total_evidence)
    return margin, best if margin > SETTINGS.margin and not best.is_undetermined else None


def nearest_scans(a: ScanCluster, b: ScanCluster) -> tuple[int, int, int]:
    """The scans of two clusters that are nearest to each other in the log, and the difference of their numbers."""
    gaps = np.abs(a.rows[:, None] - b.rows)
    i, j = np.unravel_index(int(gaps.argmin()), gaps.shape)
    return int(a.rows[i]), int(b.rows[j]), int(gaps[i, j])


def align_clusters(observations: ScanObservations, a: ScanCluster, b: ScanCluster) -> list[Alignment]:
    """All alignments of two clusters that a hypothesis leads to."""
    first, second, gap = nearest_scans(a, b)
    # 1. Both clusters in the frames of the scans at which they meet.
    a, b = (adjust_poses(observations, one, steps=3, fixed=scan) for one, scan in ((a, first), (b, second)))
    a, b = a.transform(inverse(a.poses[first])), b.transform(inverse(b.poses[second]))
    pair = _ClusterPair(observations, a, b, first, second, gap)
    alignments: list[Alignment] = []
    tried: list[tuple[frozenset[tuple[int, int]], np.ndarray]] = []
    # 2. From every initial pose: match reflectors and adjust, in turn.
    for pose in initial_poses(a, b, gap):
        found = None
        for _ in range(SETTINGS.match_rounds):
            pairs = matching_reflectors(a, b.transform(pose))
            repeated = any(set(pairs) == those and not are_distinct(pose, there) for those, there in tried)
            known = any(
                one.is_undetermined and set(pairs) == set(one.pairs) and one.contains(pose) for one in alignments
            )
            if not pairs or repeated or known:
                break
            tried.append((frozenset(pairs), pose))
            found = pair.align(pose, pairs)
            pose = found.pose
        alignments += [] if found is None else [found]
    # 3. An undetermined alignment has the negative evidence of its best position.
    best = max((one.total_evidence for one in alignments if not one.is_undetermined), default=-np.inf)
    least = best - SETTINGS.margin - SETTINGS.undetermined_cost
    return [pair.relax(one) if one.is_undetermined and one.evidence > least else one for one in alignments]


@dataclass(frozen=True)
class _ClusterPair:
    """Two clusters, each in the frame of the scan at which they meet."""

    observations: ScanObservations
    a: ScanCluster
    b: ScanCluster
    first: int
    second: int
    gap: int

    def align(self, pose: Float[np.ndarray, "3"], pairs: list[tuple[int, int]]) -> Alignment:
        """Adjust from a pose and common reflectors; a bad pair is split if that increases the evidence."""
        cluster = self._merge(pose, pairs)
        before = np.where(self.a.reflector >= 0, self.a.squared_residuals, self.b.squared_residuals)
        mine = np.flatnonzero(cluster.reflector >= 0)
        while len(pairs) > 1:
            increase = (cluster.squared_residuals - before)[mine] / 2
            worse = np.bincount(cluster.reflector[mine], increase, minlength=len(cluster.kind))
            worse = worse[[row for row, _ in pairs]]
            fewer = [one for k, one in enumerate(pairs) if k != worse.argmax()]
            other = self._merge(pose, fewer) if worse.max() > SETTINGS.split_nats else cluster
            if other.evidence <= cluster.evidence:
                break
            cluster, pairs = other, fewer
        step = relative(cluster.poses[self.first], cluster.poses[self.second])
        evidence = cluster.evidence - self.a.evidence - self.b.evidence + self._motion_log_density(cluster, step)
        evidence += unassigned_evidence(self.observations, cluster) - self._separate[1]
        evidence -= implied_corner_evidence(cluster, pairs) + total_wall_gap(self.a, self.b.transform(step), pairs)
        covariance = cluster.pose_covariance[self.second]
        return Alignment(cluster, step, covariance, tuple(pairs), evidence, self._negative_evidence(cluster))

    def relax(self, alignment: Alignment) -> Alignment:
        """Minimize the negative evidence along the undetermined direction."""
        variance, axes = np.linalg.eigh(alignment.covariance[:2, :2])
        along = min(float(np.sqrt(variance[-1])), 1.0) * axes[:, -1]
        least = alignment.negative_evidence
        for sd in SETTINGS.slide_deviations:
            shifted = self.b.transform(alignment.pose + np.append(sd * along, 0.0))
            cluster = merge_clusters(self.a, shifted, alignment.pairs)
            cluster = adjust_poses(self.observations, cluster, steps=1, fixed=self.first)
            least = min(least, self._negative_evidence(cluster) + sd**2 / 2)
        return replace(alignment, negative_evidence=least)

    def _merge(self, pose: Float[np.ndarray, "3"], pairs: Sequence[tuple[int, int]]) -> ScanCluster:
        return adjust_cluster(
            self.observations, merge_clusters(self.a, self.b.transform(pose), pairs), fixed=self.first
        )

    def _negative_evidence(self, cluster: ScanCluster) -> float:
        """Negative evidence that neither cluster has alone."""
        return cluster_negative_evidence(self.observations, cluster) - self._separate[0]

    @cached_property
    def _separate(self) -> tuple[float, float]:
        """Negative evidence, and evidence of unassigned echoes, of both clusters alone."""
        both = self.a, self.b
        return (
            sum(cluster_negative_evidence(self.observations, one) for one in both),
            sum(unassigned_evidence(self.observations, one) for one in both),
        )

    def _motion_log_density(self, cluster: ScanCluster, step: Float[np.ndarray, "3"]) -> float:
        """Log-density of the motion between the clusters; it may continue the motion before or after it."""
        usual = float(usual_motion(self.gap).log_density(step[None])[0])
        direction, steady = int(np.sign(self.second - self.first)), []
        for near, far, moved in (
            (self.first, self.first - direction, step),
            (self.second, self.second + direction, inverse(step)),
        ):
            if 0 <= far < len(cluster.poses) and cluster.registered[far]:
                continued = np.zeros(3)
                for _ in range(self.gap):
                    continued = compose(continued, relative(cluster.poses[far], cluster.poses[near]))
                position, heading = SETTINGS.steady_sd
                sd = self.gap * np.array([position, position, heading])
                off = subtract_poses(moved, continued) / sd
                steady.append(-float(off @ off) / 2 - float(np.log(sd).sum()) - 1.5 * np.log(2 * np.pi))
        if not steady:
            return usual
        probability = SETTINGS.steady_probability
        return float(np.logaddexp(np.log(1 - probability) + usual, np.log(probability) + np.mean(steady)))
