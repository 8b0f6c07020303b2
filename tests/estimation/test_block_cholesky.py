"""Sparse elimination against the dense inverse, for graphs of all kinds."""

import numpy as np
import pytest

from jaxsonar.estimation.block_cholesky import Plan

BLOCKS = 24


def pairs_of(name, rng):
    """Graphs of blocks: a chain, a ring, all with one, a chain with shortcuts, all with all, none."""
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
    """A plan, its numbers, and the same as one matrix."""
    sizes = rng.integers(1, 4, BLOCKS)
    begin = np.append(0, np.cumsum(sizes))
    pairs = pairs_of(request.param, rng)
    whole = np.diag(rng.uniform(1, 2, begin[-1]))
    for one, other in pairs:
        rows = np.zeros((2, begin[-1]))
        for block in (one, other):
            rows[:, begin[block] : begin[block + 1]] = rng.standard_normal((2, sizes[block]))
        whole += rows.T @ rows
    plan = Plan(sizes, pairs)
    terms = np.unique(np.concatenate([np.sort(pairs, axis=1), np.tile(np.arange(BLOCKS)[:, None], 2)]), axis=0)
    values = np.full(plan.stored, np.nan)
    # In either order of the two blocks it is the same number.
    for one, other in (terms.T, terms.T[::-1]):
        for a, b, base, di, dk in zip(one, other, *plan.places(one, other), strict=True):
            for i in range(sizes[a]):
                for k in range(sizes[b]):
                    values[base + i * di + k * dk] = whole[begin[a] + i, begin[b] + k]
    return plan, np.nan_to_num(values), whole, begin


def test_the_solution_is_that_of_the_whole_matrix(equations, rng):
    plan, values, whole, _ = equations
    side = rng.standard_normal(len(whole))
    np.testing.assert_allclose(plan.factor(values).solve(side), np.linalg.solve(whole, side), rtol=0, atol=1e-11)


def test_marginals_are_blocks_of_the_inverse(equations):
    plan, values, whole, begin = equations
    inverse = np.linalg.inv(whole)
    for k, found in enumerate(plan.factor(values).marginals()):
        own = slice(begin[k], begin[k + 1])
        np.testing.assert_allclose(found, inverse[own, own], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(found, found.T)


def test_the_diagonal_stands_where_it_is_said(equations):
    plan, values, whole, _ = equations
    np.testing.assert_array_equal(values[plan.diagonal], np.diag(whole))


def test_room_grows_with_the_length_of_a_chain():
    def stored(count):
        chain = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
        return Plan(np.full(count, 3), chain).stored

    assert stored(800) < 2.1 * stored(400) < 400 * 3 * 3 * 8


def test_equations_that_determine_nothing_are_refused():
    plan = Plan(np.array([2, 1]), np.array([[0, 1]]))
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        plan.factor(np.zeros(plan.stored))
