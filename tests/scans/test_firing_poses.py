"""Poses of readings against a trajectory in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from jaxsonar.geometry.se2 import compose, subtract_poses
from jaxsonar.scans.firing_poses import path_poses, reading_motion, reading_poses
from jaxsonar.scans.measured_paths import measured_paths
from jaxsonar.scans.readings import explicit_log
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

RING = Ring.circular(count=4, neighbors=1)


def arc(time, *, turn=0.7, speed=0.4):
    """Pose of a robot that drives on a circle, at some times."""
    time = np.asarray(time, np.float64)
    radius = speed / turn
    theta = turn * time
    return np.stack([1.0 + radius * np.sin(theta), 2.0 + radius * (1 - np.cos(theta)), theta], axis=-1)


def assert_same_poses(found, expected):
    np.testing.assert_allclose(subtract_poses(np.asarray(found), np.asarray(expected)), 0, atol=1e-9)


def full_scans(t, age, *, stamps=(3.0, 3.4, 3.8, 4.2)):
    """Scans of all four direct paths, with one ``t`` and ``age`` for each sensor."""
    scans = len(stamps)
    sensor = np.tile(np.arange(4), scans)
    return Log.from_echoes(
        np.repeat(np.arange(scans), 4),
        sensor,
        sensor,
        1 + np.arange(4.0 * scans) / 100,
        t=np.tile(t, scans),
        age=np.tile(age, scans),
        stamp=np.array(stamps),
        pose=arc(stamps),
    )


def test_readings_have_the_pose_of_their_time_of_measurement():
    t, age = np.array([0.0, 0.1, 0.2, 0.3]), np.array([0.0, 0.05, 0.0, 0.15])
    log = full_scans(t, age)
    assert_same_poses(reading_poses(log), arc(log.stamp[log.echo_scan] + log.t - log.age))


def test_odometry_at_its_own_rate_replaces_the_poses_of_the_scans():
    log = full_scans(np.array([0.0, 0.1, 0.2, 0.3]), np.zeros(4))
    time = np.arange(2.9, 4.7, 0.02)
    swerving = arc(time) + 0.05 * np.sin(9 * time)[:, None]
    at = lambda when: np.stack([np.interp(when, time, column) for column in swerving.T], axis=-1)  # noqa: E731
    log = replace(log, pose=at(log.stamp), odometry=np.column_stack([time, swerving]))
    found = reading_poses(log)
    assert np.abs(subtract_poses(found, at(log.stamp[log.echo_scan] + log.t))).max() < 1e-3
    without = reading_poses(replace(log, odometry=None))
    assert np.abs(without - found).max() > 0.02


def test_motion_within_a_scan_does_not_depend_on_corrections_of_the_poses():
    log = full_scans(np.array([0.0, 0.1, 0.2, 0.3]), np.zeros(4))
    log = replace(log, odometry=np.column_stack([log.stamp, log.pose]))
    correction = np.array([0.3, -0.2, 0.5])
    moved = replace(log, pose=compose(correction, log.pose))
    assert_same_poses(reading_motion(moved), reading_motion(log))


@pytest.mark.parametrize("missing", ["stamp", "pose"])
def test_readings_belong_to_the_pose_of_their_scan_if_the_motion_is_unknown(missing):
    log = full_scans(np.array([0.0, 0.1, 0.2, 0.3]), np.zeros(4))
    log = replace(log, **{missing: np.full_like(getattr(log, missing), np.nan)})
    for unknown in (log, full_scans(np.array([0.0, 0.1, 0.2, 0.3]), np.zeros(4), stamps=(3.0,))):
        assert reading_motion(unknown) is None
        np.testing.assert_array_equal(reading_poses(unknown), unknown.pose[unknown.echo_scan])


def test_the_motion_beyond_the_last_pose_is_extrapolated_by_one_interval_only():
    log = full_scans(np.array([0.0, 0.1, 0.3, 9.0]), np.zeros(4))
    found = reading_poses(log)[-4:]
    assert_same_poses(found[:3], arc(4.2 + np.array([0.0, 0.1, 0.3])))
    assert_same_poses(found[3], arc(4.6))


def test_paths_have_the_pose_of_their_readings():
    log = full_scans(np.array([0.0, 0.1, 0.2, 0.3]), np.zeros(4))
    poses = path_poses(RING, log)
    assert poses is not None
    direct = RING.path_index[np.arange(4), np.arange(4)]
    assert_same_poses(poses[:, direct].reshape(-1, 3), reading_motion(log))
    assert not np.delete(poses, direct, axis=1).any()


@pytest.mark.parametrize("whole_transmitter", [False, True])
def test_a_silent_path_of_an_implicit_log_has_the_time_of_its_transmitter(whole_transmitter):
    """All paths of a circle of four sensors; one path, or all of one transmitter, without a reading in scan 1."""
    stamps, (tx, rx) = np.array([3.0, 3.4, 3.8]), np.tile(RING.paths, (3, 1)).T
    scan = np.repeat(np.arange(3), len(RING.paths))
    columns = (scan, tx, rx, np.ones(len(scan)), 0.1 * tx)
    kept = ~((scan == 1) & (tx == 3) & (whole_transmitter | (rx == 3)))
    scan, tx, rx, heard, t = (column[kept] for column in columns)
    log = Log.from_echoes(scan, tx, rx, heard, t=t, stamp=stamps, pose=arc(stamps))
    poses = path_poses(RING, log)
    assert poses is not None
    assert measured_paths(RING, log).all()
    fired = stamps[:, None] + 0.1 * RING.paths[:, 0]
    assert_same_poses(compose(log.pose[:, None], poses), arc(fired))
    listed = explicit_log(log)
    np.testing.assert_allclose(listed.t, 0.1 * listed.tx)


def test_scans_of_a_robot_that_fires_at_once_are_not_changed():
    log = full_scans(np.zeros(4), np.zeros(4))
    assert path_poses(RING, log) is None
