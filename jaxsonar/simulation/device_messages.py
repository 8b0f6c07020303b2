"""Device messages (firing groups and poses) from a scan log, or from a robot that moves through a room."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.messages import ECHO, REFERENCE_SPEED_OF_SOUND, Group, Message, Pose
from jaxsonar.hardware.protocol import MAX_ANGLE, MAX_POSITION, MAX_TIME_OF_FLIGHT_US
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.simulation.simulator import simulate

NUMBER_LIMITS = {"scan": 2**32, "echo": 2**8}
"""Exclusive upper bounds of numbers in the protocol."""


def log_messages(log: Log, ring: Ring, *, moving: bool = False, temperature: float = np.nan) -> Iterator[Message]:
    """Messages from which the receiver assembles this log again.

    A scan starts at its stamp. Its groups follow after the time of flight of the maximum range, or sooner if the next
    scan starts before that. Scans without stamps follow each other immediately.

    Args:
        log: the scans. Ranges become times of flight at the reference speed of sound, at any temperature.
        ring: determines which sensors fire simultaneously.
        moving: False: one pose per scan, before its first group. True: one pose before every group, interpolated
            between the poses of consecutive scans; the pose of a scan in the log is then that of its last group.
        temperature: measured air temperature in the messages, deg C; NaN if it is not measured.

    Raises:
        SonarError: sensors that the ring does not have, or numbers and times outside the protocol's limits. All errors
            are raised by this call and none by the returned iterator.
    """
    group_of = _group_of(ring)
    _check_log(log, ring)
    time = _group_times(ring, log.stamp)
    pose = _group_poses(log.pose, time) if moving else log.pose[:, None]
    return _messages(log, group_of, time, pose, temperature)


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
        poses: world_from_robot (x, y, theta; metres, radians) of the last group of every scan.
        stamps: when the first group of every scan fires, seconds.
        temperature: measured air temperature in the messages, deg C; NaN if it is not measured.
        settings: further keyword arguments of ``simulate``.

    Raises:
        SonarError: a value out of range; the message names it and the allowed range.
    """
    group_of = _group_of(ring)
    time = _group_times(ring, stamps)
    groups = time.shape[1]
    pose = _group_poses(poses, time)
    echoes = simulate(ring, room, pose.reshape(-1, 3), stamps=time.reshape(-1), **settings)
    tx, rx = ring.paths[echoes.path].T
    fired = group_of[tx] == echoes.scan % groups  # the simulation of each group contains all transmitters
    part = Log.from_echoes(
        echoes.scan[fired] // groups,
        tx[fired],
        rx[fired],
        echoes.range[fired],
        amplitude=echoes.amplitude[fired],
        stamp=np.asarray(stamps),
        pose=np.asarray(poses),
    )
    _check_log(part, ring)
    return _messages(part, group_of, time, pose, temperature)


def _group_of(ring: Ring) -> Int[np.ndarray, " sensors"]:
    """Firing group of every sensor."""
    group_of = np.empty(ring.count, dtype=np.int64)
    for k, sensors in enumerate(ring.firing_groups):
        group_of[sensors] = k
    return group_of


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


def _group_times(ring: Ring, stamps: Float[np.ndarray, " scans"]) -> Float[np.ndarray, "scans groups"]:
    """Time at which each group fires, seconds."""
    groups = len(ring.firing_groups)
    firing = 2 * ring.max_range / REFERENCE_SPEED_OF_SOUND
    if np.isnan(stamps).all():
        stamps = np.arange(len(stamps)) * groups * firing
    wrong = ~(stamps >= 0) | ~(stamps < 2**43)  # microseconds are then exact in double precision
    wrong[1:] |= np.diff(stamps) < 0
    if wrong.any():
        allowed = "seconds from 0 up that do not fall, or none at all"
        raise SonarError(f"log: stamp {stamps[wrong][0]:g} (scans[{np.argmax(wrong)}]) came; allowed are {allowed}")
    gap = np.append(np.diff(stamps), np.inf)
    return stamps[:, None] + np.minimum(firing, gap / groups)[:, None] * np.arange(groups)


def _group_poses(
    poses: Float[np.ndarray, "scans 3"], time: Float[np.ndarray, "scans groups"]
) -> Float[np.ndarray, "scans groups 3"]:
    """Interpolated poses of the groups; the given poses belong to the last groups. NaN for scans without a pose."""
    has_pose = ~np.isnan(poses[:, 0])
    if not has_pose.any():
        return np.full((*time.shape, 3), np.nan)
    known, at = poses[has_pose], time[has_pose, -1]
    unwrapped = np.column_stack([known[:, :2], np.unwrap(known[:, 2])])
    pose = np.stack([np.interp(time, at, column) for column in unwrapped.T], axis=-1)
    pose[..., 2] = wrap_angle(pose[..., 2])
    pose[:, -1] = poses  # without rounding
    pose[~has_pose] = np.nan
    return pose


def _echoes(log: Log) -> np.ndarray:
    """The echoes in the format of the protocol, in the order of the log."""
    echoes = np.empty(len(log.tx), dtype=ECHO)
    order = np.lexsort([log.range, log.rx, log.tx, log.echo_scan])
    same = np.ones(len(order), dtype=bool)
    for column in (log.echo_scan, log.tx, log.rx):
        same[1:] &= np.diff(column[order]) == 0
    same[:1] = False
    first = np.maximum.accumulate(np.where(same, 0, np.arange(len(order))))
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order)) - first  # nearest first
    if len(number) and number.max() >= NUMBER_LIMITS["echo"]:
        raise SonarError(
            f"log: {number.max() + 1} echoes of one path in one scan; allowed are up to {NUMBER_LIMITS['echo']}"
        )
    echoes["tx"], echoes["rx"], echoes["echo"], echoes["flags"] = log.tx, log.rx, number, 0
    with np.errstate(over="ignore", under="ignore"):
        echoes["time_us"] = log.range * (2e6 / REFERENCE_SPEED_OF_SOUND)
        echoes["amplitude"] = log.amplitude
    wrong = ~(echoes["time_us"] > 0) | ~(echoes["time_us"] <= MAX_TIME_OF_FLIGHT_US) | np.isinf(echoes["amplitude"])
    if wrong.any():
        came = f"range {log.range[wrong][0]:g} m, amplitude {log.amplitude[wrong][0]:g}"
        farthest = MAX_TIME_OF_FLIGHT_US * REFERENCE_SPEED_OF_SOUND / 2e6
        raise SonarError(f"log: {came} came; allowed for a device are up to {farthest:.0f} m and 32-bit amplitudes")
    return echoes


def _messages(
    log: Log,
    group_of: Int[np.ndarray, " sensors"],
    time: Float[np.ndarray, "scans groups"],
    pose: Float[np.ndarray, "scans poses 3"],
    temperature: float,
) -> Iterator[Message]:
    """Messages scan by scan; the first groups of a scan have one pose each, as many as there are poses."""
    scans, groups = time.shape
    key = log.echo_scan * groups + group_of[log.tx]
    order = np.argsort(key, kind="stable")
    echoes = _echoes(log)[order]
    start = np.searchsorted(key[order], np.arange(scans * groups + 1)).tolist()
    time_us = np.round(time * 1e6).astype(np.int64).tolist()
    numbers, poses = log.scan.tolist(), pose.tolist()

    def messages() -> Iterator[Message]:
        sequence, pose_valid = 0, False
        for i in range(scans):
            for k in range(groups):
                if k < len(poses[i]):
                    known = poses[i][k][0] == poses[i][k][0]  # not NaN
                    if known or pose_valid:  # an unknown pose is sent once, to invalidate the previous one
                        yield Pose(sequence % 2**32, time_us[i][k], *poses[i][k])
                        sequence += 1
                    pose_valid = known
                part = echoes[start[i * groups + k] : start[i * groups + k + 1]]
                yield Group(sequence % 2**32, time_us[i][k], numbers[i], k, groups, temperature, part)
                sequence += 1

    return messages()
