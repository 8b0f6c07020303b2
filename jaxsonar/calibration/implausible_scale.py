"""A probable mistake: ranges of a ring that do not go with the motion of the robot."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from jaxsonar.calibration.closing_tracks import estimate_scale
from jaxsonar.plausibility.implausibility import Implausibility
from jaxsonar.registration.wall_readings import fresh_readings
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class ImplausibleScaleSettings:
    """When the scale of the ranges is a probable mistake; chosen by hand."""

    least: float = 0.025
    """Least scale error; odometry may be wrong by less."""
    sigmas: float = 4.0
    """Least scale error, standard deviations."""


SETTINGS = ImplausibleScaleSettings()


def implausible_scale(ring: Ring, log: Log) -> Iterator[Implausibility]:
    """A statement about ranges that change more or less than the robot moves towards targets, if they do.

    Args:
        ring: the sensors.
        log: scans with poses or odometry.
    """
    found = estimate_scale(ring, [fresh_readings(ring, log)])
    error = float(np.expm1(found.log_scale))
    if abs(found.log_scale) < max(SETTINGS.least, SETTINGS.sigmas * found.sd):
        return
    size, more = ("long", "more") if error > 0 else ("short", "less")
    changes = f"by {100 * abs(error):.1f} +- {100 * found.sd:.1f} % {more} than the robot moves ({found.tracks} tracks)"
    what = f"while sensors approach something, their ranges change {changes}"
    cause = f"the ranges are too {size}: another speed of sound or clock than the ring's, or the odometry is wrong"
    speed = float(ring.speed_of_sound) * float(np.exp(-found.log_scale))
    remedy = f"calibrate the ring, or set its speed_of_sound to {speed:.1f} m/s"
    yield Implausibility("range scale", what, cause, remedy)
