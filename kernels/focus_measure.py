"""Focus measure of a ring: how sharply the tangent lines of its echoes intersect in the accumulator.

If the parameters of the ring are right, the curves of all echoes of a wall cross in one cell. Wrong range offsets,
sensor poses or a wrong speed of sound blur them. No map is needed, and no echo is associated with a wall. The measure
is differentiable in all parameters of the ring.

A power sum of all votes, the usual focus measure, is dominated by the largest walls. Here the accumulator is evaluated
along the arc of every echo, and the sum of the logarithms gives all echoes the same weight.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from . import hough_accumulator as hough
from . import isorange_arcs as arcs
from .hough_accumulator import HoughSettings
from .hough_voting import PackedEchoes
from .measurement_model import corrected_range
from .planar_geometry import rotate_back
from .sensor_array import SensorArray, echo_paths


@dataclass(frozen=True)
class FocusSettings:
    """Constants of the focus measure; all chosen by hand."""

    blur_radius: int = 6
    """Cells on each side that the low pass along rho covers: three standard deviations of two cells."""
    norm: int = 4
    """Exponent of the norm of the occupancies along an arc: close to their maximum, but smooth."""
    floor: float = 1e-12
    """Added to the power sum of an echo, so that its logarithm is finite if all lines are outside the accumulator."""


SETTINGS = FocusSettings()


def focus_measure(occupancy: Float[Array, "echoes points"], exists: Bool[Array, "echoes points"]) -> Float[Array, ""]:
    """Sum over echoes of the logarithm of the 4-norm of the occupancies along the arc of each.

    Args:
        occupancy: of the accumulator at the tangent lines of every echo, votes.
        exists: which of the lines exist; an echo without lines adds nothing.
    """
    valid = exists.any(axis=1)
    power = jnp.sum(jnp.where(exists, occupancy, 0) ** SETTINGS.norm, axis=1)
    log_power = jnp.log(jnp.where(valid, power, 1) + SETTINGS.floor)
    return jnp.sum(jnp.where(valid, log_power / SETTINGS.norm, 0))


def blur(
    votes: Float[Array, "theta rho"], width: Float[Array, ""], settings: HoughSettings
) -> Float[Array, "theta rho"]:
    """Low pass, Gaussian of any width along rho, binomial along theta; across both seams, in any precision.

    Args:
        votes: the accumulator.
        width: standard deviation along rho, cells; not static, so that all widths share one program.
        settings: of the accumulator; at least ``FocusSettings.blur_radius`` columns.
    """
    columns, radius = settings.rho_cells, SETTINGS.blur_radius
    before = jnp.roll(votes[:, :radius][:, ::-1], settings.theta_cells // 2, axis=0)
    wide = jnp.concatenate([before, votes, jnp.zeros_like(before)], axis=1)
    steps = jnp.arange(-radius, radius + 1, dtype=votes.dtype)
    taps = jax.nn.softmax(-((steps / width) ** 2) / 2)
    smooth = sum((taps[k] * wide[:, k : k + columns] for k in range(len(steps))), start=jnp.zeros_like(votes))
    return (jnp.roll(smooth, 1, axis=0) + 2 * smooth + jnp.roll(smooth, -1, axis=0)) / 4


def tangent_lines_of_echoes(
    sensors: SensorArray, echoes: PackedEchoes, *, settings: HoughSettings, points: int
) -> tuple[Float[Array, "echoes points"], Float[Array, "echoes points"], Bool[Array, "echoes points"]]:
    """Tangent lines (rho, theta) at equidistant points of every echo's arc.

    Args:
        sensors: the ring.
        echoes: (echoes,) of one accumulator; with poses, the lines are in the parent frame of the poses.
        settings: point pitch.
        points: number of points on the widest arc (``points_of_widest_arc``).

    Returns:
        rho (metres, any sign; 0 where there is no line), theta (radians, not wrapped), and which lines exist.
    """
    paths = echo_paths(sensors)
    arcs_of_paths = jax.vmap(partial(arcs.arc, pitch=settings.point_pitch, points=points))(paths)

    def one_echo(path: Int[Array, ""], reported: Float[Array, ""], pose: Float[Array, "3"] | None):
        arc: arcs.Arc = jax.tree.map(lambda leaf: leaf[path], arcs_of_paths)
        offset = paths.range_offset[path]
        distance = corrected_range(reported, range_offset=offset, range_scale=sensors.range_scale)
        rho, exists = arcs.tangent_rho(arc, distance, max_range=sensors.max_range)
        theta = arc.theta
        if pose is not None:  # rho + n . (x, y): rotating the position is cheaper than rotating every normal
            forward, left = rotate_back(pose[:2], pose[2])
            rho = jnp.where(exists, rho + arc.normal_x * forward + arc.normal_y * left, 0)
            theta = theta + pose[2]
        return rho, theta, exists

    poses = None if echoes.pose is None else 0
    return jax.vmap(one_echo, in_axes=(0, 0, poses))(echoes.path, echoes.range, echoes.pose)


@partial(jax.jit, static_argnames=("settings", "points"))
def ring_focus_measure(
    sensors: SensorArray, echoes: PackedEchoes, width: Float[Array, ""], *, settings: HoughSettings, points: int
) -> Float[Array, ""]:
    """Sum of the focus measures of several accumulators, one for each row of echoes, nats.

    If the poses are accurate, gather all scans in one row, with the pose of each echo; otherwise give each scan its own
    row without poses. Only differences between rings for the same echoes are meaningful. The result does not depend on
    the frame of the poses, except for the positions of lines within cells.

    Args:
        sensors: the ring; the measure is differentiable in every leaf of a floating-point type.
        echoes: (rows, echoes) packed echoes.
        width: standard deviation of the low pass along rho, cells, at most a third of ``FocusSettings.blur_radius``.
        settings: cells and point pitch; lines beyond the accumulator are ignored.
        points: number of points on the widest arc (``points_of_widest_arc``).
    """

    def one_row(row: PackedEchoes) -> Float[Array, ""]:
        rho, theta, exists = tangent_lines_of_echoes(sensors, row, settings=settings, points=points)
        vote = partial(hough.soft_accumulate, rho, theta, settings=settings)
        votes, interpolate = jax.vjp(vote, exists.astype(rho.dtype))
        # Interpolation between cells is the transpose of voting.
        (occupancy,) = interpolate(blur(votes, width, settings))
        return focus_measure(occupancy, exists)

    return jax.lax.map(one_row, echoes).sum()
