"""Probable mistakes of a floor plan and of a trajectory through it.

A floor plan: millimetres, centimetres, degrees of longitude and latitude. A trajectory: headings in degrees or
clockwise, positions in millimetres or outside of the room.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.se2 import unit as unit_vector
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.geometry.segments import crossings, lengths
from jaxsonar.plausibility.implausibility import Implausibility


@dataclass(frozen=True)
class RoomSettings:
    """When the coordinates of a room are no metres. Chosen by hand."""

    long_wall: float = 40.0
    """Half of the walls are shorter than this, metres, in all rooms but ..."""
    large: float = 150.0
    """... those that are smaller than this, metres: a hall with four walls."""
    millimetres: float = 500.0
    """In rooms in millimetres, half of the walls are longer than this; in centimetres, they are shorter."""
    hall: float = 500.0
    """No hall is larger than this, metres. A smaller one is in centimetres only if the trajectory shows it: ..."""
    narrow: float = 1.5
    """... no side of the room in centimetres is shorter than this, metres, ..."""
    fill: float = 0.1
    """... and the trajectory has at least this share of its size."""
    tiny: float = 0.1
    """No room is smaller than this, metres."""
    column: float = 20.0
    """No round column has a larger radius, metres; nor is it wider than the room."""


ROOM_SETTINGS = RoomSettings()


@dataclass(frozen=True)
class TrajectorySettings:
    """When the poses of a trajectory are implausible. Chosen by hand."""

    margin: float = 0.3
    """A pose is beside a room if it is farther away from the room's bounding box than this share of its size, ..."""
    least_margin: float = 5.0
    """... and than this, metres: the reach of sensors."""
    beside: float = 0.5
    """Share of such poses from which on the trajectory is implausible."""
    inside: float = 0.9
    """Share of the poses that are within the room in the right unit."""
    fill: float = 0.02
    """Size of a trajectory relative to its room, at least."""
    rays: int = 24
    """Directions in which a pose looks for walls."""
    open_rays: float = 0.45
    """From a pose outside a closed room, no wall is seen in at least this share of the directions."""
    grid: int = 16
    """Places along each side of the bounding box at which it is tried whether a room is closed."""
    closed: float = 0.2
    """Share of these places that have walls in all directions, in a closed room."""
    outside: float = 0.05
    """Share of the poses outside of a closed room from which on the trajectory is implausible."""
    samples: int = 200
    """Number of poses that are compared with the walls."""
    step: float = 0.01
    """The robot drives if it moves by this from pose to pose, metres."""
    steps: int = 8
    """Fewer steps give no warning about headings."""
    agrees: float = 0.9
    """Mean resultant length of the angle between heading and motion from which on they agree, ..."""
    differs: float = 0.5
    """... and below which they do not."""
    change: float = 0.5
    """A robot drives in another direction of its own after a change by more than this, radians; ..."""
    changes: int = 3
    """... as often, it does not in the right description."""
    straight: float = 0.98
    """Mean resultant length on a drive in one direction."""
    ahead: float = 0.05
    """Sine of the angle of a drive straight ahead, or back."""


TRAJECTORY_SETTINGS = TrajectorySettings()

_UNITS = ((1000.0, "millimetres"), (100.0, "centimetres"))


def implausible_room(room: Room, points: Float[np.ndarray, "poses 2"] | None = None) -> Iterator[Implausibility]:
    """Probable mistakes of a floor plan.

    Args:
        room: walls, poles and columns, world frame, metres.
        points: world positions of a robot that drives there, metres; without NaN. None: unknown.
    """
    yield from _implausible_columns(room)
    yield from implausible_walls(room.walls, points)


def implausible_walls(
    walls: Float[np.ndarray, "walls 2 2"], points: Float[np.ndarray, "poses 2"] | None = None
) -> Iterator[Implausibility]:
    """Probable mistakes of walls, as ``implausible_room``; ``walls`` are both ends of each, metres."""
    if not len(walls):
        return
    ends = walls.reshape(-1, 2)
    low, high = ends.min(axis=0), ends.max(axis=0)
    width, depth = high - low
    size = max(width, depth)
    what = f"the room is {width:.4g} m x {depth:.4g} m"
    wall = float(np.median(lengths(walls)))
    if size > ROOM_SETTINGS.large and wall > ROOM_SETTINGS.long_wall:
        millimetres = wall > ROOM_SETTINGS.millimetres
        if millimetres or size > ROOM_SETTINGS.hall or _shows_centimetres(points, low, high):
            cause = f"its coordinates are probably {'millimetres' if millimetres else 'centimetres'}"
            remedy = f"give metres: divide the coordinates by {1000 if millimetres else 100}"
            yield Implausibility("room unit", what, cause, remedy)
    if size < ROOM_SETTINGS.tiny:
        x, y = ends[0]
        if abs(x) <= 180 and abs(y) <= 90 and np.abs(ends[0]).max() > 10 * size:
            what = f"the room is {width:.2g} m x {depth:.2g} m at ({x:.6g}, {y:.6g})"
            cause = "its coordinates are probably degrees of longitude and latitude"
            remedy = "project it to a plane in metres"
        else:
            cause, remedy = "its coordinates are probably kilometres, or degrees", "give metres"
        yield Implausibility("room unit", what, cause, remedy)


def _shows_centimetres(
    points: Float[np.ndarray, "poses 2"] | None, low: Float[np.ndarray, " 2"], high: Float[np.ndarray, " 2"]
) -> bool:
    """Whether a trajectory in metres fills a room whose bounding box is in centimetres."""
    if points is None or not len(points) or (high - low).min() < 100 * ROOM_SETTINGS.narrow:
        return False
    return _fill(points, low / 100, high / 100) >= ROOM_SETTINGS.fill


def _implausible_columns(room: Room) -> Iterator[Implausibility]:
    """Round columns that are larger than the room, or than any column."""
    if not len(room.circles):
        return
    x, y, radius = room.circles[int(np.argmax(room.circles[:, 2]))]
    size = float(np.ptp(room.walls.reshape(-1, 2), axis=0).max()) if len(room.walls) else np.inf
    if radius > min(ROOM_SETTINGS.column, size):
        what = f"the circle at ({x:.4g}, {y:.4g}) has a radius of {radius:.4g} m"
        if np.isfinite(size):
            what += f", the room a size of {size:.4g} m"
        cause = "the radius is probably in millimetres or centimetres"
        yield Implausibility("room unit", what, cause, "give the radius in metres")


def implausible_trajectory(room: Room | None, poses: Float[np.ndarray, "poses 3"]) -> Iterator[Implausibility]:
    """Probable mistakes of the poses of a robot.

    Args:
        room: the floor plan through which the robot drives; None: unknown.
        poses: world_from_robot x, y (metres), theta (radians); without NaN.
    """
    if not len(poses):
        return
    yield from _implausible_headings(poses)
    if room is not None and len(room.walls):
        yield from _implausible_positions(room, poses[:, :2])


def _implausible_headings(poses: Float[np.ndarray, "poses 3"]) -> Iterator[Implausibility]:
    """Headings in degrees or clockwise, or swapped axes.

    Without the mistake, the robot always drives in one direction of its own. As given, its direction must change: one
    that always drives backwards or sideways is sound.
    """
    heading, step = poses[:, 2], np.diff(poses[:, :2], axis=0)
    drives = np.hypot(*step.T) > TRAJECTORY_SETTINGS.step
    direction = np.arctan2(step[:, 1], step[:, 0])[drives]
    middle = heading[:-1][drives] + np.diff(heading)[drives] / 2
    turns = float(np.abs(np.diff(heading)).max(initial=0.0))
    cause, remedy = "the headings are probably in degrees", "give radians, counter-clockwise from x"
    if turns > 2 * np.pi + 0.1:
        what = f"the heading changes by up to {turns:.4g} rad from pose to pose"
        yield Implausibility("heading unit", what, cause, remedy)
    if turns > 2 * np.pi + 0.1 or len(direction) < TRAJECTORY_SETTINGS.steps:
        return
    given, degrees, clockwise = (direction - one for one in (middle, np.radians(middle), -middle))
    both = direction + np.radians(middle)
    what = "the headings do not agree with the motion of the robot"
    if _is_in_degrees(given, degrees, heading):
        yield Implausibility("heading unit", what, cause, remedy)
    elif _contradicts(given, clockwise):
        names = ("clockwise, or y is negated", "those of a compass, clockwise from y, or x and y are swapped")
        name = names[int(abs(np.sin(np.angle(np.exp(1j * clockwise).mean()))) > np.sqrt(0.5))]
        yield Implausibility("heading direction", what, f"the headings are probably {name}", remedy)
    elif _contradicts(given, both):
        yield Implausibility("heading unit", what, f"{cause} and clockwise", remedy)


def _contradicts(given: Float[np.ndarray, " steps"], other: Float[np.ndarray, " steps"]) -> bool:
    """Whether a robot drives in changing directions, but in one direction with other headings.

    Args:
        given: angle of the motion in the robot frame, radians, ...
        other: ... and with other headings.
    """
    s = TRAJECTORY_SETTINGS
    if _agreement(given, 2) < s.differs:  # a robot may also go back
        return max(_agreement(other, 1), _agreement(other, 2)) > s.agrees
    # Forwards and backwards in turn: so does a robot that turns in a narrow place, but only once or twice.
    changes = int((np.abs(wrap_angle(np.diff(given))) > s.change).sum())
    return _agreement(given, 1) < s.differs and _agreement(other, 1) > s.agrees and changes >= s.changes


def _is_in_degrees(
    given: Float[np.ndarray, " steps"], degrees: Float[np.ndarray, " steps"], heading: Float[np.ndarray, " poses"]
) -> bool:
    """Whether the headings are in degrees; also on a straight drive, or between few slow turns."""
    s = TRAJECTORY_SETTINGS
    if _contradicts(given, degrees):
        return True
    if np.abs(heading).max() <= 2 * np.pi or _agreement(degrees, 1) < s.straight:
        return False
    # Headings beyond a full turn: in degrees, the robot drives straight ahead or back; as given, it does not.
    aside = [float(abs(np.sin(np.angle(np.exp(1j * one).mean())))) for one in (degrees, given)]
    return aside[0] < s.ahead and (_agreement(given, 1) < s.straight or aside[1] > 2 * s.ahead)


def _agreement(angle: Float[np.ndarray, " steps"], fold: int) -> float:
    """Mean resultant length: 1 if the robot drives in one direction of its own (1), or also back (2)."""
    return float(np.abs(np.exp(1j * fold * angle).mean())) if len(angle) else 0.0


def _implausible_positions(room: Room, points: Float[np.ndarray, "poses 2"]) -> Iterator[Implausibility]:
    """Positions that are not in the room."""
    ends = room.walls.reshape(-1, 2)
    low, high = ends.min(axis=0), ends.max(axis=0)
    size = high - low
    margin = max(TRAJECTORY_SETTINGS.least_margin, TRAJECTORY_SETTINGS.margin * float(size.max()))
    beside = ((points < low - margin) | (points > high + margin)).any(axis=1)
    if beside.mean() >= TRAJECTORY_SETTINGS.beside:
        near, far = points.min(axis=0), points.max(axis=0)
        what = f"{beside.mean():.0%} of the poses are outside of the room: they go from ({near[0]:.4g}, {near[1]:.4g}) "
        what += f"to ({far[0]:.4g}, {far[1]:.4g}) m, the room from ({low[0]:.4g}, {low[1]:.4g}) to "
        what += f"({high[0]:.4g}, {high[1]:.4g}) m"
        cause, remedy = "room and trajectory probably have different origins", "give both in one frame, in metres"
        fill, scale, name = max((_fill(points / scale, low, high), scale, name) for scale, name in _UNITS)
        if fill > TRAJECTORY_SETTINGS.fill:
            cause, remedy = f"the positions are probably in {name}", f"give metres: divide x and y by {scale:g}"
        yield Implausibility("trajectory", what, cause, remedy)
        return
    sampled = points[np.unique(np.linspace(0, len(points) - 1, TRAJECTORY_SETTINGS.samples).astype(int))]
    outside = _sees_no_wall(room, sampled).mean(axis=1) >= TRAJECTORY_SETTINGS.open_rays
    if outside.mean() >= TRAJECTORY_SETTINGS.outside and _is_closed(room, low, high):
        x, y = sampled[int(np.argmax(outside))]
        what = f"{outside.mean():.0%} of the poses are outside of the room, the first at ({x:.4g}, {y:.4g})"
        cause = "room and trajectory probably have different origins or axes"
        yield Implausibility("trajectory", what, cause, "give both in one frame, in metres")


def _fill(points: Float[np.ndarray, "poses 2"], low: Float[np.ndarray, " 2"], high: Float[np.ndarray, " 2"]) -> float:
    """Size of a trajectory relative to a room that holds most of it; 0 for a room that does not."""
    inside = ((points >= low) & (points <= high)).all(axis=1).mean()
    return float(np.ptp(points, axis=0).max() / (high - low).max()) if inside >= TRAJECTORY_SETTINGS.inside else 0.0


def _is_closed(room: Room, low: Float[np.ndarray, " 2"], high: Float[np.ndarray, " 2"]) -> bool:
    """Whether walls enclose a part of a room."""
    sides = [np.linspace(low[k], high[k], TRAJECTORY_SETTINGS.grid + 2)[1:-1] for k in range(2)]
    places = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    return float((~_sees_no_wall(room, places)).all(axis=1).mean()) >= TRAJECTORY_SETTINGS.closed


def _sees_no_wall(room: Room, points: Float[np.ndarray, "places 2"]) -> Bool[np.ndarray, "places rays"]:
    """For each place and direction, whether there is no wall."""
    way = unit_vector(np.arange(TRAJECTORY_SETTINGS.rays) * 2 * np.pi / TRAJECTORY_SETTINGS.rays + 0.01)
    seen = np.zeros((len(points), TRAJECTORY_SETTINGS.rays), bool)
    for k, point in enumerate(points):
        distance, share = crossings(np.stack([np.broadcast_to(point, way.shape), point + way], axis=1), room.walls)
        seen[k] = ((distance > 0) & (share >= 0) & (share <= 1)).any(axis=1)  # False for NaN, a parallel wall
    return ~seen
