"""Scenes of the diagnostics benchmark: random rooms, rings and trajectories, and their simulated logs."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar import Log, Ring, Room, random_pose, random_room, simulate
from jaxsonar.geometry.segments import point_to_segments
from jaxsonar.simulation.wheel_odometry import simulate_odometry

SCAN_PERIOD = 0.1
"""Time between scans, seconds."""
STEP = 0.03, 0.07
"""Smallest and largest distance between scans, metres: 0.3 to 0.7 m/s."""
TURN = 0.1, 0.3
"""Smallest and largest rotation between scans, radians."""
CLEARANCE = 0.45
"""Distance of the center of the robot from walls and poles, metres."""
DRIFT = 0.01, float(np.radians(0.5))
"""Errors of the odometry, standard deviations after one metre: metres and radians."""
SIGMAS = 0.001, 0.002, 0.003, 0.005, 0.01
"""Standard deviations of the ranges, metres."""
STYLES = "cross", "direct", "half rings"
"""Arrangements of sensors: wide cones that hear their neighbors, narrow cones that do not, two half circles of them."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A ring that drives through a room."""

    seed: int
    style: str
    """One of ``STYLES``."""
    ring: Ring
    room: Room
    poses: Float[np.ndarray, "scans 3"]
    """True poses world_from_robot: x, y (m), theta (rad)."""
    sigma: float
    """Standard deviation of the ranges, metres."""
    clutter: float
    """False echoes per true echo."""
    dropout: float
    """Probability that an echo is lost."""

    def log(self, ring: Ring | None = None) -> Log:
        """The log of a ring, by default of this one, with odometry; paths that heard nothing are known."""
        ring = self.ring if ring is None else ring
        errors = {"sigma": self.sigma, "clutter": self.clutter, "dropout": self.dropout, "seed": self.seed}
        most = 3 if self.style == "cross" else 1
        echoes = simulate(ring, self.room, self.poses, max_echoes=most, **errors)
        return echoes.as_log(ring, simulate_odometry(self.poses, distance=DRIFT[0], turn=DRIFT[1], seed=self.seed))


def random_scene(seed: int, *, scans: int = 240, styles: tuple[str, ...] = STYLES) -> Scene:
    """A random room, ring, trajectory and noise; the same arguments give the same scene."""
    rng = np.random.default_rng([seed, 20])
    style = styles[seed % len(styles)]
    room = random_room(rng) if rng.random() < 0.5 else corner_room(rng)
    poses = trajectory(rng, room, scans)
    errors = {"clutter": float(rng.choice([0.0, 0.05, 0.1])), "dropout": float(rng.choice([0.05, 0.1, 0.2]))}
    return Scene(seed, style, random_ring(rng, style), room, poses, float(rng.choice(SIGMAS)), **errors)


def random_ring(rng: np.random.Generator, style: str) -> Ring:
    """A random ring of a style, with 8 to 24 sensors."""
    radius = rng.uniform(0.12, 0.3)
    if style == "cross":
        count = int(rng.choice([12, 16, 24]))
        reach = {"neighbors": int(rng.integers(1, 4)), "max_range": rng.uniform(2.0, 3.0)}
        return Ring.circular(count=count, radius=radius, beam=np.radians(rng.uniform(50, 70)), **reach)
    reach = {"neighbors": 0, "max_range": rng.uniform(3.0, 5.0)}
    if style == "direct":
        count = int(rng.choice([8, 12, 16, 24]))
        return Ring.circular(count=count, radius=radius, beam=np.radians(rng.uniform(24, 45)), **reach)
    # Two half circles, the rear one farther from the center of the robot, as on many research robots.
    front = np.radians([90.0, 50.0, 30.0, 10.0, -10.0, -30.0, -50.0, -90.0])
    heading = np.concatenate([front, front[::-1] + np.pi])
    shift = np.repeat([[rng.uniform(0.0, 0.1), 0.0], [-rng.uniform(0.05, 0.15), 0.0]], 8, axis=0)
    position = radius * np.stack([np.cos(heading), np.sin(heading)], axis=-1) + shift
    return Ring(position, heading, beam=np.radians(rng.uniform(26, 36)), **reach)


def corner_room(rng: np.random.Generator) -> Room:
    """A random room with an L, T or U shape, or a corridor, in any orientation."""
    wide, deep, w = rng.uniform(4.5, 7.0), rng.uniform(4.0, 6.0), rng.uniform(1.6, 2.4)
    right = wide + 1
    a, b = sorted(rng.uniform(w, wide - w, 2)) if wide > 2 * w + 0.5 else (w, wide - w)
    b = max(b, a + 1.4)
    shapes = [
        [(0, 0), (wide, 0), (wide, w), (w, w), (w, deep), (0, deep)],
        [(0, 0), (wide + 1.4, 0), (wide + 1.4, w), (b, w), (b, deep), (a, deep), (a, w), (0, w)],
        [(0, 0), (right, 0), (right, deep), (right - w, deep), (right - w, w), (w, w), (w, deep), (0, deep)],
        [(0, 0), (wide + 2, 0), (wide + 2, w), (0, w)],
    ]
    corners = np.array(shapes[int(rng.integers(len(shapes)))], dtype=np.float64)
    angle = rng.uniform(-np.pi, np.pi)
    cos, sin = np.cos(angle), np.sin(angle)
    corners = corners @ np.array([[cos, sin], [-sin, cos]]) + rng.uniform(-2, 2, 2)
    return Room(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1))


def trajectory(rng: np.random.Generator, room: Room, scans: int) -> Float[np.ndarray, "scans 3"]:
    """A robot that turns towards a random place, drives there, and so on, with constant speeds."""
    step, turn = rng.uniform(*STEP), rng.uniform(*TURN)
    pose = random_pose(rng, room, clearance=CLEARANCE)
    poses = [pose]
    while len(poses) < scans:
        goal = _goal(rng, room, poses[-1][:2])
        x, y, theta = poses[-1]
        towards = np.arctan2(*(goal - (x, y))[::-1])
        rotation = (towards - theta + np.pi) % (2 * np.pi) - np.pi
        steps = int(np.ceil(abs(rotation) / turn))
        poses += [np.array([x, y, theta + rotation * k / steps]) for k in range(1, steps + 1)]
        distance = np.hypot(*(goal - (x, y)))
        travelled = np.arange(step, distance, step)
        heading = [np.cos(towards), np.sin(towards)]
        poses += [np.array([*((x, y) + d * np.array(heading)), theta + rotation]) for d in travelled]
    return np.array(poses[:scans])


def _goal(rng: np.random.Generator, room: Room, start: np.ndarray) -> np.ndarray:
    """A random place that the robot reaches on a straight line with the clearance."""
    while True:
        goal = random_pose(rng, room, clearance=CLEARANCE)[:2]
        along = np.linspace(0, 1, 40)[:, None] * (goal - start) + start
        if np.hypot(*(goal - start)) > 0.3 and _clear(room, along[1:]).all():
            return goal


def _clear(room: Room, points: np.ndarray) -> Bool[np.ndarray, " points"]:
    clear = (point_to_segments(points, room.walls) >= 0.98 * CLEARANCE).all(axis=1)
    return clear & (np.linalg.norm(points[:, None] - room.poles, axis=-1) >= 0.98 * CLEARANCE).all(axis=1)


def with_geometry(ring: Ring, position: Float[np.ndarray, "sensors 2"], heading: Float[np.ndarray, " sensors"]) -> Ring:
    """The ring with its sensors elsewhere."""
    return replace(ring, position=position, heading=heading)
