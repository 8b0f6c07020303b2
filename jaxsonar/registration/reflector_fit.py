"""Robust fit of reflectors as every kind, at fixed transducer poses (Geman-McClure, graduated non-convexity).

The loss is that of ``kernels.robust_fit``. Here it is written in NumPy, because the numbers of reflectors and echoes
vary from call to call and would be compiled again.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.registration.settings import RANGE_SETTINGS as SETTINGS
from jaxsonar.sensors.range_models import KINDS, RANGE_OF_KIND


class ReflectorFit(NamedTuple):
    """Reflectors fitted as plane, corner and edge."""

    parameters: Float[np.ndarray, "reflectors 3 2"]
    """(rho, theta) as plane, (x, y) as corner and as edge, metres and radians."""
    residual: Float[np.ndarray, "3 echoes"]
    """Measured minus predicted range as every kind, in units of sigma."""
    information: Float[np.ndarray, "reflectors 3 2 2"]
    """Inverse covariances of the parameters."""


def fit_reflectors(
    parameters: Float[np.ndarray, "reflectors 3 2"],
    reflector: Int[np.ndarray, " echoes"],
    measured: Float[np.ndarray, " echoes"],
    midpoint: Float[np.ndarray, "echoes 2"],
    half_baseline: Float[np.ndarray, "echoes 2"],
    *,
    sigma: float,
    steps: int,
    scales: tuple[float, float],
) -> ReflectorFit:
    """Gauss-Newton steps of all reflectors and kinds at once.

    Args:
        parameters: start values.
        reflector: row of the reflector of each echo.
        measured: ranges, metres.
        midpoint: midpoints of the transducers, in the frame of the reflectors, metres.
        half_baseline: half the vectors from transmitter to receiver.
        sigma: standard deviation of the ranges, metres.
        steps: number of steps.
        scales: first and last scale of the robust weights, in sigma; the scale is halved in every step.
    """
    count, (scale, last) = len(parameters), scales
    member = np.zeros((count, len(measured)))
    member[reflector, np.arange(len(measured))] = 1.0
    information = np.zeros((count, 3, 2, 2))

    def residuals() -> tuple[Float[np.ndarray, "3 echoes"], Float[np.ndarray, "3 echoes 2"]]:
        """Residuals as every kind, and derivatives of the ranges by the parameters, in sigma."""
        each = [RANGE_OF_KIND[kind](parameters[reflector, kind], midpoint, half_baseline) for kind in KINDS]
        residual = (measured - np.stack([one.range for one in each])) / sigma
        return residual, np.stack([one.d_range_d_landmark for one in each]) / sigma

    for _ in range(steps):
        residual, slope = residuals()
        weight = 1 / np.square(1 + np.square(residual / scale))
        scale = max(scale / 2, last)
        # Normal equations of all reflectors at once: sums over the echoes of each.
        first, second = slope[..., 0], slope[..., 1]
        products = first * first, first * second, second * second, residual * first, residual * second
        sums = np.einsum("re,pke->prk", member, weight * np.stack(products), optimize=True)
        aa, ab, bb = sums[0] + SETTINGS.fit_damping, sums[1], sums[2] + SETTINGS.fit_damping
        information = np.stack([np.stack([aa, ab], axis=-1), np.stack([ab, bb], axis=-1)], axis=-2)
        step = np.stack([bb * sums[3] - ab * sums[4], aa * sums[4] - ab * sums[3]], axis=-1)
        step = step / (aa * bb - ab * ab)[..., None]
        parameters = parameters + np.clip(step, -SETTINGS.fit_max_step, SETTINGS.fit_max_step)
    residual, _ = residuals()
    parameters = parameters.copy()
    parameters[:, 0, 1] = wrap_angle(parameters[:, 0, 1])
    return ReflectorFit(parameters, residual, information)
