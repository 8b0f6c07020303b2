"""Rooms for the simulator: walls, poles, and where walls meet."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.geometry.segments import cross, crossings, point_to_segments
from jaxsonar.hardware.errors import SonarError

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


def walls_in_robot_frame(
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
    return np.abs(rho), wrap_angle(theta)


def laser_ranges(
    room: Room, pose: Float[np.ndarray, " 3"], bearing: Float[np.ndarray, " beams"]
) -> Float[np.ndarray, " beams"]:
    """How far a laser at a pose sees along each beam, metres; NaN where it meets no wall.

    Args:
        room: walls in the world frame.
        pose: world_from_laser: x, y (metres), theta (radians).
        bearing: directions of the beams in the laser's frame, radians.
    """
    angle = pose[2] + bearing
    beam = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rays = np.stack([np.broadcast_to(pose[:2], beam.shape), pose[:2] + beam], axis=1)
    way, share = crossings(rays, room.walls)
    meets = (way > 0) & (share >= 0) & (share <= 1)  # False for NaN, a parallel wall
    nearest = np.where(meets, way, np.inf).min(axis=1, initial=np.inf)
    return np.where(np.isfinite(nearest), nearest, np.nan)


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
    position, across = (offset * tangent).sum(-1), cross(tangent, offset)
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
    touching = point_to_segments(corners, walls) <= TOUCH
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
