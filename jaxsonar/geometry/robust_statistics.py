"""Weights and spreads of residuals with heavy tails."""

import numpy as np
from jaxtyping import Float

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


def student_weights(squared: Float[np.ndarray, "*any"], freedom: float) -> Float[np.ndarray, "*any"]:
    """Weights in reweighted least squares of residuals that follow Student's t distribution.

    Args:
        squared: squared residuals in units of the squared scale of the distribution.
        freedom: its degrees of freedom.
    """
    return (freedom + 1) / (freedom + squared)


def robust_deviation(values: Float[np.ndarray, " values"], *, center: float | None = None) -> float:
    """Robust standard deviation about the median, from the median absolute deviation; 0 without values.

    Args:
        values: the sample.
        center: the mean, if it is known, instead of the median.
    """
    if not len(values):
        return 0.0
    return MAD_TO_SIGMA * float(np.median(np.abs(values - (np.median(values) if center is None else center))))
