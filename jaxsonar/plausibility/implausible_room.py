"""Probable mistakes of a floor plan: millimetres, centimetres, degrees of longitude and latitude."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.segments import lengths
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


SETTINGS = RoomSettings()


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
    if size > SETTINGS.large and wall > SETTINGS.long_wall:
        unit = "millimetres" if wall > SETTINGS.millimetres else "centimetres"
        scale = 1000 if unit == "millimetres" else 100
        cause = f"its coordinates are probably {unit}"
        yield Implausibility("room unit", what, cause, f"give metres: divide the coordinates by {scale}")
    if size < SETTINGS.tiny:
        x, y = ends[0]
        if abs(x) <= 180 and abs(y) <= 90 and np.abs(ends[0]).max() > 10 * size:
            what = f"the room is {width:.2g} m x {depth:.2g} m at ({x:.6g}, {y:.6g})"
            cause = "its coordinates are probably degrees of longitude and latitude"
            remedy = "project it to a plane in metres"
        else:
            cause, remedy = "its coordinates are probably kilometres, or degrees", "give metres"
        yield Implausibility("room unit", what, cause, remedy)
