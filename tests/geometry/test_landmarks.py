"""Landmarks: transformations act like those of their points, and their Jacobians are differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsonar import kernels
from jaxsonar.geometry.landmarks import (
    concatenate_landmarks,
    landmark_positions,
    landmarks_from_points,
    landmarks_from_segments,
    landmarks_in_robot_frame,
    pad_landmarks,
    transform_landmarks,
    transform_parameters,
    wall_segments,
)
from jaxsonar.geometry.se2 import compose, inverse, tangent_of, transform_points, unit, wrap_angle

PLANE, CORNER, EDGE = kernels.PLANE, kernels.CORNER, kernels.EDGE


@pytest.fixture
def landmarks(rng):
    """Three walls, a corner and an edge, none of them at its anchor."""
    parameters = rng.uniform(-0.2, 0.2, (5, 2))
    parameters[:3, 1] = rng.uniform(-3, 3, 3)
    extent = np.zeros((5, 2))
    extent[:3] = rng.uniform([-2, 0.5], [-0.5, 2], (3, 2))
    kind = np.array([PLANE, PLANE, PLANE, CORNER, EDGE], np.int32)
    return kernels.Landmarks(kind, parameters, rng.uniform(-3, 3, (5, 2)), extent)


@pytest.fixture
def pose(rng):
    return rng.uniform(-3, 3, 3)


def assert_same(found, expected):
    for a, b in zip(
        (found.kind, found.anchor, found.extent), (expected.kind, expected.anchor, expected.extent), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=1e-12)
    difference = found.parameters - expected.parameters
    difference[expected.kind == PLANE, 1] = wrap_angle(difference[expected.kind == PLANE, 1])
    np.testing.assert_allclose(difference, 0, atol=1e-12)


def test_transformed_landmarks_are_where_their_transformed_points_are(landmarks, pose):
    moved = transform_landmarks(pose, landmarks)
    np.testing.assert_allclose(landmark_positions(moved), transform_points(pose, landmark_positions(landmarks)))
    walls, moved_walls = landmarks.take(np.arange(3)), moved.take(np.arange(3))
    np.testing.assert_allclose(wall_segments(moved_walls), transform_points(pose, wall_segments(walls)))


def test_transformations_are_a_group_action(landmarks, pose, rng):
    other = rng.uniform(-3, 3, 3)
    assert_same(transform_landmarks(inverse(pose), transform_landmarks(pose, landmarks)), landmarks)
    both = transform_landmarks(other, transform_landmarks(pose, landmarks))
    assert_same(transform_landmarks(compose(other, pose), landmarks), both)


def test_parameters_relative_to_the_moved_anchors_are_those_of_the_moved_landmarks(landmarks, pose):
    moved = transform_landmarks(pose, landmarks)
    found = transform_parameters(pose, landmarks, np.asarray(moved.anchor))
    assert_same(moved.with_parameters(found.parameters), moved)


def test_jacobians_of_transformed_parameters_are_differences(landmarks, pose, rng):
    anchor = rng.uniform(-3, 3, (5, 2))
    found = transform_parameters(pose, landmarks, anchor)
    for k, h in enumerate(1e-6 * np.eye(3)):
        ahead, behind = (transform_parameters(pose + sign * h, landmarks, anchor).parameters for sign in (1, -1))
        np.testing.assert_allclose(found.by_transform[..., k], (ahead - behind) / 2e-6, atol=1e-7)
    for k, h in enumerate(1e-6 * np.eye(2)):
        ahead, behind = (
            transform_parameters(pose, landmarks.with_parameters(landmarks.parameters + sign * h), anchor).parameters
            for sign in (1, -1)
        )
        np.testing.assert_allclose(found.by_parameters[..., k], (ahead - behind) / 2e-6, atol=1e-7)


def test_parameters_in_the_robot_frame_are_those_of_the_kernel(landmarks, pose):
    found, jacobian = landmarks_in_robot_frame(pose, landmarks)
    for row in range(5):
        one = jax.tree.map(lambda leaf, row=row: jnp.asarray(leaf[row]), landmarks)
        expected = np.asarray(kernels.landmark_in_robot_frame(jnp.asarray(pose), one))
        difference = found[row] - expected
        difference[1] = wrap_angle(difference[1]) if landmarks.kind[row] == PLANE else difference[1]
        np.testing.assert_allclose(difference, 0, atol=1e-5)
    for k, h in enumerate(1e-6 * np.eye(3)):
        ahead, behind = (landmarks_in_robot_frame(pose + sign * h, landmarks)[0] for sign in (1, -1))
        np.testing.assert_allclose(jacobian[..., k], (ahead - behind) / 2e-6, atol=1e-7)
    for k, h in enumerate(1e-6 * np.eye(2)):
        ahead, behind = (
            landmarks_in_robot_frame(pose, landmarks.with_parameters(landmarks.parameters + sign * h))[0]
            for sign in (1, -1)
        )
        np.testing.assert_allclose(jacobian[..., 3 + k], (ahead - behind) / 2e-6, atol=1e-7)


def test_segments_and_points_make_landmarks_and_come_back(rng):
    theta, rho = rng.uniform(-3, 3, 4), rng.uniform(0.5, 3, 4)
    ends = np.sort(rng.uniform(-2, 2, (4, 2)), axis=1)
    segments = (rho[:, None] * unit(theta))[:, None] + ends[..., None] * tangent_of(theta)[:, None]
    np.testing.assert_allclose(wall_segments(landmarks_from_segments(rho, theta, segments)), segments, atol=1e-12)
    positions = rng.uniform(-3, 3, (2, 2))
    points = landmarks_from_points(np.array([CORNER, EDGE]), positions)
    np.testing.assert_array_equal(landmark_positions(points), positions)


def test_concatenation_and_padding_keep_the_rows(landmarks):
    parts = [landmarks.take(np.arange(2)), landmarks.take(np.arange(2, 5))]
    assert_same(concatenate_landmarks(parts), landmarks)
    assert not len(concatenate_landmarks([]).kind)
    padded = pad_landmarks(landmarks, 8)
    assert_same(padded.take(np.arange(5)), landmarks)
    assert padded.kind[5:].tolist() == [-1, -1, -1]
