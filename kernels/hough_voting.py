"""From the echoes of scans to highly occupied cells: the compiled step before the labeling (paper, section 4)."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from . import hough_accumulator
from . import isorange_arcs as arcs
from .hough_accumulator import HoughSettings
from .measurement_model import corrected_range
from .sensor_array import EchoPaths, SensorArray, echo_paths

if TYPE_CHECKING:
    AnyArray = Array  # inside the kernels
else:
    AnyArray = np.ndarray | Array  # a compiled function moves NumPy arrays to its device itself
PIECE_POINTS = 16
"""Number of points in a piece of an arc."""


class PackedEchoes(NamedTuple):
    """Echoes of scans: real ones first, then padding. A tuple, because JAX flattens tuples without calling Python."""

    path: Int[AnyArray, "*scans echoes"]
    """Row of the ring's ``paths``; 0 where there is no echo."""
    range: Float[AnyArray, "*scans echoes"]
    """Half path length as reported, metres; NaN where there is no echo."""
    pose: Float[AnyArray, "*scans echoes 3"] | None = None
    """model_from_robot for each echo, where model is the frame of the lines: x, y (metres), theta (radians). None: all
    are the identity."""
    scans_per_row: Float[AnyArray, "*scans"] | None = None
    """Number of scans of all paths to which the measurements of a row amount: a factor of the vote threshold. None:
    one."""
    piece: Int[AnyArray, "*scans pieces"] | None = None
    """Index of each piece of ``PIECE_POINTS`` points within its arc; -1 for unused rows. Pieces save memory and time
    where detection ranges differ in width. None: every echo has the points of the widest arc."""
    owner: Int[AnyArray, "*scans pieces"] | None = None
    """The echo that each piece belongs to; given together with ``piece``."""
    measured: Bool[AnyArray, "*scans paths"] | None = None
    """Paths that were measured, whether or not they received an echo; only these can miss an echo. None: all."""
    path_pose: Float[AnyArray, "*scans paths 3"] | None = None
    """model_from_robot when each path was measured: x, y (metres), theta (radians); ``pose`` has the same poses by
    echo. None: all are the identity."""


class CrosstalkPaths(eqx.Module):
    """Paths on which the sound of other transmitters of a firing group reaches the receiver of each path."""

    paths: EchoPaths
    """(paths, transmitters) their geometry."""
    exists: Bool[Array, "*paths transmitters"]
    """False for padding."""


class RingArcs(eqx.Module):
    """Data that all scans of a ring share: its paths and their arcs, for one set of settings."""

    paths: EchoPaths
    """Geometry of every echo path."""
    arcs: arcs.Arc
    """Equidistant normals on the arcs of every path."""
    theta_rows: Int[Array, "paths points"]
    """Row of the accumulator for each normal."""
    vote_threshold: Float[Array, ""]
    """Occupancy that a highly occupied cell must exceed, votes."""
    range_scale: Float[Array, ""]
    """Speed of sound divided by the speed that the reported ranges assume."""
    max_range: Float[Array, ""]
    """Half path length beyond which echoes are ignored, metres."""
    full_wall_paths: Float[Array, ""]
    """Number of paths that receive an echo of a wide wall."""
    crosstalk: CrosstalkPaths | None = None
    """Paths from the other transmitters of the same firing group; None if all fire alone."""


@partial(jax.jit, static_argnames=("settings", "points"))
def ring_arcs(
    sensors: SensorArray,
    *,
    settings: HoughSettings,
    points: int,
    simultaneous: Int[Array, "paths transmitters"] | None = None,
) -> RingArcs:
    """Equidistant points on the arcs of every path of a ring, and the threshold for its scans.

    Args:
        sensors: the ring.
        settings: point pitch, cells and threshold.
        points: number of points on the widest arc (``points_of_widest_arc``).
        simultaneous: other transmitters that fire at the same time as that of each path; -1 for padding.
    """
    paths = echo_paths(sensors)
    arcs_of_paths = jax.vmap(partial(arcs.arc, pitch=settings.point_pitch, points=points))(paths)
    return RingArcs(
        paths=paths,
        arcs=arcs_of_paths,
        theta_rows=hough_accumulator.theta_row(arcs_of_paths.theta, settings),
        vote_threshold=settings.threshold * hough_accumulator.full_wall_votes(paths, settings),
        range_scale=sensors.range_scale,
        max_range=sensors.max_range,
        full_wall_paths=hough_accumulator.full_wall_paths(paths),
        crosstalk=None if simultaneous is None else _crosstalk_paths(sensors, simultaneous),
    )


def _crosstalk_paths(sensors: SensorArray, simultaneous: Int[Array, "paths transmitters"]) -> CrosstalkPaths:
    rx = jnp.broadcast_to(sensors.rx[:, None], simultaneous.shape)
    of_all = eqx.tree_at(lambda s: (s.tx, s.rx), sensors, (jnp.maximum(simultaneous, 0).ravel(), rx.ravel()))
    paths = jax.tree.map(lambda leaf: leaf.reshape(*simultaneous.shape, *leaf.shape[1:]), echo_paths(of_all))
    return CrosstalkPaths(paths, simultaneous >= 0)


def points_of_widest_arc(beam: Float[np.ndarray, " sensors"], settings: HoughSettings) -> int:
    """Points of the widest arc of a ring, that of the direct path of the widest cone, rounded up to whole pieces."""
    return PIECE_POINTS * max(1, int(np.ceil((np.max(beam) / settings.point_pitch - 1e-6) / PIECE_POINTS)))


class TangentLines(eqx.Module):
    """Tangent lines at the points of echo arcs: of one echo or piece, or of all of ONE scan."""

    rho: Float[Array, "*arcs points"]
    """Distances, metres, any sign."""
    normal_x: Float[Array, "*arcs points"]
    """Cosines of the normals."""
    normal_y: Float[Array, "*arcs points"]
    """Sines of the normals."""
    cell: Int[Array, "*arcs points"]
    """Cells of the accumulator (``hough_accumulator.cell_of``)."""


def tangent_lines(ring: RingArcs, echoes: PackedEchoes, settings: HoughSettings) -> TangentLines:
    """Tangent line at every point of every echo's arc, for ONE scan or several scans gathered in one frame.

    Oracle: ``tangent_lines_in_frame`` of tests/support/oracles.py.
    """

    def one_arc(arc: arcs.Arc, row: Int[Array, " points"], path: Int[Array, ""], echo: Int[Array, ""]) -> TangentLines:
        offset = ring.paths.range_offset[path]
        distance = corrected_range(echoes.range[echo], range_offset=offset, range_scale=ring.range_scale)
        rho, exists = arcs.tangent_rho(arc, distance, max_range=ring.max_range)
        normal_x, normal_y = arc.normal_x, arc.normal_y
        if echoes.pose is not None:  # transform the line from the robot frame to the parent frame of the pose
            pose = echoes.pose[echo]
            cosine, sine = jnp.cos(pose[2]), jnp.sin(pose[2])
            normal_x, normal_y = cosine * normal_x - sine * normal_y, sine * normal_x + cosine * normal_y
            rho = rho + pose[0] * normal_x + pose[1] * normal_y
            row = hough_accumulator.theta_row(arc.theta + pose[2], settings)
        return TangentLines(rho, normal_x, normal_y, hough_accumulator.cell_of(rho, row, exists, settings))

    def whole_arc(echo: Int[Array, ""]) -> TangentLines:
        path = echoes.path[echo]
        arc, row = jax.tree.map(lambda leaf: leaf[path], (ring.arcs, ring.theta_rows))
        return one_arc(arc, row, path, echo)

    if echoes.piece is None or echoes.owner is None:
        return jax.vmap(whole_arc)(jnp.arange(len(echoes.path)))
    pieces = ring.theta_rows.shape[-1] // PIECE_POINTS

    def split(leaf: Array) -> Array:
        return leaf if leaf.ndim == 1 else leaf.reshape(-1, PIECE_POINTS)

    of_pieces = jax.tree.map(split, (ring.arcs, ring.theta_rows))

    def one_piece(piece: Int[Array, ""], echo: Int[Array, ""]) -> TangentLines:
        path = echoes.path[echo]
        index = path * pieces + jnp.maximum(piece, 0)
        arc, row = jax.tree.map(lambda leaf: leaf[path if leaf.ndim == 1 else index], of_pieces)
        arc = eqx.tree_at(lambda a: a.exists, arc, arc.exists & (piece >= 0))
        return one_arc(arc, row, path, echo)

    return jax.vmap(one_piece)(echoes.piece, echoes.owner)


def map_scans(one_scan: Callable, *scans):
    """Map over scans: one after the other on a CPU, where caches are small; all at once on a GPU with many cores."""

    def sequential(*scans):
        return jax.lax.map(lambda scan: one_scan(*scan), scans)

    if jax.default_backend() == "cpu":  # saves tracing the GPU version
        return sequential(*scans)
    return jax.lax.platform_dependent(*scans, cpu=sequential, default=jax.vmap(one_scan))


class Votes(NamedTuple):
    """Votes of a batch of scans after the threshold (paper, section 4)."""

    occupied: Bool[Array, "*scans theta rho"]
    """The highly occupied cells of each scan."""
    cell: Int[Array, "*scans arcs points"]
    """The cell of every point, row * rho_cells + column; one past the last cell for points without a line."""
    rho: Float[Array, "*scans arcs points"]
    """The distance of every point's tangent line, metres, any sign."""


@partial(jax.jit, static_argnames="settings")
def vote(ring: RingArcs, echoes: PackedEchoes, *, settings: HoughSettings) -> Votes:
    """The paper's section 4 up to the threshold, for a batch of scans in one compiled function.

    Args:
        ring: arcs of the ring's paths, and the threshold.
        echoes: (scans, echoes) packed echoes.
        settings: accumulator and low pass.
    """
    # Arcs -> equidistant points -> tangent lines. Elementwise, so all scans at once.
    lines = jax.vmap(lambda scan: tangent_lines(ring, scan, settings))(echoes)
    scan_count = jnp.ones(len(lines.cell)) if echoes.scans_per_row is None else echoes.scans_per_row

    def one_scan(cell: Int[Array, "arcs points"], threshold: Float[Array, ""]) -> Bool[Array, "theta rho"]:
        votes = hough_accumulator.accumulate(cell, settings)  # points per cell
        smooth = hough_accumulator.lowpass(votes, settings)  # balance between neighbor cells
        return smooth > threshold  # highly occupied cells

    return Votes(map_scans(one_scan, lines.cell, ring.vote_threshold * scan_count), lines.cell, lines.rho)


@partial(jax.jit, static_argnames="settings")
def accumulators(
    ring: RingArcs, echoes: PackedEchoes, *, settings: HoughSettings
) -> tuple[Int[Array, "scans theta rho"], Float[Array, "scans theta rho"]]:
    """Votes before and after the low pass, for plots; arguments as ``vote``."""

    def one_scan(scan: PackedEchoes):
        votes = hough_accumulator.accumulate(tangent_lines(ring, scan, settings).cell, settings)
        return votes, hough_accumulator.lowpass(votes, settings)

    return map_scans(one_scan, echoes)


@partial(jax.jit, static_argnames="settings")
def vote_lines(
    rho: Float[Array, "clusters lines"], theta: Float[Array, "clusters lines"], *, settings: HoughSettings
) -> tuple[Bool[Array, "clusters theta rho"], Int[Array, "clusters lines"]]:
    """Highly occupied cells of each cluster of lines: votes, low pass, threshold.

    Args:
        rho: distances from the cluster's origin, metres, any sign; NaN where there is no line.
        theta: directions of the normals, radians.
        settings: the accumulator; its threshold is a number of lines.

    Returns:
        The highly occupied cells, and the flat cell of each line: one past the last cell for NaN and for lines beyond
        the accumulator.
    """

    def one_cluster(lines: tuple[Array, Array]) -> tuple[Array, Array]:
        rho, theta = lines
        known = jnp.isfinite(rho)
        row = hough_accumulator.theta_row(jnp.where(known, theta, 0), settings)
        cell = hough_accumulator.cell_of(jnp.where(known, rho, 0), row, known, settings)
        votes = hough_accumulator.accumulate(cell, settings)
        return hough_accumulator.lowpass(votes, settings) > settings.threshold, cell

    return jax.lax.map(one_cluster, (rho, theta))
