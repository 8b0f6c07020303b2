"""Random rooms and random poses in rooms, for results that do not depend on one room."""

import numpy as np
from jaxtyping import Float

from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.segments import crossings, point_to_segments
from jaxsonar.hardware.errors import SonarError

MAX_COLUMNS = 8
"""Largest number of columns of a random room; more seldom fit into it."""
COLUMN_RADIUS = (0.05, 0.3)
"""Smallest and largest radius of a random column, metres: from a pipe to a pillar."""
COLUMN_GAP = 0.1
"""Smallest distance of a random column from walls, poles and other columns, metres, as of other obstacles."""


def random_room(
    rng: np.random.Generator,
    *,
    recess: float = 0.4,
    box: float = 0.3,
    segment: float = 0.4,
    pole: float = 0.3,
    columns: float = 0.0,
) -> Room:
    """A random closed room, 3 to 6 m wide, with 4 to 7 walls in any orientation; a ring of 2 m range detects walls.

    Half of the rooms are rectangles with a random rotation. The others are polygons without parallel walls.

    Args:
        rng: random generator; the same state gives the same room.
        recess: probability that one wall has a recess (a door, 0.6 to 1 m wide).
        box: probability that the room contains a box (0.3 to 0.6 m).
        segment: probability that the room contains a free-standing wall (0.3 to 0.8 m).
        pole: probability that the room contains a pole.
        columns: expected number of round columns of 0.05 to 0.3 m radius: 0.5 is one column in half of the rooms, 3 are
            three in each. Many columns make the search long.

    Raises:
        SonarError: a number of columns out of range.
    """
    if not 0 <= columns <= MAX_COLUMNS:
        raise SonarError(f"random_room: columns {columns:g}; allowed is 0 to {MAX_COLUMNS}")
    count = int(columns) + int(columns % 1 > 0 and rng.random() < columns % 1)
    while True:
        outline = _rectangle(rng.uniform(3.0, 5.0, 2)) if rng.random() < 0.5 else _polygon(rng)
        if rng.random() < recess:
            outline = _with_recess(rng, outline)
        turn = rng.uniform(-np.pi, np.pi)
        outline = _moved(outline, rng.uniform(-1.0, 1.0, 2), turn)
        shell = _closed_walls(outline)
        names = tuple(f"wall {k}" for k in range(len(shell)))
        parts, poles = [shell], np.zeros((0, 2))
        low, high = outline.min(0), outline.max(0)
        if rng.random() < box:
            parts.append(_closed_walls(_moved(_rectangle(rng.uniform(0.3, 0.6, 2)), rng.uniform(low, high), turn)))
            names += ("box",) * 4
        if rng.random() < segment:
            half = rng.uniform(0.15, 0.4)
            ends = np.array([[-half, 0.0], [half, 0.0]])
            parts.append(_moved(ends, rng.uniform(low, high), rng.uniform(-np.pi, np.pi))[None])
            names += ("segment",)
        if rng.random() < pole:
            poles = rng.uniform(low, high, (1, 2))
        circles = np.column_stack([rng.uniform(low, high, (count, 2)), rng.uniform(*COLUMN_RADIUS, count)])
        room = Room(np.concatenate(parts), names, poles, circles)
        if _is_usable(room, len(shell), rng):
            return room


def random_pose(rng: np.random.Generator, room: Room, *, clearance: float = 0.45) -> Float[np.ndarray, " 3"]:
    """A random pose inside a closed room: world_from_robot x, y (metres), theta (radians).

    A point is inside if rays in all directions meet a wall; this also works with obstacles in the room.

    Args:
        rng: random generator.
        room: the floor plan.
        clearance: smallest distance of the robot's center from any wall, pole or circle, metres.

    Raises:
        SonarError: no such pose was found, because the room is open or too small.
    """
    if not (np.isfinite(clearance) and clearance >= 0):
        raise SonarError(f"random_pose: clearance {clearance:g} m; allowed is 0 or more")
    for _ in range(100 if len(room.walls) else 0):
        points = rng.uniform(room.walls.min((0, 1)), room.walls.max((0, 1)), (64, 2))
        inside = np.flatnonzero(_free(room, points, clearance))
        if len(inside):
            return np.append(points[inside[0]], rng.uniform(-np.pi, np.pi))
    raise SonarError(f"random_pose: no place {clearance:g} m clear of all walls; allowed is a closed room with space")


def _free(room: Room, points: np.ndarray, clearance: float) -> np.ndarray:
    """Points inside the room, with a wall in each of 64 directions, and with this clearance (metres)."""
    inside = (point_to_segments(points, room.walls) >= clearance).all(axis=1)
    inside &= (np.linalg.norm(points[:, None] - room.poles, axis=-1) >= clearance).all(axis=1)
    away = np.linalg.norm(points[:, None] - room.circles[:, :2], axis=-1) - room.circles[:, 2]
    inside &= (away >= clearance).all(axis=1)
    kept = np.flatnonzero(inside)
    angle = 2 * np.pi * np.arange(64) / 64
    towards = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rays = np.stack(np.broadcast_arrays(points[kept, None], points[kept, None] + towards), axis=-2).reshape(-1, 2, 2)
    distance, share = crossings(rays, room.walls)
    hits = ((distance > 0) & (share >= 0) & (share <= 1)).any(axis=1)
    inside[kept] = hits.reshape(-1, 64).all(axis=1)
    return inside


def _is_usable(room: Room, shell: int, rng: np.random.Generator) -> bool:
    """Whether a random room is usable: no walls cross, obstacles are inside, and there is free space for a robot."""
    share_a, share_b = crossings(room.walls, room.walls)
    inner = (share_a > 1e-6) & (share_a < 1 - 1e-6) & (share_b > 1e-6) & (share_b < 1 - 1e-6)
    if inner.any() or (np.ptp(room.walls[:shell], axis=(0, 1)) > 7.0).any():
        return False
    outer = Room(room.walls[:shell])
    obstacles = np.concatenate([room.walls[shell:].reshape(-1, 2), room.poles])
    if len(obstacles) and not _free(outer, obstacles, 0.1).all():
        return False
    if len(room.circles) and not _columns_apart(outer, room):
        return False
    points = rng.uniform(room.walls.min((0, 1)), room.walls.max((0, 1)), (256, 2))
    return int(np.count_nonzero(_free(room, points, 0.5))) >= 16


def _columns_apart(outer: Room, room: Room) -> bool:
    """Whether all columns stand inside the outer walls, and COLUMN_GAP from walls, poles and each other."""
    center, radius = room.circles[:, :2], room.circles[:, 2]
    apart = np.linalg.norm(center[:, None] - center, axis=-1) - radius - radius[:, None]
    np.fill_diagonal(apart, np.inf)
    gaps = (
        point_to_segments(center, room.walls) - radius[:, None],
        np.linalg.norm(center[:, None] - room.poles, axis=-1) - radius[:, None],
        apart,
    )
    return all((gap >= COLUMN_GAP).all() for gap in gaps) and bool(_free(outer, center, COLUMN_GAP).all())


def _rectangle(size: np.ndarray) -> np.ndarray:
    """Corners of a rectangle around the origin, counter-clockwise."""
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size / 2


def _polygon(rng: np.random.Generator) -> np.ndarray:
    """A simple (star-shaped) polygon around the origin with 4 to 7 corners, counter-clockwise."""
    count = int(rng.integers(4, 8))
    angle = 2 * np.pi * (np.arange(count) + rng.uniform(-0.25, 0.25, count)) / count
    radius = rng.uniform(1.8, 2.9, count)
    return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _with_recess(rng: np.random.Generator, outline: np.ndarray) -> np.ndarray:
    """The outline with a rectangular recess in the middle of one wall, if that wall is long enough."""
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


def _closed_walls(outline: np.ndarray) -> np.ndarray:
    """Walls between consecutive corners."""
    return np.stack([outline, np.roll(outline, -1, axis=0)], axis=1)


def _moved(points: np.ndarray, at: np.ndarray, turn: float) -> np.ndarray:
    """Points after a rotation about the origin and a translation."""
    cos, sin = np.cos(turn), np.sin(turn)
    return at + points @ np.array([[cos, sin], [-sin, cos]])
