"""Messages of a device: the echoes of one firing group, or the odometry pose. Wire format: ``docs/protocol.md``."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Shaped

ECHO = np.dtype(
    [("tx", "<u2"), ("rx", "<u2"), ("echo", "u1"), ("flags", "u1"), ("time_us", "<f4"), ("amplitude", "<f4")]
)
"""One echo as in a frame: 14 bytes, packed.

``tx`` is the transmitter, ``rx`` the receiver. ``echo`` numbers the echoes of this path from 0, nearest first.
``flags`` is a bit set: 1 is ring-down, 2 is saturated; other bits are 0 and ignored. ``time_us`` is the
two-way time of flight, microseconds. ``amplitude`` is in the device's own unit, NaN if it is not measured. A path
without an echo has no record.
"""

REFERENCE_SPEED_OF_SOUND = 343.2
"""Metres per second, air at 20 deg C. A log's range is half the time of flight times this, at any temperature."""


@dataclass(frozen=True, eq=False)
class Group:
    """The echoes that all sensors received after one firing group transmitted simultaneously."""

    sequence: int
    """Sequence number over all messages of a device, 0 to 2^32 - 1, wrapping to 0. A gap means loss."""
    time_us: int
    """Device clock at the moment of firing, microseconds, 64 bits."""
    scan: int
    """Number of the scan, 0 to 2^32 - 1."""
    group: int
    """Number of the group in its scan, 0 to groups - 1."""
    groups: int
    """Number of groups in a scan."""
    temperature: float
    """Air temperature, degrees Celsius; NaN if it is not measured."""
    echoes: Shaped[np.ndarray, " echoes"]
    """Array of dtype ``ECHO``."""


@dataclass(frozen=True)
class Pose:
    """Odometry pose of the robot. It holds for the groups that follow, until the next pose. Three NaN: unknown."""

    sequence: int
    """As in ``Group``; both message types share one counter."""
    time_us: int
    """Device clock, microseconds."""
    x: float
    """world_from_robot, metres."""
    y: float
    """world_from_robot, metres."""
    theta: float
    """world_from_robot, radians, counter-clockwise."""


Message = Group | Pose
"""The messages that ``Decoder.feed`` returns."""
