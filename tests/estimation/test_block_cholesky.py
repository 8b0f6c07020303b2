"""Block Cholesky against dense linear algebra, for graphs of several kinds."""

import numpy as np
import pytest

from jaxsonar.estimation.block_cholesky import SymbolicFactorization

BLOCKS = 24


def pairs_of(name, rng):
    """Pairs of blocks: a chain, a ring, a star, a chain with shortcuts, all pairs, none."""
    chain = np.stack([np.arange(BLOCKS - 1), np.arange(1, BLOCKS)], axis=1)
    some = rng.integers(0, BLOCKS, (40, 2))
    return {
        "chain": chain,
        "ring": np.concatenate([chain, [[BLOCKS - 1, 0]]]),
        "star": np.stack([np.arange(BLOCKS), np.full(BLOCKS, 7)], axis=1),
        "random": np.concatenate([chain, some, some[:, ::-1]]),
        "all": np.argwhere(np.ones((BLOCKS, BLOCKS))),
        "none": np.zeros((0, 2), dtype=np.int64),
    }[name]


@pytest.fixture(params=["chain", "ring", "star", "random", "all", "none"])
def equations(request, rng):
    """A symbolic factorization, the stored entries of a normal matrix, and the same matrix as a dense one."""
    sizes = rng.integers(1, 4, BLOCKS)
    sizes[5] = 12  # larger than the blocks that LAPACK inverts
    begin = np.append(0, np.cumsum(sizes))
    pairs = pairs_of(request.param, rng)
    whole = np.diag(rng.uniform(1, 2, begin[-1]))
    for one, other in pairs:
        rows = np.zeros((2, begin[-1]))
        for block in (one, other):
            rows[:, begin[block] : begin[block + 1]] = rng.standard_normal((2, sizes[block]))
        whole += rows.T @ rows
    structure = SymbolicFactorization(sizes, pairs)
    terms = np.unique(np.concatenate([np.sort(pairs, axis=1), np.tile(np.arange(BLOCKS)[:, None], 2)]), axis=0)
    values = np.full(structure.nnz, np.nan)
    # The storage does not depend on the order of the two blocks.
    for one, other in (terms.T, terms.T[::-1]):
        for a, b, base, row_stride, column_stride in zip(one, other, *structure.storage(one, other), strict=True):
            for i in range(sizes[a]):
                for k in range(sizes[b]):
                    values[base + i * row_stride + k * column_stride] = whole[begin[a] + i, begin[b] + k]
    return structure, np.nan_to_num(values), whole, begin


def test_the_solution_equals_that_of_the_dense_matrix(equations, rng):
    structure, values, whole, _ = equations
    side = rng.standard_normal(len(whole))
    np.testing.assert_allclose(
        structure.factorize(values).solve(side), np.linalg.solve(whole, side), rtol=0, atol=1e-11
    )


def test_the_marginals_are_the_diagonal_blocks_of_the_inverse(equations):
    structure, values, whole, begin = equations
    inverse = np.linalg.inv(whole)
    for k, found in enumerate(structure.factorize(values).marginals()):
        own = slice(begin[k], begin[k + 1])
        np.testing.assert_allclose(found, inverse[own, own], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(found, found.T)


def test_the_diagonal_indices_select_the_diagonal(equations):
    structure, values, whole, _ = equations
    np.testing.assert_array_equal(values[structure.diagonal], np.diag(whole))


def test_memory_grows_linearly_with_the_length_of_a_chain():
    def nnz(count):
        chain = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
        return SymbolicFactorization(np.full(count, 3), chain).nnz

    assert nnz(800) < 2.1 * nnz(400) < 400 * 3 * 3 * 8


def test_a_singular_matrix_is_an_error():
    structure = SymbolicFactorization(np.array([2, 1]), np.array([[0, 1]]))
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        structure.factorize(np.zeros(structure.nnz))
