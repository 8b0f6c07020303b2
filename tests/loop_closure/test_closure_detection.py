"""Detected closures between submaps: correct where the pose is unique, not accepted where it is ambiguous."""

import numpy as np
import pytest
from support.submap_pairs import FIRST, NICHE, SECOND, off_by, two
from support.submaps import corridor_with_rooms, drive, rectangle

from jaxsonar.estimation.pose_graph import BetweenFactor, solve_pose_graph
from jaxsonar.geometry.se2 import compose
from jaxsonar.loop_closure.closure_detection import detect_closure
from jaxsonar.loop_closure.settings import SETTINGS

TWINS = corridor_with_rooms(12, [(3, 0.45, 1.2, 5.2, 3.0), (7.6, 0.45, 5.8, 9.8, 3.0)])
DOORS = corridor_with_rooms(20, [(x, 0.45, 0.15) for x in np.arange(1.5, 19, 2.0)])


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_similar_room_is_not_accepted_where_drift_moves_it_onto_the_known_one():
    first = drive((3, 2.2), (3, 3), (1.9, 3.2), (2.2, 4.2), (4, 4))
    for seed in range(4):
        earlier, newest, _, _, cov = two(TWINS, first, first + np.array([4.6, 0, 0]), seed, 2.0)
        found = detect_closure(newest, earlier, np.zeros(3), cov)
        assert found is None or found.log_odds < SETTINGS.acceptance_log_odds - 2


@pytest.mark.slow
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


@pytest.mark.slow
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
