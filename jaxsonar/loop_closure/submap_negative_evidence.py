"""Negative evidence against an alignment of two submaps: blocked trajectories and lines of sight, missed reflectors.

All functions evaluate many poses at once. What each submap observed is compared with the walls of the other.
"""

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar.geometry.se2 import compose, inverse, transform_points, wrap_angle
from jaxsonar.loop_closure.settings import SETTINGS
from jaxsonar.loop_closure.submap_view import SubmapNeighborhood, SubmapView
from jaxsonar.registration.features import crosses_walls


def submap_negative_evidence(
    earlier: SubmapView,
    newest: SubmapView,
    poses: Float[np.ndarray, "poses 3"],
    *,
    tolerance: float,
    reliable_range: float,
) -> Float[np.ndarray, " poses"]:
    """Evidence against poses of the newest submap, nats.

    Args:
        earlier: the submap that stays.
        newest: the submap that is moved.
        poses: earlier_from_newest.
        tolerance: largest distance between two observations of one wall, metres.
        reliable_range: walls within this distance are surely detected, metres.
    """
    back = inverse(poses)
    first = _one_sided(newest, earlier, poses, back, tolerance, reliable_range)
    return first + _one_sided(earlier, newest, back, poses, tolerance, reliable_range)


def neighborhood_negative_evidence(
    earlier: SubmapNeighborhood,
    newest: SubmapNeighborhood,
    poses: Float[np.ndarray, "poses 3"],
    *,
    tolerance: float,
    reliable_range: float,
    limit: float,
) -> Float[np.ndarray, " poses"]:
    """Largest negative evidence of any pair of submaps of two neighborhoods, nats.

    The maximum is taken and not the sum, because neighbors observe the same walls.

    Args:
        earlier: the submap that stays, with its neighbors.
        newest: the submap that is moved, with its neighbors.
        poses: earlier_from_newest.
        tolerance: as for ``submap_negative_evidence``; it must include the errors between neighbors.
        reliable_range: walls within this distance are surely detected, metres.
        limit: evidence beyond which no further pair is evaluated, nats; the result is bounded by it.
    """
    nats = np.zeros(len(poses))
    for stays, mine in earlier.all:
        for moves, yours in newest.all:
            row = np.flatnonzero(nats < limit)
            pose = compose(inverse(stays), compose(poses[row], moves))
            distance = np.linalg.norm(transform_points(pose, yours.center) - mine.center, axis=-1)
            close = distance < mine.radius + yours.radius + reliable_range
            row, pose = row[close], pose[close]
            found = submap_negative_evidence(mine, yours, pose, tolerance=tolerance, reliable_range=reliable_range)
            nats[row] = np.maximum(nats[row], found)
    return np.minimum(nats, limit)


def _one_sided(
    viewer: SubmapView,
    other: SubmapView,
    poses: Float[np.ndarray, "poses 3"],
    back: Float[np.ndarray, "poses 3"],
    tolerance: float,
    reliable_range: float,
) -> Float[np.ndarray, " poses"]:
    """Observations of the viewer against the walls of the other; poses are other_from_viewer, back the inverse."""
    walls = other.features
    if not len(walls.theta):
        return np.zeros(len(poses))
    # 1. Walls across the trajectory and across lines of sight.
    viewpoint, start, end = (
        transform_points(poses[:, None], part) for part in (viewer.viewpoint, viewer.sight_start, viewer.sight_end)
    )
    blocked_trajectory = _crosses(other, viewpoint[:, :-1], viewpoint[:, 1:], tolerance).any(axis=1).sum(-1)
    blocked_sight = _crosses(other, start, end, tolerance).any(axis=-1).sum(-1)
    nats = SETTINGS.blocked_trajectory_nats * blocked_trajectory + SETTINGS.blocked_sight_nats * blocked_sight
    # 2. Missed walls: they face a viewpoint, are near, not hidden, and not among the viewer's own walls.
    offset = viewpoint[:, :, None] - walls.reference
    along, distance = (offset * walls.tangent).sum(-1), -(offset * walls.normal).sum(-1)
    due = (distance > SETTINGS.min_range) & (distance < reliable_range) & other.is_certain
    due &= np.abs(along) < walls.half_length - SETTINGS.end_margin
    due &= ~_has_wall(viewer, other, poses, tolerance)[:, None]
    if viewer.directions is not None:
        normal = walls.theta + back[:, 2, None, None]
        due &= viewer.measured_from(np.broadcast_to(normal, due.shape))
    foot = viewpoint[:, :, None] + 0.9 * distance[..., None] * walls.normal
    nats += _missed_nats(viewer, other, back, viewpoint, foot, due).sum(-1)
    # 3. Missed points.
    offset = walls.point - viewpoint[:, :, None]
    distance = np.linalg.norm(offset, axis=-1)
    due = (distance > SETTINGS.min_range) & (distance < reliable_range) & (other.point_factor > 0)
    own = transform_points(poses[:, None], viewer.features.point)
    nearest = np.linalg.norm(own[:, :, None] - walls.point, axis=-1).min(axis=1, initial=np.inf)
    due &= ~(nearest < tolerance + 0.1)[:, None]
    if viewer.directions is not None:
        due &= viewer.measured_from(np.arctan2(offset[..., 1], offset[..., 0]) + back[:, 2, None, None])
    missed = _missed_nats(viewer, other, back, viewpoint, viewpoint[:, :, None] + 0.9 * offset, due)
    return nats + (other.point_factor * missed).sum(-1)


def _missed_nats(
    viewer: SubmapView,
    other: SubmapView,
    back: Float[np.ndarray, "poses 3"],
    viewpoint: Float[np.ndarray, "poses viewpoints 2"],
    target: Float[np.ndarray, "poses viewpoints reflectors 2"],
    due: Bool[np.ndarray, "poses viewpoints reflectors"],
) -> Float[np.ndarray, "poses reflectors"]:
    """Negative evidence of reflectors that are due from viewpoints, unless a wall of either submap hides them."""
    pose, view, which = np.nonzero(due)
    if len(pose):
        at, end = viewpoint[pose, view], target[pose, view, which]
        hidden = _crosses(other, at[:, None], end[:, None], 0.0).any(axis=(1, 2))
        away = back[pose]
        own = [transform_points(away, part) for part in (at, end)]
        if len(viewer.features.theta):
            hidden |= _crosses(viewer, own[0][:, None], own[1][:, None], 0.0).any(axis=(1, 2))
        due[pose[hidden], view[hidden], which[hidden]] = False
    missed = np.array(SETTINGS.missed_nats)
    return missed[np.minimum(due.sum(axis=1), len(missed) - 1)]


def _has_wall(
    viewer: SubmapView, other: SubmapView, poses: Float[np.ndarray, "poses 3"], tolerance: float
) -> Bool[np.ndarray, "poses walls"]:
    """Whether the viewer observed each wall of the other."""
    own, walls = viewer.features, other.features
    turn = wrap_angle(own.theta[:, None] - walls.theta + poses[:, 2, None, None])
    offset = transform_points(poses[:, None], own.reference)[:, :, None] - walls.reference
    across, along = (offset * walls.normal).sum(-1), (offset * walls.tangent).sum(-1)
    # The directions may differ a little: the distance is taken where the two walls face each other.
    half = walls.half_length
    shift = np.clip(along, -half, half) - along
    across = across + np.tan(np.clip(turn, -SETTINGS.same_wall_angle, SETTINGS.same_wall_angle)) * shift
    overlap = np.abs(along) < half + own.half_length[:, None]
    return ((np.abs(turn) < SETTINGS.same_wall_angle) & (np.abs(across) < tolerance + 0.05) & overlap).any(axis=1)


def _crosses(
    walls: SubmapView,
    start: Float[np.ndarray, "poses lines 2"],
    end: Float[np.ndarray, "poses lines 2"],
    tolerance: float,
) -> Bool[np.ndarray, "poses lines walls"]:
    """Whether lines clearly pass through walls."""
    return crosses_walls(
        walls.features,
        start,
        end,
        start_margin=SETTINGS.crossing_margin,
        end_margin=SETTINGS.crossing_margin + tolerance,
        border=SETTINGS.crossing_border + tolerance,
    )
