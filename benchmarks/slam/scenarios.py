"""Scenes of the SLAM benchmark: floor plans like those of buildings, trajectories through them, simulated echoes.

A floor plan is a polygon of free space (shapely): corridors, rooms behind doors and recesses, minus pillars and
cupboards. Its border is the walls. Corridors are 1.5 to 2.2 m wide, so that a ring with 2 m range reaches the walls.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float
from shapely import LineString, Polygon
from shapely.affinity import rotate, translate
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from jaxsonar import Log, Ring, Room, random_pose, random_room, simulate
from jaxsonar.geometry.se2 import unit, wrap_angle
from jaxsonar.simulation.office import load_office
from jaxsonar.simulation.simulator import Simulation
from jaxsonar.simulation.traced_echoes import EchoKind
from jaxsonar.simulation.wheel_odometry import simulate_odometry

SIGMA = 0.001
"""Range noise, metres."""
DISTANCE, TURN = 0.02, float(np.radians(1.0))
"""Odometry noise after one metre (standard deviations), metres and radians; arguments of ``simulate_odometry``."""
SCAN_DISTANCE = 0.1, 0.2
"""Minimum and maximum distance between scans, metres."""
SCAN_ROTATION = float(np.radians(15.0))
"""Rotation between scans while the robot turns in place, radians."""
CURVE_RADIUS = 0.8
"""Radius of curves, metres."""
CLEARANCE = 0.35
"""Minimum distance from the center of the robot to walls, metres; the ring has a radius of 0.28 m."""
DOOR_WIDTH, WALL_THICKNESS = (1.0, 1.2), 0.15
"""Widths of doors, and thickness of the walls between corridors and rooms, metres."""

HARD_CONES: dict[str, Any] = {"beams": "hard"}
"""Argument of long scenes: soft beams have three times as many echoes."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A floor plan, a trajectory through it, and the simulated echoes."""

    name: str
    room: Room
    poses: Float[np.ndarray, "scans 3"]
    """True poses world_from_robot: x, y (m), theta (rad)."""
    ring: Ring = field(default_factory=Ring.circular)
    sigma: float = SIGMA
    """Range noise, metres."""
    clutter: float = 0.0
    """False echoes per true echo."""
    dropout: float = 0.0
    """Probability that an echo is lost."""
    beams: str = "soft"
    """As in ``simulate``."""
    seed: int = 0
    """Seed of the noise."""
    has_odometry: bool = True
    """Whether there is odometry."""

    @cached_property
    def simulation(self) -> Simulation:
        """The echoes and the reflector of each."""
        errors = {"sigma": self.sigma, "clutter": self.clutter, "dropout": self.dropout, "seed": self.seed}
        return simulate(self.ring, self.room, self.poses, beams=self.beams, **errors)

    @property
    def distance_traveled(self) -> float:
        """Length of the trajectory, metres."""
        return float(np.linalg.norm(np.diff(self.poses[:, :2], axis=0), axis=-1).sum())

    def odometry(self, seed: int = 0) -> Float[np.ndarray, "scans 3"]:
        """Poses by odometry."""
        return simulate_odometry(self.poses, distance=DISTANCE, turn=TURN, seed=seed)

    def log(self, seed: int = 0) -> Log:
        """Log of the echoes with odometry of this seed."""
        odometry = self.odometry(seed)
        return self.simulation.as_log(self.ring, odometry if self.has_odometry else np.full_like(odometry, np.nan))


# Scenes


def one_scan(seed: int = 0, **errors: Any) -> Scene:
    """(a) One scan in a random known room, with echoes of at least two walls that are not parallel."""
    rng = np.random.default_rng([seed, 1])
    while True:
        room = random_room(rng)
        scene = Scene(f"one scan {seed}", room, random_pose(rng, room, clearance=0.45)[None], seed=seed, **errors)
        simulation = scene.simulation
        wall, echoes = np.unique(simulation.reflector[simulation.kind == EchoKind.PLANE], return_counts=True)
        along = (room.walls[:, 1] - room.walls[:, 0])[wall[echoes >= 6]]
        direction = along / np.linalg.norm(along, axis=-1, keepdims=True)
        if np.abs(direction[:, :1] * direction[:, 1] - direction[:, 1:] * direction[:, 0]).max(initial=0) > 0.3:
            return scene


def office(seed: int = 0, **errors: Any) -> Scene:
    """(b) The embedded office and its 17 poses."""
    position = load_office()
    return Scene("office", position.room, position.poses, ring=position.ring, seed=seed, **errors)


def echoes_alone(seed: int = 0, **errors: Any) -> Scene:
    """(b) The office without odometry, at a noise of 5 mm."""
    return replace(
        office(seed, **(HARD_CONES | {"sigma": 0.005} | errors)),
        name=f"office, echoes alone {seed}",
        has_odometry=False,
    )


def loop(seed: int = 0, **errors: Any) -> Scene:
    """(c) One lap around a building and 4 m more; the ring corridor is 30 to 100 m long, two rooms are entered."""
    rng = np.random.default_rng([seed, 3])
    plan = _ring_plan(rng, length=rng.uniform(30.0, 100.0))
    route = _around(plan, rng, laps=1, visited=2, beyond=4.0)
    return _scene(f"loop {seed}", plan.floor, [route], rng, seed, errors)


def twins(seed: int = 0, **errors: Any) -> Scene:
    """(d) Two rooms that look alike on one corridor: enter both, the first again, and return to the start."""
    rng = np.random.default_rng([seed, 4])
    length, width, deep, door, wide = 14.0, rng.uniform(1.6, 2.0), 3.0, 1.1, 3.4
    side = width / 2
    rooms, at = [], (4.0, 10.0)
    cupboard = shapely.box(-wide / 2, side + WALL_THICKNESS + deep - 0.5, -wide / 2 + 0.9, side + WALL_THICKNESS + deep)
    box = shapely.box(wide / 2 - 0.4, side + WALL_THICKNESS, wide / 2, side + WALL_THICKNESS + 0.6)
    for x in at:
        inside = shapely.box(-wide / 2, side + WALL_THICKNESS, wide / 2, side + WALL_THICKNESS + deep)
        free = (
            inside.difference(cupboard)
            .difference(box)
            .union(shapely.box(-door / 2, 0, door / 2, side + 2 * WALL_THICKNESS))
        )
        rooms.append(translate(free, x, 0))
    # Different recesses opposite, so that the corridor itself is not symmetric.
    niches = [shapely.box(5.2, -side - 0.3, 6.6, 0), shapely.box(11.5, -side - 0.12, 12.5, 0)]
    floor = _union([shapely.box(0, -side, length, side), *rooms, *niches])
    inside = side + WALL_THICKNESS + deep / 2
    a, b = ([np.array([x, 0.0]), np.array([x, inside])] for x in at)
    begin = np.array([1.3, 0.0])
    legs = [[begin, *a], [*a[::-1], *b], [*b[::-1], *a], [*a[::-1], begin]]
    return _scene(f"twin rooms {seed}", floor, [np.array(leg) for leg in legs], rng, seed, errors)


def corridor(seed: int = 0, *, length: float = 30.0, **errors: Any) -> Scene:
    """(e) An empty straight corridor, to its end and back."""
    rng = np.random.default_rng([seed, 5])
    half = rng.uniform(0.75, 1.0)
    ends = np.array([[1.2, 0.0], [length - 1.2, 0.0]])
    return _scene(f"corridor {seed}", shapely.box(0, -half, length, half), [ends, ends[::-1]], rng, seed, errors)


def long_run(seed: int = 0, *, scans: int = 10_000, length: float = 60.0, **errors: Any) -> Scene:
    """(f) Laps around a building, sometimes into a room, up to this number of scans."""
    rng = np.random.default_rng([seed, 6])
    plan = _ring_plan(rng, length=length)
    legs, route = [], 0.0
    while route < scans * SCAN_DISTANCE[1]:
        legs.append(_around(plan, rng, laps=1, visited=int(rng.integers(3)), beyond=0.0))
        route += LineString(legs[-1]).length
    scene = _scene(f"long run {seed}", plan.floor, legs, rng, seed, errors)
    return Scene(scene.name, scene.room, scene.poses[:scans], seed=seed, **HARD_CONES | errors)


# Floor plans


@dataclass(frozen=True, eq=False)
class _Plan:
    """A building with a ring corridor."""

    floor: Polygon
    center: np.ndarray  # (corners, 2) of the center line of the corridor, in order
    rooms: tuple[
        tuple[int, float, float], ...
    ]  # side of the ring, metres along it, metres to the left of the center line


def _ring_plan(rng: np.random.Generator, *, length: float) -> _Plan:
    """A ring corridor, rectangular or L-shaped, with recesses, pilasters, and rooms behind doors on both sides."""
    short = rng.uniform(6.5, max(7.0, min(length / 4, 18.0)))
    size = np.array([length / 2 - short, short])
    corners = np.array([[0, 0], [size[0], 0], size, [0, size[1]]], dtype=float)
    if size.min() > 11.0 and rng.random() < 0.6:  # a notch does not change the length
        cut = rng.uniform(5.0, size - 5.5)
        corners = np.array([[0, 0], [size[0], 0], [size[0], size[1] - cut[1]], size - cut, [size[0] - cut[0], size[1]],
                            [0, size[1]]])  # fmt: skip
    side = rng.uniform(1.5, 2.2) / 2
    floor = LineString([*corners, corners[0], corners[1]]).buffer(side, cap_style="flat", join_style="mitre")
    rooms = []
    for k, (start, end) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True)):
        for left in (1.0, -1.0):
            floor, found = _furnish(rng, floor, start, end, side, left)
            rooms += [(k, along, across) for along, across in found]
    return _Plan(floor, corners, tuple(rooms))


def _furnish(
    rng: np.random.Generator, floor: Polygon, start: np.ndarray, end: np.ndarray, side: float, left: float
) -> tuple[Polygon, list[tuple[float, float]]]:
    """Add doors, bays, pilasters and rooms along one wall of a corridor.

    Returns:
        The floor, and (along, across) of the centers of rooms, metres.
    """
    length, rooms = float(np.linalg.norm(end - start)), []
    tangent = (end - start) / length
    corridor = floor

    def box(low: float, high: float, near: float, far: float) -> Polygon:
        """A rectangle, in metres along the corridor and away from its center line."""
        normal = left * np.array([-tangent[1], tangent[0]])
        return Polygon(
            [start + a * tangent + b * normal for a, b in ((low, near), (high, near), (high, far), (low, far))]
        )

    at = side + rng.uniform(0.6, 2.0)
    while at < length - side - 1.6:
        kind = rng.choice(["door", "bay", "pilaster", "room"], p=[0.35, 0.15, 0.15, 0.35])
        wide = {"door": rng.uniform(0.85, 1.05), "bay": rng.uniform(0.8, 2.0), "pilaster": rng.uniform(0.2, 0.4),
                "room": rng.uniform(*DOOR_WIDTH)}[kind]  # fmt: skip
        if at + wide > length - side - 0.4:
            break
        if kind == "pilaster":
            floor = _polygon(floor.difference(box(at, at + wide, side - rng.uniform(0.08, 0.15), side)))
        elif kind == "room":
            size = rng.uniform(2.4, 4.2, 2)
            low = at - rng.uniform(0.2, size[0] - wide - 0.2)
            inside = box(low, low + size[0], side + WALL_THICKNESS, side + WALL_THICKNESS + size[1])
            free = inside.buffer(WALL_THICKNESS - 0.01, join_style="mitre").disjoint(floor)
            deep = rng.uniform(0.4, 0.6)
            cupboard = box(
                low,
                low + rng.uniform(0.6, 1.2),
                side + WALL_THICKNESS + size[1] - deep,
                side + WALL_THICKNESS + size[1],
            )
            if free:
                door = box(at, at + wide, side - 0.01, side + WALL_THICKNESS + 0.01)
                floor = _union([floor, inside.difference(cupboard), door])
                rooms.append((at + wide / 2, left * (side + WALL_THICKNESS + size[1] / 2 - 0.2)))
        else:
            deep = rng.uniform(0.06, 0.2) if kind == "door" else rng.uniform(0.3, 0.6)
            recess = box(at, at + wide, side - 0.01, side + deep)
            apart = recess.buffer(WALL_THICKNESS - 0.01, join_style="mitre").difference(corridor)
            if apart.intersection(floor.difference(corridor)).area < 1e-6:
                floor = _union([floor, recess])
        at += wide + rng.uniform(0.8, 3.5)
    return floor, rooms


def _union(parts: Sequence[BaseGeometry]) -> Polygon:
    return _polygon(unary_union(parts))


def _polygon(one: BaseGeometry) -> Polygon:
    assert isinstance(one, Polygon), "the floor is not connected"
    return one


def _room_of(floor: Polygon) -> Room:
    """The room whose walls are the border of a floor."""
    whole = _polygon(shapely.set_precision(floor, 1e-4).simplify(1e-4))
    rings = [np.array(ring.coords)[:-1] for ring in (whole.exterior, *whole.interiors)]
    rings = [_without_collinear(ring) for ring in rings]
    return Room(np.concatenate([np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in rings]))


def _without_collinear(ring: np.ndarray) -> np.ndarray:
    """A closed polygon without collinear corners."""
    before, after = ring - np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0) - ring
    return ring[np.abs(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]) > 1e-6]


# Trajectories


def _around(plan: _Plan, rng: np.random.Generator, *, laps: int, visited: int, beyond: float) -> np.ndarray:
    """Corners of a route around the ring from the middle of its first side, with detours into some rooms."""
    count = len(plan.center)
    begin = (plan.center[0] + plan.center[1]) / 2
    tangent = (plan.center[1] - plan.center[0]) / np.linalg.norm(plan.center[1] - plan.center[0])
    chosen = rng.permutation(len(plan.rooms))[:visited]
    route = [begin]
    first = float(np.linalg.norm(begin - plan.center[0]))
    for k in range(laps * count + 1):
        side, last = k % count, k == laps * count
        start, end = plan.center[side], plan.center[(side + 1) % count]
        along = (end - start) / np.linalg.norm(end - start)
        entered = sorted(plan.rooms[room][1:] for room in chosen if plan.rooms[room][0] == side)
        for at, across in entered:
            if (k == 0 and at < first + 1.0) or (last and at > first - 1.0):
                continue
            door = start + at * along
            inside = door + across * np.array([-along[1], along[0]])
            route += [door, inside, door]
        if not last:
            route.append(end)
    return np.array([*route, begin + beyond * tangent])


def _scene(
    name: str, floor: Polygon, legs: Sequence[np.ndarray], rng: np.random.Generator, seed: int, errors: dict[str, Any]
) -> Scene:
    """A scene from a floor plan and the corners of routes, in a random frame."""
    turn, shift = float(rng.uniform(-np.pi, np.pi)), rng.uniform(-2.0, 2.0, 2)
    poses = poses_along(np.concatenate(legs), rng)
    c, s = np.cos(turn), np.sin(turn)
    position = poses[:, :2] @ np.array([[c, s], [-s, c]]) + shift
    moved = translate(rotate(floor, turn, origin=(0, 0), use_radians=True), *shift)
    return Scene(
        name,
        _room_of(_polygon(moved)),
        np.column_stack([position, wrap_angle(poses[:, 2] + turn)]),
        seed=seed,
        **HARD_CONES | errors,
    )


def poses_along(corners: Float[np.ndarray, "corners 2"], rng: np.random.Generator) -> Float[np.ndarray, "scans 3"]:
    """Poses along a route with rounded corners and lateral deviations of centimetres; reversals are turns in place."""
    corners = corners[np.append(True, np.linalg.norm(np.diff(corners, axis=0), axis=-1) > 1e-9)]
    heading = np.arctan2(*np.diff(corners, axis=0).T[::-1])
    back = np.flatnonzero(np.abs(wrap_angle(np.diff(heading))) > np.radians(150)) + 1
    poses: list[np.ndarray] = []
    for first, last in zip([0, *back], [*back, len(corners) - 1], strict=True):
        leg = _leg(corners[first : last + 1], rng)
        if poses:
            turned = float(wrap_angle(leg[0, 2] - poses[-1][-1, 2]))
            turned = abs(turned) if rng.random() < 0.5 and abs(turned) > 3 else turned
            steps = int(np.ceil(abs(turned) / SCAN_ROTATION))
            rotation = np.repeat(poses[-1][-1:], steps, axis=0)
            rotation[:, 2] += turned * np.arange(1, steps + 1) / steps
            poses.append(rotation)
            leg = leg[1:]
        poses.append(leg)
    whole = np.concatenate(poses)
    return np.column_stack([whole[:, :2], wrap_angle(whole[:, 2])])


def _leg(corners: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Poses along a route without reversals."""
    line = LineString(_rounded(corners, CURVE_RADIUS))
    at = np.arange(0.0, line.length, 0.02)
    dense = shapely.get_coordinates(shapely.line_interpolate_point(line, np.append(at, line.length)))
    along = np.gradient(dense, axis=0)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    s = np.append(at, line.length)
    waves = rng.uniform(2 * np.pi / 6, 2 * np.pi / 3, 3), rng.uniform(0, 2 * np.pi, 3)
    sway = 0.025 * np.sin(s[:, None] * waves[0] + waves[1]).sum(axis=1) * np.clip(np.minimum(s, s[-1] - s) / 1.0, 0, 1)
    dense = dense + sway[:, None] * np.stack([-along[:, 1], along[:, 0]], axis=-1)
    swayed = LineString(dense)
    steps = rng.uniform(*SCAN_DISTANCE, int(swayed.length / SCAN_DISTANCE[0]) + 1)
    marks = np.append(0.0, np.cumsum(steps))
    marks = marks[: np.searchsorted(marks, swayed.length) + 1]
    marks *= swayed.length / marks[-1]  # slightly shorter steps, so that the last one ends at the end of the route
    ahead, behind = np.minimum(marks + 0.03, swayed.length), np.maximum(marks - 0.03, 0.0)
    position, ahead_point, behind_point = (
        shapely.get_coordinates(shapely.line_interpolate_point(swayed, m)) for m in (marks, ahead, behind)
    )
    return np.column_stack([position, np.arctan2(*(ahead_point - behind_point).T[::-1])])


def _rounded(corners: np.ndarray, radius: float) -> np.ndarray:
    """A route of straight lines and arcs."""
    if len(corners) < 3:
        return corners
    steps = np.diff(corners, axis=0)
    length = np.linalg.norm(steps, axis=-1)
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    parts = [corners[:1]]
    for k in range(1, len(corners) - 1):
        turn = float(wrap_angle(heading[k] - heading[k - 1]))
        if abs(turn) < 1e-6:
            continue
        cut = min(radius * np.tan(abs(turn) / 2), 0.49 * min(length[k - 1], length[k]))
        bend = cut / np.tan(abs(turn) / 2)
        begin = corners[k] - cut * unit(heading[k - 1])
        angle = heading[k - 1] + turn * np.linspace(0.0, 1.0, 16)
        sign = np.sign(turn)
        center = begin + sign * bend * unit(heading[k - 1] + np.pi / 2)
        parts.append(center + bend * unit(angle - sign * np.pi / 2))
    return np.concatenate([*parts, corners[-1:]])


def clearance(scene: Scene) -> float:
    """Minimum distance of the trajectory from the walls, metres; 0 if it crosses one."""
    route = LineString(scene.poses[:, :2]) if len(scene.poses) > 1 else shapely.Point(scene.poses[0, :2])
    return float(shapely.MultiLineString(list(scene.room.walls)).distance(route))
