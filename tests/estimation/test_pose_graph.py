"""The pose graph against dense normal equations with numerical derivatives and GTSAM; laws of its covariances."""

import numpy as np
import pytest

from jaxsonar import SonarError
from jaxsonar.estimation.pose_graph import BetweenFactor, solve_pose_graph
from jaxsonar.geometry.se2 import compose, relative, relative_jacobians, rotate_covariance, subtract_poses


def graph_of(rng, nodes=9, loops=6, noise=1.0):
    """True poses of a random trajectory, initial poses with errors, and odometry and loop-closure factors."""
    true = np.zeros((nodes, 3))
    for k in range(1, nodes):
        true[k] = compose(true[k - 1], np.array([rng.uniform(0.5, 2.0), rng.uniform(-0.5, 0.5), rng.uniform(-1, 1)]))
    pairs = [(k, k + 1) for k in range(nodes - 1)]
    pairs += [tuple(int(k) for k in rng.choice(nodes, 2, replace=False)) for _ in range(loops)]
    factors = []
    for first, second in pairs:
        root = rng.normal(size=(3, 3)) * np.array([0.02, 0.02, 0.01])[:, None]
        cov = root @ root.T + np.diag([1e-4, 1e-4, 2e-5])
        first_from_second = relative(true[first], true[second]) + noise * (np.linalg.cholesky(cov) @ rng.normal(size=3))
        factors.append(BetweenFactor(first, second, first_from_second, np.linalg.inv(cov)))
    start = true + rng.normal(size=true.shape) * np.array([0.1, 0.1, 0.05])
    start[0] = true[0]
    return true, start, factors


def stacked_residual(flat, first, factors):
    """All residuals, whitened, as a function of all poses but the first."""
    poses = np.concatenate([first[None], flat.reshape(-1, 3)])
    first, second = (poses[[factor[k] for factor in factors]] for k in (0, 1))
    values, vectors = np.linalg.eigh(np.array([factor.information for factor in factors]))
    error = subtract_poses(relative(first, second), np.array([factor.first_from_second for factor in factors]))
    return (np.sqrt(np.maximum(values, 0.0)) * np.einsum("lij,li->lj", vectors, error)).ravel()


def numerical_jacobian(flat, first, factors, step=1e-6):
    columns = []
    for k in range(len(flat)):
        moved = np.zeros(len(flat))
        moved[k] = step
        ahead, behind = (stacked_residual(flat + sign * moved, first, factors) for sign in (1, -1))
        columns.append((ahead - behind) / (2 * step))
    return np.stack(columns, axis=-1)


def dense(start, factors):
    """The oracle: Gauss-Newton with numerical derivatives; poses and the joint covariance of all but the first."""
    flat = start[1:].ravel().copy()
    for _ in range(6):
        jacobian, residual = numerical_jacobian(flat, start[0], factors), stacked_residual(flat, start[0], factors)
        flat = flat - np.linalg.lstsq(jacobian, residual, rcond=None)[0]
    jacobian = numerical_jacobian(flat, start[0], factors)
    return np.concatenate([start[:1], flat.reshape(-1, 3)]), np.linalg.inv(jacobian.T @ jacobian)


@pytest.mark.parametrize("seed", range(4))
def test_poses_and_covariances_equal_those_of_the_dense_oracle(seed):
    _, start, factors = graph_of(np.random.default_rng(seed))
    graph = solve_pose_graph(start, factors)
    poses, cov = dense(start, factors)
    assert graph.converged
    assert np.abs(subtract_poses(graph.poses, poses)).max() < 1e-6
    chi2 = (stacked_residual(poses[1:].ravel(), poses[0], factors) ** 2).reshape(-1, 3).sum(-1)
    np.testing.assert_allclose(graph.chi2, chi2, rtol=1e-4, atol=1e-6)
    scale = cov.diagonal().max()
    nodes = np.array([4, 0, 7, 4])
    picked = np.concatenate([np.arange(9, 12), np.arange(18, 21)])
    joint = graph.joint_covariance(nodes).reshape(4, 3, 4, 3)
    inner = joint[[0, 2]][:, :, [0, 2]].reshape(6, 6)
    assert np.abs(inner - cov[np.ix_(picked, picked)]).max() < 1e-5 * scale
    assert not joint[1].any()
    np.testing.assert_allclose(joint[3], joint[0])  # a repeated node
    np.testing.assert_allclose(graph.marginal_covariances(nodes)[2], joint[2][:, 2])


def test_relative_covariances_follow_from_the_joint_covariance(rng):
    _, start, factors = graph_of(rng)
    graph = solve_pose_graph(start, factors)
    first_from_second, cov = graph.relative_poses(3, np.array([6, 0, 3]))
    np.testing.assert_allclose(first_from_second[0], relative(graph.poses[3], graph.poses[6]))
    for row, second in ((0, 6), (1, 0)):
        joint, both = graph.joint_covariance(np.array([3, second])), graph.poses[[3, second]].ravel()
        columns = []
        for k in range(6):
            moved = np.zeros(6)
            moved[k] = 1e-6
            ahead, behind = (both + sign * moved for sign in (1, -1))
            columns.append(subtract_poses(relative(ahead[:3], ahead[3:]), relative(behind[:3], behind[3:])) / 2e-6)
        design = np.stack(columns, axis=-1)
        np.testing.assert_allclose(cov[row], design @ joint @ design.T, atol=1e-9)
        by_first, by_second = relative_jacobians(both[:3], relative(both[:3], both[3:]))
        np.testing.assert_allclose(np.concatenate([by_first, by_second], axis=1), design, atol=1e-8)
    np.testing.assert_allclose(cov[2], 0.0, atol=1e-12)


def test_relative_covariances_of_all_pairs_equal_those_from_one_node(rng):
    _, start, factors = graph_of(rng)
    graph, nodes = solve_pose_graph(start, factors), np.array([0, 3, 5, 8])
    between = graph.relative_covariances(nodes)
    for k, node in enumerate(nodes):
        np.testing.assert_allclose(between[k], graph.relative_poses(int(node), nodes)[1], atol=1e-12)


def test_the_solution_is_equivariant_under_rigid_motions(rng):
    _, start, factors = graph_of(rng)
    world = np.array([3.0, -2.0, 2.5])
    here, there = solve_pose_graph(start, factors), solve_pose_graph(compose(world, start), factors)
    assert np.abs(subtract_poses(there.poses, compose(world, here.poses))).max() < 1e-6
    np.testing.assert_allclose(there.chi2, here.chi2, rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(here.poses[0], start[0])
    np.testing.assert_allclose(
        here.relative_poses(2, np.array([7]))[1], there.relative_poses(2, np.array([7]))[1], rtol=1e-4
    )


def test_a_chain_without_loops_is_composed_without_residuals(rng):
    true, _, factors = graph_of(rng, loops=0)
    poses = [true[0]]
    for factor in factors:
        poses.append(compose(poses[-1], factor.first_from_second))
    graph = solve_pose_graph(np.array(poses) + 0.01, [*factors])
    moved = np.array(poses)[0] + 0.01
    assert np.abs(graph.poses[0] - moved).max() == 0.0
    assert graph.chi2.max() < 1e-9


def test_removing_a_factor_undoes_adding_it(rng):
    _, start, factors = graph_of(rng)
    never = solve_pose_graph(start, factors[:-1])
    withdrawn = solve_pose_graph(solve_pose_graph(start, factors).poses, factors[:-1])
    assert np.abs(subtract_poses(withdrawn.poses, never.poses)).max() < 1e-6
    np.testing.assert_allclose(
        withdrawn.joint_covariance(np.arange(9)), never.joint_covariance(np.arange(9)), atol=1e-8
    )


def test_a_factor_of_rank_2_does_not_constrain_the_third_direction(rng):
    _, start, factors = graph_of(rng, loops=0)
    before = solve_pose_graph(start, factors)
    free = np.array([np.cos(0.4), np.sin(0.4)])
    held = np.eye(3)
    held[:2, :2] -= np.outer(free, free)
    first_from_second, cov = before.relative_poses(1, np.array([8]))
    # In the undetermined direction the measurement is absurd.
    target = first_from_second[0] + np.append(5.0 * free, 0.0)
    after = solve_pose_graph(start, [*factors, BetweenFactor(1, 8, target, 1e6 * held)])
    moved, less = after.relative_poses(1, np.array([8]))
    assert after.converged
    assert np.abs(subtract_poses(moved[0], first_from_second[0])).max() < 1e-5  # it agrees in the determined directions
    assert free @ less[0][:2, :2] @ free < 1.001 * (free @ cov[0][:2, :2] @ free)
    across = np.array([-free[1], free[0]])
    assert across @ less[0][:2, :2] @ across < 2e-6
    assert free @ less[0][:2, :2] @ free > 1e-5


def test_the_errors_are_consistent_with_the_covariances():
    rng, total, count = np.random.default_rng(5), 0.0, 40
    for _ in range(count):
        true, start, factors = graph_of(rng)
        graph = solve_pose_graph(start, factors)
        error = subtract_poses(graph.poses, true)[1:].ravel()
        total += error @ np.linalg.solve(graph.joint_covariance(np.arange(1, 9)), error)
    assert abs(total / (24 * count) - 1) < 4 * np.sqrt(2 / (24 * count))


def test_undetermined_poses_and_invalid_factors_are_errors(rng):
    _, start, factors = graph_of(rng, loops=0)
    with pytest.raises(SonarError, match="do not determine"):
        solve_pose_graph(start, factors[:3] + factors[4:])
    flat = factors[4]._replace(information=np.diag([1e4, 0.0, 1e4]))
    with pytest.raises(SonarError, match="do not determine"):
        solve_pose_graph(start, [*factors[:4], flat, *factors[5:]])
    with pytest.raises(SonarError, match="not finite"):
        solve_pose_graph(start, [factors[0]._replace(first_from_second=np.full(3, np.nan)), *factors[1:]])
    with pytest.raises(SonarError, match="allowed are 0 to 8"):
        solve_pose_graph(start, [*factors, BetweenFactor(3, 12, np.zeros(3), np.eye(3))])


def test_from_a_bad_start_the_result_is_finite_and_good_if_converged(rng):
    for _ in range(5):
        true, start, factors = graph_of(rng, nodes=20, loops=10)
        start[1:] += rng.normal(size=(19, 3)) * np.array([3.0, 3.0, 1.0])
        graph = solve_pose_graph(start, factors)
        assert np.isfinite(graph.poses).all()
        if graph.converged and graph.chi2.sum() < 200:
            assert np.abs(subtract_poses(graph.poses, true)[:, :2]).max() < 0.5


def test_one_pose_needs_no_factors():
    graph = solve_pose_graph(np.zeros((1, 3)), [])
    assert graph.converged
    assert not graph.marginal_covariances(np.array([0])).any()


@pytest.mark.parametrize("seed", range(3))
def test_gtsam_finds_the_same_poses_and_covariances(seed):
    """Up to second order: the residuals of GTSAM are those of the Lie algebra, in the frame of the measurement."""
    gtsam = pytest.importorskip("gtsam")
    _, start, factors = graph_of(np.random.default_rng(seed))
    graph = solve_pose_graph(start, factors)
    problem, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    fixed = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    problem.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*start[0]), fixed))
    for k, pose in enumerate(start):
        values.insert(k, gtsam.Pose2(*pose))
    for first, second, measured, information in factors:
        cov = rotate_covariance(-measured[2], np.linalg.inv(information))
        noise = gtsam.noiseModel.Gaussian.Covariance(cov)
        problem.add(gtsam.BetweenFactorPose2(first, second, gtsam.Pose2(*measured), noise))
    found = gtsam.LevenbergMarquardtOptimizer(problem, values).optimize()
    poses = [found.atPose2(k) for k in range(len(start))]
    poses = np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses])
    np.testing.assert_allclose(subtract_poses(poses, graph.poses), 0, atol=3e-3)
    cov = rotate_covariance(poses[5, 2], gtsam.Marginals(problem, found).marginalCovariance(5))
    sd = np.sqrt(np.diag(graph.marginal_covariances(np.array([5]))[0]))
    np.testing.assert_allclose(np.sqrt(np.diag(cov)), sd, rtol=0.03)
