"""Update of the estimate of the scene between two passes of the maximum-likelihood detector."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..detection_cones import DEAF, echo_level, visibility
from ..detection_cones import SETTINGS as CONES
from ..measurement_model import CORNER, PLANE, plane_echo
from ..sensor_array import EchoPaths
from .likelihood import alignment_ratio
from .settings import DetectionSettings
from .state import Hypotheses, ScanData, SceneEstimate, Selection, count


def update_scene(
    scan: ScanData,
    selected: Hypotheses,
    selection: Selection,
    scene: SceneEstimate,
    sigma: Float[Array, ""],
    settings: DetectionSettings,
) -> SceneEstimate:
    """Estimate walls, detection probability, sigma and alignment from the selected reflectors, for the next pass.

    Args:
        scan: the echoes.
        selected: the selected hypotheses.
        selection: their kinds and echoes.
        scene: the previous estimate.
        sigma: standard deviation of the ranges, metres; NaN: it is estimated.
        settings: priors and bounds.
    """
    involved = selection.involved
    wall = (selection.kind == PLANE) & (selection.evidence > -jnp.inf)
    covariance = jax.vmap(lambda one: one.covariance)(selected)

    # Detection probability: of the paths well inside both cones and between the outermost footpoints of a wall.
    margin = settings.footpoint_margin
    low = jnp.where(involved, selected.footpoint, jnp.inf).min(axis=1) + margin
    high = jnp.where(involved, selected.footpoint, -jnp.inf).max(axis=1) - margin

    def is_certain(line: Float[Array, "2"], low: Float[Array, ""], high: Float[Array, ""], path: EchoPaths):
        echo = plane_echo(line, path)
        in_range = echo.range < scan.max_range - settings.range_margin - 2 * scene.sigma
        between = (echo.footpoint > low) & (echo.footpoint < high)
        return in_range & between & (visibility(echo, path) > settings.certain_visibility)

    each_path = jax.vmap(jax.vmap(is_certain, in_axes=(None, None, None, -1)), in_axes=(0, 0, 0, None))
    certain = each_path(selected.parameters, low, high, scan.paths) & wall[:, None]
    certain = certain if scan.measured is None else certain & scan.measured[None]
    expected, received = count(certain), count(certain[:, scan.path_index] & involved)
    weight = settings.detection_weight
    detection = (weight * settings.detection_probability + received) / (weight + expected)

    extent = jnp.stack([low, high], axis=-1)
    scene = scene._replace(detection_probability=jnp.clip(detection, *settings.detection_bounds))
    of_walls = involved & wall[:, None]
    threshold = estimate_threshold(scan, selected.parameters, extent, of_walls, scene, settings)

    # Sigma: residuals of the walls, minus two degrees of freedom for each wall.
    enough = wall & (involved.sum(axis=1) >= settings.min_echoes_for_sigma)
    squares = jnp.where(involved & enough[:, None], selected.residual**2, 0).sum()
    degrees_of_freedom = count(involved & enough[:, None]) - 2 * count(enough)
    prior_squares = settings.sigma_weight * scene.sigma**2
    estimate = jnp.sqrt((prior_squares + squares) / (settings.sigma_weight + degrees_of_freedom))

    # Fraction of the walls that are parallel or perpendicular to another one: posterior of each wall, averaged.
    corner = (selection.kind == CORNER) & (selection.evidence > -jnp.inf)
    walls = scene._replace(
        walls=selected.parameters,
        covariance=covariance,
        is_wall=wall,
        extent=extent,
        is_corner=corner,
    )
    ratio = jax.vmap(lambda line, c: alignment_ratio(line, c[1, 1], walls, settings))(selected.parameters, covariance)
    aligned = scene.aligned_fraction * ratio / (1 - scene.aligned_fraction + scene.aligned_fraction * ratio)
    aligned_walls = jnp.where(wall, aligned, 0).sum() + settings.aligned_weight * settings.aligned_fraction
    return walls._replace(
        aligned_fraction=aligned_walls / (count(wall) + settings.aligned_weight),
        sigma=jnp.where(jnp.isfinite(sigma), scene.sigma, jnp.maximum(estimate, settings.min_sigma)),
        threshold=threshold,
        silence_threshold=threshold,
    )


def estimate_threshold(
    scan: ScanData,
    lines: Float[Array, "reflectors 2"],
    extent: Float[Array, "reflectors 2"],
    involved: Bool[Array, "reflectors echoes"],
    scene: SceneEstimate,
    settings: DetectionSettings,
) -> Float[Array, ""]:
    """Most likely level of the faintest echoes of walls that are received outside of the cones, dB.

    Rings of datasheet cones and real transducers differ: a wall is often heard 50 deg off the axis of a 60 deg cone.

    Args:
        scan: the echoes.
        lines: the walls (rho, theta).
        extent: outermost footpoints of their echoes, metres; only paths between them count.
        involved: the echoes of each wall; none in rows that are not walls.
        scene: detection probability and sigma.
        settings: the levels among which to choose.
    """

    def one(line: Float[Array, "2"], extent: Float[Array, "2"], path: EchoPaths):
        echo = plane_echo(line, path)
        in_range = echo.exists & (echo.range < scan.max_range - settings.range_margin - 2 * scene.sigma)
        between = (echo.footpoint > extent[0]) & (echo.footpoint < extent[1])
        outside = in_range & between & (visibility(echo, path) < settings.outside_cones)
        return outside, echo_level(echo, path)

    each_path = jax.vmap(jax.vmap(one, in_axes=(None, None, -1)), in_axes=(0, 0, None))
    outside, level = each_path(lines, extent, scan.paths)
    outside = outside if scan.measured is None else outside & scan.measured[None]
    heard = jnp.zeros_like(outside).at[:, scan.path_index].max(involved)
    grid = jnp.asarray((DEAF, *settings.thresholds), level.dtype)
    audible = jax.nn.sigmoid((level[..., None] - grid[None, None]) / CONES.level_sd)
    stray = settings.stray_probability
    probability = stray + (scene.detection_probability - 2 * stray) * audible
    log_likelihood = jnp.where(heard[..., None], jnp.log(probability), jnp.log(1 - probability))
    total = jnp.where(outside[..., None], log_likelihood, 0).sum((0, 1))
    return grid[total.argmax()]
