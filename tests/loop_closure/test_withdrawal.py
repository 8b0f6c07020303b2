"""Withdrawal of a wrong closure restores the pose graph."""

import numpy as np
import pytest
from support.submap_pairs import run_graph
from support.submaps import drive, ring_corridor

from jaxsonar.loop_closure.closure_candidate import ACCEPTED, ClosureCandidate


@pytest.mark.slow
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
