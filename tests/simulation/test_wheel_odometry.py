"""Simulated odometry: exact without errors, otherwise a random walk that does not depend on the step length."""

import numpy as np
import pytest

from jaxsonar import SonarError
from jaxsonar.geometry.se2 import compose, relative, wrap_angle
from jaxsonar.simulation.wheel_odometry import LATERAL_RATIO, odometry_step_sd, simulate_odometry


def straight(metres, steps):
    return np.column_stack([np.linspace(0, metres, steps + 1), np.zeros((steps + 1, 2))])


def round_trip(rng):
    heading = np.cumsum(rng.normal(0, 0.4, 80))
    place = np.cumsum(rng.uniform(-0.1, 0.3, (80, 1)) * np.stack([np.cos(heading), np.sin(heading)], axis=-1), axis=0)
    return np.column_stack([place + np.array([3.0, -2.0]), wrap_angle(heading)])


def test_odometry_without_errors_equals_the_true_poses(rng):
    poses = round_trip(rng)
    got = simulate_odometry(poses, distance=0.0, turn=0.0)
    np.testing.assert_allclose(got, poses, atol=1e-12)
    for few in (poses[:0], poses[:1]):
        np.testing.assert_array_equal(simulate_odometry(few, distance=0.1, turn=0.1), few)


def test_odometry_starts_at_the_true_pose_and_is_reproducible(rng):
    poses = round_trip(rng)
    got = simulate_odometry(poses, distance=0.02, turn=0.02, seed=3)
    np.testing.assert_array_equal(got[0], poses[0])
    np.testing.assert_array_equal(got, simulate_odometry(poses, distance=0.02, turn=0.02, seed=3))
    assert not np.array_equal(got, simulate_odometry(poses, distance=0.02, turn=0.02, seed=4))
    assert (np.abs(got[:, 2]) <= np.pi).all()


def test_odometry_is_equivariant_under_motions_of_the_world(rng):
    poses, motion = round_trip(rng), np.array([1.0, 2.0, 3.0])
    moved = simulate_odometry(compose(motion, poses), distance=0.02, turn=0.02)
    there = compose(motion, simulate_odometry(poses, distance=0.02, turn=0.02))
    np.testing.assert_allclose(relative(there, moved), 0, atol=1e-9)


def errors_of_parts(poses, length, **errors):
    """Errors of consecutive parts of a trajectory, which are independent."""
    told = simulate_odometry(poses, **errors)[::length]
    true = poses[::length]
    return relative(relative(true[:-1], true[1:]), relative(told[:-1], told[1:]))


@pytest.mark.parametrize("steps", [9, 90])
def test_random_walk_grows_with_the_square_root_of_the_distance(steps):
    """After 9 m the error is three times that after 1 m, for any number of steps."""
    parts = 2000
    poses = straight(9.0 * parts, steps * parts)
    off = errors_of_parts(poses, steps, distance=0.02, turn=0.0)
    np.testing.assert_allclose(off.std(axis=0), [0.06, 0.06 * LATERAL_RATIO, 0], rtol=0.08)
    np.testing.assert_allclose(off.mean(axis=0), 0, atol=0.006)
    off = errors_of_parts(poses, steps, distance=0.0, turn=0.01)
    np.testing.assert_allclose(off[:, 2].std(), 0.03, rtol=0.08)
    # The heading error moves the end laterally by the integral of the random walk, turn * sqrt(length^3 / 3).
    assert 0.8 < off[:, 1].std() / (0.01 * np.sqrt(9.0**3 / 3)) < 1.1


def test_rotation_in_place_affects_the_heading_only():
    parts = 2000
    poses = np.column_stack([np.ones((8 * parts + 1, 2)), wrap_angle(np.pi / 4 * np.arange(8 * parts + 1))])
    off = errors_of_parts(poses, 8, distance=0.02, turn=0.5)
    np.testing.assert_array_equal(off[:, :2], 0)
    np.testing.assert_allclose(off[:, 2].std(), 0.02 * np.sqrt(2 * np.pi), rtol=0.08)


def test_scale_errors_are_systematic(rng):
    poses = round_trip(rng)
    long = simulate_odometry(poses, distance=0.0, turn=0.0, scale=0.03)
    np.testing.assert_allclose(long[:, :2] - poses[0, :2], 1.03 * (poses[:, :2] - poses[0, :2]), atol=1e-12)
    far = simulate_odometry(poses, distance=0.0, turn=0.0, turn_scale=0.5)
    steps, told = relative(poses[:-1], poses[1:]), relative(far[:-1], far[1:])
    np.testing.assert_allclose(wrap_angle(told[:, 2] - 1.5 * steps[:, 2]), 0, atol=1e-9)


def test_step_standard_deviations_match_the_simulated_errors(rng):
    poses = np.concatenate([straight(0.25, 1), [[0.25, 0.0, 0.4]]])
    sd = odometry_step_sd(poses, distance=0.02, turn=0.1)
    np.testing.assert_allclose(sd, [[0.01, 0.01 * LATERAL_RATIO, 0.05], [0, 0, 0.02 * np.sqrt(0.4)]])


@pytest.mark.parametrize(
    ("wrong", "said"),
    [({"distance": -0.1}, "distance -0.1"), ({"turn": np.nan}, "turn nan"), ({"scale": -1.0}, "scale -1")],
)
def test_values_out_of_range_raise_a_named_error(wrong, said):
    with pytest.raises(SonarError, match=f"odometry: {said}; allowed"):
        simulate_odometry(straight(1.0, 2), **{"distance": 0.1, "turn": 0.1} | wrong)
    with pytest.raises(SonarError, match="pose 1"):
        simulate_odometry(np.array([[0.0, 0, 0], [np.nan, 0, 0]]), distance=0.1, turn=0.1)
