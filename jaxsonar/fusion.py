"""From pieces of walls to walls: pieces that continue or cover one another and agree add up, until none do."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from .pieces import Pieces, add_up
from .poses import wrap_angle

OFFSET_GATE = 0.06
"""Metres; pieces of one wall lie at most this far off one another, across the wall."""
TURN_GATE = 3.0
"""Standard deviations by which their directions may differ."""
OFFSET_FLOOR = 0.012
"""Metres; how well an offset can agree at best."""
TURN_FLOOR = float(np.radians(1.5))
"""Radians; how well a direction can agree at best: walls are not quite straight, nor is odometry."""
BOTH_SIDES = 0.04
"""Metres; faces seen from opposite sides and less than this apart are one thin wall, else two."""
Opening = Callable[[Float[np.ndarray, "gaps 2 2"], Float[np.ndarray, " gaps"]], Bool[np.ndarray, " gaps"]]
"""Tells of gaps (both ends, metres, and the direction of the wall's normal) whether they are openings."""
_LEVER = 2.0  # metres that a radian counts for, when neighbors are looked for
_NEAREST = 12


def fuse(pieces: Pieces, *, gap: float, opening: Opening | None = None) -> tuple[Pieces, Int[np.ndarray, " pieces"]]:
    """Walls from pieces: in rounds, those that are each other's best match add up, until no two of them match.

    Two pieces match if they face the same way, their directions agree, they lie on one line (``OFFSET_GATE``), and not
    more than ``gap`` metres of that line lies between them. The result does not depend on the order of the pieces, and
    fusing it again changes nothing.

    Args:
        pieces: pieces of walls.
        gap: metres.
        opening: if given, tells which gaps, from end to end, are openings and stay open.

    Returns:
        The walls, and which of them each piece belongs to.
    """
    thorough = False
    wall_of = np.arange(len(pieces))
    while len(pieces) > 1:
        pairs = _neighbors(pieces, gap, nearest=None if thorough else _NEAREST)
        cost = mismatch(pieces, pairs, gap=gap)
        pairs, cost = pairs[cost <= 1], cost[cost <= 1]
        if opening is not None and len(pairs):
            shut = ~opening(*gaps(pieces, pairs))
            pairs, cost = pairs[shut], cost[shut]
        if len(pairs):
            group = _mutual(pairs, cost, len(pieces))
            pieces, wall_of = add_up(pieces, group), group[wall_of]
            thorough = False
        elif thorough or len(pieces) <= _NEAREST:
            break
        else:
            thorough = True  # none among the nearest ones: look at all of them before saying so
    return pieces, wall_of


def mismatch(pieces: Pieces, pairs: Int[np.ndarray, "pairs 2"], *, gap: float) -> Float[np.ndarray, " pairs"]:
    """How badly the pieces of each pair agree: 0 for the same piece twice, 1 at the first gate, more beyond it."""
    a, b = pairs.T
    turn = wrap_angle(pieces.theta[b] - pieces.theta[a])
    opposite = np.abs(turn) > np.pi / 2
    turn = np.where(opposite, wrap_angle(turn + np.pi), turn)
    variance = 1 / pieces.info_theta

    # The common line, as ``add_up`` would draw it, and how far the ends of both pieces are from it.
    share = pieces.info_theta[b] / (pieces.info_theta[a] + pieces.info_theta[b])
    theta = pieces.theta[a] + share * turn
    tangent = np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
    normal = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    offset = pieces.centre[b] - pieces.centre[a]
    along, across = (offset * tangent).sum(-1), (offset * normal).sum(-1)
    info_a, info_b = pieces.info_offset[a], pieces.info_offset[b]
    together = info_a * info_b / (info_a + info_b)
    angles = pieces.info_theta[a] + pieces.info_theta[b]
    bend = -together * along * across / (angles + together * along**2)
    apart = np.abs(across + bend * along)
    segments = pieces.segments
    first = ((segments[a] - pieces.centre[a][:, None]) * tangent[:, None]).sum(-1)
    second = ((segments[b] - pieces.centre[a][:, None]) * tangent[:, None]).sum(-1)
    between = np.maximum(first.min(-1) - second.max(-1), second.min(-1) - first.max(-1))
    between = np.maximum(between, 0)
    # How far either must be turned to lie on the common line, in standard deviations.
    turns = np.abs(np.stack([share * turn + bend, (share - 1) * turn + bend]))
    turns = (turns / np.sqrt(variance[[a, b]] + TURN_FLOOR**2)).max(axis=0) / TURN_GATE
    spread = np.sqrt(1 / info_a + 1 / info_b + OFFSET_FLOOR**2)
    offset_gate = np.where(opposite, BOTH_SIDES, np.minimum(OFFSET_GATE, TURN_GATE * spread))
    return np.maximum.reduce([apart / offset_gate, turns, between / gap])


def gaps(
    pieces: Pieces, pairs: Int[np.ndarray, "pairs 2"]
) -> tuple[Float[np.ndarray, "pairs 2 2"], Float[np.ndarray, " pairs"]]:
    """What lies between two pieces, from the end of one to the nearest end of the other, and its normal."""
    a, b = pairs.T
    ends = pieces.segments
    apart = np.linalg.norm(ends[a][:, :, None] - ends[b][:, None], axis=-1).reshape(-1, 4)
    nearest = apart.argmin(axis=1)
    return np.stack([ends[a, nearest // 2], ends[b, nearest % 2]], axis=1), pieces.theta[a]


def _neighbors(pieces: Pieces, gap: float, *, nearest: int | None) -> Int[np.ndarray, "pairs 2"]:
    """Pairs of pieces that may match: samples along them that are near in place and direction."""
    parts = np.maximum(np.ceil(pieces.length / gap).astype(np.int64), 1) + 1
    piece = np.repeat(np.arange(len(pieces)), parts)
    share = (np.arange(len(piece)) - np.repeat(np.cumsum(parts) - parts, parts)) / (parts[piece] - 1)
    start, end = pieces.segments[piece, 0], pieces.segments[piece, 1]
    place = start + share[:, None] * (end - start)
    double = 2 * pieces.theta[piece]  # both sides of a wall have one direction
    direction = 0.5 * _LEVER * np.stack([np.cos(double), np.sin(double)], axis=-1)
    points = np.concatenate([place, direction], axis=-1)
    steepest = TURN_GATE * np.sqrt(2 / pieces.info_theta.min() + TURN_FLOOR**2)
    reach = float(np.hypot(1.6 * gap + OFFSET_GATE, _LEVER * min(steepest, np.pi / 2)))
    tree = KDTree(points)
    if nearest is None:
        pairs = tree.query_pairs(reach, output_type="ndarray")
    else:
        _, other = tree.query(points, k=min(nearest, len(points)), distance_upper_bound=reach)
        other = np.asarray(other).reshape(len(points), -1)
        one, rank = np.nonzero(other < len(points))
        pairs = np.stack([one, other[one, rank]], axis=-1)
    pairs = np.sort(piece[pairs], axis=1)
    pairs = pairs[pairs[:, 0] < pairs[:, 1]]
    flat = np.unique(pairs[:, 0] * len(pieces) + pairs[:, 1])
    return np.stack([flat // len(pieces), flat % len(pieces)], axis=-1)


def _mutual(
    pairs: Int[np.ndarray, "pairs 2"], cost: Float[np.ndarray, " pairs"], pieces: int
) -> Int[np.ndarray, " pieces"]:
    """Group of each piece: two that are each other's best match share one."""
    best = np.full(pieces, np.inf)
    for side in (0, 1):
        np.minimum.at(best, pairs[:, side], cost)
    chosen = pairs[(cost == best[pairs[:, 0]]) & (cost == best[pairs[:, 1]])]
    graph = coo_array((np.ones(len(chosen), np.int8), (chosen[:, 0], chosen[:, 1])), shape=(pieces, pieces))
    return connected_components(graph, directed=False)[1]
