"""Submaps into one map: the chain of them, closures where the robot comes back, and where every submap lies.

``SubmapGraph`` is all that a front end needs: ``add`` takes a finished submap, ``work`` does what follows from it piece
by piece, so that a robot can do one with each scan, and ``poses`` says where all are.
"""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.estimation.pose_graph import Graph, Link, solve
from jaxsonar.geometry.se2 import composed, relative
from jaxsonar.loop_closure.closure import REACH, closure
from jaxsonar.loop_closure.negative_evidence import Surroundings, Vicinity, surroundings
from jaxsonar.loop_closure.sequential_constraint import joined
from jaxsonar.loop_closure.submap import Submap
from jaxsonar.loop_closure.verification import Closures, Decision, Proposal

MOST, LOOKED_AT = 4, 12
"""Earlier submaps that are compared with a new one, and those among which they are chosen."""
RECENT = 5
"""Submaps not older than this take at most half of these places."""
TIED = 2
"""So many closures of a submap that count are enough."""
BESIDE = 2
"""So many submaps before and after one are asked what speaks against its place."""
BEYOND = 3.0
"""Submaps may overlap if they do within so many standard deviations."""


class SubmapGraph:
    """Where submaps lie. The first one's frame is the world; the last node is the frame of the submap still to come.

    Args:
        reach: walls as near as this to the robot are heard, metres.
        most: earlier submaps that are compared with each new one.
    """

    def __init__(self, *, reach: float = REACH, most: int = MOST):
        self.reach, self.most = reach, most
        self.submaps: list[Submap] = []
        self.surroundings: list[Surroundings] = []
        self.chain: list[Link] = []
        self.closures = Closures()
        self.graph = Graph(np.zeros((1, 3)), (), converged=True)
        self._todo: tuple[Callable[[SubmapGraph], None], ...] = ()

    @property
    def poses(self) -> Float[np.ndarray, "nodes 3"]:
        """world_from_submap, of the submap still to come as well."""
        return self.graph.poses

    def copy(self) -> "SubmapGraph":
        """One that can be added to, while this one stays as it is."""
        twin = SubmapGraph(reach=self.reach, most=self.most)
        twin.submaps, twin.chain, twin.graph = list(self.submaps), list(self.chain), self.graph
        twin.surroundings, twin._todo = list(self.surroundings), self._todo
        twin.closures = self.closures.copy()
        return twin

    @property
    def last_covariance(self) -> Float[np.ndarray, "3 3"]:
        """Of the pose of the submap still to come."""
        return self.graph.covariance(np.array([len(self.graph) - 1]))[0]

    def covariances(self) -> Float[np.ndarray, "nodes 3 3"]:
        """Of ``poses``."""
        return self.graph.covariance(np.arange(len(self.graph)))

    def add(self, submap: Submap) -> tuple[Decision, ...]:
        """Take a finished submap. Whatever was left to do for the one before is done first: its decisions."""
        decisions = self.settle()
        newest = len(self.submaps)
        self.submaps.append(submap)
        self.surroundings.append(surroundings(submap))
        self.chain.append(chain_link(submap, newest))
        # A new end of the chain pulls at nothing: all others stay where they are.
        poses = np.concatenate([self.poses, composed(self.poses[-1], submap.exit)[None]])
        self.graph = Graph(poses, self.chain + self.closures.links, converged=self.graph.converged)
        self._todo = (SubmapGraph._join, SubmapGraph._choose) if newest else ()
        return decisions

    @property
    def busy(self) -> bool:
        """Whether anything is left to do for the newest submap."""
        return bool(self._todo)

    def work(self) -> tuple[Decision, ...]:
        """Do the next piece of what is left for the newest submap; the decisions about closures that it came to.

        First the walls that it shares with the one before, then which earlier ones it may overlap, then these one by
        one, the likeliest first.
        """
        made = len(self.closures.decisions)
        if self._todo:
            task, *rest = self._todo
            self._todo = tuple(rest)
            task(self)
        return tuple(self.closures.decisions[made:])

    def settle(self) -> tuple[Decision, ...]:
        """Do all that is left."""
        made = len(self.closures.decisions)
        while self.busy:
            self.work()
        return tuple(self.closures.decisions[made:])

    def _join(self) -> None:
        """Put the walls that the newest submap shares with the one before into the chain."""
        newest = len(self.submaps) - 1
        self.chain[-2] = joined(self.submaps[-2], self.submaps[-1], newest - 1)
        self.graph = solve(self.poses, self.chain + self.closures.links)

    def _choose(self) -> None:
        """See which earlier submaps the newest one may overlap."""
        chosen = candidates(self.graph, self.submaps, len(self.submaps) - 1, most=self.most)
        self._todo = tuple(partial(SubmapGraph._compare, earlier=int(earlier)) for earlier in chosen)

    def _compare(self, earlier: int) -> None:
        """See whether the newest submap lies on an earlier one; what counts makes the next ones' prior narrower."""
        newest = len(self.submaps) - 1
        expected, covariance = self.graph.relative(earlier, np.array([newest]))
        middle = (earlier + newest) // 2  # what lies between the two is told of one of them
        around = self._vicinity(earlier, 0, middle), self._vicinity(newest, middle + 1, newest)
        known = self.submaps[earlier]
        found = closure(self.submaps[newest], known, expected[0], covariance[0], reach=self.reach, around=around)
        if found is None:
            return
        place = known.anchor[found.pairs.earlier].mean(axis=0)
        if self.closures.consider(self.graph, Proposal(earlier, newest, found, place)):
            self.graph = self.closures.settled(self.graph.poses, self.chain, newest)
            if sum(one.newest == newest for one in self.closures.accepted) >= TIED:
                self._todo = ()

    def _vicinity(self, number: int, first: int, last: int) -> Vicinity:
        """Of a submap, with some of those before and after it, from a first to a last one."""
        own = self.graph.poses[number]
        steps = [sign * step for step in range(1, BESIDE + 1) for sign in (1, -1)]
        others = [number + step for step in steps if first <= number + step <= last]
        return Vicinity(
            self.surroundings[number],
            tuple((relative(own, self.graph.poses[k]), self.surroundings[k]) for k in others),
        )


def chain_link(submap: Submap, number: int) -> Link:
    """From a submap to the next one, by the exit alone."""
    return Link(number, number + 1, submap.exit, np.linalg.inv(submap.covariance[:3, :3]))


def candidates(graph: Graph, submaps: Sequence[Submap], newest: int, *, most: int = MOST) -> Int[np.ndarray, " chosen"]:
    """Earlier submaps that may overlap the newest one, the likeliest first.

    The one just before is not among them: what it shares is in the chain (``joined``).

    Args:
        graph: where the submaps lie.
        submaps: all of them.
        newest: number of the newest.
        most: so many at most.
    """
    if newest < 2:
        return np.zeros(0, dtype=np.int64)
    middle, radius = (np.array(part) for part in zip(*(_extent(one) for one in submaps[: newest + 1]), strict=True))
    heading = graph.poses[: newest + 1, 2]
    c, s = np.cos(heading), np.sin(heading)
    x, y = middle.T
    at = graph.poses[: newest + 1, :2] + np.stack([c * x - s * y, s * x + c * y], axis=-1)
    apart = np.linalg.norm(at[:-2] - at[newest], axis=1)
    room = radius[:-2] + radius[newest]
    looked_at = np.argsort(apart - room, kind="stable")[:LOOKED_AT]
    _, covariance = graph.relative(newest, looked_at)
    sigma = np.sqrt(np.linalg.eigvalsh(covariance[:, :2, :2])[:, -1])
    # A turn of the newest moves what is far.
    sigma = sigma + np.sqrt(covariance[:, 2, 2]) * (radius[looked_at] + radius[newest])
    score = apart[looked_at] / np.sqrt(room[looked_at] ** 2 + sigma**2)
    may = apart[looked_at] - room[looked_at] < BEYOND * sigma
    order = np.argsort(np.where(may, score, np.inf), kind="stable")[: int(may.sum())]
    chosen = looked_at[order]
    recent = newest - chosen <= RECENT
    kept = ~recent | (np.cumsum(recent) <= max(most // 2, 1))
    return chosen[kept][:most]


def _extent(submap: Submap) -> tuple[Float[np.ndarray, "2"], float]:
    """Middle of the path, and how far reflectors are from it, metres, roughly."""
    if not len(submap.poses):
        return np.zeros(2), 2.0
    low, high = submap.poses[:, :2].min(axis=0), submap.poses[:, :2].max(axis=0)
    return (low + high) / 2, float(np.linalg.norm(high - low)) / 2 + 1.0
