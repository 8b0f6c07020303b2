"""A map that grows while the poses are estimated, too: the evidence of each submap stands where its submap lies."""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from jaxsonar.detection.local_map import LocalModel
from jaxsonar.geometry.se2 import compose, wrap_angle
from jaxsonar.graph_slam.tracker import Tracker, TrackerState, TrackerStep
from jaxsonar.mapping.map_evidence import MapEvidence, gather_evidence
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.sensors.ring import Ring

MOVED = (0.005, float(np.radians(0.1)))
"""Metres and radians; a submap that has moved by more is looked at again."""

Part = tuple[tuple[Scan, LocalModel], ...]
"""Scans that were first taken in one submap, with their local models."""


@dataclass(frozen=True, eq=False)
class SubmapEvidence:
    """Scans so far, by submap, and where these lie."""

    tracker_state: TrackerState
    scans: tuple[Part, ...] = ((),)
    """The last one is of the submap that is being made."""
    cache: dict[int, tuple[Float[np.ndarray, "3"], int, MapEvidence]] = field(default_factory=dict)
    """What submaps amounted to when they were last looked at: their pose and number of scans then; only a memory."""

    def step(self, tracker: Tracker, scan: Scan, **given) -> tuple["SubmapEvidence", TrackerStep]:
        """The journey with one scan more (``Tracker.step``, whose arguments these are)."""
        tracked, step = tracker.step(self.tracker_state, scan, **given)
        parts = (*self.scans[:-1], (*self.scans[-1], (scan, step.model)))
        if len(tracked.graph.submaps) > len(self.tracker_state.graph.submaps):
            parts = (*parts, ())
        return SubmapEvidence(tracked, parts, self.cache), step

    def evidence(self, ring: Ring) -> MapEvidence | None:
        """What all scans say of the walls, from where they were taken as far as that is known now; None without any."""
        whole = None
        for number, part in enumerate(self.scans):
            if not part:
                continue
            base = compose(self.tracker_state.world_from_first, self.tracker_state.graph.poses[number])
            known = self.cache.get(number)
            if known is None or known[1] != len(part) or _apart(base, known[0]):
                known = (base, len(part), self._of(ring, number, base))
                self.cache[number] = known
            whole = known[2] if whole is None else whole.union(known[2])
        return whole

    def _of(self, ring: Ring, number: int, base: Float[np.ndarray, "3"]) -> MapEvidence:
        submaps, part = self.tracker_state.graph.submaps, self.scans[number]
        poses = submaps[number].poses if number < len(submaps) else np.array(self.tracker_state.submap.poses)
        # A submap begins with the scan that the one before ends with.
        world = compose(base, poses[-len(part) :])
        scans = [replace(scan, pose=pose) for (scan, _), pose in zip(part, world, strict=True)]
        return gather_evidence(ring, Log.from_scans(scans), [model for _, model in part])


def _apart(pose: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"]) -> bool:
    turn = abs(float(wrap_angle(float(pose[2] - other[2]))))
    return bool(np.hypot(*(pose - other)[:2]) > MOVED[0] or turn > MOVED[1])
