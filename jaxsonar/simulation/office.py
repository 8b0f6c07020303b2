"""The embedded office: a room of our own in the spirit of the paper's figures, and 17 poses in it (section 5)."""

from importlib.resources import as_file, files
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsonar.floor_plans.room import Room
from jaxsonar.floor_plans.room_geojson import load_room
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_toml import load_ring
from jaxsonar.simulation.poses_csv import load_poses


class Office(NamedTuple):
    """The room, the robot's way through it, and the paper's ring."""

    ring: Ring
    room: Room
    poses: Float[np.ndarray, "17 3"]
    """world_from_robot (x, y, theta); steps of 0.25, 0.30 and 0.50 m."""
    stamps: Float[np.ndarray, " 17"]
    """Seconds."""


def load_office() -> Office:
    """The office as it is shipped: walls up to 2 m from the first pose, recesses, and a chair back-rest."""
    folder = files("jaxsonar") / "data"
    with as_file(folder / "office.geojson") as room, as_file(folder / "office-path.csv") as path:
        return Office(load_ring("faw"), load_room(room), *load_poses(path))
