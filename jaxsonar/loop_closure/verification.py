"""Which closures count: proposed first, then accepted or refused, and withdrawn where later ones speak against them."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.special import chdtri

from jaxsonar.estimation.pose_graph import Graph, Link, relative_jacobians, solve
from jaxsonar.geometry.se2 import to_world, wrap_angle
from jaxsonar.loop_closure.closure import COPY, HONEST, Closure
from jaxsonar.loop_closure.perceptual_aliasing import log_sum

UNLIKELY, INTOLERABLE = 1e-3, 1e-5
"""Probability of the chi2 at which closures are not proposed to the graph, and at which they are withdrawn from it."""
SURE, CONFIRMED = 6.9, 5.3
"""Nats by which a closure must beat all doubts by itself, and with others that confirm it."""
TELLING = 0.15
"""Metres to which a closure must predict another one that confirms it."""
SAME_PLACE = 3.0
"""Closures whose reflectors are nearer than this, metres, are of one place: what repeats once, repeats in both."""

REMEMBERED = 16
"""So many that are proposed only are looked at again when others come."""

PROPOSED, ACCEPTED, REFUSED, WITHDRAWN = "proposed", "accepted", "refused", "withdrawn"


@dataclass(frozen=True, eq=False)
class Proposal:
    """A closure between two nodes of the graph, and what became of it."""

    earlier: int
    newest: int
    closure: Closure
    place: Float[np.ndarray, "2"]
    """Middle of the reflectors that are shared, frame of the earlier node."""
    state: str = PROPOSED

    @property
    def link(self) -> Link:
        """As it stands in the graph."""
        return Link(self.earlier, self.newest, self.closure.relative, self.closure.information)


@dataclass(frozen=True)
class Decision:
    """What became of a closure, for reports."""

    submap: int
    """The newest submap at that time."""
    state: str
    earlier: int
    newest: int
    odds: float
    """Nats by which it beat all doubts, with what confirmed it."""
    chi2: float
    """Under the graph at that time."""


class Closures:
    """All that were ever proposed, and the decisions about them."""

    def __init__(self) -> None:
        self.proposals: list[Proposal] = []
        self.decisions: list[Decision] = []

    def copy(self) -> "Closures":
        """One that can go on, while this one stays as it is."""
        twin = Closures()
        twin.proposals = list(self.proposals)
        twin.decisions = list(self.decisions)
        return twin

    @property
    def accepted(self) -> list[Proposal]:
        """Those that count."""
        return [one for one in self.proposals if one.state == ACCEPTED]

    @property
    def links(self) -> list[Link]:
        """Of those that count."""
        return [one.link for one in self.accepted]

    def consider(self, graph: Graph, proposal: Proposal) -> bool:
        """Take up a proposal; whether any closure counts now that did not before."""
        submap, number = proposal.newest, len(self.proposals)
        self.proposals.append(proposal)
        chi2 = _surprise(graph, proposal)
        refused = chi2 > _bound([proposal], UNLIKELY)
        self._decide(submap, number, REFUSED if refused else PROPOSED, proposal.closure.odds, chi2)
        if refused:
            return False
        before = len(self.accepted)
        self._verified(graph, submap, number, chi2)
        # What it confirms, or is confirmed by, may count as well.
        for other in self._open:
            if other != number:
                self._verified(graph, submap, other, _surprise(graph, self.proposals[other]))
        return len(self.accepted) > before

    @property
    def _open(self) -> list[int]:
        """The last few that are proposed only."""
        return [number for number, one in enumerate(self.proposals) if one.state == PROPOSED][-REMEMBERED:]

    def _verified(self, graph: Graph, submap: int, number: int, chi2: float) -> bool:
        proposal = self.proposals[number]
        odds = proposal.closure.odds
        if odds < SURE:
            # What is in the graph has narrowed the prior already.
            known = {id(link.information) for link in graph.links}
            open_ones = [self.proposals[other] for other in self._open]
            others = [one for one in self.accepted if id(one.closure.information) not in known]
            odds = confirmed(graph, proposal, open_ones + others)
        counts = odds >= (SURE if odds == proposal.closure.odds else CONFIRMED)
        if counts:
            self._decide(submap, number, ACCEPTED, odds, chi2)
        return counts

    def settled(self, poses: Float[np.ndarray, "nodes 3"], chain: list[Link], submap: int) -> Graph:
        """The graph of the chain and all closures that count, less those that it cannot bear: these are withdrawn.

        Of those that are far off, the one goes without which the rest agrees best.
        """
        graph = solve(poses, chain + self.links)
        while True:
            numbers = [number for number, one in enumerate(self.proposals) if one.state == ACCEPTED]
            accepted = [self.proposals[number] for number in numbers]
            chi2 = graph.chi2[len(chain) :]
            far = [k for k, one in enumerate(accepted) if chi2[k] > _bound([one], INTOLERABLE)]
            if not far:
                return graph
            best = None
            for k in np.argsort(-chi2, kind="stable")[:4]:
                without = solve(graph.poses, chain + [one.link for one in accepted if one is not accepted[k]])
                if best is None or without.chi2.sum() < best[1].chi2.sum():
                    best = int(k), without
            assert best is not None
            self._decide(submap, numbers[best[0]], WITHDRAWN, accepted[best[0]].closure.odds, float(chi2[best[0]]))
            graph = best[1]

    def _decide(self, submap: int, number: int, state: str, odds: float, chi2: float) -> None:
        one = self.proposals[number] = replace(self.proposals[number], state=state)
        self.decisions.append(Decision(submap, state, one.earlier, one.newest, float(odds), float(chi2)))


def confirmed(graph: Graph, proposal: Proposal, others: list[Proposal]) -> float:
    """Nats by which a closure beats all doubts, together with others that agree with it around their loop.

    A doubt stands only where all of them would stand as well, each as far from its place; a building that repeats must
    do so once more for each other place.
    """
    closure, doubts = proposal.closure, proposal.closure.doubts
    turned_world = graph.poses[proposal.earlier, 2]
    world = _turned(doubts.offset, turned_world)
    nats, mine = doubts.nats.copy(), closure.field.at(doubts.offset)
    places = [to_world(graph.poses[proposal.earlier], proposal.place)]
    cost, sides = 0.0, 0
    for other in others:
        along_walls = other.closure.free is not None
        if other is proposal or (along_walls and closure.free is not None) or not _agree(graph, proposal, other):
            continue
        theirs = other.closure.field.at(_turned(world, -graph.poses[other.earlier, 2]))
        if along_walls:
            # The walls of one corridor are one piece of news: only what they know better than this closure counts.
            nats -= np.maximum(theirs - mine, 0.0)
            sides += 1
            continue
        nats -= theirs
        cost += max(float(other.closure.field.at(np.zeros((1, 2)))[0]), 0.0)
        place = to_world(graph.poses[other.earlier], other.place)
        if min(np.linalg.norm(place - one) for one in places) > SAME_PLACE:
            nats[doubts.unseen] += np.log(COPY)
            places.append(place)
    if len(places) == 1 and not sides:
        return closure.odds
    return closure.weight - min(cost, 2.0) - log_sum(nats)


def _turned(offset: Float[np.ndarray, "places 2"], angle: float) -> Float[np.ndarray, "places 2"]:
    c, s = np.cos(angle), np.sin(angle)
    return offset @ np.array([[c, s], [-s, c]])


def _agree(graph: Graph, first: Proposal, second: Proposal) -> bool:
    """Whether two closures fit together around the loop that they make, and both to the graph.

    This says something only where the first one tells well what the second one must be.
    """
    off, cov = _innovation(graph, [first, second])
    split = first.closure.basis.shape[1]
    own, mixed, alone = cov[:split, :split], cov[split:, :split], off[:split]
    rest = cov[split:, split:] - mixed @ np.linalg.solve(own, mixed.T)
    places = second.closure.basis.shape[1] - 1
    if np.linalg.eigvalsh(rest[:places, :places])[-1] > TELLING**2:
        return False
    both = float(off @ np.linalg.solve(cov, off))
    last = both - float(alone @ np.linalg.solve(own, alone))
    return both <= _bound([first, second], UNLIKELY) and last <= _bound([second], UNLIKELY)


def _surprise(graph: Graph, proposal: Proposal) -> float:
    """Chi2 of a closure under the covariance of a graph that it is no part of."""
    off, cov = _innovation(graph, [proposal])
    return float(off @ np.linalg.solve(cov, off))


def _innovation(
    graph: Graph, proposals: list[Proposal]
) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows rows"]]:
    """By how much the graph misses closures, in the directions that these determine, and the covariance of that."""
    joint = graph.joint(np.array([node for one in proposals for node in (one.earlier, one.newest)]))
    residual, design, noise = [], [], []
    for one in proposals:
        seen, by_first, by_second = relative_jacobians(graph.poses[one.earlier], graph.poses[one.newest])
        basis = one.closure.basis
        off = seen - one.closure.relative
        residual.append(basis.T @ np.append(off[:2], wrap_angle(float(off[2]))))
        design.append(basis.T @ np.concatenate([by_first, by_second], axis=1))
        noise.append(basis.T @ np.linalg.pinv(one.closure.information, hermitian=True) @ basis)
    whole = block_diag(*design)
    return np.concatenate(residual), HONEST**2 * whole @ joint @ whole.T + block_diag(*noise)


def _bound(proposals: list[Proposal], probability: float) -> float:
    """Chi2 that closures exceed with this probability."""
    return float(chdtri(sum(one.closure.basis.shape[1] for one in proposals), probability))
