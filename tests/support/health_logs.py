"""Logs of random rooms for the health check, with simulated faults of the ring.

All logs have at most 32 scans, so that few programs are compiled.
"""

import dataclasses
import json

import numpy as np
from support.hard_cones import simulate

from jaxsonar import Log, Ring, random_pose, random_room

RING = Ring.circular()
SIGMA = 0.002
"""Standard deviation of the range noise, metres."""


def log_of(seed, ring=RING, scans=24):
    """Scans of a random room without poses, by the true ring."""
    rng = np.random.default_rng(seed)
    room = random_room(rng)
    poses = np.array([random_pose(rng, room) for _ in range(scans)])
    came = simulate(ring, room, poses, sigma=SIGMA, dropout=0.1, clutter=0.1, seed=seed)
    return came.as_log(ring, np.full((scans, 3), np.nan))


def renumbered(log, place):
    """The log with other sensor numbers: sensor k becomes ``place[k]``."""
    return dataclasses.replace(log, tx=place[log.tx], rx=place[log.rx], asked=place[log.asked])


def only(log, kept):
    """The log with the selected echoes only."""
    return Log.from_echoes(
        log.echo_scan[kept], log.tx[kept], log.rx[kept], log.range[kept], stamp=log.stamp, pose=log.pose
    )


def written(health):
    """The result of the health check after writing it as JSON and reading it again."""
    return json.loads(json.dumps(health.as_json(), allow_nan=False))
