"""A floor plan as a global map, for localization in a known building."""

import numpy as np

from jaxsonar.floor_plans.room import Room, walls_in_robot_frame
from jaxsonar.mapping.global_map import GlobalMap

_SD = 1e-6
"""Standard deviation of the walls of a floor plan, metres and radians; a plan counts as exact. Chosen by hand."""
_ECHOES = 1000
"""Number of echoes that is attributed to each wall, so that none counts as uncertain. Chosen by hand."""


def map_from_room(room: Room) -> GlobalMap:
    """The walls of a floor plan as a global map. Poles are left out."""
    rho, theta = walls_in_robot_frame(room, np.zeros(3))
    count = len(room.walls)
    sd = np.full(count, _SD)
    return GlobalMap(np.array(room.walls), rho, theta, sd, sd, np.full(count, _ECHOES), ((0, 1),) * count)
