"""Sonar points of ``sensor_msgs/PointCloud`` and ``PointCloud2``: from points to ranges of the ring's sensors.

A point lies on the axis of the sensor that heard it, at the measured distance. The sensor of a point is therefore the
one whose axis is nearest to its direction, within half a beam.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.se2 import inverse, transform_points, wrap_angle
from jaxsonar.hardware.errors import SonarError, shown
from jaxsonar.recordings.rosbag_messages import Messages, Topic
from jaxsonar.recordings.rosbag_odometry import Odometry
from jaxsonar.recordings.rosbag_scans import log_from_readings
from jaxsonar.recordings.rosbag_transforms import FrameTree
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class CloudSettings:
    """Constants of the recognition of sonar points. Chosen by hand."""

    words: tuple[str, ...] = ("sonar", "ultraso")
    """A cloud whose topic contains one of these is one of sonar points."""
    most_points: int = 4
    """A cloud with more points per sensor of the ring is that of a laser or a camera."""


SETTINGS = CloudSettings()


def sonar_topics(topics: Sequence[Topic], *, name: str) -> list[str]:
    """The topics with sonar points: those with a name like sonar, or the only one with points.

    Raises:
        SonarError: several topics with points came, and none has such a name.
    """
    named = [one.name for one in topics if any(word in one.name.lower() for word in SETTINGS.words)]
    if named or len(topics) < 2:
        return named or [one.name for one in topics]
    listed = ", ".join(one.name for one in topics)
    raise SonarError(
        f"{shown(name)}: several topics with points came: {shown(listed, 400)}; allowed are clouds of sonar points on "
        "a topic whose name contains sonar or ultrasound"
    )


@dataclass(frozen=True, eq=False)
class CloudReadings:
    """Echoes of the points of all messages of a stream."""

    message: Int[np.ndarray, " echoes"]
    sensor: Int[np.ndarray, " echoes"]
    range: Float[np.ndarray, " echoes"]


def log_from_clouds(
    streams: Sequence[Messages],
    times: Sequence[Float[np.ndarray, " messages"]],
    *,
    ring: Ring,
    tree: FrameTree,
    base: str | None,
    odometry: Odometry | None,
    odometry_frame: str,
    name: str,
    note: Callable[[str], None],
) -> Log:
    """A log of sonar points. Each message is a scan, in which all sensors that are heard anywhere fired.

    Several topics are merged into scans as single readings are; then nothing is known about silent sensors.

    Args:
        streams: the clouds.
        times: time of each message, seconds.
        ring: the sensors.
        tree: the frames.
        base: the robot frame in the tree, if it is known.
        odometry: poses of the robot; None if they are unknown.
        odometry_frame: frame of the poses; points may be given in it.
        name: name of the bag in error messages.
        note: called with one line for each choice.

    Raises:
        SonarError: the points are not those of sonars, or their frame is unknown.
    """
    found = []
    for one, time in zip(streams, times, strict=True):
        points = _robot_points(one, time, tree, base, odometry, odometry_frame, len(streams) == 1, name, note)
        found.append(_readings(one, points, ring, name, note))
    if len(streams) > 1:
        parts = [(time[readings.message], readings) for time, readings in zip(times, found, strict=True)]
        return log_from_readings(
            np.concatenate([time for time, _ in parts]),
            np.concatenate([readings.sensor for _, readings in parts]),
            np.concatenate([readings.range for _, readings in parts]),
            order=np.concatenate([one.order[readings.message] for one, readings in zip(streams, found, strict=True)]),
            odometry=odometry,
        )
    readings, order = found[0], np.argsort(times[0], kind="stable")
    stamp, place = times[0][order], np.argsort(order)
    rows = np.argsort(place[readings.message], kind="stable")
    sensor = readings.sensor[rows]
    return Log.from_echoes(
        place[readings.message][rows],
        sensor,
        sensor,
        readings.range[rows],
        stamp=stamp,
        pose=np.full((len(stamp), 3), np.nan) if odometry is None else odometry.poses(stamp),
        odometry=None if odometry is None else odometry.samples,
    )


def _readings(
    one: Messages,
    points: Sequence[Float[np.ndarray, "points 2"]],
    ring: Ring,
    name: str,
    note: Callable[[str], None],
) -> CloudReadings:
    """Sensor and range of each point."""
    counts = np.array([len(some) for some in points])
    if np.median(counts) > SETTINGS.most_points * ring.count:
        raise SonarError(
            f"{shown(name)}: clouds of {int(np.median(counts))} points came on {shown(one.topic)}; allowed are sonar "
            f"points, at most {SETTINGS.most_points} for each of the ring's {ring.count} sensors"
        )
    message, p_robot = np.repeat(np.arange(len(points)), counts), np.concatenate([np.zeros((0, 2)), *points])
    position, heading = np.asarray(ring.position), np.asarray(ring.heading)
    offset = p_robot[:, None] - position
    angle = np.abs(wrap_angle(np.arctan2(offset[..., 1], offset[..., 0]) - heading))
    sensor = np.argmin(np.where(np.isfinite(angle), angle, np.inf), axis=1)
    rows = np.arange(len(p_robot))
    distance = np.hypot(*offset[rows, sensor].T)
    inside = np.isfinite(distance) & (distance > 0) & (angle[rows, sensor] <= 0.5 * np.asarray(ring.beam)[sensor])
    text = f"points: {int(inside.sum())} of {one.topic}, each of the sensor with the nearest axis"
    note(text + f"; {int((~inside).sum())} in no beam are left out" * bool((~inside).any()))
    return CloudReadings(message[inside], sensor[inside], distance[inside])


def _robot_points(
    one: Messages,
    time: Float[np.ndarray, " messages"],
    tree: FrameTree,
    base: str | None,
    odometry: Odometry | None,
    odometry_frame: str,
    alone: bool,
    name: str,
    note: Callable[[str], None],
) -> list[Float[np.ndarray, "points 2"]]:
    """The points of each message in the robot frame."""
    points = [np.asarray(some, np.float64) for some in one.values]
    matrix = None if base is None else tree.lookup(base, one.frame)
    if matrix is not None:
        return [(some @ matrix[:3, :3].T + matrix[:3, 3])[:, :2] for some in points]
    if odometry is not None and one.frame and one.frame == odometry_frame:
        note(f"points of {one.topic}: from frame '{one.frame}' by the odometry")
        poses = odometry.poses(time)
        return [transform_points(inverse(pose), some[:, :2]) for pose, some in zip(poses, points, strict=True)]
    if one.frame.split("/")[-1].startswith("base") or alone:
        note(f"points of {one.topic}: frame '{one.frame}' is taken for the robot frame")
        return [some[:, :2] for some in points]
    raise SonarError(
        f"{shown(name)}: points of {shown(one.topic)} came in frame '{shown(one.frame)}'; needed is its transform to "
        "the robot frame in /tf_static"
    )
