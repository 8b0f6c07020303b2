"""Circles in the maximum-likelihood detector: selected reflectors are fitted with a curvature as a third parameter.

A wall, a column and a thin pole are one family of reflectors, with curvatures of 0, 1 / radius and infinity. In one
scan, a ring with narrow cones hardly determines the curvature by the ranges. The level down to which the reflector is
heard tells more. Where neither decides, the reflector remains undecided.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..detection_cones import audibility
from ..measurement_model import PLANE, CurvedEcho, PredictedEcho, curved_echo
from ..planar_geometry import length_and_direction, normal, tangent
from ..sensor_array import EchoPaths
from .likelihood import hears_outside_cones, point_missed_log_likelihood
from .settings import DetectionSettings
from .state import Hypotheses, ScanData, SceneEstimate, Selection, log_normal


class CircleFit(NamedTuple):
    """ONE selected reflector as a circle."""

    circle: Float[Array, "3"]
    """Center x, y and radius, robot frame, metres."""
    covariance: Float[Array, "3 3"]
    """Covariance of these, square metres; it includes the prior of the shape."""
    evidence: Float[Array, ""]
    """Nats above clutter; -inf with too few echoes."""


class TangentCircle(NamedTuple):
    """ONE circle by its tangent line and its shape, which is 0 for a plane and 1 for a pole."""

    rho: Float[Array, ""]
    """Distance of the nearest point from the origin, metres."""
    theta: Float[Array, ""]
    """Its direction, radians."""
    shape: Float[Array, ""]
    """distance / (distance + radius), where the distance is ``scale``."""
    scale: Float[Array, ""]
    """A constant of about rho, metres."""

    @property
    def radius(self) -> Float[Array, ""]:
        """Metres."""
        return self.scale * (1 - self.shape) / self.shape

    def echo(self, path: EchoPaths) -> CurvedEcho:
        """What ONE path receives, with derivatives by rho, theta and the curvature."""
        return curved_echo(jnp.stack([self.rho, self.theta, 1 / self.radius]), path)

    def as_circle(self) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        """Center and radius, and their derivatives by rho, theta and shape."""
        n, t, distance = normal(self.theta), tangent(self.theta), self.rho + self.radius
        by_shape = -self.scale / self.shape**2 * jnp.append(n, 1)
        jacobian = jnp.stack([jnp.append(n, 0), jnp.append(distance * t, 0), by_shape], axis=-1)
        return jnp.append(distance * n, self.radius), jacobian


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
        scene: detection probability, sigma and thresholds.
        settings: prior and steps.
    """
    involved = selection.involved.astype(jnp.int32)
    taken = jnp.cumsum(involved, axis=0) > involved
    left = scan.valid[None] & ~taken
    is_plane, first, second = selection.kind == PLANE, *selected.parameters.T
    rho = jnp.where(is_plane, first, jnp.sqrt(first**2 + second**2))
    theta = jnp.where(is_plane, second, jnp.arctan2(second, jnp.where(rho > 0, first, 1)))
    shape = jnp.asarray(settings.circle_starts, rho.dtype)[selection.kind]
    starts = TangentCircle(rho, theta, shape, jnp.maximum(rho, settings.min_circle_distance))
    return jax.vmap(lambda start, some: _fit_circle(scan, start, some, clutter, scene, settings))(starts, left)


def nearest_point(circle: Float[Array, "3"]) -> Float[Array, "2"]:
    """Point of ONE circle (x, y, radius) that is nearest to the origin, metres."""
    distance, direction = length_and_direction(circle[:2])
    return (distance - circle[2]) * direction


class _LinearizedEchoes(NamedTuple):
    """The echoes of a scan as seen by ONE circle."""

    jacobian: Float[Array, "3 echoes"]
    """Derivatives of the ranges by rho, theta and shape."""
    residual: Float[Array, " echoes"]
    """Measured minus predicted range, metres."""
    log_ratio: Float[Array, " echoes"]
    """Log-likelihood ratio between the circle and clutter, nats."""


def _fit_circle(
    scan: ScanData,
    start: TangentCircle,
    left: Bool[Array, " echoes"],
    clutter: Float[Array, " echoes"],
    scene: SceneEstimate,
    settings: DetectionSettings,
) -> CircleFit:
    """Fit ONE circle by Gauss-Newton, each echo weighted by its probability of coming from it."""
    mean, sd = settings.circle_shape
    prior_information = jnp.zeros((3, 3), start.rho.dtype).at[2, 2].set(1 / sd**2)

    def linearize(at: TangentCircle, sigma: Float[Array, ""]) -> _LinearizedEchoes:
        def one(path: EchoPaths):
            echo = at.echo(path)
            d_curvature_d_shape = 1 / (at.scale * (1 - at.shape) ** 2)
            factor = jnp.stack([jnp.ones_like(at.shape), jnp.ones_like(at.shape), d_curvature_d_shape])
            visible = audibility(echo.as_predicted(), path, scene.threshold)
            return echo.range, echo.d_range_d_landmark * factor, visible

        distance, jacobian, visible = jax.vmap(one, in_axes=-1, out_axes=-1)(scan.echo_paths)
        detection, residual = scene.detection_probability * visible, scan.ranges - distance
        odds = jnp.log(detection / (1 - detection) + 1e-9) + log_normal(residual, sigma) - clutter
        return _LinearizedEchoes(jacobian, residual, jnp.where(left, odds, -jnp.inf))

    def normal_equations(at: TangentCircle, echoes: _LinearizedEchoes, sigma: Float[Array, ""]):
        weighted = echoes.jacobian * (jax.nn.sigmoid(echoes.log_ratio) / sigma**2)[None]
        gradient = weighted @ echoes.residual - prior_information[2] * (at.shape - mean)
        return _covariance(weighted @ echoes.jacobian.T + prior_information), gradient

    def step(state: tuple[TangentCircle, Any], sigma: Float[Array, ""]):
        at, _ = state
        echoes = linearize(at, sigma)
        covariance, gradient = normal_equations(at, echoes, sigma)
        largest = jnp.asarray([settings.max_refinement, settings.max_refinement, settings.max_shape_step])
        rho, theta, shape = jnp.clip(covariance @ gradient, -largest, largest)
        shape = jnp.clip(at.shape + shape, *settings.circle_bounds)
        return (at._replace(rho=at.rho + rho, theta=at.theta + theta, shape=shape), (at, echoes, covariance)), None

    # The first steps also reach echoes that the plane or the point did not explain. The last linearization is at the
    # result; in the loop, it is compiled once.
    scales = settings.circle_initial_scale * 0.5 ** jnp.arange(settings.circle_steps, dtype=start.rho.dtype)
    noise = jnp.append(jnp.maximum(scales, scene.sigma), scene.sigma)
    nothing = jnp.zeros_like(scan.ranges)
    unused = start, _LinearizedEchoes(jnp.stack([nothing] * 3), nothing, nothing), prior_information
    (_, (fitted, echoes, covariance)), _ = jax.lax.scan(step, (start, unused), noise)
    circle, jacobian = fitted.as_circle()
    return CircleFit(
        circle=circle,
        covariance=jacobian @ covariance @ jacobian.T,
        evidence=_evidence(scan, fitted, echoes, covariance, scene, settings),
    )


def _evidence(
    scan: ScanData,
    fitted: TangentCircle,
    echoes: _LinearizedEchoes,
    covariance: Float[Array, "3 3"],
    scene: SceneEstimate,
    settings: DetectionSettings,
) -> Float[Array, ""]:
    """Evidence for ONE circle above clutter, nats: echoes, missed detections, prior, volume of the posterior."""
    supported = echoes.log_ratio > 0
    line = jnp.stack([fitted.rho, fitted.theta])
    hypothesis = Hypotheses(
        line, jnp.eye(2), echoes.log_ratio, jnp.zeros_like(echoes.residual), echoes.residual, jnp.zeros(())
    )

    def model(_: Float[Array, "2"], path: EchoPaths) -> PredictedEcho:
        return fitted.echo(path).as_predicted()

    # A convex mirror widens the wave: it is fainter than a wall.
    strength = 10 * jnp.log10(fitted.radius / (fitted.radius + fitted.scale)), settings.circle_strength_sd
    missed = point_missed_log_likelihood(scan, model, jnp.ones(()), hypothesis, scene, settings, strength)
    mean, sd = settings.circle_shape
    # Density of the center, which is uniform over the area within range, by rho and theta.
    density = settings.expected_circles * (fitted.rho + fitted.radius) / (jnp.pi * scan.max_range**2)
    prior = jnp.log(jnp.maximum(density, 1e-9)) + log_normal(fitted.shape - mean, jnp.asarray(sd, density.dtype))
    volume = 1.5 * jnp.log(2 * jnp.pi) + 0.5 * jnp.log(jnp.maximum(jnp.linalg.det(covariance), 1e-30))
    gain = jnp.where(supported, echoes.log_ratio, 0).sum()
    evidence = gain + settings.missed_weight_point * missed + settings.prior_weight * prior + volume
    evidence -= jnp.where(hears_outside_cones(scene), 0, settings.circle_handicap)
    return jnp.where(supported.sum() >= settings.min_circle_echoes, evidence, -jnp.inf)


def _covariance(information: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Inverse of an information matrix, by cofactors of the matrix scaled to a unit diagonal."""
    scale = 1 / jnp.sqrt(jnp.maximum(jnp.diagonal(information), 1.0))
    m = information * scale[:, None] * scale[None] + 1e-5 * jnp.eye(3)
    cofactors = jnp.stack([jnp.cross(m[1], m[2]), jnp.cross(m[2], m[0]), jnp.cross(m[0], m[1])])
    return cofactors / jnp.maximum(m[0] @ cofactors[0], 1e-12) * scale[:, None] * scale[None]
