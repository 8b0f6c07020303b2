"""Trajectory errors: independence of the frame, optimal alignment, consistency of covariances."""

import numpy as np
import pytest
from scipy.optimize import minimize

from jaxsonar import SonarError
from jaxsonar.estimation.trajectory import Trajectory
from jaxsonar.evaluation.trajectory_errors import align_poses, associate_stamps, trajectory_errors
from jaxsonar.geometry.se2 import compose, wrap_angle


def walk(rng, count=60, step=0.3):
    heading = np.cumsum(rng.normal(0, 0.2, count))
    place = np.cumsum(step * np.stack([np.cos(heading), np.sin(heading)], axis=-1), axis=0)
    return np.column_stack([place, wrap_angle(heading)])


def trajectory(poses, covariance=None):
    return Trajectory(0.1 * np.arange(len(poses)), poses, covariance)


def test_aligned_errors_do_not_depend_on_the_frame(rng):
    poses = walk(rng)
    moved = compose(np.array([3.0, -2.0, 2.5]), poses)
    for align in ("best", "first"):
        got = trajectory_errors(trajectory(moved), trajectory(poses), align=align)
        for name in ("ate", "ate_heading", "worst", "relative", "relative_heading"):
            assert getattr(got, name) < 1e-7, name
        np.testing.assert_allclose(compose(got.truth_from_estimate, moved), poses, atol=1e-9)
    unaligned = trajectory_errors(trajectory(moved), trajectory(poses), align="none")
    distance = np.linalg.norm(moved[:, :2] - poses[:, :2], axis=-1)
    np.testing.assert_allclose(unaligned.ate, np.sqrt(np.mean(distance**2)))
    np.testing.assert_allclose(unaligned.worst, distance.max())
    np.testing.assert_allclose(unaligned.ate_heading, 2.5)
    assert np.isnan(unaligned.nees)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_the_best_alignment_equals_a_numerical_search(seed):
    rng = np.random.default_rng(seed)
    truth = walk(rng)
    poses = compose(rng.normal(0, 2, 3), truth + rng.normal(0, 0.3, truth.shape))

    def cost(motion):
        return np.sum((compose(motion, poses)[:, :2] - truth[:, :2]) ** 2)

    starts = [np.array([0.0, 0.0, turn]) for turn in np.linspace(-3, 3, 7)]
    best = min((minimize(cost, start) for start in starts), key=lambda one: one.fun)
    got = trajectory_errors(trajectory(poses), trajectory(truth))
    np.testing.assert_allclose(got.ate, np.sqrt(best.fun / len(truth)), rtol=1e-6)
    np.testing.assert_allclose(cost(got.truth_from_estimate), best.fun, rtol=1e-6)


def test_coincident_positions_are_aligned_by_headings():
    truth = np.array([[1.0, 2.0, 0.1], [1.0, 2.0, 0.3]])
    poses = truth + np.array([5.0, 0.0, 1.0])
    np.testing.assert_allclose(compose(align_poses(poses, truth), poses), truth, atol=1e-12)
    assert trajectory_errors(trajectory(truth[:1]), trajectory(truth[:1])).ate == 0


def test_relative_errors_are_per_metre():
    truth = np.column_stack([0.25 * np.arange(41), np.zeros((41, 2))])
    long = truth * [1.02, 1, 1]
    got = trajectory_errors(trajectory(long), trajectory(truth))
    np.testing.assert_allclose([got.relative, got.relative_heading], [0.02, 0], atol=1e-12)
    np.testing.assert_allclose(trajectory_errors(trajectory(long), trajectory(truth), align="first").worst, 0.2)
    heading = 0.05 * truth[:, 0]
    turning = np.column_stack([np.sin(heading) / 0.05, (1 - np.cos(heading)) / 0.05, heading])
    np.testing.assert_allclose(trajectory_errors(trajectory(turning), trajectory(truth)).relative_heading, 0.05)
    assert np.isnan(trajectory_errors(trajectory(truth[:3]), trajectory(truth[:3])).relative), "shorter than a metre"


def test_nees_is_one_for_correct_covariances(rng):
    truth = walk(rng, count=4000)
    root = rng.normal(0, 0.02, (4000, 3, 3))
    covariance = root @ root.transpose(0, 2, 1) + 1e-6 * np.eye(3)
    error = (np.linalg.cholesky(covariance) @ rng.normal(size=(4000, 3, 1)))[..., 0]
    error[0], covariance[0] = 0, 0  # the first pose is the reference
    estimate = trajectory(truth + error, covariance)
    got = trajectory_errors(estimate, trajectory(truth)).nees
    np.testing.assert_allclose(got, 1, atol=0.06)
    elsewhere = estimate.transform(np.array([4.0, -1.0, 2.0]))
    np.testing.assert_allclose(trajectory_errors(elsewhere, trajectory(truth)).nees, got)
    np.testing.assert_allclose(
        trajectory_errors(trajectory(truth + error, 4 * covariance), trajectory(truth)).nees, got / 4
    )
    assert trajectory_errors(trajectory(truth, -covariance), trajectory(truth)).nees == np.inf
    assert np.isnan(trajectory_errors(trajectory(truth, 0 * covariance), trajectory(truth)).nees)


def test_poses_are_associated_by_stamps(rng):
    poses = walk(rng)
    truth = trajectory(poses)
    rows = np.array([3, 10, 11, 40])
    part = Trajectory(truth.stamp[rows] + 0.004, poses[rows])
    got = trajectory_errors(part, truth)
    assert got.poses == 4
    assert got.ate < 1e-12
    with pytest.raises(SonarError, match=r"0\.001 s"):
        trajectory_errors(part, truth, tolerance=0.001)
    own, other = associate_stamps(np.array([5.0, 1.0, 1.001]), np.array([1.0, 9.0, 5.002]), tolerance=0.01)
    np.testing.assert_array_equal([own, other], [[0, 1], [2, 0]])
