"""Echoes that move with the robot, added to logs."""

import numpy as np

from jaxsonar import Log
from jaxsonar.scans.readings import explicit_log


def with_robot_echoes(log, pairs, ranges, *, sigma=0.003, present=1.0, single_echo=False, seed=0):
    """The log with constant echoes, and the mask of these among its readings.

    Args:
        log: the scans.
        pairs: (tx, rx) of each echo.
        ranges: its range, metres.
        sigma: standard deviation of its noise, metres.
        present: probability of each echo.
        single_echo: whether each path reports its nearest echo only.
        seed: seed of the noise.
    """
    rng = np.random.default_rng(seed)
    scan = np.repeat(np.arange(len(log)), len(pairs))
    tx, rx = np.tile(np.asarray(pairs), (len(log), 1)).T
    added = np.tile(ranges, len(log)) + sigma * rng.standard_normal(len(scan))
    kept = rng.random(len(scan)) < present
    heard = np.isfinite(log.range)
    columns = [
        np.concatenate([old[heard], new[kept]])
        for old, new in ((log.echo_scan, scan), (log.tx, tx), (log.rx, rx), (log.range, added))
    ]
    is_robot = np.append(np.zeros(heard.sum(), bool), np.ones(kept.sum(), bool))
    order = np.lexsort((columns[3], columns[2], columns[1], columns[0]))
    if single_echo:
        path = np.stack([column[order] for column in columns[:3]])
        order = order[np.append(True, (np.diff(path) != 0).any(axis=0))]
    scan, tx, rx, reported = (column[order] for column in columns)
    asked = np.unique(np.concatenate([log.asked, np.asarray(pairs).reshape(-1, 2)]), axis=0)
    return Log.from_echoes(scan, tx, rx, reported, stamp=log.stamp, pose=log.pose, asked=asked), is_robot[order]


def drive(corners, *, step=0.1, turn=0.35):
    """Poses of a robot that drives straight from corner to corner and turns there."""
    poses, heading, here = [], None, np.array(corners[0], np.float64)
    for corner in np.array(corners[1:], np.float64):
        way = corner - here
        ahead = np.arctan2(way[1], way[0])
        heading = ahead if heading is None else heading
        angle = (ahead - heading + np.pi) % (2 * np.pi) - np.pi
        turns, steps = int(np.ceil(abs(angle) / turn)), max(1, int(np.ceil(np.hypot(*way) / step)))
        poses += [[*here, heading + angle * (k + 1) / turns] for k in range(turns)]
        poses += [[*(here + way * k / steps), ahead] for k in range(1, steps + 1)]
        heading, here = ahead, corner
    return np.array(poses)


def same_measurements(one, other):
    """Whether two logs hold the same echoes and the same silence, in whatever form."""
    first, second = (
        np.unique(np.column_stack([log.echo_scan, log.tx, log.rx, np.nan_to_num(log.range, nan=-1.0)]), axis=0)
        for log in (explicit_log(one), explicit_log(other))
    )
    return np.array_equal(first, second)
