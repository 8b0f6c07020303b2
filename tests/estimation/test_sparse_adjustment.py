"""The sparse bundle adjustment against dense solvers, and its invariances."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from jax.flatten_util import ravel_pytree
from scipy.optimize import least_squares
from support.adjustment_problem import (
    ECHOES,
    LANDMARK_COUNT,
    RING,
    SCANS,
    SENSORS,
    assert_same,
    dense_jacobian,
    dense_residuals,
    problem_with_truth,
)

from jaxsonar import kernels
from jaxsonar.estimation.sparse_adjustment import absorbed_freedom, marginal_covariances, solve_adjustment


@pytest.fixture(autouse=True)
def double():
    """Double precision."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(params=[True, False], ids=["odometry", "no odometry"])
def odometry(request):
    return request.param


adjust_all = partial(solve_adjustment, poses_free=True)
adjust_held = partial(solve_adjustment, poses_free=False)
covariances = partial(marginal_covariances, poses_free=True)


def dense_covariance(problem, unknowns, *, poses_free=True):
    """Blocks of the inverse of the dense normal matrix, as ``marginal_covariances`` yields them."""
    jacobian, size = np.asarray(dense_jacobian(unknowns, problem)), problem.basis.shape[1]
    poses = slice(size, size + 3 * len(unknowns.poses))
    if not poses_free:
        jacobian = np.delete(jacobian, poses, axis=1)
    cov = np.linalg.inv(jacobian.T @ jacobian)
    first = poses.stop if poses_free else size
    rows = [np.arange(size + 3 * k, size + 3 * k + 3) for k in range(len(unknowns.poses)) if poses_free]
    points = [np.arange(first + 2 * k, first + 2 * k + 2) for k in range(len(unknowns.landmarks))]
    return cov[:size, :size], [cov[np.ix_(r, r)] for r in rows], [cov[np.ix_(r, r)] for r in points]


def assert_covariances(found, expected):
    """Equal to 1e-5 standard deviations."""
    coordinates, poses, landmarks = expected
    for one, other in [(found.coordinates, coordinates), *zip(found.poses, poses, strict=False),
                       *zip(found.landmarks, landmarks, strict=True)]:  # fmt: skip
        scale = np.sqrt(np.outer(np.diag(other), np.diag(other)))
        np.testing.assert_allclose(one / scale, other / scale, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("odometry_scale", [False, True])
def test_dense_solvers_find_the_same(rng, odometry, odometry_scale):
    problem, start, _ = problem_with_truth(rng, odometry=odometry, odometry_scale=odometry_scale)
    found = adjust_all(problem, start)
    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-10)
    expected = optx.least_squares(dense_residuals, solver, start, problem, max_steps=100).value
    assert_same(found.unknowns, expected, atol=1e-6)
    flat, unravel = ravel_pytree(start)
    by_scipy = least_squares(
        lambda x: np.asarray(dense_residuals(unravel(jnp.asarray(x)), problem)),
        np.asarray(flat),
        jac=lambda x: np.asarray(dense_jacobian(unravel(jnp.asarray(x)), problem)),  # pyright: ignore[reportArgumentType]
        xtol=1e-12,
    )
    assert_same(found.unknowns, unravel(jnp.asarray(by_scipy.x)), atol=1e-6)
    assert found.cost <= (1 + 1e-9) * kernels.cost(problem, expected)
    assert found.cost < 1e-2 * found.initial_cost
    np.testing.assert_allclose(found.initial_cost, kernels.cost(problem, start), rtol=1e-12)
    np.testing.assert_allclose(found.cost, kernels.cost(problem, found.unknowns), rtol=1e-12)


@pytest.mark.parametrize("poses_free", [False, True])
def test_the_absorbed_freedom_is_the_trace_of_the_hat_matrix_of_the_echoes(rng, odometry, poses_free):
    problem, _, true = problem_with_truth(rng, odometry=odometry)
    found = absorbed_freedom(problem, true, poses_free=poses_free)
    jacobian, size = np.asarray(dense_jacobian(true, problem)), problem.basis.shape[1]
    if not poses_free:
        jacobian = np.delete(jacobian, slice(size, size + 3 * SCANS), axis=1)
    echoes = jacobian[: SCANS * ECHOES]
    expected = np.trace(echoes @ np.linalg.inv(jacobian.T @ jacobian) @ echoes.T)
    assert found == pytest.approx(expected, rel=0.2)
    assert found < jacobian.shape[1]


@pytest.mark.slow
@pytest.mark.parametrize("odometry_scale", [False, True])
def test_the_covariances_are_those_of_the_dense_equations(rng, odometry, odometry_scale):
    problem, start, _ = problem_with_truth(rng, odometry=odometry, odometry_scale=odometry_scale)
    unknowns = adjust_all(problem, start).unknowns
    assert_covariances(covariances(problem, unknowns), dense_covariance(problem, unknowns))
    jacobian = np.asarray(dense_jacobian(unknowns, problem))
    sd = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    gradient = jacobian.T @ np.asarray(dense_residuals(unknowns, problem))
    assert np.abs(gradient * sd).max() < 1e-3  # standard deviations from the minimum


def test_held_poses_keep_their_values_and_reduce_the_covariances(rng):
    problem, start, true = problem_with_truth(rng)
    start = replace(start, poses=true.poses)
    unknowns = adjust_held(problem, start).unknowns
    np.testing.assert_array_equal(unknowns.poses, true.poses)
    held = marginal_covariances(problem, unknowns, poses_free=False)
    assert_covariances(held, dense_covariance(problem, unknowns, poses_free=False))
    assert not held.poses.any()
    jacobian, size = np.asarray(dense_jacobian(unknowns, problem)), problem.basis.shape[1]
    gradient = jacobian.T @ np.asarray(dense_residuals(unknowns, problem))
    gradient = np.delete(gradient, slice(size, size + 3 * SCANS))
    sd = np.sqrt(np.concatenate([np.diag(held.coordinates), *(np.diag(cov) for cov in held.landmarks)]))
    assert np.abs(gradient * sd).max() < 1e-3
    free = covariances(problem, adjust_all(problem, start).unknowns)
    assert (np.diag(free.coordinates) >= np.diag(held.coordinates) * (1 - 1e-9)).all()


def test_the_errors_agree_with_the_standard_deviations(rng):
    problem, start, true = problem_with_truth(rng)
    unknowns = adjust_all(problem, start).unknowns
    cov = covariances(problem, unknowns)
    sd = np.sqrt(np.concatenate([np.diag(cov.coordinates), *(np.diag(block) for block in cov.landmarks)]))
    values = [np.concatenate([np.asarray(u.coordinates), np.asarray(u.landmarks).ravel()]) for u in (unknowns, true)]
    observed = sd < 0.5
    assert observed.sum() > 15
    assert np.abs((values[0] - values[1]) / sd)[observed].max() < 4


# Invariances


def test_the_order_of_scans_is_irrelevant_without_odometry(rng):
    problem, start, _ = problem_with_truth(rng, odometry=False)
    order = np.array([3, 0, 4, 2, 1])
    per_scan = [problem.factors, problem.prior_poses, problem.prior_information, problem.odometry]
    permuted = [jax.tree.map(lambda x: x[order], tree) for tree in per_scan]
    other = eqx.tree_at(lambda p: [p.factors, p.prior_poses, p.prior_information, p.odometry], problem, permuted)
    found = adjust_all(problem, start).unknowns
    again = adjust_all(other, replace(start, poses=start.poses[order])).unknowns
    assert_same((again.coordinates, again.landmarks), (found.coordinates, found.landmarks), 1e-7)
    np.testing.assert_allclose(again.poses, found.poses[order], atol=1e-7)
    assert_same(covariances(other, again).coordinates, covariances(problem, found).coordinates, 1e-7)


def test_the_order_of_echoes_and_of_transmitter_and_receiver_are_irrelevant(rng):
    """(tx, rx) and (rx, tx) have the same geometry; for echoes of second order the walls swap as well."""
    problem, start, _ = problem_with_truth(rng)
    order = rng.permutation(ECHOES)
    factors = jax.tree.map(lambda x: x[:, order], problem.factors)
    reverse_path = RING.path_index[RING.paths[:, 1], RING.paths[:, 0]].astype(np.int32)
    reflection = factors.reflection
    reversed_factors = eqx.tree_at(
        lambda f: (f.path, f.reflection.first, f.reflection.second),
        factors,
        (jnp.asarray(reverse_path)[factors.path], reflection.second, reflection.first),
    )
    other = replace(problem, factors=reversed_factors)
    found, again = adjust_all(problem, start).unknowns, adjust_all(other, start).unknowns
    assert_same(again, found, 1e-7)
    assert_same(covariances(other, again), covariances(problem, found), 1e-7)


def test_echoes_of_weight_0_are_ignored(rng):
    problem, start, _ = problem_with_truth(rng)
    ignored = problem.factors.weight == 0
    path = jnp.where(ignored, 0, problem.factors.path)
    reported = jnp.where(ignored, 1e6, problem.factors.reported)
    kind = jnp.where(ignored, -1, problem.factors.reflection.kind)
    other = eqx.tree_at(
        lambda p: (p.factors.path, p.factors.reported, p.factors.reflection.kind), problem, (path, reported, kind)
    )
    found, again = adjust_all(problem, start).unknowns, adjust_all(other, start).unknowns
    assert_same(again, found)
    assert_same(covariances(other, again), covariances(problem, found))


def test_padding_is_irrelevant(rng):
    """Scans and landmarks without echoes keep their initial values and prior covariances."""
    problem, start, _ = problem_with_truth(rng)

    def grow(tree, rows):
        return jax.tree.map(lambda x: jnp.concatenate([x, jnp.zeros((rows, *x.shape[1:]), x.dtype)]), tree)

    grown = replace(
        problem,
        landmarks=grow(problem.landmarks, 2),
        factors=grow(problem.factors, 3),
        prior_poses=grow(problem.prior_poses, 3),
        odometry=grow(problem.odometry, 3),
        prior_information=grow(problem.prior_information, 3).at[SCANS:].set(1.0),
        # The row of the last scan was not used; now it must be 0.
        odometry_information=grow(problem.odometry_information.at[-1].set(0), 3),
    )
    found = adjust_all(problem, start).unknowns
    again = adjust_all(grown, replace(start, poses=grow(start.poses, 3), landmarks=grow(start.landmarks, 2))).unknowns
    kept = replace(again, poses=again.poses[:SCANS], landmarks=again.landmarks[:LANDMARK_COUNT])
    assert_same(kept, found, 1e-7)
    np.testing.assert_array_equal(again.poses[SCANS:], 0)
    np.testing.assert_array_equal(again.landmarks[LANDMARK_COUNT:], 0)
    cov, grown_cov = covariances(problem, found), covariances(grown, again)
    np.testing.assert_allclose(grown_cov.coordinates, cov.coordinates, atol=1e-7)
    np.testing.assert_allclose(grown_cov.poses, np.concatenate([cov.poses, np.tile(np.eye(3), (3, 1, 1))]), atol=1e-7)
    np.testing.assert_allclose(grown_cov.landmarks[LANDMARK_COUNT:], np.tile(np.eye(2), (2, 1, 1)), atol=1e-12)


def test_a_parameter_without_a_column_stays_at_its_prior(rng):
    problem, start, _ = problem_with_truth(rng)
    problem = replace(problem, basis=problem.basis.at[:, SENSORS].set(0))
    found = adjust_all(problem, start).unknowns
    assert found.coordinates[SENSORS] == 0
    row = covariances(problem, found).coordinates[SENSORS]
    np.testing.assert_allclose(row, np.eye(len(row))[SENSORS], atol=1e-12)
    changed = kernels.apply_parameters(problem.sensors, problem.basis @ found.coordinates)
    assert changed.range_scale == problem.sensors.range_scale


def test_the_minimum_is_a_fixed_point(rng):
    problem, start, _ = problem_with_truth(rng)
    found = adjust_all(problem, start)
    again = adjust_all(problem, found.unknowns)
    assert again.iterations <= 2
    assert_same(again.unknowns, found.unknowns, 1e-6)
    assert found.iterations < 20
