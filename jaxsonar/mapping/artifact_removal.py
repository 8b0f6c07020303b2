"""Removal of segments that are not walls (lines of corners, edges and poles) and of walls that are no longer there."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jaxsonar.geometry.se2 import perpendicular, wrap_angle
from jaxsonar.geometry.segments import cross
from jaxsonar.mapping.driven_space import DrivenSpace
from jaxsonar.mapping.free_space import DirectionalFreeSpace
from jaxsonar.mapping.observations import neighbor_pairs
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.mapping.wall_segments import WallSegments


def remove_corner_lines(segments: WallSegments, walls: WallSegments) -> WallSegments:
    """The segments without the lines that corners and edges of the walls produce.

    A corner produces the same echoes as a wall through it that is perpendicular to the line of sight. Its lines are
    short, lie where two walls meet or one ends, and have the direction of neither.
    """
    settings = SETTINGS.artifacts
    long = np.flatnonzero(walls.length >= settings.min_wall_length)
    short = np.flatnonzero(segments.length < settings.min_wall_length)
    vertices, owners = _vertices(walls, long)
    artifact = np.zeros(len(segments), dtype=bool)
    if not len(vertices) or not len(short):
        return segments
    row, vertex = neighbor_pairs(vertices, segments.center[short], settings.corner_radius)
    segment = short[row]
    angle = angle_between_lines(segments.theta[segment][:, None], walls.theta[owners[vertex]])
    free_end = owners[vertex, 0] == owners[vertex, 1]
    stands_on_end = free_end & (np.abs(angle[:, 0] - np.pi / 2) < settings.perpendicular)
    other_direction = np.all(angle > settings.same_direction, axis=1)
    artifact[segment[other_direction & ~stands_on_end]] = True
    artifact[segment[~other_direction & ~free_end]] = False  # it continues one of the walls that meet here
    return segments.take(~artifact)


def is_pole_line(walls: WallSegments) -> Bool[np.ndarray, " walls"]:
    """Which walls are lines that poles produce: short ones with different directions at one position.

    A pole reflects sound to every pose, and its line is always perpendicular to the line of sight.
    """
    settings = SETTINGS.artifacts
    short = np.flatnonzero(walls.length < settings.min_wall_length)
    artifact = np.zeros(len(walls), dtype=bool)
    if len(short) > 1:
        pairs = KDTree(walls.center[short]).query_pairs(settings.corner_radius, output_type="ndarray")
        a, b = short[pairs.reshape(-1, 2).T]
        crossed = angle_between_lines(walls.theta[a], walls.theta[b]) > settings.same_direction
        artifact[a[crossed]] = artifact[b[crossed]] = True
    return artifact


def remove_seen_through(
    segments: WallSegments, wall_of: Int[np.ndarray, " segments"], free_space: DirectionalFreeSpace
) -> WallSegments:
    """The segments without the parts that at least three scans saw through after the wall was last observed there.

    Args:
        segments: wall segments.
        wall_of: number of the wall that each belongs to.
        free_space: where walls would have been detected and were not.
    """
    if not len(segments) or not free_space.tiles:
        return segments
    # Sample every segment once per cell.
    segment, along, samples = _sampled(segments, SETTINGS.free_space.cell)
    position = segments.center[segment] + along[:, None] * segments.tangent[segment]
    # The oldest remembered time is that of the third latest scan that saw through the sample.
    seen_through = free_space.query_neighborhood(position, segments.theta[segment])[:, -1]
    gone = seen_through > segments.last_seen[segment]
    suspects = np.flatnonzero(gone)
    if not len(suspects):
        return segments
    # Another segment of the same wall may have been observed there since.
    last_seen = np.full(len(suspects), -np.inf)
    order = np.argsort(wall_of, kind="stable")
    wall = wall_of[segment[suspects]]
    begins, stops = (np.searchsorted(wall_of[order], wall, side=side) for side in ("left", "right"))
    for k, sample in enumerate(suspects):
        mates = order[begins[k] : stops[k]]
        at = ((position[sample] - segments.center[mates]) * segments.tangent[mates]).sum(-1)
        covers = (at >= segments.extent[mates, 0]) & (at <= segments.extent[mates, 1])
        last_seen[k] = segments.last_seen[mates[covers]].max(initial=-np.inf)
    gone[suspects] = seen_through[suspects] > last_seen
    # Keep the runs of samples that are left.
    first = np.append(True, (np.diff(segment) > 0) | (np.diff(gone.astype(np.int8)) != 0))
    begin = np.flatnonzero(first)
    end = np.append(begin[1:], len(segment)) - 1
    left = ~gone[begin]
    begin, end = begin[left], end[left]
    width = (segments.length / samples)[segment[begin]]
    extent = np.column_stack([along[begin] - width / 2, along[end] + width / 2])
    whole = end - begin + 1 == samples[segment[begin]]
    kept = whole | (extent[:, 1] - extent[:, 0] > SETTINGS.artifacts.min_remainder)
    return replace(segments.take(segment[begin][kept]), extent=extent[kept])


def remove_driven_through(segments: WallSegments, driven: DrivenSpace) -> WallSegments:
    """The segments without those through which the robot drove.

    Such a segment is no wall as a whole: it comes from echoes of something that moves, or spans a door. Other segments
    of the same wall stay. A segment that was last observed long after the robot drove there may be a closed door.
    """
    if not len(segments) or not len(driven.cells):
        return segments
    segment, along, _ = _sampled(segments, SETTINGS.evidence.position_cell / 2)
    start, end = segments.extent[segment].T
    inner = np.minimum(along - start, end - along) >= SETTINGS.artifacts.driven_end
    time = driven.latest(segments.center[segment] + along[:, None] * segments.tangent[segment])
    crossed = inner & (time > segments.last_seen[segment] - SETTINGS.artifacts.door_time)
    return segments.take(np.bincount(segment[crossed], minlength=len(segments)) == 0) if crossed.any() else segments


def _sampled(
    segments: WallSegments, spacing: float
) -> tuple[Int[np.ndarray, " points"], Float[np.ndarray, " points"], Int[np.ndarray, " segments"]]:
    """Points on segments: the segment, the position along it (metres), and the number of points of each segment."""
    samples = np.maximum(np.round(segments.length / spacing).astype(np.int64), 1)
    segment = np.repeat(np.arange(len(segments)), samples)
    number = np.arange(len(segment)) - np.repeat(np.cumsum(samples) - samples, samples)
    along = segments.extent[segment, 0] + (number + 0.5) * (segments.length / samples)[segment]
    return segment, along, samples


def find_openings(
    gaps: Float[np.ndarray, "gaps 2 2"],
    theta: Float[np.ndarray, " gaps"],
    segments: WallSegments,
    free_space: DirectionalFreeSpace,
) -> Bool[np.ndarray, " gaps"]:
    """Which gaps in walls are openings: something was observed through them, or a wall there would have been detected.

    Args:
        gaps: both ends of each gap, metres.
        theta: normals of the walls, radians.
        segments: observed segments, each from ``viewing_distance`` in front of it.
        free_space: where walls would have been detected and were not.
    """
    settings = SETTINGS.artifacts
    viewpoint = segments.center - segments.viewing_distance[:, None] * segments.normal
    length = np.linalg.norm(gaps[:, 1] - gaps[:, 0], axis=-1)
    fraction = (np.arange(settings.gap_samples) + 0.5) / settings.gap_samples
    position = gaps[:, :1] + fraction[:, None] * (gaps[:, 1:] - gaps[:, :1])
    times = free_space.query(position.reshape(-1, 2), np.repeat(theta, settings.gap_samples))[:, 0]
    free_fraction = np.isfinite(times.reshape(-1, settings.gap_samples)).mean(axis=1)
    free = free_fraction * length > settings.min_opening
    seen_through = np.array([_crosses(gap, viewpoint, segments.center) for gap in gaps], dtype=bool)
    return free | seen_through


def _crosses(
    gap: Float[np.ndarray, "2 2"], start: Float[np.ndarray, "sights 2"], end: Float[np.ndarray, "sights 2"]
) -> bool:
    """Whether any line of sight passes through the gap and ends clearly behind it."""
    along = gap[1] - gap[0]
    normal = perpendicular(along) / max(float(np.hypot(*along)), 1e-9)
    before, after = (start - gap[0]) @ normal, (end - gap[0]) @ normal
    passes = before * after < 0
    passes &= np.abs(after) > SETTINGS.artifacts.behind
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = start + (before / (before - after))[:, None] * (end - start)
    fraction = (crossing - gap[0]) @ along / max(float(along @ along), 1e-18)
    return bool((passes & (fraction > 0) & (fraction < 1)).any())


def _vertices(
    walls: WallSegments, long: Int[np.ndarray, " long"]
) -> tuple[Float[np.ndarray, "vertices 2"], Int[np.ndarray, "vertices 2"]]:
    """Where two long walls meet or one ends, and the two walls; for an end, the same wall twice."""
    settings = SETTINGS.artifacts
    segments = walls.endpoints[long]
    outward = settings.unseen_end * walls.tangent[long]
    ends = np.stack([segments[:, 0], segments[:, 1], segments[:, 0] - outward, segments[:, 1] + outward], axis=1)
    ends, own = ends.reshape(-1, 2), np.repeat(long, 4)
    if len(long) < 2:
        return ends, np.stack([own, own], axis=-1)
    tree = KDTree(walls.center[long])
    radius = 2 * settings.max_extension + float(walls.length[long].max())
    pairs = tree.query_pairs(radius, output_type="ndarray").reshape(-1, 2)
    a, b = segments[pairs[:, 0]], segments[pairs[:, 1]]
    u, v, offset = a[:, 1] - a[:, 0], b[:, 1] - b[:, 0], b[:, 0] - a[:, 0]
    determinant = cross(u, v)
    length_a, length_b = np.linalg.norm(u, axis=-1), np.linalg.norm(v, axis=-1)
    meets = np.abs(determinant) > np.sin(2 * settings.same_direction) * length_a * length_b
    determinant = np.where(meets, determinant, np.nan)
    fraction_a, fraction_b = cross(offset, v) / determinant, cross(offset, u) / determinant
    beyond = [np.maximum(np.maximum(-s, s - 1), 0) * n for s, n in ((fraction_a, length_a), (fraction_b, length_b))]
    meets &= np.maximum(*beyond) <= settings.max_extension
    crossings = (a[:, 0] + fraction_a[:, None] * u)[meets]
    return np.concatenate([ends, crossings]), np.concatenate([np.stack([own, own], axis=-1), long[pairs[meets]]])


def angle_between_lines(a: Float[np.ndarray, "*#any"], b: Float[np.ndarray, "*#any"]) -> Float[np.ndarray, "..."]:
    """Angle between undirected lines, radians, in [0, pi / 2]."""
    angle = np.abs(wrap_angle(a - b))
    return np.minimum(angle, np.pi - angle)
