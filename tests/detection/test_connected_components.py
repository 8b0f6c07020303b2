"""Connected components against a flood fill in the parameter space, with both seams and many scans."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import oracles

from jaxsonar.detection.connected_components import label_components


def partition(labels):
    """The components as sets of cells, independent of their numbers."""
    return {frozenset(map(tuple, np.argwhere(np.abs(labels) == k))) for k in range(1, np.abs(labels).max() + 1)}


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.02, 0.6), st.integers(1, 4))
def test_components_agree_with_the_oracle(seed, density, scans):
    masks = np.random.default_rng(seed).random((scans, 12, 7)) < density
    labels, counts = label_components(masks)
    assert not labels[:, -1].any()  # the row after the last
    for mask, label, count in zip(masks, labels[:, :-1], counts, strict=True):
        assert ((label != 0) == mask).all()
        assert sorted(np.unique(np.abs(label[mask]))) == list(range(1, count + 1))
        assert partition(label) == set(oracles.components(mask))


def cells(*where):
    mask = np.zeros((1, 12, 7), bool)
    for row, column in where:
        mask[0, row, column] = True
    return label_components(mask)


@pytest.mark.parametrize("column", range(7))
def test_components_join_across_theta_pi(column):
    assert cells((0, column), (11, column))[1] == [1]
    assert cells((0, column), (11, min(column + 1, 6)))[1] == [1]
    assert cells((1, column), (11, column))[1] == [2]


def test_components_join_across_rho_zero():
    labels, counts = cells((2, 0), (8, 0))
    assert counts == [1]
    assert labels[0, 2, 0] * labels[0, 8, 0] == -1  # one component with different signs on its two sides
    assert cells((2, 0), (9, 0))[1] == [1]
    assert cells((2, 0), (10, 0))[1] == [2]
    assert cells((2, 1), (8, 0))[1] == [2]
    assert cells((11, 0), (6, 0))[1] == [1]


def test_empty_batches_and_empty_scans():
    assert label_components(np.zeros((0, 12, 7), bool))[0].shape == (0, 13, 7)
    labels, counts = label_components(np.zeros((3, 12, 7), bool))
    assert not labels.any()
    assert list(counts) == [0, 0, 0]


def test_components_do_not_join_across_scans():
    mask = np.zeros((2, 12, 7), bool)
    mask[0, -1] = mask[1, 0] = True
    assert list(label_components(mask)[1]) == [1, 1]
