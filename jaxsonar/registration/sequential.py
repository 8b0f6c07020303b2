"""Poses of the robot from local models alone: scan after scan is placed in the map of those before.

Every way to lay a scan on known walls, corners and edges is a hypothesis. What speaks for it is its evidence in nats
(Laplace's approximation): densities of what agrees against chance, the room that the pose has left, the robot's
motion, what would have been heard, what lies in the way. A scan is placed only where one hypothesis beats all others.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar.detection.extract import LocalModel
from jaxsonar.geometry.se2 import composed, inverse
from jaxsonar.hardware.errors import SonarError
from jaxsonar.registration.feature_map import NOT_PARALLEL, Places, Seen, seen_of
from jaxsonar.registration.pose_hypotheses import Motion, only_pose
from jaxsonar.registration.pose_likelihood import explained

ODOMETRY = 0.05
"""Standard deviation of odometry as a share of the way and of the turn."""
MARGIN = 4.0
"""Nats by which the best hypothesis must beat any other one that is elsewhere."""
LATE = 1.0
"""Nats more for each scan between this one and the nearest that is placed: the robot may be among new walls."""
LOST = 5
"""Scans without a place in a row after which a map of its own is begun, to be joined later."""


def place(
    models: Sequence[LocalModel],
    odometry: Float[np.ndarray, "scans 3"] | None = None,
    *,
    slip: float = ODOMETRY,
    margin: float = MARGIN,
    blur: float = 1.0,
    progress: Callable[[int, int], None] | None = None,
) -> Float[np.ndarray, "scans 3"]:
    """Poses of the scans of an unmeasured room, good to centimetres and degrees: a start for an adjustment.

    The first of ``place_parts``, whose arguments these are; all NaN where there is none.
    """
    parts = place_parts(models, odometry, slip=slip, margin=margin, blur=blur, progress=progress)
    return parts[0] if parts else np.full((len(models), 3), np.nan)


def place_parts(
    models: Sequence[LocalModel],
    odometry: Float[np.ndarray, "scans 3"] | None = None,
    *,
    slip: float = ODOMETRY,
    margin: float = MARGIN,
    blur: float = 1.0,
    progress: Callable[[int, int], None] | None = None,
) -> list[Float[np.ndarray, "scans 3"]]:
    """Poses of the scans of an unmeasured room, in parts that could not be laid on one another.

    Scans that may be at more than one place are left out rather than guessed. Without odometry a scan needs two walls
    that are not parallel, or a wall and a point, in common with what is known by then.

    Args:
        models: local models in the order of the way, lines and points in the robot frame.
        odometry: (scans, 3) world_from_robot (x, y, theta), metres and radians, drifting; NaN where there is none.
        slip: standard deviation of odometry as a share of the way and of the turn.
        margin: nats by which a place must be likelier than all others; with less, more scans are placed, also wrongly.
        blur: 1 for a ring that may be centimetres off, less for one that is known better.
        progress: called with (scans looked at, scans) now and then.

    Returns:
        The parts, the one with the most scans first. Of each (scans, 3) world_from_robot (x, y, theta), metres and
        radians, in a world of its own: its first scan is at the origin, or at its odometry pose if it has one; NaN
        where a scan is not of this part.

    Raises:
        SonarError: odometry of another shape.
    """
    count = len(models)
    given = np.full((count, 3), np.nan) if odometry is None else np.array(odometry, dtype=np.float64)
    if given.shape != (count, 3):
        raise SonarError(f"place: odometry of shape {given.shape}; allowed is ({count}, 3): x, y, theta for every scan")
    given[~np.isfinite(given).all(axis=1)] = np.nan
    tracker = _Tracker([seen_of(model, blur=blur) for model in models], Motion(given, slip), margin)
    # Scan after scan; where the way is lost, a map of its own begins.
    parts = tracker.parts(progress)
    # Maps that fit together become one; then what was left out is looked at again, before and behind being known.
    parts = tracker.joined(parts)
    parts = sorted(parts, key=lambda part: -int(part.placed.sum()))
    return [_begun(part.poses, given) for part in parts]


def place_more(
    models: Sequence[LocalModel],
    poses: Float[np.ndarray, "scans 3"],
    odometry: Float[np.ndarray, "scans 3"] | None = None,
    *,
    slip: float = ODOMETRY,
    margin: float = MARGIN,
    blur: float = 1.0,
) -> Float[np.ndarray, "scans 3"]:
    """The same poses, with those scans that find their place in the map of the others by now.

    Args:
        models: as for ``place_parts``.
        poses: world_from_robot of those that are placed, metres and radians; NaN for the others.
        odometry: as for ``place_parts``.
        slip: as for ``place_parts``.
        margin: as for ``place_parts``.
        blur: as for ``place_parts``.

    Returns:
        (scans, 3); the poses that were given are as they were, NaN where a scan has no place yet.
    """
    given = np.full((len(models), 3), np.nan) if odometry is None else np.array(odometry, dtype=np.float64)
    tracker = _Tracker([seen_of(model, blur=blur) for model in models], Motion(given, slip), margin)
    base = _Part(np.full((len(models), 3), np.nan), Places())
    for scan in np.flatnonzero(np.isfinite(poses[:, 0])):
        base.take(int(scan), tracker.seen[scan], poses[scan])
    free = ~base.placed
    tracker.fill(base, free)
    others = [part for part in tracker.parts(None, free & ~base.placed) if part.placed.sum() > 1]
    return tracker.joined([base, *others], first=True)[0].poses


def _begun(poses: Float[np.ndarray, "scans 3"], given: Float[np.ndarray, "scans 3"]) -> Float[np.ndarray, "scans 3"]:
    """The same with the first placed scan at the origin, or where the odometry has it."""
    first = int(np.flatnonzero(np.isfinite(poses[:, 0]))[0])
    start = given[first] if np.isfinite(given[first, 0]) else np.zeros(3)
    return composed(composed(start, inverse(poses[first])), poses)


class _Part(NamedTuple):
    """Scans that are placed with respect to each other."""

    poses: Float[np.ndarray, "scans 3"]
    """NaN where a scan is not of this part."""
    map: Places

    @property
    def placed(self) -> Bool[np.ndarray, " scans"]:
        """Which scans are of this part."""
        return np.isfinite(self.poses[:, 0])

    def take(self, scan: int, seen: Seen, pose: Float[np.ndarray, "3"]) -> None:
        """A scan is of this part."""
        self.poses[scan] = pose
        known = explained(self.map, seen, pose[None])
        self.map.add(seen, pose, known.wall[0], known.point[0])


class _Tracker:
    """Places scans in maps."""

    def __init__(self, seen: list[Seen], motion: Motion, margin: float):
        self.seen, self.motion, self.margin = seen, motion, margin
        far = np.concatenate([np.zeros(1), *(one.heard[:, 0] for one in seen)])
        self.reach = 0.85 * float(np.quantile(far, 0.98))  # as near as this walls are surely heard

    def parts(
        self, progress: Callable[[int, int], None] | None, free: Bool[np.ndarray, " scans"] | None = None
    ) -> list[_Part]:
        """The log in pieces, or those scans of it that are free: a new one begins where several find no place."""
        count, parts = len(self.seen), []
        free = np.ones(count, dtype=bool) if free is None else free.copy()
        for start in range(count):
            if not free[start] or not self._begins(start):
                continue
            part = self._begun_at(start, free, progress)
            self.fill(part, free)
            free &= ~part.placed
            parts.append(part)
        if progress is not None:
            progress(count, count)
        return [part for part in parts if part.placed.sum() > 1] or parts[:1]

    def _begins(self, scan: int) -> bool:
        """Whether a map can begin with this scan: two directions, unless odometry holds the free one."""
        seen = self.seen[scan]
        spread = np.abs(np.sin(seen.theta[:, None] - seen.theta)).max(initial=0.0) > NOT_PARALLEL
        enough = spread or (len(seen.theta) and len(seen.point)) or len(seen.point) > 1
        return bool(enough) or bool(len(seen.theta) and self.motion.known(scan))

    def _begun_at(
        self, start: int, free: Bool[np.ndarray, " scans"], progress: Callable[[int, int], None] | None
    ) -> _Part:
        """A part from this scan on, until the way is lost."""
        count, lost = len(self.seen), 0
        part = _Part(np.full((count, 3), np.nan), Places())
        part.take(start, self.seen[start], np.zeros(3))
        for scan in range(start + 1, count):
            found = free[scan] and self.find(part, scan)
            lost = 0 if found else lost + 1
            if progress is not None:
                progress(scan, count)
            if lost >= LOST:
                break
        return part

    def find(self, part: _Part, scan: int) -> bool:
        """Take a scan into a part, if its place there is not open."""
        seen = self.seen[scan]
        if not len(seen.theta) + len(seen.point):
            return False
        placed = np.flatnonzero(part.placed)
        split = int(np.searchsorted(placed, scan))
        anchors = placed[max(split - 1, 0) : split + 1]
        priors = self.motion.priors(part.poses, anchors, scan)
        margin = self.margin + LATE * (int(np.abs(anchors - scan).min()) - 1)
        pose = only_pose(seen, part.map, priors, reach=self.reach, margin=margin)
        if pose is not None:
            part.take(scan, seen, pose)
        return pose is not None

    def fill(self, part: _Part, free: Bool[np.ndarray, " scans"]) -> None:
        """Look again for those that were left out near this part's scans, backward and forward, until none is found."""
        for turn in range(4):
            inside, scans = np.flatnonzero(part.placed), np.arange(len(free))
            behind = np.searchsorted(inside, scans)
            beside = inside[np.clip(np.stack([behind - 1, behind]), 0, len(inside) - 1)]
            near = np.abs(beside - scans).min(axis=0)
            wanted = np.flatnonzero(free & ~part.placed & (near <= LOST))
            more = [self.find(part, int(scan)) for scan in (wanted if turn % 2 else wanted[::-1])]
            if turn and not any(more):
                break

    def joined(self, parts: list[_Part], *, first: bool = False) -> list[_Part]:
        """Lay smaller parts on the largest, or all on the first, wherever that is unambiguous."""
        parts = parts if first else sorted(parts, key=lambda part: -int(part.placed.sum()))
        number = 1
        while number < len(parts):
            moved = self._laid_on(parts[0], parts[number])
            if moved is None:
                number += 1
                continue
            for scan in np.flatnonzero(np.isfinite(moved[:, 0])):
                parts[0].take(int(scan), self.seen[scan], moved[scan])
            parts = parts[:number] + parts[number + 1 :]
            taken = np.any([part.placed for part in parts], axis=0)
            self.fill(parts[0], ~taken)
            # With more known, parts that were open may not be so any more.
            number = 1
        return parts

    def _laid_on(self, base: _Part, other: _Part) -> Float[np.ndarray, "scans 3"] | None:
        """The other part's poses in the base's frame, or None where it is open how they lie."""
        mine, theirs = np.flatnonzero(base.placed), np.flatnonzero(other.placed)
        gap = np.abs(mine[:, None] - theirs)
        a, b = np.unravel_index(int(gap.argmin()), gap.shape)
        anchor = int(theirs[b])
        priors = self.motion.priors(base.poses, mine[a : a + 1], anchor)
        margin = self.margin + LATE * min(int(gap[a, b]), LOST)
        other_from_anchor = other.poses[anchor]
        pose = only_pose(other.map.as_seen(other_from_anchor), base.map, priors, reach=0.0, margin=margin)
        return None if pose is None else composed(composed(pose, inverse(other_from_anchor)), other.poses)
