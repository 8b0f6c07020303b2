"""The pose graph against dense normal equations with numerical derivatives, and the laws of its covariances."""

import numpy as np
import pytest

from jaxsonar import SonarError
from jaxsonar.estimation.pose_graph import BetweenFactor, solve_pose_graph
from jaxsonar.geometry.se2 import compose, relative, relative_jacobians, wrap_angle


def graph_of(rng, nodes=9, loops=6, noise=1.0):
    """A wandering path with its chain, some loops, and a start off the truth."""
    true = np.zeros((nodes, 3))
    for k in range(1, nodes):
        true[k] = compose(true[k - 1], np.array([rng.uniform(0.5, 2.0), rng.uniform(-0.5, 0.5), rng.uniform(-1, 1)]))
    ends = [(k, k + 1) for k in range(nodes - 1)]
    ends += [tuple(int(k) for k in rng.choice(nodes, 2, replace=False)) for _ in range(loops)]
    links = []
    for first, second in ends:
        root = rng.normal(size=(3, 3)) * np.array([0.02, 0.02, 0.01])[:, None]
        cov = root @ root.T + np.diag([1e-4, 1e-4, 2e-5])
        seen = relative(true[first], true[second]) + noise * (np.linalg.cholesky(cov) @ rng.normal(size=3))
        links.append(BetweenFactor(first, second, seen, np.linalg.inv(cov)))
    start = true + rng.normal(size=true.shape) * np.array([0.1, 0.1, 0.05])
    start[0] = true[0]
    return true, start, links


def stacked_residual(flat, first, links):
    """All residuals, whitened, as a function of all poses but the first."""
    poses = np.concatenate([first[None], flat.reshape(-1, 3)])
    first, second = (poses[[link[k] for link in links]] for k in (0, 1))
    values, vectors = np.linalg.eigh(np.array([link.information for link in links]))
    off = difference(relative(first, second), np.array([link.relative for link in links]))
    return (np.sqrt(np.maximum(values, 0.0)) * np.einsum("lij,li->lj", vectors, off)).ravel()


def numerical_jacobian(flat, first, links, step=1e-6):
    columns = []
    for k in range(len(flat)):
        moved = np.zeros(len(flat))
        moved[k] = step
        ahead, behind = (stacked_residual(flat + sign * moved, first, links) for sign in (1, -1))
        columns.append((ahead - behind) / (2 * step))
    return np.stack(columns, axis=-1)


def dense(start, links):
    """The oracle: Gauss-Newton with numerical derivatives; poses and the joint covariance of all but the first."""
    flat = start[1:].ravel().copy()
    for _ in range(6):
        jacobian, residual = numerical_jacobian(flat, start[0], links), stacked_residual(flat, start[0], links)
        flat = flat - np.linalg.lstsq(jacobian, residual, rcond=None)[0]
    jacobian = numerical_jacobian(flat, start[0], links)
    return np.concatenate([start[:1], flat.reshape(-1, 3)]), np.linalg.inv(jacobian.T @ jacobian)


def difference(a, b):
    off = a - b
    off[..., 2] = wrap_angle(off[..., 2])
    return off


@pytest.mark.parametrize("seed", range(4))
def test_the_poses_and_every_covariance_are_those_of_the_dense_oracle(seed):
    _, start, links = graph_of(np.random.default_rng(seed))
    graph = solve_pose_graph(start, links)
    poses, cov = dense(start, links)
    assert graph.converged
    assert np.abs(difference(graph.poses, poses)).max() < 1e-6
    chi2 = (stacked_residual(poses[1:].ravel(), poses[0], links) ** 2).reshape(-1, 3).sum(-1)
    np.testing.assert_allclose(graph.chi2, chi2, rtol=1e-4, atol=1e-6)
    scale = cov.diagonal().max()
    nodes = np.array([4, 0, 7, 4])
    picked = np.concatenate([np.arange(9, 12), np.arange(18, 21)])
    joint = graph.joint_covariance(nodes).reshape(4, 3, 4, 3)
    inner = joint[[0, 2]][:, :, [0, 2]].reshape(6, 6)
    assert np.abs(inner - cov[np.ix_(picked, picked)]).max() < 1e-5 * scale
    assert not joint[1].any()
    np.testing.assert_allclose(joint[3], joint[0])  # the same node asked for twice
    np.testing.assert_allclose(graph.marginal_covariances(nodes)[2], joint[2][:, 2])


def test_the_relative_covariance_is_that_of_the_joint_one_through_numerical_derivatives(rng):
    _, start, links = graph_of(rng)
    graph = solve_pose_graph(start, links)
    seen, cov = graph.relative_poses(3, np.array([6, 0, 3]))
    np.testing.assert_allclose(seen[0], relative(graph.poses[3], graph.poses[6]))
    for row, second in ((0, 6), (1, 0)):
        joint, both = graph.joint_covariance(np.array([3, second])), graph.poses[[3, second]].ravel()
        columns = []
        for k in range(6):
            moved = np.zeros(6)
            moved[k] = 1e-6
            ahead, behind = (both + sign * moved for sign in (1, -1))
            columns.append(difference(relative(ahead[:3], ahead[3:]), relative(behind[:3], behind[3:])) / 2e-6)
        design = np.stack(columns, axis=-1)
        np.testing.assert_allclose(cov[row], design @ joint @ design.T, atol=1e-9)
        by_first, by_second = relative_jacobians(both[:3], relative(both[:3], both[3:]))
        np.testing.assert_allclose(np.concatenate([by_first, by_second], axis=1), design, atol=1e-8)
    np.testing.assert_allclose(cov[2], 0.0, atol=1e-12)


def test_every_pair_is_as_one_of_them_sees_the_other(rng):
    _, start, links = graph_of(rng)
    graph, nodes = solve_pose_graph(start, links), np.array([0, 3, 5, 8])
    between = graph.relative_covariances(nodes)
    for k, node in enumerate(nodes):
        np.testing.assert_allclose(between[k], graph.relative_poses(int(node), nodes)[1], atol=1e-12)


def test_the_world_may_be_turned_and_moved(rng):
    _, start, links = graph_of(rng)
    world = np.array([3.0, -2.0, 2.5])
    here, there = solve_pose_graph(start, links), solve_pose_graph(compose(world, start), links)
    assert np.abs(difference(there.poses, compose(world, here.poses))).max() < 1e-6
    np.testing.assert_allclose(there.chi2, here.chi2, rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(here.poses[0], start[0])
    np.testing.assert_allclose(
        here.relative_poses(2, np.array([7]))[1], there.relative_poses(2, np.array([7]))[1], rtol=1e-4
    )


def test_a_chain_alone_is_composed_and_costs_nothing(rng):
    true, _, links = graph_of(rng, loops=0)
    poses = [true[0]]
    for link in links:
        poses.append(compose(poses[-1], link.relative))
    graph = solve_pose_graph(np.array(poses) + 0.01, [*links])
    moved = np.array(poses)[0] + 0.01
    assert np.abs(graph.poses[0] - moved).max() == 0.0
    assert graph.chi2.max() < 1e-9


def test_a_link_withdrawn_is_a_link_never_made(rng):
    _, start, links = graph_of(rng)
    never = solve_pose_graph(start, links[:-1])
    withdrawn = solve_pose_graph(solve_pose_graph(start, links).poses, links[:-1])
    assert np.abs(difference(withdrawn.poses, never.poses)).max() < 1e-6
    np.testing.assert_allclose(
        withdrawn.joint_covariance(np.arange(9)), never.joint_covariance(np.arange(9)), atol=1e-8
    )


def test_a_link_that_knows_two_directions_leaves_the_third_alone(rng):
    _, start, links = graph_of(rng, loops=0)
    before = solve_pose_graph(start, links)
    way = np.array([np.cos(0.4), np.sin(0.4)])
    held = np.eye(3)
    held[:2, :2] -= np.outer(way, way)
    seen, cov = before.relative_poses(1, np.array([8]))
    # Along the free way it says something absurd.
    target = seen[0] + np.append(5.0 * way, 0.0)
    after = solve_pose_graph(start, [*links, BetweenFactor(1, 8, target, 1e6 * held)])
    moved, less = after.relative_poses(1, np.array([8]))
    assert after.converged
    assert np.abs(difference(moved[0], seen[0])).max() < 1e-5  # it agrees where it says anything
    assert way @ less[0][:2, :2] @ way < 1.001 * (way @ cov[0][:2, :2] @ way)
    across = np.array([-way[1], way[0]])
    assert across @ less[0][:2, :2] @ across < 2e-6
    assert way @ less[0][:2, :2] @ way > 1e-5


def test_the_errors_are_as_large_as_the_covariances_say():
    rng, total, count = np.random.default_rng(5), 0.0, 40
    for _ in range(count):
        true, start, links = graph_of(rng)
        graph = solve_pose_graph(start, links)
        off = difference(graph.poses, true)[1:].ravel()
        total += off @ np.linalg.solve(graph.joint_covariance(np.arange(1, 9)), off)
    assert abs(total / (24 * count) - 1) < 4 * np.sqrt(2 / (24 * count))


def test_what_cannot_be_solved_is_said(rng):
    _, start, links = graph_of(rng, loops=0)
    with pytest.raises(SonarError, match="do not determine"):
        solve_pose_graph(start, links[:3] + links[4:])
    flat = links[4]._replace(information=np.diag([1e4, 0.0, 1e4]))
    with pytest.raises(SonarError, match="do not determine"):
        solve_pose_graph(start, [*links[:4], flat, *links[5:]])
    with pytest.raises(SonarError, match="not finite"):
        solve_pose_graph(start, [links[0]._replace(first_from_second=np.full(3, np.nan)), *links[1:]])
    with pytest.raises(SonarError, match="allowed are 0 to 8"):
        solve_pose_graph(start, [*links, BetweenFactor(3, 12, np.zeros(3), np.eye(3))])


def test_from_a_bad_start_there_are_poses_or_a_word_that_there_are_none(rng):
    for _ in range(5):
        true, start, links = graph_of(rng, nodes=20, loops=10)
        start[1:] += rng.normal(size=(19, 3)) * np.array([3.0, 3.0, 1.0])
        graph = solve_pose_graph(start, links)
        assert np.isfinite(graph.poses).all()
        if graph.converged and graph.chi2.sum() < 200:
            assert np.abs(difference(graph.poses, true)[:, :2]).max() < 0.5


def test_one_pose_needs_no_links():
    graph = solve_pose_graph(np.zeros((1, 3)), [])
    assert graph.converged
    assert not graph.marginal_covariances(np.array([0])).any()
