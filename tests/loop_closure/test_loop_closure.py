"""Closures between submaps of floor plans: correct where the pose is unique, none where it is ambiguous."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from support.submaps import corridor_with_rooms, drive, rectangle, ring_corridor, submap, submaps

from jaxsonar import kernels
from jaxsonar.estimation.pose_graph import BetweenFactor, solve_pose_graph
from jaxsonar.geometry.se2 import compose, relative, subtract_poses, wrap_angle
from jaxsonar.loop_closure.closure_candidate import ACCEPTED, ClosureCandidate
from jaxsonar.loop_closure.closure_detection import detect_closure
from jaxsonar.loop_closure.sequential_constraint import sequential_factor
from jaxsonar.loop_closure.settings import SETTINGS
from jaxsonar.loop_closure.submap_graph import SubmapGraph, overlap_candidates
from jaxsonar.loop_closure.submap_matching import Pairs, fit_pose, nearest_pairs, pair_residuals
from jaxsonar.loop_closure.verification import ClosureVerifier

NICHE = np.array([[0, 0], [4, 0], [4, 3.2], [2.4, 3.2], [2.4, 2.7], [1.2, 2.7], [1.2, 3.2], [0, 3.2]], dtype=float)
FIRST, SECOND = (
    drive((1, 1), (3, 1), (3, 2.2), (1.2, 2.2)),
    drive((3, 2), (1, 1.8), (1, 1), (2.8, 1.2)),
)
TWINS = corridor_with_rooms(12, [(3, 0.45, 1.2, 5.2, 3.0), (7.6, 0.45, 5.8, 9.8, 3.0)])
DOORS = corridor_with_rooms(20, [(x, 0.45, 0.15) for x in np.arange(1.5, 19, 2.0)])


def two(outline, first, second, seed, sigma):
    """Two submaps, the true earlier_from_newest, and the mean and covariance of a prior drawn around it."""
    rng = np.random.default_rng(seed)
    earlier, newest = (submap(outline, path, path[-1], rng) for path in (first, second))
    true = relative(first[0], second[0])
    spread = np.array([sigma, sigma, min(0.2 * sigma, np.radians(20))])
    return earlier, newest, true, true + rng.normal(size=3) * spread, np.diag(spread**2)


def off_by(found, true):
    """Error of a relative pose in its determined directions, and the squared Mahalanobis distance."""
    error = found.basis.T @ subtract_poses(found.earlier_from_newest, true)
    return error, float(error @ (found.basis.T @ found.information @ found.basis) @ error)


@pytest.mark.slow
def test_closures_in_a_room_are_correct_and_consistent():
    surprise, rank = [], 0
    for seed in range(9):
        earlier, newest, true, prior, cov = two(NICHE, FIRST, SECOND, seed, (0.1, 0.3, 0.7)[seed % 3])
        found = detect_closure(newest, earlier, prior, cov)
        if found is not None:
            error, chi2 = off_by(found, true)
            assert np.abs(error).max() < 0.1
            surprise.append(chi2)
            rank += len(error)
            assert chi2 < 16 * len(error)
    assert len(surprise) >= 7
    assert 0.5 < sum(surprise) / rank < 1.8


def test_after_little_drift_a_closure_needs_no_confirmation():
    sure = 0
    for seed in range(5):
        earlier, newest, _, prior, cov = two(NICHE, FIRST, SECOND, seed, 0.1)
        found = detect_closure(newest, earlier, prior, cov)
        sure += found is not None and found.log_odds > SETTINGS.acceptance_log_odds
    assert sure >= 4


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.3, 1.0, 2.0])
def test_a_similar_room_is_not_accepted(sigma):
    first = drive((3, 2.2), (3, 3), (1.9, 3.2), (2.2, 4.2), (4, 4))
    for seed in range(3):
        earlier, newest, _, prior, cov = two(TWINS, first, first + np.array([4.6, 0, 0]), seed, sigma)
        found = detect_closure(newest, earlier, prior, cov)
        assert found is None or found.log_odds < SETTINGS.acceptance_log_odds - 2


def test_a_similar_room_is_not_accepted_where_drift_moves_it_onto_the_known_one():
    first = drive((3, 2.2), (3, 3), (1.9, 3.2), (2.2, 4.2), (4, 4))
    for seed in range(4):
        earlier, newest, _, _, cov = two(TWINS, first, first + np.array([4.6, 0, 0]), seed, 2.0)
        found = detect_closure(newest, earlier, np.zeros(3), cov)
        assert found is None or found.log_odds < SETTINGS.acceptance_log_odds - 2


def test_a_rectangle_is_not_rotated_by_half_a_turn():
    outline, half = rectangle(4.0, 3.2), np.array([4.0, 3.2, np.pi])
    there = compose(half, SECOND)  # the same trajectory, rotated by half a turn about the center of the room
    for seed in range(3):
        earlier, newest, true, prior, cov = two(outline, FIRST, SECOND, seed, 0.3)
        found = detect_closure(newest, earlier, prior, cov)
        if found is not None:
            assert np.abs(off_by(found, true)[0]).max() < 0.1
        # If every heading is possible, the pose is ambiguous.
        found = detect_closure(newest, earlier, compose(true, np.array([0.0, 0.0, 1.5])), np.diag([1.0, 1.0, 9.0]))
        assert found is None or found.log_odds < SETTINGS.acceptance_log_odds
        earlier, newest, true, prior, cov = two(outline, FIRST, there, seed, 0.3)
        found = detect_closure(newest, earlier, prior, cov)
        assert found is None or np.abs(off_by(found, true)[0]).max() < 0.1


def test_repeating_doors_are_not_accepted_wrongly():
    for seed in range(4):
        shift = 2.0 * (seed % 3 - 1)
        second = drive((9.2 + shift, 0.8), (5.9 + shift, 0.8))
        earlier, newest, _, prior, cov = two(DOORS, drive((5.0, 0.9), (8.5, 0.9)), second, seed, 0.8)
        found = detect_closure(newest, earlier, prior, cov)
        assert (
            found is None or found.undetermined_direction is not None or found.log_odds < SETTINGS.acceptance_log_odds
        )


def test_parallel_walls_leave_the_direction_along_them_undetermined():
    outline = corridor_with_rooms(20, [])
    for seed in range(4):
        first, second = drive((6.0, 0.9), (9.0, 0.9)), drive((9.4, 0.8), (6.9, 0.8))
        earlier, newest, true, prior, cov = two(outline, first, second, seed, 0.15)
        found = detect_closure(newest, earlier, prior, cov)
        if found is None:
            continue
        assert found.undetermined_direction is not None
        assert abs(found.undetermined_direction @ np.array([1.0, 0.0])) > 0.99
        free = np.append(found.undetermined_direction, 0.0)
        assert np.abs(found.information @ free).max() < 1e-6 * np.abs(found.information).max()
        assert np.linalg.matrix_rank(found.information, tol=1.0) == 2
        assert off_by(found, true)[1] < 32
        # In a pose graph it does not change the variance along the corridor.
        chain = [BetweenFactor(0, 1, prior, np.linalg.inv(cov))]
        graph = solve_pose_graph(
            np.stack([np.zeros(3), prior]), [*chain, BetweenFactor(0, 1, found.earlier_from_newest, found.information)]
        )
        after = graph.marginal_covariances(np.array([1]))[0]
        assert free @ after @ free > 0.9 * (free @ cov @ free)


def test_pair_residuals_and_their_derivatives(rng):
    earlier, newest, true, _, _ = two(NICHE, FIRST, SECOND, 3, 0.1)
    pairs = nearest_pairs(earlier, newest, true, np.diag([1e-4, 1e-4, 1e-5]))
    assert len(pairs) > 5
    pose = true + np.array([0.05, -0.03, 0.02])
    seen = pair_residuals(earlier, newest, pairs.earlier, pairs.newest, pose)
    # Independent computation: transform a point on each reflector.
    for k, (a, b) in enumerate(zip(*pairs, strict=True)):
        if earlier.landmarks.kind[a] != kernels.PLANE:
            place = compose(pose, np.append(newest.landmarks.anchor[b] + newest.landmarks.parameters[b], 0.0))[:2]
            np.testing.assert_allclose(
                seen.residual[k], place - earlier.landmarks.anchor[a] - earlier.landmarks.parameters[a]
            )
            continue
        level, theta = newest.landmarks.parameters[b]
        foot = newest.landmarks.anchor[b] + level * np.array([np.cos(theta), np.sin(theta)])
        moved = compose(pose, np.append(foot, theta))
        normal = np.array([np.cos(moved[2]), np.sin(moved[2])])
        expected = [normal @ (moved[:2] - earlier.landmarks.anchor[a]) - earlier.landmarks.parameters[a, 0]]
        expected.append(float(wrap_angle(float(moved[2] - earlier.landmarks.parameters[a, 1]))))
        np.testing.assert_allclose(seen.residual[k], expected, atol=1e-12)
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-6
        sides = [pair_residuals(earlier, newest, *pairs, pose + sign * step).residual for sign in (1, -1)]
        np.testing.assert_allclose((sides[0] - sides[1]) / 2e-6, seen.d_residual_d_pose[..., k], atol=1e-6)
    for k in range(2):
        step = np.zeros(2)
        step[k] = 1e-6
        sides = [
            pair_residuals(
                earlier,
                replace(newest, landmarks=newest.landmarks.with_parameters(newest.landmarks.parameters + sign * step)),
                *pairs,
                pose,
            ).residual
            for sign in (1, -1)
        ]
        np.testing.assert_allclose((sides[0] - sides[1]) / 2e-6, seen.d_residual_d_newest[..., k], atol=1e-6)


def test_the_fit_is_the_least_squares_solution():
    earlier, newest, true, _, _ = two(NICHE, FIRST, SECOND, 1, 0.1)
    pairs = nearest_pairs(earlier, newest, true, np.diag([1e-4, 1e-4, 1e-5]))
    fit = fit_pose(earlier, newest, pairs, true)
    for step in 1e-3 * np.concatenate([np.eye(3), -np.eye(3)]):
        # Around the minimum chi2 is a quadratic form with the information matrix; here it is computed directly.
        seen = pair_residuals(earlier, newest, *pairs, fit.pose + step)
        rows = (3 + 2 * pairs.earlier[:, None] + np.arange(2)).ravel()
        others = (3 + 2 * pairs.newest[:, None] + np.arange(2)).ravel()
        design = np.zeros((len(rows), len(others)))
        for k, block in enumerate(pair_residuals(earlier, newest, *pairs, fit.pose).d_residual_d_newest):
            design[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = block
        cov = earlier.covariance[np.ix_(rows, rows)] + design @ newest.covariance[np.ix_(others, others)] @ design.T
        off = seen.residual.ravel()
        expected = fit.chi2 + step @ fit.information @ step
        assert off @ np.linalg.solve(cov, off) == pytest.approx(expected, abs=0.02 * expected)


def test_sequential_factors_are_more_accurate_and_consistent():
    total, joint, before, better, count = 0.0, 0.0, 0.0, 0, 20
    for seed in range(count):
        rng = np.random.default_rng(seed)
        made, true = submaps(NICHE, drive((1, 1), (3, 1), (3, 2.2), (1.2, 2.2), (1, 1)), rng, scans=25, slip=3.0)
        link, expected = sequential_factor(made[0], made[1], 4), relative(true[0], true[1])
        assert (link.first, link.second) == (4, 5)
        off = link.first_from_second - expected
        off[2] = wrap_angle(off[2])
        total += off @ link.information @ off
        joint += float(np.abs(off[:2]).sum())
        before += float(np.abs((made[0].exit_pose - expected)[:2]).sum())
        better += np.linalg.det(link.information) > 2 * np.linalg.det(np.linalg.inv(made[0].covariance[:3, :3]))
    assert better >= 0.8 * count  # unchanged where doors or corners repeat within the uncertainty of the exit pose
    assert joint < 0.7 * before
    assert 0.5 < total / (3 * count) < 1.7


def test_without_shared_walls_the_sequential_factor_is_the_odometry_factor():
    rng = np.random.default_rng(0)
    here, there = (
        submap(NICHE, FIRST, FIRST[-1], rng),
        submap(rectangle(9, 9), drive((1.5, 4), (1.5, 6)), FIRST[-1], rng),
    )
    empty = replace(
        there,
        landmarks=there.landmarks.take(np.arange(0)),
        scan_counts=there.scan_counts[:0],
        covariance=there.covariance[:3, :3],
    )
    link = sequential_factor(here, empty)
    np.testing.assert_array_equal(link.first_from_second, here.exit_pose)
    assert detect_closure(empty, here, np.zeros(3), np.eye(3)) is None
    assert len(nearest_pairs(here, empty, np.zeros(3), np.eye(3))) == 0


def run_graph(outline, path, seed, **errors):
    """The graph at the end of a trajectory, and the true poses of the submaps relative to the first."""
    made, true = submaps(outline, path, np.random.default_rng(seed), **errors)
    graph = SubmapGraph()
    for one in made:
        graph.add(one)
        graph.process_all()
    return graph, relative(np.broadcast_to(true[0], true.shape), true)


@pytest.mark.slow
@pytest.mark.parametrize("slip", [1.0, 4.0])
def test_closures_around_a_block_are_correct(slip):
    doors = [(0, 1.7, 0.5, 0.2), (0, 3.9, 0.4, 0.2), (1, 3.0, 0.5, 0.2), (2, 2.1, 0.5, 0.2), (3, 4.0, 0.5, 0.2)]
    corners = [(-0.9, -0.9), (7.9, -0.9), (7.9, 5.9), (-0.9, 5.9)]
    path = drive(*corners, *corners[:3])
    graph, true = run_graph(ring_corridor(7, 5, doors), path, 2, slip=slip, missed=0.1, spurious=0.5)
    assert len(graph.verifier.accepted) >= 3
    for one in graph.verifier.accepted:
        error, chi2 = off_by(one.measurement, relative(true[one.earlier], true[one.newest]))
        assert np.abs(error).max() < 0.15
        assert chi2 < 16 * len(error)
    off = graph.poses - true
    assert np.linalg.norm(off[:, :2], axis=1).max() < 0.4
    assert graph.covariances().shape == (len(true), 3, 3)


@pytest.mark.slow
def test_pending_work_in_pieces_gives_the_same_graph():
    corners = [(-0.9, -0.9), (7.9, -0.9), (7.9, 5.9), (-0.9, 5.9)]
    made, _ = submaps(
        ring_corridor(7, 5, [(0, 1.7, 0.5, 0.2)]), drive(*corners, *corners[:2]), np.random.default_rng(3)
    )
    at_once, slowly = SubmapGraph(), SubmapGraph()
    for one in made:
        at_once.add(one)
        decisions = at_once.process_all()
        slowly.add(one)
        before, said = slowly, []
        while slowly.has_pending_work:
            before, slowly = slowly, slowly.copy()
            said += slowly.process_next()
            assert before.has_pending_work  # the copy is independent
        assert [vars(one) for one in said] == [vars(one) for one in decisions]
    assert at_once.verifier.accepted
    np.testing.assert_array_equal(at_once.poses, slowly.poses)
    # Pending work is done before the next submap is added.
    late = SubmapGraph()
    for one in made:
        late.add(one)
    late.process_all()
    np.testing.assert_array_equal(at_once.poses, late.poses)


def test_a_wrong_closure_is_withdrawn_and_leaves_no_trace():
    corners = [(-0.9, -0.9), (7.9, -0.9), (7.9, 5.9), (-0.9, 5.9)]
    doors = [(0, 1.7, 0.5, 0.2), (0, 3.9, 0.4, 0.2), (1, 3.0, 0.5, 0.2)]
    graph, _ = run_graph(ring_corridor(7, 5, doors), drive(*corners, *corners[:2]), 1)
    known = graph.verifier
    good, before = known.accepted[0], graph.graph
    wrong = good.measurement._replace(
        earlier_from_newest=good.measurement.earlier_from_newest + np.array([1.0, 0.0, 0.0])
    )
    # It could have been accepted early, with a wide prior.
    known.candidates.append(ClosureCandidate(good.earlier, good.newest, wrong, good.position, ACCEPTED))
    after = known.solve(before.poses, graph.chain, len(graph.submaps) - 1)
    np.testing.assert_allclose(after.poses, before.poses, atol=1e-5)
    np.testing.assert_allclose(
        after.marginal_covariances(np.arange(5)), before.marginal_covariances(np.arange(5)), atol=1e-8
    )
    assert [one.state for one in known.decisions][-1] == "withdrawn"


def test_a_closure_that_contradicts_the_chain_is_refused():
    earlier, newest, true, _, cov = two(NICHE, FIRST, SECOND, 0, 0.1)
    found = detect_closure(newest, earlier, true, cov)
    assert found is not None
    graph = solve_pose_graph(np.stack([np.zeros(3), true]), [BetweenFactor(0, 1, true, np.linalg.inv(cov))])
    for shift, state in ((0.0, ACCEPTED), (2.0, "refused")):
        known = ClosureVerifier()
        moved = found._replace(earlier_from_newest=found.earlier_from_newest + np.array([shift, 0.0, 0.0]))
        assert known.add(graph, ClosureCandidate(0, 1, moved, np.zeros(2))) == (state == ACCEPTED)
        assert known.decisions[-1].state == state
        assert len(known.factors) == (state == ACCEPTED)


def test_overlap_candidates_are_few_and_near():
    made, true = submaps(corridor_with_rooms(30, []), drive((1, 0.9), (29, 0.9), (1, 0.8)), np.random.default_rng(0))
    links = [BetweenFactor(k, k + 1, relative(a, b), 1e4 * np.eye(3)) for k, (a, b) in enumerate(pairwise(true))]
    graph, newest = solve_pose_graph(true, links), len(made) - 1
    chosen = overlap_candidates(graph, made, newest, max_compared=3)
    assert 1 <= len(chosen) <= 3
    assert chosen.max() < newest - 1
    assert np.linalg.norm(true[chosen, :2] - true[newest, :2], axis=1).max() < 8.0
    assert len(overlap_candidates(graph, made, 1)) == 0


def test_take_selects_pairs():
    pairs = Pairs(np.array([3, 1, 2]), np.array([0, 4, 5])).take(np.array([0, 2]))
    assert pairs.earlier.tolist() == [3, 2]
    assert pairs.newest.tolist() == [0, 5]
