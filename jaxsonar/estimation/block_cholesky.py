"""Multifrontal block Cholesky factorization of sparse normal equations, and marginal covariances of every block.

A block is a pose, a landmark, or a group of parameters on which all terms depend. A pose is connected to the few
landmarks around it. In a fill-reducing order of elimination each block therefore has few neighbors left, and time and
memory grow linearly with the length of the trajectory. The same recursion in reverse order yields the blocks along the
diagonal of the inverse without the inverse itself (Takahashi et al. 1973).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg.lapack import dpotrf, dpotri  # pyright: ignore[reportAttributeAccessIssue]
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

MAX_LAPACK_SIZE = 8
"""Larger blocks are inverted by NumPy: for these SciPy's ``dpotrf`` starts threads, which made a block of 26 rows 100
times slower (measured on two busy cores)."""


class _FrontalMatrix(NamedTuple):
    """A block at its elimination: itself and its neighbors of higher elimination rank."""

    block: int
    size: int
    """Number of unknowns of the block."""
    rows: Int[np.ndarray, " front"]
    """Indices of all unknowns of the front, those of the block first."""
    panel: slice
    """Storage of the rows of the block in the normal matrix."""
    parent: int
    """Elimination rank of the front that the Schur complement is added to; -1: none."""
    parent_index: Int[np.ndarray, " neighbors"]
    """Row of each neighboring unknown in the parent's front."""


class SymbolicFactorization:
    """Order of elimination, and storage of the normal matrix.

    Args:
        sizes: number of unknowns of every block; the unknowns are ordered by block.
        pairs: pairs of blocks that occur in a common term; order and repetitions are irrelevant.
    """

    def __init__(self, sizes: Int[np.ndarray, " blocks"], pairs: Int[np.ndarray, "pairs 2"]):
        self.sizes = np.asarray(sizes, dtype=np.int64)
        count = len(self.sizes)
        self.begin: Int[np.ndarray, " ends"] = np.append(0, np.cumsum(self.sizes))
        """First unknown of every block, and the number of all unknowns."""
        # 1. The order of elimination.
        low, high = np.divmod(np.unique(pairs.min(axis=1) * count + pairs.max(axis=1)), count)
        pairs = np.stack([low, high], axis=1)[low != high]
        order = _minimum_degree_order(count, pairs)
        self.elimination_rank = np.empty(count, dtype=np.int64)
        self.elimination_rank[order] = np.arange(count)
        # 2. The elimination tree: by rank, the ranks of the neighbors that are eliminated later, fill-in included.
        later: list[set[int]] = [set() for _ in range(count)]
        for one, other in np.sort(self.elimination_rank[pairs], axis=1).tolist():
            later[one].add(other)
        parent = np.full(count, -1)
        for rank in range(count):
            if later[rank]:
                parent[rank] = min(later[rank])
                later[parent[rank]] |= later[rank] - {int(parent[rank])}
        # 3. The fronts and their storage.
        self.fronts: list[_FrontalMatrix] = []
        self._column: list[dict[int, int]] = []  # by rank: first column of each neighbor in the front
        nnz, rows_of = 0, [int(self.begin[block]) + np.arange(int(self.sizes[block])) for block in order]
        for rank in range(count):
            block, size = int(order[rank]), int(self.sizes[order[rank]])
            width, column = size, {rank: 0}
            for other in sorted(later[rank]):
                column[other] = width
                width += len(rows_of[other])
            rows = np.concatenate([rows_of[rank], *(rows_of[other] for other in sorted(later[rank]))])
            self._column.append(column)
            panel = slice(nnz, nnz + size * width)
            self.fronts.append(_FrontalMatrix(block, size, rows, panel, int(parent[rank]), np.zeros(0, dtype=np.int64)))
            nnz = panel.stop
        for rank, front in enumerate(self.fronts):
            if front.parent >= 0:
                column = self._column[front.parent]
                index = [column[other] + np.arange(len(rows_of[other])) for other in sorted(later[rank])]
                self.fronts[rank] = front._replace(parent_index=np.concatenate(index))
        self.nnz = nnz
        """Number of stored entries of the normal matrix, fill-in included."""

    def storage(
        self, first: Int[np.ndarray, " terms"], second: Int[np.ndarray, " terms"]
    ) -> tuple[Int[np.ndarray, " terms"], Int[np.ndarray, " terms"], Int[np.ndarray, " terms"]]:
        """Storage of the product of two blocks in the normal matrix.

        Entry (i, k) is stored at base + i * row_stride + k * column_stride.

        The product of a block with itself is stored as a whole square, that of two blocks as one of two rectangles.

        Args:
            first: index of a block, for every term.
            second: likewise; the two must be one of the pairs, or the same block.

        Returns:
            Base, row stride and column stride of every term.
        """
        code, inverse = np.unique(first * len(self.sizes) + second, return_inverse=True)
        found = np.empty((len(code), 3), dtype=np.int64)
        for k, (one, other) in enumerate(np.stack(np.divmod(code, len(self.sizes)), axis=1).tolist()):
            a, b = int(self.elimination_rank[one]), int(self.elimination_rank[other])
            low, high = min(a, b), max(a, b)
            front = self.fronts[low]
            width = len(front.rows)
            base = front.panel.start + self._column[low][high]
            found[k] = (base, width, 1) if a <= b else (base, 1, width)
        base, row_stride, column_stride = found[inverse].T
        return base, row_stride, column_stride

    @property
    def diagonal(self) -> Int[np.ndarray, " unknowns"]:
        """Storage index of each diagonal entry."""
        out = np.empty(int(self.begin[-1]), dtype=np.int64)
        for front in self.fronts:
            row = np.arange(front.size)
            out[front.rows[: front.size]] = front.panel.start + row * (len(front.rows) + 1)
        return out

    def factorize(self, values: Float[np.ndarray, " nnz"]) -> "BlockCholesky":
        """Factorize a positive definite normal matrix.

        Raises:
            numpy.linalg.LinAlgError: the matrix is not positive definite.
        """
        pending: list[np.ndarray | None] = [None] * len(self.fronts)  # sums of the children's Schur complements
        inverse, coupling = [], []
        for rank, front in enumerate(self.fronts):
            size, width = front.size, len(front.rows)
            update = pending[rank]
            panel = values[front.panel].reshape(size, width)
            if update is not None:
                panel = panel + update[:size]
            block_inverse = _inverse(panel[:, :size])
            off_diagonal = panel[:, size:]
            gain = block_inverse @ off_diagonal
            inverse.append(block_inverse)
            coupling.append(gain)
            pending[rank] = None
            if front.parent < 0:
                continue
            schur_complement = -(off_diagonal.T @ gain)
            if update is not None:
                schur_complement += update[size:, size:]
            target = pending[front.parent]
            if target is None:
                parent_size = len(self.fronts[front.parent].rows)
                target = pending[front.parent] = np.zeros((parent_size, parent_size))
            target[front.parent_index[:, None], front.parent_index] += schur_complement
        return BlockCholesky(self, inverse, coupling)


class BlockCholesky:
    """Factorized normal equations.

    Args:
        structure: the symbolic factorization.
        inverse: inverse of the pivot block of each front.
        coupling: inverse of the pivot block times the rest of its rows, for each front.
    """

    def __init__(self, structure: SymbolicFactorization, inverse: Sequence[np.ndarray], coupling: Sequence[np.ndarray]):
        self.structure, self._inverse, self._coupling = structure, inverse, coupling

    def solve(self, right_hand_side: Float[np.ndarray, " unknowns"]) -> Float[np.ndarray, " unknowns"]:
        """The solution of the normal equations."""
        x = np.array(right_hand_side, dtype=np.float64)
        fronts = self.structure.fronts
        for front, coupling in zip(fronts, self._coupling, strict=True):
            x[front.rows[front.size :]] -= x[front.rows[: front.size]] @ coupling
        for front, inverse, coupling in zip(fronts[::-1], self._inverse[::-1], self._coupling[::-1], strict=True):
            own, rest = front.rows[: front.size], front.rows[front.size :]
            x[own] = inverse @ x[own] - coupling @ x[rest]
        return x

    def marginals(self) -> list[Float[np.ndarray, "_ _"]]:
        """Marginal covariances: the blocks along the diagonal of the inverse, in the order of the blocks."""
        fronts = self.structure.fronts
        out: list[np.ndarray] = [np.zeros((0, 0))] * len(fronts)
        # Joint covariance of each front, kept until all of its children are done.
        joint: list[np.ndarray | None] = [None] * len(fronts)
        children = np.bincount([front.parent for front in fronts if front.parent >= 0], minlength=len(fronts))
        for rank in range(len(fronts) - 1, -1, -1):
            front, coupling = fronts[rank], self._coupling[rank]
            size, cov = front.size, self._inverse[rank]
            whole = np.empty((len(front.rows), len(front.rows)))
            if front.parent >= 0:
                parent = joint[front.parent]
                assert parent is not None
                rest = parent[front.parent_index[:, None], front.parent_index]
                cross = -coupling @ rest
                cov = cov - cross @ coupling.T
                whole[:size, size:], whole[size:, :size], whole[size:, size:] = cross, cross.T, rest
                children[front.parent] -= 1
                if not children[front.parent]:
                    joint[front.parent] = None
            whole[:size, :size] = (cov + cov.T) / 2
            joint[rank] = whole if children[rank] else None
            out[front.block] = whole[:size, :size].copy()
        return out


def _inverse(block: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Inverse of a positive definite matrix; only its upper triangle is read."""
    if len(block) > MAX_LAPACK_SIZE:
        np.linalg.cholesky(block, upper=True)  # raises for a matrix that is not positive definite
        upper = np.triu(block)
        return np.linalg.inv(upper + np.triu(upper, 1).T)
    upper, failed = dpotrf(block)
    if failed:
        raise np.linalg.LinAlgError("the normal matrix is not positive definite")
    half = np.triu(dpotri(upper)[0])
    return half + np.triu(half, 1).T


def _minimum_degree_order(count: int, pairs: Int[np.ndarray, "pairs 2"]) -> Int[np.ndarray, " blocks"]:
    """Blocks in a minimum-degree order, as SuperLU computes it."""
    first, second = pairs.T
    diagonal = np.arange(count)
    rows, columns = np.concatenate([diagonal, first, second]), np.concatenate([diagonal, second, first])
    values = np.concatenate([np.full(count, count + 1.0), -np.ones(2 * len(pairs))])
    graph = csc_matrix((values, (rows, columns)), shape=(count, count))
    factor = splu(graph, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.argsort(factor.perm_c)
