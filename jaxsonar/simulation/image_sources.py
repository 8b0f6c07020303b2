"""Specular echoes by the image source method: planes, right-angled corners and second-order reflections."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.floor_plans.junctions import Junctions
from jaxsonar.geometry.segments import cross
from jaxsonar.simulation.traced_echoes import EchoKind, TracedEchoes
from jaxsonar.simulation.tracing_scene import TOLERANCE, TracingScene, row_slices


def trace_planes(scene: TracingScene) -> TracedEchoes:
    """Echoes with one reflection."""
    group, wall = np.nonzero(scene.distance <= scene.max_range + scene.radius[:, None])
    i, j = scene.pairs.T
    parts = []
    for rows in row_slices(len(group), len(i)):
        g, w = group[rows], wall[rows]
        along, across = scene.walls.coordinates(w, scene.sensors[g])
        row, pair = scene.candidates(g, w, w)
        tx, rx = (row, i[pair]), (row, j[pair])
        echo, position, length = _reflect(
            scene, w[row], scene.baseline2[g[row], pair], along[tx], across[tx], along[rx], across[rx]
        )
        row, pair = row[echo], pair[echo]
        hit = scene.walls.point_at(w[row], position)
        found = TracedEchoes.of_kind(EchoKind.PLANE, g[row], pair, scene.index[w[row]], length, hit, hit)
        parts.append(scene.audible(found))
    return TracedEchoes.concatenate(parts)


def trace_second_order(scene: TracingScene, right_angled: Bool[np.ndarray, "walls walls"]) -> TracedEchoes:
    """Echoes with reflections at two walls, except pairs of walls that form a right-angled corner."""
    allowed = ~right_angled[np.ix_(scene.index, scene.index)] & ~np.eye(len(scene.index), dtype=bool)
    i, j = scene.pairs.T
    parts = []
    for groups in row_slices(len(scene.hub), allowed.size):
        group, wall_a, wall_b = _wall_pairs(scene, groups, allowed)
        for rows in row_slices(len(group), len(i)):
            g, a, b = group[rows], wall_a[rows], wall_b[rows]
            sensors = scene.sensors[g]
            along_a, across_a = scene.walls.coordinates(a, sensors)
            along_b, across_b = scene.walls.coordinates(b, sensors)
            images = sensors - 2 * across_b[..., None] * scene.walls.normal(b)[:, None]
            along_image, across_image = scene.walls.coordinates(a, images)
            # The path tx -> a -> b -> rx equals tx -> a -> image of rx in b, with one reflection at a.
            row, pair = scene.candidates(g, a, b)
            tx, rx = (row, i[pair]), (row, j[pair])
            baseline2 = scene.baseline2[g[row], pair] + 4 * across_b[tx] * across_b[rx]
            echo, position, length = _reflect(
                scene, a[row], baseline2, along_a[tx], across_a[tx], along_image[rx], across_image[rx]
            )
            row, pair = row[echo], pair[echo]
            first = scene.walls.point_at(a[row], position)
            along_first, across_first = (x[:, 0] for x in scene.walls.coordinates(b[row], first[:, None]))
            along_rx, across_rx = along_b[row, j[pair]], across_b[row, j[pair]]
            with np.errstate(divide="ignore", invalid="ignore"):
                position = (along_first * across_rx + along_rx * across_first) / (across_first + across_rx)
            # The first point lies strictly on the side of b where rx is; this excludes a vertex that a and b share.
            valid = (across_first * across_rx > 0) & (np.minimum(np.abs(across_first), np.abs(across_rx)) > TOLERANCE)
            valid &= (position >= -TOLERANCE) & (position <= scene.walls.length[b[row]] + TOLERANCE)
            row, pair, position, length, first = row[valid], pair[valid], position[valid], length[valid], first[valid]
            last = scene.walls.point_at(b[row], position)
            found = TracedEchoes.of_kind(EchoKind.SECOND_ORDER, g[row], pair, scene.index[a[row]], length, first, last)
            parts.append(scene.audible(replace(found, second=scene.index[b[row]])))
    return _drop_reversed_duplicates(TracedEchoes.concatenate(parts))


def trace_corners(scene: TracingScene, junctions: Junctions) -> TracedEchoes:
    """Double reflections in right-angled corners, which equal a point reflection at the vertex."""
    wedge = junctions.corners
    vertex = junctions.wedge_vertex[wedge]
    point = junctions.vertices[vertex] - scene.origin
    ends = junctions.wedge_start[wedge] + np.array([[0.0], [1.0]]) * junctions.wedge_width[wedge]
    e1, e2 = np.stack([np.cos(ends), np.sin(ends)], axis=-1)  # along the two walls, away from the vertex
    sine = cross(e1, e2)[:, None]
    wall_length1, wall_length2 = junctions.wedge_reach[wedge].T
    g, k = scene.points_in_range(point)
    i, j = scene.pairs.T
    offset = scene.sensors[g] - point[k, None]
    x, y = cross(offset, e2[k, None]) / sine[k], cross(e1[k, None], offset) / sine[k]  # oblique coordinates
    inside = (x > TOLERANCE) & (y > TOLERANCE)
    middle_x, middle_y = (x[:, i] + x[:, j]) / 2, (y[:, i] + y[:, j]) / 2
    middle = (offset[:, i] + offset[:, j]) / 2
    distance = np.linalg.norm(middle, axis=-1)
    row, pair = np.nonzero(inside[:, i] & inside[:, j] & (distance <= scene.max_range))
    mx, my = middle_x[row, pair], middle_y[row, pair]
    # Both outer legs are parallel to m -> c. The ray from tx crosses wall 1 (y = 0) at the fraction y / m_y, wall 2 at
    # x / m_x. The wall that it meets first deflects it to the other; both points are this far from the vertex:
    lead = x[row, i[pair]] / mx - y[row, i[pair]] / my
    on1, on2 = np.abs(lead) * mx, np.abs(lead) * my
    valid = (on1 <= wall_length1[k[row]] + TOLERANCE) & (on2 <= wall_length2[k[row]] + TOLERANCE)
    row, pair, lead, on1, on2 = row[valid], pair[valid], lead[valid], on1[valid], on2[valid]
    c = k[row]
    hit1, hit2 = point[c] + on1[:, None] * e1[c], point[c] + on2[:, None] * e2[c]
    first, last = np.where((lead >= 0)[:, None], (hit1, hit2), (hit2, hit1))
    length = 2 * distance[row, pair]
    return scene.audible(TracedEchoes.of_kind(EchoKind.CORNER, g[row], pair, vertex[c], length, first, last))


def _wall_pairs(
    scene: TracingScene, groups: slice, allowed: Bool[np.ndarray, "walls walls"]
) -> tuple[Int[np.ndarray, " found"], Int[np.ndarray, " found"], Int[np.ndarray, " found"]]:
    """(group, first wall, second wall) that can give an echo in this order, by bounds that hold for all sensors."""
    radius, distance = scene.radius[groups, None, None], scene.distance[groups]
    hub, count = scene.hub[groups], len(scene.index)
    normal = scene.walls.normal(np.arange(count))
    across = hub @ normal.T - (scene.walls.start * normal).sum(-1)
    first, second = across[:, :, None], across[:, None, :]
    image = first - 2 * second * (normal @ normal.T)  # distance of the hub's image in the second wall from the first
    reachable = distance[:, :, None] + scene.separation + distance[:, None, :] <= 2 * (scene.max_range + radius)
    reachable &= second**2 + first * image <= (scene.max_range + radius) ** 2
    same_side = (first * image > 0) | (np.minimum(np.abs(first), np.abs(image)) <= radius)
    group, a, b = np.nonzero(reachable & same_side & allowed)
    return group + groups.start, a, b


def _drop_reversed_duplicates(found: TracedEchoes) -> TracedEchoes:
    """Drop the second of two equally long paths of one pair over the same two walls in both orders."""
    low, high = np.minimum(found.reflector, found.second), np.maximum(found.reflector, found.second)
    order = np.lexsort((found.reflector, high, low, found.pair, found.group))
    same = np.ones(max(len(order) - 1, 0), dtype=bool)
    for key in (found.group, found.pair, low, high):
        same &= np.diff(key[order]) == 0
    same &= np.abs(np.diff(found.length[order])) <= TOLERANCE
    return found[order[np.append(True, ~same)[: len(order)]]]


def _reflect(
    scene: TracingScene,
    wall: Int[np.ndarray, " rows"],
    baseline2: Float[np.ndarray, " rows"],
    along_tx: Float[np.ndarray, " rows"],
    across_tx: Float[np.ndarray, " rows"],
    along_rx: Float[np.ndarray, " rows"],
    across_rx: Float[np.ndarray, " rows"],
) -> tuple[Int[np.ndarray, " found"], Float[np.ndarray, " found"], Float[np.ndarray, " found"]]:
    """Reflections at a wall between two points in its frame: row, position along the wall, path length."""
    product = across_tx * across_rx
    length2 = baseline2 + 4 * product
    with np.errstate(divide="ignore", invalid="ignore"):
        position = (along_tx * across_rx + along_rx * across_tx) / (across_tx + across_rx)
    valid = (product > 0) & (length2 <= (2 * scene.max_range) ** 2)
    valid &= (position >= -TOLERANCE) & (position <= scene.walls.length[wall] + TOLERANCE)
    row = np.flatnonzero(valid)
    return row, position[row], np.sqrt(length2[row])
