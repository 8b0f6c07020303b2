"""Where walls end: at the corners and edges that they meet."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jaxsonar.floor_plans.room import cross
from jaxsonar.mapping.ghost_removal import LONG, REACH, TURNED, turn_between
from jaxsonar.mapping.observations import join
from jaxsonar.mapping.point_landmarks import GATE, Points
from jaxsonar.mapping.segment_fusion import Opening
from jaxsonar.mapping.wall_segments import Pieces, add_up

INSIDE = 0.2
"""Metres that the feet of a wall may lie beyond its end, where echoes of the edge itself were taken for the wall's."""
ALIKE = 0.01
"""Metres; how well a wall's line meets its corner at best."""
SHARP = 0.005
"""Metres; how well a wall's line is known from its corner at best."""
KNOWN = 0.1
"""Metres; a point that is known worse than this (standard deviation) ends no wall."""
FACE = 0.1
"""Metres from the ends of a wall, and from other walls, where its face begins."""
BEFORE = 0.03
"""Metres; nothing stands this little before a wall's face."""


def end_at(walls: Pieces, points: Points, opening: Opening) -> Pieces:
    """The walls, with ends at the points that lie on their lines: corners and edges where they stop.

    The feet of the echoes are the least that a wall extends. Where a point lies on its line, at most ``REACH`` beyond
    the last foot (``INSIDE`` before it), and the way there is no opening, the wall goes on to there. Of several walls
    on one line the nearest one gets the point, of several points an end gets the nearest.

    Args:
        walls: lines and outermost feet.
        points: corners and edges.
        opening: tells which gaps are openings.
    """
    if not len(walls) or not len(points):
        return walls
    near = KDTree(points.place).query_ball_point(walls.segments.reshape(-1, 2), REACH)
    end = np.repeat(np.arange(2 * len(walls)), [len(found) for found in near])
    point = np.array([k for found in near for k in found], dtype=np.int64)
    wall, side = np.divmod(end, 2)
    along, off = _off(walls, points, wall, point)
    beyond = np.where(side == 1, along - walls.ends[wall, 1], walls.ends[wall, 0] - along)
    on = (off <= 1) & (beyond >= -np.minimum(INSIDE, walls.length[wall] / 2))
    on &= np.sqrt(np.linalg.eigvalsh(points.honest_cov[point])[:, 1]) <= KNOWN
    end, point, along, beyond = end[on], point[on], along[on], beyond[on]
    gaps = np.stack([walls.segments.reshape(-1, 2)[end], points.place[point]], axis=1)
    shut = beyond <= 0
    shut[~shut] = ~opening(gaps[~shut], walls.theta[end[~shut] // 2])
    taken = np.zeros(2 * len(walls), dtype=bool)
    claimed: dict[int, list[float]] = {}
    chosen = []
    for k in np.lexsort((point, end, np.abs(beyond))):
        direction = walls.theta[[end[k] // 2]]
        others = claimed.setdefault(int(point[k]), [])
        if taken[end[k]] or (turn_between(direction, np.array(others)) < TURNED).any():
            continue
        others.append(float(direction[0]))  # even where the way is open: it is nearest to this wall, and ends another
        taken[end[k]] = True
        if shut[k]:
            chosen.append(k)
    end, point = end[chosen], point[chosen]
    return _tied(walls, points, end, point)


def _tied(walls: Pieces, points: Points, end: Int[np.ndarray, " ties"], point: Int[np.ndarray, " ties"]) -> Pieces:
    """The walls through their points: a corner at its end tells where a wall is, too."""
    wall, side = np.divmod(end, 2)
    normal = walls.normal[wall]
    variance = np.einsum("pi,pij,pj->p", normal, points.honest_cov[point], normal) + SHARP**2
    nothing = np.zeros(len(end))
    tie = replace(
        walls.take(wall),
        centre=points.place[point],
        ends=np.zeros((len(end), 2)),
        info_offset=1 / variance,
        info_theta=nothing,
        misfit=nothing,
        count=np.zeros(len(end), dtype=np.int64),
        echoes=np.zeros(len(end), dtype=np.int64),
        distance=nothing,
    )
    walls = add_up(join([walls, tie]), np.append(np.arange(len(walls)), wall))
    ends = walls.ends.copy()
    ends[wall, side] = ((points.place[point] - walls.centre[wall]) * walls.tangent[wall]).sum(-1)
    return replace(walls, ends=ends)


def ended(gaps: Float[np.ndarray, "gaps 2 2"], points: Points) -> Bool[np.ndarray, " gaps"]:
    """Across which gaps no wall goes on: an edge lies on the way, or where it begins or stops.

    Args:
        gaps: both ends, metres.
        points: corners and edges.
    """
    edges = points.place[np.array(points.kinds, dtype=np.str_) == "edge"]
    along = gaps[:, 1] - gaps[:, 0]
    length = np.maximum(np.linalg.norm(along, axis=-1), 1e-9)
    tangent, offset = along / length[:, None], edges - gaps[:, :1]
    way = (offset * tangent[:, None]).sum(-1)
    on = (way > -FACE) & (way < length[:, None] + FACE) & (np.abs(cross(tangent[:, None], offset)) < BEFORE)
    return on.any(axis=1)


def mirages(walls: Pieces, points: Points) -> Bool[np.ndarray, " walls"]:
    """Which short walls are points: one that no fewer scans saw stands in their middle.

    A point's line is square to the line of sight, and its feet lie on both sides of it.
    """
    wall, point = _on_faces(walls, points, margin=walls.length / 4)
    times = np.bincount(walls.scans[0], minlength=len(walls))
    ghost = np.zeros(len(walls), dtype=bool)
    ghost[wall[(walls.length[wall] < LONG) & (points.times[point] >= times[wall])]] = True
    return ghost


def floating(walls: Pieces, points: Points) -> Bool[np.ndarray, " points"]:
    """Which points lie on the face of a wall, away from its ends, where no other wall meets it."""
    wall, point = _on_faces(walls, points, margin=np.full(len(walls), FACE))
    lies = np.zeros(len(points), dtype=bool)
    for k, p in zip(wall, point, strict=True):
        other = turn_between(walls.theta, walls.theta[[k]]) > TURNED
        offset = points.place[p] - walls.centre
        along = (offset * walls.tangent).sum(-1)
        meets = np.abs((offset * walls.normal).sum(-1)) <= FACE
        meets &= (along >= walls.ends[:, 0] - FACE) & (along <= walls.ends[:, 1] + FACE)
        lies[p] |= not (meets & other).any()
    return lies


def _on_faces(
    walls: Pieces, points: Points, *, margin: Float[np.ndarray, " walls"]
) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """Pairs of wall and point: the point is on the wall, farther than the margin (metres) from both of its ends."""
    if not len(walls) or not len(points):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    near = KDTree(points.place).query_ball_point(walls.segments.mean(axis=1), walls.length / 2 + FACE)
    wall = np.repeat(np.arange(len(walls)), [len(found) for found in near])
    point = np.array([k for found in near for k in found], dtype=np.int64)
    along, off = _off(walls, points, wall, point, least=BEFORE)
    on = (off <= 1) & (along > walls.ends[wall, 0] + margin[wall]) & (along < walls.ends[wall, 1] - margin[wall])
    return wall[on], point[on]


def _off(
    walls: Pieces,
    points: Points,
    wall: Int[np.ndarray, " pairs"],
    point: Int[np.ndarray, " pairs"],
    least: float = GATE * ALIKE,
) -> tuple[Float[np.ndarray, " pairs"], Float[np.ndarray, " pairs"]]:
    """Where along its wall each point is, metres, and how far off its line, 1 at the gate."""
    offset, normal = points.place[point] - walls.centre[wall], walls.normal[wall]
    along, across = (offset * walls.tangent[wall]).sum(-1), (offset * normal).sum(-1)
    variance = np.einsum("pi,pij,pj->p", normal, points.honest_cov[point], normal)
    variance += 1 / walls.info_offset[wall] + along**2 / walls.info_theta[wall]
    return along, np.abs(across) / np.sqrt(GATE**2 * variance + least**2)
