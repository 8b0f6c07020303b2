"""trials."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsonar import Log, Ring, Room, random_pose, random_room, simulate
from jaxsonar.geometry.se2 import compose, relative, wrap_angle
from jaxsonar.geometry.segments import point_to_segments
from jaxsonar.simulation.office import load_office
from jaxsonar.simulation.simulator import Simulation
from jaxsonar.simulation.traced_echoes import EchoKind

SIGMA = 0.001
"""Metres; noise of the ranges."""

SCANS = 25
"""Of a path; steps and clearance as below."""

STEP = 0.2, 0.4
"""Metres."""

CLEARANCE = 0.45
"""Metres from the robot's centre to anything."""

FIRST_ORDER = (EchoKind.PLANE, EchoKind.CORNER, EchoKind.EDGE, EchoKind.POLE)


@dataclass(frozen=True)
class Condition:
    """What is wrong with the ring, with its echoes, and what is known of the poses."""

    name: str
    offset: float = 0.005
    """Standard deviation of the range offsets, metres."""
    extra: float = 0.0
    """Metres by which two sensors are off besides, one either way."""
    speed: float = 0.01
    """By which the speed of sound is off, either way, relative."""
    poses: str = "trust"
    odometry: float | None = None
    """Share that odometry is wrong by; None: no odometry."""
    false: float = 0.0
    """False echoes for each true one."""
    lost: float = 0.0
    """Share of the echoes that are lost."""


CONDITIONS = (
    Condition("poses known"),
    Condition("poses estimated, no odometry", poses="estimate"),
    Condition("poses estimated, 2 % odometry", poses="estimate", odometry=0.02),
    Condition("hard start: 2 %, 20 mm, poses known", offset=0.003, extra=0.02, speed=0.02),
    Condition("20 % false, 10 % lost, poses known", false=0.2, lost=0.1),
)


class Trial(NamedTuple):
    """One ring in one room."""

    nominal: Ring
    true: Ring
    room: Room
    poses: Float[np.ndarray, "scans 3"]
    heard: Simulation
    log: Log


def trial(condition: Condition, seed: int, place: str) -> Trial:
    """A ring as the condition says, and what it hears in the office or in a random room of its own.

    Rooms, paths and signs are the same under all conditions.
    """
    for_room, for_ring, for_odometry = np.random.default_rng(seed).spawn(3)
    office = load_office()
    room, poses = office.room, office.poses
    if place != "office":
        room = random_room(for_room)
        poses = path_in(room, for_room, SCANS)
    count = office.ring.count
    offset = condition.offset * for_ring.standard_normal(count)
    offset[for_ring.choice(count, 2, replace=False)] += condition.extra * np.array([1.0, -1.0])
    speed = float(office.ring.speed_of_sound) * (1 + condition.speed * for_ring.choice([-1.0, 1.0]))
    true = replace(office.ring, range_offset=offset, speed_of_sound=speed)
    heard = simulate(true, room, poses, sigma=SIGMA, clutter=condition.false, dropout=condition.lost, seed=seed)
    given = poses
    if condition.poses == "estimate":
        odometry = condition.odometry
        given = np.full_like(poses, np.nan) if odometry is None else slipped(poses, odometry, for_odometry)
    return Trial(office.ring, true, room, poses, heard, heard.as_log(true, given))


def path_in(room: Room, rng: np.random.Generator, count: int) -> Float[np.ndarray, "scans 3"]:
    """A smooth way through the free space of a room, metres and radians; it turns more sharply where it has to."""
    poses = [random_pose(rng, room, clearance=CLEARANCE)]
    while len(poses) < count:
        sharp = np.repeat([0.3, 1.0, 3.0], 64)
        heading = poses[-1][2] + sharp * rng.standard_normal(len(sharp))
        ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        to = poses[-1][:2] + rng.uniform(*STEP, len(sharp))[:, None] * ahead
        # No step is long enough to pass through a wall that both of its ends are clear of.
        clear = (point_to_segments(to, room.walls) >= CLEARANCE).all(axis=1)
        clear &= (np.linalg.norm(to[:, None] - room.poles, axis=-1) >= CLEARANCE).all(axis=1)
        if not clear.any():
            poses = [random_pose(rng, room, clearance=CLEARANCE)]  # a nook: begin elsewhere
            continue
        first = int(np.argmax(clear))
        poses.append(np.append(to[first], wrap_angle(heading[first])))
    return np.array(poses)


def slipped(
    poses: Float[np.ndarray, "scans 3"], share: float, rng: np.random.Generator
) -> Float[np.ndarray, "scans 3"]:
    """Poses by odometry: every component of every step wrong by this share (one standard deviation), chained."""
    steps = relative(poses[:-1], poses[1:])
    steps *= 1 + share * rng.standard_normal(steps.shape)
    out = [poses[0]]
    for step in steps:
        out.append(compose(out[-1], step))
    return np.array(out)
