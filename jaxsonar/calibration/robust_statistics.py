"""Weights and spreads of residuals with heavy tails."""

import numpy as np
from jaxtyping import Float

from jaxsonar.estimation.robust_adjustment import SETTINGS as GNC_SETTINGS


def student_weights(residual: Float[np.ndarray, "*any"], freedom: float) -> Float[np.ndarray, "*any"]:
    """Weights in reweighted least squares of residuals that follow Student's t distribution.

    Args:
        residual: residuals in units of the scale of the distribution.
        freedom: its degrees of freedom.
    """
    return (freedom + 1) / (freedom + residual**2)


def robust_deviation(values: Float[np.ndarray, " values"]) -> float:
    """Robust standard deviation about the median, from the median absolute deviation; 0 without values."""
    if not len(values):
        return 0.0
    return GNC_SETTINGS.mad_to_sigma * float(np.median(np.abs(values - np.median(values))))
