"""Sparse normal equations, eliminated block by block (multifrontal Cholesky); covariances of every block.

A block is a pose, a reflector, or whatever hangs on all of them. A pose hears the few reflectors around it, so in a
good order of elimination each block has few neighbors left, however many there are in all: time and room grow with the
length of the path. The same recursion backwards gives the blocks along the diagonal of the inverse (Takahashi), without
the inverse.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg.lapack import dpotrf, dpotri  # pyright: ignore[reportAttributeAccessIssue]
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu


class _Front(NamedTuple):
    """One block in its turn: itself and those of its neighbors that come later."""

    block: int
    own: int
    """Unknowns of the block."""
    rows: Int[np.ndarray, " front"]
    """All unknowns of the front, those of the block first."""
    panel: slice
    """Where the rows of the block begin and end in the stored numbers."""
    parent: int
    """The front that takes over what is left, -1 for none."""
    into: Int[np.ndarray, " neighbors"]
    """Place of each unknown that is left in the front of the parent."""


class Plan:
    """In which order blocks are eliminated, and where their numbers stand.

    Args:
        sizes: unknowns of every block; the unknowns of all blocks follow each other in their order.
        pairs: blocks that occur together in a term; in any order, each as often as you like.
    """

    def __init__(self, sizes: Int[np.ndarray, " blocks"], pairs: Int[np.ndarray, "pairs 2"]):
        self.sizes = np.asarray(sizes, dtype=np.int64)
        count = len(self.sizes)
        self.begin: Int[np.ndarray, " ends"] = np.append(0, np.cumsum(self.sizes))
        low, high = np.divmod(np.unique(pairs.min(axis=1) * count + pairs.max(axis=1)), count)
        pairs = np.stack([low, high], axis=1)[low != high]
        order = _order(count, pairs)
        self.turn = np.empty(count, dtype=np.int64)
        self.turn[order] = np.arange(count)
        later: list[set[int]] = [set() for _ in range(count)]  # by turn: the turns of the neighbors that come later
        for one, other in np.sort(self.turn[pairs], axis=1).tolist():
            later[one].add(other)
        parent = np.full(count, -1)
        for turn in range(count):
            if later[turn]:
                up = min(later[turn])
                parent[turn] = up
                later[up] |= later[turn] - {up}
        self.fronts: list[_Front] = []
        self._at: list[dict[int, int]] = []  # by turn: the column at which each later turn's unknowns begin
        stored, rows_of = 0, [int(self.begin[block]) + np.arange(int(self.sizes[block])) for block in order]
        for turn in range(count):
            block, own = int(order[turn]), int(self.sizes[order[turn]])
            column, at = own, {turn: 0}
            for other in sorted(later[turn]):
                at[other] = column
                column += len(rows_of[other])
            rows = np.concatenate([rows_of[turn], *(rows_of[other] for other in sorted(later[turn]))])
            self._at.append(at)
            panel = slice(stored, stored + own * column)
            self.fronts.append(_Front(block, own, rows, panel, int(parent[turn]), np.zeros(0, dtype=np.int64)))
            stored = panel.stop
        for turn, front in enumerate(self.fronts):
            if front.parent >= 0:
                at = self._at[front.parent]
                into = [at[other] + np.arange(len(rows_of[other])) for other in sorted(later[turn])]
                self.fronts[turn] = front._replace(into=np.concatenate(into))
        self.stored = stored
        """Numbers that the equations have: a row for each unknown, up to the last one that it meets."""

    def places(
        self, first: Int[np.ndarray, " terms"], second: Int[np.ndarray, " terms"]
    ) -> tuple[Int[np.ndarray, " terms"], Int[np.ndarray, " terms"], Int[np.ndarray, " terms"]]:
        """Where the product of unknown i of a first block and k of a second one is stored: at base + i di + k dk.

        Of a block with itself this is its whole square; of two blocks one of the two rectangles is stored.

        Args:
            first: number of a block, for every term.
            second: likewise; the two must be a pair of the plan, or the same.

        Returns:
            Base, di, dk of every term.
        """
        code, which = np.unique(first * len(self.sizes) + second, return_inverse=True)
        found = np.empty((len(code), 3), dtype=np.int64)
        for k, (one, other) in enumerate(np.stack(np.divmod(code, len(self.sizes)), axis=1).tolist()):
            a, b = int(self.turn[one]), int(self.turn[other])
            low, high = min(a, b), max(a, b)
            front = self.fronts[low]
            width = len(front.rows)
            base = front.panel.start + self._at[low][high]
            found[k] = (base, width, 1) if a <= b else (base, 1, width)
        base, di, dk = found[which].T
        return base, di, dk

    @property
    def diagonal(self) -> Int[np.ndarray, " unknowns"]:
        """Where the diagonal is stored, unknown by unknown."""
        out = np.empty(int(self.begin[-1]), dtype=np.int64)
        for front in self.fronts:
            own = np.arange(front.own)
            out[front.rows[: front.own]] = front.panel.start + own * (len(front.rows) + 1)
        return out

    def factor(self, values: Float[np.ndarray, " stored"]) -> "Factor":
        """Of positive definite equations.

        Raises:
            numpy.linalg.LinAlgError: they are singular.
        """
        left: list[np.ndarray | None] = [None] * len(self.fronts)
        inverse, right = [], []
        for turn, front in enumerate(self.fronts):
            own, width = front.own, len(front.rows)
            whole = left[turn]
            panel = values[front.panel].reshape(own, width)
            if whole is not None:
                panel = panel + whole[:own]
            block = _inverse(panel[:, :own])
            beside = panel[:, own:]
            share = block @ beside
            inverse.append(block)
            right.append(share)
            left[turn] = None
            if front.parent < 0:
                continue
            rest = -(beside.T @ share)
            if whole is not None:
                rest += whole[own:, own:]
            up = left[front.parent]
            if up is None:
                size = len(self.fronts[front.parent].rows)
                up = left[front.parent] = np.zeros((size, size))
            up[front.into[:, None], front.into] += rest
        return Factor(self, inverse, right)


class Factor:
    """Equations that have been eliminated."""

    def __init__(self, plan: Plan, inverse: Sequence[np.ndarray], right: Sequence[np.ndarray]):
        self.plan, self._inverse, self._right = plan, inverse, right

    def solve(self, side: Float[np.ndarray, " unknowns"]) -> Float[np.ndarray, " unknowns"]:
        """The solution for a right hand side."""
        x = np.array(side, dtype=np.float64)
        fronts = self.plan.fronts
        for front, right in zip(fronts, self._right, strict=True):
            x[front.rows[front.own :]] -= x[front.rows[: front.own]] @ right
        for front, inverse, right in zip(fronts[::-1], self._inverse[::-1], self._right[::-1], strict=True):
            own, rest = front.rows[: front.own], front.rows[front.own :]
            x[own] = inverse @ x[own] - right @ x[rest]
        return x

    def marginals(self) -> list[Float[np.ndarray, "_ _"]]:
        """The blocks along the diagonal of the inverse, in the order of the blocks."""
        fronts = self.plan.fronts
        out: list[np.ndarray] = [np.zeros((0, 0))] * len(fronts)
        known: list[np.ndarray | None] = [None] * len(fronts)
        waiting = np.bincount([front.parent for front in fronts if front.parent >= 0], minlength=len(fronts))
        for turn in range(len(fronts) - 1, -1, -1):
            front, right = fronts[turn], self._right[turn]
            own, cov = front.own, self._inverse[turn]
            whole = np.empty((len(front.rows), len(front.rows)))
            if front.parent >= 0:
                up = known[front.parent]
                assert up is not None
                later = up[front.into[:, None], front.into]
                cross = -right @ later
                cov = cov - cross @ right.T
                whole[:own, own:], whole[own:, :own], whole[own:, own:] = cross, cross.T, later
                waiting[front.parent] -= 1
                if not waiting[front.parent]:
                    known[front.parent] = None
            whole[:own, :own] = (cov + cov.T) / 2
            known[turn] = whole if waiting[turn] else None
            out[front.block] = whole[:own, :own].copy()
        return out


def _inverse(block: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Of a positive definite matrix of a few rows; its upper triangle is looked at."""
    upper, wrong = dpotrf(block)
    if wrong:
        raise np.linalg.LinAlgError("elimination: the equations are not positive definite")
    half = np.triu(dpotri(upper)[0])
    return half + np.triu(half, 1).T


def _order(count: int, pairs: Int[np.ndarray, "pairs 2"]) -> Int[np.ndarray, " blocks"]:
    """Blocks in an order of least degree."""
    first, second = pairs.T
    diagonal = np.arange(count)
    rows, columns = np.concatenate([diagonal, first, second]), np.concatenate([diagonal, second, first])
    values = np.concatenate([np.full(count, count + 1.0), -np.ones(2 * len(pairs))])
    graph = csc_matrix((values, (rows, columns)), shape=(count, count))
    factor = splu(graph, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.argsort(factor.perm_c)
