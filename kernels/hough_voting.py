"""From the echoes of scans to highly occupied cells: the jitted step before the component labelling (section 4)."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from . import hough_accumulator as hough
from . import isorange_arcs as arcs
from .array_geometry import EchoPaths, SensorArray, echo_paths, transform_path
from .hough_accumulator import HoughSettings
from .measurement_model import corrected_range

if TYPE_CHECKING:
    AnyArray = Array  # what kernels see
else:
    AnyArray = np.ndarray | Array  # a compiled step takes NumPy arrays to where it runs
PIECE_POINTS = 16
"""Points in a piece of an arc."""


class PackedEchoes(NamedTuple):
    """Echoes of scans, packed: real ones first, then padding. A tuple, which JAX takes apart without Python's help."""

    path: Int[AnyArray, "*scans echoes"]
    """Row of the ring's ``paths``; 0 where there is no echo."""
    range: Float[AnyArray, "*scans echoes"]
    """Half path length as reported, metres; NaN where there is no echo."""
    pose: Float[AnyArray, "*scans echoes 3"] | None = None
    """model_from_robot: where the robot stood when each echo was taken, in the frame of the lines: x, y (metres), theta
    (radians). None: all were taken where that frame is."""
    scan_count: Float[AnyArray, "*scans"] | None = None
    """How many scans were gathered, the measure of the votes that a wall can collect. None: one."""
    piece: Int[AnyArray, "*scans pieces"] | None = None
    """Arcs in pieces of ``PIECE`` points: which piece of its arc each is; -1 where there is none. So arcs of narrow
    detection ranges take less room than wide ones. None: every echo has the points of the widest arc."""
    owner: Int[AnyArray, "*scans pieces"] | None = None
    """The echo that each piece belongs to, with ``piece``."""


class RingArcs(eqx.Module):
    """What all scans of a ring have in common: its paths and their arcs, for one set of settings."""

    paths: EchoPaths
    """Geometry of every echo path."""
    arcs: arcs.Arc
    """Equidistant normals of every path."""
    theta_rows: Int[Array, "paths points"]
    """Row of the accumulator that each normal belongs to."""
    vote_threshold: Float[Array, ""]
    """Occupancy that a cell must exceed, points."""
    range_scale: Float[Array, ""]
    """Speed of sound over the speed that the reported ranges assume."""
    max_range: Float[Array, ""]
    """Half path length up to which an echo counts, metres."""
    full_wall_paths: Float[Array, ""]
    """Number of paths that hear a wide wall."""


@partial(jax.jit, static_argnames=("settings", "points"))
def ring_arcs(sensors: SensorArray, *, settings: HoughSettings, points: int) -> RingArcs:
    """Equidistant points on the arcs of every path of a ring, and the threshold for its scans.

    Args:
        sensors: the ring.
        settings: point pitch, cells and threshold.
        points: room for this many points on an arc (``points_of_widest_arc``).
    """
    paths = echo_paths(sensors)
    arcs_of_paths = jax.vmap(partial(arcs.arc, pitch=settings.point_pitch, points=points))(paths)
    return RingArcs(
        paths=paths,
        arcs=arcs_of_paths,
        theta_rows=hough.theta_row(arcs_of_paths.theta, settings),
        vote_threshold=settings.threshold * hough.full_wall_votes(paths, settings),
        range_scale=sensors.range_scale,
        max_range=sensors.max_range,
        full_wall_paths=hough.full_wall_paths(paths),
    )


@partial(jax.jit, static_argnames="settings")
def transform_arcs(ring: RingArcs, pose: Float[Array, "paths 3"], *, settings: HoughSettings) -> RingArcs:
    """The arcs of a ring that moved while its groups fired, one after the other.

    Args:
        ring: arcs of the ring at rest.
        pose: model_from_robot when the transmitter of each path fired: x, y (metres), theta (radians).
        settings: those of ``ring``.
    """
    paths = jax.vmap(transform_path)(ring.paths, pose)
    points = ring.arcs.theta.shape[-1]
    arcs_of_paths = jax.vmap(partial(arcs.arc, pitch=settings.point_pitch, points=points))(paths)
    rows = hough.theta_row(arcs_of_paths.theta, settings)
    return eqx.tree_at(lambda r: (r.paths, r.arcs, r.theta_rows), ring, (paths, arcs_of_paths, rows))


def points_of_widest_arc(beam: Float[np.ndarray, " sensors"], settings: HoughSettings) -> int:
    """Room for the widest arc of a ring, that of the direct path of the sensor with the widest cone: whole pieces."""
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
    """Cells of the accumulator (``hough.cell_of``)."""


def tangent_lines(ring: RingArcs, echoes: PackedEchoes, settings: HoughSettings) -> TangentLines:
    """The tangent line at every point of every echo's arc, for ONE scan, or several gathered in one frame."""

    def one_arc(arc: arcs.Arc, row: Int[Array, " points"], path: Int[Array, ""], echo: Int[Array, ""]) -> TangentLines:
        offset = ring.paths.range_offset[path]
        reach = corrected_range(echoes.range[echo], range_offset=offset, range_scale=ring.range_scale)
        rho, counts = arcs.tangent_rho(arc, reach, max_range=ring.max_range)
        normal_x, normal_y = arc.normal_x, arc.normal_y
        if echoes.pose is not None:  # the line n . p = rho, seen from a frame in which the robot stands at the pose
            pose = echoes.pose[echo]
            turn_x, turn_y = jnp.cos(pose[2]), jnp.sin(pose[2])
            normal_x, normal_y = turn_x * normal_x - turn_y * normal_y, turn_y * normal_x + turn_x * normal_y
            rho = rho + pose[0] * normal_x + pose[1] * normal_y
            row = hough.theta_row(arc.theta + pose[2], settings)
        return TangentLines(rho, normal_x, normal_y, hough.cell_of(rho, row, counts, settings))

    def whole(echo: Int[Array, ""]) -> TangentLines:
        path = echoes.path[echo]
        arc, row = jax.tree.map(lambda leaf: leaf[path], (ring.arcs, ring.theta_rows))
        return one_arc(arc, row, path, echo)

    if echoes.piece is None or echoes.owner is None:
        return jax.vmap(whole)(jnp.arange(len(echoes.path)))
    pieces = ring.theta_rows.shape[-1] // PIECE_POINTS

    def cut(leaf: Array) -> Array:
        return leaf if leaf.ndim == 1 else leaf.reshape(-1, PIECE_POINTS)

    of_pieces = jax.tree.map(cut, (ring.arcs, ring.theta_rows))

    def part(piece: Int[Array, ""], echo: Int[Array, ""]) -> TangentLines:
        path = echoes.path[echo]
        at = path * pieces + jnp.maximum(piece, 0)
        arc, row = jax.tree.map(lambda leaf: leaf[path if leaf.ndim == 1 else at], of_pieces)
        arc = eqx.tree_at(lambda a: a.exists, arc, arc.exists & (piece >= 0))
        return one_arc(arc, row, path, echo)

    return jax.vmap(part)(echoes.piece, echoes.owner)


def map_scans(one_scan: Callable, *scans):
    """One scan after the other where caches are small (CPU), all at once where cores are many (GPU)."""

    def in_turn(*scans):
        return jax.lax.map(lambda scan: one_scan(*scan), scans)

    if jax.default_backend() == "cpu":  # nothing else is there, as a rule: the other way need not be traced
        return in_turn(*scans)
    return jax.lax.platform_dependent(*scans, cpu=in_turn, default=jax.vmap(one_scan))


class Votes(NamedTuple):
    """What a batch of scans voted for (paper, section 4, up to the threshold)."""

    occupied: Bool[Array, "*scans theta rho"]
    """The highly occupied cells of each scan."""
    cell: Int[Array, "*scans arcs points"]
    """The cell of every point, row * rho_cells + column; one past the last cell where there is none."""
    rho: Float[Array, "*scans arcs points"]
    """The distance of every point's tangent line, metres, any sign."""


@partial(jax.jit, static_argnames="settings")
def vote(ring: RingArcs, echoes: PackedEchoes, *, settings: HoughSettings) -> Votes:
    """The paper's section 4 up to the threshold, for a batch of scans in one compiled step.

    Args:
        ring: arcs of the ring's paths, and the threshold.
        echoes: (scans, echoes) packed echoes.
        settings: accumulator and low pass.
    """
    # Arcs -> equidistant points -> tangent lines: no sums, so all scans at once.
    lines = jax.vmap(lambda scan: tangent_lines(ring, scan, settings))(echoes)
    gathered = jnp.ones(len(lines.cell)) if echoes.scan_count is None else echoes.scan_count

    def one_scan(cell: Int[Array, "arcs points"], level: Float[Array, ""]) -> Bool[Array, "theta rho"]:
        votes = hough.accumulate(cell, settings)  # points per cell
        smooth = hough.lowpass(votes, settings)  # balance between neighbor cells
        return smooth > level  # highly occupied cells

    return Votes(map_scans(one_scan, lines.cell, ring.vote_threshold * gathered), lines.cell, lines.rho)


@partial(jax.jit, static_argnames="settings")
def accumulators(
    ring: RingArcs, echoes: PackedEchoes, *, settings: HoughSettings
) -> tuple[Int[Array, "scans theta rho"], Float[Array, "scans theta rho"]]:
    """Votes before and after the low pass, to look at; arguments as ``vote``."""

    def one_scan(scan: PackedEchoes):
        votes = hough.accumulate(tangent_lines(ring, scan, settings).cell, settings)
        return votes, hough.lowpass(votes, settings)

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
        row = hough.theta_row(jnp.where(known, theta, 0), settings)
        cell = hough.cell_of(jnp.where(known, rho, 0), row, known, settings)
        votes = hough.accumulate(cell, settings)
        return hough.lowpass(votes, settings) > settings.threshold, cell

    return jax.lax.map(one_cluster, (rho, theta))
