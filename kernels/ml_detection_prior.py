"""Prior of the maximum-likelihood detector: where walls, corners and edges are expected before any echo.

Walls tend to be parallel or perpendicular to each other, corners are where two walls meet, edges where a wall ends. The
walls are those of the previous pass over the scan.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .ml_detection_settings import DetectionSettings
from .ml_detection_state import Hypotheses, ScanData, SceneEstimate, count, log_normal
from .planar_geometry import normal, tangent, wrap_angle


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
    return density + (direction - jnp.where(crossing, settings.crossing_penalty, 0))


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
    return jnp.log(jnp.where(is_edge > 0, edges, settings.expected_corners * corners))


def _oblique(turn: Float[Array, "*any"], settings: DetectionSettings) -> Bool[Array, "*any"]:
    least, most = settings.oblique_angles
    return (jnp.abs(turn) > least) & (jnp.abs(turn) < most)
