"""Scans from ROS bags, ROS 1 and 2, without ROS (extra ``ros``).

There is no message for what a ring hears, so this is what is read: ``sensor_msgs/Range``, one direct echo each, and
``nav_msgs/Odometry``.

- The sensor is the number at the end of ``header.frame_id`` or, without one there, of the topic: ``sonar_7`` is
  sensor 7 of the ring.
- ``range`` counts as a half path length at 343.2 m/s. What is not finite, or not within ``min_range`` and below
  ``max_range``, is no echo (REP 117, and drivers older than it).
- A scan ends where a sensor speaks that has spoken in it already. Its stamp is that of its last message; its pose is
  the latest odometry before that.
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


def bag_scans(path: str | os.PathLike[str], *, name: str) -> Iterator[Scan]:
    """The scans of a bag, one after another, numbered from 0.

    Args:
        path: ``.bag``, ``.db3``, ``.mcap``, or the folder of a ROS 2 bag.
        name: what messages call it.

    Raises:
        SonarError: it cannot be read, holds no ranges or does not say of which sensor, or the extra is missing.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise SonarError(f"{shown(name)}: bags need the extra ros: pip install 'jaxsonar[ros]'") from None
    try:
        with AnyReader([Path(path)], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
            yield from _scans(bag, name)
    except SonarError:
        raise
    except Exception as failure:  # whatever the library and its databases say of bytes that are no bag
        raise SonarError(f"{shown(name)}: {reason(failure)}; needed is a whole bag") from None


def _scans(bag: Any, name: str) -> Iterator[Scan]:
    wanted = [connection for connection in bag.connections if connection.msgtype in (RANGE, ODOMETRY)]
    if not any(connection.msgtype == RANGE for connection in wanted):
        held = ", ".join(sorted({connection.msgtype for connection in bag.connections})) or "nothing"
        raise SonarError(f"{shown(name)}: {shown(held)} came; needed are messages {RANGE}")
    latest = pose = np.full(3, np.nan)
    number, stamp, heard = 0, 0.0, dict[int, float]()
    for connection, time_ns, data in bag.messages(connections=wanted):
        message = bag.deserialize(data, connection.msgtype)
        if connection.msgtype == ODOMETRY:
            latest = _pose(message.pose.pose)
            continue
        sensor = _sensor(message.header.frame_id, connection.topic, name)
        if sensor in heard:
            yield _scan(number, stamp, pose, heard)
            number, heard = number + 1, {}
        pose, stamp = latest, _stamp(message.header.stamp) or time_ns * 1e-9
        heard[sensor] = _echo(message)
    if heard:
        yield _scan(number, stamp, pose, heard)


def _scan(number: int, stamp: float, pose: np.ndarray, heard: dict[int, float]) -> Scan:
    sensor = np.array([k for k, range_ in heard.items() if not math.isnan(range_)], dtype=np.int64)
    ranges = np.array([range_ for range_ in heard.values() if not math.isnan(range_)])
    return Scan(number, stamp, pose, sensor, sensor, ranges, np.full(len(sensor), np.nan))


def _sensor(frame: str, topic: str, name: str) -> int:
    for text in (frame, topic):
        if found := re.search(r"(\d{1,9})\D*$", text):
            return int(found[1])
    came = f"frame_id '{shown(frame, 40)}' on topic '{shown(topic, 40)}' came"
    raise SonarError(f"{shown(name)}: {came}; needed is the sensor's number at the end of either")


def _echo(message: Any) -> float:
    """Half path length, metres; NaN where nothing was heard."""
    heard = math.isfinite(message.range) and message.range > 0 and message.min_range <= message.range
    return float(message.range) if heard and message.range < message.max_range else math.nan


def _stamp(stamp: Any) -> float:
    return stamp.sec + stamp.nanosec * 1e-9


def _pose(pose: Any) -> np.ndarray:
    """x, y (m) and theta (rad) of a pose in space."""
    q = pose.orientation
    theta = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
    planar = np.array([pose.position.x, pose.position.y, theta])
    return planar if np.isfinite(planar).all() else np.full(3, np.nan)
