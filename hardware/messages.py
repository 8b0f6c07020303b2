"""What a device says: the echoes of one firing group, or where the robot is. The records of ``docs/protocol.md``."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Shaped

ECHO = np.dtype(
    [("tx", "<u2"), ("rx", "<u2"), ("echo", "u1"), ("flags", "u1"), ("time_us", "<f4"), ("amplitude", "<f4")]
)
"""One echo as it stands in a frame, 14 bytes, packed.

``tx`` fired, ``rx`` heard; ``echo`` counts the echoes of that pair from 0, nearest first; ``flags`` see ``FLAGS``;
``time_us`` is the time of flight in microseconds, there and back; ``amplitude`` in the device's own unit, NaN where
there is none. An absent echo is an absent record.
"""

FLAGS = {"ring_down": 1, "saturated": 2}
"""Bits of an echo's ``flags``; the others are 0 and ignored."""


@dataclass(frozen=True, eq=False)
class Group:
    """What the ring heard after the sensors of one firing group fired at once."""

    sequence: int
    """Counts all messages of a sender, 0 to 2^32 - 1, then from 0 again; a gap is loss."""
    time_us: int
    """Device clock when the group fired, microseconds, 64 bits."""
    scan: int
    """Number of the scan, 0 to 2^32 - 1."""
    group: int
    """Number of the group in its scan, 0 to groups - 1."""
    groups: int
    """Groups that make a scan."""
    temperature: float
    """Of the air, degrees Celsius; NaN where it is not measured."""
    echoes: Shaped[np.ndarray, " echoes"]
    """An array of ``ECHO``."""


@dataclass(frozen=True)
class Pose:
    """Odometry of the robot: the pose of the groups that follow, until the next one; three NaN: not known any more."""

    sequence: int
    """As in ``Group``: both kinds count together."""
    time_us: int
    """Device clock, microseconds."""
    x: float
    """world_from_robot, metres."""
    y: float
    """world_from_robot, metres."""
    theta: float
    """world_from_robot, radians counter-clockwise."""


Message = Group | Pose
"""Everything that ``Decoder.feed`` returns."""
