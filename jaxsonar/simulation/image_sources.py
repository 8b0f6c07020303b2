"""Where the echoes of a room come from: exact path lengths with provenance, without any sensor model.

Specular reflections by image sources, diffraction at edges and scattering at poles by their two legs, occlusion by
walls as thin screens. NumPy, float64, vectorised over sensor groups (scans), pairs (paths) and reflectors.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.floor_plans.room import Junctions, Room, cross, crossings, point_to_walls

_TOL = 1e-9  # m; what may be missed by rounding when a point lies on a wall or at its end


class Kind(IntEnum):
    """What an echo came from."""

    PLANE = 0
    """One reflection at a wall."""
    CORNER = 1
    """Double reflection in a right-angled corner."""
    EDGE = 2
    """Diffraction at a free end or an outer corner of walls."""
    POLE = 3
    """Scattering at a pole."""
    SECOND_ORDER = 4
    """Reflections at two walls, one after the other, that do not form a right-angled corner."""
    CLUTTER = 5
    """A false echo; nothing is there."""


@dataclass(frozen=True, eq=False)
class Reflections:
    """Sound paths found, one entry each, in no particular order."""

    group: Int[np.ndarray, " found"]
    """Row of sensors (a scan) the path belongs to."""
    pair: Int[np.ndarray, " found"]
    """Which of the pairs (tx, rx)."""
    kind: Int[np.ndarray, " found"]
    """A value of ``Kind``."""
    reflector: Int[np.ndarray, " found"]
    """Wall (plane; first wall of a second-order path), vertex of ``Room.junctions`` (corner, edge) or pole."""
    second: Int[np.ndarray, " found"]
    """Second wall of a second-order path, else -1."""
    length: Float[np.ndarray, " found"]
    """Length of the whole path from tx to rx, metres."""
    first: Float[np.ndarray, "found 2"]
    """Point of the room that the sound meets first, world frame, metres: departure from tx is towards it."""
    last: Float[np.ndarray, "found 2"]
    """Point of the room that the sound meets last: arrival at rx is from it."""

    def __len__(self) -> int:
        return len(self.length)

    def __getitem__(self, index: Int[np.ndarray, " some"] | Bool[np.ndarray, " found"]) -> "Reflections":
        return Reflections(*(getattr(self, field.name)[index] for field in fields(self)))

    @classmethod
    def joined(cls, parts: list["Reflections"]) -> "Reflections":
        """All of several in one."""
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))


def reflections(
    room: Room,
    tx: Float[np.ndarray, "pairs 2"],
    rx: Float[np.ndarray, "pairs 2"],
    *,
    max_range: float = np.inf,
) -> Reflections:
    """Every echo from each tx to its rx, for sensors that send and hear in all directions.

    Args:
        room: what reflects.
        tx: (pairs, 2) senders, world frame, metres.
        rx: (pairs, 2) receivers.
        max_range: largest half path length, metres.

    Returns:
        What was found, ``pair`` counting the rows of tx and rx.
    """
    found = trace(room, np.stack([tx, rx], axis=1), np.array([[0, 1]]), max_range=max_range)
    return replace(found, group=np.zeros_like(found.group), pair=found.group)


def trace(
    room: Room,
    sensors: Float[np.ndarray, "groups sensors 2"],
    pairs: Int[np.ndarray, "pairs 2"],
    *,
    max_range: float = np.inf,
    axis: Float[np.ndarray, "groups sensors 2"] | None = None,
    half_beam: Float[np.ndarray, " sensors"] | None = None,
) -> Reflections:
    """Every echo between pairs of sensors, for many places of the same array of sensors at once.

    - Plane: image source; the reflection lies in the wall, both sensors on one side of it.
    - Second order: image of the image, for every ordered pair of walls; two orders with one length are one echo.
    - Corner: walls that meet at 90 deg (within 1 deg, then taken as exactly 90) return the sound through the point
      reflection at their vertex, length 2|m - c|. Both sensors lie inside the wedge. tx = rx is no special case.
    - Edge and pole: |s_i - c| + |s_j - c|; at an edge both sensors lie inside its wedge of more than 180 deg.

    All legs are free of walls; poles do not occlude. With ``axis`` and ``half_beam`` the sound must leave tx and reach
    rx within their cones (exact directions, no far field).

    Args:
        room: what reflects.
        sensors: (groups, sensors, 2) positions in the world frame, metres; a group is a scan.
        pairs: (pairs, 2) sensor indices tx, rx, the same for every group.
        max_range: largest half path length, metres.
        axis: (groups, sensors, 2) unit vectors the sensors look along, world frame; with half_beam.
        half_beam: (sensors,) half the width of each cone, radians.
    """
    scene = _Scene.of(room, sensors, pairs, max_range, axis, half_beam)
    junctions = room.junctions
    found = Reflections.joined(
        [
            _planes(scene),
            _corners(scene, junctions),
            _edges(scene, junctions),
            _scattered(scene, Kind.POLE, room.poles),
            _second_order(scene, junctions.right_angled),
        ]
    )
    return replace(found, first=found.first + scene.origin, last=found.last + scene.origin)


class _Walls(NamedTuple):
    """Walls as frames: along the tangent from the start, across to the left."""

    start: np.ndarray  # (walls, 2)
    tangent: np.ndarray  # (walls, 2)
    length: np.ndarray  # (walls,)

    @classmethod
    def of(cls, walls: np.ndarray) -> "_Walls":
        along = walls[:, 1] - walls[:, 0]
        length = np.linalg.norm(along, axis=-1)
        return cls(walls[:, 0], along / length[:, None], length)

    def frame(self, wall: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates (along, across) of points (rows, n, 2) in the frame of one wall a row."""
        x = points[..., 0] - self.start[wall, 0, None]
        y = points[..., 1] - self.start[wall, 1, None]
        cos, sin = self.tangent[wall, 0, None], self.tangent[wall, 1, None]
        return cos * x + sin * y, cos * y - sin * x

    def normal(self, wall: np.ndarray) -> np.ndarray:
        """Unit vectors to the left of each wall."""
        return np.stack([-self.tangent[wall, 1], self.tangent[wall, 0]], axis=-1)

    def at(self, wall: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Points this far along each wall."""
        return self.start[wall] + along[:, None] * self.tangent[wall]

    def blocks(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Which legs from p (legs, 2) to q pass through a wall; a leg that ends on a wall does not.

        The test is on distances from the wall's line, so that an end on a wall needs no list of exceptions.
        """
        blocked = np.zeros(len(p), dtype=bool)
        normal = self.normal(np.arange(len(self.start)))
        level = (normal * self.start).sum(-1)
        for some in _slices(len(p), len(self.start)):
            side_p, side_q = p[some] @ normal.T - level, q[some] @ normal.T - level
            leg, wall = np.nonzero((side_p * side_q < 0) & (np.minimum(np.abs(side_p), np.abs(side_q)) > _TOL))
            share = side_p[leg, wall] / (side_p[leg, wall] - side_q[leg, wall])
            through = p[some][leg] + share[:, None] * (q[some][leg] - p[some][leg])
            position = ((through - self.start[wall]) * self.tangent[wall]).sum(-1)
            met = (position >= -_TOL) & (position <= self.length[wall] + _TOL)
            blocked[some][leg[met]] = True
        return blocked


@dataclass(frozen=True, eq=False)
class _Scene:
    """What all finders share, in a frame near the room: large world coordinates would cost precision."""

    origin: np.ndarray  # (2,)
    walls: _Walls  # those within reach of any group
    index: np.ndarray  # (walls,) their numbers in the room
    apart: np.ndarray  # (walls, walls) distance of two walls
    distance: np.ndarray  # (groups, walls) from the hub of a group to a wall
    sensors: np.ndarray  # (groups, sensors, 2)
    hub: np.ndarray  # (groups, 2) middle of the sensors
    radius: np.ndarray  # (groups,) within which they sit
    pairs: np.ndarray  # (pairs, 2)
    baseline2: np.ndarray  # (groups, pairs) squared distance of tx and rx
    max_range: float
    axis: np.ndarray | None  # (groups, sensors, 2)
    cos_half: np.ndarray  # (sensors,)

    @classmethod
    def of(cls, room, sensors, pairs, max_range, axis, half_beam) -> "_Scene":
        things = np.concatenate([room.walls.reshape(-1, 2), room.poles])
        origin = things.mean(0) if len(things) else np.zeros(2)
        sensors = sensors - origin
        hub = sensors.mean(1)
        radius = np.linalg.norm(sensors - hub[:, None], axis=-1).max(1)
        walls = room.walls - origin
        distance = point_to_walls(hub, walls)
        # Every point of a path lies within half its length of the middle of its sensors.
        index = np.flatnonzero((distance <= max_range + radius[:, None]).any(0))
        walls = walls[index]
        ends = point_to_walls(walls.reshape(-1, 2), walls).reshape(len(walls), 2, len(walls)).min(1)
        share_a, share_b = crossings(walls, walls)
        crossed = (share_a >= 0) & (share_a <= 1) & (share_b >= 0) & (share_b <= 1)
        return cls(
            origin=origin,
            walls=_Walls.of(walls),
            index=index,
            apart=np.where(crossed, 0.0, np.minimum(ends, ends.T)),
            distance=distance[:, index],
            sensors=sensors,
            hub=hub,
            radius=radius,
            pairs=pairs,
            baseline2=((sensors[:, pairs[:, 0]] - sensors[:, pairs[:, 1]]) ** 2).sum(-1),
            max_range=max_range,
            axis=axis,
            cos_half=np.zeros(sensors.shape[1]) if half_beam is None else np.cos(half_beam),
        )

    def confirmed(self, found: Reflections) -> Reflections:
        """Those that leave and arrive within the cones and whose legs no wall blocks; cheapest test first."""
        for side, point in ((0, "first"), (1, "last")):
            if self.axis is not None:
                sensor = self.pairs[found.pair, side]
                leg = getattr(found, point) - self.sensors[found.group, sensor]
                found = found[_within(leg, self.axis[found.group, sensor], self.cos_half[sensor])]
        for side, point in ((0, "first"), (1, "last")):
            start = self.sensors[found.group, self.pairs[found.pair, side]]
            found = found[~self.walls.blocks(start, getattr(found, point))]
        return found[~self.walls.blocks(found.first, found.last)]


def _planes(scene: _Scene) -> Reflections:
    group, wall = np.nonzero(scene.distance <= scene.max_range + scene.radius[:, None])
    i, j = scene.pairs.T
    parts = []
    for some in _slices(len(group), len(i)):
        g, w = group[some], wall[some]
        along, across = scene.walls.frame(w, scene.sensors[g])
        row, pair, spot, length = _mirrored(
            scene, w, scene.baseline2[g], along[:, i], across[:, i], along[:, j], across[:, j]
        )
        hit = scene.walls.at(w[row], spot)
        parts.append(scene.confirmed(_found(Kind.PLANE, g[row], pair, scene.index[w[row]], length, hit, hit)))
    return Reflections.joined([_none(), *parts])


def _second_order(scene: _Scene, right_angled: np.ndarray) -> Reflections:
    allowed = ~right_angled[np.ix_(scene.index, scene.index)] & ~np.eye(len(scene.index), dtype=bool)
    i, j = scene.pairs.T
    parts = []
    for groups in _slices(len(scene.hub), allowed.size):
        group, wall_a, wall_b = _wall_pairs(scene, groups, allowed)
        for some in _slices(len(group), len(i)):
            g, a, b = group[some], wall_a[some], wall_b[some]
            sensors = scene.sensors[g]
            along_a, across_a = scene.walls.frame(a, sensors)
            along_b, across_b = scene.walls.frame(b, sensors)
            images = sensors - 2 * across_b[..., None] * scene.walls.normal(b)[:, None]
            along_image, across_image = scene.walls.frame(a, images)
            # tx -> A -> B -> rx is tx -> A -> the image of rx in b: a reflection at one plane, a.
            baseline2 = scene.baseline2[g] + 4 * across_b[:, i] * across_b[:, j]
            row, pair, spot, length = _mirrored(
                scene, a, baseline2, along_a[:, i], across_a[:, i], along_image[:, j], across_image[:, j]
            )
            first = scene.walls.at(a[row], spot)
            along_first, across_first = (x[:, 0] for x in scene.walls.frame(b[row], first[:, None]))
            along_rx, across_rx = along_b[row, j[pair]], across_b[row, j[pair]]
            with np.errstate(divide="ignore", invalid="ignore"):
                spot = (along_first * across_rx + along_rx * across_first) / (across_first + across_rx)
            # A strictly on the side of b that rx is on; this also excludes the vertex that a and b may share.
            valid = (across_first * across_rx > 0) & (np.minimum(np.abs(across_first), np.abs(across_rx)) > _TOL)
            valid &= (spot >= -_TOL) & (spot <= scene.walls.length[b[row]] + _TOL)
            row, pair, spot, length, first = row[valid], pair[valid], spot[valid], length[valid], first[valid]
            last = scene.walls.at(b[row], spot)
            found = _found(Kind.SECOND_ORDER, g[row], pair, scene.index[a[row]], length, first, last)
            parts.append(scene.confirmed(replace(found, second=scene.index[b[row]])))
    return _one_of_both_orders(Reflections.joined([_none(), *parts]))


def _wall_pairs(scene: _Scene, groups: slice, allowed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(group, first wall, second wall) that may reflect in this order: bounds from the hub that no sensor escapes."""
    radius, distance = scene.radius[groups, None, None], scene.distance[groups]
    hub, count = scene.hub[groups], len(scene.index)
    normal = scene.walls.normal(np.arange(count))
    across = hub @ normal.T - (scene.walls.start * normal).sum(-1)
    first, second = across[:, :, None], across[:, None, :]
    image = first - 2 * second * (normal @ normal.T)  # of the hub's image in the second wall, across the first
    reachable = distance[:, :, None] + scene.apart + distance[:, None, :] <= 2 * (scene.max_range + radius)
    reachable &= second**2 + first * image <= (scene.max_range + radius) ** 2
    same_side = (first * image > 0) | (np.minimum(np.abs(first), np.abs(image)) <= radius)
    group, a, b = np.nonzero(reachable & same_side & allowed)
    return group + groups.start, a, b


def _one_of_both_orders(found: Reflections) -> Reflections:
    """Without the second of two paths of one pair over the same two walls, in both orders, of one length."""
    low, high = np.minimum(found.reflector, found.second), np.maximum(found.reflector, found.second)
    order = np.lexsort((found.reflector, high, low, found.pair, found.group))
    same = np.ones(max(len(order) - 1, 0), dtype=bool)
    for key in (found.group, found.pair, low, high):
        same &= np.diff(key[order]) == 0
    same &= np.abs(np.diff(found.length[order])) <= _TOL
    return found[order[np.append(True, ~same)[: len(order)]]]


def _mirrored(scene, wall, baseline2, along_tx, across_tx, along_rx, across_rx):
    """Reflections at a wall between two points in its frame, arrays (rows, pairs): row, pair, position, length."""
    product = across_tx * across_rx
    length2 = baseline2 + 4 * product
    with np.errstate(divide="ignore", invalid="ignore"):
        spot = (along_tx * across_rx + along_rx * across_tx) / (across_tx + across_rx)
    valid = (product > 0) & (length2 <= (2 * scene.max_range) ** 2)
    valid &= (spot >= -_TOL) & (spot <= scene.walls.length[wall, None] + _TOL)
    row, pair = np.nonzero(valid)
    return row, pair, spot[row, pair], np.sqrt(length2[row, pair])


def _corners(scene: _Scene, junctions: Junctions) -> Reflections:
    wedge = junctions.corners
    vertex = junctions.wedge_vertex[wedge]
    point = junctions.vertices[vertex] - scene.origin
    ends = junctions.wedge_start[wedge] + np.array([[0.0], [1.0]]) * junctions.wedge_width[wedge]
    e1, e2 = np.stack([np.cos(ends), np.sin(ends)], axis=-1)  # along the two walls, away from the vertex
    turn = cross(e1, e2)[:, None]
    reach1, reach2 = junctions.wedge_reach[wedge].T
    g, k = _near(scene, point)
    i, j = scene.pairs.T
    offset = scene.sensors[g] - point[k, None]
    x, y = cross(offset, e2[k, None]) / turn[k], cross(e1[k, None], offset) / turn[k]  # (rows, sensors), oblique
    inside = (x > _TOL) & (y > _TOL)
    middle_x, middle_y = (x[:, i] + x[:, j]) / 2, (y[:, i] + y[:, j]) / 2
    middle = (offset[:, i] + offset[:, j]) / 2
    distance = np.linalg.norm(middle, axis=-1)
    row, pair = np.nonzero(inside[:, i] & inside[:, j] & (distance <= scene.max_range))
    mx, my = middle_x[row, pair], middle_y[row, pair]
    # Both outer legs run along m -> c; the ray from tx crosses wall 1 (y = 0) at share y / m_y, wall 2 at x / m_x.
    # The wall it meets first turns it to the other, and both reflections are this far from the vertex:
    lead = x[row, i[pair]] / mx - y[row, i[pair]] / my
    on1, on2 = np.abs(lead) * mx, np.abs(lead) * my
    valid = (on1 <= reach1[k[row]] + _TOL) & (on2 <= reach2[k[row]] + _TOL)
    row, pair, lead, on1, on2 = row[valid], pair[valid], lead[valid], on1[valid], on2[valid]
    c = k[row]
    hit1, hit2 = point[c] + on1[:, None] * e1[c], point[c] + on2[:, None] * e2[c]
    first, last = np.where((lead >= 0)[:, None], (hit1, hit2), (hit2, hit1))
    length = 2 * distance[row, pair]
    return scene.confirmed(_found(Kind.CORNER, g[row], pair, vertex[c], length, first, last))


def _edges(scene: _Scene, junctions: Junctions) -> Reflections:
    edges = junctions.edges
    vertex = junctions.wedge_vertex[edges]
    start, width = junctions.wedge_start[edges], junctions.wedge_width[edges]

    def inside(edge: np.ndarray, leg: np.ndarray) -> np.ndarray:
        """Whether the legs (rows, sensors, 2) come from within the wedge, not along its walls."""
        angle = (np.arctan2(-leg[..., 1], -leg[..., 0]) - start[edge, None]) % (2 * np.pi)
        return (angle > _TOL) & (angle < width[edge, None] - _TOL)

    found = _scattered(scene, Kind.EDGE, junctions.vertices[vertex], inside)
    return replace(found, reflector=vertex[found.reflector])


def _scattered(
    scene: _Scene,
    kind: Kind,
    points: np.ndarray,
    seen: Callable[[np.ndarray, np.ndarray], np.ndarray] = lambda point, leg: np.ones(leg.shape[:2], dtype=bool),
) -> Reflections:
    """Echoes of points that send sound on in all directions; what a sensor sees is decided sensor by sensor."""
    points = points - scene.origin
    g, point = _near(scene, points)
    i, j = scene.pairs.T
    leg = points[point, None] - scene.sensors[g]
    distance = np.linalg.norm(leg, axis=-1)
    visible = (distance > _TOL) & seen(point, leg)
    if scene.axis is not None:
        visible &= _within(leg, scene.axis[g], scene.cos_half)
    row, sensor = np.nonzero(visible)
    visible[row, sensor] = ~scene.walls.blocks(scene.sensors[g[row], sensor], points[point[row]])
    length = distance[:, i] + distance[:, j]
    row, pair = np.nonzero(visible[:, i] & visible[:, j] & (length <= 2 * scene.max_range))
    at = points[point[row]]
    return _found(kind, g[row], pair, point[row], length[row, pair], at, at)


def _near(scene: _Scene, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(group, point) within reach."""
    gap = np.linalg.norm(scene.hub[:, None] - points, axis=-1)
    group, point = np.nonzero(gap <= scene.max_range + scene.radius[:, None])
    return group, point


def _within(leg: np.ndarray, axis: np.ndarray, cos_half: np.ndarray) -> np.ndarray:
    """Whether a leg leaves within the cone around the axis."""
    return (leg * axis).sum(-1) >= (cos_half - 1e-12) * np.linalg.norm(leg, axis=-1)


def _found(kind, group, pair, reflector, length, first, last) -> Reflections:
    return Reflections(
        group, pair, np.full(len(group), int(kind)), reflector, np.full(len(group), -1), length, first, last
    )


def _none() -> Reflections:
    nothing = np.zeros(0, dtype=int)
    return _found(Kind.PLANE, nothing, nothing, nothing, np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2)))


def _slices(rows: int, width: int, cells: int = 1 << 18) -> Iterator[slice]:
    """Slices of so many rows of this width that temporaries stay in the cache."""
    step = max(1, cells // max(1, width))
    return (slice(k, min(k + step, rows)) for k in range(0, rows, step))
