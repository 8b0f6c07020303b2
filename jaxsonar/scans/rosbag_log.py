"""Scans from bags of ROS 1 and ROS 2, without a ROS installation (extra ``ros``).

ROS has no message type for cross echoes. These messages are read: ``sensor_msgs/Range``, one direct echo each, and
``nav_msgs/Odometry``.

- The sensor index is the number at the end of ``header.frame_id`` or, if it has none, of the topic: ``sonar_7`` is
  sensor 7 of the ring.
- ``range`` is a half path length at 343.2 m/s. A value that is not finite, less than ``min_range``, or not less than
  ``max_range`` means no echo (REP 117, and older drivers).
- A scan ends before the second message of any sensor. Its stamp is that of its last message, and its pose is the latest
  odometry before that message.
"""

import math
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxsonar.fileio.atomic_files import reason, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.scan_log import Scan

RANGE, ODOMETRY = "sensor_msgs/msg/Range", "nav_msgs/msg/Odometry"


def read_bag_scans(filename: str | os.PathLike[str], *, name: str) -> Iterator[Scan]:
    """The scans of a bag in order, numbered from 0.

    Args:
        filename: ``.bag``, ``.db3``, ``.mcap``, or the folder of a ROS 2 bag.
        name: name of the bag in error messages.

    Raises:
        SonarError: the bag cannot be read or contains no ranges, a sensor index is missing, or the extra is missing.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise SonarError(f"{shown(name)}: bags need the extra ros: pip install 'jaxsonar[ros]'") from None
    try:
        with AnyReader([Path(filename)], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
            yield from _scans(bag, name)
    except SonarError:
        raise
    except Exception as failure:  # the library and its databases raise many types for invalid bags
        raise SonarError(f"{shown(name)}: {reason(failure)}; needed is a whole bag") from None


def _scans(bag: Any, name: str) -> Iterator[Scan]:
    """The scans of an open bag."""
    wanted = [connection for connection in bag.connections if connection.msgtype in (RANGE, ODOMETRY)]
    if not any(connection.msgtype == RANGE for connection in wanted):
        held = ", ".join(sorted({connection.msgtype for connection in bag.connections})) or "nothing"
        raise SonarError(f"{shown(name)}: {shown(held)} came; needed are messages {RANGE}")
    latest = pose = np.full(3, np.nan)
    number, stamp, ranges = 0, 0.0, dict[int, float]()
    for connection, time_ns, data in bag.messages(connections=wanted):
        message = bag.deserialize(data, connection.msgtype)
        if connection.msgtype == ODOMETRY:
            latest = _pose(message.pose.pose)
            continue
        sensor = _sensor(message.header.frame_id, connection.topic, name)
        if sensor in ranges:
            yield _scan(number, stamp, pose, ranges)
            number, ranges = number + 1, {}
        pose, stamp = latest, _stamp(message.header.stamp) or time_ns * 1e-9
        ranges[sensor] = _range(message)
    if ranges:
        yield _scan(number, stamp, pose, ranges)


def _scan(number: int, stamp: float, pose: np.ndarray, ranges: dict[int, float]) -> Scan:
    """A scan of direct echoes from the range of each sensor; NaN is no echo."""
    sensor = np.array([k for k, distance in ranges.items() if not math.isnan(distance)], dtype=np.int64)
    distance = np.array([distance for distance in ranges.values() if not math.isnan(distance)])
    return Scan(number, stamp, pose, sensor, sensor, distance, np.full(len(sensor), np.nan))


def _sensor(frame: str, topic: str, name: str) -> int:
    """Sensor index from the frame or the topic."""
    for text in (frame, topic):
        if found := re.search(r"(\d{1,9})\D*$", text):
            return int(found[1])
    came = f"frame_id '{shown(frame, 40)}' on topic '{shown(topic, 40)}' came"
    raise SonarError(f"{shown(name)}: {came}; needed is the sensor's number at the end of either")


def _range(message: Any) -> float:
    """Half path length, metres; NaN for no echo."""
    valid = math.isfinite(message.range) and message.range > 0 and message.min_range <= message.range
    return float(message.range) if valid and message.range < message.max_range else math.nan


def _stamp(stamp: Any) -> float:
    """Seconds of a ROS time."""
    return stamp.sec + stamp.nanosec * 1e-9


def _pose(pose: Any) -> np.ndarray:
    """x, y (m) and theta (rad) of a pose in space; NaN if it is not finite."""
    q = pose.orientation
    theta = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
    planar = np.array([pose.position.x, pose.position.y, theta])
    return planar if np.isfinite(planar).all() else np.full(3, np.nan)
