"""Merging as the paper has it: clusters of midpoints, then the Hough transform of their lines (paper, section 5)."""

from collections.abc import Iterator
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay

from jaxsonar import kernels
from jaxsonar.detection.connected_components import label_components
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.kernels.shape_buckets import bucket_size
from jaxsonar.mapping.wall_segments import Pieces, add_up, outermost, overwrite

RHO_CELL = 0.10
"""Metres; the paper's cell for merging, with 0.0628 rad in theta."""
THRESHOLD = 0.1
"""Lines; a single one leaves a quarter of itself in its cell after the low pass, and none is to be lost."""
_CELLS_AT_ONCE, _MOST_CELLS = 2_000_000, 8192


def merge_as_paper(pieces: Pieces, *, cut: float) -> Pieces:
    """Merged segments: the paper's recipe, with an origin for every cluster, so that none is far from it.

    Args:
        pieces: aggregated segments.
        cut: midpoints up to this far apart are connected, metres.
    """
    if not len(pieces):
        return pieces
    # Cluster the segments by their midpoints, by single linkage.
    midpoint = pieces.segments.mean(axis=1)
    cluster = single_linkage(midpoint, cut)
    size = np.bincount(cluster)
    origin = np.stack([np.bincount(cluster, midpoint[:, k]) for k in (0, 1)], axis=-1) / size[:, None]
    rho = (pieces.normal * (pieces.centre - origin[cluster])).sum(-1)
    part, line = np.zeros(len(pieces), dtype=np.int64), np.stack([rho, pieces.theta], axis=-1)
    for settings, rows, column, row in _batches(cluster, size, rho):
        shape = bucket_size(int(row[-1]) + 1, least=2), bucket_size(int(column.max()) + 1, least=16)
        lines = np.full((2, *shape), np.nan, np.float32)
        lines[:, row, column] = rho[rows], pieces.theta[rows]
        # Hough transform the infinite lines; low pass, threshold, components, centres of gravity.
        packed = tuple(jnp.asarray(values) for values in lines)
        labels, counts = label_components(np.asarray(kernels.occupied_by_lines(*packed, settings=settings)))
        found = bucket_size(int(counts.max()), least=16)
        merged = kernels.merged_lines(*packed, jnp.asarray(labels), settings=settings, size=found)
        merged_rho, merged_theta, component = (np.asarray(values) for values in merged)
        part[rows] = component[row, column]
        line[rows] = np.stack([merged_rho[row, part[rows] - 1], merged_theta[row, part[rows] - 1]], axis=-1)
    _, first, group = np.unique(np.stack([cluster, part]), axis=1, return_index=True, return_inverse=True)
    return _on_lines(pieces, group.ravel(), origin[cluster[first]], line[first])


def single_linkage(points: Float[np.ndarray, "points 2"], cut: float) -> Int[np.ndarray, " points"]:
    """Clusters in which every point can be reached by steps up to ``cut``, in n log n however dense they are.

    The shortest edges that join all points are among those of the Delaunay triangulation; those up to ``cut`` join the
    clusters.
    """
    places, place_of = np.unique(points, axis=0, return_inverse=True)
    edges = np.zeros((0, 2), dtype=np.int64)
    if len(places) > 1:
        # Three far points make any set a plane one; no shortest edge between the others goes through them.
        near = np.stack([_without_deserts(places[:, k], cut) for k in (0, 1)], axis=-1)
        high = near.max(axis=0)
        far = 4 * float(high.max()) + cut
        corners = high / 2 + far * np.array([[-2.0, -1.0], [2.0, -1.0], [0.0, 2.0]])
        mesh = Delaunay(np.concatenate([near, corners]))
        sides = mesh.simplices[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        edges = np.concatenate([sides, mesh.coplanar[:, [0, 2]]])  # points too near to another to be corners
        edges = edges[(edges < len(places)).all(axis=1)]
        edges = edges[np.linalg.norm(places[edges[:, 0]] - places[edges[:, 1]], axis=-1) <= cut]
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(len(places), len(places)))
    return connected_components(graph, directed=False)[1][place_of.ravel()].astype(np.int64)


def _without_deserts(x: Float[np.ndarray, " points"], cut: float) -> Float[np.ndarray, " points"]:
    """Coordinates from 0 on, every empty stretch wider than twice the cut made that wide: no link changes.

    A triangulation of points whose extent is a million times their distance loses edges to rounding.
    """
    order = np.argsort(x)
    steps = np.minimum(np.diff(x[order]), 2 * cut)
    near = np.empty_like(x)
    near[order] = np.append(0.0, np.cumsum(steps))
    return near


def _batches(
    cluster: Int[np.ndarray, " lines"], size: Int[np.ndarray, " clusters"], rho: Float[np.ndarray, " lines"]
) -> Iterator[
    tuple[kernels.HoughSettings, Int[np.ndarray, " some"], Int[np.ndarray, " some"], Int[np.ndarray, " some"]]
]:
    """Clusters of like size and extent together: settings, rows of the lines, their columns, and their cluster."""
    farthest = np.zeros(len(size))
    np.maximum.at(farthest, cluster, np.abs(rho))
    # Clusters of a kilometre get coarser cells.
    coarse = 2 ** np.maximum(np.ceil(np.log2((farthest + 1) / (_MOST_CELLS * RHO_CELL))), 0).astype(np.int64)
    cells = np.array([bucket_size(int(n) + 2, least=100) for n in farthest / (coarse * RHO_CELL)])
    cells = np.minimum(cells, _MOST_CELLS)
    lines = np.array([bucket_size(int(n), least=16) for n in size])
    shapes = np.stack([cells, lines, coarse])
    order = np.argsort(cluster, kind="stable")
    start = np.cumsum(size) - size
    for shape in np.unique(shapes[:, size > 1], axis=1).T:  # a line alone is its own centre of gravity
        settings = kernels.HoughSettings(
            rho_cells=int(shape[0]), rho_cell=RHO_CELL * int(shape[2]), threshold=THRESHOLD, min_echoes=1
        )
        alike = np.flatnonzero((shapes == shape[:, None]).all(axis=0) & (size > 1))
        at_once = max(1, _CELLS_AT_ONCE // settings.cells)
        for first in range(0, len(alike), at_once):
            some = alike[first : first + at_once]
            row = np.repeat(np.arange(len(some)), size[some])
            column = np.arange(len(row)) - np.repeat(np.cumsum(size[some]) - size[some], size[some])
            yield settings, order[start[some][row] + column], column, row


def _on_lines(
    pieces: Pieces,
    group: Int[np.ndarray, " pieces"],
    origin: Float[np.ndarray, "merged 2"],
    line: Float[np.ndarray, "merged 2"],
) -> Pieces:
    """One piece a group, on the given line (rho, theta from the origin); its outermost projected ends bound it."""
    summed = add_up(pieces, group)
    theta = np.where(np.cos(line[:, 1] - summed.theta) < 0, wrap_angle(line[:, 1] + np.pi), line[:, 1])
    tangent = np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
    foot = origin + line[:, :1] * np.stack([np.cos(line[:, 1]), np.sin(line[:, 1])], axis=-1)
    first, last = outermost(pieces.segments, group, foot, tangent)
    middle = (first + last) / 2
    alone = np.bincount(group) == 1
    merged = replace(
        summed,
        centre=foot + middle[:, None] * tangent,
        theta=theta,
        ends=np.stack([first - middle, last - middle], axis=-1),
    )
    return overwrite(merged, alone, summed.take(alone))
