"""Residuals and Jacobians of the bundle adjustment: the kernels of one path, derivatives, precision."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from support.adjustment_problem import (
    ECHOES,
    LANDMARK_COUNT,
    RING,
    SCANS,
    SENSORS,
    SIGMA,
    dense_jacobian,
    dense_residuals,
    problem_with_truth,
)

from jaxsonar import kernels
from jaxsonar.kernels import Reflection


@pytest.fixture(autouse=True)
def double():
    """Double precision, except where a test asks for less."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(params=[True, False], ids=["odometry", "no odometry"])
def odometry(request):
    return request.param


gradient_of_cost = jax.jit(jax.grad(kernels.cost, argnums=1))


def test_the_residuals_of_the_true_unknowns_are_the_noise(rng):
    problem, _, true = problem_with_truth(rng)
    residual = np.asarray(kernels.residuals(problem, true))[np.asarray(problem.factors.weight) > 0]
    assert np.std(residual) == pytest.approx(SIGMA, rel=0.2)


@pytest.mark.slow
def test_the_residuals_are_reported_minus_predicted_ranges(rng):
    """Echo by echo, through the kernels of one path."""
    problem, _, true = problem_with_truth(rng)
    sensors = kernels.apply_parameters(problem.sensors, problem.basis @ true.coordinates)
    landmarks = problem.landmarks.with_parameters(true.landmarks)
    found, factors = np.asarray(kernels.residuals(problem, true)), problem.factors
    for k, e in [(0, 0), (1, 7), (2, 11), (3, 30), (4, 39)]:
        tx, rx = RING.paths[int(factors.path[k, e])]
        reflection = factors.reflection
        first, second = (
            kernels.landmark_in_robot_frame(true.poses[k], landmarks.take(rows[k, e]))
            for rows in (reflection.first, reflection.second)
        )
        kind = reflection.kind[k, e]
        true_range = kernels.expected_range(kind, first, second, sensors.position[tx], sensors.position[rx])
        offset = (sensors.range_offset[tx] + sensors.range_offset[rx]) / 2
        expected = factors.reported[k, e] - (true_range / sensors.range_scale + offset)
        np.testing.assert_allclose(found[k, e], expected, atol=1e-13)


@pytest.mark.parametrize("odometry_scale", [False, True])
def test_the_cost_is_half_the_sum_of_all_squares(rng, odometry, odometry_scale):
    problem, start, true = problem_with_truth(rng, odometry=odometry, odometry_scale=odometry_scale)
    for unknowns in (start, true):
        expected = float((dense_residuals(unknowns, problem) ** 2).sum()) / 2
        np.testing.assert_allclose(kernels.cost(problem, unknowns), expected, rtol=1e-12)


def test_forward_reverse_and_numerical_derivatives_agree(rng):
    problem, _, true = problem_with_truth(rng)
    flat, unravel = ravel_pytree(true)
    step = 1e-5
    numerical = [(kernels.residuals(problem, unravel(flat + h)), kernels.residuals(problem, unravel(flat - h)))
                 for h in step * jnp.eye(len(flat))]  # fmt: skip
    numerical = np.stack([np.ravel(ahead - behind) / (2 * step) for ahead, behind in numerical], axis=-1)
    forward = np.asarray(dense_jacobian(true, problem))
    weight = np.sqrt(np.ravel(problem.factors.weight))
    of_echoes = forward[: len(weight)][weight > 0] / weight[weight > 0, None]
    np.testing.assert_allclose(of_echoes, numerical[weight > 0], rtol=1e-4, atol=1e-8)
    reverse, _ = ravel_pytree(gradient_of_cost(problem, true))
    expected = forward.T @ np.asarray(dense_residuals(true, problem))
    np.testing.assert_allclose(reverse, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("odometry_scale", [False, True])
def test_linearize_yields_the_blocks_of_the_dense_jacobian(rng, odometry_scale):
    problem, _, true = problem_with_truth(rng, odometry_scale=odometry_scale)
    scan, echo = (jnp.asarray(x, jnp.int32) for x in np.nonzero(np.asarray(problem.factors.weight) > 0))
    found = kernels.linearize(problem, true, scan, echo)
    size = problem.basis.shape[1]
    dense = np.asarray(dense_jacobian(true, problem))
    by_coordinates, by_pose = dense[:, :size], dense[:, size : size + 3 * SCANS].reshape(-1, SCANS, 3)
    row = np.asarray(scan) * ECHOES + np.asarray(echo)
    # The weighted residuals decrease as the predictions grow.
    np.testing.assert_allclose(found.residual / SIGMA, dense_residuals(true, problem)[row], atol=1e-9)
    np.testing.assert_allclose(found.d_range_d_coordinates / -SIGMA, by_coordinates[row], atol=1e-9)
    np.testing.assert_allclose(found.d_range_d_pose / -SIGMA, by_pose[row, scan], atol=1e-8)
    steps = len(dense) - 3 * (SCANS - 1) + np.arange(3 * (SCANS - 1)).reshape(-1, 3)
    sd = 1 / np.sqrt(np.asarray(problem.odometry_information))[:-1]
    here = np.arange(SCANS - 1)[:, None]
    np.testing.assert_allclose(found.odometry_residual / sd, dense_residuals(true, problem)[steps], atol=1e-8)
    np.testing.assert_allclose(found.d_odometry_d_from / sd[..., None], by_pose[steps, here], atol=1e-8)
    np.testing.assert_allclose(found.d_odometry_d_to / sd[..., None], by_pose[steps, here + 1], atol=1e-8)
    np.testing.assert_allclose(found.d_odometry_d_coordinates / sd[..., None], by_coordinates[steps], atol=1e-8)


def test_derivatives_are_finite_on_a_wall_and_in_padding(rng):
    """A sensor on a wall or at a corner, landmarks of no kind: 0 times infinity would yield NaN everywhere."""
    problem, start, _ = problem_with_truth(rng)
    direct = eqx.tree_at(lambda p: p.factors.path, problem, problem.factors.path % SENSORS)
    sensor = jnp.asarray([0.25, 0.0])
    on_wall = problem.landmarks.anchor[0] + start.landmarks[0, 0] * kernels.normal(start.landmarks[0, 1]) - sensor
    at_corner = problem.landmarks.anchor[3] + start.landmarks[3] - sensor
    on_wall, at_corner = (
        eqx.tree_at(lambda u: u.poses, start, start.poses.at[0].set(jnp.append(position, 0.0)))
        for position in (on_wall, at_corner)
    )
    nothing = jnp.full((SCANS, ECHOES), -1, jnp.int32)
    padding = Reflection(nothing, nothing + LANDMARK_COUNT, nothing + LANDMARK_COUNT)
    padded = eqx.tree_at(lambda p: p.factors.reflection, problem, padding)
    for given, unknowns in ((direct, on_wall), (problem, on_wall), (direct, at_corner), (padded, start)):
        for leaf in jax.tree.leaves(gradient_of_cost(given, unknowns)):
            assert np.isfinite(leaf).all()


def test_single_precision_agrees(rng):
    problem, start, _ = problem_with_truth(rng)
    residual, cost = kernels.residuals(problem, start), kernels.cost(problem, start)
    leaves, tree = jax.tree.flatten((problem, start))
    leaves = [np.asarray(leaf) for leaf in leaves]
    with jax.enable_x64(False):
        narrow = jax.tree.unflatten(tree, [jnp.asarray(leaf) for leaf in leaves])
        found, found_cost = kernels.residuals(*narrow), kernels.cost(*narrow)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, residual, atol=1e-6)
    np.testing.assert_allclose(found_cost, cost, rtol=1e-4)
