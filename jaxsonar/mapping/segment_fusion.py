"""Fusion of wall segments into walls: segments that continue or overlap one another and agree are fused iteratively."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from jaxsonar.geometry.se2 import tangent_of, unit, wrap_angle
from jaxsonar.geometry.segments import sample_segments
from jaxsonar.mapping.observations import unique_pairs
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.mapping.wall_segments import WallSegments

OpeningTest = Callable[[Float[np.ndarray, "gaps 2 2"], Float[np.ndarray, " gaps"]], Bool[np.ndarray, " gaps"]]
"""Decides which gaps are openings. Arguments: both ends of each gap (metres) and the normal of its wall (radians)."""


def fuse_segments(
    segments: WallSegments,
    *,
    gap: float,
    systematic_error: float = SETTINGS.fusion.offset_floor,
    is_opening: OpeningTest | None = None,
    near_wall: float = 0.0,
) -> tuple[WallSegments, Int[np.ndarray, " segments"]]:
    """Walls from segments. In each iteration, segments that are each other's best match are fused, until none match.

    Two segments match if they face the same way, have the same direction, lie on one line, and the gap between them is
    at most ``gap``. The result does not depend on the order of the segments, and fusing it again does not change it.

    Args:
        segments: wall segments.
        gap: largest gap that is closed, metres.
        systematic_error: standard deviation of an offset due to pose errors, metres (``estimate_systematic_error``).
        is_opening: decides which gaps stay open although they are short enough.
        near_wall: a segment whose ends are this close to the line of a longer segment matches it as well, metres.

    Returns:
        The walls, and the row of the wall that each segment belongs to.
    """
    wall_of = np.arange(len(segments))
    scans, walls = segments.scans, replace(segments, scans=(wall_of[:0], wall_of[:0]))  # scans are merged once, below
    pairs, cost = np.zeros((0, 2), dtype=np.int64), np.zeros(0)
    changed, exhaustive = np.ones(len(walls), dtype=bool), False
    while len(walls) > 1:
        # New matches involve a changed segment. First search the nearest neighbors, finally all of them.
        nearest = None if exhaustive else SETTINGS.fusion.nearest
        new = _candidate_pairs(walls, changed, gap, systematic_error, nearest=nearest)
        badness, between = compare_segments(walls, new, gap, systematic_error)
        if near_wall:
            offset = _largest_offset(walls, new)
            badness = np.minimum(badness, np.maximum(offset / near_wall, between / gap))
        new, badness, between = new[badness <= 1], badness[badness <= 1], between[badness <= 1]
        if is_opening is not None and (between > 0).any():
            apart = np.flatnonzero(between > 0)
            closed = np.delete(np.arange(len(new)), apart[is_opening(*_gaps_between(walls, new[apart]))])
            new, badness = new[closed], badness[closed]
        pairs, unique = np.unique(np.concatenate([pairs, new]), axis=0, return_index=True)
        cost = np.concatenate([cost, badness])[unique]
        if len(pairs):
            group = mutual_best(pairs, cost, len(walls))
            walls, wall_of = walls.fuse(group), group[wall_of]
            changed = np.bincount(group) > 1
            pairs = group[pairs]
            unchanged = ~changed[pairs].any(axis=1)
            pairs, cost = np.sort(pairs[unchanged], axis=1), cost[unchanged]
        elif exhaustive:
            break
        else:
            changed, exhaustive = np.ones(len(walls), dtype=bool), True
    return replace(walls, scans=unique_pairs(wall_of[scans[0]], scans[1])), wall_of


def estimate_systematic_error(segments: WallSegments, *, gap: float) -> float:
    """Standard deviation of offsets that their covariances do not explain, metres; the effect of pose errors.

    It is twice the excess scatter of the median segment about its wall, between the limits in the settings. Walls and
    error are estimated in turn until the error no longer grows.

    Args:
        segments: wall segments.
        gap: as for ``fuse_segments``.
    """
    error = SETTINGS.fusion.offset_floor
    while True:
        walls, _ = fuse_segments(segments, gap=gap, systematic_error=error)
        walls = walls.take(walls.count > 1)
        if not len(walls):
            return error
        excess_variance = np.maximum(walls.chi_squared - 2 * (walls.count - 1), 0) / walls.info_offset
        order = np.argsort(excess_variance, kind="stable")
        median = np.searchsorted(np.cumsum(walls.count[order]), walls.count.sum() / 2)
        larger = min(2 * float(np.sqrt(excess_variance[order[median]])), SETTINGS.fusion.max_systematic_error)
        if larger < SETTINGS.fusion.min_error_growth * error:
            return error
        error = larger


def robust_refit(
    segments: WallSegments,
    wall_of: Int[np.ndarray, " segments"],
    walls: WallSegments,
    *,
    systematic_error: float = SETTINGS.fusion.offset_floor,
) -> WallSegments:
    """The walls, estimated again with outlying segments down-weighted (iteratively reweighted least squares).

    A line with echoes of another reflector is farther off than its covariance indicates. If a segment deviates from its
    wall by more than ``outlier_gate`` standard deviations, its information is divided by the square of the excess.

    Args:
        segments: wall segments.
        wall_of: row of the wall that each segment belongs to.
        walls: their fusions, the starting point.
        systematic_error: as for ``fuse_segments``; the part above ``offset_floor`` does not count as a deviation.
    """
    settings = SETTINGS.fusion
    slack = systematic_error - settings.offset_floor
    offset_variance = segments.count / segments.info_offset + slack**2
    theta_variance = segments.count / segments.info_theta + (settings.angle_per_offset * slack) ** 2
    for _ in range(settings.refit_iterations):
        offset = ((segments.center - walls.center[wall_of]) * walls.normal[wall_of]).sum(-1)
        angle = (segments.theta - walls.theta[wall_of] + np.pi / 2) % np.pi - np.pi / 2
        squared = offset**2 / offset_variance + angle**2 / theta_variance
        weight = np.minimum(1, settings.outlier_gate**2 / np.maximum(squared, 1e-9))
        weighted = replace(segments, info_offset=weight * segments.info_offset, info_theta=weight * segments.info_theta)
        walls = weighted.fuse(wall_of)
    return walls


def compare_segments(
    segments: WallSegments, pairs: Int[np.ndarray, "pairs 2"], gap: float, systematic_error: float
) -> tuple[Float[np.ndarray, " pairs"], Float[np.ndarray, " pairs"]]:
    """How badly the segments of each pair agree, and the length of the gap between them.

    Args:
        segments: the segments.
        pairs: rows of the segments of each pair.
        gap: longest gap between segments of one wall, metres.
        systematic_error: offset between segments of one wall that does not average out, metres.

    Returns:
        Mismatch: 0 for identical segments, 1 at the first gate, more beyond it. Gap, metres: 0 if they overlap.
    """
    settings = SETTINGS.fusion
    a, b = pairs.T
    angle = wrap_angle(segments.theta[b] - segments.theta[a])
    opposite = np.abs(angle) > np.pi / 2
    angle = np.where(opposite, wrap_angle(angle + np.pi), angle)
    variance = 1 / segments.info_theta
    # Errors that do not average out: those of a single line (it contains foreign echoes), and the systematic error.
    single = segments.count / segments.info_offset
    offset_floor = systematic_error**2 + np.maximum(single[a], single[b])
    theta_floor = settings.angle_per_offset**2 * offset_floor

    # The common line, as WallSegments.fuse would place it, and the distance of both centers across it.
    weight_b = segments.info_theta[b] / (segments.info_theta[a] + segments.info_theta[b])
    theta = segments.theta[a] + weight_b * angle
    tangent, normal = tangent_of(theta), unit(theta)
    offset = segments.center[b] - segments.center[a]
    along, across = (offset * tangent).sum(-1), (offset * normal).sum(-1)
    info_a, info_b = segments.info_offset[a], segments.info_offset[b]
    info_both = info_a * info_b / (info_a + info_b)
    rotation = -info_both * along * across / (segments.info_theta[a] + segments.info_theta[b] + info_both * along**2)
    apart = np.abs(across + rotation * along)
    # The gap between the two, along the common line.
    endpoints = segments.endpoints
    first = ((endpoints[a] - segments.center[a][:, None]) * tangent[:, None]).sum(-1)
    second = ((endpoints[b] - segments.center[a][:, None]) * tangent[:, None]).sum(-1)
    between = np.maximum(first.min(-1) - second.max(-1), second.min(-1) - first.max(-1))
    between = np.maximum(between, 0)
    # Angles by which each must be rotated onto the common line, and the angle between both, as fractions of the gate.
    turns = np.abs(np.stack([weight_b * angle + rotation, (weight_b - 1) * angle + rotation]))
    turns = (turns / np.sqrt(variance[[a, b]] + theta_floor)).max(axis=0)
    turns = np.maximum(turns, np.abs(angle) / np.sqrt(variance[a] + variance[b] + 2 * theta_floor)) / settings.gate
    spread = np.sqrt(1 / info_a + 1 / info_b + offset_floor)
    same_side_gate = np.minimum(settings.max_offset, settings.gate * spread)
    offset_gate = np.where(opposite, settings.max_thickness, same_side_gate)
    return np.maximum.reduce([apart / offset_gate, turns, between / gap]), between


def _largest_offset(segments: WallSegments, pairs: Int[np.ndarray, "pairs 2"]) -> Float[np.ndarray, " pairs"]:
    """Larger distance of the two ends of the shorter segment of each pair from the line of the longer one, metres."""
    a, b = pairs.T
    a, b = np.where(segments.length[a] < segments.length[b], [b, a], [a, b])
    offset = segments.endpoints[b] - segments.center[a][:, None]
    return np.abs((offset * segments.normal[a][:, None]).sum(-1)).max(axis=-1)


def _gaps_between(
    segments: WallSegments, pairs: Int[np.ndarray, "pairs 2"]
) -> tuple[Float[np.ndarray, "pairs 2 2"], Float[np.ndarray, " pairs"]]:
    """The nearest ends of the two segments of each pair, metres, and the normal of the first one, radians."""
    a, b = pairs.T
    ends = segments.endpoints
    apart = np.linalg.norm(ends[a][:, :, None] - ends[b][:, None], axis=-1).reshape(-1, 4)
    nearest = apart.argmin(axis=1)
    return np.stack([ends[a, nearest // 2], ends[b, nearest % 2]], axis=1), segments.theta[a]


def _candidate_pairs(
    segments: WallSegments,
    changed: Bool[np.ndarray, " segments"],
    gap: float,
    systematic_error: float,
    *,
    nearest: int | None,
) -> Int[np.ndarray, "pairs 2"]:
    """Pairs that may match, at least one of them changed: segments with samples close in position and direction.

    With ``nearest``, only that many neighbors of each sample are considered.
    """
    settings = SETTINGS.fusion
    samples = np.maximum(np.ceil(segments.length / gap).astype(np.int64), 1) + 1
    position, segment = sample_segments(segments.endpoints, samples)
    direction = 0.5 * settings.angle_scale * unit(2 * segments.theta[segment])  # both sides of a wall are one direction
    points = np.concatenate([position, direction], axis=-1)
    theta_floor = settings.angle_per_offset**2 * (systematic_error**2 + (segments.count / segments.info_offset).max())
    largest_angle = settings.gate * np.sqrt(2 / segments.info_theta.min() + 2 * theta_floor)
    angular_distance = settings.angle_scale * min(largest_angle, np.pi / 2)
    radius = float(np.hypot(settings.search_gaps * gap + settings.max_offset, angular_distance))
    tree, queries = KDTree(points), np.flatnonzero(changed[segment])
    if nearest is None and len(queries) == len(points):
        one, other = tree.query_pairs(radius, output_type="ndarray").reshape(-1, 2).T
    elif nearest is None:
        found = tree.query_ball_point(points[queries], radius)
        one = np.repeat(queries, [len(near) for near in found])
        other = np.array([k for near in found for k in near], dtype=np.int64)
    else:
        near = tree.query(points[queries], k=min(nearest, len(points)), distance_upper_bound=radius)[1]
        near = np.asarray(near)
        row, rank = np.nonzero(near < len(points))
        one, other = queries[row], near[row, rank]
    one, other = np.sort([segment[one], segment[other]], axis=0)
    flat = np.unique((one * len(segments) + other)[one < other])
    return np.stack([flat // len(segments), flat % len(segments)], axis=-1)


def mutual_best(
    pairs: Int[np.ndarray, "pairs 2"], cost: Float[np.ndarray, " pairs"], items: int
) -> Int[np.ndarray, " items"]:
    """Group number of each item; two items share a group if each is the other's partner of lowest cost.

    Args:
        pairs: numbers of the two items of each pair.
        cost: cost of each pair.
        items: number of items.
    """
    best = np.full(items, np.inf)
    for side in (0, 1):
        np.minimum.at(best, pairs[:, side], cost)
    chosen = pairs[(cost == best[pairs[:, 0]]) & (cost == best[pairs[:, 1]])]
    graph = coo_array((np.ones(len(chosen), np.int8), (chosen[:, 0], chosen[:, 1])), shape=(items, items))
    return connected_components(graph, directed=False)[1]
