"""Odometry with heading slips: the whole log is turned, and the steps around a slip are uncertain."""

from dataclasses import replace

import numpy as np
import pytest
from support.wandering_robot import RING, log_of, ranges, trajectory

from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.geometry.se2 import compose, wrap_angle
from jaxsonar.graph_slam.slam import slam
from jaxsonar.graph_slam.slipped_odometry import SlippedOdometryNoise, repair_heading_slips
from jaxsonar.registration.heading_slips import HeadingSlip, slip_transform

TRUE = trajectory(160)
SPARSE = replace(RING, beam=np.full(RING.count, np.radians(20.0)))
ROW, ANGLE = 75, np.radians(25.0)


def slipped(pose):
    moved = slip_transform(pose, HeadingSlip(ROW, ROW, -ANGLE, 0.0))
    return np.concatenate([pose[: ROW + 1], compose(moved, pose[ROW + 1 :])])


@pytest.fixture(scope="module")
def log():
    return log_of(ranges(TRUE, sigma=0.01, ring=SPARSE), slipped(TRUE))


def test_poses_and_odometry_at_its_own_rate_are_turned_alike(log):
    samples = np.column_stack([log.stamp, log.pose])
    repaired, slips = repair_heading_slips(SPARSE, replace(log, odometry=samples))
    assert len(slips) == 1
    assert repaired.odometry is not None
    np.testing.assert_allclose(repaired.odometry[:, 1:], repaired.pose, atol=1e-12)
    assert np.abs(wrap_angle(repaired.pose[:, 2] - TRUE[:, 2])).max() < np.radians(26.0)
    assert np.abs(repaired.pose[-1, :2] - TRUE[-1, :2]).max() < 0.4
    np.testing.assert_array_equal(log.pose, slipped(TRUE))  # the given log is as it was


def test_logs_without_stamps_are_repaired(log):
    unstamped = replace(log, stamp=np.full(len(log), np.nan))
    repaired, slips = repair_heading_slips(SPARSE, unstamped)
    assert len(slips) == 1
    assert np.abs(repaired.pose[-1, :2] - TRUE[-1, :2]).max() < 0.4


def test_only_steps_around_the_slip_are_less_certain():
    usual = OdometryNoise()
    noise = SlippedOdometryNoise(usual, (HeadingSlip(ROW, ROW, ANGLE, 30.0),))
    rows = np.arange(len(TRUE))
    before, after = usual(TRUE, rows), noise(TRUE, rows)
    np.testing.assert_array_equal(after[:, :2], before[:, :2])
    more = after[:, 2] ** 2 - before[:, 2] ** 2
    assert np.sqrt(more.sum()) == pytest.approx(ANGLE)
    assert (np.flatnonzero(more > 1e-12) >= ROW - 3).all()
    assert (np.flatnonzero(more > 1e-12) <= ROW + 3).all()


def test_slam_reports_a_slip_in_several_steps_and_repairs_it(log):
    pose = TRUE
    for row in range(ROW - 3, ROW + 2):
        moved = slip_transform(pose, HeadingSlip(row, row, -ANGLE / 5, 0.0))
        pose = np.concatenate([pose[: row + 1], compose(moved, pose[row + 1 :])])
    log = replace(log, pose=pose)
    found = slam(SPARSE, log, window=1.5)
    (slip,) = found.slips
    assert np.degrees(slip.angle) == pytest.approx(25.0, abs=4.0)
    np.testing.assert_array_equal(found.odometry, log.pose)
    off = np.linalg.norm(found.poses[:, :2] - TRUE[:, :2], axis=1)
    given = np.linalg.norm(log.pose[:, :2] - TRUE[:, :2], axis=1)
    assert off.max() < 0.3
    assert given.max() > 0.8
