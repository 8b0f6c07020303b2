"""ROS bags for tests, written with the library rosbags: ROS 1, ROS 2 in SQLite, and ROS 2 in MCAP."""

import numpy as np
import pytest
from support.hard_cones import simulate

from jaxsonar import Log, Ring, Room
from jaxsonar.geometry.se2 import compose

KINDS = ("ros1", "sqlite", "mcap")
START = 1_700_000_000.0
"""Time of the first message, seconds."""


class BagMessages:
    """Messages that are written to a bag in the order of their times. Times are seconds after ``START``.

    The header of a message has its time as its stamp, unless another stamp is given; 0 is an unset stamp.
    """

    def __init__(self, kind="sqlite"):
        pytest.importorskip("rosbags")
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.kind = kind
        self.store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
        if kind == "ros1":  # the library lacks this type
            transforms = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(transforms, "tf2_msgs/msg/TFMessage"))
        self.messages = []

    def new(self, name, /, **fields):
        return self.store.types[name](**fields)

    def header(self, seconds, frame):
        whole = int(np.floor(seconds))
        stamp = self.new("builtin_interfaces/msg/Time", sec=whole, nanosec=round((seconds - whole) * 1e9))
        return self.new(
            "std_msgs/msg/Header", stamp=stamp, frame_id=frame, **({"seq": 0} if self.kind == "ros1" else {})
        )

    def add(self, time, topic, message):
        self.messages.append((time + START, topic, message))

    def range(self, time, value, *, frame="", topic=None, limits=(0.02, 4.0), view=1.0, radiation=0, stamp=None):
        stamp = time + START if stamp is None else stamp
        message = self.new(
            "sensor_msgs/msg/Range",
            header=self.header(stamp, frame),
            radiation_type=radiation,
            field_of_view=view,
            min_range=limits[0],
            max_range=limits[1],
            range=value,
        )
        self.add(time, topic or f"/{frame}", message)

    def odometry(self, time, pose, *, frame="odom", child="base_link", topic="/odom", stamp=None, quaternion=None):
        zero = self.vector(0, 0, 0)
        twist = self.new("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        message = self.new(
            "nav_msgs/msg/Odometry",
            header=self.header(time + START if stamp is None else stamp, frame),
            child_frame_id=child,
            pose=self.new(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=self.new(
                    "geometry_msgs/msg/Pose",
                    position=self.new("geometry_msgs/msg/Point", x=float(pose[0]), y=float(pose[1]), z=0.0),
                    orientation=self.quaternion(quaternion or turned(pose[2])),
                ),
                covariance=np.zeros(36),
            ),
            twist=self.new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )
        self.add(time, topic, message)

    def transform(self, time, parent, child, pose, *, topic="/tf_static", quaternion=None):
        transform = self.new(
            "geometry_msgs/msg/Transform",
            translation=self.vector(pose[0], pose[1], 0.25),
            rotation=self.quaternion(quaternion or turned(pose[2])),
        )
        header = self.header(time + START, parent)
        one = self.new("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=transform)
        self.add(time, topic, self.new("tf2_msgs/msg/TFMessage", transforms=[one]))

    def cloud(self, time, points, *, frame="base_link", topic="/sonar"):
        points = [self.new("geometry_msgs/msg/Point32", x=float(x), y=float(y), z=0.25) for x, y in points]
        header = self.header(time + START, frame)
        self.add(time, topic, self.new("sensor_msgs/msg/PointCloud", header=header, points=points, channels=[]))

    def cloud2(self, time, points, *, frame="base_link", topic="/sonar"):
        rows = np.zeros(len(points), np.dtype([("id", "u1"), ("z", ">f4"), ("x", ">f4"), ("y", ">f4"), ("rest", "u2")]))
        rows["x"], rows["y"] = np.reshape(points, (-1, 2)).T
        fields = [
            self.new("sensor_msgs/msg/PointField", name=axis, offset=offset, datatype=7, count=1)
            for axis, offset in (("z", 1), ("x", 5), ("y", 9))
        ]
        message = self.new(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(time + START, frame),
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=True,
            point_step=rows.itemsize,
            row_step=rows.nbytes,
            data=np.frombuffer(rows.tobytes(), np.uint8),
            is_dense=True,
        )
        self.add(time, topic, message)

    def vector(self, x, y, z):
        return self.new("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z))

    def quaternion(self, xyzw):
        return self.new("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, xyzw), strict=True)))

    def write(self, path):
        """Write the bag; its filename gets the suffix of its kind. Returns the file, or the folder of a ROS 2 bag."""
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2

        if self.kind == "ros1":
            path = path.with_suffix(".bag")
            writer = Writer1(path)
        else:
            plugin = StoragePlugin.MCAP if self.kind == "mcap" else StoragePlugin.SQLITE3
            writer = Writer2(path, version=9, storage_plugin=plugin)
        with writer:
            known = {}
            for time, topic, message in sorted(self.messages, key=lambda one: one[0]):
                name = message.__msgtype__
                if topic not in known:
                    known[topic] = writer.add_connection(topic, name, typestore=self.store)
                serialize = self.store.serialize_ros1 if self.kind == "ros1" else self.store.serialize_cdr
                writer.write(known[topic], round(time * 1e9), serialize(message, name))
        return path


def turned(theta):
    """The quaternion (x, y, z, w) of a rotation about the vertical axis."""
    return 0.0, 0.0, np.sin(theta / 2), np.cos(theta / 2)


def sonar_ring(count=8, **more):
    """A ring of direct echoes, as all bags have it."""
    options = {"radius": 0.2, "beam": np.radians(60), "neighbors": 0, "max_range": 3.0, "name": "sonars"} | more
    return Ring.circular(count=count, **options)


def firing_log(ring: Ring, room: Room, pose_at, times, *, sigma=0.003, seed=0) -> Log:
    """A log of one firing per scan, sensors 0, 1, 2, ... in turn, each at the pose of its own time.

    Args:
        ring: the sensors.
        room: the walls.
        pose_at: world_from_robot at a time.
        times: time of each firing, seconds.
        sigma: noise of the ranges, metres.
        seed: seed of the noise.

    Returns:
        An explicit log with the first echo of each firing; its stamps are the times.
    """
    poses = np.array([pose_at(time) for time in times])
    log = simulate(ring, room, poses, sigma=sigma, seed=seed).as_log(ring, poses)
    ranges = np.full(len(times), np.nan)
    for k, scan in enumerate(log):
        own = (scan.tx == k % ring.count) & (scan.rx == k % ring.count)
        ranges[k] = scan.range[own].min() if own.any() else np.nan
    sensor = np.arange(len(times)) % ring.count
    return Log.from_echoes(
        np.arange(len(times)), sensor, sensor, ranges, stamp=np.array(times), pose=poses, asked=np.zeros((0, 2), int)
    )


def bag_of_firings(
    log: Log, kind="sqlite", *, names: str | list[str] = "sonar_{}", pose_at=None, odometry_period=0.02, no_echo=np.inf
):
    """The messages of a bag with one Range topic per sensor, and odometry at its own rate.

    Args:
        log: single firings with stamps.
        kind: one of ``KINDS``.
        names: frame and topic of a sensor, with its number in braces; or a list of names.
        pose_at: world_from_robot at a time; None: no odometry.
        odometry_period: seconds.
        no_echo: value of the message of a firing that heard nothing.
    """
    bag = BagMessages(kind)
    for scan in log:
        for sensor, value in zip(scan.tx, scan.range, strict=True):
            frame = names.format(sensor) if isinstance(names, str) else names[sensor]
            bag.range(scan.stamp, no_echo if np.isnan(value) else value, frame=frame)
    if pose_at is not None:
        for time in np.arange(log.stamp[0] - 0.011, log.stamp[-1] + 2 * odometry_period, odometry_period):
            bag.odometry(time, pose_at(time))
    return bag


def spinning(center, rate):
    """pose_at of a robot that turns in place, radians per second."""
    return lambda time: compose(np.array([*center, 0.0]), np.array([0.0, 0.0, rate * time]))
