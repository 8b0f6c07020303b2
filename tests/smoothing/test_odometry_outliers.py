"""Odometry outliers are found at the stated rate, and split the points on their two sides but nothing else."""

import numpy as np
import pytest
from support.maps import wall_and_corner

from jaxsonar.smoothing.odometry_outliers import OdometryOutliers, find_odometry_outliers
from jaxsonar.smoothing.settings import SETTINGS

SD = np.array([0.008, 0.004, 0.007])
STEPS = 600
INFORMATION = np.tile(1 / SD**2, (STEPS, 1))


def residuals(seed, scale=1.0):
    """Random odometry residuals; ``scale`` relative to the assumed standard deviation."""
    return scale * SD * np.random.default_rng(seed).standard_normal((STEPS, 3))


@pytest.mark.slow
def test_the_rate_of_false_outliers_is_the_expected_one():
    found = sum(len(find_odometry_outliers(residuals(seed), INFORMATION)) for seed in range(40))
    expected = 40 * SETTINGS.expected_false_outliers
    assert found <= 2 * (expected + 3 * np.sqrt(expected))  # a window of two is two steps


@pytest.mark.parametrize("axis", range(3))
def test_a_step_far_beyond_the_noise_is_an_outlier(axis):
    residual, information = residuals(1, 0.5), INFORMATION.copy()
    assert not len(find_odometry_outliers(residual, information))
    residual[400] = 7 * SD * np.eye(3)[axis]
    assert 400 in find_odometry_outliers(residual, information)
    information[399:402] = 0  # no odometry, no outlier
    assert not len(find_odometry_outliers(residual, information))


def test_two_steps_may_be_an_outlier_only_together():
    residual = residuals(1, 0.5)
    residual[300:302] = 3.4 * SD * [1, 0, 0]
    assert find_odometry_outliers(residual, INFORMATION).tolist() == [300, 301]
    residual[301] = 0
    assert not len(find_odometry_outliers(residual, INFORMATION))


def test_a_trajectory_of_one_scan_has_no_step():
    assert not len(find_odometry_outliers(np.zeros((0, 3)), np.zeros((0, 3))))


ROWS = {10 * row: row for row in range(200)}  # scan numbers differ from rows


@pytest.fixture
def world():
    """A wall and a corner, observed on both sides of row 4, and much later."""
    return wall_and_corner(tuple(10 * row for row in (3, 4, 6, 7, 150)))


def test_without_outliers_nothing_changes(world):
    outliers = OdometryOutliers(np.zeros(0, dtype=np.int64), ROWS)
    same = outliers.split_landmarks(world)
    assert (same.scans, same.point_scans) == (world.scans, world.point_scans)
    assert outliers.visibility_mask(same, 200).all()


def test_an_outlier_splits_points_and_no_walls(world):
    outliers = OdometryOutliers(np.array([4]), ROWS)  # between rows 4 and 5
    split = outliers.split_landmarks(world)
    assert split.scans == world.scans
    assert split.point_scans == ((30, 40), (60, 70, 1500))  # a much later observation is not split off
    np.testing.assert_array_equal(split.points, np.repeat(world.points, 2, axis=0))
    mask = outliers.visibility_mask(split, 200)
    assert mask[:, 0].all()
    assert mask[:5, 1].all()
    assert not mask[5:44, 1].any()
    assert mask[60:, 1].all()  # the robot may have returned
    assert not mask[:5, 2].any()
    assert mask[5:, 2].all()
    again = outliers.split_landmarks(split)
    assert again.point_scans == split.point_scans


def test_outliers_elsewhere_split_nothing(world):
    outliers = OdometryOutliers(np.array([2, 7, 90]), ROWS)
    assert outliers.split_landmarks(world).point_scans == world.point_scans
