"""Logs of sensors that fire one after another: as full scans, and with one scan per firing."""

from dataclasses import replace

import numpy as np
from support.hard_cones import simulate

from jaxsonar import Log


def fire_in_turn(ring, room, trajectory, scans, *, period=0.025, **errors):
    """Simulated scans in which one sensor fires after the other.

    Args:
        ring: the sensors.
        room: what they hear.
        trajectory: the pose (x, y, theta) at the time of each firing, from an array of times (seconds).
        scans: number of scans.
        period: time between two firings, seconds.
        **errors: of ``simulate``.

    Returns:
        The log of full scans, with ``t`` and the odometry of all firings; and the same with one scan per firing. Both
        hold a row for every path that was measured.
    """
    firings = scans * ring.count
    time = period * np.arange(firings)
    pose = trajectory(time)
    every = simulate(ring, room, pose, **errors)
    transmitter = ring.paths[:, 0]
    own = transmitter[every.path] == every.scan % ring.count
    firing, path, reported = every.scan[own], every.path[own], every.range[own]
    # Paths of the transmitter that heard nothing.
    measured = np.argwhere(transmitter == (np.arange(firings) % ring.count)[:, None])
    silent = measured[~np.isin(measured @ (len(ring.paths), 1), firing * len(ring.paths) + path)]
    firing, path = np.concatenate([firing, silent[:, 0]]), np.concatenate([path, silent[:, 1]])
    reported = np.concatenate([reported, np.full(len(silent), np.nan)])
    order = np.lexsort((path, firing))
    firing, (tx, rx), reported = firing[order], ring.paths[path[order]].T, reported[order]
    alone = Log.from_echoes(firing, tx, rx, reported, stamp=time, pose=pose)
    first = np.arange(0, firings, ring.count)
    together = Log.from_echoes(
        firing // ring.count,
        tx,
        rx,
        reported,
        t=time[firing] - time[first][firing // ring.count],
        stamp=time[first],
        pose=pose[first],
        odometry=np.column_stack([time, pose]),
    )
    return together, alone


def explicit(ring, log, measured):
    """The log with rows of silence, and with readings of the measured (scans, paths) only."""
    path = ring.path_index[log.tx, log.rx]
    kept = measured[log.echo_scan, path]
    scan, path, reported = log.echo_scan[kept], path[kept], log.range[kept]
    heard = np.zeros_like(measured)
    heard[scan, path] = True
    more = np.argwhere(measured & ~heard)
    scan, path = np.concatenate([scan, more[:, 0]]), np.concatenate([path, more[:, 1]])
    order = np.argsort(scan, kind="stable")
    tx, rx = ring.paths[path[order]].T
    reported = np.concatenate([reported, np.full(len(more), np.nan)])[order]
    nothing = np.zeros((0, 2), np.int64)
    return Log.from_echoes(scan[order], tx, rx, reported, stamp=log.stamp, pose=log.pose, scan=log.scan, asked=nothing)


def repeat_readings(log, *, age, poses):
    """The log with a second copy of every scan, a while later at another pose, that renewed no reading."""
    late = [
        replace(scan, scan=scan.scan + 10_000, stamp=scan.stamp + age, pose=pose, age=np.full(len(scan.tx), age))
        for scan, pose in zip(log, poses, strict=True)
    ]
    return Log.from_scans([scan for pair in zip(log, late, strict=True) for scan in pair])
