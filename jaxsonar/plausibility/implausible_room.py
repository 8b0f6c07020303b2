"""Probable mistakes of a floor plan and of a trajectory through it.

A floor plan: millimetres, centimetres, degrees of longitude and latitude. A trajectory: headings in degrees or
clockwise, positions in millimetres or outside of the room.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.se2 import unit
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
    tiny: float = 0.1
    """No room is smaller than this, metres."""


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


TRAJECTORY_SETTINGS = TrajectorySettings()

_UNITS = ((1000.0, "millimetres"), (100.0, "centimetres"))


def implausible_room(room: Room) -> Iterator[Implausibility]:
    """Probable mistakes of a floor plan.

    Args:
        room: walls and poles, world frame, metres.
    """
    if not len(room.walls):
        return
    ends = room.walls.reshape(-1, 2)
    width, depth = np.ptp(ends, axis=0)
    size = max(width, depth)
    what = f"the room is {width:.4g} m x {depth:.4g} m"
    wall = float(np.median(lengths(room.walls)))
    if size > ROOM_SETTINGS.large and wall > ROOM_SETTINGS.long_wall:
        unit = "millimetres" if wall > ROOM_SETTINGS.millimetres else "centimetres"
        scale = 1000 if unit == "millimetres" else 100
        cause = f"its coordinates are probably {unit}"
        yield Implausibility("room unit", what, cause, f"give metres: divide the coordinates by {scale}")
    if size < ROOM_SETTINGS.tiny:
        x, y = ends[0]
        if abs(x) <= 180 and abs(y) <= 90 and np.abs(ends[0]).max() > 10 * size:
            what = f"the room is {width:.2g} m x {depth:.2g} m at ({x:.6g}, {y:.6g})"
            cause = "its coordinates are probably degrees of longitude and latitude"
            remedy = "project it to a plane in metres"
        else:
            cause, remedy = "its coordinates are probably kilometres, or degrees", "give metres"
        yield Implausibility("room unit", what, cause, remedy)


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
    """Headings in degrees, or clockwise."""
    heading, step = poses[:, 2], np.diff(poses[:, :2], axis=0)
    drives = np.hypot(*step.T) > TRAJECTORY_SETTINGS.step
    direction = np.arctan2(step[:, 1], step[:, 0])[drives]
    middle = heading[:-1][drives] + np.diff(heading)[drives] / 2
    turns = float(np.abs(np.diff(heading)).max(initial=0.0))
    as_given, degrees, clockwise = (_agreement(direction - one) for one in (middle, np.radians(middle), -middle))
    enough = len(direction) >= TRAJECTORY_SETTINGS.steps and as_given < TRAJECTORY_SETTINGS.differs
    if turns > 2 * np.pi + 0.1 or (enough and degrees > TRAJECTORY_SETTINGS.agrees):
        if turns > 2 * np.pi + 0.1:
            what = f"the heading changes by up to {turns:.4g} rad from pose to pose"
        else:
            what = "the headings in radians do not agree with the motion of the robot, those in degrees do"
        yield Implausibility(
            "heading unit", what, "the headings are probably in degrees", "give radians, counter-clockwise from x"
        )
    elif enough and clockwise > TRAJECTORY_SETTINGS.agrees:
        what = "the headings do not agree with the motion of the robot, those turned the other way do"
        cause = "the headings probably grow clockwise"
        yield Implausibility("heading direction", what, cause, "give radians, counter-clockwise from x")


def _agreement(angle: Float[np.ndarray, " steps"]) -> float:
    """Mean resultant length of twice these angles: 1 if the robot drives in one direction of its own, or back."""
    return float(np.abs(np.exp(2j * angle).mean())) if len(angle) else 0.0


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
    way = unit(np.arange(TRAJECTORY_SETTINGS.rays) * 2 * np.pi / TRAJECTORY_SETTINGS.rays + 0.01)
    seen = np.zeros((len(points), TRAJECTORY_SETTINGS.rays), bool)
    for k, point in enumerate(points):
        distance, share = crossings(np.stack([np.broadcast_to(point, way.shape), point + way], axis=1), room.walls)
        seen[k] = ((distance > 0) & (share >= 0) & (share <= 1)).any(axis=1)  # False for NaN, a parallel wall
    return ~seen
