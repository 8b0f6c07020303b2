"""Data association by joint compatibility (Neira and Tardos 2001): mutual nearest neighbors and chi-square tests.

Pairs that are individually compatible need not be so together: all pairs of a hypothesis are tested under their joint
covariance. Mutual nearest neighbors allow a greedy search.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float, Int
from scipy.special import chdtri


@runtime_checkable
class CompatibilityTest(Protocol):
    """A test of pairs under their joint covariance."""

    @property
    def chi2_contribution(self) -> Float[np.ndarray, " pairs"]:
        """Contribution of each pair to the chi-square."""
        ...

    @property
    def is_compatible(self) -> bool:
        """Whether the pairs are jointly compatible."""
        ...


Test = TypeVar("Test", bound=CompatibilityTest)


@lru_cache(maxsize=1024)
def chi2_bound(dof: int, probability: float) -> float:
    """Chi-square that a correct hypothesis exceeds with this probability."""
    return float(chdtri(dof, probability))


def mutual_nearest_neighbors(
    squared_distance: Float[np.ndarray, "rows columns"],
) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """Pairs of a row and a column that are the nearest of each other, by rows.

    Args:
        squared_distance: squared Mahalanobis distances; infinite for pairs that are not allowed. Neither axis is empty.
    """
    nearest_column, nearest_row = squared_distance.argmin(axis=1), squared_distance.argmin(axis=0)
    row = np.arange(len(squared_distance))
    mutual = np.isfinite(squared_distance[row, nearest_column]) & (nearest_row[nearest_column] == row)
    return row[mutual], nearest_column[mutual]


def jointly_compatible_pairs(
    innovation: Float[np.ndarray, "pairs 2"], covariance: Float[np.ndarray, "rows rows"], probability: float
) -> list[int]:
    """All pairs if they are jointly compatible; otherwise a greedy selection in the given order.

    The selection rejects a pair that is incompatible with those selected before it.

    Args:
        innovation: residuals of the pairs, the most certain pair first.
        covariance: joint covariance of all residuals.
        probability: probability with which correct pairs are rejected.
    """
    pairs = len(innovation)
    if not pairs or _chi2(innovation.ravel(), covariance) < chi2_bound(2 * pairs, probability):
        return list(range(pairs))
    accepted: list[int] = []
    for pair in range(pairs):
        rows = np.concatenate([[2 * k, 2 * k + 1] for k in (*accepted, pair)])
        chi2 = _chi2(innovation.ravel()[rows], covariance[np.ix_(rows, rows)])
        if chi2 < chi2_bound(len(rows), probability):
            accepted.append(pair)
    return accepted


def remove_incompatible_pairs(
    count: int, test: Callable[[Int[np.ndarray, " remaining"]], Test], *, least: int, least_fraction: float
) -> tuple[Int[np.ndarray, " remaining"], Test] | None:
    """Remove the pair with the largest contribution to the chi-square until the rest is jointly compatible.

    Args:
        count: number of pairs.
        test: tests the pairs with the given numbers.
        least: least number of pairs that must remain, at least 1.
        least_fraction: least fraction of the pairs that must remain.

    Returns:
        Numbers of the remaining pairs, ascending, and their test; None where too few remain.
    """
    remaining = np.arange(count)
    while len(remaining) >= max(least, int(np.ceil(least_fraction * count))):
        result = test(remaining)
        if result.is_compatible:
            return remaining, result
        remaining = np.delete(remaining, int(result.chi2_contribution.argmax()))
    return None


def _chi2(innovation: Float[np.ndarray, " rows"], covariance: Float[np.ndarray, "rows rows"]) -> float:
    return float(innovation @ np.linalg.solve(covariance, innovation))
