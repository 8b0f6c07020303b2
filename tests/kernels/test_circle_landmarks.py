"""Circles as landmarks: shortest paths, derivatives by differences, the limit of an edge, scenes without circles."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.adjustment_problem import problem_with_truth
from support.echo_paths import paths_between
from support.oracles import shortest_path_over_circle

from jaxsonar import kernels
from jaxsonar.geometry.landmarks import (
    concatenate_landmarks,
    landmarks_from_points,
    pad_landmarks,
    transform_landmarks,
)
from jaxsonar.geometry.se2 import transform_points
from jaxsonar.kernels import CIRCLE, CORNER, EDGE, PLANE, Landmarks, Reflection
from jaxsonar.kernels.landmarks import landmark_in_robot_frame

COUNT = 60
STEP = 1e-5  # m, rad; of central differences


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


@pytest.fixture
def scene(rng):
    """Poses, circles around each of them, and pairs of sensors; every fourth path is a direct one."""
    poses = rng.uniform([-3, -3, -np.pi], [3, 3, np.pi], (COUNT, 3))
    angle, distance = rng.uniform(-np.pi, np.pi, COUNT), rng.uniform(1.2, 2.5, COUNT)
    center = poses[:, :2] + distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    parameters = rng.uniform(-0.1, 0.1, (COUNT, 2))
    radius = rng.uniform(0.005, 0.5, COUNT)
    circles = Landmarks(np.full(COUNT, CIRCLE, np.int32), parameters, center - parameters, np.zeros((COUNT, 2)), radius)
    tx, rx = rng.uniform(-0.3, 0.3, (2, COUNT, 2))
    rx[::4] = tx[::4]
    return poses, circles, tx, rx


def oracle(poses, circles, tx, rx):
    """Half the shortest path over each circle, from the definition."""
    world = [transform_points(poses, sensors) for sensors in (tx, rx)]
    center = circles.anchor + circles.parameters
    return shortest_path_over_circle(np.column_stack([center, circles.radius]), *world) / 2


def predicted(poses, circles, tx, rx, kind=CIRCLE):
    rows = np.arange(COUNT, dtype=np.int32)
    reflection = Reflection(np.full(COUNT, kind, np.int32), rows, rows)
    paths = paths_between(tx, rx, heading=np.zeros((COUNT, 2)), half_beam=3.0)
    first = jax.tree.map(jnp.asarray, circles)
    return jax.vmap(kernels.predict_reflection)(jnp.asarray(poses), reflection, first, first, paths)[:3]


def test_predicted_ranges_are_shortest_paths_over_the_circle(scene):
    expected = oracle(*scene)
    np.testing.assert_allclose(predicted(*scene)[0], expected, rtol=0, atol=1e-9)
    poses, circles, tx, rx = scene

    def report(pose, circle, tx, rx):
        local = landmark_in_robot_frame(pose, circle)
        return kernels.expected_range(jnp.asarray(CIRCLE), local, local, tx, rx, jnp.asarray(circle.radius))

    found = jax.vmap(report)(*jax.tree.map(jnp.asarray, (poses, circles, tx, rx)))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_derivatives_by_pose_and_center_are_differences_of_shortest_paths(scene):
    """Those of the extended Kalman filter; the bundle adjustment differentiates the same ranges automatically."""
    poses, circles, tx, rx = scene
    paths = paths_between(tx, rx, heading=np.zeros((COUNT, 2)), half_beam=3.0)

    def by_pose_and_center(pose, circle, path):
        belief = kernels.Belief(pose, jax.tree.map(lambda leaf: leaf[None], circle), jnp.eye(5))
        variance = [
            kernels.expected_ranges_with_variance(
                kernels.Belief(belief.pose, belief.landmarks, jnp.outer(e, e)), jax.tree.map(lambda x: x[None], path)
            ).variance[0, 0]
            for e in jnp.eye(5)
        ]
        return jnp.sqrt(jnp.stack(variance))

    arrays = jax.tree.map(jnp.asarray, (poses, circles, paths))
    found = np.asarray(jax.vmap(by_pose_and_center)(*arrays))
    for k in range(5):
        change = STEP * np.eye(5)[k]
        moved = [
            oracle(
                poses + sign * change[:3],
                dataclasses.replace(circles, parameters=circles.parameters + sign * change[3:]),
                tx,
                rx,
            )
            for sign in (1, -1)
        ]
        slope = (moved[0] - moved[1]) / (2 * STEP)
        np.testing.assert_allclose(found[:, k], np.abs(slope), atol=2e-5)


def test_a_circle_without_radius_is_an_edge(scene):
    poses, circles, tx, rx = scene
    points = dataclasses.replace(circles, radius=np.zeros(COUNT))
    edges = dataclasses.replace(points, kind=np.full(COUNT, EDGE, np.int32))
    for circle, edge in zip(predicted(poses, points, tx, rx), predicted(poses, edges, tx, rx, EDGE), strict=True):
        np.testing.assert_allclose(circle, edge, atol=1e-9)


def test_other_landmarks_are_the_same_beside_circles(rng):
    """Residuals and derivatives of walls, corners and edges do not depend on whether there may be circles."""
    problem, start, _ = problem_with_truth(rng)
    beside = dataclasses.replace(
        problem, landmarks=dataclasses.replace(problem.landmarks, radius=jnp.zeros(len(problem.landmarks.kind)))
    )
    scan, echo = np.nonzero(np.asarray(problem.factors.weight) > 0)
    for a, b in zip(
        jax.tree.leaves(kernels.linearize(problem, start, scan, echo)),
        jax.tree.leaves(kernels.linearize(beside, start, scan, echo)),
        strict=True,
    ):
        assert np.isfinite(b).all()
        np.testing.assert_allclose(b, a, atol=1e-12)


def test_circles_are_transformed_like_their_centers_and_keep_their_radii(scene, rng):
    _, circles, _, _ = scene
    motion = rng.uniform(-3, 3, 3)
    moved = transform_landmarks(motion, circles)
    np.testing.assert_allclose(
        moved.anchor + moved.parameters, transform_points(motion, circles.anchor + circles.parameters), atol=1e-12
    )
    np.testing.assert_array_equal(moved.radius, circles.radius)


def test_only_scenes_with_circles_have_radii(rng):
    places = rng.uniform(-1, 1, (3, 2))
    points = landmarks_from_points(np.array([CORNER, EDGE, EDGE]), places, np.full(3, np.nan))
    assert points.radius is None
    assert pad_landmarks(concatenate_landmarks([points, points]), 8).radius is None
    circle = landmarks_from_points(np.array([CIRCLE, EDGE]), places[:2], np.array([0.1, np.nan]))
    both = pad_landmarks(concatenate_landmarks([points, circle]), 8)
    np.testing.assert_array_equal(both.radius, [0, 0, 0, 0.1, 0, 0, 0, 0])


@pytest.mark.parametrize("kind", [PLANE, CORNER, EDGE, CIRCLE])
def test_gradients_are_finite_where_a_circle_is_between_the_sensors(kind):
    """The range is meaningless there, but the gradients of all other echoes of a batch must not be NaN."""
    place, tx, rx = jnp.array([0.0, 0.0]), jnp.array([0.2, 0.0]), jnp.array([-0.2, 0.0])
    report = partial(kernels.expected_range, jnp.asarray(kind), radius=jnp.asarray(0.1))
    slopes = jax.grad(report, argnums=(0, 2, 3))(place, place, tx, rx)
    assert all(np.isfinite(slope).all() for slope in slopes)
