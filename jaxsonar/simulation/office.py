"""The embedded office: a floor plan similar to the paper's figures, with 17 poses (section 5)."""

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
    """The paper's ring, the room, and the trajectory of the robot."""

    ring: Ring
    room: Room
    poses: Float[np.ndarray, "17 3"]
    """world_from_robot (x, y, theta); steps of 0.25, 0.30 and 0.50 m."""
    stamps: Float[np.ndarray, " 17"]
    """Seconds."""


def load_office() -> Office:
    """Load the office from the package: walls within 2 m of the first pose, recesses, and a chair back-rest."""
    folder = files("jaxsonar") / "data"
    with as_file(folder / "office.geojson") as room, as_file(folder / "office-path.csv") as path:
        return Office(load_ring("faw"), load_room(room), *load_poses(path))
