"""From pieces of walls to walls: pieces that continue or cover one another and agree add up, until none do."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.mapping.observations import unique_pairs
from jaxsonar.mapping.wall_segments import Pieces, add_up

OFFSET_GATE = 0.06
"""Metres; pieces of one wall lie at most this far off one another, across the wall."""
TURN_GATE = 3.0
"""Standard deviations by which their directions may differ."""
OFFSET_FLOOR = 0.005
"""Metres; how well an offset can agree at best: walls are not quite straight, nor is odometry."""
MOST_FLOOR = 0.02
"""Metres; however far poses are off."""
TURN_PER_OFFSET = 2.2
"""Radians per metre; how well a direction can agree at best, for how well an offset can."""
BOTH_SIDES = 0.04
"""Metres; faces seen from opposite sides and less than this apart are one thin wall, else two."""
BESIDE = 0.025
"""Metres; nothing stands this little before a wall: what is this near to its line is it, however well it is known."""
Opening = Callable[[Float[np.ndarray, "gaps 2 2"], Float[np.ndarray, " gaps"]], Bool[np.ndarray, " gaps"]]
"""Tells of gaps (both ends, metres, and the direction of the wall's normal) whether they are openings."""
OUTLYING = 3.0
"""Standard deviations from which on a piece is off its wall by more than noise."""
_ROUNDS = 5
_LEVER = 2.0  # metres that a radian counts for, when neighbors are looked for
_NEAREST = 12


def fuse(
    pieces: Pieces, *, gap: float, floor: float = OFFSET_FLOOR, opening: Opening | None = None, beside: float = 0.0
) -> tuple[Pieces, Int[np.ndarray, " pieces"]]:
    """Walls from pieces: in rounds, those that are each other's best match add up, until no two of them match.

    Two pieces match if they face the same way, their directions agree, they lie on one line (``OFFSET_GATE``), and not
    more than ``gap`` metres of that line lies between them. The result does not depend on the order of the pieces, and
    fusing it again changes nothing.

    Args:
        pieces: pieces of walls.
        gap: metres.
        floor: how well offsets can agree at best, metres (``common_floor``).
        opening: if given, tells which gaps, from end to end, are openings and stay open.
        beside: a piece whose ends are this near to the line of a longer one matches it as well, metres.

    Returns:
        The walls, and which of them each piece belongs to.
    """
    wall_of = np.arange(len(pieces))
    seen, pieces = pieces.scans, replace(pieces, scans=(wall_of[:0], wall_of[:0]))  # added up once, at the end
    pairs, cost = np.zeros((0, 2), dtype=np.int64), np.zeros(0)
    changed, thorough = np.ones(len(pieces), dtype=bool), False
    while len(pieces) > 1:
        # Only pieces that changed can match anew; first with the nearest, at last with all of them.
        new = _neighbors(pieces, changed, gap, floor, nearest=None if thorough else _NEAREST)
        badness, between = _compared(pieces, new, gap, floor)
        if beside:
            badness = np.minimum(badness, np.maximum(_width(pieces, new) / beside, between / gap))
        new, badness, between = new[badness <= 1], badness[badness <= 1], between[badness <= 1]
        if opening is not None and (between > 0).any():
            apart = np.flatnonzero(between > 0)
            shut = np.delete(np.arange(len(new)), apart[opening(*gaps(pieces, new[apart]))])
            new, badness = new[shut], badness[shut]
        pairs, once = np.unique(np.concatenate([pairs, new]), axis=0, return_index=True)
        cost = np.concatenate([cost, badness])[once]
        if len(pairs):
            group = mutual(pairs, cost, len(pieces))
            pieces, wall_of = add_up(pieces, group), group[wall_of]
            changed = np.bincount(group) > 1
            pairs = group[pairs]
            kept = ~changed[pairs].any(axis=1)
            pairs, cost = np.sort(pairs[kept], axis=1), cost[kept]
        elif thorough:
            break
        else:
            changed, thorough = np.ones(len(pieces), dtype=bool), True
    return replace(pieces, scans=unique_pairs(wall_of[seen[0]], seen[1])), wall_of


def common_floor(pieces: Pieces, *, gap: float) -> float:
    """How well offsets can agree at best, metres: more than ``OFFSET_FLOOR`` where poses are off by more.

    The pieces of a wall then differ by more than their covariances tell, in most walls, and even the nearest of them.

    Args:
        pieces: pieces of walls.
        gap: metres, as for ``fuse``.
    """
    floor = OFFSET_FLOOR
    while True:
        walls, _ = fuse(pieces, gap=gap, floor=floor)
        walls = walls.take(walls.count > 1)
        if not len(walls):
            return floor
        excess = np.maximum(walls.misfit - 2 * (walls.count - 1), 0) / walls.info_offset
        order = np.argsort(excess, kind="stable")
        half = np.searchsorted(np.cumsum(walls.count[order]), walls.count.sum() / 2)
        wanted = min(2 * float(np.sqrt(excess[order[half]])), MOST_FLOOR)
        if wanted < 1.1 * floor:
            return floor
        floor = wanted


def settle(
    pieces: Pieces, wall_of: Int[np.ndarray, " pieces"], walls: Pieces, *, floor: float = OFFSET_FLOOR
) -> Pieces:
    """The walls again, each piece counting for as much as it agrees with its wall.

    A line with echoes of another reflector in it is farther off than its covariance tells. Where a piece deviates by
    more than ``OUTLYING`` standard deviations of one of its lines, its information is divided by the square of the
    excess.

    Args:
        pieces: pieces of walls.
        wall_of: which wall each belongs to.
        walls: their sums, to begin with.
        floor: as for ``fuse``; what it exceeds ``OFFSET_FLOOR`` by is no piece's own fault.
    """
    slack = floor - OFFSET_FLOOR
    offset = pieces.count / pieces.info_offset + slack**2
    angle = pieces.count / pieces.info_theta + (TURN_PER_OFFSET * slack) ** 2
    for _ in range(_ROUNDS):
        off, turn = deviations(pieces, walls, wall_of)
        share = np.minimum(1, OUTLYING**2 / np.maximum(off**2 / offset + turn**2 / angle, 1e-9))
        weighed = replace(pieces, info_offset=share * pieces.info_offset, info_theta=share * pieces.info_theta)
        walls = add_up(weighed, wall_of)
    return walls


def mismatch(pieces: Pieces, pairs: Int[np.ndarray, "pairs 2"], *, gap: float) -> Float[np.ndarray, " pairs"]:
    """How badly the pieces of each pair agree: 0 for the same piece twice, 1 at the first gate, more beyond it."""
    return _compared(pieces, pairs, gap, OFFSET_FLOOR)[0]


def _compared(
    pieces: Pieces, pairs: Int[np.ndarray, "pairs 2"], gap: float, floor: float
) -> tuple[Float[np.ndarray, " pairs"], Float[np.ndarray, " pairs"]]:
    """The mismatch of each pair, and how much of their line lies between them, metres."""
    a, b = pairs.T
    turn = wrap_angle(pieces.theta[b] - pieces.theta[a])
    opposite = np.abs(turn) > np.pi / 2
    turn = np.where(opposite, wrap_angle(turn + np.pi), turn)
    variance = 1 / pieces.info_theta
    # What does not average out: what a single line errs by (its echoes are not all its own), and the floor.
    single = pieces.count / pieces.info_offset
    least = floor**2 + np.maximum(single[a], single[b])
    turn_floor = TURN_PER_OFFSET**2 * least

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
    turns = (turns / np.sqrt(variance[[a, b]] + turn_floor)).max(axis=0)
    turns = np.maximum(turns, np.abs(turn) / np.sqrt(variance[a] + variance[b] + 2 * turn_floor)) / TURN_GATE
    spread = np.sqrt(1 / info_a + 1 / info_b + least)
    offset_gate = np.where(opposite, BOTH_SIDES, np.minimum(OFFSET_GATE, TURN_GATE * spread))
    return np.maximum.reduce([apart / offset_gate, turns, between / gap]), between


def deviations(
    pieces: Pieces, walls: Pieces, wall_of: Int[np.ndarray, " pieces"]
) -> tuple[Float[np.ndarray, " pieces"], Float[np.ndarray, " pieces"]]:
    """How far each piece's centre is off its wall, metres, and how far it is turned, radians, in [-pi/2, pi/2]."""
    off = ((pieces.centre - walls.centre[wall_of]) * walls.normal[wall_of]).sum(-1)
    return off, (pieces.theta - walls.theta[wall_of] + np.pi / 2) % np.pi - np.pi / 2


def _width(pieces: Pieces, pairs: Int[np.ndarray, "pairs 2"]) -> Float[np.ndarray, " pairs"]:
    """How far the ends of the shorter piece of each pair are off the line of the longer one at most, metres."""
    a, b = pairs.T
    a, b = np.where(pieces.length[a] < pieces.length[b], [b, a], [a, b])
    offset = pieces.segments[b] - pieces.centre[a][:, None]
    return np.abs((offset * pieces.normal[a][:, None]).sum(-1)).max(axis=-1)


def gaps(
    pieces: Pieces, pairs: Int[np.ndarray, "pairs 2"]
) -> tuple[Float[np.ndarray, "pairs 2 2"], Float[np.ndarray, " pairs"]]:
    """What lies between two pieces, from the end of one to the nearest end of the other, and its normal."""
    a, b = pairs.T
    ends = pieces.segments
    apart = np.linalg.norm(ends[a][:, :, None] - ends[b][:, None], axis=-1).reshape(-1, 4)
    nearest = apart.argmin(axis=1)
    return np.stack([ends[a, nearest // 2], ends[b, nearest % 2]], axis=1), pieces.theta[a]


def _neighbors(
    pieces: Pieces, changed: Bool[np.ndarray, " pieces"], gap: float, floor: float, *, nearest: int | None
) -> Int[np.ndarray, "pairs 2"]:
    """Pairs that may match, one of them changed: pieces with samples near each other in place and direction."""
    parts = np.maximum(np.ceil(pieces.length / gap).astype(np.int64), 1) + 1
    piece = np.repeat(np.arange(len(pieces)), parts)
    share = (np.arange(len(piece)) - np.repeat(np.cumsum(parts) - parts, parts)) / (parts[piece] - 1)
    start, end = pieces.segments[piece, 0], pieces.segments[piece, 1]
    place = start + share[:, None] * (end - start)
    double = 2 * pieces.theta[piece]  # both sides of a wall have one direction
    direction = 0.5 * _LEVER * np.stack([np.cos(double), np.sin(double)], axis=-1)
    points = np.concatenate([place, direction], axis=-1)
    turn_floor = TURN_PER_OFFSET**2 * (floor**2 + (pieces.count / pieces.info_offset).max())
    steepest = TURN_GATE * np.sqrt(2 / pieces.info_theta.min() + 2 * turn_floor)
    reach = float(np.hypot(1.6 * gap + OFFSET_GATE, _LEVER * min(steepest, np.pi / 2)))
    tree, asking = KDTree(points), np.flatnonzero(changed[piece])
    if nearest is None and len(asking) == len(points):
        one, other = tree.query_pairs(reach, output_type="ndarray").reshape(-1, 2).T
    elif nearest is None:
        found = tree.query_ball_point(points[asking], reach)
        one = np.repeat(asking, [len(near) for near in found])
        other = np.array([k for near in found for k in near], dtype=np.int64)
    else:
        near = np.asarray(tree.query(points[asking], k=min(nearest, len(points)), distance_upper_bound=reach)[1])
        row, rank = np.nonzero(near < len(points))
        one, other = asking[row], near[row, rank]
    one, other = np.sort([piece[one], piece[other]], axis=0)
    flat = np.unique((one * len(pieces) + other)[one < other])
    return np.stack([flat // len(pieces), flat % len(pieces)], axis=-1)


def mutual(
    pairs: Int[np.ndarray, "pairs 2"], cost: Float[np.ndarray, " pairs"], pieces: int
) -> Int[np.ndarray, " pieces"]:
    """Group of each piece: two that are each other's best match share one."""
    best = np.full(pieces, np.inf)
    for side in (0, 1):
        np.minimum.at(best, pairs[:, side], cost)
    chosen = pairs[(cost == best[pairs[:, 0]]) & (cost == best[pairs[:, 1]])]
    graph = coo_array((np.ones(len(chosen), np.int8), (chosen[:, 0], chosen[:, 1])), shape=(pieces, pieces))
    return connected_components(graph, directed=False)[1]
