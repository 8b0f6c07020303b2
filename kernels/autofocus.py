"""How sharply the tangent lines of echoes meet in the accumulator: differentiable in everything that a ring is made of.

Where the ring is described rightly, the curves of all echoes of a wall cross in one cell; wrong offsets, sensor poses
or a wrong speed of sound smear them. Nothing has to be known of the room, and no echo is assigned to a wall.

A power sum of all votes, the usual measure, is ruled by the largest walls. Here every echo is asked how high the
accumulator is along its own arc, and the sum of the logarithms counts each echo alike, however large its wall is.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from . import hough_accumulator as hough
from . import isorange_arcs as arcs
from .array_geometry import SensorArray, echo_paths
from .hough_accumulator import HoughSettings
from .hough_voting import PackedEchoes
from .measurement_model import corrected_range

BLUR_RADIUS = 6
"""Cells on each side that the low pass along rho takes in: three standard deviations of two cells."""
_NORM = 4  # of the occupancies along an arc: near their maximum, yet smooth
_LEAST = 1e-12  # keeps the logarithm finite where all lines of an echo lie beyond the accumulator


def focus_measure(occupancy: Float[Array, "echoes points"], counts: Bool[Array, "echoes points"]) -> Float[Array, ""]:
    """Sum over echoes of the logarithm of the 4-norm of the occupancies that each finds along its arc.

    Args:
        occupancy: of the accumulator at the tangent lines of every echo, votes.
        counts: which of the lines exist; an echo without any adds nothing.
    """
    heard = counts.any(axis=1)
    power = jnp.sum(jnp.where(counts, occupancy, 0) ** _NORM, axis=1)
    return jnp.sum(jnp.where(heard, jnp.log(jnp.where(heard, power, 1) + _LEAST) / _NORM, 0))


def blur(
    votes: Float[Array, "theta rho"], width: Float[Array, ""], settings: HoughSettings
) -> Float[Array, "theta rho"]:
    """Low pass of any width along rho, binomial along theta; both seams kept, any floating-point type.

    Args:
        votes: the accumulator.
        width: standard deviation along rho, cells; data, so that coarse and fine share one program.
        settings: of the accumulator; at least ``BLUR_REACH`` columns.
    """
    columns = settings.rho_cells
    before = jnp.roll(votes[:, :BLUR_RADIUS][:, ::-1], settings.theta_cells // 2, axis=0)
    wide = jnp.concatenate([before, votes, jnp.zeros_like(before)], axis=1)
    steps = jnp.arange(-BLUR_RADIUS, BLUR_RADIUS + 1, dtype=votes.dtype)
    taps = jax.nn.softmax(-((steps / width) ** 2) / 2)
    smooth = sum((taps[k] * wide[:, k : k + columns] for k in range(len(steps))), start=jnp.zeros_like(votes))
    return (jnp.roll(smooth, 1, axis=0) + 2 * smooth + jnp.roll(smooth, -1, axis=0)) / 4


def tangent_lines_of_echoes(
    sensors: SensorArray, echoes: PackedEchoes, *, settings: HoughSettings, points: int
) -> tuple[Float[Array, "echoes points"], Float[Array, "echoes points"], Bool[Array, "echoes points"]]:
    """Tangent lines (rho, theta) at equidistant points of every echo's arc, and which of them exist.

    Args:
        sensors: the ring.
        echoes: (echoes,) of one accumulator; with poses, the lines are in the frame of the poses.
        settings: point pitch.
        points: room for this many points on an arc (``points_of_widest_arc``).

    Returns:
        rho (metres, any sign; 0 where there is no line), theta (radians, any turn), and which lines exist.
    """
    paths = echo_paths(sensors)
    arcs_of_paths = jax.vmap(partial(arcs.arc, pitch=settings.point_pitch, points=points))(paths)

    def one_echo(path: Int[Array, ""], reported: Float[Array, ""], pose: Float[Array, "3"] | None):
        arc: arcs.Arc = jax.tree.map(lambda leaf: leaf[path], arcs_of_paths)
        offset = paths.range_offset[path]
        reach = corrected_range(reported, range_offset=offset, range_scale=sensors.range_scale)
        rho, counts = arcs.tangent_rho(arc, reach, max_range=sensors.max_range)
        theta = arc.theta
        if pose is not None:  # rho + n . (x, y), with the place turned into the robot frame instead of every normal
            cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
            ahead, left = cos * pose[0] + sin * pose[1], cos * pose[1] - sin * pose[0]
            rho = jnp.where(counts, rho + arc.normal_x * ahead + arc.normal_y * left, 0)
            theta = theta + pose[2]
        return rho, theta, counts

    poses = None if echoes.pose is None else 0
    return jax.vmap(one_echo, in_axes=(0, 0, poses))(echoes.path, echoes.range, echoes.pose)


@partial(jax.jit, static_argnames=("settings", "points"))
def ring_focus_measure(
    sensors: SensorArray, echoes: PackedEchoes, width: Float[Array, ""], *, settings: HoughSettings, points: int
) -> Float[Array, ""]:
    """How well the echoes agree on where walls are, in nats: the sum over echoes, one accumulator a row.

    Gather all scans in one row, with the pose of each echo, where poses are trusted; give each scan a row of its own,
    without poses, where they are not. Only differences mean something, between rings and for the same echoes. Moving
    and turning the frame of the poses changes nothing but the places of lines within cells.

    Args:
        sensors: the ring; differentiable in every leaf that is a number.
        echoes: (rows, echoes) packed echoes.
        width: standard deviation of the low pass along rho, cells, up to about ``BLUR_REACH / 3``.
        settings: cells and point pitch. Lines beyond the accumulator meet nothing.
        points: room for this many points on an arc (``points_of_widest_arc``).
    """

    def one_row(row: PackedEchoes) -> Float[Array, ""]:
        rho, theta, counts = tangent_lines_of_echoes(sensors, row, settings=settings, points=points)
        vote = partial(hough.soft_accumulate, rho, theta, settings=settings)
        votes, read = jax.vjp(vote, counts.astype(rho.dtype))
        (occupancy,) = read(blur(votes, width, settings))  # reading between cells is the transpose of voting
        return focus_measure(occupancy, counts)

    return jax.lax.map(one_row, echoes).sum()
