"""Likelihood and prior of the maximum-likelihood detector.

Likelihood: received echoes, missed detections and second-order clutter. Prior: walls tend to be parallel or
perpendicular to each other, corners are where two walls meet, edges where a wall ends. The walls are those of the
previous pass over the scan.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..detection_cones import DEAF, audibility, echo_level
from ..measurement_model import CORNER, PLANE, corner_echo, echo_of_kind, plane_echo, second_order_echo
from ..planar_geometry import normal, tangent, wrap_angle
from ..sensor_array import EchoPaths
from .settings import DetectionSettings
from .state import Hypotheses, Model, ScanData, SceneEstimate, count, log_normal, regularized_inverse


def clutter_log_density(scan: ScanData, scene: SceneEstimate, settings: DetectionSettings) -> Float[Array, " echoes"]:
    """Log density of clutter at each echo's range, 1/m: unexplained echoes and those that two walls reflect."""
    structured = jnp.maximum(_second_order_density(scan, scene, settings), _crosstalk_density(scan, scene, settings))
    return jnp.log(settings.clutter_density + structured)


def _crosstalk_density(scan: ScanData, scene: SceneEstimate, settings: DetectionSettings) -> Float[Array, " echoes"]:
    """Density of the echoes of known walls and corners that come from another transmitter of the firing group, 1/m."""
    if scan.crosstalk is None:
        return jnp.zeros_like(scan.ranges)

    def one(
        parameters: Float[Array, "2"],
        is_corner: Bool[Array, ""],
        path: EchoPaths,
        exists: Bool[Array, ""],
        measured: Float[Array, ""],
    ) -> Float[Array, ""]:
        echo = echo_of_kind(
            jnp.where(is_corner, CORNER, PLANE), plane_echo(parameters, path), corner_echo(parameters, path)
        )
        sd = 2 * scene.sigma + settings.second_order_sd
        heard = audibility(echo, path, scene.threshold) * jnp.exp(log_normal(measured - echo.range, sd))
        return jnp.where(exists, heard, 0)

    each_echo = jax.vmap(one, in_axes=(None, None, -1, -1, -1))
    each_transmitter = jax.vmap(each_echo, in_axes=(None, None, -2, -2, None))
    each_reflector = jax.vmap(each_transmitter, in_axes=(0, 0, None, None, None))
    paths, exists = scan.crosstalk.paths, scan.crosstalk.exists
    density = each_reflector(scene.walls, scene.is_corner, paths, exists, scan.ranges)
    known = (scene.is_wall | scene.is_corner)[:, None, None]
    density = scene.detection_probability * jnp.where(known, density, 0).max(axis=(0, 1))
    return jnp.where(scan.valid, density, 0)


def _second_order_density(scan: ScanData, scene: SceneEstimate, settings: DetectionSettings) -> Float[Array, " echoes"]:
    size = min(len(scene.is_wall), settings.second_order_walls)
    first, second = np.nonzero(~np.eye(size, dtype=bool))

    def pair(first: Float[Array, "2"], second: Float[Array, "2"], known: Bool[Array, ""]) -> Float[Array, " echoes"]:
        def one(path: EchoPaths, measured: Float[Array, ""]) -> Float[Array, ""]:
            echo = second_order_echo(first, second, path)
            sd = 2 * scene.sigma + settings.second_order_sd
            return audibility(echo, path, scene.threshold) * jnp.exp(log_normal(measured - echo.range, sd))

        each_echo = jax.vmap(one, in_axes=-1)
        return jnp.where(known, scene.detection_probability * each_echo(scan.echo_paths, scan.ranges), 0)

    known = scene.is_wall[first] & scene.is_wall[second]
    densities = jax.vmap(pair)(scene.walls[first], scene.walls[second], known)
    return jnp.where(scan.valid, densities.max(axis=0), 0)


def refine(
    scan: ScanData,
    model: Model,
    start: Float[Array, "2"],
    scene: SceneEstimate,
    clutter: Float[Array, " echoes"],
    settings: DetectionSettings,
) -> Hypotheses:
    """Maximum likelihood of ONE reflector: each echo is weighted by its probability of coming from this reflector.

    ``robust_fit.fit_reflector`` finds the start with a robust loss, without a model of clutter and misses.

    Args:
        scan: the echoes.
        model: measurement model of the reflector's kind.
        start: its parameters after the previous pass.
        scene: detection probability and sigma.
        clutter: log density of clutter at each echo's range, 1/m.
        settings: step sizes.
    """

    def predict(x: Float[Array, "2"], path: EchoPaths):
        echo = model(x, path)
        return echo, audibility(echo, path, scene.threshold)

    def step(x: Float[Array, "2"], _: None):
        echo, visible = jax.vmap(predict, in_axes=(None, -1), out_axes=-1)(x, scan.echo_paths)
        detection = scene.detection_probability * visible
        residual, (a, b) = scan.ranges - echo.range, echo.d_range_d_landmark
        odds = jnp.log(detection / (1 - detection) + 1e-9) + log_normal(residual, scene.sigma) - clutter
        log_ratio = jnp.where(scan.valid, odds, -jnp.inf)
        weight = jax.nn.sigmoid(log_ratio) / scene.sigma**2
        aa, ab, bb = (weight * a * a).sum(), (weight * a * b).sum(), (weight * b * b).sum()
        information = jnp.stack([jnp.stack([aa, ab]), jnp.stack([ab, bb])])
        gradient = jnp.stack([(weight * residual * a).sum(), (weight * residual * b).sum()])
        most = settings.max_refinement
        x = x + jnp.clip(regularized_inverse(information) @ gradient, -most, most)
        return x, (information, log_ratio, echo.footpoint, residual)

    x, steps = jax.lax.scan(step, start, None, length=settings.refinement_steps)
    # Values before the last step, which is tiny.
    information, log_ratio, footpoint, residual = jax.tree.map(lambda leaf: leaf[-1], steps)
    return Hypotheses(x, information, log_ratio, footpoint, residual, jnp.zeros(()))


class MissedDetections(NamedTuple):
    """What every path should receive of ONE reflector, and the echoes that explain why some of them did."""

    footpoint: Float[Array, " paths"]
    """As ``PredictedEcho``."""
    visibility: Float[Array, " paths"]
    """Weight by both cones; 0 beyond the maximum range and for paths that were not measured."""
    loss: Float[Array, " paths"]
    """Minus the level of the echo (``detection_cones.echo_level``), dB."""
    cost: Float[Array, " paths"]
    """Log probability that the path receives no echo, nats."""
    echo_footpoint: Float[Array, " echoes"]
    """As ``footpoint``, for the path of each echo."""
    echo_loss: Float[Array, " echoes"]
    """As ``loss``, for the path of each echo."""
    excuse: Float[Array, " echoes"]
    """Cost that each echo cancels, nats: it is the echo of this reflector, or its blanking hides that echo."""

    def total(self, paths: Bool[Array, " paths"], echoes: Bool[Array, " echoes"]) -> Float[Array, ""]:
        """Log likelihood of the missed detections of some of the paths, at most 0 nats."""
        return jnp.minimum(jnp.where(paths, self.cost, 0).sum() - jnp.where(echoes, self.excuse, 0).sum(), 0)


def missed_detections(
    scan: ScanData, model: Model, reflector: Hypotheses, scene: SceneEstimate, settings: DetectionSettings
) -> MissedDetections:
    """Predict what every path should receive of ONE reflector."""

    def predict(path: EchoPaths):
        echo = model(reflector.parameters, path)
        in_range = echo.range < scan.max_range - settings.range_margin - 2 * scene.sigma
        visible = jnp.where(in_range, audibility(echo, path, scene.silence_threshold), 0)
        cost = jnp.log(1 - scene.detection_probability * visible)
        return echo.range, echo.footpoint, visible, -echo_level(echo, path), cost

    each_path = jax.vmap(predict, in_axes=-1, out_axes=-1)
    _, footpoint, visible, loss, cost = each_path(scan.paths)
    if scan.measured is not None:
        visible, cost = jnp.where(scan.measured, visible, 0), jnp.where(scan.measured, cost, 0)
    predicted, echo_footpoint, _, echo_loss, echo_cost = each_path(scan.echo_paths)
    behind, gate = scan.ranges - predicted, settings.excuse_gate * scene.sigma
    excused = scan.valid & (behind < gate) & (behind > -settings.blanking_distance - gate)
    excuse = jnp.where(excused, echo_cost, 0)
    return MissedDetections(footpoint, visible, loss, cost, echo_footpoint, echo_loss, excuse)


def point_missed_log_likelihood(
    scan: ScanData,
    model: Model,
    is_edge: Float[Array, ""],
    point: Hypotheses,
    scene: SceneEstimate,
    settings: DetectionSettings,
    strength: tuple[Float[Array, ""] | float, float],
) -> Float[Array, ""]:
    """Log likelihood of the missed detections of ONE corner (0) or edge (1), at most 0 nats.

    Args:
        scan: the echoes.
        model: its measurement model.
        is_edge: 0 for a corner, which returns as much sound as a wall; 1 for an edge, a pole or a circle.
        point: the reflector.
        scene: detection probability, sigma and thresholds.
        settings: weights.
        strength: mean and standard deviation of the level of what returns less sound than a wall, dB relative to it.
    """
    missed = missed_detections(scan, model, point, scene, settings)
    # A faint edge is received near the axes only: up to the highest loss among its echoes.
    border = jnp.where(point.log_ratio > 0, missed.echo_loss, -jnp.inf).max() + settings.loss_margin
    border = jnp.where(is_edge > 0, border, jnp.inf)
    inside = missed.total(missed.loss < border, missed.echo_loss < border)
    outside = missed.total(missed.loss >= border, missed.echo_loss >= border)
    # The border also tells how much less sound than a wall it returns.
    mean, sd = strength
    most = settings.max_strength_deviation
    deviation = jnp.clip((border + scene.silence_threshold - mean) / sd, -most, most)
    faintness = jnp.where(hears_outside_cones(scene) & (is_edge > 0), -0.5 * deviation**2, 0)
    inside = jnp.maximum(inside, -_max_occlusion_cost(scene, settings))
    return inside + jnp.maximum(outside, -settings.max_faint_edge_cost) + faintness


def hears_outside_cones(scene: SceneEstimate) -> Bool[Array, ""]:
    """Whether the scan has echoes of walls outside of the cones, as far as known."""
    return scene.silence_threshold < DEAF


def _max_occlusion_cost(scene: SceneEstimate, settings: DetectionSettings) -> Float[Array, ""]:
    outside = hears_outside_cones(scene)
    return jnp.where(outside, settings.max_occlusion_cost_outside, settings.max_occlusion_cost)


def plane_missed_log_likelihood(
    scan: ScanData, plane: Hypotheses, scene: SceneEstimate, settings: DetectionSettings
) -> Float[Array, ""]:
    """Log likelihood of the missed detections of ONE wall, at most 0 nats.

    The wall may end beyond the outermost footpoints of its echoes, before the next footpoint without an echo.
    """
    missed = missed_detections(scan, plane_echo, plane, scene, settings)
    footpoint, echo_footpoint, own = missed.footpoint, missed.echo_footpoint, plane.log_ratio > 0
    low, high = jnp.where(own, plane.footpoint, jnp.inf).min(), jnp.where(own, plane.footpoint, -jnp.inf).max()
    inside = missed.total((footpoint >= low) & (footpoint <= high), (echo_footpoint >= low) & (echo_footpoint <= high))
    total = jnp.maximum(inside, -_max_occlusion_cost(scene, settings))
    for gap, echo_gap in ((low - footpoint, low - echo_footpoint), (footpoint - high, echo_footpoint - high)):
        silent = (missed.visibility > settings.gap_visibility) & (gap > settings.footpoint_margin)
        next_silent = jnp.where(silent, gap, jnp.inf).min()
        ends = jnp.log(jnp.clip(next_silent, settings.min_gap, settings.wall_length) / settings.wall_length)
        beyond = jnp.maximum(missed.total(gap > 0, echo_gap > 0), ends)
        total += jnp.where(jnp.isfinite(next_silent), beyond, 0)
    return total


def plane_log_prior(
    scan: ScanData, plane: Hypotheses, scene: SceneEstimate, settings: DetectionSettings
) -> Float[Array, ""]:
    """Log density of ONE plane, nats: uniform in rho and theta, aligned with other walls, not across their corners."""
    rho, theta = plane.parameters
    density = jnp.log(settings.expected_planes / (2 * jnp.pi * scan.max_range))
    turn = wrap_angle(scene.walls[:, 1] - theta)
    distance = scene.walls[:, 0] - normal(scene.walls[:, 1]) @ (rho * normal(theta))
    crossing = (scene.is_wall & (jnp.abs(distance) < settings.crossing_distance) & _oblique(turn, settings)).any()
    alignment = alignment_ratio(plane.parameters, plane.covariance[1, 1], scene, settings)
    direction = jnp.log(1 - scene.aligned_fraction + scene.aligned_fraction * alignment)
    # Sound does not pass through walls: the outermost points of reflection must not be behind another one.
    own = plane.log_ratio > 0
    ends = jnp.stack([jnp.where(own, plane.footpoint, jnp.inf).min(), jnp.where(own, plane.footpoint, -jnp.inf).max()])
    ends = jnp.where(own.any(), ends, 0)
    points = (rho * normal(theta))[None] + ends[:, None] * tangent(theta)[None]
    occluded = (is_behind(points[0], scene, settings) & is_behind(points[1], scene, settings)).any()
    penalty = jnp.where(crossing, settings.crossing_penalty, 0) + jnp.where(occluded, settings.occluded_penalty, 0)
    return density + (direction - penalty)


def is_behind(point: Float[Array, "2"], scene: SceneEstimate, settings: DetectionSettings) -> Bool[Array, " walls"]:
    """Known walls that the line from the origin to ONE point crosses between their outermost echoes."""
    n, t = normal(scene.walls[:, 1]), tangent(scene.walls[:, 1])
    depth, along = n @ point, t @ point
    behind = depth > scene.walls[:, 0] + settings.same_wall_rho
    crossing = along * scene.walls[:, 0] / jnp.where(behind, depth, 1)
    margin = settings.occlusion_margin
    between = (crossing > scene.extent[:, 0] - margin) & (crossing < scene.extent[:, 1] + margin)
    return scene.is_wall & behind & between


def alignment_ratio(
    line: Float[Array, "2"], variance: Float[Array, ""], scene: SceneEstimate, settings: DetectionSettings
) -> Float[Array, ""]:
    """Likelihood ratio of ONE wall's direction: parallel or perpendicular to another wall, against uniform.

    Args:
        line: rho, theta.
        variance: of theta, square radians.
        scene: the other walls; with none of them the ratio is 1.
        settings: tolerances.
    """
    turn = wrap_angle(scene.walls[:, 1] - line[1])
    same = jnp.abs(scene.walls[:, 0] - line[0]) < settings.same_wall_rho
    same &= jnp.abs(turn) < settings.same_wall_theta
    deviation = jnp.abs(jnp.mod(turn + jnp.pi / 4, jnp.pi / 2) - jnp.pi / 4)  # from the nearest multiple of 90 deg
    sd = jnp.sqrt(variance + scene.covariance[:, 1, 1] + settings.aligned_sd**2)
    others = scene.is_wall & ~same
    ratio = jnp.where(others, jnp.exp(log_normal(deviation, sd)) * jnp.pi / 2, 0).max()
    return jnp.where(others.any(), ratio, 1)


def point_log_prior(
    scan: ScanData,
    is_edge: Float[Array, ""],
    point: Hypotheses,
    scene: SceneEstimate,
    settings: DetectionSettings,
) -> Float[Array, ""]:
    """Log density of ONE corner (0) or edge (1), nats: on one or two detected walls, or anywhere."""
    place = point.parameters
    # Density of the point on the line of each wall, by the uncertainties of both.
    n, along = normal(scene.walls[:, 1]), tangent(scene.walls[:, 1]) @ place
    point_variance = jnp.einsum("wi,ij,wj->w", n, point.covariance, n)
    c = scene.covariance
    line_variance = c[:, 0, 0] - 2 * along * c[:, 0, 1] + along**2 * c[:, 1, 1]
    distance = scene.walls[:, 0] - n @ place
    bearing = jnp.arctan2(place[1], jnp.where((place == 0).all(), 1, place[0]))
    # A wall whose foot is this point is the point itself, mistaken for a wall.
    beside = scene.is_wall & _oblique(wrap_angle(scene.walls[:, 1] - bearing), settings)
    sd = jnp.sqrt(point_variance + line_variance + scene.sigma**2)
    on_wall = jnp.where(beside, jnp.exp(log_normal(distance, sd)), 0)
    # Edges: anywhere, or on the line of a wall.
    anywhere = 1 / (jnp.pi * scan.max_range**2)
    on_any_wall = on_wall.sum() / (2 * scan.max_range)
    on_mean_wall = on_any_wall / jnp.maximum(count(scene.is_wall), 1)
    isolated = settings.edge_fraction_isolated
    edges = settings.expected_edges * (isolated * anywhere + (1 - isolated) * on_mean_wall)
    # Corners: anywhere, on the line of a wall, or where two perpendicular walls meet.
    angle = jnp.abs(wrap_angle(scene.walls[:, None, 1] - scene.walls[None, :, 1])) - jnp.pi / 2
    variance = c[:, None, 1, 1] + c[None, :, 1, 1] + settings.aligned_sd**2
    perpendicular = angle**2 < settings.right_angle_gate**2 * variance
    on_two_walls = jnp.triu(jnp.where(perpendicular, on_wall[:, None] * on_wall[None, :], 0), 1).sum()
    corners = (
        settings.corner_fraction_isolated * anywhere
        + settings.corner_fraction_one_wall * on_any_wall
        + settings.corner_fraction_two_walls * on_two_walls
    )
    penalty = jnp.where(is_behind(place, scene, settings).any(), settings.occluded_penalty, 0)
    return jnp.log(jnp.where(is_edge > 0, edges, settings.expected_corners * corners)) - penalty


def _oblique(turn: Float[Array, "*any"], settings: DetectionSettings) -> Bool[Array, "*any"]:
    least, most = settings.oblique_angles
    return (jnp.abs(turn) > least) & (jnp.abs(turn) < most)
