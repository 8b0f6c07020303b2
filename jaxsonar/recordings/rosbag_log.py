"""Logs and rings from bags of ROS 1 and ROS 2, without a ROS installation (extra ``ros``).

ROS has no message type for cross echoes. Direct echoes are read from ``sensor_msgs/Range`` of kind ULTRASOUND or, if a
bag has none, from sonar points (``sensor_msgs/PointCloud``, ``PointCloud2``). Poses are those of ``nav_msgs/Odometry``
or, if a bag has none, of the transforms from odom to the robot in ``/tf``.
"""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxsonar.geometry.se2 import compose, inverse
from jaxsonar.hardware.errors import SonarError, shown
from jaxsonar.recordings.input_options import InputOptions
from jaxsonar.recordings.rosbag_clocks import message_times
from jaxsonar.recordings.rosbag_clouds import log_from_clouds, sonar_topics
from jaxsonar.recordings.rosbag_messages import CLOUD, ODOMETRY, POSE, RANGE, TRANSFORM, Bag, Messages, open_bag, yaw
from jaxsonar.recordings.rosbag_odometry import Odometry, choose_odometry
from jaxsonar.recordings.rosbag_ranges import ECHO, NOT_MEASURED, SILENT, reading_kinds
from jaxsonar.recordings.rosbag_scans import log_from_readings
from jaxsonar.recordings.rosbag_sensors import BagSensor, name_numbers, sensor_indices
from jaxsonar.recordings.rosbag_transforms import (
    DescribedSensor,
    FrameTree,
    described_ring,
    places_in_ring,
    planar_pose,
    warn_of_other_headings,
)
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

_Note = Callable[[str], None]


def read_bag(
    filename: str | os.PathLike[str],
    *,
    ring: Ring | None = None,
    options: InputOptions = InputOptions(),  # noqa: B008  immutable
    on_note: _Note | None = None,
    name: str | None = None,
) -> Log:
    """The log of a bag. It is explicit: sensors that heard nothing have silent readings, others were not measured.

    Args:
        filename: ``.bag``, ``.db3``, ``.mcap``, or the folder of a ROS 2 bag.
        ring: the sensors; its names tell which topic or frame is which sensor.
        options: names of sensors and the topic of the odometry, where the bag does not tell them.
        on_note: called with one line for each choice.
        name: name of the bag in error messages; the filename if omitted.

    Raises:
        SonarError: the bag cannot be read or contains no ultrasound ranges, the extra is missing, or the bag does not
            tell which sensor or odometry is which; the message then says what to write.
    """
    name, note = name or os.fspath(filename), on_note or _ignore
    with open_bag(filename, name) as bag:
        messages = bag.read([*bag.named(RANGE), *bag.named(ODOMETRY), *_static_topics(bag)])
        ranges = _ultrasound(messages, note)
        poses = _poses(bag, messages, options)
        if not ranges:
            return _cloud_log(bag, poses, ring, options, note)
    sensors, ranges = _of_robot([BagSensor(one.topic, one.frame) for one in ranges], ranges, options, note)
    index = sensor_indices(
        sensors,
        count=None if ring is None else ring.count,
        ring_names=() if ring is None else ring.names,
        given=options.sensors,
        name=name,
        note=note,
        places=None if ring is None else places_in_ring(sensors, poses.tree, ring),
    )
    if ring is not None:
        known = [(sensor, k) for sensor, k in zip(sensors, index, strict=True) if k is not None]
        warn_of_other_headings([sensor for sensor, _ in known], [k for _, k in known], poses.tree, ring, note)
    used = [(one, k) for one, k in zip(ranges, index, strict=True) if k is not None]
    chosen = choose_odometry(
        poses.candidates,
        wanted=options.odometry,
        sensor_topics=[one.topic for one, _ in used],
        name=name,
        note=note,
    )
    streams = [one for one, _ in used]
    times = message_times([*([chosen] if chosen else []), *streams], note)
    odometry = None if chosen is None else _odometry(chosen, times[0], poses.tree, note)
    times = times[1:] if chosen else times
    table = np.concatenate([np.array(one.values, np.float64)[:, :3] for one in streams])
    kind = reading_kinds(*table.T, ring_max_range=None if ring is None else ring.max_range, note=note)
    reported = np.where(kind == SILENT, np.nan, table[:, 0])
    sensor = np.repeat([k for _, k in used], [len(one.values) for one in streams])
    time, order = np.concatenate(times), np.concatenate([one.order for one in streams])
    kept = (kind != NOT_MEASURED) & ~_repeated(time, sensor, table[:, 0], order)
    log = log_from_readings(time[kept], sensor[kept], reported[kept], order=order[kept], odometry=odometry)
    _summarize(log, note)
    return log


def ring_from_bag(
    filename: str | os.PathLike[str],
    *,
    options: InputOptions = InputOptions(),  # noqa: B008  immutable
    on_note: _Note | None = None,
    name: str | None = None,
) -> Ring:
    """The ring that a bag describes: transforms of the sensors' frames, field of view, and maximum range.

    Its sensors are in the order of ``options.sensors`` or of the numbers in their names; without numbers, they are
    sorted counter-clockwise from the front. Each has the name of its frame or topic, so that ``read_bag`` with this
    ring finds it.

    Args:
        filename: as in ``read_bag``.
        options: names of sensors and the topic of the odometry, where the bag does not tell them.
        on_note: called with one line for each choice.
        name: name of the bag in error messages; the filename if omitted.

    Raises:
        SonarError: the bag cannot be read, or does not describe all sensors.
    """
    name, note = name or os.fspath(filename), on_note or _ignore
    with open_bag(filename, name) as bag:
        messages = bag.read([*bag.named(RANGE), *bag.named(ODOMETRY), *bag.named(TRANSFORM)])
        ranges = _ultrasound(messages, note)
        if not ranges:
            raise _nothing(bag)
        candidates, tree = _of_types(messages, ODOMETRY), FrameTree(_static_first(messages))
    sensors, ranges = _of_robot([BagSensor(one.topic, one.frame) for one in ranges], ranges, options, note)
    wanted = (options.odometry or "").strip("/")
    children = [one.child for one in candidates if wanted in ("", one.topic.strip("/"))]
    base = tree.base(next((child for child in children if child.split("/")[-1].startswith("base")), ""))
    if base is None:
        listed = ", ".join(sorted(tree.frames)) or "no transforms"
        raise SonarError(f"{shown(name)}: no robot frame base_link came; {shown(listed, 400)} came in /tf_static")
    described = [_described(sensor, one) for sensor, one in zip(sensors, ranges, strict=True)]
    rows = _ring_order(sensors, options, tree, base, name)
    return described_ring([described[row] for row in rows], tree, base=base, name=Path(name).stem, note=note)


class _Poses:
    """Messages that may tell the robot's pose, and the frames."""

    def __init__(self, candidates: list[Messages], tree: FrameTree):
        self.candidates = candidates
        self.tree = tree


def _poses(bag: Bag, messages: Sequence[Messages], options: InputOptions) -> _Poses:
    """Candidates for the robot's poses. ``/tf`` is read only if there is no odometry."""
    wanted = options.odometry and f"/{options.odometry.strip('/')}"
    types = {one.name: one.type for one in bag.topics}
    candidates = _of_types(messages, ODOMETRY)
    if wanted and types.get(wanted) in POSE:
        candidates += bag.read([wanted])
    if candidates and types.get(wanted or "") not in TRANSFORM:
        return _Poses(candidates, FrameTree(_of_types(messages, TRANSFORM)))
    transforms = _static_first(bag.read(bag.named(TRANSFORM)))
    moving = [one for one in transforms if one.topic not in _static_topics(bag) and len(one.values) > 1]
    robot = [
        Messages(
            one.topic,
            one.frame,
            one.child,
            one.received,
            one.stamp,
            one.order,
            [(value[0], value[1], yaw(*value[3:])) for value in one.values],
        )
        for one in moving
        if one.frame.split("/")[-1].lower() in ("odom", "map", "world") or "odom" in one.frame.lower()
        if one.child.split("/")[-1].startswith("base")
    ]
    return _Poses(robot, FrameTree(transforms))


def _static_topics(bag: Bag) -> list[str]:
    return [one.name for one in bag.topics if one.type in TRANSFORM and one.name.endswith("static")]


def _static_first(messages: Sequence[Messages]) -> list[Messages]:
    """All transforms, those of static topics first."""
    return sorted(_of_types(messages, TRANSFORM), key=lambda one: not one.topic.endswith("static"))


def _of_types(messages: Sequence[Messages], types: Sequence[str]) -> list[Messages]:
    return [one for one in messages if one.type in types]


def _odometry(chosen: Messages, time: Float[np.ndarray, " messages"], tree: FrameTree, note: _Note) -> Odometry:
    """Poses of the robot frame from the chosen messages, whose child frame may be another one."""
    pose = np.array(chosen.values, np.float64).reshape(-1, 3)
    base = tree.base()
    if chosen.child and not chosen.child.split("/")[-1].startswith("base"):
        matrix = tree.lookup(base, chosen.child) if base else None
        if matrix is None:
            note(f"odometry: its frame '{chosen.child}' is taken for the robot frame, as no transform relates them")
        else:
            note(f"odometry: moved from '{chosen.child}' to '{base}' by the transforms")
            pose = compose(pose, inverse(planar_pose(matrix)))
    return Odometry.of(time, pose, note)


def _ultrasound(messages: Sequence[Messages], note: _Note) -> list[Messages]:
    """The ultrasound ranges by topic and frame; others are left out and reported."""
    found, others = [], {}
    for one in _of_types(messages, RANGE):
        radiation = np.array([value[4] for value in one.values])
        if (rest := radiation != 0).any():
            others[one.frame or one.topic] = int(rest.sum())
        if not rest.all():
            found.append(_part(one, ~rest))
    if others:
        listed = ", ".join(others)
        note(f"infrared: {sum(others.values())} ranges of {len(others)} sensors are left out: {shown(listed, 400)}")
    return found


def _part(one: Messages, rows: np.ndarray) -> Messages:
    values = [value for value, kept in zip(one.values, rows, strict=True) if kept]
    return Messages(one.topic, one.frame, one.child, one.received[rows], one.stamp[rows], one.order[rows], values)


def _of_robot(
    sensors: list[BagSensor], ranges: list[Messages], options: InputOptions, note: _Note
) -> tuple[list[BagSensor], list[Messages]]:
    """The sensors in the namespace of the chosen odometry, if the bag has sensors of several robots."""
    space = (
        "/".join((options.odometry or "").strip("/").split("/")[:1])
        if "/" in (options.odometry or "").strip("/")
        else ""
    )
    inside = [one.topic.strip("/").startswith(f"{space}/") for one in sensors]
    if not space or all(inside) or not any(inside):
        return sensors, ranges
    note(f"sensors: {sum(inside)} of {len(sensors)}, those in the namespace of the odometry, /{space}")
    kept = [row for row, one in enumerate(inside) if one]
    return [sensors[row] for row in kept], [ranges[row] for row in kept]


def _repeated(time: np.ndarray, sensor: np.ndarray, reported: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Readings that repeat the time and the range of another one of their sensor: messages that were recorded twice."""
    value = np.nan_to_num(reported, nan=-1.0, posinf=-2.0, neginf=-3.0)
    rows = np.lexsort((order, value, time, sensor))
    same = (np.diff(sensor[rows]) == 0) & (np.diff(time[rows]) == 0) & (np.diff(value[rows]) == 0)
    repeated = np.zeros(len(time), bool)
    repeated[rows[1:]] = same
    return repeated


def _cloud_log(bag: Bag, poses: _Poses, ring: Ring | None, options: InputOptions, note: _Note) -> Log:
    """The log of a bag that has sonar points, but no ranges."""
    clouds = [one for one in bag.topics if one.type in CLOUD]
    if not clouds:
        raise _nothing(bag)
    if ring is None:
        raise SonarError(
            f"{shown(bag.name)}: sonar points came; needed is the ring, which tells the sensor of each point (--ring)"
        )
    streams = _of_types(bag.read(sonar_topics(clouds, name=bag.name)), CLOUD)
    chosen = choose_odometry(
        poses.candidates,
        wanted=options.odometry,
        sensor_topics=[one.topic for one in streams],
        name=bag.name,
        note=note,
    )
    times = message_times([*([chosen] if chosen else []), *streams], note)
    tree = FrameTree(_static_first(bag.read(bag.named(TRANSFORM))))
    odometry = None if chosen is None else _odometry(chosen, times[0], tree, note)
    log = log_from_clouds(
        streams,
        times[1:] if chosen else times,
        ring=ring,
        tree=tree,
        base=tree.base("" if chosen is None else chosen.child),
        odometry=odometry,
        odometry_frame="" if chosen is None else chosen.frame,
        name=bag.name,
        note=note,
    )
    _summarize(log, note)
    return log


def _nothing(bag: Bag) -> SonarError:
    held = ", ".join(sorted({one.type for one in bag.topics})) or "no message"
    if any(one.type in RANGE for one in bag.topics):
        held = "only ranges of other sensors (infrared)"
    return SonarError(
        f"{shown(bag.name)}: {shown(held)} came; needed are ultrasound messages {RANGE[0]} or sonar points"
    )


def _described(sensor: BagSensor, one: Messages) -> DescribedSensor:
    reported, low, high, view, _ = np.array(one.values, np.float64).T
    kind = reading_kinds(reported, low, high, ring_max_range=None, note=_ignore)
    echoes, limits, views = reported[kind == ECHO], high[np.isfinite(high) & (high > low) & (high > 0)], view[view > 0]
    return DescribedSensor(
        sensor,
        field_of_view=float(np.median(views)) if len(views) else 0.0,
        max_range=float(limits.max()) if len(limits) else np.nan,
        largest_range=float(echoes.max()) if len(echoes) else np.nan,
    )


def _ring_order(
    sensors: Sequence[BagSensor], options: InputOptions, tree: FrameTree, base: str, name: str
) -> list[int]:
    """Rows of the sensors in the order of the ring."""
    if options.sensors:
        index = sensor_indices(sensors, count=None, ring_names=(), given=options.sensors, name=name, note=_ignore)
        used = sorted(k for k in index if k is not None)
        if used != list(range(len(used))):
            raise SonarError(
                f"{shown(name)}: sensors {', '.join(map(str, used))} came; needed for a ring are 0, 1, 2, ..."
            )
        return [index.index(k) for k in used]
    if (numbers := name_numbers(sensors)) is not None:
        return sorted(range(len(sensors)), key=lambda row: numbers[row])
    matrices = [tree.lookup(base, one.frame) for one in sensors]
    heading = [0.0 if one is None else float(np.mod(planar_pose(one)[2] + 1e-6, 2 * np.pi)) for one in matrices]
    return sorted(range(len(sensors)), key=lambda row: heading[row])


def _summarize(log: Log, note: _Note) -> None:
    silent, unknown = len(log.tx) - log.echo_count, int(np.isnan(log.pose[:, 0]).sum())
    poses = f"; {unknown} scans have no pose" if unknown and log.odometry is not None else ""
    note(f"scans: {len(log)} with {log.echo_count} echoes and {silent} silent readings{poses}")


def _ignore(text: str) -> None:
    """Drop a note."""
