"""Where simulated echoes were reflected: the parts of walls that a ring truly heard."""

import numpy as np
from jaxtyping import Float

from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.se2 import transform_points
from jaxsonar.sensors.ring import Ring
from jaxsonar.simulation.simulator import Simulation
from jaxsonar.simulation.traced_echoes import EchoKind


def wall_reflection_points(
    ring: Ring, room: Room, poses: Float[np.ndarray, "scans 3"], simulation: Simulation
) -> Float[np.ndarray, "points 2"]:
    """Points of walls at which echoes of one reflection were reflected, world frame, metres.

    Args:
        ring: the sensors.
        room: the reflectors.
        poses: world_from_robot of the scans, metres and radians.
        simulation: their echoes.
    """
    echo = np.flatnonzero(simulation.kind == EchoKind.PLANE)
    ends = transform_points(
        poses[simulation.scan[echo], None], np.asarray(ring.position)[ring.paths[simulation.path[echo]]]
    )
    wall = room.walls[simulation.reflector[echo]]
    along = wall[:, 1] - wall[:, 0]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=-1) / np.linalg.norm(along, axis=-1, keepdims=True)
    height = ((ends - wall[:, :1]) * normal[:, None]).sum(-1)
    foot = ends - height[..., None] * normal[:, None]
    fraction = np.abs(height[:, 0]) / np.maximum(np.abs(height).sum(axis=1), 1e-12)
    return foot[:, 0] + fraction[:, None] * (foot[:, 1] - foot[:, 0])
