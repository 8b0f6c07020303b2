"""The graph of submaps: correct closures of a drive around a block, work in pieces, candidates for overlap."""

from itertools import pairwise

import numpy as np
import pytest
from support.submap_pairs import off_by, run_graph
from support.submaps import corridor_with_rooms, drive, ring_corridor, submaps

from jaxsonar.estimation.pose_graph import BetweenFactor, solve_pose_graph
from jaxsonar.geometry.se2 import relative
from jaxsonar.loop_closure.submap_graph import SubmapGraph, overlap_candidates


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


def test_overlap_candidates_are_few_and_near():
    made, true = submaps(corridor_with_rooms(30, []), drive((1, 0.9), (29, 0.9), (1, 0.8)), np.random.default_rng(0))
    links = [BetweenFactor(k, k + 1, relative(a, b), 1e4 * np.eye(3)) for k, (a, b) in enumerate(pairwise(true))]
    graph, newest = solve_pose_graph(true, links), len(made) - 1
    chosen = overlap_candidates(graph, made, newest, max_compared=3)
    assert 1 <= len(chosen) <= 3
    assert chosen.max() < newest - 1
    assert np.linalg.norm(true[chosen, :2] - true[newest, :2], axis=1).max() < 8.0
    assert len(overlap_candidates(graph, made, 1)) == 0
