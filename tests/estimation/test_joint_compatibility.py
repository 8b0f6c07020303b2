"""Joint compatibility: mutual nearest neighbors, and chi-square tests of pairs under their joint covariance."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import chi2

from jaxsonar.estimation.joint_compatibility import (
    chi2_bound,
    jointly_compatible_pairs,
    mutual_nearest_neighbors,
    remove_incompatible_pairs,
)


@pytest.mark.parametrize("dof", [1, 2, 7, 80])
def test_the_bound_is_exceeded_with_the_given_probability(dof):
    assert chi2.sf(chi2_bound(dof, 0.005), dof) == pytest.approx(0.005)


def test_neighbors_are_nearest_in_both_directions(rng):
    distance = rng.random((6, 4))
    distance[:, 1] = np.inf
    rows, columns = mutual_nearest_neighbors(distance)
    assert 1 not in columns
    assert len(rows) >= 1
    for row, column in zip(rows, columns, strict=True):
        assert distance[row, column] == distance[row].min() == distance[:, column].min()


def test_a_pair_that_contradicts_the_better_ones_is_rejected():
    """A common error of all pairs is compatible; a pair without it is not."""
    covariance = 1e-4 * np.eye(6) + np.kron(np.ones((3, 3)), np.eye(2))
    common = np.tile([1.0, -0.5], (3, 1))
    assert jointly_compatible_pairs(common, covariance, 0.001) == [0, 1, 2]
    common[1] = 0.0
    assert jointly_compatible_pairs(common, covariance, 0.001) == [0, 2]
    assert jointly_compatible_pairs(np.zeros((0, 2)), np.zeros((0, 0)), 0.001) == []


class _Largest(NamedTuple):
    """Compatible if no contribution exceeds 1."""

    chi2_contribution: np.ndarray

    @property
    def is_compatible(self) -> bool:
        return bool((self.chi2_contribution <= 1).all())


def test_the_worst_pairs_are_removed_first():
    cost = np.array([0.5, 3.0, 0.1, 0.2, 0.3, 0.4])
    found = remove_incompatible_pairs(6, lambda rows: _Largest(cost[rows]), least=2, least_fraction=2 / 3)
    assert found is not None
    assert found[0].tolist() == [0, 2, 3, 4, 5]
    cost[:4] = 2.0
    assert remove_incompatible_pairs(6, lambda rows: _Largest(cost[rows]), least=2, least_fraction=2 / 3) is None
