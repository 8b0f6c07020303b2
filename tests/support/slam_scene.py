"""A room with corners, a trajectory through it, and its log with simulated odometry, for tests of SLAM."""

from functools import cache

import numpy as np
from support.hard_cones import simulate

from jaxsonar import Ring, Room
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.simulation.wheel_odometry import simulate_odometry

RING = Ring.circular()

SIGMA = 0.002

ODOMETRY_NOISE = OdometryNoise(
    position_per_meter=0.04, heading_per_meter=float(np.radians(2.0)), heading_per_radian=0.04
)

SCAN_COUNT = 48

CORNERS = [(0, 0), (5, 0), (5, 1.7), (6.3, 1.7), (6.3, 4.1), (3.2, 4.1), (3.2, 3), (2.1, 3), (2.1, 3.6), (0, 3.6)]

ROOM = Room(np.array([[a, b] for a, b in zip(CORNERS, [*CORNERS[1:], CORNERS[0]], strict=True)], dtype=float))


def trajectory():
    """Through the room and back, in curves."""
    t = np.linspace(0.0, 1.0, SCAN_COUNT)
    place = np.column_stack([1.0 + 3.3 * np.sin(np.pi * t) ** 2, 1.6 + 0.5 * np.sin(2 * np.pi * t)])
    to = np.gradient(place, axis=0)
    return np.column_stack([place, wrap_angle(np.arctan2(to[:, 1], to[:, 0]))])


@cache
def truth():
    return trajectory()


@cache
def log(sigma=SIGMA, seed=1):
    odometry = simulate_odometry(truth(), distance=0.04, turn=float(np.radians(2.0)), seed=seed)
    return simulate(RING, ROOM, truth(), sigma=sigma, seed=seed).as_log(RING, odometry)
