"""Logs of a robot that drives and turns through a random room, and the mistakes that people make in such logs."""

from dataclasses import replace
from functools import cache

import numpy as np
from support.hard_cones import simulate

from jaxsonar import Ring, random_pose, random_room
from jaxsonar.geometry.segments import point_to_segments
from jaxsonar.simulation.wheel_odometry import simulate_odometry

CLEARANCE = 0.4
"""Distance of the robot's center from walls, metres."""


def drive(rng, room, scans, *, step=0.05):
    """Poses of a robot that drives on wavy lines and turns in place before a wall."""
    poses, curve, side = [random_pose(rng, room)], 0.0, 1.0
    while len(poses) < scans:
        x, y, theta = poses[-1]
        curve = 0.8 * curve + 0.06 * rng.standard_normal()
        theta_next = theta + np.clip(curve, -0.2, 0.2)
        ahead = np.array([[x + step * np.cos(theta_next), y + step * np.sin(theta_next)]])
        if (point_to_segments(ahead, room.walls) > CLEARANCE).all():
            poses.append(np.array([*ahead[0], theta_next]))
        else:
            side = rng.choice([-1.0, 1.0]) if len(poses) % 7 == 0 else side
            poses.append(np.array([x, y, theta + 0.15 * side]))
    return np.array(poses)


@cache
def driven_log(seed, count, neighbors, *, scans=100, drift=True):
    """A ring and its log: random room, beam, first heading, noise, clutter and dropout."""
    rng = np.random.default_rng([seed, count])
    ring = Ring.circular(
        count=count,
        radius=rng.uniform(0.1, 0.3),
        beam=np.radians(rng.uniform(25, 60)),
        neighbors=neighbors,
        max_range=rng.uniform(2.0, 4.0),
        first_heading=rng.choice([0.0, np.pi / count]),
    )
    room = random_room(rng)
    poses = drive(rng, room, scans)
    errors = {"sigma": rng.choice([0.001, 0.003, 0.01]), "clutter": rng.choice([0.0, 0.2]), "dropout": 0.1}
    odometry = simulate_odometry(poses, distance=0.02, turn=0.02, seed=seed) if drift else poses
    return ring, simulate(ring, room, poses, seed=seed, **errors).as_log(ring, odometry)


def with_poses(log, change):
    """The log with other poses; ``change`` is given x, y and theta and returns the new ones."""
    return replace(log, pose=np.stack(change(*log.pose.T), axis=-1))


def numbered(ring, log, sign, shift):
    """The log with sensor k renumbered as sign k + shift, modulo the number of sensors."""
    order = (sign * np.arange(ring.count) + shift) % ring.count
    return replace(log, tx=order[log.tx], rx=order[log.rx], asked=order[log.asked])


def from_one(log):
    """The log with sensors that are counted from 1."""
    return replace(log, tx=log.tx + 1, rx=log.rx + 1, asked=log.asked + 1)
