"""Withdrawal of accepted closures that contradict the pose graph."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsonar.estimation.pose_graph import BetweenFactor, PoseGraph, solve_pose_graph
from jaxsonar.loop_closure.closure_candidate import ClosureCandidate, candidates_chi2_bound
from jaxsonar.loop_closure.settings import SETTINGS


class Withdrawal(NamedTuple):
    """One withdrawn closure."""

    candidate: ClosureCandidate
    chi2: float
    """In the graph before its removal."""


def solve_and_withdraw(
    poses: Float[np.ndarray, "nodes 3"], chain: Sequence[BetweenFactor], accepted: Sequence[ClosureCandidate]
) -> tuple[PoseGraph, list[Withdrawal]]:
    """Solve the pose graph, and remove closures until none is improbable.

    A closure is improbable if its chi-square exceeds the bound of ``withdrawal_probability``. Of the closures with the
    largest chi-square, the one is removed without which the sum over all constraints is smallest: a wrong closure often
    makes a correct one look worse than itself.

    Args:
        poses: world_from_node, start values.
        chain: constraints between consecutive submaps.
        accepted: the accepted closures.

    Returns:
        The graph with the remaining closures, and the withdrawn ones in the order of their removal.
    """
    chain, remaining, withdrawn = list(chain), list(accepted), []
    graph = solve_pose_graph(poses, chain + [one.factor for one in remaining])
    while True:
        chi2 = graph.chi2[len(chain) :]
        bounds = [candidates_chi2_bound([one], SETTINGS.withdrawal_probability) for one in remaining]
        if not (chi2 > np.array(bounds)).any():
            return graph, withdrawn
        trials = np.argsort(-chi2, kind="stable")[: SETTINGS.max_withdrawal_trials]
        reduced = [chain + [one.factor for one in remaining if one is not remaining[k]] for k in trials]
        graphs = [solve_pose_graph(graph.poses, factors) for factors in reduced]
        best = int(np.argmin([one.chi2.sum() for one in graphs]))
        withdrawn.append(Withdrawal(remaining.pop(trials[best]), float(chi2[trials[best]])))
        graph = graphs[best]
