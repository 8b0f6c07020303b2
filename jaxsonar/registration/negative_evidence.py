"""What speaks for and against scans that lie together beside their targets: silence, walls in the way, loose echoes."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.geometry.se2 import unit
from jaxsonar.registration.cluster_adjustment import Part
from jaxsonar.registration.echo_targets import Geometry, Range, Views, expected
from jaxsonar.registration.feature_map import quarter, tangent_of, turned

DUE, SILENT = 4, 0.7
"""So many paths, and this share of them, must hear nothing of a reflector that is due for that to mean anything."""
SILENCE, MOST_SILENCE = 0.4, 4.0
"""Nats for each silent path, and for all of one scan and reflector; half of that for corners."""
IN_THE_WAY, MOST = 4.0, 8.0
"""Nats against a wall in the way; and most of what is held against one reflector."""
NEAREST = 0.2
"""No robot is nearer to a wall, metres."""
CLOSE = 2
"""Scans between which a robot goes about straight."""
LOOSE, MOST_LOOSE = 0.5, 5.0
"""Share of the loose echoes that come from something known; nats of those of one scan and reflector at most."""
_INSIDE, _WIDER = 0.7, 1.3  # squared chord off the axis over that of the cone: surely heard, perhaps heard
_REACH = 0.9  # of the maximum range
_NEAR, _BLANKED = 0.03, 0.05  # m, beside three sigma; behind another echo
_MARGIN, _BESIDE, _ALONG = 0.06, 0.03, 0.3  # m; of walls in the way, of walls that are due, of walls of loose echoes
_BEFORE = 0.1  # m; a sensor is before a wall
_WORST = 0.02  # m; standard deviation of a range that a reflector is expected at


def against(views: Views, part: Part) -> float:
    """Nats against a part: what its scans should have heard, walls in the way, and the robot on walls."""
    if not len(part.kind) or len(part.rows) < 2:
        return 0.0
    poses, wall = part.poses[part.rows], part.kind == kernels.PLANE
    look = _Look.of(part, poses[:, None], views.paths.take(views.near))
    due = look.faced & (look.off_axis < _INSIDE) & (look.range.reach < _REACH * float(views.ring.max_range))
    due &= ~wall[:, None, None] | _within(part, look.foot, _BESIDE)
    due &= (part.kind != kernels.EDGE)[:, None, None]  # faint
    # Heard, or just behind something else.
    behind = look.range.reach[..., None] - views.ranges[part.rows][:, views.near]
    heard = (np.abs(behind) < _NEAR + 3 * views.sigma) | ((behind > 0) & (behind < _BLANKED))
    silent, count = (due & ~heard.any(axis=-1)).sum(axis=-1), due.sum(axis=-1)
    own = np.zeros((len(part.kind), len(part.poses)), dtype=bool)
    mine = np.flatnonzero(part.owner >= 0)
    own[part.owner[mine], views.targets.scan[mine]] = True
    own = own[:, part.rows]
    blocked = _blocked(part, poses, _spots(part, poses, look.foot, due))
    means = (silent >= DUE) & (silent > SILENT * count) & ~own & ~blocked
    nats = np.where(means, np.minimum(SILENCE * silent, MOST_SILENCE), 0.0) * np.where(wall, 1.0, 0.5)[:, None]
    nats += np.where(own & blocked, IN_THE_WAY, 0.0)
    return float(np.minimum(nats.sum(axis=1), MOST).sum()) + IN_THE_WAY * _on_walls(part, poses)


def loose_explained(views: Views, part: Part) -> float:
    """Nats of loose echoes that reflectors of a part explain, against their being anywhere."""
    echoes = views.loose
    mine = np.flatnonzero(part.placed[echoes.scan])
    if not len(mine) or not len(part.kind):
        return 0.0
    look = _Look.of(part, part.poses[echoes.scan[mine]], views.paths.take(echoes.path[mine]))
    extent, wall = part.extent, part.kind == kernels.PLANE
    beside = (look.foot < extent[:, :1] - _ALONG) | (look.foot > extent[:, 1:] + _ALONG)
    heard = look.faced & (look.off_axis < _WIDER) & ~(wall[:, None] & beside)
    spread = np.einsum("rei,rij,rej->re", look.range.own, part.cov, look.range.own)
    variance = views.sigma**2 + np.minimum(spread, _WORST**2)
    density = np.exp(-np.square(echoes.range[mine] - look.range.reach) / variance / 2) / np.sqrt(2 * np.pi * variance)
    density = np.where(heard, density, 0.0) * float(views.ring.max_range) / np.maximum(heard.sum(axis=0), 2)
    nats = np.log(1 + LOOSE / (1 - LOOSE) * density.sum(axis=0))
    both = echoes.scan[mine] * len(part.kind) + density.argmax(axis=0)
    return float(np.minimum(np.bincount(both, weights=nats), MOST_LOOSE).sum())


class _Look(NamedTuple):
    """How paths hear reflectors: reflectors x (scans x paths, or echoes)."""

    faced: Bool[np.ndarray, "reflectors *batch"]
    """Whether the sensors are before the wall; true for points."""
    off_axis: Float[np.ndarray, "reflectors *batch"]
    """Squared chord off the axis over that of the cone, the larger of both sensors."""
    foot: Float[np.ndarray, "reflectors *batch"]
    """Where along a wall, metres from the foot of the origin."""
    range: Range

    @classmethod
    def of(cls, part: Part, pose: Float[np.ndarray, "... 3"], paths: Geometry) -> "_Look":
        heading = pose[..., 2]
        middle = (pose[..., :2] + turned(paths.middle, heading))[None]
        base = turned(paths.base, heading)[None]
        place = part.place.reshape(-1, *[1] * (middle.ndim - 2), 2)
        found = expected(part.kind, place, middle, base)
        sides = zip((found.leaving, found.arriving), np.moveaxis(paths.axes, -2, 0), paths.cone.T, strict=True)
        off = [np.square(way - turned(axis, heading)).sum(axis=-1) / cone for way, axis, cone in sides]
        height = place[..., 0] - (middle * unit(place[..., 1])).sum(axis=-1)
        foot = (middle * tangent_of(place[..., 1])).sum(axis=-1)
        wall = (part.kind == kernels.PLANE).reshape(-1, *[1] * (height.ndim - 1))
        return cls(~wall | (height > _BEFORE), np.maximum(*off), foot, found)


def _within(
    part: Part,
    along: Float[np.ndarray, "some *batch"],
    margin: float,
    rows: Int[np.ndarray, " some"] | None = None,
) -> Bool[np.ndarray, "some *batch"]:
    """Whether places along walls lie in what a scan saw of them, less a margin.

    Args:
        part: with the walls.
        along: metres along the tangent from the foot of the origin.
        margin: metres.
        rows: reflectors of the places; all of them if left out.
    """
    number = np.full(len(part.kind), -1)
    rows = np.arange(len(part.kind)) if rows is None else rows
    number[rows] = np.arange(len(rows))
    out = np.zeros(along.shape, dtype=bool)
    for target in np.flatnonzero(part.owner >= 0):
        row, (low, high) = number[part.owner[target]], part.stretch[target]
        if row >= 0:
            out[row] |= (along[row] > low + margin) & (along[row] < high - margin)
    return out


def _spots(
    part: Part,
    poses: Float[np.ndarray, "scans 3"],
    foot: Float[np.ndarray, "reflectors scans paths"],
    due: Bool[np.ndarray, "reflectors scans paths"],
) -> Float[np.ndarray, "reflectors scans 2"]:
    """Where scans would hear reflectors: points, and on walls the middle of what is due, or what is nearest."""
    tangent, extent = tangent_of(part.place[:, 1]), part.extent
    beside = tangent @ poses[:, :2].T
    mean = np.where(due.any(axis=-1), (foot * due).sum(axis=-1) / np.maximum(due.sum(axis=-1), 1), beside)
    mean = np.clip(mean, extent[:, :1], extent[:, 1:])
    nearest = (part.place[:, :1] * unit(part.place[:, 1]))[:, None] + mean[..., None] * tangent[:, None]
    return np.where((part.kind == kernels.PLANE)[:, None, None], nearest, part.place[:, None])


def _blocked(
    part: Part, poses: Float[np.ndarray, "scans 3"], spot: Float[np.ndarray, "reflectors scans 2"]
) -> Bool[np.ndarray, "reflectors scans"]:
    """Whether another wall is between scans and what they would hear."""
    wall = np.flatnonzero(part.kind == kernels.PLANE)
    normal = unit(part.place[wall, 1])
    tangent = quarter(normal)
    start = (part.place[wall, 0] - poses[:, :2] @ normal.T)[None]
    end = part.place[wall, 0] - spot @ normal.T
    before, behind = (poses[:, :2] @ tangent.T)[None], spot @ tangent.T
    apart = np.where(np.abs(start - end) > 1e-9, start - end, 1e-9)
    at = before + start / apart * (behind - before)
    through = (np.minimum(start, end) < -_MARGIN) & (np.maximum(start, end) > _MARGIN)
    through &= np.moveaxis(_within(part, np.moveaxis(at, -1, 0), _MARGIN, wall), 0, -1)
    return (through & (wall != np.arange(len(part.kind))[:, None, None])).any(axis=-1)


def _on_walls(part: Part, poses: Float[np.ndarray, "scans 3"]) -> int:
    """How often the robot is on a wall, or goes through one from a scan to the next."""
    wall = np.flatnonzero(part.kind == kernels.PLANE)
    normal = unit(part.place[wall, 1])
    height = part.place[wall, 0][:, None] - normal @ poses[:, :2].T
    along = quarter(normal) @ poses[:, :2].T
    on = _within(part, along, 0.0, wall) & (np.abs(height) < NEAREST)
    before, after = height[:, :-1], height[:, 1:]
    apart = np.where(np.abs(before - after) > 1e-9, before - after, 1e-9)
    at = along[:, :-1] + before / apart * np.diff(along, axis=1)
    through = (before * after < 0) & _within(part, at, 0.02, wall) & (np.diff(part.rows) <= CLOSE)
    return int(on.sum() + through.sum())
