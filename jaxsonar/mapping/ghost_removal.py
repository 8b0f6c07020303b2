"""What answers like a wall and is none: corners, edges and poles, and walls that are no longer there."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jaxsonar.floor_plans.room import cross
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.mapping.free_space import CELL, SeenThrough
from jaxsonar.mapping.wall_segments import Pieces

LONG = 0.6
"""Metres; pieces from here on are walls, whatever else answers at their place."""
NEAR = 0.15
"""Metres; how far from its corner the foot of a corner's line may be."""
TURNED = float(np.radians(12.0))
"""Radians; lines that differ by more than this have different directions."""
SQUARE = float(np.radians(10.0))
"""Radians; how far from a right angle a short wall may stand on another."""
OPENING = 0.12
"""Metres of a gap in a wall that must have been seen through for an opening."""
BEHIND = 0.06
"""Metres behind a wall's line that what is seen through an opening stands."""
CRUMB = 0.15
"""Metres; what is left of a piece that was seen through must be longer."""
BEYOND = 0.15
"""Metres that a wall may end behind its last foot."""
_SAMPLES = 16
REACH = 1.5
"""Metres that a wall may go on unseen to the corner that it ends in."""


def without_corners(pieces: Pieces, walls: Pieces) -> Pieces:
    """The pieces without the lines that corners and edges of the walls leave.

    A corner answers like a wall that stands square to the line of sight, and its line passes through it: short lines
    where two walls meet, or one ends, in neither's direction.
    """
    long, short = np.flatnonzero(walls.length >= LONG), np.flatnonzero(pieces.length < LONG)
    vertex, owners = _vertices(walls, long)
    ghost = np.zeros(len(pieces), dtype=bool)
    if not len(vertex) or not len(short):
        return pieces
    near = KDTree(vertex).query_ball_point(pieces.centre[short], NEAR)
    piece = short[np.repeat(np.arange(len(short)), [len(found) for found in near])]
    place = np.array([k for found in near for k in found], dtype=np.int64)
    turn = turn_between(pieces.theta[piece][:, None], walls.theta[owners[place]])
    free_end = owners[place, 0] == owners[place, 1]
    square = free_end & (np.abs(turn[:, 0] - np.pi / 2) < SQUARE)
    turned = np.all(turn > TURNED, axis=1)
    ghost[piece[turned & ~square]] = True
    ghost[piece[~turned & ~free_end]] = False  # in the direction of a wall that meets another here
    return pieces.take(~ghost)


def points_among(walls: Pieces) -> Bool[np.ndarray, " walls"]:
    """Which walls are lines that poles leave: short ones with different directions at one place.

    A point answers to every pose, and its line is always square to the line of sight.
    """
    short = np.flatnonzero(walls.length < LONG)
    ghost = np.zeros(len(walls), dtype=bool)
    if len(short) > 1:
        pairs = KDTree(walls.centre[short]).query_pairs(NEAR, output_type="ndarray")
        a, b = short[pairs.reshape(-1, 2).T]
        crossed = turn_between(walls.theta[a], walls.theta[b]) > TURNED
        ghost[a[crossed]] = ghost[b[crossed]] = True
    return ghost


def trim(pieces: Pieces, wall_of: Int[np.ndarray, " pieces"], seen: SeenThrough) -> Pieces:
    """The pieces without what at least three scans saw through after the last one that saw their wall there.

    Args:
        pieces: pieces of walls.
        wall_of: which wall each belongs to.
        seen: where walls would have been heard and were not.
    """
    if not len(pieces) or not seen.tiles:
        return pieces
    parts = np.maximum(np.round(pieces.length / CELL).astype(np.int64), 1)
    piece = np.repeat(np.arange(len(pieces)), parts)
    number = np.arange(len(piece)) - np.repeat(np.cumsum(parts) - parts, parts)
    along = pieces.ends[piece, 0] + (number + 0.5) * (pieces.length / parts)[piece]
    place = pieces.centre[piece] + along[:, None] * pieces.tangent[piece]
    times = seen.look_around(place, pieces.theta[piece])
    gone = times[:, -1] > pieces.latest[piece]
    suspects = np.flatnonzero(gone)
    if not len(suspects):
        return pieces
    # Another piece of the same wall may have been seen there since.
    last = np.full(len(suspects), -np.inf)
    order = np.argsort(wall_of, kind="stable")
    begins, stops = (np.searchsorted(wall_of[order], wall_of[piece[suspects]], side=side) for side in ("left", "right"))
    for k, sample in enumerate(suspects):
        mates = order[begins[k] : stops[k]]
        way = ((place[sample] - pieces.centre[mates]) * pieces.tangent[mates]).sum(-1)
        covers = (way >= pieces.ends[mates, 0]) & (way <= pieces.ends[mates, 1])
        last[k] = pieces.latest[mates[covers]].max(initial=-np.inf)
    gone[suspects] = times[suspects, -1] > last
    first = np.append(True, (np.diff(piece) > 0) | (np.diff(gone.astype(np.int8)) != 0))
    begin = np.flatnonzero(first)
    end = np.append(begin[1:], len(piece)) - 1
    left = ~gone[begin]
    begin, end = begin[left], end[left]
    width = (pieces.length / parts)[piece[begin]]
    ends = np.column_stack([along[begin] - width / 2, along[end] + width / 2])
    whole = end - begin + 1 == parts[piece[begin]]
    worth = whole | (ends[:, 1] - ends[:, 0] > CRUMB)
    return replace(pieces.take(piece[begin][worth]), ends=ends[worth])


def openings(
    gaps: Float[np.ndarray, "gaps 2 2"], theta: Float[np.ndarray, " gaps"], pieces: Pieces, seen: SeenThrough
) -> Bool[np.ndarray, " gaps"]:
    """Which gaps in walls are openings: a wall was seen through them, or would have been heard there and was not.

    Args:
        gaps: both ends, metres.
        theta: normals of the walls, radians.
        pieces: what was seen, each from ``distance`` before it.
        seen: where walls would have been heard and were not.
    """
    viewpoint = pieces.centre - pieces.distance[:, None] * pieces.normal
    length = np.linalg.norm(gaps[:, 1] - gaps[:, 0], axis=-1)
    share = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    place = gaps[:, :1] + share[:, None] * (gaps[:, 1:] - gaps[:, :1])
    times = seen.look(place.reshape(-1, 2), np.repeat(theta, _SAMPLES))[:, 0].reshape(-1, _SAMPLES)
    silent = np.isfinite(times).mean(axis=1) * length > OPENING
    through = np.array([_crosses(gap, viewpoint, pieces.centre) for gap in gaps], dtype=bool)
    return silent | through


def _crosses(
    gap: Float[np.ndarray, "2 2"], start: Float[np.ndarray, "sights 2"], end: Float[np.ndarray, "sights 2"]
) -> bool:
    """Whether any line of sight goes through the gap, and not only just to it."""
    along = gap[1] - gap[0]
    normal = np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9)
    before, after = (start - gap[0]) @ normal, (end - gap[0]) @ normal
    goes = before * after < 0
    goes &= np.abs(after) > BEHIND  # what was seen stands clearly behind the wall's line
    with np.errstate(divide="ignore", invalid="ignore"):
        place = start + (before / (before - after))[:, None] * (end - start)
    share = (place - gap[0]) @ along / max(float(along @ along), 1e-18)
    return bool((goes & (share > 0) & (share < 1)).any())


def _vertices(
    walls: Pieces, long: Int[np.ndarray, " long"]
) -> tuple[Float[np.ndarray, "vertices 2"], Int[np.ndarray, "vertices 2"]]:
    """Where two walls meet or one ends, and which; a wall that ends there is named twice."""
    segments = walls.segments[long]
    outward = BEYOND * walls.tangent[long]
    ends = np.stack([segments[:, 0], segments[:, 1], segments[:, 0] - outward, segments[:, 1] + outward], axis=1)
    ends, own = ends.reshape(-1, 2), np.repeat(long, 4)
    if len(long) < 2:
        return ends, np.stack([own, own], axis=-1)
    tree = KDTree(walls.centre[long])
    reach = 2 * REACH + float(walls.length[long].max())
    pairs = tree.query_pairs(reach, output_type="ndarray").reshape(-1, 2)
    a, b = segments[pairs[:, 0]], segments[pairs[:, 1]]
    u, v, offset = a[:, 1] - a[:, 0], b[:, 1] - b[:, 0], b[:, 0] - a[:, 0]
    turn = cross(u, v)
    length_a, length_b = np.linalg.norm(u, axis=-1), np.linalg.norm(v, axis=-1)
    meets = np.abs(turn) > np.sin(2 * TURNED) * length_a * length_b
    turn = np.where(meets, turn, np.nan)
    share_a, share_b = cross(offset, v) / turn, cross(offset, u) / turn
    beyond = [np.maximum(np.maximum(-s, s - 1), 0) * n for s, n in ((share_a, length_a), (share_b, length_b))]
    meets &= np.maximum(*beyond) <= REACH
    places = (a[:, 0] + share_a[:, None] * u)[meets]
    return np.concatenate([ends, places]), np.concatenate([np.stack([own, own], axis=-1), long[pairs[meets]]])


def turn_between(a: Float[np.ndarray, "*#any"], b: Float[np.ndarray, "*#any"]) -> Float[np.ndarray, "..."]:
    """Angle between undirected lines, radians, 0 to pi / 2."""
    turn = np.abs(wrap_angle(a - b))
    return np.minimum(turn, np.pi - turn)
