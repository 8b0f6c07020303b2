"""Verification of loop closures: candidates are proposed, then accepted or refused, and may be withdrawn later.

``mutual_confirmation`` combines the evidence of several candidates, ``withdrawal`` removes accepted closures again.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jaxsonar.estimation.pose_graph import BetweenFactor, PoseGraph
from jaxsonar.loop_closure.closure_candidate import (
    ACCEPTED,
    PROPOSED,
    REFUSED,
    WITHDRAWN,
    ClosureCandidate,
    candidates_chi2_bound,
    innovation_chi2,
)
from jaxsonar.loop_closure.mutual_confirmation import confirmed_log_odds
from jaxsonar.loop_closure.settings import SETTINGS
from jaxsonar.loop_closure.withdrawal import solve_and_withdraw


@dataclass(frozen=True)
class ClosureDecision:
    """A decision about a candidate, for reports."""

    submap: int
    """The newest submap at the time of the decision."""
    state: str
    """"proposed", "accepted", "refused" or "withdrawn"."""
    earlier: int
    newest: int
    log_odds: float
    """Against all alternatives, with the closures that confirm it, nats."""
    chi2: float
    """Under the graph at that time."""


class ClosureVerifier:
    """All candidates so far, and the decisions about them."""

    def __init__(self) -> None:
        self.candidates: list[ClosureCandidate] = []
        self.decisions: list[ClosureDecision] = []

    def copy(self) -> "ClosureVerifier":
        """An independent copy; candidates are immutable and shared."""
        twin = ClosureVerifier()
        twin.candidates = list(self.candidates)
        twin.decisions = list(self.decisions)
        return twin

    @property
    def accepted(self) -> list[ClosureCandidate]:
        """The accepted closures."""
        return [one for one in self.candidates if one.state == ACCEPTED]

    @property
    def factors(self) -> list[BetweenFactor]:
        """The accepted closures as constraints of the pose graph."""
        return [one.factor for one in self.accepted]

    def add(self, graph: PoseGraph, candidate: ClosureCandidate) -> bool:
        """Add a candidate; whether any closure is accepted now that was not before."""
        submap, number = candidate.newest, len(self.candidates)
        self.candidates.append(candidate)
        # 1. Refuse what the graph contradicts.
        chi2 = innovation_chi2(graph, candidate)
        refused = chi2 > candidates_chi2_bound([candidate], SETTINGS.refusal_probability)
        state = REFUSED if refused else PROPOSED
        self._decide(submap, number, state, candidate.measurement.log_odds, chi2)
        if refused:
            return False
        # 2. Accept it if its odds suffice; it may confirm other candidates, too.
        before = len(self.accepted)
        self._accept_if_sure(graph, submap, number, chi2)
        for other in self._undecided:
            if other != number:
                self._accept_if_sure(graph, submap, other, innovation_chi2(graph, self.candidates[other]))
        return len(self.accepted) > before

    @property
    def _undecided(self) -> list[int]:
        """The latest undecided candidates."""
        return [number for number, one in enumerate(self.candidates) if one.state == PROPOSED][
            -SETTINGS.max_undecided :
        ]

    def _accept_if_sure(self, graph: PoseGraph, submap: int, number: int, chi2: float) -> None:
        candidate = self.candidates[number]
        log_odds, least = candidate.measurement.log_odds, SETTINGS.acceptance_log_odds
        if log_odds < least:
            # Closures that are in the graph have narrowed the prior already; they do not count again.
            used = {id(factor.information) for factor in graph.factors}
            others = [self.candidates[other] for other in self._undecided]
            others += [one for one in self.accepted if id(one.measurement.information) not in used]
            together = confirmed_log_odds(graph, candidate, others)
            least = least if together == log_odds else SETTINGS.confirmed_log_odds
            log_odds = together
        if log_odds >= least:
            self._decide(submap, number, ACCEPTED, log_odds, chi2)

    def solve(self, poses: Float[np.ndarray, "nodes 3"], chain: list[BetweenFactor], submap: int) -> PoseGraph:
        """The pose graph with all accepted closures; those that contradict it are withdrawn.

        Args:
            poses: world_from_node, start values.
            chain: constraints between consecutive submaps.
            submap: the newest submap, for the decisions.
        """
        graph, withdrawn = solve_and_withdraw(poses, chain, self.accepted)
        for candidate, chi2 in withdrawn:
            number = next(k for k, one in enumerate(self.candidates) if one is candidate)
            self._decide(submap, number, WITHDRAWN, candidate.measurement.log_odds, chi2)
        return graph

    def _decide(self, submap: int, number: int, state: str, log_odds: float, chi2: float) -> None:
        one = self.candidates[number] = replace(self.candidates[number], state=state)
        self.decisions.append(ClosureDecision(submap, state, one.earlier, one.newest, float(log_odds), float(chi2)))
