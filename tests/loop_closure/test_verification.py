"""Verification of closures: a closure that contradicts the pose graph is refused."""

import numpy as np
from support.submap_pairs import FIRST, NICHE, SECOND, two

from jaxsonar.estimation.pose_graph import BetweenFactor, solve_pose_graph
from jaxsonar.loop_closure.closure_candidate import ACCEPTED, ClosureCandidate
from jaxsonar.loop_closure.closure_detection import detect_closure
from jaxsonar.loop_closure.verification import ClosureVerifier


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
