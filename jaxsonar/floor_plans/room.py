"""Floor plans: straight walls, thin poles and round columns in the world frame."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float

from jaxsonar.floor_plans.junctions import TOUCH, Junctions, find_junctions
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.geometry.segments import cross, crossings
from jaxsonar.hardware.errors import SonarError


@dataclass(frozen=True, eq=False)
class Room:
    """A floor plan: straight thin walls, thin poles and circles, world frame, metres.

    On construction, ends of walls within 1 mm of each other, or of another wall, are moved together, so that sound does
    not pass through gaps from rounded coordinates. The arrays are read-only.

    Raises:
        SonarError: a wall, pole or circle that is not finite, a wall or circle without size, or a wrong number of
            names.
    """

    walls: Float[np.ndarray, "walls 2 2"]
    """Endpoints of each wall; walls reflect on both sides."""
    wall_names: tuple[str, ...] = ()
    """Name of each wall, "" for a wall without one; empty if no wall has a name."""
    poles: Float[np.ndarray, "poles 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    """Centers of poles much thinner than a wavelength; they scatter and do not occlude."""
    circles: Float[np.ndarray, "circles 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    """Center x, y and radius of round columns; they reflect outwards and occlude."""

    def __post_init__(self):
        walls = np.array(self.walls, dtype=np.float64).reshape(-1, 2, 2)
        poles = np.array(self.poles, dtype=np.float64).reshape(-1, 2)
        circles = np.array(self.circles, dtype=np.float64).reshape(-1, 3)
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
        if not (np.isfinite(circles).all() and (circles[:, 2] > 0).all()):
            raise SonarError("room: a circle is not finite, or has no radius; allowed are finite metres, above 0")
        walls = _close_gaps(walls)
        short = np.flatnonzero(np.linalg.norm(walls[:, 1] - walls[:, 0], axis=-1) <= TOUCH)
        if len(short):
            tiny = np.ptp(walls.reshape(-1, 2), axis=0).max() < 0.1
            degrees = "; are the coordinates degrees of longitude and latitude? needed are metres" if tiny else ""
            allowed = f"allowed is more than {TOUCH * 1e3:g} mm{degrees}"
            raise SonarError(f"room: wall {short[0]} ({names[short[0]]}) has no length; {allowed}")
        walls.setflags(write=False)
        poles.setflags(write=False)
        circles.setflags(write=False)
        object.__setattr__(self, "circles", circles)
        object.__setattr__(self, "walls", walls)
        object.__setattr__(self, "poles", poles)
        object.__setattr__(self, "wall_names", names)

    @cached_property
    def junctions(self) -> Junctions:
        """Vertices and wedges at ends of walls, at ends that touch another wall (T), and at crossings (X)."""
        return find_junctions(self.walls)


def walls_in_robot_frame(
    room: Room, world_from_robot: Float[np.ndarray, " 3"]
) -> tuple[Float[np.ndarray, " walls"], Float[np.ndarray, " walls"]]:
    """The line through each wall, (rho, theta) with n(theta) . p = rho in the robot frame.

    Args:
        room: walls in the world frame.
        world_from_robot: robot pose x, y (metres), theta (radians).

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
    room: Room, world_from_laser: Float[np.ndarray, " 3"], bearing: Float[np.ndarray, " beams"]
) -> Float[np.ndarray, " beams"]:
    """Ranges of a laser scanner along each beam, metres; NaN if the beam meets neither a wall nor a circle.

    Args:
        room: walls in the world frame.
        world_from_laser: laser pose x, y (metres), theta (radians).
        bearing: directions of the beams in the laser frame, radians.
    """
    angle = world_from_laser[2] + bearing
    beam = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rays = np.stack([np.broadcast_to(world_from_laser[:2], beam.shape), world_from_laser[:2] + beam], axis=1)
    distance, share = crossings(rays, room.walls)
    meets = (distance > 0) & (share >= 0) & (share <= 1)  # False for NaN, a parallel wall
    nearest = np.where(meets, distance, np.inf).min(axis=1, initial=np.inf)
    offset = room.circles[:, :2] - world_from_laser[:2]
    ahead, aside = beam @ offset.T, cross(beam[:, None], offset[None])
    radius = room.circles[:, 2]
    entry = ahead - np.sqrt(np.maximum(radius**2 - aside**2, 0))
    hits = (np.abs(aside) <= radius) & (entry > 0)
    nearest = np.minimum(nearest, np.where(hits, entry, np.inf).min(axis=1, initial=np.inf))
    return np.where(np.isfinite(nearest), nearest, np.nan)


def _close_gaps(walls: Float[np.ndarray, "walls 2 2"]) -> Float[np.ndarray, "walls 2 2"]:
    """Walls whose ends within 1 mm of another end or wall are moved onto it; exact ones stay unchanged."""
    if not len(walls):
        return walls
    ends = walls.reshape(-1, 2)
    first = (np.linalg.norm(ends[:, None] - ends, axis=-1) <= TOUCH).argmax(axis=1)
    while (first != first[first]).any():  # chains of close ends
        first = first[first]
    walls = ends[first].reshape(-1, 2, 2)
    start, along = walls[:, 0], walls[:, 1] - walls[:, 0]
    length = np.linalg.norm(along, axis=-1)
    if (length <= TOUCH).any():
        return walls  # the caller raises an error
    tangent = along / length[:, None]
    offset = walls.reshape(-1, 2)[:, None] - start
    position, across = (offset * tangent).sum(-1), cross(tangent, offset)
    touches = (np.abs(across) <= TOUCH) & (position > TOUCH) & (position < length - TOUCH)
    end, wall = np.nonzero(touches & (np.abs(across) > 1e-12))
    ends = walls.reshape(-1, 2).copy()
    ends[end] = start[wall] + position[end, wall, None] * tangent[wall]
    return ends.reshape(-1, 2, 2)
