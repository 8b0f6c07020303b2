"""A graph of planar poses held together by relative poses: sparse Gauss-Newton, and covariances of what is asked for.

Poses are world_from_node, (x, y, theta); the first one does not move. A link is a relative pose with an information
matrix, which may be singular: parallel walls say nothing about the way along them.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU, splu

from jaxsonar.geometry.se2 import relative, wrap_angle
from jaxsonar.hardware.errors import SonarError

STEPS = 30
"""Most steps of a solution."""
STILL = 1e-7
"""Largest step in metres and radians at which poses have come to rest."""
SHRINKS = 0.3
"""A factor is used again while each step is at most this share of the last one."""
SINGULAR = 1e-13
"""Smallest pivot as a share of its diagonal element."""


class Link(NamedTuple):
    """What is known of one node as seen from another."""

    first: int
    """Number of the node that sees."""
    second: int
    """Number of the node that is seen."""
    relative: Float[np.ndarray, "3"]
    """first_from_second, metres and radians."""
    information: Float[np.ndarray, "3 3"]
    """Inverse covariance of ``relative``; zero in the directions that are not known."""


class Graph:
    """Poses where they satisfy the links best.

    Args:
        poses: world_from_node.
        links: what holds them together.
        converged: whether the last step was small.
    """

    def __init__(self, poses: Float[np.ndarray, "nodes 3"], links: Sequence[Link], *, converged: bool):
        self.poses, self.links, self.converged = poses, tuple(links), converged
        self._stacked = _stacked(links)

    def __len__(self) -> int:
        return len(self.poses)

    @cached_property
    def chi2(self) -> Float[np.ndarray, " links"]:
        """Squared residual of each link in its standard deviations."""
        links = self._stacked
        residual = relative(self.poses[links.first], self.poses[links.second]) - links.relative
        residual[:, 2] = wrap_angle(residual[:, 2])
        return np.einsum("li,lij,lj->l", residual, links.information, residual)

    @cached_property
    def _factor(self) -> SuperLU:
        return _Normal(len(self.poses), self._stacked).factor(self.poses)

    def joint(self, nodes: Int[np.ndarray, " chosen"]) -> Float[np.ndarray, "unknowns unknowns"]:
        """Joint covariance of chosen nodes in the world frame, three rows each in their order; the first node has none.

        A node may be asked for more than once.
        """
        size = 3 * len(self.poses) - 3
        column = (3 * np.asarray(nodes)[:, None] - 3 + np.arange(3)).ravel()
        free = column >= 0
        wanted = np.zeros((size, len(column)))
        wanted[column[free], np.flatnonzero(free)] = 1.0
        # Column after column: for many at once SuperLU calls a threaded BLAS, which is slower by far.
        solved = np.stack([self._factor.solve(one) for one in wanted.T], axis=-1) if size else wanted
        cov = np.where(free[:, None], solved[np.maximum(column, 0)] if size else 0.0, 0.0)
        return (cov + cov.T) / 2

    def covariance(self, nodes: Int[np.ndarray, " chosen"]) -> Float[np.ndarray, "chosen 3 3"]:
        """Marginal covariance of each of these nodes in the world frame."""
        return _diagonal(self.joint(nodes))

    def relative(
        self, first: int, seconds: Int[np.ndarray, " chosen"]
    ) -> tuple[Float[np.ndarray, "chosen 3"], Float[np.ndarray, "chosen 3 3"]]:
        """first_from_second of chosen nodes, and the covariance of each, of errors added to it."""
        count = len(seconds)
        seen = relative(np.broadcast_to(self.poses[first], (count, 3)), self.poses[seconds])
        joint = self.joint(np.append(np.asarray([first]), seconds))
        by_first, by_second = _jacobians(np.broadcast_to(self.poses[first], (count, 3)), seen)
        own, cross = joint[:3, :3], joint[:3, 3:].reshape(3, count, 3).swapaxes(0, 1)
        mixed = by_first @ cross @ by_second.swapaxes(1, 2)
        cov = by_first @ own @ by_first.swapaxes(1, 2) + by_second @ _diagonal(joint[3:, 3:]) @ by_second.swapaxes(1, 2)
        cov = cov + mixed + mixed.swapaxes(1, 2)
        return seen, (cov + cov.swapaxes(1, 2)) / 2

    def between(self, nodes: Int[np.ndarray, " chosen"]) -> Float[np.ndarray, "chosen chosen 3 3"]:
        """Covariance of each of these nodes as seen from each of them, as ``relative`` has it."""
        count = len(nodes)
        joint = self.joint(nodes).reshape(count, 3, count, 3).swapaxes(1, 2)
        own = joint[np.arange(count), np.arange(count)]
        out = np.zeros_like(joint)
        for k, node in enumerate(nodes):
            here = np.broadcast_to(self.poses[node], (count, 3))
            by_first, by_second = _jacobians(here, relative(here, self.poses[nodes]))
            mixed = by_first @ joint[k] @ by_second.swapaxes(1, 2)
            cov = by_first @ own[k] @ by_first.swapaxes(1, 2) + by_second @ own @ by_second.swapaxes(1, 2)
            out[k] = cov + mixed + mixed.swapaxes(1, 2)
        return (out + out.swapaxes(2, 3)) / 2


def solve(poses: Float[np.ndarray, "nodes 3"], links: Sequence[Link]) -> Graph:
    """The poses that satisfy the links best: Gauss-Newton, damped (Levenberg-Marquardt) where a step does not help.

    Args:
        poses: world_from_node, a start; the first one stays.
        links: between nodes; together they must determine every pose.

    Returns:
        The poses; ``converged`` is False where they had not come to rest after ``STEPS`` steps.

    Raises:
        SonarError: numbers that are not finite, links to nodes that are not there, poses that no link determines.
    """
    stacked = _stacked(links)
    _checked(poses, stacked)
    if len(poses) < 2:
        return Graph(poses, links, converged=True)
    normal = _Normal(len(poses), stacked)
    factor, (gradient, cost) = normal.factor(poses), normal.force(poses)
    damping, last, still = 0.0, np.inf, False
    for _ in range(STEPS):
        step = np.append(np.zeros(3), -factor.solve(gradient)).reshape(-1, 3)
        tried = poses + step
        tried[1:, 2] = wrap_angle(tried[1:, 2])
        far = float(np.abs(step).max())
        still = far < STILL
        if still:
            poses = tried
            break
        new_gradient, new_cost = normal.force(tried)
        if new_cost <= cost * (1 + 1e-12):
            poses, gradient, cost = tried, new_gradient, new_cost
            # While steps shrink fast the old factor is as good as a new one.
            if damping or far > SHRINKS * last:
                damping = damping / 10 if damping > 1e-6 else 0.0
                factor = normal.factor(poses, damping)
            last = far
        else:
            damping, last = (10 * damping if damping else 1e-4), np.inf
            factor = normal.factor(poses, damping)
    return Graph(poses, links, converged=still)


class _Stacked(NamedTuple):
    """All links as arrays."""

    first: Int[np.ndarray, " links"]
    second: Int[np.ndarray, " links"]
    relative: Float[np.ndarray, "links 3"]
    information: Float[np.ndarray, "links 3 3"]


def _stacked(links: Sequence[Link]) -> _Stacked:
    return _Stacked(
        np.array([link.first for link in links], dtype=np.int64),
        np.array([link.second for link in links], dtype=np.int64),
        np.array([link.relative for link in links], dtype=np.float64).reshape(-1, 3),
        np.array([link.information for link in links], dtype=np.float64).reshape(-1, 3, 3),
    )


def _checked(poses: Float[np.ndarray, "nodes 3"], links: _Stacked) -> None:
    ends = np.concatenate([links.first, links.second])
    if len(ends) and (ends.min() < 0 or ends.max() >= len(poses)):
        raise SonarError(f"posegraph: a link to node {ends.max()} or {ends.min()}; allowed are 0 to {len(poses) - 1}")
    finite = np.isfinite(poses).all() and np.isfinite(links.relative).all() and np.isfinite(links.information).all()
    if not finite:
        raise SonarError("posegraph: a pose, a relative pose or an information matrix is not finite")


def _jacobians(
    first: Float[np.ndarray, "links 3"], seen: Float[np.ndarray, "links 3"]
) -> tuple[Float[np.ndarray, "links 3 3"], Float[np.ndarray, "links 3 3"]]:
    """Of first_from_second by both poses, from world_from_first and first_from_second."""
    c, s = np.cos(first[:, 2]), np.sin(first[:, 2])
    by_second = np.zeros((len(first), 3, 3))
    by_second[:, 0, 0], by_second[:, 0, 1] = c, s
    by_second[:, 1, 0], by_second[:, 1, 1] = -s, c
    by_second[:, 2, 2] = 1.0
    by_first = -by_second
    by_first[:, 0, 2], by_first[:, 1, 2] = seen[:, 1], -seen[:, 0]
    return by_first, by_second


def relative_jacobians(
    first: Float[np.ndarray, "3"], second: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]:
    """first_from_second of two poses world_from_node, and its derivatives by both."""
    seen = relative(first, second)
    by_first, by_second = _jacobians(first[None], seen[None])
    return seen, by_first[0], by_second[0]


def _diagonal(joint: Float[np.ndarray, "unknowns unknowns"]) -> Float[np.ndarray, "nodes 3 3"]:
    """The blocks of 3 x 3 along the diagonal."""
    count = len(joint) // 3
    return joint.reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count)]


class _Normal:
    """The normal equations of all nodes but the first; where the links put their numbers is found once a solution."""

    def __init__(self, nodes: int, links: _Stacked):
        self.links, self.size = links, 3 * nodes - 3
        self.place = (3 * np.stack([links.first, links.second], axis=-1)[..., None] - 3 + np.arange(3)).reshape(-1, 6)
        row, column = (part.ravel() for part in np.broadcast_arrays(self.place[:, :, None], self.place[:, None]))
        self.kept = (row >= 0) & (column >= 0)
        self.row, self.column = row[self.kept], column[self.kept]
        self.free = self.place.ravel() >= 0

    def force(self, poses: Float[np.ndarray, "nodes 3"]) -> tuple[Float[np.ndarray, " unknowns"], float]:
        """Half the gradient of the cost there, and the cost: chi2 of all links."""
        residual, jacobian = self._linear(poses)
        pulled = (self.links.information @ residual[..., None])[..., 0]
        force = np.einsum("lij,li->lj", jacobian, pulled).ravel()[self.free]
        gradient = np.bincount(self.place.ravel()[self.free], weights=force, minlength=self.size)
        return gradient, float((residual * pulled).sum())

    def factor(self, poses: Float[np.ndarray, "nodes 3"], damping: float = 0.0) -> SuperLU:
        """Of the normal equations there, the diagonal raised by a share of itself."""
        _, jacobian = self._linear(poses)
        values = (jacobian.swapaxes(1, 2) @ self.links.information @ jacobian).ravel()[self.kept]
        diagonal = np.arange(self.size)
        # The diagonal always has a place, so that a missing link shows as a zero pivot.
        rows, columns = np.append(self.row, diagonal), np.append(self.column, diagonal)
        scale = np.bincount(self.row, weights=values * (self.row == self.column), minlength=self.size)
        values = np.append(values, damping * scale)
        return _factored(csc_matrix((values, (rows, columns)), shape=(self.size, self.size)), scale)

    def _linear(
        self, poses: Float[np.ndarray, "nodes 3"]
    ) -> tuple[Float[np.ndarray, "links 3"], Float[np.ndarray, "links 3 6"]]:
        first = poses[self.links.first]
        seen = relative(first, poses[self.links.second])
        residual = seen - self.links.relative
        residual[:, 2] = wrap_angle(residual[:, 2])
        return residual, np.concatenate(_jacobians(first, seen), axis=-1)


def _factored(normal: csc_matrix, scale: Float[np.ndarray, " unknowns"]) -> SuperLU:
    """Of normal equations with this diagonal, which must determine everything."""
    undetermined = SonarError("posegraph: the links do not determine all poses; every node needs a chain of full links")
    try:
        factor = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError as error:  # a pivot is exactly zero
        raise undetermined from error
    if (factor.U.diagonal() <= SINGULAR * scale[np.argsort(factor.perm_c)]).any():
        raise undetermined
    return factor
