"""Odometry that jumps: the trajectory goes on where the robot did, and is cut where it is not known."""

from dataclasses import replace

import numpy as np
import pytest
from support.hard_cones import simulate
from support.slam_scene import ODOMETRY_NOISE, RING, ROOM, SIGMA, truth
from support.wandering_robot import RING as NARROW
from support.wandering_robot import log_of, ranges, trajectory

from jaxsonar.cli.slam_summary import as_json, summary_lines
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.geometry.se2 import compose, relative, wrap_angle
from jaxsonar.graph_slam.interrupted_odometry import InterruptedOdometryNoise, continue_odometry
from jaxsonar.graph_slam.slam import slam
from jaxsonar.simulation.wheel_odometry import simulate_odometry

WIDE = replace(NARROW, beam=np.full(NARROW.count, np.radians(45.0)))


def restarted(pose, row, at=(0.0, 0.0, 0.0)):
    """Poses that begin again at a pose before the scan of a row."""
    return np.concatenate([pose[:row], compose(np.array(at), relative(pose[row], pose[row:]))])


def heard(pose, odometry):
    return log_of(ranges(pose, ring=WIDE), odometry)


@pytest.mark.parametrize("row", [40, 77, 150, 199])
def test_the_trajectory_goes_on_over_a_restart(row):
    pose = trajectory(200)
    found = continue_odometry(WIDE, heard(pose, restarted(pose, row)))
    assert found.bridged.tolist() == [row]
    assert found.parts == (slice(0, 200),)
    off = found.log.pose - pose
    assert np.hypot(*off[:, :2].T).max() < 0.02
    assert np.abs(wrap_angle(off[:, 2])).max() < 0.04


def test_several_restarts_are_bridged_and_a_sound_log_is_not_changed():
    pose = trajectory(300)
    found = continue_odometry(WIDE, heard(pose, restarted(restarted(pose, 90), 200, (4.0, 2.0, 1.0))))
    assert found.bridged.tolist() == [90, 200]
    assert np.hypot(*(found.log.pose - pose)[:, :2].T).max() < 0.05
    log = heard(pose, pose)
    assert continue_odometry(WIDE, log).log is log


def test_odometry_at_its_own_rate_goes_on_as_well():
    """Samples between the scans belong to the side of the jump on which they are."""
    pose = trajectory(400, step=0.02)
    odometry = restarted(pose, 203)
    log = heard(pose[::2], odometry[::2])
    samples = np.column_stack([100 + 0.05 * np.arange(400), odometry])
    found = continue_odometry(WIDE, replace(log, stamp=samples[::2, 0], odometry=samples))
    assert found.bridged.tolist() == [102]
    assert found.log.odometry is not None
    assert np.hypot(*(found.log.odometry[:, 1:] - pose)[:, :2].T).max() < 0.03


def test_a_robot_that_was_carried_leaves_two_parts():
    pose = trajectory(300)
    pose = np.concatenate([pose[:60], pose[200:]])
    found = continue_odometry(WIDE, heard(pose, restarted(pose, 60, (2.0, 1.0, 0.5))))
    assert found.parts == (slice(0, 60), slice(60, 160))
    assert found.largest_part == slice(60, 160)
    assert not len(found.bridged)


def test_only_steps_over_a_jump_are_less_certain():
    noise, pose = OdometryNoise(), trajectory(10)
    rows = np.array([0, 1, 4, 6, 9])
    interrupted = InterruptedOdometryNoise(noise, np.array([1, 5]))(pose, rows)
    same = interrupted == noise(pose, rows)
    assert same.all(axis=1).tolist() == [False, True, False, True]
    assert (interrupted >= noise(pose, rows)).all()
    np.testing.assert_array_equal(InterruptedOdometryNoise(noise, rows[:0])(pose, rows), noise(pose, rows))


def log_with(odometry, poses):
    return simulate(RING, ROOM, poses, sigma=SIGMA, seed=1).as_log(RING, odometry)


@pytest.mark.slow
def test_slam_is_as_accurate_with_a_restart_as_without():
    pose = truth()[:24]
    odometry = simulate_odometry(pose, distance=0.02, turn=float(np.radians(1.0)), seed=2)
    found = slam(RING, log_with(restarted(odometry, 12), pose), odometry_noise=ODOMETRY_NOISE, smooth=False)
    (jump,) = found.jumps
    assert jump.after == 12
    off = relative(found.poses[0], found.poses) - relative(pose[0], pose)
    assert np.hypot(*off[:, :2].T).max() < 0.05
    (line,) = [line for line in summary_lines(found, None) if "odometry jumps" in line]
    assert "at scan 12" in line
    assert "continues" in line
    (entry,) = as_json(found, None)["odometry_jumps"]
    assert (entry["scan"], entry["bridged"]) == (12, True)


def test_slam_gives_no_pose_to_the_smaller_part_of_a_log_whose_parts_are_not_tied():
    pose = np.concatenate([truth()[:6], truth()[30:44]])
    odometry = np.concatenate([pose[:6], pose[6:] + np.array([20.0, 5.0, 0.0])])
    found = slam(RING, log_with(odometry, pose), odometry_noise=ODOMETRY_NOISE, smooth=False)
    assert np.isnan(found.poses[:6]).all()
    off = relative(found.poses[6], found.poses[6:]) - relative(pose[6], pose[6:])
    assert np.hypot(*off[:, :2].T).max() < 0.05
    assert found.left_out.tolist() == [0, 1, 2, 3, 4, 5]
    (line,) = [line for line in summary_lines(found, None) if "odometry jumps" in line]
    assert "the scans before it have no pose" in line
    assert as_json(found, None)["odometry_jumps"][0]["bridged"] is False
