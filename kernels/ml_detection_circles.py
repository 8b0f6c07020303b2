"""Circles in the maximum-likelihood detector: selected reflectors are fitted with a curvature as a third parameter.

A wall, a column and a thin pole are one family, with curvatures of 0, 1 / radius and infinity. A ring with narrow cones
determines the curvature in one scan hardly at all. The prior then decides, and the reflector remains undecided.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .detection_cones import audibility
from .measurement_model import EDGE, PLANE, PredictedEcho, curved_echo
from .ml_detection_likelihood import point_missed_log_likelihood
from .ml_detection_settings import DetectionSettings
from .ml_detection_state import Hypotheses, ScanData, SceneEstimate, Selection, log_normal
from .planar_geometry import normal, tangent
from .sensor_array import EchoPaths


class CircleFit(NamedTuple):
    """ONE selected reflector as a circle."""

    circle: Float[Array, "3"]
    """Center x, y and radius, robot frame, metres."""
    covariance: Float[Array, "3 3"]
    """Covariance of these, square metres; it includes the prior of the curvature."""
    score: Float[Array, ""]
    """Evidence above clutter, nats."""
    supported: Bool[Array, " echoes"]
    """Echoes that are more likely echoes of this circle than clutter."""


def fit_circles(
    scan: ScanData,
    selected: Hypotheses,
    selection: Selection,
    clutter: Float[Array, " echoes"],
    scene: SceneEstimate,
    settings: DetectionSettings,
) -> CircleFit:
    """Fit every selected reflector as a circle, to the echoes that the reflectors before it left.

    Args:
        scan: the echoes.
        selected: the selected hypotheses.
        selection: their kinds and echoes.
        clutter: log density of clutter at each echo's range, 1/m.
        scene: detection probability, sigma and threshold.
        settings: prior and steps.
    """
    taken = jnp.cumsum(selection.involved, axis=0) - selection.involved > 0
    left = scan.valid[None] & ~taken
    radius_coordinate = jnp.asarray(settings.circle_starts, scan.ranges.dtype)[selection.kind]
    is_plane = selection.kind == PLANE
    line, point = selected.parameters, selected.parameters
    distance = jnp.sqrt((point**2).sum(-1))
    rho = jnp.where(is_plane, line[:, 0], distance)
    theta = jnp.where(is_plane, line[:, 1], jnp.arctan2(point[:, 1], jnp.where(distance > 0, point[:, 0], 1)))
    start = jnp.stack([rho, theta, radius_coordinate], axis=-1)
    return jax.vmap(lambda x, some: _fit_circle(scan, x, some, clutter, scene, settings))(start, left)


def _curvature(q: Float[Array, ""], distance: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Curvature (1/m) and its derivative by q, which goes from 0 (a plane) to 1 (a pole)."""
    return q / (distance * (1 - q)), 1 / (distance * (1 - q) ** 2)


def _fit_circle(
    scan: ScanData,
    start: Float[Array, "3"],
    left: Bool[Array, " echoes"],
    clutter: Float[Array, " echoes"],
    scene: SceneEstimate,
    settings: DetectionSettings,
) -> CircleFit:
    scale = jnp.maximum(start[0], settings.least_circle_distance)  # of the curvature; constant during the fit
    mean, sd = settings.circle_shape
    prior_information = jnp.zeros((3, 3), start.dtype).at[2, 2].set(1 / sd**2)
    low, high = settings.circle_bounds

    def predict(x: Float[Array, "3"], path: EchoPaths):
        kappa, slope = _curvature(x[2], scale)
        echo = curved_echo(jnp.stack([x[0], x[1], kappa]), path)
        factor = jnp.stack([jnp.ones_like(slope), jnp.ones_like(slope), slope])
        return echo.range, echo.d_range_d_landmark * factor, audibility(_without_derivatives(echo), path, scene.threshold)

    def evaluate(x: Float[Array, "3"]):
        distance, jacobian, visible = jax.vmap(predict, in_axes=(None, -1), out_axes=(-1, -1, -1))(x, scan.echo_paths)
        detection = scene.detection_probability * visible
        residual = scan.ranges - distance
        odds = jnp.log(detection / (1 - detection) + 1e-9) + log_normal(residual, scene.sigma) - clutter
        return jacobian, residual, jnp.where(left, odds, -jnp.inf)

    def step(x: Float[Array, "3"], _: None):
        jacobian, residual, log_ratio = evaluate(x)
        weight = jax.nn.sigmoid(log_ratio) / scene.sigma**2
        information = jnp.einsum("ie,e,je->ij", jacobian, weight, jacobian) + prior_information
        gradient = jnp.einsum("ie,e->i", jacobian, weight * residual) - jnp.stack(
            [jnp.zeros(()), jnp.zeros(()), (x[2] - mean) / sd**2]
        )
        most = settings.max_refinement
        change = jnp.clip(_inverse(information) @ gradient, -most, most)
        change = change.at[2].set(jnp.clip((_inverse(information) @ gradient)[2], -0.3, 0.3))
        x = x + change
        return x.at[2].set(jnp.clip(x[2], low, high)), None

    x, _ = jax.lax.scan(step, start, None, length=settings.circle_steps)
    jacobian, residual, log_ratio = evaluate(x)
    weight = jax.nn.sigmoid(log_ratio) / scene.sigma**2
    information = jnp.einsum("ie,e,je->ij", jacobian, weight, jacobian) + prior_information
    covariance = _inverse(information)
    kappa, slope = _curvature(x[2], scale)
    radius = 1 / kappa

    # Evidence.
    supported = log_ratio > 0
    gain = jnp.where(supported, log_ratio, 0).sum()
    line = jnp.stack([x[0], x[1]])
    hypothesis = Hypotheses(line, information[:2, :2], log_ratio, jnp.zeros_like(residual), residual, jnp.zeros(()))

    def model(_: Float[Array, "2"], path: EchoPaths) -> PredictedEcho:
        return _without_derivatives(curved_echo(jnp.stack([x[0], x[1], kappa]), path))

    strength = 10 * jnp.log10(radius / (radius + jnp.maximum(x[0], settings.least_circle_distance)))
    missed = point_missed_log_likelihood(
        scan, model, jnp.ones(()), hypothesis, scene, settings, strength, jnp.asarray(settings.circle_strength_sd)
    )
    density = settings.expected_circles / (jnp.pi * scan.max_range**2) * (x[0] + radius)
    prior = jnp.log(density) + log_normal(x[2] - mean, jnp.asarray(sd, x.dtype))
    volume = 1.5 * jnp.log(2 * jnp.pi) + 0.5 * jnp.log(_determinant(covariance))
    score = gain + settings.missed_weight_point * missed + settings.prior_weight * prior + volume
    score -= jnp.where(scene.silence_threshold < settings.deaf_threshold, 0, settings.circle_handicap)
    enough = supported.sum() >= settings.min_circle_echoes

    # Center and radius instead of rho, theta, q.
    n, t = normal(x[1]), tangent(x[1])
    d_radius = -(radius**2) * slope
    by_parameters = jnp.stack(
        [jnp.append(n, 0.0), jnp.append((x[0] + radius) * t, 0.0), d_radius * jnp.append(n, 1.0)], axis=-1
    )
    circle = jnp.append((x[0] + radius) * n, radius)
    covariance = by_parameters @ covariance @ by_parameters.T
    return CircleFit(circle, (covariance + covariance.T) / 2, jnp.where(enough, score, -jnp.inf), supported)


def _without_derivatives(echo) -> PredictedEcho:
    zero = jnp.zeros_like(echo.range)
    return PredictedEcho(echo.range, jnp.stack([zero, zero]), echo.departure, echo.arrival, zero, echo.exists)


def _inverse(m: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Inverse of a symmetric positive matrix, scaled to a unit diagonal first."""
    scale = 1 / jnp.sqrt(jnp.maximum(jnp.diagonal(m), 1e-9))
    unit = m * scale[:, None] * scale[None, :] * (1 - jnp.eye(3)) + jnp.eye(3) * (1 + 1e-5)
    a, b, c = unit[0, 1], unit[0, 2], unit[1, 2]
    d = unit[0, 0]
    adjugate = jnp.stack(
        [
            jnp.stack([d * d - c * c, c * b - a * d, a * c - b * d]),
            jnp.stack([c * b - a * d, d * d - b * b, a * b - c * d]),
            jnp.stack([a * c - b * d, a * b - c * d, d * d - a * a]),
        ]
    )
    det = d * (d * d - c * c) - a * (a * d - b * c) + b * (a * c - b * d)
    return adjugate / jnp.maximum(det, 1e-12) * scale[:, None] * scale[None, :]


def _determinant(m: Float[Array, "3 3"]) -> Float[Array, ""]:
    """Determinant of a covariance, at least a tiny one."""
    a, b, c, d, e, f = m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2]
    return jnp.maximum(a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d), 1e-30)
