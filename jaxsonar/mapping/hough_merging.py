"""The paper's merging: clusters of segment midpoints, then the Hough transform of their lines (paper, section 5)."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay

from jaxsonar import kernels
from jaxsonar.detection.component_centroids import mean_lines
from jaxsonar.detection.connected_components import label_components
from jaxsonar.geometry.se2 import tangent_of, unit, wrap_angle
from jaxsonar.kernels.shape_buckets import bucket_size
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.mapping.wall_segments import WallSegments, outermost_projections, replace_rows


def merge_by_hough(segments: WallSegments, *, linkage_distance: float) -> WallSegments:
    """Walls by the paper's recipe, but with a local origin for every cluster, so that rho stays small.

    Args:
        segments: wall segments in the world frame.
        linkage_distance: midpoints up to this far apart belong to one cluster, metres.
    """
    if not len(segments):
        return segments
    # Cluster the segments by their midpoints, and express their lines relative to the mean midpoint.
    midpoint = segments.endpoints.mean(axis=1)
    cluster = single_linkage(midpoint, linkage_distance)
    size = np.bincount(cluster)
    origin = np.stack([np.bincount(cluster, midpoint[:, k]) for k in (0, 1)], axis=-1) / size[:, None]
    rho = (segments.normal * (segments.center - origin[cluster])).sum(-1)
    part, line = np.zeros(len(segments), dtype=np.int64), np.stack([rho, segments.theta], axis=-1)
    for settings, rows, column, row in _batches(cluster, size, rho):
        shape = bucket_size(int(row[-1]) + 1, least=2), bucket_size(int(column.max()) + 1, least=16)
        lines = np.full((2, *shape), np.nan, np.float32)
        lines[:, row, column] = rho[rows], segments.theta[rows]
        # Accumulate the infinite lines, apply low pass and threshold, and label the connected components.
        occupied, cells = kernels.vote_lines(*lines, settings=settings)
        labels, counts = label_components(np.asarray(occupied))
        # Each component is a wall. Its line is the centroid of its members.
        label = labels.reshape(len(labels), -1)[row, np.asarray(cells)[row, column]].astype(np.int64)
        part[rows] = np.abs(label)
        # (-rho, n) is the line (rho, -n); a negative label marks the far side of a component that joins across rho = 0.
        side = np.where(rho[rows] < 0, -1, 1) * np.sign(label)
        wall = row * (int(counts.max()) + 1) + part[rows]
        normal = side[:, None] * unit(segments.theta[rows])
        sums = (np.ones(len(rows), np.int64), side * rho[rows], *normal.T)
        merged_rho, merged_theta, _ = mean_lines(wall, *sums, components=int(wall.max()) + 1)
        line[rows] = np.stack([merged_rho[wall], merged_theta[wall]], axis=-1)
    _, first, group = np.unique(np.stack([cluster, part]), axis=1, return_index=True, return_inverse=True)
    return _walls_on_lines(segments, group.ravel(), origin[cluster[first]], line[first])


def single_linkage(points: Float[np.ndarray, "points 2"], max_distance: float) -> Int[np.ndarray, " points"]:
    """Single-linkage clusters: points belong together if steps up to ``max_distance`` (metres) connect them.

    The minimum spanning tree is a subset of the edges of the Delaunay triangulation, so the edges up to
    ``max_distance`` connect the clusters. The cost is O(n log n), however dense the points are.
    """
    positions, position_of = np.unique(points, axis=0, return_inverse=True)
    edges = np.zeros((0, 2), dtype=np.int64)
    if len(positions) > 1:
        # Three far points guarantee a planar triangulation, also of collinear points. They change no edge of the tree.
        near = np.stack([_shorten_gaps(positions[:, k], max_distance) for k in (0, 1)], axis=-1)
        high = near.max(axis=0)
        far = 4 * float(high.max()) + max_distance
        corners = high / 2 + far * np.array([[-2.0, -1.0], [2.0, -1.0], [0.0, 2.0]])
        triangulation = Delaunay(np.concatenate([near, corners]))
        sides = triangulation.simplices[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        # Points that nearly coincide with another are listed apart, with their nearest vertex.
        edges = np.concatenate([sides, triangulation.coplanar[:, [0, 2]]])
        edges = edges[(edges < len(positions)).all(axis=1)]
        length = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=-1)
        edges = edges[length <= max_distance]
    shape = (len(positions), len(positions))
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=shape)
    return connected_components(graph, directed=False)[1][position_of.ravel()].astype(np.int64)


def _shorten_gaps(x: Float[np.ndarray, " points"], max_distance: float) -> Float[np.ndarray, " points"]:
    """Coordinates from 0, in which gaps wider than twice ``max_distance`` are shortened to that; no link changes.

    If the extent of the points is a million times their spacing, a triangulation loses edges to rounding.
    """
    order = np.argsort(x)
    steps = np.minimum(np.diff(x[order]), 2 * max_distance)
    near = np.empty_like(x)
    near[order] = np.append(0.0, np.cumsum(steps))
    return near


def _batches(
    cluster: Int[np.ndarray, " lines"], size: Int[np.ndarray, " clusters"], rho: Float[np.ndarray, " lines"]
) -> Iterator[
    tuple[kernels.HoughSettings, Int[np.ndarray, " some"], Int[np.ndarray, " some"], Int[np.ndarray, " some"]]
]:
    """Batches of clusters with similar size and extent, for few compiled shapes.

    Yields:
        The settings of the accumulator; the numbers of the lines; their column and their row (cluster) in the batch.
    """
    hough = SETTINGS.hough
    extent = np.zeros(len(size))
    np.maximum.at(extent, cluster, np.abs(rho))
    # Clusters with an extent of a kilometre get coarser cells.
    ratio = (extent + 1) / (hough.max_rho_cells * hough.rho_cell)
    coarse = 2 ** np.maximum(np.ceil(np.log2(ratio)), 0).astype(np.int64)
    cells = np.array([bucket_size(int(n) + 2, least=100) for n in extent / (coarse * hough.rho_cell)])
    cells = np.minimum(cells, hough.max_rho_cells)
    lines = np.array([bucket_size(int(n), least=16) for n in size])
    shapes = np.stack([cells, lines, coarse])
    order = np.argsort(cluster, kind="stable")
    start = np.cumsum(size) - size
    for shape in np.unique(shapes[:, size > 1], axis=1).T:  # a single line is its own centroid
        rho_cell = hough.rho_cell * int(shape[2])
        settings = kernels.HoughSettings(
            rho_cells=int(shape[0]), rho_cell=rho_cell, threshold=hough.threshold, min_echoes=1
        )
        alike = np.flatnonzero((shapes == shape[:, None]).all(axis=0) & (size > 1))
        at_once = max(1, hough.cells_per_step // settings.cells)
        for first in range(0, len(alike), at_once):
            some = alike[first : first + at_once]
            row = np.repeat(np.arange(len(some)), size[some])
            column = np.arange(len(row)) - np.repeat(np.cumsum(size[some]) - size[some], size[some])
            yield settings, order[start[some][row] + column], column, row


def _walls_on_lines(
    segments: WallSegments,
    group: Int[np.ndarray, " segments"],
    origin: Float[np.ndarray, "walls 2"],
    line: Float[np.ndarray, "walls 2"],
) -> WallSegments:
    """One wall per group on the given line (rho, theta from the origin), between its outermost projected ends."""
    fused = segments.fuse(group)
    theta = np.where(np.cos(line[:, 1] - fused.theta) < 0, wrap_angle(line[:, 1] + np.pi), line[:, 1])
    tangent = tangent_of(theta)
    footpoint = origin + line[:, :1] * unit(line[:, 1])
    first, last = outermost_projections(segments.endpoints, group, footpoint, tangent)
    middle = (first + last) / 2
    alone = np.bincount(group) == 1
    walls = replace(
        fused,
        center=footpoint + middle[:, None] * tangent,
        theta=theta,
        extent=np.stack([first - middle, last - middle], axis=-1),
    )
    return replace_rows(walls, alone, fused.take(alone))
