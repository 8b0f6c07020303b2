"""Inputs of the calibration benchmark: rings with errors, and their echoes in the office or in random rooms."""

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
"""Range noise, metres."""

SCANS = 25
"""Number of scans in a random room."""

STEP = 0.2, 0.4
"""Minimum and maximum distance between scans, metres."""

CLEARANCE = 0.45
"""Minimum distance from the center of the robot candidates walls and poles, metres."""

FIRST_ORDER = (EchoKind.PLANE, EchoKind.CORNER, EchoKind.EDGE, EchoKind.POLE)
"""Kinds of first-order echoes."""


@dataclass(frozen=True)
class Condition:
    """Errors of the ring and of its echoes, and knowledge of the poses."""

    name: str
    offset: float = 0.005
    """Standard deviation of the range offsets, metres."""
    extra: float = 0.0
    """Additional offset of two sensors, one positive and one negative, metres."""
    speed: float = 0.01
    """Relative error of the speed of sound, of random sign."""
    poses: str = "trust"
    """``trust`` or ``estimate``, as in ``calibrate``."""
    odometry: float | None = None
    """Relative error of the odometry; None: no odometry."""
    false: float = 0.0
    """False echoes per true echo."""
    lost: float = 0.0
    """Probability that an echo is lost."""
    beams: str = "soft"
    """As in ``simulate``."""


CONDITIONS = (
    Condition("poses known"),
    Condition("poses estimated, no odometry", poses="estimate", beams="hard"),
    Condition("poses estimated, 2 % odometry", poses="estimate", odometry=0.02, beams="hard"),
    Condition("hard start: 2 %, 20 mm, poses known", offset=0.003, extra=0.02, speed=0.02),
    Condition("20 % false, 10 % lost, poses known", false=0.2, lost=0.1),
)


class Trial(NamedTuple):
    """One ring in one room: nominal and true ring, true poses, simulated echoes, log."""

    nominal: Ring
    true: Ring
    room: Room
    poses: Float[np.ndarray, "scans 3"]
    simulation: Simulation
    log: Log


def trial(condition: Condition, seed: int, place: str) -> Trial:
    """Simulate a ring with the errors of a condition, in the office or in a random room.

    Rooms, trajectories and signs are the same in all conditions.
    """
    for_room, for_ring, for_odometry = np.random.default_rng(seed).spawn(3)
    office = load_office()
    room, poses = office.room, office.poses
    if place != "office":
        room = random_room(for_room)
        poses = trajectory_in(room, for_room, SCANS)
    count = office.ring.count
    offset = condition.offset * for_ring.standard_normal(count)
    offset[for_ring.choice(count, 2, replace=False)] += condition.extra * np.array([1.0, -1.0])
    speed = float(office.ring.speed_of_sound) * (1 + condition.speed * for_ring.choice([-1.0, 1.0]))
    true = replace(office.ring, range_offset=offset, speed_of_sound=speed)
    simulation = simulate(
        true,
        room,
        poses,
        sigma=SIGMA,
        clutter=condition.false,
        dropout=condition.lost,
        seed=seed,
        beams=condition.beams,
    )
    given = poses
    if condition.poses == "estimate":
        odometry = condition.odometry
        given = np.full_like(poses, np.nan) if odometry is None else noisy_odometry(poses, odometry, for_odometry)
    return Trial(office.ring, true, room, poses, simulation, simulation.as_log(true, given))


def trajectory_in(room: Room, rng: np.random.Generator, count: int) -> Float[np.ndarray, "scans 3"]:
    """A smooth trajectory through the free space of a room, metres and radians, with sharper turns where needed."""
    poses = [random_pose(rng, room, clearance=CLEARANCE)]
    while len(poses) < count:
        curvature = np.repeat([0.3, 1.0, 3.0], 64)
        heading = poses[-1][2] + curvature * rng.standard_normal(len(curvature))
        direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        candidates = poses[-1][:2] + rng.uniform(*STEP, len(curvature))[:, None] * direction
        # Steps are too short candidates pass through a wall if both ends keep the clearance.
        clear = (point_to_segments(candidates, room.walls) >= CLEARANCE).all(axis=1)
        clear &= (np.linalg.norm(candidates[:, None] - room.poles, axis=-1) >= CLEARANCE).all(axis=1)
        if not clear.any():
            poses = [random_pose(rng, room, clearance=CLEARANCE)]  # a dead end: start somewhere else
            continue
        first = int(np.argmax(clear))
        poses.append(np.append(candidates[first], wrap_angle(heading[first])))
    return np.array(poses)


def noisy_odometry(
    poses: Float[np.ndarray, "scans 3"], share: float, rng: np.random.Generator
) -> Float[np.ndarray, "scans 3"]:
    """Simulated odometry: each component of each step has this relative error (one standard deviation)."""
    steps = relative(poses[:-1], poses[1:])
    steps *= 1 + share * rng.standard_normal(steps.shape)
    out = [poses[0]]
    for step in steps:
        out.append(compose(out[-1], step))
    return np.array(out)
