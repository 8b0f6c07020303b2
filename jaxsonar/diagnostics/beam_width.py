"""Width and direction of the detection cones, from which walls were detected at which off-axis angle."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize

from jaxsonar.diagnostics.echo_residuals import ResidualTable
from jaxsonar.diagnostics.settings import SETTINGS

_CONES = SETTINGS.cones
_EDGES = np.arange(-_CONES.bins // 2, _CONES.bins // 2 + 1) * _CONES.bin_width
BIN_CENTERS = (_EDGES[1:] + _EDGES[:-1]) / 2
"""Centers of the bins of off-axis angles, radians."""


def count_by_angle(
    table: ResidualTable,
    usable: Bool[np.ndarray, " rows"],
    detected: Bool[np.ndarray, " rows"],
    beam: Float[np.ndarray, " sensors"],
) -> tuple[Int[np.ndarray, "sensors bins"], Int[np.ndarray, "sensors bins"]]:
    """Expected and detected direct echoes of each sensor by off-axis angle.

    If the nominal cones differ, angles are scaled to the mean cone.

    Args:
        table: expected echoes.
        usable: rows to count.
        detected: rows whose echo was detected.
        beam: nominal full width of the cones, radians.
    """
    near = table.beyond_end <= SETTINGS.reference.end_margin
    row = np.flatnonzero(usable & (table.tx == table.rx) & near)
    angle = table.off_axis[row] * (beam.mean() / beam[table.tx[row]])
    bin_ = np.digitize(angle, _EDGES) - 1
    inside = (bin_ >= 0) & (bin_ < len(BIN_CENTERS))
    row, bin_ = row[inside], bin_[inside]
    expected_count = np.zeros((len(beam), len(BIN_CENTERS)), np.int64)
    detected_count = np.zeros_like(expected_count)
    np.add.at(expected_count, (table.tx[row], bin_), 1)
    np.add.at(detected_count, (table.tx[row], bin_), detected[row])
    return expected_count, detected_count


def detection_probability(
    curve: Float[np.ndarray, " 4"], angle: Float[np.ndarray, "*any"]
) -> Float[np.ndarray, "*any"]:
    """Detection probability at off-axis angles (radians), by a fitted curve (``Health.curve``): a logistic roll-off."""
    half_width, rolloff_width, inside, outside = curve
    return outside + (inside - outside) / (1 + np.exp(np.clip((np.abs(angle) - half_width) / rolloff_width, -50, 50)))


def fit_cone(
    expected: Int[np.ndarray, " bins"], detected: Int[np.ndarray, " bins"]
) -> tuple[Float[np.ndarray, " 4"], float]:
    """The curve of ``detection_probability`` by maximum likelihood, and the standard deviation of its half width.

    NaN if there are too few echoes, or too few on one side of the border.
    """
    unknown = np.full(4, np.nan), float("nan")
    if expected.sum() < _CONES.min_expected or detected.sum() < _CONES.min_detected:
        return unknown

    def negative_log_likelihood(x: np.ndarray) -> float:
        p = np.clip(detection_probability(x, BIN_CENTERS), 1e-4, 1 - 1e-4)
        return -float(detected @ np.log(p) + (expected - detected) @ np.log(1 - p))

    # Several starting points: the likelihood has local maxima.
    bounds = list(zip(_CONES.lower_limits, _CONES.upper_limits, strict=True))
    starts = [np.array([np.radians(half), *_CONES.start_shape]) for half in _CONES.start_half_widths_deg]
    fits = (minimize(negative_log_likelihood, start, method="L-BFGS-B", bounds=bounds) for start in starts)
    best = min(fits, key=lambda fit: fit.fun).x
    # Standard deviation from the Fisher information, reduced by the observed scatter.
    p = np.clip(detection_probability(best, BIN_CENTERS), 0.01, 0.99)
    steps = np.diag([1e-3, 1e-3, 1e-3, 1e-3])
    jacobian = np.stack(
        [
            (detection_probability(best + step, BIN_CENTERS) - detection_probability(best - step, BIN_CENTERS)) / 2e-3
            for step in steps
        ]
    )
    scatter = ((detected - expected * p) ** 2 / (p * (1 - p) * np.maximum(expected, 1)))[expected > 0]
    overdispersion = max(1.0, float(scatter.sum()) / max(1, len(scatter) - 4))
    information = (jacobian * (expected / (p * (1 - p)))) @ jacobian.T / overdispersion
    error = float(np.sqrt(np.linalg.inv(information + np.diag(_CONES.prior_information))[0, 0]))
    outside, inside = np.abs(BIN_CENTERS) > best[0], np.abs(BIN_CENTERS) < best[0]
    least = _CONES.min_per_side
    if expected[outside].sum() < least or expected[inside].sum() < least or error > _CONES.max_error:
        return unknown
    return best, error


class EachCone(NamedTuple):
    """The cone of each sensor. NaN where there are too few echoes."""

    half_width: Float[np.ndarray, "sensors 2"]
    """Half width and its standard deviation, radians."""
    direction: Float[np.ndarray, "sensors 2"]
    """Direction of the middle relative to the sensor's heading, counter-clockwise, and its standard deviation,
    radians."""
    nats: Float[np.ndarray, " sensors"]
    """Log-likelihood ratio of the best direction to the sensor's heading."""


def fit_each_cone(
    expected: Int[np.ndarray, "sensors bins"],
    detected: Int[np.ndarray, "sensors bins"],
    curve: Float[np.ndarray, " 4"],
) -> EachCone:
    """The cone of each sensor, with the roll-off of the common curve.

    Widths and directions are means over their posterior on a grid; directions, with the prior that the cones of a ring
    have similar widths.
    """
    sensors = len(expected)
    if not np.isfinite(curve).all():
        unknown = np.full((sensors, 2), np.nan)
        return EachCone(unknown, unknown.copy(), np.full(sensors, np.nan))
    half_width = np.radians(np.arange(3, 90, 1.0))
    direction = np.radians(np.arange(-_CONES.most_turn_deg, _CONES.most_turn_deg + 1, 1.0))
    outside = np.abs(BIN_CENTERS - direction[:, None])[None] - half_width[:, None, None]
    rolloff = 1 / (1 + np.exp(np.clip(outside / max(curve[1], _CONES.bin_width / 2), -50, 50)))
    # A sensor that detects less in all directions does not have a narrower cone: scale its curve.
    usual = expected @ detection_probability(curve, BIN_CENTERS)
    level = np.clip(detected.sum(axis=1) / np.maximum(usual, 1), 0.2, 1 / curve[2]) * curve[2]
    estimates: tuple[list[tuple[float, float]], list[tuple[float, float]]] = ([], [])
    nats = np.full(sensors, np.nan)
    alike = -0.5 * ((half_width / curve[0] - 1) / _CONES.alike)[:, None] ** 2
    for k, (n, found, inside) in enumerate(zip(expected, detected, level, strict=True)):
        p = np.clip(curve[3] + (inside - curve[3]) * rolloff, 1e-3, 1 - 1e-3)
        log_likelihood = np.log(p) @ found + np.log(1 - p) @ (n - found)
        nats[k] = (log_likelihood + alike).max() - (log_likelihood[:, len(direction) // 2] + alike[:, 0]).max()
        # The cones of a ring are alike: this tells a turned cone from a wide one.
        for values, axis, prior, estimate in (
            (half_width, 1, 0.0, estimates[0]),
            (direction, 0, alike, estimates[1]),
        ):
            posterior = np.exp(log_likelihood + prior - (log_likelihood + prior).max())
            marginal = posterior.sum(axis=axis) / posterior.sum()
            mean = float(marginal @ values)
            estimate.append((mean, float(np.sqrt(marginal @ (values - mean) ** 2))))
    enough = (expected.sum(axis=1) >= _CONES.min_expected_each) & (detected.sum(axis=1) >= _CONES.min_detected_each)
    widths, directions = (
        np.where((enough & (x[:, 1] < _CONES.max_error))[:, None], x, np.nan) for x in map(np.array, estimates)
    )
    return EachCone(widths, directions, np.where(np.isfinite(directions[:, 0]), nats, np.nan))
