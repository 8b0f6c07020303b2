"""Odometry with heading slips: repaired before the adjustment, and uncertain where it slipped."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.estimation.odometry_noise import OdometryNoiseModel
from jaxsonar.geometry.se2 import compose
from jaxsonar.registration.heading_slips import HeadingSlip, find_heading_slips, slip_transform
from jaxsonar.registration.wall_readings import distance_travelled
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class SlippedOdometrySettings:
    """Constants of the noise of slips; chosen by hand."""

    reach: float = 0.05
    """Metres before and after a slip in which it may have happened, as a whole or in parts."""


SETTINGS = SlippedOdometrySettings()


@dataclass(frozen=True)
class SlippedOdometryNoise:
    """Noise model (``OdometryNoiseModel``) of odometry with repaired slips.

    The steps around a slip have its angle as standard deviation together.
    """

    noise: OdometryNoiseModel
    """Of all other steps."""
    slips: tuple[HeadingSlip, ...]

    def __call__(
        self, measured: Float[np.ndarray, "scans 3"], rows: Int[np.ndarray, " rows"]
    ) -> Float[np.ndarray, "_ 3"]:
        """See ``OdometryNoiseModel``."""
        sd = self.noise(measured, rows).copy()
        travelled = distance_travelled(measured)
        for slip in self.slips:
            near = (rows[:-1] <= slip.row) & (slip.row < rows[1:])
            near |= np.abs(travelled[rows[1:]] - travelled[slip.row]) <= SETTINGS.reach
            sd[near, 2] = np.hypot(sd[near, 2], abs(slip.angle) / np.sqrt(max(near.sum(), 1)))
        return sd


def repair_heading_slips(ring: Ring, log: Log) -> tuple[Log, tuple[HeadingSlip, ...]]:
    """The log with the poses after each heading slip turned about the place of the slip, and the slips.

    Args:
        ring: the sensors.
        log: full scans; their poses are odometry.
    """
    slips = find_heading_slips(ring, log)
    for slip in slips:
        moved = slip_transform(log.pose, slip)
        pose, samples = log.pose.copy(), log.odometry
        if samples is not None:
            samples = samples.copy()
            later = samples[:, 0] > np.nanmax(log.stamp[: slip.row + 1], initial=-np.inf)
            samples[later, 1:] = compose(moved, samples[later, 1:])
        pose[slip.row + 1 :] = compose(moved, pose[slip.row + 1 :])
        log = replace(log, pose=pose, odometry=samples)
    return log, slips
