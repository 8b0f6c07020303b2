"""Straight lines from the echoes of scans: the jitted steps before and after the component labelling (section 4)."""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from . import arcs, clusters, hough
from .hough import HoughSettings
from .paths import EchoPaths, Sensors, echo_paths


class Echoes(eqx.Module):
    """Echoes of scans, packed: real ones first, then padding."""

    path: Int[Array | np.ndarray, "*scans echoes"]
    """Row of the ring's ``paths``; 0 where there is no echo."""
    range: Float[Array | np.ndarray, "*scans echoes"]
    """Half path length as reported, metres; NaN where there is no echo."""


class _Ring(eqx.Module):
    """What one call needs of the ring, the same for all its scans."""

    sensors: Sensors
    paths: EchoPaths
    arcs: arcs.Arc


def _prepare(sensors: Sensors, settings: HoughSettings, points: int) -> _Ring:
    paths = echo_paths(sensors)
    one_arc = partial(arcs.arc, pitch=settings.point_pitch, points=points)
    return _Ring(sensors, paths, jax.vmap(one_arc)(paths))


def _lines_of_scan(ring: _Ring, echoes: Echoes, settings: HoughSettings):
    """Distance, normal direction and cell of every point of every echo of ONE scan."""

    def one_echo(path: Int[Array, ""], reported: Float[Array, ""]):
        arc = jax.tree.map(lambda leaf: leaf[path], ring.arcs)
        max_range, scale = ring.sensors.max_range, ring.sensors.range_scale
        offset = ring.paths.range_offset[path]
        reach = arcs.corrected_range(reported, range_offset=offset, range_scale=scale, max_range=max_range)
        rho, counts = arcs.tangent_rho(arc, reach, max_range=max_range)
        return rho, arc.theta, counts

    rho, theta, counts = jax.vmap(one_echo)(echoes.path, echoes.range)
    return rho, theta, hough.cell_of(rho, theta, counts, settings)


def _over_scans(one_scan: Callable, *scans):
    """One scan after the other where caches are small (CPU), all at once where cores are many (GPU)."""
    return jax.lax.platform_dependent(
        *scans,
        cpu=lambda *s: jax.lax.map(lambda scan: one_scan(*scan), s),
        default=lambda *s: jax.vmap(one_scan)(*s),
    )


@partial(jax.jit, static_argnames=("settings", "points"))
def occupied_cells(
    sensors: Sensors, echoes: Echoes, *, settings: HoughSettings, points: int
) -> Bool[Array, "scans theta rho"]:
    """The paper's section 4 up to the threshold, for a batch of scans in one compiled step.

    Args:
        sensors: the ring.
        echoes: (scans, echoes) packed echoes.
        settings: accumulator, low pass and threshold.
        points: most points that an arc has.

    Returns:
        The highly occupied cells of each scan.
    """
    ring = _prepare(sensors, settings, points)
    level = settings.threshold * hough.full_wall_votes(ring.paths, settings)

    def one_scan(scan: Echoes) -> Bool[Array, "theta rho"]:
        _, _, cells = _lines_of_scan(ring, scan, settings)  # arcs -> equidistant points -> tangent lines
        votes = hough.accumulate(cells, settings)  # points per cell
        smooth = hough.lowpass(votes, settings)  # balance between neighbor cells
        return smooth > level  # highly occupied cells

    return _over_scans(one_scan, echoes)


@partial(jax.jit, static_argnames=("settings", "points"))
def accumulators(
    sensors: Sensors, echoes: Echoes, *, settings: HoughSettings, points: int
) -> tuple[Int[Array, "scans theta rho"], Float[Array, "scans theta rho"]]:
    """Votes before and after the low pass, to look at; arguments as ``occupied_cells``."""
    ring = _prepare(sensors, settings, points)

    def one_scan(scan: Echoes):
        votes = hough.accumulate(_lines_of_scan(ring, scan, settings)[2], settings)
        return votes, hough.lowpass(votes, settings)

    return _over_scans(one_scan, echoes)


@partial(jax.jit, static_argnames=("settings", "points", "size"))
def cluster_lines(
    sensors: Sensors,
    echoes: Echoes,
    labels: Int[Array, "scans theta rho"],
    *,
    settings: HoughSettings,
    points: int,
    size: int,
) -> tuple[clusters.Clusters, Float[Array, "scans clusters 2 2"]]:
    """The paper's section 4 from the labelled components on, and section 5's extent, for a batch of scans.

    Args:
        sensors: the ring.
        echoes: (scans, echoes) packed echoes, as ``occupied_cells`` got them.
        labels: component of each cell: 0 none, k or -k (see ``centres_of_gravity``).
        settings: as ``occupied_cells`` got them.
        points: as ``occupied_cells`` got it.
        size: room for this many components a scan.

    Returns:
        Centres of gravity with the echoes involved, and the endpoints of the segments, robot frame, metres.
    """
    ring = _prepare(sensors, settings, points)

    def one_scan(scan: Echoes, label: Int[Array, "theta rho"]):
        rho, theta, cells = _lines_of_scan(ring, scan, settings)
        label_of_cell = jnp.append(label.ravel(), jnp.zeros(1, label.dtype))  # the last one: no cell, no component
        lines = clusters.centres_of_gravity(rho, theta, label_of_cell[cells], clusters=size)
        sensors_of_echoes = ring.paths.midpoint[scan.path]
        segments = jax.vmap(clusters.extent, in_axes=(0, 0, None, 0))(
            lines.rho, lines.theta, sensors_of_echoes, lines.involved
        )
        return lines, segments

    return _over_scans(one_scan, echoes, labels)


def points_of_widest_arc(widest: float, settings: HoughSettings) -> int:
    """Points that the widest detection range (radians) of a ring needs, at least one."""
    return max(1, round(float(np.ceil(widest / settings.point_pitch - 1e-6))))
