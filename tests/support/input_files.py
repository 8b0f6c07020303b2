"""Files of other robots as inputs of commands."""

import numpy as np
from support.bags import bag_of_firings, firing_log, sonar_ring, spinning

from jaxsonar import Room, save_ring

WALLS = np.array([[[0, 0], [4, 0]], [[4, 0], [4, 3]], [[4, 3], [0, 3]], [[0, 3], [0, 0]]], np.float64)
"""A rectangular room, metres."""


def spinning_bag(path, kind, *, seconds=8.0, names="sonar_{}", transforms=False, **ring_options):
    """A bag of a robot that turns at 40 deg/s while 16 sensors fire one after another, and the file of its ring.

    With ``transforms``, it holds the places of the sensors as well.
    """
    ring = sonar_ring(16, **ring_options)
    pose_at = spinning((1.7, 1.3), np.radians(40))
    log = firing_log(ring, Room(WALLS), pose_at, np.arange(0.0, seconds, 0.025))
    bag = bag_of_firings(log, kind, names=names, pose_at=pose_at)
    for k in range(ring.count if transforms else 0):
        bag.transform(0.0, "base_link", names.format(k), (*ring.position[k], ring.heading[k]))
    file = bag.write(path)
    save_ring(ring, path.with_suffix(".toml"))
    return file, path.with_suffix(".toml")
