"""A floor plan as a global map, for localization in a known building."""

import numpy as np

from jaxsonar.floor_plans.room import Room, walls_in_robot_frame
from jaxsonar.mapping.global_map import GlobalMap

_SD = 1e-6
"""Standard deviation of the walls of a floor plan, metres and radians; a plan counts as exact. Chosen by hand."""
_ECHOES = 1000
"""Number of echoes that is attributed to each wall, so that none counts as uncertain. Chosen by hand."""


def map_from_room(room: Room) -> GlobalMap:
    """The walls, poles (as edges) and circles of a floor plan as a global map."""
    rho, theta = walls_in_robot_frame(room, np.zeros(3))
    count = len(room.walls)
    sd = np.full(count, _SD)
    walls = GlobalMap(np.array(room.walls), rho, theta, sd, sd, np.full(count, _ECHOES), ((0, 1),) * count)
    points = np.concatenate([room.poles, room.circles[:, :2]])
    of_circles = np.append(np.zeros(len(room.poles), dtype=bool), np.ones(len(room.circles), dtype=bool))
    covariance = np.tile(np.eye(3) * _SD**2, (len(points), 1, 1))
    return walls.with_points(
        points,
        point_kinds=tuple(np.where(of_circles, "circle", "edge").tolist()),
        point_cov=covariance[:, :2, :2],
        point_echoes=np.full(len(points), _ECHOES),
        point_radius=np.append(np.full(len(room.poles), np.nan), room.circles[:, 2]),
        point_circle_cov=np.where(of_circles[:, None, None], covariance, np.nan),
    )
