"""Device messages (firing groups and poses) from a scan log, or from a robot that moves through a room."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.se2 import compose, relative
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.messages import ECHO, REFERENCE_SPEED_OF_SOUND, Group, Message, Pose
from jaxsonar.hardware.protocol import MAX_ANGLE, MAX_POSITION, MAX_TIME_OF_FLIGHT_US
from jaxsonar.scans.firing_poses import poses_at
from jaxsonar.scans.readings import firing_times, unique_readings
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.simulation.simulator import simulate

MAX_GROUPS = 256
"""Largest number of firing groups in a scan of the protocol."""
NUMBER_LIMITS = {"scan": 2**32, "echo": 2**8}
"""Exclusive upper bounds of numbers in the protocol."""


def log_messages(log: Log, ring: Ring, *, moving: bool = False, temperature: float = np.nan) -> Iterator[Message]:
    """Messages from which the receiver assembles this log again.

    Each group is sent at the time of its readings, stamp + t, with the pose of the robot at that time. If the log tells
    what its scans measured (``Log.asked`` is empty), only groups that fired are sent; otherwise all groups. Groups are
    those of the ring, or single sensors if the sensors of a group did not fire together. Scans without stamps follow
    each other immediately. Repeated old readings are omitted (``unique_readings``).

    Args:
        log: the scans. Ranges become times of flight at the reference speed of sound, at any temperature.
        ring: determines which sensors fire simultaneously.
        moving: True: the groups of a scan follow each other after the time of flight of the maximum range, or sooner
            if the next scan starts before that. Only for logs without times of readings (``t``).
        temperature: measured air temperature in the messages, deg C; NaN if it is not measured.

    Raises:
        SonarError: sensors that the ring does not have, or numbers and times outside the protocol's limits. All errors
            are raised by this call and none by the returned iterator.
    """
    _check_log(log, ring)
    log = unique_readings(log)
    all_fire = bool(len(log.asked)) or not len(log.tx)
    plan = ring.firing_group_of_sensor
    if not _fire_together(log, plan, all_fire) and ring.count <= MAX_GROUPS:
        plan = np.arange(ring.count)
    groups = int(plan.max()) + 1
    stamps = _stamps(ring, log.stamp, groups)
    fired = np.full((len(log), groups), all_fire)
    fired[log.echo_scan, plan[log.tx]] = True
    if moving and not log.t.any():
        time = _following_times(ring, stamps, groups)
    else:
        time = stamps[:, None] + firing_times(log, plan[log.tx], groups)
    pose = _group_poses(log.pose, stamps, time, log.odometry)
    return _messages(log, plan, fired, time, pose, temperature)


def room_messages(
    ring: Ring,
    room: Room,
    poses: Float[np.ndarray, "scans 3"],
    stamps: Float[np.ndarray, " scans"],
    *,
    temperature: float = np.nan,
    **settings: Any,
) -> Iterator[Message]:
    """Messages of a device on a robot that moves while the groups of a scan fire.

    Each group is simulated at the pose where it fires, which is interpolated between the poses of consecutive scans.

    Args:
        ring: the sensors.
        room: the reflectors.
        poses: world_from_robot (x, y, theta; metres, radians) of the first group of every scan.
        stamps: when the first group of every scan fires, seconds.
        temperature: measured air temperature in the messages, deg C; NaN if it is not measured.
        settings: further keyword arguments of ``simulate``.

    Raises:
        SonarError: a value out of range; the message names it and the allowed range.
    """
    plan = ring.firing_group_of_sensor
    groups = int(plan.max()) + 1
    stamps = _stamps(ring, np.asarray(stamps), groups)
    time = _following_times(ring, stamps, groups)
    pose = _group_poses(np.asarray(poses), stamps, time, None)
    echoes = simulate(ring, room, pose.reshape(-1, 3), stamps=time.reshape(-1), **settings)
    tx, rx = ring.paths[echoes.path].T
    own = plan[tx] == echoes.scan % groups  # the simulation of each group contains all transmitters
    part = Log.from_echoes(
        echoes.scan[own] // groups,
        tx[own],
        rx[own],
        echoes.range[own],
        amplitude=echoes.amplitude[own],
        stamp=stamps,
        pose=np.asarray(poses),
    )
    _check_log(part, ring)
    return _messages(part, plan, np.ones(time.shape, bool), time, pose, temperature)


def _fire_together(log: Log, plan: Int[np.ndarray, " sensors"], all_fire: bool) -> bool:
    """Whether the sensors of each group always have equal times, and are all measured or none of them."""
    groups, scan = int(plan.max()) + 1, log.echo_scan
    earliest = np.full((len(log), groups), np.inf)
    np.minimum.at(earliest, (scan, plan[log.tx]), log.t)
    if (log.t != earliest[scan, plan[log.tx]]).any():
        return False
    fired = np.zeros((len(log), len(plan)), bool)
    fired[scan, log.tx] = True
    count = fired.astype(np.int64) @ (plan[:, None] == np.arange(groups))
    return all_fire or bool(((count == 0) | (count == np.bincount(plan))).all())


def _check_log(log: Log, ring: Ring) -> None:
    """Raise a SonarError for sensors, numbers and poses that the protocol cannot carry."""
    for column in (log.tx, log.rx):
        if len(column) and column.max() >= ring.count:
            echo = int(np.argmax(column >= ring.count))
            place = f"log: scan {log.scan[log.echo_scan[echo]]}"
            raise SonarError(f"{place}: sensor {column[echo]} came; allowed with this ring is 0 to {ring.count - 1}")
    wrong = (log.scan < 0) | (log.scan >= NUMBER_LIMITS["scan"])
    if wrong.any():
        allowed = f"0 to {NUMBER_LIMITS['scan'] - 1}"
        raise SonarError(f"log: scan {log.scan[wrong][0]} came; allowed for a device is {allowed}")
    far = (np.abs(log.pose) > [MAX_POSITION, MAX_POSITION, MAX_ANGLE]).any(axis=1)
    if far.any():
        came = f"scan {log.scan[far][0]}: pose {tuple(log.pose[far][0].tolist())}"
        allowed = f"x and y up to {MAX_POSITION:g} m, theta up to {MAX_ANGLE:g} rad"
        raise SonarError(f"log: {came} came; allowed for a device are {allowed}")


def _stamps(ring: Ring, stamps: Float[np.ndarray, " scans"], groups: int) -> Float[np.ndarray, " scans"]:
    """Stamps of the scans, seconds; scans without any follow each other immediately.

    Raises:
        SonarError: stamps that the protocol cannot carry.
    """
    if np.isnan(stamps).all():
        return np.arange(len(stamps)) * groups * _firing_interval(ring)
    wrong = ~(stamps >= 0) | ~(stamps < 2**43)  # microseconds are then exact in double precision
    wrong[1:] |= np.diff(stamps) < 0
    if wrong.any():
        allowed = "seconds from 0 up that do not fall, or none at all"
        raise SonarError(f"log: stamp {stamps[wrong][0]:g} (scans[{np.argmax(wrong)}]) came; allowed are {allowed}")
    return stamps


def _following_times(ring: Ring, stamps: Float[np.ndarray, " scans"], groups: int) -> Float[np.ndarray, "scans groups"]:
    """Time at which each group fires if the groups follow each other, seconds."""
    gap = np.append(np.diff(stamps), np.inf)
    return stamps[:, None] + np.minimum(_firing_interval(ring), gap / groups)[:, None] * np.arange(groups)


def _firing_interval(ring: Ring) -> float:
    """Time between two groups, seconds."""
    return 2 * ring.max_range / REFERENCE_SPEED_OF_SOUND


def _group_poses(
    poses: Float[np.ndarray, "scans 3"],
    stamps: Float[np.ndarray, " scans"],
    time: Float[np.ndarray, "scans groups"],
    odometry: Float[np.ndarray, "samples 4"] | None,
) -> Float[np.ndarray, "scans groups 3"]:
    """Poses of the groups: that of the scan, moved by the motion since its stamp; NaN for scans without a pose."""
    pose = np.repeat(poses[:, None], time.shape[1], axis=1)
    if odometry is None:
        odometry = np.column_stack([stamps, poses])
    known = np.isfinite(odometry).all(axis=1)
    at, first = np.unique(odometry[known, 0], return_index=True)
    moves = (time != stamps[:, None]) & np.isfinite(poses[:, :1])
    if len(at) < 2 or not moves.any():
        return pose
    there = odometry[known, 1:][first]
    motion = relative(
        poses_at(at, there, np.broadcast_to(stamps[:, None], time.shape)[moves]), poses_at(at, there, time[moves])
    )
    pose[moves] = compose(pose[moves], motion)
    return pose


def _echoes(log: Log) -> np.ndarray:
    """The echoes in the format of the protocol, in the order of the log."""
    heard = np.isfinite(log.range)
    scan, tx, rx, range_ = log.echo_scan[heard], log.tx[heard], log.rx[heard], log.range[heard]
    echoes = np.empty(len(tx), dtype=ECHO)
    order = np.lexsort([range_, rx, tx, scan])
    same = np.ones(len(order), dtype=bool)
    for column in (scan, tx, rx):
        same[1:] &= np.diff(column[order]) == 0
    same[:1] = False
    first = np.maximum.accumulate(np.where(same, 0, np.arange(len(order))))
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order)) - first  # nearest first
    if len(number) and number.max() >= NUMBER_LIMITS["echo"]:
        raise SonarError(
            f"log: {number.max() + 1} echoes of one path in one scan; allowed are up to {NUMBER_LIMITS['echo']}"
        )
    echoes["tx"], echoes["rx"], echoes["echo"], echoes["flags"] = tx, rx, number, 0
    with np.errstate(over="ignore", under="ignore"):
        echoes["time_us"] = range_ * (2e6 / REFERENCE_SPEED_OF_SOUND)
        echoes["amplitude"] = log.amplitude[heard]
    wrong = ~(echoes["time_us"] > 0) | ~(echoes["time_us"] <= MAX_TIME_OF_FLIGHT_US) | np.isinf(echoes["amplitude"])
    if wrong.any():
        came = f"range {range_[wrong][0]:g} m, amplitude {log.amplitude[heard][wrong][0]:g}"
        farthest = MAX_TIME_OF_FLIGHT_US * REFERENCE_SPEED_OF_SOUND / 2e6
        raise SonarError(f"log: {came} came; allowed for a device are up to {farthest:.0f} m and 32-bit amplitudes")
    return echoes


def _messages(
    log: Log,
    group_of: Int[np.ndarray, " sensors"],
    fired: Bool[np.ndarray, "scans groups"],
    time: Float[np.ndarray, "scans groups"],
    pose: Float[np.ndarray, "scans groups 3"],
    temperature: float,
) -> Iterator[Message]:
    """Messages scan by scan, in order of time; a pose before the first group of a scan, and before each that moved."""
    scans, groups = time.shape
    heard = np.isfinite(log.range)
    key = (log.echo_scan * groups + group_of[log.tx])[heard]
    order = np.argsort(key, kind="stable")
    echoes = _echoes(log)[order]
    start = np.searchsorted(key[order], np.arange(scans * groups + 1)).tolist()
    time_us = np.round(time * 1e6).astype(np.int64).tolist()
    numbers, poses, all_fired = log.scan.tolist(), pose.tolist(), fired.tolist()
    in_order = np.argsort(time, axis=1, kind="stable").tolist()

    def messages() -> Iterator[Message]:
        sequence, sent = 0, [np.nan] * 3
        for i in range(scans):
            is_first = True
            for k in in_order[i]:
                if not all_fired[i][k]:
                    continue
                known, was_known = poses[i][k][0] == poses[i][k][0], sent[0] == sent[0]  # not NaN
                if (known and (is_first or poses[i][k] != sent)) or was_known > known:  # an unknown pose is sent once
                    yield Pose(sequence % 2**32, time_us[i][k], *poses[i][k])
                    sequence, sent = sequence + 1, poses[i][k]
                is_first = False
                part = echoes[start[i * groups + k] : start[i * groups + k + 1]]
                yield Group(sequence % 2**32, time_us[i][k], numbers[i], k, groups, temperature, part)
                sequence += 1

    return messages()
