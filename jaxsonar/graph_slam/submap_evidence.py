"""The map evidence of a run whose poses are estimated scan by scan, kept for each submap.

Free space has directions and cannot be rotated. So the scans are kept, and the evidence of a submap is gathered again
when a loop closure has moved the submap.
"""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsonar.detection.local_model import LocalModel
from jaxsonar.geometry.se2 import compose, subtract_poses
from jaxsonar.graph_slam.tracker import Tracker, TrackerState, TrackerStep
from jaxsonar.mapping.map_evidence import MapEvidence, gather_evidence
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class SubmapEvidenceSettings:
    """Constants of the map evidence of submaps; chosen by hand."""

    max_position_change: float = 0.005
    """Evidence of a submap that moved farther is gathered again, metres."""
    max_heading_change: float = float(np.radians(0.1))
    """The same for rotations, radians."""


SETTINGS = SubmapEvidenceSettings()

SubmapScans = tuple[tuple[Scan, LocalModel], ...]
"""Scans that were first taken in one submap, with their local models."""


class CachedEvidence(NamedTuple):
    """The evidence of one submap."""

    world_from_submap: Float[np.ndarray, "3"]
    """Pose of the submap when it was gathered."""
    scan_count: int
    """Number of scans then."""
    evidence: MapEvidence


@dataclass(frozen=True, eq=False)
class SubmapEvidence:
    """The scans of a run, by submap."""

    tracker_state: TrackerState
    """Poses of the scans and the submaps."""
    scans: tuple[SubmapScans, ...] = ((),)
    """Of every submap; the last one is the submap around the robot."""
    cache: dict[int, CachedEvidence] = field(default_factory=dict)
    """Evidence by number of the submap; shared by all states of a run."""

    def step(self, tracker: Tracker, scan: Scan, **options: Any) -> tuple["SubmapEvidence", TrackerStep]:
        """Add one scan; arguments as for ``Tracker.step``."""
        state, step = tracker.step(self.tracker_state, scan, **options)
        scans = (*self.scans[:-1], (*self.scans[-1], (scan, step.model)))
        if len(state.graph.submaps) > len(self.tracker_state.graph.submaps):
            scans = (*scans, ())
        return SubmapEvidence(state, scans, self.cache), step

    def evidence(self, ring: Ring) -> MapEvidence | None:
        """Evidence of all scans at their current poses; None without scans."""
        union = None
        for number, scans in enumerate(self.scans):
            if not scans:
                continue
            world_from_submap = self._world_from_submap(number)
            cached = self.cache.get(number)
            is_current = cached is not None and cached.scan_count == len(scans)
            if cached is None or not is_current or _is_stale(world_from_submap, cached.world_from_submap):
                evidence = self._gather(ring, number, world_from_submap)
                cached = self.cache[number] = CachedEvidence(world_from_submap, len(scans), evidence)
            union = cached.evidence if union is None else union.union(cached.evidence)
        return union

    def poses(self) -> Float[np.ndarray, "scans 3"]:
        """Current estimates of world_from_robot of all scans, metres and radians."""
        numbers = [number for number, scans in enumerate(self.scans) if scans]
        parts = [self._poses_of(number, self._world_from_submap(number)) for number in numbers]
        return np.concatenate([np.zeros((0, 3)), *parts])

    def scans_at_current_poses(self) -> list[Scan]:
        """All scans with their current poses."""
        scans = [scan for pairs in self.scans for scan, _ in pairs]
        return [replace(scan, pose=pose) for scan, pose in zip(scans, self.poses(), strict=True)]

    def _world_from_submap(self, number: int) -> Float[np.ndarray, "3"]:
        return compose(self.tracker_state.world_from_first, self.tracker_state.graph.poses[number])

    def _poses_of(self, number: int, world_from_submap: Float[np.ndarray, "3"]) -> Float[np.ndarray, "scans 3"]:
        """Poses of the scans of one submap."""
        submaps = self.tracker_state.graph.submaps
        poses = submaps[number].poses if number < len(submaps) else np.array(self.tracker_state.submap.poses)
        # A submap starts with the last scan of the submap before, which has that scan already.
        return compose(world_from_submap, poses[-len(self.scans[number]) :])

    def _gather(self, ring: Ring, number: int, world_from_submap: Float[np.ndarray, "3"]) -> MapEvidence:
        """Evidence of one submap."""
        pairs, poses = self.scans[number], self._poses_of(number, world_from_submap)
        scans = [replace(scan, pose=pose) for (scan, _), pose in zip(pairs, poses, strict=True)]
        return gather_evidence(ring, Log.from_scans(scans), [model for _, model in pairs])


def _is_stale(pose: Float[np.ndarray, "3"], before: Float[np.ndarray, "3"]) -> bool:
    x, y, heading = subtract_poses(pose, before)
    return bool(np.hypot(x, y) > SETTINGS.max_position_change or abs(heading) > SETTINGS.max_heading_change)
