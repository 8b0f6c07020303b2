"""Wall ends at corners and edges, and points that contradict walls."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.se2 import unit
from jaxsonar.geometry.segments import cross
from jaxsonar.mapping.artifact_removal import angle_between_lines
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.mapping.observations import concatenate, neighbor_pairs
from jaxsonar.mapping.point_landmarks import PointLandmarks
from jaxsonar.mapping.segment_fusion import OpeningTest
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.mapping.wall_segments import WallSegments


def snap_endpoints(walls: WallSegments, points: PointLandmarks, is_opening: OpeningTest) -> WallSegments:
    """The walls with their ends moved to the corners and edges on their lines.

    The footpoints of the echoes are a lower bound of a wall's extent. If a point lies on its line, close enough to its
    last footpoint, and the gap between them is not an opening, then the wall ends at the point. A point ends the
    nearest of several walls on one line; an end takes the nearest of several points.

    Args:
        walls: lines, and extents from the outermost footpoints.
        points: corners and edges.
        is_opening: decides which gaps are openings.
    """
    if not len(walls) or not len(points):
        return walls
    # Candidates: points near an end, on the line of the wall, and known well enough.
    ends = walls.endpoints.reshape(-1, 2)
    end, point = neighbor_pairs(points.position, ends, SETTINGS.artifacts.max_extension)
    wall, side = np.divmod(end, 2)
    alignment = SETTINGS.points.gate * SETTINGS.endpoints.alignment_floor
    along, offset = _relative_position(walls, points, wall, point, alignment)
    beyond = np.where(side == 1, along - walls.extent[wall, 1], walls.extent[wall, 0] - along)
    candidate = offset <= 1
    candidate &= beyond >= -np.minimum(SETTINGS.endpoints.max_overshoot, walls.length[wall] / 2)
    largest_sd = np.sqrt(np.linalg.eigvalsh(points.inflated_cov[point])[:, 1])
    candidate &= largest_sd <= SETTINGS.endpoints.max_point_sd
    end, point, beyond = end[candidate], point[candidate], beyond[candidate]
    # The gap between the last footpoint and the point must be closed.
    gaps = np.stack([ends[end], points.position[point]], axis=1)
    closed = beyond <= 0
    closed[~closed] = ~is_opening(gaps[~closed], walls.theta[end[~closed] // 2])
    # Assign points to ends greedily, nearest first. A point ends one wall per direction.
    assigned = np.zeros(2 * len(walls), dtype=bool)
    directions: dict[int, list[float]] = {}
    chosen = []
    for k in np.lexsort((point, end, np.abs(beyond))):
        direction = walls.theta[[end[k] // 2]]
        others = directions.setdefault(int(point[k]), [])
        angle = angle_between_lines(direction, np.array(others))
        if assigned[end[k]] or (angle < SETTINGS.artifacts.same_direction).any():
            continue
        others.append(float(direction[0]))  # also if the gap is an opening: no farther wall may then take the point
        assigned[end[k]] = True
        if closed[k]:
            chosen.append(k)
    return _constrain_to_points(walls, points, end[chosen], point[chosen])


def _constrain_to_points(
    walls: WallSegments, points: PointLandmarks, end: Int[np.ndarray, " ends"], point: Int[np.ndarray, " ends"]
) -> WallSegments:
    """The walls with the given ends at the given points; a point also corrects the line of its wall."""
    wall, side = np.divmod(end, 2)
    normal = walls.normal[wall]
    variance = np.einsum("pi,pij,pj->p", normal, points.inflated_cov[point], normal)
    variance += SETTINGS.endpoints.constraint_sd**2
    zero = np.zeros(len(end))
    constraint = replace(
        walls.take(wall),
        center=points.position[point],
        extent=np.zeros((len(end), 2)),
        info_offset=1 / variance,
        info_theta=zero,
        chi_squared=zero,
        count=np.zeros(len(end), dtype=np.int64),
        echoes=np.zeros(len(end), dtype=np.int64),
        viewing_distance=zero,
    )
    walls = concatenate([walls, constraint]).fuse(np.append(np.arange(len(walls)), wall))
    extent = walls.extent.copy()
    extent[wall, side] = ((points.position[point] - walls.center[wall]) * walls.tangent[wall]).sum(-1)
    return replace(walls, extent=extent)


def blocks_gap(gaps: Float[np.ndarray, "gaps 2 2"], points: PointLandmarks) -> Bool[np.ndarray, " gaps"]:
    """Gaps across which no wall continues, because an edge lies in the gap or at one of its ends.

    Args:
        gaps: both ends of each gap, metres.
        points: corners and edges.
    """
    settings = SETTINGS.endpoints
    edges = points.position[np.array(points.kinds, dtype=np.str_) == "edge"]
    along = gaps[:, 1] - gaps[:, 0]
    length = np.maximum(np.linalg.norm(along, axis=-1), 1e-9)
    tangent, offset = along / length[:, None], edges - gaps[:, :1]
    position = (offset * tangent[:, None]).sum(-1)
    inside = (position > -settings.face_margin) & (position < length[:, None] + settings.face_margin)
    inside &= np.abs(cross(tangent[:, None], offset)) < settings.face_depth
    return inside.any(axis=1)


def spurious_walls(walls: WallSegments, points: PointLandmarks) -> Bool[np.ndarray, " walls"]:
    """Short walls that are points: a point observed by at least as many scans lies in their middle half.

    The line of a point is perpendicular to the line of sight, with footpoints on both sides of the point.
    """
    wall, point = _points_on_faces(walls, points, margin=walls.length / 4)
    observed_as_point = points.scan_counts()[point] >= walls.scan_counts()[wall]
    spurious = np.zeros(len(walls), dtype=bool)
    spurious[wall[(walls.length[wall] < SETTINGS.artifacts.min_wall_length) & observed_as_point]] = True
    return spurious


def detached_points(walls: WallSegments, points: PointLandmarks) -> Bool[np.ndarray, " points"]:
    """Points on the face of a wall, away from its ends, where no other wall meets it; they cannot exist."""
    margin = SETTINGS.endpoints.face_margin
    wall, point = _points_on_faces(walls, points, margin=np.full(len(walls), margin))
    detached = np.zeros(len(points), dtype=bool)
    for k, p in zip(wall, point, strict=True):
        other = angle_between_lines(walls.theta, walls.theta[[k]]) > SETTINGS.artifacts.same_direction
        offset = points.position[p] - walls.center
        along = (offset * walls.tangent).sum(-1)
        meets = np.abs((offset * walls.normal).sum(-1)) <= margin
        meets &= (along >= walls.extent[:, 0] - margin) & (along <= walls.extent[:, 1] + margin)
        detached[p] |= not (meets & other).any()
    return detached


def _points_on_faces(
    walls: WallSegments, points: PointLandmarks, *, margin: Float[np.ndarray, " walls"]
) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """Pairs (wall, point) where the point lies on the wall, farther than the margin (metres) from both ends."""
    if not len(walls) or not len(points):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    radius = walls.length / 2 + SETTINGS.endpoints.face_margin
    wall, point = neighbor_pairs(points.position, walls.endpoints.mean(axis=1), radius)
    along, offset = _relative_position(walls, points, wall, point, SETTINGS.endpoints.face_depth)
    start, end = walls.extent[wall].T
    on_face = (offset <= 1) & (along > start + margin[wall]) & (along < end - margin[wall])
    return wall[on_face], point[on_face]


def _relative_position(
    walls: WallSegments,
    points: PointLandmarks,
    wall: Int[np.ndarray, " pairs"],
    point: Int[np.ndarray, " pairs"],
    offset_floor: float,
) -> tuple[Float[np.ndarray, " pairs"], Float[np.ndarray, " pairs"]]:
    """Position of each point along its wall, metres, and its distance from the line as a fraction of the gate.

    The gate is that of point observations, with ``offset_floor`` (metres) added in quadrature.
    """
    offset, normal = points.position[point] - walls.center[wall], walls.normal[wall]
    along, across = (offset * walls.tangent[wall]).sum(-1), (offset * normal).sum(-1)
    variance = np.einsum("pi,pij,pj->p", normal, points.inflated_cov[point], normal)
    variance += 1 / walls.info_offset[wall] + along**2 / walls.info_theta[wall]
    return along, np.abs(across) / np.sqrt(SETTINGS.points.gate**2 * variance + offset_floor**2)


def end_walls(world: GlobalMap) -> GlobalMap:
    """The map with every wall that ends at a corner or an edge ended there, and the kinds and covariances of its ends.

    The end is the joint estimate of the point and of the line on which it lies (Schmidt). The point moves with it.
    """
    count, points, cov = len(world), np.array(world.points), np.array(world.point_cov)
    kinds, end_cov = [["", ""] for _ in range(count)], np.full((count, 2, 2, 2), np.nan)
    segments = np.array(world.segments)
    answers = np.array([_ends_a_wall(world, k) for k in range(len(points))], dtype=bool)
    if not answers.any() or not count:
        return replace(world, end_kinds=tuple((a, b) for a, b in kinds), end_cov=end_cov)
    settings, normal = SETTINGS.endpoints, unit(world.theta)
    middle = segments.mean(axis=1)
    along = segments[:, 1] - segments[:, 0]
    length = np.linalg.norm(along, axis=-1)
    tangent = along / np.maximum(length, 1e-9)[:, None]
    # Variance of the line's offset at each point.
    offset = points - middle[:, None]
    position, across = (offset * tangent[:, None]).sum(-1), (offset * normal[:, None]).sum(-1)
    sd_rho, sd_theta = (np.nan_to_num(sd)[:, None] for sd in (world.sigma_rho, world.sigma_theta))
    at_foot = np.maximum(sd_rho**2 - ((middle * tangent).sum(-1)[:, None] * sd_theta) ** 2, 0.0)
    of_line = at_foot + (position * sd_theta) ** 2 + settings.constraint_sd**2
    of_point = np.einsum("wi,pij,wj->wp", normal, np.nan_to_num(cov), normal)
    gate = SETTINGS.points.gate * np.sqrt(of_line + of_point + settings.alignment_floor**2)
    aligned = answers & (np.abs(across) <= gate)
    for wall in range(count):
        for side, sign in ((0, -1.0), (1, 1.0)):
            beyond = sign * position[wall] - length[wall] / 2
            near = aligned[wall] & (beyond <= settings.max_unobserved)
            near &= beyond >= -min(settings.max_overshoot, length[wall] / 2)
            if not near.any():
                continue
            point = int(np.argmin(np.where(near, np.abs(beyond), np.inf)))
            prior = np.where(np.isfinite(cov[point]), cov[point], settings.max_point_sd**2 * np.eye(2))
            gain = prior @ normal[wall] / (normal[wall] @ prior @ normal[wall] + of_line[wall, point])
            moved = points[point] - gain * ((points[point] - middle[wall]) @ normal[wall])
            joint = prior - np.outer(gain, normal[wall] @ prior)
            points[point], cov[point] = moved, (joint + joint.T) / 2
            end_cov[wall, side] = cov[point]
            segments[wall, side] = middle[wall] + ((moved - middle[wall]) @ tangent[wall]) * tangent[wall]
            kinds[wall][side] = "corner" if world.point_kinds[point] == "corner" else "edge"
    ends = {"segments": segments, "end_kinds": tuple((a, b) for a, b in kinds), "end_cov": end_cov}
    return replace(world, points=points, point_cov=cov, **ends)


def _ends_a_wall(world: GlobalMap, point: int) -> bool:
    """Whether a point of a map is a corner or an edge, or probably one of both."""
    if world.point_kinds[point] == "undecided":
        _, corner, edge, _ = world.point_probabilities[point]
        return bool(corner + edge > SETTINGS.endpoints.min_end_probability)
    return world.point_kinds[point] in ("corner", "edge")
