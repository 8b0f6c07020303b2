"""Rooms for the simulator: walls, poles, and where walls meet (GeoJSON in and out, random rooms and poses)."""

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.hardware.errors import SonarError

from .files import atomic_write, read_bytes, reason, shown

TOUCH = 1e-3
"""Metres; ends of walls nearer than this are one vertex, and an end this near to another wall touches it."""
ANGLE_TOLERANCE = np.radians(1.0)
"""Radians; how far a wedge may be from 90 deg to reflect twice, and must be beyond 180 deg to diffract."""
_SAME_DIRECTION = 1e-4  # rad; walls that leave a vertex closer than this lie on one another


@dataclass(frozen=True, eq=False)
class Junctions:
    """The vertices of a room and the wedges of free space between neighboring walls around each of them."""

    vertices: Float[np.ndarray, "vertices 2"]
    """Ends and crossings of walls, world frame, metres."""
    wedge_vertex: Int[np.ndarray, " wedges"]
    """Vertex each wedge belongs to."""
    wedge_start: Float[np.ndarray, " wedges"]
    """Direction of the wall that bounds the wedge clockwise, world frame, radians."""
    wedge_width: Float[np.ndarray, " wedges"]
    """Opening counter-clockwise from there to the next wall, radians, in (0, 2 pi]; 2 pi at a free end."""
    wedge_reach: Float[np.ndarray, "wedges 2"]
    """How far the (clockwise, counter-clockwise) bounding wall extends from the vertex, metres."""
    right_angled: Bool[np.ndarray, "walls walls"]
    """Pairs of walls that bound a right-angled corner with each other."""

    @property
    def edges(self) -> Int[np.ndarray, " edges"]:
        """Wedges wider than 180 deg: their vertex diffracts (free ends, outer corners)."""
        return np.flatnonzero(self.wedge_width > np.pi + ANGLE_TOLERANCE)

    @property
    def corners(self) -> Int[np.ndarray, " corners"]:
        """Wedges of 90 deg: their two walls reflect a sound back to where it came from."""
        return np.flatnonzero(np.abs(self.wedge_width - np.pi / 2) <= ANGLE_TOLERANCE)


@dataclass(frozen=True, eq=False)
class Room:
    """What reflects around a robot: straight thin walls and thin poles, world frame, metres.

    Ends of walls within 1 mm of each other, or of another wall, are moved together on construction, so that no sound
    slips through the gaps that rounded coordinates leave. The arrays are read-only.

    Raises:
        SonarError: a wall or pole that is not finite, a wall of no length, or not one name a wall.
    """

    walls: Float[np.ndarray, "walls 2 2"]
    """Both ends of each wall; it reflects on both sides."""
    wall_names: tuple[str, ...] = ()
    """What a person calls each wall, "" where it has no name; none at all means no names."""
    poles: Float[np.ndarray, "poles 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    """Centres of poles much thinner than a wavelength; they scatter and do not hide what stands behind."""

    def __post_init__(self):
        walls = np.array(self.walls, dtype=np.float64).reshape(-1, 2, 2)
        poles = np.array(self.poles, dtype=np.float64).reshape(-1, 2)
        names = tuple(self.wall_names) or ("",) * len(walls)
        if len(names) != len(walls):
            raise SonarError(f"room: {len(names)} names for {len(walls)} walls; allowed is one each, or none")
        for index, name in enumerate(names):
            if not name.isprintable():
                raise SonarError(f"room: wall {index} is named {name!a:.60}; allowed is one line of printable text")
            if not np.isfinite(walls[index]).all():
                raise SonarError(f"room: wall {index} ({name}) is not finite; allowed are finite coordinates in metres")
        if not np.isfinite(poles).all():
            raise SonarError("room: a pole is not finite; allowed are finite coordinates in metres")
        walls = _closed(walls)
        short = np.flatnonzero(np.linalg.norm(walls[:, 1] - walls[:, 0], axis=-1) <= TOUCH)
        if len(short):
            raise SonarError(
                f"room: wall {short[0]} ({names[short[0]]}) has no length; allowed is more than {TOUCH * 1e3:g} mm"
            )
        walls.setflags(write=False)
        poles.setflags(write=False)
        object.__setattr__(self, "walls", walls)
        object.__setattr__(self, "poles", poles)
        object.__setattr__(self, "wall_names", names)

    @cached_property
    def junctions(self) -> Junctions:
        """Vertices and wedges: ends of walls, ends that touch another wall (T), crossings (X)."""
        return _junctions(self.walls)


def point_to_walls(
    points: Float[np.ndarray, "points 2"], walls: Float[np.ndarray, "walls 2 2"]
) -> Float[np.ndarray, "points walls"]:
    """Distance of every point from every wall, metres."""
    start, along = walls[:, 0], walls[:, 1] - walls[:, 0]
    offset = points[:, None] - start
    share = np.clip((offset * along).sum(-1) / (along**2).sum(-1), 0.0, 1.0)
    return np.linalg.norm(offset - share[..., None] * along, axis=-1)


def crossings(
    first: Float[np.ndarray, "a 2 2"], second: Float[np.ndarray, "b 2 2"]
) -> tuple[Float[np.ndarray, "a b"], Float[np.ndarray, "a b"]]:
    """Where the lines through every two segments cross, as shares (0 start, 1 end) of both; NaN if parallel."""
    u = (first[:, 1] - first[:, 0])[:, None]
    v = (second[:, 1] - second[:, 0])[None]
    offset = second[None, :, 0] - first[:, None, 0]
    turn = _cross(u, v)
    turn = np.where(np.abs(turn) > 1e-12, turn, np.nan)
    return _cross(offset, v) / turn, _cross(offset, u) / turn


def lines_in(
    room: Room, world_from_robot: Float[np.ndarray, " 3"]
) -> tuple[Float[np.ndarray, " walls"], Float[np.ndarray, " walls"]]:
    """The line through each wall as a robot sees it: (rho, theta) with n(theta) . p = rho in the robot frame.

    Args:
        room: walls in the world frame.
        world_from_robot: pose (x, y, theta) of the robot, metres and radians.

    Returns:
        rho: (walls,) distances, metres, >= 0.
        theta: (walls,) directions of the normals, radians, in [-pi, pi).
    """
    start, along = room.walls[:, 0], room.walls[:, 1] - room.walls[:, 0]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=-1) / np.linalg.norm(along, axis=-1, keepdims=True)
    rho = (normal * (start - world_from_robot[:2])).sum(-1)
    normal = np.where(rho < 0, -1.0, 1.0)[:, None] * normal
    theta = np.arctan2(normal[:, 1], normal[:, 0]) - world_from_robot[2]
    theta = (theta + np.pi) % (2 * np.pi) - np.pi
    return np.abs(rho), np.where(theta >= np.pi, -np.pi, theta)  # the modulo may round up to pi


def load_room(path: str | os.PathLike[str]) -> Room:
    """Read a room from a GeoJSON FeatureCollection in world metres.

    LineString and MultiLineString pieces and the rings of Polygon and MultiPolygon are walls, each with its feature's
    property ``name``; a Point with property ``kind`` "pole" is a pole. Points of kind "corner" and "edge", which maps
    contain, are skipped: walls imply them.

    Raises:
        SonarError: the file cannot be read, or a feature is none of these; one line names file, feature and cause.
    """
    content = read_bytes(path, what="a room, GeoJSON")
    place = shown(path)
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as failure:
        raise SonarError(f"{place}: no JSON: {reason(failure)}; allowed is a GeoJSON FeatureCollection") from None
    features = document.get("features") if isinstance(document, dict) else None
    if not (isinstance(document, dict) and document.get("type") == "FeatureCollection" and isinstance(features, list)):
        raise SonarError(f"{place}: no FeatureCollection came; allowed is a GeoJSON FeatureCollection with features")
    walls, names, poles = [], [], []
    for index, feature in enumerate(features):
        try:
            name, pieces, points = _feature(feature)
        except SonarError as error:
            raise SonarError(f"{place}: feature {index}: {error}") from None
        walls += pieces
        names += [name] * len(pieces)
        poles += points
    if not walls and not poles:
        raise SonarError(f"{place}: neither wall nor pole came; allowed is at least one LineString, Polygon or pole")
    try:
        return Room(np.array(walls).reshape(-1, 2, 2), tuple(names), np.array(poles).reshape(-1, 2))
    except SonarError as error:
        raise SonarError(f"{place}: {error}") from None


def save_room(room: Room, path: str | os.PathLike[str]) -> None:
    """Write a room as GeoJSON in world metres: a LineString a wall, a Point of kind "pole" a pole.

    The file appears complete or not at all. Coordinates are written in full: what is loaded again is the same room.

    Raises:
        SonarError: the file cannot be written.
    """
    features: list[dict[str, Any]] = []
    for wall, name in zip(room.walls.tolist(), room.wall_names, strict=True):
        properties = {"kind": "wall"} | ({"name": name} if name else {})
        geometry = {"type": "LineString", "coordinates": wall}
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    for pole in room.poles.tolist():
        geometry = {"type": "Point", "coordinates": pole}
        features.append({"type": "Feature", "properties": {"kind": "pole"}, "geometry": geometry})
    body = ",\n".join(json.dumps(feature, ensure_ascii=False) for feature in features)
    text = f'{{"type": "FeatureCollection", "features": [\n{body}\n]}}\n'
    with atomic_write(path) as file:
        file.write(text)


def random_room(
    rng: np.random.Generator,
    *,
    recess: float = 0.4,
    box: float = 0.3,
    segment: float = 0.4,
    pole: float = 0.3,
) -> Room:
    """A closed room 3 to 6 m across with 4 to 7 walls, at any angle, in which a ring of 2 m range finds walls.

    Half of the rooms are rectangles, turned at random; the others are polygons without parallel walls.

    Args:
        rng: source of randomness; the same state gives the same room.
        recess: probability that one wall has a recess (a door, 0.6 to 1 m wide).
        box: probability that a box (0.3 to 0.6 m) stands in the room.
        segment: probability that a free-standing segment (0.3 to 0.8 m) stands in the room.
        pole: probability that a pole stands in the room.
    """
    while True:
        outline = _rectangle(rng.uniform(3.0, 5.0, 2)) if rng.random() < 0.5 else _polygon(rng)
        if rng.random() < recess:
            outline = _with_recess(rng, outline)
        turn = rng.uniform(-np.pi, np.pi)
        outline = _placed(outline, rng.uniform(-1.0, 1.0, 2), turn)
        shell = _loop(outline)
        names = tuple(f"wall {k}" for k in range(len(shell)))
        parts, poles = [shell], np.zeros((0, 2))
        low, high = outline.min(0), outline.max(0)
        if rng.random() < box:
            parts.append(_loop(_placed(_rectangle(rng.uniform(0.3, 0.6, 2)), rng.uniform(low, high), turn)))
            names += ("box",) * 4
        if rng.random() < segment:
            half = rng.uniform(0.15, 0.4)
            ends = np.array([[-half, 0.0], [half, 0.0]])
            parts.append(_placed(ends, rng.uniform(low, high), rng.uniform(-np.pi, np.pi))[None])
            names += ("segment",)
        if rng.random() < pole:
            poles = rng.uniform(low, high, (1, 2))
        room = Room(np.concatenate(parts), names, poles)
        if _sound(room, len(shell), rng):
            return room


def random_pose(rng: np.random.Generator, room: Room, *, clearance: float = 0.45) -> Float[np.ndarray, " 3"]:
    """A pose (x, y, theta) inside a closed room, metres and radians, world_from_robot.

    Inside means that walls are met in all directions; this works whatever stands in the room.

    Args:
        rng: source of randomness.
        room: the walls around.
        clearance: least distance of the robot's centre from any wall or pole, metres.

    Raises:
        SonarError: no such place was found: the room is open or too small.
    """
    if not (np.isfinite(clearance) and clearance >= 0):
        raise SonarError(f"random_pose: clearance {clearance:g} m; allowed is 0 or more")
    for _ in range(100 if len(room.walls) else 0):
        points = rng.uniform(room.walls.min((0, 1)), room.walls.max((0, 1)), (64, 2))
        inside = np.flatnonzero(_free(room, points, clearance))
        if len(inside):
            return np.append(points[inside[0]], rng.uniform(-np.pi, np.pi))
    raise SonarError(f"random_pose: no place {clearance:g} m clear of all walls; allowed is a closed room with space")


def _cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _closed(walls: np.ndarray) -> np.ndarray:
    """Walls whose ends within 1 mm of one another, or of a wall, are moved onto it; exact ones stay as they are."""
    if not len(walls):
        return walls
    ends = walls.reshape(-1, 2)
    first = (np.linalg.norm(ends[:, None] - ends, axis=-1) <= TOUCH).argmax(axis=1)
    while (first != first[first]).any():  # chains of near ends
        first = first[first]
    walls = ends[first].reshape(-1, 2, 2)
    start, along = walls[:, 0], walls[:, 1] - walls[:, 0]
    length = np.linalg.norm(along, axis=-1)
    if (length <= TOUCH).any():
        return walls  # the caller says so
    tangent = along / length[:, None]
    offset = walls.reshape(-1, 2)[:, None] - start
    position, across = (offset * tangent).sum(-1), _cross(tangent, offset)
    touches = (np.abs(across) <= TOUCH) & (position > TOUCH) & (position < length - TOUCH)
    end, wall = np.nonzero(touches & (np.abs(across) > 1e-12))
    ends = walls.reshape(-1, 2).copy()
    ends[end] = start[wall] + position[end, wall, None] * tangent[wall]
    return ends.reshape(-1, 2, 2)


def _junctions(walls: np.ndarray) -> Junctions:
    vertices = list(dict.fromkeys(map(tuple, walls.reshape(-1, 2).tolist())))
    share_a, share_b = crossings(walls, walls)
    inner = np.triu((share_a > 0) & (share_a < 1) & (share_b > 0) & (share_b < 1))
    for a, b in zip(*np.nonzero(inner), strict=True):
        point = walls[a, 0] + share_a[a, b] * (walls[a, 1] - walls[a, 0])
        if (np.linalg.norm(np.array(vertices) - point, axis=-1) > TOUCH).all():
            vertices.append(tuple(point.tolist()))
    corners = np.array(vertices).reshape(-1, 2)
    touching = point_to_walls(corners, walls) <= TOUCH
    rows: list[tuple[int, float, float, float, float]] = []
    right_angled = np.zeros((len(walls), len(walls)), dtype=bool)
    for vertex, point in enumerate(corners):
        leaving = _leaving(point, walls, np.flatnonzero(touching[vertex]))
        for k, (angle, reach, members) in enumerate(leaving):
            next_angle, next_reach, next_members = leaving[(k + 1) % len(leaving)]
            width = (next_angle - angle) % (2 * np.pi) if len(leaving) > 1 else 2 * np.pi
            rows.append((vertex, angle, width, reach, next_reach))
            if abs(width - np.pi / 2) <= ANGLE_TOLERANCE:
                right_angled[np.ix_(members, next_members)] = True
    table = np.array(rows).reshape(-1, 5)
    return Junctions(
        corners, table[:, 0].astype(int), table[:, 1], table[:, 2], table[:, 3:], right_angled | right_angled.T
    )


def _leaving(point: np.ndarray, walls: np.ndarray, touching: np.ndarray) -> list[tuple[float, float, list[int]]]:
    """Directions in which walls leave a vertex, counter-clockwise: (angle, how far, which walls)."""
    rays = []
    for wall in touching.tolist():
        for start, end in ((0, 1), (1, 0)):
            reach = float(np.linalg.norm(walls[wall, end] - point))
            if reach > TOUCH:
                dx, dy = walls[wall, end] - walls[wall, start]
                rays.append((float(np.arctan2(dy, dx)), reach, wall))
    merged: list[tuple[float, float, list[int]]] = []
    for angle, reach, wall in sorted(rays):
        if merged and angle - merged[-1][0] < _SAME_DIRECTION:
            merged[-1] = (merged[-1][0], max(reach, merged[-1][1]), [*merged[-1][2], wall])
        else:
            merged.append((angle, reach, [wall]))
    if len(merged) > 1 and merged[0][0] + 2 * np.pi - merged[-1][0] < _SAME_DIRECTION:
        angle, reach, members = merged.pop()  # one direction on both sides of the seam at pi
        merged[0] = (merged[0][0], max(reach, merged[0][1]), merged[0][2] + members)
    return merged


def _feature(feature: Any) -> tuple[str, list[np.ndarray], list[np.ndarray]]:
    """Name, walls and poles of one GeoJSON feature."""
    if not isinstance(feature, dict) or feature.get("type") != "Feature":
        raise SonarError("no Feature came; allowed are Feature objects")
    properties, geometry = feature.get("properties"), feature.get("geometry")
    properties = {} if properties is None else properties
    if not isinstance(properties, dict):
        raise SonarError("properties are no object; allowed is an object or null")
    name = properties.get("name")
    if not isinstance(name, str | None):
        raise SonarError(f"name {name!r:.60}; allowed is text")
    if not isinstance(geometry, dict) or "coordinates" not in geometry:
        raise SonarError("no geometry with coordinates came; allowed are LineString, Polygon, their Multi forms, Point")
    form, coordinates = geometry.get("type"), geometry["coordinates"]
    if form == "Point":
        kind = properties.get("kind")
        if kind not in ("pole", "corner", "edge"):
            raise SonarError(f'Point of kind {kind!r:.60}; allowed is "pole" ("corner" and "edge" are skipped)')
        return name or "", [], [_positions([coordinates])[0]] if kind == "pole" else []
    pieces: list[np.ndarray] = []
    for line, is_ring in _lines(form, coordinates):
        points = _positions(line)
        if is_ring:
            if len(points) < 4 or (points[0] != points[-1]).any():
                raise SonarError(
                    f"a ring of {len(points)} positions is open; allowed are 4 or more, the last = the first"
                )
            points = points[np.append(True, (points[1:] != points[:-1]).any(axis=1))]
        if len(points) < 2:
            raise SonarError(f"a line of {len(points)} positions; allowed are 2 or more")
        length = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if (length <= TOUCH).any():
            x, y = points[int(length.argmin())]
            raise SonarError(f"a wall of no length at ({x:g}, {y:g}); allowed is more than {TOUCH * 1e3:g} mm")
        pieces += list(np.stack([points[:-1], points[1:]], axis=1))
    return name or "", pieces, []


def _lines(form: Any, coordinates: Any) -> Iterator[tuple[Any, bool]]:
    """Every list of positions in a geometry, and whether it is a ring."""
    depth = {"LineString": 0, "MultiLineString": 1, "Polygon": 1, "MultiPolygon": 2}.get(str(form))
    if depth is None:
        raise SonarError(f"geometry {form!r:.60}; allowed are LineString, Polygon, their Multi forms and Point")
    lists = [coordinates]
    for _ in range(depth):
        if not all(isinstance(entry, list) for entry in lists):
            raise SonarError(f"coordinates of a {form:.60} are no lists of lines; allowed is what RFC 7946 gives")
        lists = [line for entry in lists for line in entry]
    for line in lists:
        yield line, str(form).endswith("Polygon")


def _positions(line: Any) -> np.ndarray:
    if not isinstance(line, list):
        raise SonarError(f"{line!r:.40} instead of a list of positions; allowed are lists of [x, y]")
    for position in line:
        pair = position[:2] if isinstance(position, list) else []
        if len(pair) < 2 or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in pair):
            raise SonarError(f"position {position!r:.60}; allowed is [x, y] in metres")
        if not all(abs(v) < 1e12 for v in pair):  # NaN fails too, and integers too large for a float
            raise SonarError(f"position {position!r:.60}; allowed are finite numbers, metres")
    return np.array([position[:2] for position in line], dtype=np.float64).reshape(-1, 2)


def _free(room: Room, points: np.ndarray, clearance: float) -> np.ndarray:
    """Which points lie inside, with walls in every one of 64 directions, and clear of everything."""
    inside = (point_to_walls(points, room.walls) >= clearance).all(axis=1)
    inside &= (np.linalg.norm(points[:, None] - room.poles, axis=-1) >= clearance).all(axis=1)
    kept = np.flatnonzero(inside)
    angle = 2 * np.pi * np.arange(64) / 64
    towards = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rays = np.stack(np.broadcast_arrays(points[kept, None], points[kept, None] + towards), axis=-2).reshape(-1, 2, 2)
    distance, share = crossings(rays, room.walls)
    hits = ((distance > 0) & (share >= 0) & (share <= 1)).any(axis=1)
    inside[kept] = hits.reshape(-1, 64).all(axis=1)
    return inside


def _sound(room: Room, shell: int, rng: np.random.Generator) -> bool:
    """Whether a random room is of use: nothing crosses, obstacles stand inside, and a robot finds a place."""
    share_a, share_b = crossings(room.walls, room.walls)
    inner = (share_a > 1e-6) & (share_a < 1 - 1e-6) & (share_b > 1e-6) & (share_b < 1 - 1e-6)
    if inner.any() or (np.ptp(room.walls[:shell], axis=(0, 1)) > 7.0).any():
        return False
    outer = Room(room.walls[:shell])
    obstacles = np.concatenate([room.walls[shell:].reshape(-1, 2), room.poles])
    if len(obstacles) and not _free(outer, obstacles, 0.1).all():
        return False
    points = rng.uniform(room.walls.min((0, 1)), room.walls.max((0, 1)), (256, 2))
    return int(np.count_nonzero(_free(room, points, 0.5))) >= 16


def _rectangle(size: np.ndarray) -> np.ndarray:
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size / 2


def _polygon(rng: np.random.Generator) -> np.ndarray:
    """A polygon around the origin with 4 to 7 corners, counter-clockwise; star-shaped, hence simple."""
    count = int(rng.integers(4, 8))
    angle = 2 * np.pi * (np.arange(count) + rng.uniform(-0.25, 0.25, count)) / count
    radius = rng.uniform(1.8, 2.9, count)
    return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _with_recess(rng: np.random.Generator, outline: np.ndarray) -> np.ndarray:
    """The outline with a rectangular niche behind the middle of one wall, where the wall is long enough."""
    k = int(rng.integers(len(outline)))
    start, end = outline[k], outline[(k + 1) % len(outline)]
    length = np.linalg.norm(end - start)
    width, depth = rng.uniform(0.6, 1.0), rng.uniform(0.1, 0.4)
    if length < width + 0.6:
        return outline
    tangent = (end - start) / length
    outward = np.array([tangent[1], -tangent[0]])
    left, right = (start + end - width * tangent) / 2, (start + end + width * tangent) / 2
    niche = [left, left + depth * outward, right + depth * outward, right]
    return np.concatenate([outline[: k + 1], niche, outline[k + 1 :]])


def _loop(outline: np.ndarray) -> np.ndarray:
    return np.stack([outline, np.roll(outline, -1, axis=0)], axis=1)


def _placed(points: np.ndarray, at: np.ndarray, turn: float) -> np.ndarray:
    cos, sin = np.cos(turn), np.sin(turn)
    return at + points @ np.array([[cos, sin], [-sin, cos]])
