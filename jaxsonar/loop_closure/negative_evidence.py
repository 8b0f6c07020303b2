"""What two submaps say against lying as they would: walls across a way, and walls that should have been heard.

Everything is asked of many poses at once, both ways round: what the one saw is held against the walls of the other.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.geometry.se2 import composed, inverse, unit, wrap_angle
from jaxsonar.loop_closure.submap import Submap
from jaxsonar.registration.feature_map import tangent_of, turned

VIEWS = 6
"""Places of the path from which is looked."""
OFTEN = 3
"""Scans that must have seen a wall before its absence elsewhere says anything."""
PATH_CROSSED, SIGHT_CROSSED = 6.0, 3.0
"""Nats against a wall across the robot's path, and across the way to what it heard."""
UNHEARD = np.array([0.0, 1.0, 2.0, 3.0])
"""Nats against a wall that was not heard from 0, 1, 2 and more places."""
CORNER_SHARE, EDGE_SHARE = 0.6, 0.3
"""The same of corners and of edges, which are faint, as a share."""
BODY = 0.1
"""Any robot reaches at least this far from its centre, metres."""
NEAREST, ASKEW, EDGE = 0.2, np.radians(15.0), 0.15
"""Walls are heard from this far on, taken for each other up to this angle, and not surely there this near to an end."""


class Surroundings(NamedTuple):
    """A submap as is needed here, in its own frame."""

    rows: Int[np.ndarray, " walls"]
    """Of the submap."""
    theta: Float[np.ndarray, " walls"]
    """Direction of the normal, away from the robot."""
    middle: Float[np.ndarray, "walls 2"]
    half: Float[np.ndarray, " walls"]
    """Half the length."""
    sure: Bool[np.ndarray, " walls"]
    """Seen often."""
    point: Float[np.ndarray, "points 2"]
    share: Float[np.ndarray, " points"]
    """How much the absence of each says, as a share of that of a wall."""
    path: Float[np.ndarray, "views 2"]
    start: Float[np.ndarray, "sights 2"]
    end: Float[np.ndarray, "sights 2"]
    """From the robot to what it heard, nearly."""

    @property
    def middle_of_path(self) -> Float[np.ndarray, "2"]:
        """Of the box around the path."""
        return (self.path.min(axis=0) + self.path.max(axis=0)) / 2

    @property
    def radius(self) -> float:
        """Metres from there to the ends of the path, at most."""
        return float(np.linalg.norm(np.ptp(self.path, axis=0))) / 2


class Vicinity(NamedTuple):
    """Surroundings of a submap and of those along the path just before and after it."""

    own: Surroundings
    beside: tuple[tuple[Float[np.ndarray, "3"], Surroundings], ...] = ()
    """The others, the nearest first: own_from_other, and what it is."""

    @property
    def all(self) -> tuple[tuple[Float[np.ndarray, "3"], Surroundings], ...]:
        """Its own as well, first."""
        return (np.zeros(3), self.own), *self.beside


def surroundings(submap: Submap) -> Surroundings:
    """Of one submap."""
    row, segment = submap.walls, submap.segments
    theta = submap.parameters[row, 1]
    middle, half = segment.mean(axis=1), np.linalg.norm(segment[:, 1] - segment[:, 0], axis=-1) / 2
    chosen = np.unique(np.linspace(0, max(len(submap.poses) - 1, 0), VIEWS).round().astype(int))
    path = submap.poses[chosen, :2] if len(submap.poses) else np.zeros((1, 2))
    # Each wall from all places whose foot is on it, each point from the nearest place.
    offset = path[:, None] - middle
    along, distance = (offset * tangent_of(theta)).sum(-1), -(offset * unit(theta)).sum(-1)
    beside = np.where((np.abs(along) <= half + EDGE) & (distance > 0), distance, np.inf)
    targets, starts = [submap.points], [_nearest(path, submap.points)]
    view, wall = np.nonzero(np.isfinite(beside))
    targets.append(path[view] + distance[view, wall, None] * unit(theta[wall]))
    starts.append(path[view])
    start, target = np.concatenate(starts), np.concatenate(targets)
    other = np.flatnonzero(submap.kind != kernels.PLANE)
    share = np.where(submap.kind[other] == kernels.CORNER, CORNER_SHARE, EDGE_SHARE) * (submap.scans[other] >= OFTEN)
    sure, end = submap.scans[row] >= OFTEN, start + 0.9 * (target - start)
    # The robot itself takes room: no wall goes through it either.
    away = target - start
    start = start - BODY * away / np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-9)
    return Surroundings(row, theta, middle, half, sure, submap.points, share, path, start, end)


def _nearest(
    path: Float[np.ndarray, "views 2"], points: Float[np.ndarray, "points 2"]
) -> Float[np.ndarray, "points 2"]:
    return path[np.linalg.norm(path[:, None] - points, axis=-1).argmin(axis=0)]


def against(
    earlier: Surroundings,
    newest: Surroundings,
    poses: Float[np.ndarray, "poses 3"],
    *,
    slack: float,
    reach: float,
) -> Float[np.ndarray, " poses"]:
    """Nats against poses.

    Args:
        earlier: of the submap that stays.
        newest: of the submap that is moved.
        poses: earlier_from_newest.
        slack: how far walls may be off and still be taken for one another, metres.
        reach: walls as near as this are heard, metres.
    """
    back = inverse(poses)
    return _against(newest, earlier, poses, back, slack, reach) + _against(earlier, newest, back, poses, slack, reach)


def against_vicinity(
    earlier: Vicinity,
    newest: Vicinity,
    poses: Float[np.ndarray, "poses 3"],
    *,
    slack: float,
    reach: float,
    enough: float,
) -> Float[np.ndarray, " poses"]:
    """The same, and what is known before and after either may speak: what speaks most, for walls are in several.

    Args:
        earlier: of the submap that stays.
        newest: of the submap that is moved.
        poses: earlier_from_newest.
        slack: as for ``against``; it must bear the errors between neighbors as well.
        reach: walls as near as this are heard, metres.
        enough: nats above which no more is asked.
    """
    nats = np.zeros(len(poses))
    for stays, mine in earlier.all:
        for moves, yours in newest.all:
            asked = np.flatnonzero(nats < enough)
            there = np.concatenate([_moved(poses[asked], moves[None, :2])[:, 0], poses[asked, 2:] + moves[2]], axis=-1)
            pose = composed(inverse(stays), there)
            near = np.linalg.norm(_moved(pose, yours.middle_of_path[None])[:, 0] - mine.middle_of_path, axis=-1)
            close = near < mine.radius + yours.radius + reach
            asked, pose = asked[close], pose[close]
            nats[asked] = np.maximum(nats[asked], against(mine, yours, pose, slack=slack, reach=reach))
    return np.minimum(nats, enough)


def _against(
    viewer: Surroundings,
    other: Surroundings,
    poses: Float[np.ndarray, "poses 3"],
    back: Float[np.ndarray, "poses 3"],
    slack: float,
    reach: float,
) -> Float[np.ndarray, " poses"]:
    """What one has seen against the walls of the other; poses are other_from_viewer, back viewer_from_other."""
    if not len(other.theta):
        return np.zeros(len(poses))
    path, start, end = (_moved(poses, part) for part in (viewer.path, viewer.start, viewer.end))
    crossed = _crossed(other, path[:, :-1], path[:, 1:], slack).any(axis=1).sum(-1)
    nats = PATH_CROSSED * crossed + SIGHT_CROSSED * _crossed(other, start, end, slack).any(axis=-1).sum(-1)
    # Walls that face a place of the path, near, behind nothing, and that are not among the viewer's own.
    offset = path[:, :, None] - other.middle
    along, distance = (offset * tangent_of(other.theta)).sum(-1), -(offset * unit(other.theta)).sum(-1)
    due = (distance > NEAREST) & (distance < reach) & (np.abs(along) < other.half - EDGE) & other.sure
    due &= ~_known(viewer, other, poses, slack)[:, None]
    foot = path[:, :, None] + 0.9 * distance[..., None] * unit(other.theta)
    nats += _unheard(viewer, other, back, path, foot, due).sum(-1)
    # Points likewise.
    offset = other.point - path[:, :, None]
    distance = np.linalg.norm(offset, axis=-1)
    due = (distance > NEAREST) & (distance < reach) & (other.share > 0)
    mine = _moved(poses, viewer.point)
    found = np.linalg.norm(mine[:, :, None] - other.point, axis=-1).min(axis=1, initial=np.inf) < slack + 0.1
    due &= ~found[:, None]
    return nats + (other.share * _unheard(viewer, other, back, path, path[:, :, None] + 0.9 * offset, due)).sum(-1)


def _unheard(
    viewer: Surroundings,
    other: Surroundings,
    back: Float[np.ndarray, "poses 3"],
    path: Float[np.ndarray, "poses views 2"],
    target: Float[np.ndarray, "poses views reflectors 2"],
    due: Bool[np.ndarray, "poses views reflectors"],
) -> Float[np.ndarray, "poses reflectors"]:
    """Nats against reflectors that were due from these views, if nothing was in between."""
    pose, view, which = np.nonzero(due)
    if len(pose):
        at, end = path[pose, view], target[pose, view, which]
        hidden = _crossed(other, at[:, None], end[:, None], 0.0).any(axis=(1, 2))
        away = back[pose]
        mine = [turned(part, away[:, 2]) + away[:, :2] for part in (at, end)]
        if len(viewer.theta):
            hidden |= _crossed(viewer, mine[0][:, None], mine[1][:, None], 0.0).any(axis=(1, 2))
        due[pose[hidden], view[hidden], which[hidden]] = False
    return UNHEARD[np.minimum(due.sum(axis=1), len(UNHEARD) - 1)]


def _moved(
    poses: Float[np.ndarray, "poses 3"], places: Float[np.ndarray, "places 2"]
) -> Float[np.ndarray, "poses places 2"]:
    return turned(places, poses[:, 2, None]) + poses[:, None, :2]


def _known(
    viewer: Surroundings, other: Surroundings, poses: Float[np.ndarray, "poses 3"], slack: float
) -> Bool[np.ndarray, "poses walls"]:
    """Which walls of the other the viewer has as well."""
    turn = wrap_angle(viewer.theta[:, None] - other.theta + poses[:, 2, None, None])
    offset = _moved(poses, viewer.middle)[:, :, None] - other.middle
    across, along = (offset * unit(other.theta)).sum(-1), (offset * tangent_of(other.theta)).sum(-1)
    # The viewer's wall may be askew a little: what counts is where the two face each other.
    shift = np.clip(along, -other.half, other.half) - along
    across = across + np.tan(np.clip(turn, -ASKEW, ASKEW)) * shift
    near = np.abs(along) < other.half + viewer.half[:, None]
    return ((np.abs(turn) < ASKEW) & (np.abs(across) < slack + 0.05) & near).any(axis=1)


def _crossed(
    walls: Surroundings, start: Float[np.ndarray, "poses ways 2"], end: Float[np.ndarray, "poses ways 2"], slack: float
) -> Bool[np.ndarray, "poses ways walls"]:
    """Which ways go through the known part of which walls, clearly."""
    normal, tangent = unit(walls.theta), tangent_of(walls.theta)
    first, last = start[:, :, None] - walls.middle, end[:, :, None] - walls.middle
    before, behind = (first * normal).sum(-1), (last * normal).sum(-1)
    apart = np.where(np.abs(before - behind) > 1e-9, before - behind, 1e-9)
    along = (first * tangent).sum(-1) + before / apart * ((last - first) * tangent).sum(-1)
    through = (before * behind < 0) & (np.abs(before) > 0.05) & (np.abs(behind) > 0.05 + slack)
    return through & (np.abs(along) < walls.half - 0.1 - slack)
