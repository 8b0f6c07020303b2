"""SE(2): group axioms, Jacobians against central differences, covariances against samples."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsonar.geometry.se2 import (
    compose,
    compose_jacobians,
    compose_with_covariance,
    interpolate,
    inverse,
    perpendicular,
    propagate,
    relative,
    relative_covariance,
    relative_jacobians,
    rotate,
    rotate_covariance,
    rotation,
    tangent_of,
    transform_points,
    unit,
    wrap_angle,
)

coordinates = st.floats(-10, 10, allow_nan=False)
poses = st.tuples(coordinates, coordinates, st.floats(-7, 7)).map(np.array)
IDENTITY = np.zeros(3)


def assert_same_pose(found, expected):
    difference = np.asarray(found) - expected
    difference[..., 2] = wrap_angle(difference[..., 2])
    np.testing.assert_allclose(difference, 0.0, atol=1e-9)


def pose_difference(a, b):
    return np.append(a[:2] - b[:2], wrap_angle(a[2] - b[2]))


def jacobian(function, at):
    """By central differences."""
    return np.stack([pose_difference(function(at + h), function(at - h)) / 2e-6 for h in 1e-6 * np.eye(len(at))], -1)


def random_covariance(rng, size, scale):
    root = rng.standard_normal((size, size))
    return root @ root.T * scale


@given(poses, poses, poses)
def test_composition_is_associative(a, b, c):
    assert_same_pose(compose(a, compose(b, c)), compose(compose(a, b), c))


@given(poses)
def test_identity_and_inverse(a):
    assert_same_pose(compose(a, IDENTITY), a)
    assert_same_pose(compose(IDENTITY, a), a)
    assert_same_pose(compose(a, inverse(a)), IDENTITY)
    assert_same_pose(compose(inverse(a), a), IDENTITY)


@given(poses, poses)
def test_relative_is_inverse_times_second(a, b):
    assert_same_pose(relative(a, b), compose(inverse(a), b))
    assert_same_pose(compose(a, relative(a, b)), b)


@given(poses, poses, coordinates, coordinates)
def test_composition_acts_on_points_like_both_in_turn(a, b, x, y):
    point = np.array([[x, y]])
    np.testing.assert_allclose(
        transform_points(compose(a, b), point), transform_points(a, transform_points(b, point)), atol=1e-9
    )


def test_batches_equal_single_poses(rng):
    a, many = rng.uniform(-4, 4, 3), rng.uniform(-4, 4, (2, 5, 3))
    for k in np.ndindex(2, 5):
        np.testing.assert_allclose(compose(a, many)[k], compose(a, many[k]), atol=1e-14)
        np.testing.assert_array_equal(relative(a, many)[k], relative(a, many[k]))
        np.testing.assert_array_equal(inverse(many)[k], inverse(many[k]))
        for batch, single in zip(relative_jacobians(many, many), relative_jacobians(many[k], many[k]), strict=True):
            np.testing.assert_array_equal(batch[k], single)


@given(st.floats(-1e3, 1e3))
def test_wrapped_angles_lie_in_the_interval_and_keep_their_direction(angle):
    wrapped = wrap_angle(angle)
    assert -np.pi <= wrapped < np.pi
    np.testing.assert_allclose(unit(wrapped), unit(angle), atol=1e-9)


@pytest.mark.parametrize("angle", [np.pi, -np.pi, np.nextafter(-np.pi, -4), np.nextafter(np.pi, 4), 3 * np.pi])
def test_wrapping_at_the_seam(angle):
    assert -np.pi <= wrap_angle(angle) < np.pi


@given(st.floats(-7, 7), coordinates, coordinates)
def test_rotations_agree(theta, x, y):
    vector, angle = np.array([x, y]), np.array(theta)
    np.testing.assert_allclose(rotate(vector, angle), rotation(theta) @ vector, atol=1e-9)
    np.testing.assert_allclose(perpendicular(vector), rotation(np.pi / 2) @ vector, atol=1e-9)
    np.testing.assert_allclose(tangent_of(theta), perpendicular(unit(theta)), atol=1e-9)


@given(poses, poses)
def test_jacobians_are_differences(a, b):
    by_first, by_second = compose_jacobians(a, b)
    np.testing.assert_allclose(by_first, jacobian(lambda x: compose(x, b), a), atol=1e-6)
    np.testing.assert_allclose(by_second, jacobian(lambda x: compose(a, x), b), atol=1e-6)
    by_first, by_second = relative_jacobians(a, relative(a, b))
    np.testing.assert_allclose(by_first, jacobian(lambda x: relative(x, b), a), atol=1e-6)
    np.testing.assert_allclose(by_second, jacobian(lambda x: relative(a, x), b), atol=1e-6)


@pytest.mark.slow
def test_covariance_of_a_composition_is_that_of_samples(rng):
    a, b = np.array([1.0, 2.0, 2.8]), np.array([0.5, -0.4, 1.1])
    cov_a, cov_b = random_covariance(rng, 3, 1e-4), random_covariance(rng, 3, 1e-4)
    pose, cov = compose_with_covariance(a, cov_a, b, cov_b)
    assert_same_pose(pose, compose(a, b))
    draws = zip(rng.multivariate_normal(a, cov_a, 20_000), rng.multivariate_normal(b, cov_b, 20_000), strict=True)
    errors = np.array([pose_difference(compose(x, y), pose) for x, y in draws])
    sd = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(np.cov(errors.T) / np.outer(sd, sd), cov / np.outer(sd, sd), atol=0.05)


def test_propagation_keeps_correlations_with_other_unknowns(rng):
    pose, step, cov = np.array([0.4, -0.2, 0.7]), np.array([0.3, 0.05, 0.2]), random_covariance(rng, 5, 1e-3)
    step_cov = np.diag([4e-4, 1e-4, 9e-4])
    moved, found = propagate(pose, cov, step, step_cov)
    assert_same_pose(moved, compose(pose, step))
    design = np.eye(5)
    design[:3, :3] = jacobian(lambda x: compose(x, step), pose)
    by_step = jacobian(lambda x: compose(pose, x), step)
    expected = design @ cov @ design.T
    expected[:3, :3] += by_step @ step_cov @ by_step.T
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(found[:3, :3], compose_with_covariance(pose, cov[:3, :3], step, step_cov)[1], atol=1e-12)


def test_covariance_of_a_relative_pose_has_both_errors_and_their_correlation(rng):
    a, b, joint = rng.uniform(-2, 2, 3), rng.uniform(-2, 2, 3), random_covariance(rng, 6, 1e-4)
    design = jacobian(lambda both: relative(both[:3], both[3:]), np.concatenate([a, b]))
    found = relative_covariance(a, relative(a, b), joint[:3, :3], joint[3:, 3:], joint[:3, 3:])
    np.testing.assert_allclose(found, design @ joint @ design.T, atol=1e-10)


def test_an_exact_change_of_frame_rotates_the_covariance(rng):
    frame, pose, cov = rng.uniform(-2, 2, 3), rng.uniform(-2, 2, 3), random_covariance(rng, 3, 1e-4)
    expected = compose_with_covariance(frame, np.zeros((3, 3)), pose, cov)[1]
    np.testing.assert_allclose(rotate_covariance(frame[2], cov), expected, atol=1e-14)


def test_batches_of_poses_transform_like_single_poses(rng):
    poses, others, points = rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), rng.normal(size=(7, 2))
    np.testing.assert_allclose(
        transform_points(poses[:, None], points), [transform_points(pose, points) for pose in poses], atol=1e-14
    )
    single = [compose(pose, other) for pose, other in zip(poses, others, strict=True)]
    np.testing.assert_allclose(compose(poses, others), single, atol=1e-14)
    np.testing.assert_allclose(compose(poses, others[0]), [compose(pose, others[0]) for pose in poses], atol=1e-14)


def interpolated(start, end, fraction):
    (pose,) = interpolate(start[None], np.asarray(end)[None], np.array([fraction]))
    return pose


@given(start=poses, step=poses, fraction=st.floats(-1, 2))
def test_interpolation_composes_along_the_geodesic(start, step, fraction):
    step = step * np.array([1, 1, 0.4])  # turns of less than half a circle
    end = compose(start, step)
    assert_same_pose(interpolated(start, end, 0.0), start)
    assert_same_pose(interpolated(start, end, 1.0), end)
    # The second half of the way equals the first half.
    half = interpolated(start, end, fraction / 2)
    assert_same_pose(relative(start, half), relative(half, interpolated(start, end, fraction)))


def test_interpolation_of_a_straight_drive_and_of_a_circle():
    assert_same_pose(interpolated(IDENTITY, np.array([2.0, -1.0, 0.0]), 0.25), np.array([0.5, -0.25, 0.0]))
    quarter = np.array([1.0, 1.0, np.pi / 2])  # of a circle with radius 1
    expected = np.array([np.sin(np.pi / 6), 1 - np.cos(np.pi / 6), np.pi / 6])
    assert_same_pose(interpolated(IDENTITY, quarter, 1 / 3), expected)
