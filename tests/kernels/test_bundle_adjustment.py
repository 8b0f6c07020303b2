"""Ring, poses and reflectors in one least squares: slopes, a dense solver beside it, and what must change nothing."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from jax.flatten_util import ravel_pytree

from jaxsonar import Ring, kernels
from jaxsonar.estimation import sparse_adjustment
from jaxsonar.kernels import (
    CORNER,
    EDGE,
    PLANE,
    SECOND_ORDER,
    EchoFactors,
    Landmarks,
    LeastSquaresProblem,
    Reflection,
    Unknowns,
)

RING = Ring.circular(count=6, neighbors=1, radius=0.25)
SENSORS, SCANS, ECHOES = 6, 5, 40
SIGMA = 1e-3
KIND = np.array([PLANE, PLANE, PLANE, CORNER, EDGE, -1], np.int32)
REFLECTORS = len(KIND)
SCENE = Landmarks(
    kind=KIND,
    parameters=np.array([[0.01, 0.1], [-0.02, 1.7], [0.0, -2.0], [0.01, 0.02], [-0.01, 0.0], [0, 0]], np.float64),
    anchor=np.array([[1.2, 0.2], [0.1, 1.4], [-0.8, -1.1], [1.3, 1.2], [-1.0, 0.6], [0, 0]], np.float64),
    extent=np.tile([-1.0, 1.0], (REFLECTORS, 1)),
)
POSES = np.array([[0, 0, 0], [0.2, 0.05, 0.4], [0.35, -0.1, 0.9], [0.2, -0.2, 2.9], [0.0, -0.1, -2.6]], np.float64)
LINK = np.array([0.004, 0.004, 0.006])


@pytest.fixture(autouse=True)
def double():
    """Double precision, but where a test asks for less."""
    with jax.enable_x64(True):
        yield


def arrays(tree):
    return jax.tree.map(jnp.asarray, tree)


def modes_of(sensors):
    """Offsets relative to their mean, the speed, and every position, in standard deviations."""
    columns = np.zeros((3 * sensors + 1, 3 * sensors + 1))
    columns[:sensors, :sensors] = 0.02 * (np.eye(sensors) - 1 / sensors)
    columns[sensors, sensors] = 0.015
    columns[sensors + 1 :, sensors + 1 :] = 0.004 * np.eye(2 * sensors)
    return columns


def a_problem(rng, *, linked=True, garbage=0.0):
    """Echoes of all kinds with noise, from a ring, poses and a scene that are a little off; and the start."""
    shape = (SCANS, ECHOES)
    kind = rng.choice([PLANE, PLANE, CORNER, EDGE, SECOND_ORDER], shape).astype(np.int32)
    first = np.select([kind == CORNER, kind == EDGE], [3, 4], rng.integers(0, 2, shape))
    first = np.where((kind == PLANE) & (rng.random(shape) < 0.3), 2, first).astype(np.int32)
    second = np.where(kind == SECOND_ORDER, 1 - first, first).astype(np.int32)
    missing = rng.random(shape) < 0.2
    heard = EchoFactors(
        path=jnp.asarray(rng.integers(0, len(RING.paths), shape), jnp.int32),
        reported=jnp.zeros(shape),
        reflection=arrays(Reflection(kind, first, second)),
        weight=jnp.asarray(np.where(missing, 0, 1 / SIGMA**2)),
    )
    step = np.zeros((SCANS, 3))
    cos, sin = np.cos(POSES[:-1, 2]), np.sin(POSES[:-1, 2])
    way = np.diff(POSES, axis=0)
    step[:-1] = np.stack([cos * way[:, 0] + sin * way[:, 1], cos * way[:, 1] - sin * way[:, 0], way[:, 2]], -1)
    anchored = np.full((SCANS, 3), 1.0)
    anchored[0] = 1e8
    # The last link leads nowhere: what stands there must not matter.
    linked_weight = np.tile(linked / LINK**2, (SCANS, 1))
    # Odometry may well be a whole turn off.
    measured = step + LINK * rng.standard_normal((SCANS, 3)) + np.array([0, 0, 2 * np.pi])
    problem = LeastSquaresProblem(
        sensors=RING.sensors,
        basis=jnp.asarray(modes_of(SENSORS)),
        landmarks=arrays(SCENE),
        factors=heard,
        prior_poses=jnp.asarray(POSES),
        prior_information=jnp.asarray(anchored),
        odometry=jnp.asarray(measured),
        odometry_information=jnp.asarray(linked_weight),
    )
    true = Unknowns(
        jnp.asarray(rng.normal(0, 0.3, 3 * SENSORS + 1)),
        jnp.asarray(POSES + np.concatenate([np.zeros((1, 3)), 0.01 * rng.standard_normal((SCANS - 1, 3))])),
        jnp.asarray(SCENE.parameters + 0.01 * rng.standard_normal((REFLECTORS, 2)) * (KIND >= 0)[:, None]),
    )
    noise = np.where(missing, garbage, SIGMA * rng.standard_normal(shape))
    reported = -kernels.residuals(problem, true) + noise
    problem = eqx.tree_at(lambda p: p.heard.reported, problem, reported)
    return problem, Unknowns(jnp.zeros(3 * SENSORS + 1), problem.poses, problem.scene.parameters), true


def wrap(angle):
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi


def dense(unknowns, problem):
    """Everything that is squared, in one vector, with poses as matrices."""
    out = [(jnp.sqrt(problem.heard.weight) * kernels.residuals(problem, unknowns)).ravel()]
    out += [unknowns.modes, (unknowns.scene - problem.scene.parameters).ravel()]
    off = unknowns.poses - problem.poses
    out.append((jnp.sqrt(problem.anchored) * jnp.concatenate([off[:, :2], wrap(off[:, 2:])], 1)).ravel())
    for k in range(len(problem.poses) - 1):
        here, there = unknowns.poses[k], unknowns.poses[k + 1]
        cos, sin = jnp.cos(here[2]), jnp.sin(here[2])
        back = jnp.stack([jnp.stack([cos, sin]), jnp.stack([-sin, cos])])
        slip = back @ (there - here)[:2] - problem.odometry[k, :2]
        turn = wrap(there[2] - here[2] - problem.odometry[k, 2])
        out.append(jnp.sqrt(problem.linked[k]) * jnp.append(slip, turn))
    return jnp.concatenate(out)


adjusted = partial(kernels.adjust, poses_free=True)
held = partial(kernels.adjust, poses_free=False)


@jax.jit
def jacobian(unknowns, problem):
    slope = jax.jacfwd(dense)(unknowns, problem)
    rows = slope.modes.shape[0]
    return slope.poses.reshape(rows, -1), jnp.concatenate([slope.modes, slope.scene.reshape(rows, -1)], 1)


slope_of_cost = jax.jit(jax.grad(kernels.cost, argnums=1))


def assert_same(a, b, atol=1e-9):
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=atol)


@pytest.fixture(params=[True, False], ids=["odometry", "no odometry"])
def linked(request):
    return request.param


# The model


def test_residuals_are_the_noise_where_the_unknowns_are_true(rng):
    problem, _, true = a_problem(rng)
    left = np.asarray(kernels.residuals(problem, true))[np.asarray(problem.heard.weight) > 0]
    assert np.std(left) == pytest.approx(SIGMA, rel=0.2)


def test_residuals_are_report_minus_expected_with_the_moved_ring(rng):
    """Echo by echo through the kernels of one path."""
    problem, _, true = a_problem(rng)
    sensors = kernels.apply_parameters(problem.sensors, problem.modes @ true.coordinates)
    scene = eqx.tree_at(lambda s: s.parameters, problem.scene, true.landmarks)
    found, heard = np.asarray(kernels.residuals(problem, true)), problem.heard
    for k, e in [(0, 0), (1, 7), (2, 11), (3, 30), (4, 39)]:
        tx, rx = RING.paths[int(heard.path[k, e])]
        of = heard.reflection
        one, other = (
            kernels.landmark_in_robot_frame(true.poses[k], jax.tree.map(lambda x, row=int(rows[k, e]): x[row], scene))
            for rows in (of.first, of.second)
        )
        reach = kernels.expected_range(of.kind[k, e], one, other, sensors.position[tx], sensors.position[rx])
        offset = (sensors.range_offset[tx] + sensors.range_offset[rx]) / 2
        expected = heard.reported[k, e] - (reach / sensors.range_scale + offset)
        np.testing.assert_allclose(found[k, e], expected, atol=1e-13)


def test_the_cost_is_half_the_sum_of_all_squares(rng, linked):
    problem, start, true = a_problem(rng, linked=linked)
    for unknowns in (start, true):
        expected = float((dense(unknowns, problem) ** 2).sum()) / 2
        np.testing.assert_allclose(kernels.cost(problem, unknowns), expected, rtol=1e-12)


@pytest.mark.slow
def test_slopes_are_those_of_finite_differences_forward_and_in_reverse(rng):
    problem, _, true = a_problem(rng)
    flat, unravel = ravel_pytree(true)
    step = 1e-5
    numerical = [(kernels.residuals(problem, unravel(flat + h)), kernels.residuals(problem, unravel(flat - h)))
                 for h in step * jnp.eye(len(flat))]  # fmt: skip
    numerical = np.stack([np.ravel(there - back) / (2 * step) for there, back in numerical], axis=-1)
    by_poses, by_shared = (np.asarray(x) for x in jacobian(true, problem))
    modes = problem.modes.shape[1]
    forward = np.concatenate([by_shared[:, :modes], by_poses, by_shared[:, modes:]], axis=1)
    weight = np.sqrt(np.ravel(problem.heard.weight))
    own = forward[: len(weight)][weight > 0] / weight[weight > 0, None]
    np.testing.assert_allclose(own, numerical[weight > 0], rtol=1e-4, atol=1e-8)
    reverse, _ = ravel_pytree(slope_of_cost(problem, true))
    expected = forward.T @ np.asarray(dense(true, problem))
    np.testing.assert_allclose(reverse, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


def test_slopes_are_finite_on_the_wall_and_in_padded_rows(rng):
    """A sensor on a wall or at a corner, reflectors of no kind: 0 times infinity would poison everything."""
    problem, start, _ = a_problem(rng)
    direct = eqx.tree_at(lambda p: p.heard.path, problem, problem.heard.path % SENSORS)
    sensor = jnp.asarray([0.25, 0.0])
    on_wall = problem.scene.anchor[0] + start.landmarks[0, 0] * kernels.normal(start.landmarks[0, 1]) - sensor
    at_corner = problem.scene.anchor[3] + start.landmarks[3] - sensor
    places = [replace(start, poses=start.poses.at[0].set(jnp.append(at, 0.0))) for at in (on_wall, at_corner)]
    nothing = jnp.full((SCANS, ECHOES), -1, jnp.int32)
    nowhere = Reflection(nothing, nothing + REFLECTORS, nothing + REFLECTORS)
    padded = eqx.tree_at(lambda p: p.heard.reflection, problem, nowhere)
    for given, unknowns in ((direct, places[0]), (problem, places[0]), (direct, places[1]), (padded, start)):
        for leaf in jax.tree.leaves(slope_of_cost(given, unknowns)):
            assert np.isfinite(leaf).all()


@pytest.mark.slow
def test_single_precision_agrees(rng):
    problem, start, _ = a_problem(rng)
    wide = adjusted(problem, start)
    leaves, tree = jax.tree.flatten((problem, start))
    leaves = [np.asarray(leaf) for leaf in leaves]
    with jax.enable_x64(False):
        found = adjusted(*jax.tree.unflatten(tree, [jnp.asarray(leaf) for leaf in leaves]))
    assert found.unknowns.poses.dtype == found.covariance.dtype == np.float32
    np.testing.assert_allclose(found.before, wide.before, rtol=1e-4)  # of the residuals, too
    np.testing.assert_allclose(found.unknowns.poses, wide.unknowns.poses, atol=1e-4)
    np.testing.assert_allclose(found.unknowns.scene, wide.unknowns.scene, atol=1e-4)
    few, many = (np.asarray(problem.modes) @ np.asarray(each.unknowns.modes, np.float64) for each in (found, wide))
    np.testing.assert_allclose(few, many, atol=1e-4)


# The least squares


@pytest.mark.slow
def test_a_dense_solver_finds_the_same(rng, linked):
    problem, start, _ = a_problem(rng, linked=linked)
    found = adjusted(problem, start)
    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-10)
    expected = optx.least_squares(dense, solver, start, problem, max_steps=100).value
    assert_same(found.unknowns, expected, atol=1e-6)
    assert found.cost <= (1 + 1e-9) * kernels.cost(problem, expected)
    assert found.cost < 1e-2 * found.before
    np.testing.assert_allclose(found.before, kernels.cost(problem, start), rtol=1e-12)
    np.testing.assert_allclose(found.cost, kernels.cost(problem, found.unknowns), rtol=1e-12)


def test_the_covariance_is_that_of_the_dense_equations(rng, linked):
    problem, start, _ = a_problem(rng, linked=linked)
    found = adjusted(problem, start)
    by_poses, by_shared = (np.asarray(x) for x in jacobian(found.unknowns, problem))
    whole = np.concatenate([by_poses, by_shared], axis=1)
    covariance = np.linalg.inv(whole.T @ whole)
    shared = covariance[by_poses.shape[1] :, by_poses.shape[1] :]
    scale = np.sqrt(np.outer(np.diag(shared), np.diag(shared)))
    np.testing.assert_allclose(found.covariance / scale, shared / scale, atol=1e-6)
    pulled = whole.T @ np.asarray(dense(found.unknowns, problem))
    assert np.abs(pulled * np.sqrt(np.diag(covariance))).max() < 1e-3  # standard deviations from the minimum


@pytest.mark.slow
def test_sparse_elimination_finds_the_same(rng, linked):
    """Steps, cost and covariances are those of the dense block of all reflectors, for echoes of all kinds."""
    problem, start, _ = a_problem(rng, linked=linked)
    one, other = adjusted(problem, start), sparse_adjustment.adjust(problem, start, poses_free=True)
    assert_same(one.unknowns, other.unknowns, atol=1e-8)
    assert float(one.cost) == pytest.approx(float(other.cost), rel=1e-9)
    assert float(one.before) == pytest.approx(float(other.initial_cost), rel=1e-12)
    known = sparse_adjustment.known(problem, one.unknowns)
    modes = problem.modes.shape[1]
    np.testing.assert_allclose(known.modes, one.covariance[:modes, :modes], rtol=1e-5, atol=1e-10)
    np.testing.assert_allclose(known.poses, kernels.pose_covariances(problem, one.unknowns), rtol=1e-5, atol=1e-10)
    for k, cov in enumerate(known.reflectors):
        own = slice(modes + 2 * k, modes + 2 * k + 2)
        np.testing.assert_allclose(cov, one.covariance[own, own], rtol=1e-5, atol=1e-10)


@pytest.mark.slow
def test_sparse_elimination_with_poses_held(rng):
    problem, start, _ = a_problem(rng)
    found = sparse_adjustment.adjust(problem, start, poses_free=False)
    assert_same(held(problem, start).unknowns, found.unknowns, atol=1e-8)
    np.testing.assert_array_equal(found.unknowns.poses, start.poses)


def test_held_poses_stay_and_the_covariance_knows(rng):
    problem, start, true = a_problem(rng)
    begin = replace(start, poses=true.poses)
    found = held(problem, begin)
    np.testing.assert_array_equal(found.unknowns.poses, true.poses)
    _, by_shared = (np.asarray(x) for x in jacobian(found.unknowns, problem))
    expected = np.linalg.inv(by_shared.T @ by_shared)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found.covariance / scale, expected / scale, atol=1e-6)
    pulled = by_shared.T @ np.asarray(dense(found.unknowns, problem))
    assert np.abs(pulled * np.sqrt(np.diag(expected))).max() < 1e-3
    free = adjusted(problem, begin)
    assert (np.diag(free.covariance) >= np.diag(found.covariance) * (1 - 1e-9)).all()  # unknown poses cost something


def test_the_truth_is_within_what_is_said_of_it(rng):
    problem, start, true = a_problem(rng)
    found = adjusted(problem, start)
    shared = [np.concatenate([np.asarray(u.coordinates), np.asarray(u.landmarks).ravel()]) for u in (found.unknowns, true)]
    z = (shared[0] - shared[1]) / np.sqrt(np.diag(found.covariance))
    observed = np.sqrt(np.diag(found.covariance)) < 0.5
    assert observed.sum() > 15
    assert np.abs(z[observed]).max() < 4


# What changes nothing


@pytest.mark.slow
def test_the_order_of_scans_means_nothing_without_odometry(rng):
    problem, start, _ = a_problem(rng, linked=False)
    order = np.array([3, 0, 4, 2, 1])
    per_scan = [problem.heard, problem.poses, problem.anchored, problem.odometry]
    moved = [jax.tree.map(lambda x: x[order], tree) for tree in per_scan]
    other = eqx.tree_at(lambda p: [p.heard, p.poses, p.anchored, p.odometry], problem, moved)
    found, again = adjusted(problem, start), adjusted(other, replace(start, poses=start.poses[order]))
    assert_same((again.unknowns.modes, again.unknowns.scene), (found.unknowns.modes, found.unknowns.scene), 1e-7)
    np.testing.assert_allclose(again.unknowns.poses, found.unknowns.poses[order], atol=1e-7)
    np.testing.assert_allclose(again.covariance, found.covariance, atol=1e-7)


@pytest.mark.slow
def test_the_order_of_echoes_and_both_ways_of_a_pair_mean_nothing(rng):
    """(tx, rx) and (rx, tx) are one geometry: swapped for all but wall to wall, whose order turns about."""
    problem, start, _ = a_problem(rng)
    order = rng.permutation(ECHOES)
    heard = jax.tree.map(lambda x: x[:, order], problem.heard)
    back = RING.path_index[RING.paths[:, 1], RING.paths[:, 0]].astype(np.int32)
    of = heard.reflection
    turned = eqx.tree_at(
        lambda h: (h.path, h.reflection.first, h.reflection.second),
        heard,
        (jnp.asarray(back)[heard.path], of.second, of.first),
    )
    found, again = adjusted(problem, start), adjusted(replace(problem, heard=turned), start)
    assert_same(again.unknowns, found.unknowns, 1e-7)
    np.testing.assert_allclose(again.covariance, found.covariance, atol=1e-7)


def test_echoes_of_weight_0_mean_nothing(rng):
    problem, start, _ = a_problem(rng)
    out = problem.heard.weight == 0
    path = jnp.where(out, 0, problem.heard.path)
    reported = jnp.where(out, 1e6, problem.heard.reported)
    kind = jnp.where(out, -1, problem.heard.reflection.kind)
    other = eqx.tree_at(
        lambda p: (p.heard.path, p.heard.reported, p.heard.reflection.kind), problem, (path, reported, kind)
    )
    found, again = adjusted(problem, start), adjusted(other, start)
    assert_same(again.unknowns, found.unknowns)
    np.testing.assert_allclose(again.covariance, found.covariance, atol=1e-9)


@pytest.mark.slow
def test_rows_of_padding_mean_nothing(rng):
    """More scans and reflectors without echoes; what was unknown of them stays as it began."""
    problem, start, _ = a_problem(rng)

    def more(tree, rows):
        return jax.tree.map(lambda x: jnp.concatenate([x, jnp.zeros((rows, *x.shape[1:]), x.dtype)]), tree)

    # The last link led nowhere; now it must be none.
    grown = replace(
        problem,
        scene=more(problem.scene, 2),
        heard=more(problem.heard, 3),
        poses=more(problem.poses, 3),
        odometry=more(problem.odometry, 3),
        anchored=more(problem.anchored, 3).at[SCANS:].set(1.0),
        linked=more(problem.linked.at[-1].set(0), 3),
    )
    found = adjusted(problem, start)
    begin = replace(start, poses=more(start.poses, 3), landmarks=more(start.landmarks, 2))
    again = adjusted(grown, begin)
    kept = replace(again.unknowns, poses=again.unknowns.poses[:SCANS], scene=again.unknowns.scene[:REFLECTORS])
    assert_same(kept, found.unknowns, 1e-7)
    np.testing.assert_array_equal(again.unknowns.poses[SCANS:], 0)
    np.testing.assert_array_equal(again.unknowns.scene[REFLECTORS:], 0)
    size = len(found.covariance)
    np.testing.assert_allclose(again.covariance[:size, :size], found.covariance, atol=1e-7)
    np.testing.assert_allclose(again.covariance[size:, size:], np.eye(4), atol=1e-12)


def test_a_mode_that_is_held_stays(rng):
    problem, start, _ = a_problem(rng)
    problem = replace(problem, modes=problem.modes.at[:, SENSORS].set(0))
    found = adjusted(problem, start)
    assert found.unknowns.modes[SENSORS] == 0
    row = np.asarray(found.covariance)[SENSORS]
    np.testing.assert_allclose(row, np.eye(len(row))[SENSORS], atol=1e-12)  # as expected, and of no influence
    moved = kernels.apply_parameters(problem.sensors, problem.modes @ found.unknowns.modes)
    assert moved.range_scale == problem.sensors.range_scale


def test_a_minimum_stays_where_it_is(rng):
    problem, start, _ = a_problem(rng)
    found = adjusted(problem, start)
    again = adjusted(problem, found.unknowns)
    assert again.steps <= 2
    assert_same(again.unknowns, found.unknowns, 1e-6)
    assert found.steps < 20
