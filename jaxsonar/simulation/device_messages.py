"""What a device would have said: a scan log, or a robot on its way through a room, as firing groups and poses."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.messages import ECHO, Group, Message, Pose
from jaxsonar.hardware.protocol import MAX_ANGLE, MAX_POSITION, MAX_TIME_OF_FLIGHT_US
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import REFERENCE_SPEED_OF_SOUND, Ring
from jaxsonar.simulation.simulator import simulate

LARGEST = {"scan": 2**32, "echo": 2**8}
"""Numbers on the wire are below these."""


def log_messages(log: Log, ring: Ring, *, moving: bool = False, temperature: float = np.nan) -> Iterator[Message]:
    """The messages that give this log again once they are put together.

    A scan begins at its stamp; its groups follow one another as fast as sound allows, or faster where the next scan
    begins before that. Without stamps the scans follow one another at once.

    Args:
        log: what was heard. Ranges become times of flight at the reference speed of sound, whatever the temperature.
        ring: which sensors fire together.
        moving: False: the scan's pose before its first group. True: a pose before every group, on the way from the
            pose of one scan to that of the next; a log's pose is then that of the scan's last group.
        temperature: of the air, as the device would measure it, deg C; NaN if it does not.

    Raises:
        SonarError: sensors that the ring does not have, or numbers and times that no device can send. Only this call
            raises; what it returns does not.
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
    """The messages of a device on a robot that moves while the groups of a scan fire.

    Each group is simulated from the pose at which it fires, on the way from the pose of one scan to that of the next.

    Args:
        ring: the sensors.
        room: what reflects.
        poses: world_from_robot (x, y, theta; metres, radians) of the last group of every scan.
        stamps: when the first group of every scan fires, seconds.
        temperature: of the air, as the device would measure it, deg C; NaN if it does not.
        settings: further keywords of ``simulate``.

    Raises:
        SonarError: a value out of range, named with what is allowed.
    """
    group_of = _group_of(ring)
    time = _group_times(ring, stamps)
    groups = time.shape[1]
    pose = _group_poses(poses, time)
    heard = simulate(ring, room, pose.reshape(-1, 3), stamps=time.reshape(-1), **settings)
    tx, rx = ring.paths[heard.path].T
    own = group_of[tx] == heard.scan % groups  # what the others would have heard from there they did not
    part = Log.from_echoes(
        heard.scan[own] // groups,
        tx[own],
        rx[own],
        heard.range[own],
        amplitude=heard.amplitude[own],
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
    for column in (log.tx, log.rx):
        if len(column) and column.max() >= ring.count:
            echo = int(np.argmax(column >= ring.count))
            place = f"log: scan {log.scan[log.echo_scan[echo]]}"
            raise SonarError(f"{place}: sensor {column[echo]} came; allowed with this ring is 0 to {ring.count - 1}")
    wrong = (log.scan < 0) | (log.scan >= LARGEST["scan"])
    if wrong.any():
        allowed = f"0 to {LARGEST['scan'] - 1}"
        raise SonarError(f"log: scan {log.scan[wrong][0]} came; allowed for a device is {allowed}")
    far = (np.abs(log.pose) > [MAX_POSITION, MAX_POSITION, MAX_ANGLE]).any(axis=1)
    if far.any():
        came = f"scan {log.scan[far][0]}: pose {tuple(log.pose[far][0].tolist())}"
        allowed = f"x and y up to {MAX_POSITION:g} m, theta up to {MAX_ANGLE:g} rad"
        raise SonarError(f"log: {came} came; allowed for a device are {allowed}")


def _group_times(ring: Ring, stamps: Float[np.ndarray, " scans"]) -> Float[np.ndarray, "scans groups"]:
    """When every group fires, seconds."""
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
    """Poses at the times of the groups, those of the last groups given; NaN in scans that have none."""
    there = ~np.isnan(poses[:, 0])
    if not there.any():
        return np.full((*time.shape, 3), np.nan)
    known, at = poses[there], time[there, -1]
    unwrapped = np.column_stack([known[:, :2], np.unwrap(known[:, 2])])
    pose = np.stack([np.interp(time, at, column) for column in unwrapped.T], axis=-1)
    pose[..., 2] = wrap_angle(pose[..., 2])
    pose[:, -1] = poses  # to the last bit
    pose[~there] = np.nan
    return pose


def _echoes(log: Log) -> np.ndarray:
    """The log's echoes as a device writes them, in the log's order."""
    echoes = np.empty(len(log.tx), dtype=ECHO)
    order = np.lexsort([log.range, log.rx, log.tx, log.echo_scan])
    same = np.ones(len(order), dtype=bool)
    for column in (log.echo_scan, log.tx, log.rx):
        same[1:] &= np.diff(column[order]) == 0
    same[:1] = False
    first = np.maximum.accumulate(np.where(same, 0, np.arange(len(order))))
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order)) - first  # nearest first
    if len(number) and number.max() >= LARGEST["echo"]:
        raise SonarError(f"log: {number.max() + 1} echoes of one path in one scan; allowed are up to {LARGEST['echo']}")
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
    """One scan after the other; a scan's first groups have a pose each, as many as there are poses."""
    scans, groups = time.shape
    key = log.echo_scan * groups + group_of[log.tx]
    order = np.argsort(key, kind="stable")
    echoes = _echoes(log)[order]
    start = np.searchsorted(key[order], np.arange(scans * groups + 1)).tolist()
    time_us = np.round(time * 1e6).astype(np.int64).tolist()
    numbers, poses = log.scan.tolist(), pose.tolist()

    def one_by_one() -> Iterator[Message]:
        sequence, placed = 0, False
        for i in range(scans):
            for k in range(groups):
                if k < len(poses[i]):
                    known = poses[i][k][0] == poses[i][k][0]  # not NaN
                    if known or placed:  # an unknown one is sent once, so that no earlier one holds
                        yield Pose(sequence % 2**32, time_us[i][k], *poses[i][k])
                        sequence += 1
                    placed = known
                part = echoes[start[i * groups + k] : start[i * groups + k + 1]]
                yield Group(sequence % 2**32, time_us[i][k], numbers[i], k, groups, temperature, part)
                sequence += 1

    return one_by_one()
