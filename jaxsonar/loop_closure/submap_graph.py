"""The pose graph of the submaps: sequential constraints, loop closures, and the poses of all submaps.

``SubmapGraph.add`` takes a finished submap. The work that follows is divided into small pieces (``process_next``), so
that a robot can do one piece with each scan.
"""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.estimation.pose_graph import BetweenFactor, PoseGraph, solve_pose_graph
from jaxsonar.geometry.se2 import compose, relative, rotate
from jaxsonar.loop_closure.closure_candidate import ClosureCandidate
from jaxsonar.loop_closure.closure_detection import detect_closure
from jaxsonar.loop_closure.sequential_constraint import odometry_factor, sequential_factor
from jaxsonar.loop_closure.settings import SETTINGS
from jaxsonar.loop_closure.submap import Submap
from jaxsonar.loop_closure.submap_view import SubmapNeighborhood, SubmapView
from jaxsonar.loop_closure.verification import ClosureDecision, ClosureVerifier


class SubmapGraph:
    """Poses of submaps. The frame of the first submap is the world; the last node is the frame of the next submap.

    Args:
        reliable_range: walls within this distance of the robot are surely detected, metres.
        max_compared: number of earlier submaps that are compared with each new one.
    """

    def __init__(self, *, reliable_range: float = SETTINGS.reliable_range, max_compared: int = SETTINGS.max_compared):
        self.reliable_range, self.max_compared = reliable_range, max_compared
        self.submaps: list[Submap] = []
        self.views: list[SubmapView] = []
        self.chain: list[BetweenFactor] = []
        self.verifier = ClosureVerifier()
        self.graph = PoseGraph(np.zeros((1, 3)), (), converged=True)
        self._pending: tuple[Callable[[SubmapGraph], None], ...] = ()

    @property
    def poses(self) -> Float[np.ndarray, "nodes 3"]:
        """world_from_submap of all submaps and of the next one, metres and radians."""
        return self.graph.poses

    def copy(self) -> "SubmapGraph":
        """An independent copy."""
        twin = SubmapGraph(reliable_range=self.reliable_range, max_compared=self.max_compared)
        twin.submaps, twin.chain, twin.graph = list(self.submaps), list(self.chain), self.graph
        twin.views, twin._pending = list(self.views), self._pending
        twin.verifier = self.verifier.copy()
        return twin

    @property
    def last_covariance(self) -> Float[np.ndarray, "3 3"]:
        """Covariance of the pose of the next submap."""
        return self.graph.marginal_covariances(np.array([len(self.graph) - 1]))[0]

    def covariances(self) -> Float[np.ndarray, "nodes 3 3"]:
        """Covariances of ``poses``."""
        return self.graph.marginal_covariances(np.arange(len(self.graph)))

    def add(self, submap: Submap) -> tuple[ClosureDecision, ...]:
        """Add a finished submap, after all pending work; the decisions that the latter led to."""
        decisions = self.process_all()
        newest = len(self.submaps)
        self.submaps.append(submap)
        self.views.append(SubmapView.of(submap))
        self.chain.append(odometry_factor(submap, newest))
        # A new node at the end of the chain has no residual: all other poses stay.
        poses = np.concatenate([self.poses, compose(self.poses[-1], submap.exit_pose)[None]])
        self.graph = PoseGraph(poses, self.chain + self.verifier.factors, converged=self.graph.converged)
        self._pending = (SubmapGraph._add_sequential_factor, SubmapGraph._select_candidates) if newest else ()
        return decisions

    @property
    def has_pending_work(self) -> bool:
        """Whether work for the newest submap is pending."""
        return bool(self._pending)

    def process_next(self) -> tuple[ClosureDecision, ...]:
        """Do the next piece of pending work; the decisions about closures that it led to.

        The pieces are: the sequential constraint, the selection of earlier submaps that may overlap, and the comparison
        with each of them, the most likely first.
        """
        made = len(self.verifier.decisions)
        if self._pending:
            task, *rest = self._pending
            self._pending = tuple(rest)
            task(self)
        return tuple(self.verifier.decisions[made:])

    def process_all(self) -> tuple[ClosureDecision, ...]:
        """Do all pending work; the decisions about closures that it led to."""
        made = len(self.verifier.decisions)
        while self.has_pending_work:
            self.process_next()
        return tuple(self.verifier.decisions[made:])

    def _add_sequential_factor(self) -> None:
        """Replace the last constraint of the chain by one that uses the walls both submaps observed."""
        newest = len(self.submaps) - 1
        self.chain[-2] = sequential_factor(self.submaps[-2], self.submaps[-1], newest - 1)
        self.graph = solve_pose_graph(self.poses, self.chain + self.verifier.factors)

    def _select_candidates(self) -> None:
        """Schedule the comparison with earlier submaps that may overlap."""
        newest = len(self.submaps) - 1
        chosen = overlap_candidates(self.graph, self.submaps, newest, max_compared=self.max_compared)
        self._pending = tuple(partial(SubmapGraph._compare, earlier=int(earlier)) for earlier in chosen)

    def _compare(self, earlier: int) -> None:
        """Look for a closure with an earlier submap; an accepted one narrows the prior of the following comparisons."""
        newest = len(self.submaps) - 1
        # 1. Measure the relative pose. Submaps between the two belong to the neighborhood of one of them only.
        expected, covariance = self.graph.relative_poses(earlier, np.array([newest]))
        middle = (earlier + newest) // 2
        views = self._neighborhood(earlier, 0, middle), self._neighborhood(newest, middle + 1, newest)
        known = self.submaps[earlier]
        measured = detect_closure(
            self.submaps[newest],
            known,
            expected[0],
            covariance[0],
            reliable_range=self.reliable_range,
            neighborhoods=views,
        )
        if measured is None:
            return
        # 2. Verify it, and solve the graph if a closure was accepted.
        position = np.asarray(known.landmarks.anchor)[measured.pairs.earlier].mean(axis=0)
        if self.verifier.add(self.graph, ClosureCandidate(earlier, newest, measured, position)):
            self.graph = self.verifier.solve(self.graph.poses, self.chain, newest)
            if sum(one.newest == newest for one in self.verifier.accepted) >= SETTINGS.enough_closures:
                self._pending = ()

    def _neighborhood(self, number: int, first: int, last: int) -> SubmapNeighborhood:
        """View of a submap with its neighbors, from a first to a last one."""
        own = self.graph.poses[number]
        steps = [sign * step for step in range(1, SETTINGS.neighbors + 1) for sign in (1, -1)]
        others = [number + step for step in steps if first <= number + step <= last]
        return SubmapNeighborhood(
            self.views[number], tuple((relative(own, self.graph.poses[k]), self.views[k]) for k in others)
        )


def overlap_candidates(
    graph: PoseGraph, submaps: Sequence[Submap], newest: int, *, max_compared: int = SETTINGS.max_compared
) -> Int[np.ndarray, " chosen"]:
    """Earlier submaps that may overlap the newest one, the most likely first.

    The previous submap is not among them: the sequential constraint contains what both share.

    Args:
        graph: poses of the submaps.
        submaps: all submaps.
        newest: number of the newest submap.
        max_compared: maximum number of candidates.
    """
    if newest < 2:
        return np.zeros(0, dtype=np.int64)
    center, radius = (np.array(part) for part in zip(*(_extent(one) for one in submaps[: newest + 1]), strict=True))
    position = graph.poses[: newest + 1, :2] + rotate(center, graph.poses[: newest + 1, 2])
    distance = np.linalg.norm(position[:-2] - position[newest], axis=1)
    overlap = radius[:-2] + radius[newest]
    considered = np.argsort(distance - overlap, kind="stable")[: SETTINGS.max_considered]
    _, covariance = graph.relative_poses(newest, considered)
    sd = np.sqrt(np.linalg.eigvalsh(covariance[:, :2, :2])[:, -1])
    # A rotation of the newest submap moves what is far from it.
    sd = sd + np.sqrt(covariance[:, 2, 2]) * (radius[considered] + radius[newest])
    score = distance[considered] / np.sqrt(overlap[considered] ** 2 + sd**2)
    possible = distance[considered] - overlap[considered] < SETTINGS.overlap_sd * sd
    order = np.argsort(np.where(possible, score, np.inf), kind="stable")[: int(possible.sum())]
    chosen = considered[order]
    recent = newest - chosen <= SETTINGS.recent_submaps
    kept = ~recent | (np.cumsum(recent) <= max(max_compared // 2, 1))
    return chosen[kept][:max_compared]


def _extent(submap: Submap) -> tuple[Float[np.ndarray, "2"], float]:
    """Center of the trajectory of a submap, and approximate distance of its farthest reflector, metres."""
    radius, margin = SETTINGS.default_radius
    if not len(submap.poses):
        return np.zeros(2), radius
    low, high = submap.poses[:, :2].min(axis=0), submap.poses[:, :2].max(axis=0)
    return (low + high) / 2, float(np.linalg.norm(high - low)) / 2 + margin
