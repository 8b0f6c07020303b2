"""Messages of ROS 1 and ROS 2 bags as columns, without a ROS installation (extra ``ros``)."""

import math
import os
import re
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.hardware.errors import SonarError, reason, shown

RANGE = ("sensor_msgs/msg/Range",)
CLOUD = ("sensor_msgs/msg/PointCloud", "sensor_msgs/msg/PointCloud2")
ODOMETRY = ("nav_msgs/msg/Odometry",)
POSE = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
TRANSFORM = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

_SUFFIXES = {b"#ROSBAG V": ".bag", b"SQLite format 3\0": ".db3", b"\x89MCAP0\r\n": ".mcap"}


@dataclass(frozen=True)
class Topic:
    """A topic of a bag."""

    name: str
    type: str
    messages: int


@dataclass(frozen=True, eq=False)
class Messages:
    """The messages of one topic with one frame, in the order of the bag."""

    topic: str
    frame: str
    """``header.frame_id`` without a slash at the beginning."""
    child: str
    """Child frame of a pose; empty for other messages."""
    received: Float[np.ndarray, " messages"]
    """Time of recording, seconds."""
    stamp: Float[np.ndarray, " messages"]
    """``header.stamp``, seconds; NaN if it is zero."""
    order: Int[np.ndarray, " messages"]
    """Place in the bag."""
    values: list[Any]
    """What the message says, one each: see ``_VALUES``."""
    type: str = ""

    @property
    def path(self) -> str:
        """Frame and child frame as text, for messages to the person."""
        return f"{self.frame or '?'} -> {self.child or '?'}"


@contextmanager
def open_bag(filename: str | os.PathLike[str], name: str) -> Iterator["Bag"]:
    """Open a bag for reading. Its content decides which kind it is, not its suffix.

    Args:
        filename: the file, or the folder of a ROS 2 bag.
        name: name of the bag in error messages.

    Raises:
        SonarError: the bag cannot be read, or the extra is missing.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise SonarError(f"{shown(name)}: bags need the extra ros: pip install 'jaxsonar[ros]'") from None
    with TemporaryDirectory() as folder:
        try:
            path = _with_suffix(Path(filename), Path(folder))
            with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
                yield Bag(reader, name)
        except SonarError:
            raise
        except Exception as failure:  # the library and its databases raise many types for invalid bags
            why = re.sub(r"\('(.*?)',\)", r"\1", reason(failure)).rstrip(". ")  # some texts are tuples of one
            raise SonarError(f"{shown(name)}: {why}; needed is a whole bag") from None


class Bag:
    """An open bag."""

    def __init__(self, reader: Any, name: str):
        self._reader = reader
        self.name = name

    @property
    def topics(self) -> list[Topic]:
        """The topics with messages, sorted by name."""
        counts: dict[tuple[str, str], int] = {}
        for one in self._reader.connections:
            key = (one.topic, one.msgtype)
            counts[key] = counts.get(key, 0) + one.msgcount
        return [Topic(*key, messages) for key, messages in sorted(counts.items()) if messages]

    def named(self, types: Collection[str]) -> list[str]:
        """The topics with messages of some types."""
        return [one.name for one in self.topics if one.type in types]

    def read(self, topics: Collection[str]) -> list[Messages]:
        """The messages of some topics, by topic, type and frame, in the order of their first message.

        Every call reads the file once, and types that this module does not know are left out.
        """
        wanted = [
            one for one in self._reader.connections if one.topic in topics and one.msgcount and one.msgtype in _VALUES
        ]
        if not wanted:  # the library reads everything if nothing is wanted
            return []
        rows: dict[tuple[str, ...], list[tuple[int, float, float, Any]]] = {}
        for order, (connection, received, data) in enumerate(self._reader.messages(connections=wanted)):
            message = self._reader.deserialize(data, connection.msgtype)
            for key, stamp, value in _VALUES[connection.msgtype](message):
                key = (connection.topic, connection.msgtype, *key)
                rows.setdefault(key, []).append((order, received * 1e-9, stamp, value))
        return [_messages(*key, rows=found) for key, found in rows.items()]


def _messages(topic: str, type: str, frame: str, child: str, *, rows: list[tuple[int, float, float, Any]]) -> Messages:
    order, received, stamp, values = (list(column) for column in zip(*rows, strict=True))
    return Messages(topic, frame, child, np.array(received), np.array(stamp), np.array(order), values, type)


_Values = Iterator[tuple[tuple[str, str], float, Any]]


def _range(message: Any) -> _Values:
    """Range, minimum, maximum (m), field of view (rad), kind of radiation."""
    limits = (message.min_range, message.max_range, message.field_of_view, message.radiation_type)
    yield (_frame(message.header.frame_id), ""), _seconds(message.header.stamp), (message.range, *limits)


def _odometry(message: Any) -> _Values:
    """x, y (m), theta (rad)."""
    key = (_frame(message.header.frame_id), _frame(message.child_frame_id))
    yield key, _seconds(message.header.stamp), _planar(message.pose.pose.position, message.pose.pose.orientation)


def _pose(message: Any) -> _Values:
    """x, y (m), theta (rad)."""
    pose = getattr(message.pose, "pose", message.pose)
    key = (_frame(message.header.frame_id), "")
    yield key, _seconds(message.header.stamp), _planar(pose.position, pose.orientation)


def _transforms(message: Any) -> _Values:
    """Translation (m) and rotation (quaternion x, y, z, w)."""
    for one in message.transforms:
        move, turn = one.transform.translation, one.transform.rotation
        value = (move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w)
        yield (_frame(one.header.frame_id), _frame(one.child_frame_id)), _seconds(one.header.stamp), value


def _cloud(message: Any) -> _Values:
    """Points (points, 3), metres."""
    points = np.array([(point.x, point.y, point.z) for point in message.points], np.float64).reshape(-1, 3)
    yield (_frame(message.header.frame_id), ""), _seconds(message.header.stamp), points


def _cloud2(message: Any) -> _Values:
    """Points (points, 3), metres."""
    formats = {7: "f4", 8: "f8"}
    fields = {field.name: field for field in message.fields}
    if not {"x", "y", "z"} <= set(fields) or any(fields[axis].datatype not in formats for axis in "xyz"):
        raise SonarError("a PointCloud2 without x, y, z as floating-point numbers came")
    end = ">" if message.is_bigendian else "<"
    layout = np.dtype(
        {
            "names": ["x", "y", "z"],
            "formats": [end + formats[fields[axis].datatype] for axis in "xyz"],
            "offsets": [fields[axis].offset for axis in "xyz"],
            "itemsize": message.point_step,
        }
    )
    data = np.asarray(message.data, np.uint8)
    if message.height > 1:  # rows may be longer than their points
        data = data.reshape(message.height, message.row_step)[:, : message.width * message.point_step]
    rows = np.frombuffer(data.tobytes(), layout, count=message.height * message.width)
    points = np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    yield (_frame(message.header.frame_id), ""), _seconds(message.header.stamp), points


_VALUES: dict[str, Callable[[Any], _Values]] = {
    **dict.fromkeys(RANGE, _range),
    **dict.fromkeys(ODOMETRY, _odometry),
    **dict.fromkeys(POSE, _pose),
    **dict.fromkeys(TRANSFORM, _transforms),
    CLOUD[0]: _cloud,
    CLOUD[1]: _cloud2,
}


def _frame(name: str) -> str:
    return name.lstrip("/")


def _seconds(stamp: Any) -> float:
    """Seconds of a ROS time; NaN for zero, which means unset."""
    return stamp.sec + stamp.nanosec * 1e-9 if stamp.sec or stamp.nanosec else math.nan


def _planar(position: Any, turn: Any) -> tuple[float, float, float]:
    """x, y (m) and theta (rad) of a pose in space; NaN if it is not finite or has no orientation."""
    theta = yaw(turn.x, turn.y, turn.z, turn.w)
    pose = (position.x, position.y, theta)
    return pose if all(map(math.isfinite, pose)) else (math.nan, math.nan, math.nan)


def yaw(x: float, y: float, z: float, w: float) -> float:
    """Rotation about the vertical axis of a quaternion of any length, radians; NaN for the quaternion zero."""
    if not x * x + y * y + z * z + w * w > 0:
        return math.nan
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def _with_suffix(path: Path, folder: Path) -> Path:
    """The bag under a name with the suffix of its content, which the library needs."""
    if path.is_dir():
        return path
    with open(path, "rb") as file:
        head = file.read(16)
    suffix = next((suffix for magic, suffix in _SUFFIXES.items() if head.startswith(magic)), path.suffix)
    if path.suffix == suffix:
        return path
    link = folder / f"bag{suffix}"
    link.symlink_to(path.resolve())
    return link
