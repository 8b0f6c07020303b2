"""Odometry of a bag: the choice of one topic, and poses without gaps and jumps between readings."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.hardware.errors import SonarError, shown
from jaxsonar.recordings.rosbag_messages import Messages
from jaxsonar.scans.firing_poses import poses_at


@dataclass(frozen=True)
class OdometrySettings:
    """Constants of the interpolation of odometry. Chosen by hand for robots that drive on a floor."""

    max_gap: float = 1.0
    """Poses are interpolated over at most this time, seconds, or ``max_gap_periods`` if that is longer; or over any
    time if the robot stood still."""
    max_gap_periods: float = 2.5
    """The same in median periods of the odometry. If it is the longer one, a warning says how far the robot moves."""
    still: tuple[float, float] = (0.05, 0.05)
    """A robot that moved less in a gap stood still, metres and radians: some drivers send nothing then."""
    jump: tuple[float, float] = (0.2, 0.35)
    """Smallest jump between two messages, metres and radians."""
    max_speed: tuple[float, float] = (5.0, 8.0)
    """A jump is faster than this, metres and radians per second, ..."""
    contrast: float = 3.0
    """... and by this factor faster than the motion before and after it: vehicles may be fast."""
    hold: float = 1e-6
    """A pose is held until less than this time before a jump, seconds; larger than the resolution of a stamp."""


SETTINGS = OdometrySettings()


def choose_odometry(
    candidates: Sequence[Messages],
    *,
    wanted: str | None,
    sensor_topics: Sequence[str],
    name: str,
    note: Callable[[str], None],
) -> Messages | None:
    """The messages that tell the robot's pose; None if there are none.

    Without a choice of the person, the topic is preferred that belongs to the namespace of the sensors, then the one
    whose frames are odometry and robot base, then the one that is named odom.

    Args:
        candidates: poses by topic and frames.
        wanted: topic that the person named; None: choose.
        sensor_topics: topics of the ultrasound sensors that are used.
        name: name of the bag in error messages.
        note: called with one line that says which was chosen, and why.

    Raises:
        SonarError: no such topic, or the choice is not clear.
    """
    if wanted is not None:
        found = [one for one in candidates if one.topic.strip("/") == wanted.strip("/")]
        if not found:
            came = ", ".join(dict.fromkeys(one.topic for one in candidates)) or "no odometry"
            raise SonarError(
                f"{shown(name)}: --odometry-topic {shown(wanted)}: no such odometry; {shown(came, 400)} came"
            )
        candidates = found
    elif not candidates:
        note("odometry: none came, so the poses are unknown")
        return None
    ranks = [_rank(one, sensor_topics) for one in candidates]
    best = [one for one, rank in zip(candidates, ranks, strict=True) if rank == max(ranks)]
    why = "chosen by --odometry-topic" if wanted else "the only one"
    if wanted is None and len(candidates) > 1:
        by_namespace = len({rank[0] for rank in ranks}) > 1
        why = f"chosen of {len(candidates)} by {'its namespace, that of the sensors' if by_namespace else 'its frames'}"
    if len(best) > 1:
        named = [one for one in best if one.topic.strip("/") == "odom"]
        named = named or [one for one in best if one.topic.split("/")[-1] == "odom"]
        if len(named) != 1:
            listed = ", ".join(f"{one.topic} ({one.path})" for one in best)
            raise SonarError(
                f"{shown(name)}: {len(best)} odometry topics came: {shown(listed, 600)}; choose one with "
                f"--odometry-topic {shown(best[0].topic)}"
            )
        best, why = named, f"chosen of {len(candidates)} by its name"
    others = [one for one in candidates if one is not best[0]]
    rest = f"; not used: {', '.join(f'{one.topic} ({one.path})' for one in others)}" if others else ""
    note(f"odometry: {best[0].topic} ({best[0].path}), {why}{shown(rest, 400)}")
    return best[0]


def _rank(one: Messages, sensor_topics: Sequence[str]) -> tuple[int, int, int]:
    """Namespace of the sensors; frame of odometry rather than of a map; child frame is the base of the robot."""
    first = {topic.strip("/").split("/")[0] for topic in sensor_topics if topic.strip("/").count("/")}
    parts = one.topic.strip("/").split("/")
    same = len(parts) > 1 and len(first) == 1 and parts[0] in first
    parent, child = one.frame.split("/")[-1].lower(), one.child.split("/")[-1].lower()
    kind = 2 if "odom" in parent else 0 if parent in ("map", "world", "earth", "utm") else 1
    return int(same), kind, int(child.startswith("base") or not child)


@dataclass(frozen=True, eq=False)
class Odometry:
    """Poses of the robot at the rate of its odometry."""

    samples: Float[np.ndarray, "samples 4"]
    """Stamp (s), x, y (m), theta (rad), in ascending order, as ``Log.odometry``. Before a jump the pose is held."""
    part: Int[np.ndarray, " samples"]
    """Number of the part without a jump that each sample belongs to."""

    @classmethod
    def of(
        cls, time: Float[np.ndarray, " messages"], pose: Float[np.ndarray, "messages 3"], note: Callable[[str], None]
    ) -> "Odometry":
        """Odometry from messages in any order. Those without a finite pose are left out.

        Args:
            time: seconds.
            pose: x, y (m), theta (rad); NaN if a message has none.
            note: called with one line for left-out messages and for jumps.
        """
        known = np.isfinite(time) & np.isfinite(pose).all(axis=1)
        if not known.all():
            note(f"odometry: {int((~known).sum())} messages without a finite pose or orientation are left out")
        time, first = np.unique(time[known], return_index=True)
        pose = pose[known][first]
        step, turn = np.hypot(*np.diff(pose[:, :2], axis=0).T), np.abs(wrap_angle(np.diff(pose[:, 2])))
        jump = np.zeros(len(step), bool)
        for motion, least, fastest in zip((step, turn), SETTINGS.jump, SETTINGS.max_speed, strict=True):
            jump |= _jumps(motion, np.diff(time), least, fastest)
        if jump.size and jump[-1]:  # nothing follows this pose
            time, pose, jump = time[:-1], pose[:-1], jump[:-1]
        rows = np.flatnonzero(jump)
        if len(rows):
            k = rows[np.argmax(step[rows])]
            largest = f"{step[k]:.2f} m and {np.degrees(turn[k]):.0f} deg at {time[k + 1]:.3f} s"
            cause = "it began again or was corrected, and walls seen before and after do not fit together"
            times = "once" if len(rows) == 1 else f"{len(rows)} times"
            note(f"warning: the odometry jumps {times}, by {largest}; {cause}; map the parts separately")
        # The pose is held until just before the jump, so that nothing is interpolated across it.
        held = np.column_stack([np.nextafter(time[rows + 1], -np.inf), pose[rows]])
        samples = np.insert(np.column_stack([time, pose]), rows + 1, held, axis=0)
        part = np.append(0, np.cumsum(jump))[: len(time)].astype(np.int64)
        part = np.insert(part, rows + 1, part[rows])
        odometry = cls(samples, part)
        odometry._warn_if_slow(note)
        return odometry

    def _warn_if_slow(self, note: Callable[[str], None]) -> None:
        """Report poses that are interpolated over a long time in which the robot moved."""
        if len(self.samples) < 2:
            return
        gap, step, turn, still = self._steps()
        slow = (gap > SETTINGS.max_gap) & (gap <= self._longest_gap) & ~still
        if slow.any():
            motion = f"{step[slow].max():.2f} m and {np.degrees(turn[slow].max()):.0f} deg"
            what = f"the odometry has a pose only every {np.median(gap[slow]):.1f} s"
            moves = f"the robot moves by up to {motion} in between"
            note(f"warning: {what}, and {moves}; interpolated poses may be wrong; record the odometry more often")

    @property
    def _longest_gap(self) -> float:
        """Time over which poses of a moving robot are interpolated, seconds."""
        return max(SETTINGS.max_gap, SETTINGS.max_gap_periods * float(np.median(np.diff(self.samples[:, 0]))))

    def _steps(
        self,
    ) -> tuple[
        Float[np.ndarray, " steps"],
        Float[np.ndarray, " steps"],
        Float[np.ndarray, " steps"],
        Bool[np.ndarray, " steps"],
    ]:
        """Seconds, metres and radians between samples, and whether the robot stood still."""
        gap, pose = np.diff(self.samples[:, 0]), self.samples[:, 1:]
        step, turn = np.hypot(*np.diff(pose[:, :2], axis=0).T), np.abs(wrap_angle(np.diff(pose[:, 2])))
        still = (step <= SETTINGS.still[0]) & (turn <= SETTINGS.still[1])
        still &= np.append(gap[1:] >= SETTINGS.hold, True)  # not if the pose is only held
        return gap, step, turn, still

    def poses(self, time: Float[np.ndarray, " times"]) -> Float[np.ndarray, "times 3"]:
        """world_from_robot at some times; NaN where the odometry has a gap, and before and after it."""
        if len(self.samples) < 2:  # one pose does not tell whether the robot moved
            return np.full((len(time), 3), np.nan)
        pose = poses_at(self.samples[:, 0], self.samples[:, 1:], time)
        return np.where(self.known(time)[:, None], pose, np.nan)

    def known(self, time: Float[np.ndarray, " times"]) -> Bool[np.ndarray, " times"]:
        """Whether the pose is known at some times."""
        if len(self.samples) < 2:
            return np.zeros(len(time), bool)
        stamp, longest = self.samples[:, 0], self._longest_gap
        gap, _, _, still = self._steps()
        closed = (gap <= longest) | still
        before = np.searchsorted(stamp, time, side="right") - 1
        inside = (before >= 0) & (before < len(stamp) - 1)
        margin = np.minimum(gap[[0, -1]], longest)
        outside = (time >= stamp[0] - margin[0]) & (time <= stamp[-1] + margin[1])
        return np.where(inside, closed[np.clip(before, 0, len(gap) - 1)], outside)

    def part_at(self, time: Float[np.ndarray, " times"]) -> Int[np.ndarray, " times"]:
        """Number of the part without a jump at some times."""
        before = np.clip(np.searchsorted(self.samples[:, 0], time, side="right") - 1, 0, len(self.samples) - 1)
        return self.part[before]


def _jumps(
    motion: Float[np.ndarray, " steps"], dt: Float[np.ndarray, " steps"], least: float, fastest: float
) -> Bool[np.ndarray, " steps"]:
    """Which steps between messages are jumps.

    Args:
        motion: distance or angle of each step.
        dt: time of each step, seconds.
        least: smallest jump.
        fastest: smallest speed of a jump.
    """
    speed = motion / dt
    near = np.maximum(np.append(0.0, speed[:-1]), np.append(speed[1:], 0.0)) if len(speed) else speed
    return (motion > least) & (speed > fastest) & (speed > SETTINGS.contrast * near)
