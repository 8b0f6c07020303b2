"""The tree of frames in a bag (``/tf_static``, ``/tf``), and the ring that it and the messages describe."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.hardware.errors import SonarError, shown
from jaxsonar.recordings.rosbag_messages import Messages
from jaxsonar.recordings.rosbag_sensors import BagSensor
from jaxsonar.sensors.ring import Ring

BASES = ("base_link", "base_footprint", "base")
"""Names of the robot frame, without namespace, the preferred one first."""


@dataclass(frozen=True)
class TransformSettings:
    """Constants of the comparison of frames and sensors. Chosen by hand."""

    same_place: tuple[float, float] = (0.1, float(np.radians(20)))
    """A frame and a sensor of a ring that differ by less are the same sensor, metres and radians."""
    min_horizontal: float = 0.5
    """A sensor whose axis has a smaller horizontal part looks up or down and belongs to no ring."""
    max_field_of_view: float = float(np.pi)
    """Largest field of view of an ultrasound sensor, radians."""


SETTINGS = TransformSettings()


class FrameTree:
    """Transforms between frames, the first of each pair of frames."""

    def __init__(self, streams: Iterable[Messages]):
        self._parent: dict[str, tuple[str, Float[np.ndarray, "4 4"]]] = {}
        for one in streams:
            if one.child and one.child not in self._parent:
                self._parent[one.child] = (one.frame, _matrix(*one.values[0]))

    @property
    def frames(self) -> set[str]:
        """All frames."""
        return {*self._parent, *(parent for parent, _ in self._parent.values())}

    def lookup(self, target: str, source: str) -> Float[np.ndarray, "4 4"] | None:
        """target_from_source; None if the frames are not connected."""
        to_target, to_source = self._chain(target), self._chain(source)
        common = next((frame for frame in to_source if frame in to_target), None)
        return None if common is None else np.linalg.inv(to_target[common]) @ to_source[common]

    def _chain(self, frame: str) -> dict[str, Float[np.ndarray, "4 4"]]:
        """ancestor_from_frame of a frame and all its ancestors."""
        chain = {frame: np.eye(4)}
        matrix = np.eye(4)
        while frame in self._parent:
            frame, step = self._parent[frame]
            if frame in chain:  # a circle
                break
            matrix = step @ matrix
            chain[frame] = matrix
        return chain

    def base(self, preferred: str = "") -> str | None:
        """The robot frame: the preferred one if it is in the tree, else base_link or the like."""
        if preferred in self.frames:
            return preferred
        named = [frame for name in BASES for frame in sorted(self.frames) if frame.split("/")[-1] == name]
        return named[0] if named else None


def planar_pose(matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 3"]:
    """x, y (m) and the direction of the x axis (rad) of a transform."""
    return np.array([matrix[0, 3], matrix[1, 3], np.arctan2(matrix[1, 0], matrix[0, 0])])


def places_in_ring(sensors: Sequence[BagSensor], tree: FrameTree, ring: Ring) -> list[int] | None:
    """Sensor of the ring at the place of the frame of each sensor; None if the frames do not tell all of them."""
    poses = [_robot_pose(tree, one) for one in sensors]
    found = []
    for pose in poses:
        if pose is None:
            return None
        distance = np.hypot(*(np.asarray(ring.position) - pose[:2]).T) / SETTINGS.same_place[0]
        turn = np.abs(wrap_angle(np.asarray(ring.heading) - pose[2])) / SETTINGS.same_place[1]
        off = np.maximum(distance, turn)
        if off.min() > 1:
            return None
        found.append(int(np.argmin(off)))
    return found if len(set(found)) == len(found) else None


def warn_of_other_headings(
    sensors: Sequence[BagSensor], index: Sequence[int], tree: FrameTree, ring: Ring, note: Callable[[str], None]
) -> None:
    """Note a warning if sensors do not look where the ring says, as far as the frames tell."""
    frames = Counter(one.frame for one in sensors)
    poses = [(one, k, _robot_pose(tree, one)) for one, k in zip(sensors, index, strict=True) if frames[one.frame] == 1]
    poses = [(one, k, pose) for one, k, pose in poses if pose is not None]
    if len({float(pose[2]) for _, _, pose in poses}) < 2:  # frames without orientations tell nothing
        return
    heading = np.asarray(ring.heading)
    off = [(one, k, pose) for one, k, pose in poses if abs(wrap_angle(heading[k] - pose[2])) > SETTINGS.same_place[1]]
    if not off:
        return
    one, k, pose = off[0]
    came = (
        f"{one.frame} looks to {np.degrees(pose[2]):.0f} deg and sensor {k} of the ring to {np.degrees(heading[k]):.0f}"
    )
    cause = "the ring is numbered or turned in another way"
    remedy = "name its sensors, or make a ring of the bag with convert --ring-out"
    note(f"warning: {len(off)} sensors do not look where their frames do: {shown(came)} deg; {cause}; {remedy}")


def _robot_pose(tree: FrameTree, sensor: BagSensor) -> Float[np.ndarray, " 3"] | None:
    """robot_from_sensor in the plane; None if the frame is not connected to the robot frame, or is that frame."""
    base = tree.base()
    matrix = None if base in (None, sensor.frame) else tree.lookup(base, sensor.frame)
    return None if matrix is None else planar_pose(matrix)


@dataclass(frozen=True)
class DescribedSensor:
    """What a bag tells about a sensor."""

    sensor: BagSensor
    field_of_view: float
    """Median, radians; NaN if no message has one."""
    max_range: float
    """Largest one, metres; NaN if no message has one."""
    largest_range: float
    """Largest echo, metres; NaN if nothing was heard."""


def described_ring(
    sensors: Sequence[DescribedSensor], tree: FrameTree, *, base: str, name: str, note: Callable[[str], None]
) -> Ring:
    """A ring of sensors at the places of their frames; the beam is the field of view. It has direct echoes only.

    Args:
        sensors: the sensors in the order of the ring.
        tree: the frames.
        base: the robot frame.
        name: name of the bag in error messages.
        note: called with one line for each choice.

    Raises:
        SonarError: a frame is not connected to the robot frame, a sensor looks up or down, or values are missing.
    """
    frames = [one.sensor.frame for one in sensors]
    if shared := [one for one, times in Counter(frames).items() if times > 1]:
        came = f"{Counter(frames)[shared[0]]} sensors have the frame '{shown(shared[0])}'"
        raise SonarError(f"{shown(name)}: {came}; needed for a ring is a frame for each sensor")
    position, heading = [], []
    for one in sensors:
        matrix = tree.lookup(base, one.sensor.frame)
        if matrix is None:
            listed = ", ".join(sorted(tree.frames)) or "no frame"
            raise SonarError(
                f"{shown(name)}: frame '{shown(one.sensor.frame)}' of {shown(one.sensor.topic)} is not connected to "
                f"'{shown(base)}'; needed for a ring is its transform in /tf_static; {shown(listed, 400)} came"
            )
        if np.hypot(*matrix[:2, 0]) < SETTINGS.min_horizontal:
            raise SonarError(
                f"{shown(name)}: the x axis of frame '{shown(one.sensor.frame)}' points up or down; allowed are "
                "sensors that look along the floor"
            )
        x, y, theta = planar_pose(matrix)
        position.append((x, y))
        heading.append(theta)
    beam = np.array([one.field_of_view for one in sensors])
    unknown = ~((beam > 0) & (beam <= SETTINGS.max_field_of_view))
    if unknown.all():
        came = ", ".join(f"{one:.4g}" for one in np.unique(beam))
        needed = f"needed for a ring are radians above 0 and up to {SETTINGS.max_field_of_view:.4g}"
        raise SonarError(f"{shown(name)}: field_of_view is {shown(came)}; {needed}")
    if unknown.any():
        beam[unknown] = np.median(beam[~unknown])
        note(f"beam: {int(unknown.sum())} sensors without a field_of_view get that of the others")
    limits = [one.max_range for one in sensors if np.isfinite(one.max_range)]
    largest = np.nanmax([one.largest_range for one in sensors] + [0.0])
    if not limits and largest <= 0:
        raise SonarError(f"{shown(name)}: no max_range and no echo came; needed for a ring is either")
    max_range = max(limits) if limits else float(np.ceil(10 * largest) / 10)
    what = "the largest max_range" if limits else "the largest echo, rounded up"
    note(
        f"ring: {len(sensors)} sensors from the transforms to '{base}', beams from field_of_view, "
        f"max_range {max_range:g} m, {what}"
    )
    return Ring(
        np.round(position, 6),
        np.radians(np.round(np.degrees(heading), 6)),
        beam=np.radians(np.round(np.degrees(beam), 6)),
        neighbors=0,
        max_range=float(f"{max_range:.6g}"),
        name=name,
        names=frames,
    )


def _matrix(x: float, y: float, z: float, qx: float, qy: float, qz: float, qw: float) -> Float[np.ndarray, "4 4"]:
    """A transform from its translation and its rotation, a quaternion of any length."""
    length = np.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    qx, qy, qz, qw = np.array([qx, qy, qz, qw]) / length if length > 0 else (0.0, 0.0, 0.0, 1.0)
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    matrix[:3, :3] = [
        [1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qz * qw), 2 * (qx * qz + qy * qw)],
        [2 * (qx * qy + qz * qw), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qx * qw)],
        [2 * (qx * qz - qy * qw), 2 * (qy * qz + qx * qw), 1 - 2 * (qx * qx + qy * qy)],
    ]
    return matrix
