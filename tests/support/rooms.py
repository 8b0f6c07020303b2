"""Rooms and poses for tests of the simulator."""

import numpy as np

from jaxsonar import random_pose, random_room


def loop(points):
    """Walls between consecutive corners of a closed polygon."""
    points = np.array(points, dtype=np.float64)
    return np.stack([points, np.roll(points, -1, axis=0)], axis=1)


def turned(points, angle, at=(0.0, 0.0)):
    """Points after a rotation about the origin and a translation."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray(points) @ np.array([[cos, sin], [-sin, cos]]) + at


def room_of_exact_angles(rng, **parts):
    """A random room whose right-angled corners are exact; nearly right-angled ones count as right-angled."""
    while True:
        room = random_room(rng, **parts)
        widths = room.junctions.wedge_width[room.junctions.corners]
        if np.allclose(widths, np.pi / 2, atol=1e-9):
            return room


def places(rng, room, count, clearance=0.1):
    """Random positions inside a room."""
    return np.array([random_pose(rng, room, clearance=clearance)[:2] for _ in range(count)])


def some_poses(rng, room, count):
    """Random poses inside a room."""
    return np.array([random_pose(rng, room) for _ in range(count)])
