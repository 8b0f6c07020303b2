"""Rings for tests."""

import numpy as np

from jaxsonar import Ring


def bumper_ring(beam_deg: float | list[float] = 70.0, *, calibrated=True, **more):
    """Four sensors at the front of a robot, all of which hear each other.

    With ``calibrated`` they have range offsets and a speed of sound other than the reference.
    """
    if calibrated:
        more = {"range_offset": [0.01, -0.02, 0.03, 0.0], "speed_of_sound": 340.0} | more
    position, heading = [(0.6, -0.3), (0.65, -0.1), (0.65, 0.1), (0.6, 0.3)], np.radians([-15.0, -5.0, 5.0, 15.0])
    return Ring(position, heading, beam=np.radians(beam_deg), neighbors=3, max_range=2.5, **more)
