"""Simulated scans without odometry, and their local models."""

import numpy as np
from support.hard_cones import simulate

from jaxsonar import local_models

SIGMA = 0.005
"""Standard deviation of the range noise, metres. It is that of a sensor with a threshold, which is the hard case."""


def simulated_log(ring, room, poses, *, sigma=SIGMA, seed=0):
    """A log without odometry, and its local models."""
    log = simulate(ring, room, poses, sigma=sigma, seed=seed).as_log(ring, np.full(poses.shape, np.nan))
    return log, list(local_models(ring, log))
