"""Probable mistakes of a floor plan: millimetres, centimetres, degrees of longitude and latitude."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from jaxsonar.floor_plans.room import Room
from jaxsonar.plausibility.implausibility import Implausibility


@dataclass(frozen=True)
class RoomSettings:
    """When the coordinates of a room are no metres. Chosen by hand."""

    long_wall: float = 40.0
    """Most walls are shorter than this, metres: the quantile ``quantile``."""
    quantile: float = 0.2
    """Quantile of the lengths of the walls that is compared. Only the shortest walls are below it."""
    large: float = 100.0
    """Smaller rooms than this, metres, may have long walls only."""
    shortest_wall: float = 0.15
    """The same quantile in the right unit is above this value, metres."""
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
    wall = float(np.quantile(np.linalg.norm(room.walls[:, 1] - room.walls[:, 0], axis=-1), SETTINGS.quantile))
    if size > SETTINGS.large and wall > SETTINGS.long_wall:
        unit = "millimetres" if wall / 1000 > SETTINGS.shortest_wall else "centimetres"
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
