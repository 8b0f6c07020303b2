"""Robust fit of ONE reflector to the echoes around a candidate line: as a plane, as a corner or as an edge.

The Hough transform votes for planes only. A corner or a post is visible from many poses as well, and the tangent lines
of its echoes accumulate almost like those of a wall. The ranges tell them apart: the footpoint of a wall moves along
with the sensor, a point stays where it is. The fit is Gauss-Newton with the loss of Geman and McClure, whose scale is
reduced from step to step (graduated non-convexity), so that echoes of other reflectors lose their weight.

The ranges are those of ``measurement_model``. ``registration.reflector_fit`` fits with the same loss in NumPy, because
it fits a varying number of reflectors, which would be compiled again for every size.
``ml_detection.likelihood.refine`` has no such loss: it weights each echo by its probability of being clutter.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .hough_voting import CrosstalkPaths, PackedEchoes, RingArcs
from .measurement_model import corner_echo, corrected_range, edge_echo, image_source, plane_coordinates
from .planar_geometry import dot, fold_line, length_and_direction, normal, tangent
from .sensor_array import EchoPaths, transform_path


@dataclass(frozen=True)
class RobustFitSettings:
    """Constants of the robust fit; all chosen by hand."""

    steps: int = 8
    """Gauss-Newton steps, each with a smaller scale of the loss."""
    initial_scale: float = 4.0
    """Scale of the loss in the first step, in tolerances."""
    cone_margin: float = 0.05
    """Angle beyond its nominal cone at which a sensor may still have received an echo, radians."""
    max_step: float = 0.1
    """Largest change of a parameter in one step, metres or radians."""
    damping: float = 1e-4
    """Levenberg-Marquardt damping, relative to the trace of the normal matrix."""


SETTINGS = RobustFitSettings()
_MIN_HEIGHT = 1e-9  # m; avoids a division by zero if the virtual sensor is on the plane


class RangeAndBearing(NamedTuple):
    """The part of ``measurement_model.PredictedEcho`` that the fit needs: fewer arrays in its innermost loop."""

    range: Float[Array, ""]
    """Half the path length, metres."""
    d_range_d_landmark: Float[Array, "2"]
    """Derivatives with respect to the two parameters."""
    bearing: Float[Array, "2"]
    """Unit vector from the virtual sensor to the reflector."""


class CandidateFits(eqx.Module):
    """Planes and points fitted to the echoes around candidate lines; see ``fit_candidates``."""

    rho: Float[Array, "*lines"]
    """Distance of the fitted plane, metres, >= 0."""
    theta: Float[Array, "*lines"]
    """Direction of its normal, radians."""
    explained: Bool[Array, "*lines echoes"]
    """Echoes whose residual from the plane is within the tolerance."""
    footpoint: Float[Array, "*lines echoes"]
    """Footpoint of each echo's virtual sensor on the plane: coordinate along it, metres from the foot of the origin."""
    plane_score: Float[Array, "*lines"]
    """Sum over the echoes of max(0, 1 - (residual / tolerance)^2): how much the plane explains."""
    point_score: Float[Array, "*lines"]
    """The same for the better one of a corner and an edge."""


def paths_and_ranges(ring: RingArcs, echoes: PackedEchoes) -> tuple[EchoPaths, Float[Array, " echoes"]]:
    """Geometry of the path of every echo of ONE scan, in the frame of its poses, and the corrected ranges.

    Returns:
        Paths with a leading axis of echoes; ranges in metres, 0 where there is no echo within the maximum range.
    """
    paths = jax.tree.map(lambda leaf: leaf[echoes.path], ring.paths)
    ranges = jax.vmap(partial(corrected_range, range_scale=ring.range_scale))(
        echoes.range, range_offset=paths.range_offset
    )
    if echoes.pose is not None:
        paths = jax.vmap(transform_path)(paths, echoes.pose)
    return paths, jnp.where((ranges > 0) & (ranges < ring.max_range), ranges, 0)


def crosstalk_of_echoes(ring: RingArcs, echoes: PackedEchoes) -> CrosstalkPaths | None:
    """Paths of other transmitters to the receiver of every echo of ONE scan: axes (transmitters, echoes) last."""
    if ring.crosstalk is None:
        return None
    found = jax.tree.map(lambda leaf: leaf[echoes.path], ring.crosstalk)
    if echoes.pose is not None:
        moved = jax.vmap(jax.vmap(transform_path, in_axes=(0, None)))(found.paths, echoes.pose)
        found = eqx.tree_at(lambda f: f.paths, found, moved)
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, (0, 1), (-1, -2)), found)


def fit_reflector(
    model: Callable[[Float[Array, "2"], EchoPaths], RangeAndBearing],
    start: Float[Array, "2"],
    paths: EchoPaths,
    ranges: Float[Array, " echoes"],
    *,
    tolerance: float | Float[Array, ""],
    initial_scale: float | Float[Array, ""] | None = None,
) -> tuple[Float[Array, "2"], Float[Array, " echoes"]]:
    """Robust Gauss-Newton fit of ONE reflector with two parameters to the echoes of ONE scan.

    Args:
        model: ``plane_from_both_sides``, ``corner_from_midpoint`` or ``edge_from_midpoint``.
        start: first guess.
        paths: (echoes,) path of every echo, those of other reflectors included.
        ranges: corrected ranges, metres; 0 where there is no echo.
        tolerance: largest residual of an explained echo, metres; also the last scale of the loss.
        initial_scale: scale of the loss in the first step, metres; default: a multiple of the tolerance.

    Returns:
        The parameters, and for every echo max(0, 1 - (residual / tolerance)^2).
    """
    # The axis of echoes comes last, so that loops over the echoes are contiguous in memory.
    last = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), paths)
    cone_axis = normal(paths.start + paths.width / 2).T
    min_cosine = jnp.cos(jnp.minimum(paths.width / 2 + SETTINGS.cone_margin, jnp.pi))

    def residuals(x):
        def one(path: EchoPaths, measured, cone_axis, min_cosine):
            predicted, gradient, bearing = model(x, path)
            visible = (measured > 0) & (dot(bearing, cone_axis) >= min_cosine)
            return visible, measured - predicted, gradient

        return jax.vmap(one, in_axes=-1, out_axes=-1)(last, ranges, cone_axis, min_cosine)

    def step(x, scale):
        visible, residual, (along, across) = residuals(x)
        root = jnp.where(visible, 1 / (1 + (residual / scale) ** 2), 0)
        weight = root * root
        weighted = weight * residual
        xx, xy, yy = ((weight * a * b).sum() for a, b in ((along, along), (along, across), (across, across)))
        gx, gy = (along * weighted).sum(), (across * weighted).sum()
        damping = SETTINGS.damping * (xx + yy) + 1e-9
        xx, yy = xx + damping, yy + damping
        change = jnp.stack([yy * gx - xy * gy, xx * gy - xy * gx]) / (xx * yy - xy * xy)
        return x + jnp.clip(change, -SETTINGS.max_step, SETTINGS.max_step), None

    initial_scale = SETTINGS.initial_scale * tolerance if initial_scale is None else initial_scale
    scales = tolerance * (initial_scale / tolerance) ** jnp.linspace(1, 0, SETTINGS.steps, dtype=start.dtype)
    x, _ = jax.lax.scan(step, start, scales)
    visible, residual, _ = residuals(x)
    return x, jnp.where(visible, jnp.maximum(1 - (residual / tolerance) ** 2, 0), 0)


def plane_from_both_sides(line: Float[Array, "2"], path: EchoPaths) -> RangeAndBearing:
    """Range of a wall (rho, theta), visible from both of its sides: in a window the robot may drive past its line.

    It differs from ``measurement_model.plane_echo`` in this only.
    """
    here = plane_coordinates(line, path.midpoint, path.half_baseline)
    height = jnp.where(jnp.abs(here.height) < _MIN_HEIGHT, _MIN_HEIGHT, here.height)
    distance, gradient, _, _ = image_source(here._replace(height=height))
    return RangeAndBearing(distance, gradient, jnp.where(height >= 0, here.normal, -here.normal))


def corner_from_midpoint(point: Float[Array, "2"], path: EchoPaths) -> RangeAndBearing:
    """``measurement_model.corner_echo`` of a corner (x, y), with the bearing from the virtual sensor."""
    echo = corner_echo(point, path)
    return RangeAndBearing(echo.range, echo.d_range_d_landmark, echo.arrival)


def edge_from_midpoint(point: Float[Array, "2"], path: EchoPaths) -> RangeAndBearing:
    """``measurement_model.edge_echo`` of an edge (x, y), with the bearing from the virtual sensor."""
    echo = edge_echo(point, path)
    return RangeAndBearing(echo.range, echo.d_range_d_landmark, length_and_direction(point - path.midpoint)[1])


def start_of_point(
    line: Float[Array, "2"], midpoint: Float[Array, "echoes 2"], score: Float[Array, " echoes"]
) -> Float[Array, "2"]:
    """First guess of a corner or an edge: the center of what a fitted plane explains, metres."""
    footpoint = midpoint @ tangent(line[1])
    mean = (score * footpoint).sum() / jnp.maximum(score.sum(), 1e-6)
    return line[0] * normal(line[1]) + mean * tangent(line[1])


@partial(jax.jit, static_argnames="tolerance")
def fit_candidates(
    ring: RingArcs,
    echoes: PackedEchoes,
    rho: Float[Array, "scans lines"],
    theta: Float[Array, "scans lines"],
    *,
    tolerance: float,
) -> CandidateFits:
    """Fit a plane, a corner and an edge to the echoes around every candidate line of a batch of scans.

    Args:
        ring: arcs of the ring's paths.
        echoes: (scans, echoes) packed echoes.
        rho: distances of the candidates, metres; NaN where there is none.
        theta: directions of their normals, radians.
        tolerance: largest residual of an explained echo, metres.
    """

    def one_scan(scan: PackedEchoes, rho: Float[Array, " lines"], theta: Float[Array, " lines"]) -> CandidateFits:
        paths, ranges = paths_and_ranges(ring, scan)

        def one_candidate(rho: Float[Array, ""], theta: Float[Array, ""]) -> CandidateFits:
            line, score = fit_reflector(
                plane_from_both_sides, jnp.stack([rho, theta]), paths, ranges, tolerance=tolerance
            )
            start = start_of_point(line, paths.midpoint, score)
            points = [
                fit_reflector(model, start, paths, ranges, tolerance=tolerance)[1].sum()
                for model in (corner_from_midpoint, edge_from_midpoint)
            ]
            rho, theta = fold_line(line[0], line[1])
            footpoint = paths.midpoint @ tangent(theta)
            return CandidateFits(rho, theta, score > 0, footpoint, score.sum(), jnp.maximum(*points))

        return jax.vmap(one_candidate)(rho, theta)

    return jax.lax.map(lambda one: one_scan(*one), (echoes, rho, theta))
