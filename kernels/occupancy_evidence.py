"""Evidence of one scan for the square cells of a grid: which cells echoes may come from, and which were seen through.

An echo comes from somewhere on its isorange arc (``isorange_arcs``), so that it is shared among the cells of the arc.
Cells in front of the first echo were seen through, but only for walls that the sensor would have detected: smooth
surfaces that face it. What was seen through is therefore kept by the direction of the normal.

Coordinates are those of a tile of the grid: metres from the lower left corner of its first cell.

Models: log-odds after Matthies and Elfes 1988 (first echoes) and Wilkes et al. 1993 (all echoes of wide beams).
Expectation maximization is that of emission tomography (Shepp and Vardi 1982): an echo is an event, its arc is the line
of response, the reflectivity of a cell is the number of echoes that it returns per look.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from .isorange_arcs import arc_point
from .planar_geometry import normal
from .sensor_array import EchoPaths, transform_path

DIRECTIONS = 12
"""Number of directions of normals, modulo half a turn, that are told apart."""
CONE_MARGIN = 0.05
"""Angle beside a cone up to which cells may be touched by it, radians."""


class ArcCells(eqx.Module):
    """Cells on the arcs of echoes. The same cell may be listed twice; its weights add up."""

    column: Int[Array, "*echoes entries"]
    row: Int[Array, "*echoes entries"]
    weight: Float[Array, "*echoes entries"]
    """Part of the arc in the cell, 1 for an arc that crosses it; falls with the angle off the axes, 0 for padding."""


def direction_index(angle: Float[Array, "*batch"]) -> Int[Array, "*batch"]:
    """Index of the direction of a normal, 0 to DIRECTIONS - 1, modulo half a turn; direction 0 is centered on x."""
    return jnp.mod(jnp.floor(angle * (DIRECTIONS / jnp.pi) + 0.5).astype(jnp.int32), DIRECTIONS)


def visible_distance(
    position: Float[Array, "2"],
    angle: Float[Array, " rays"],
    walls: Float[Array, "walls 2 2"],
    max_range: Float[Array, ""],
) -> Float[Array, " rays"]:
    """Distance along rays from ONE position to the nearest wall, at most the maximum range, metres.

    Args:
        position: start of the rays.
        angle: their directions, radians.
        walls: end points; a wall without length, such as padding, hides nothing.
        max_range: metres.
    """

    def to_wall(angle: Float[Array, ""], wall: Float[Array, "2 2"]) -> Float[Array, ""]:
        ray, start, along = normal(angle), wall[0] - position, wall[1] - wall[0]
        across = _cross(ray, along)
        safe = jnp.where(across == 0, 1, across)
        distance, fraction = _cross(start, along) / safe, _cross(start, ray) / safe
        hit = (across != 0) & (distance >= 0) & (fraction >= -1e-6) & (fraction <= 1 + 1e-6)
        return jnp.where(hit, distance, max_range)

    each_ray = jax.vmap(jax.vmap(to_wall, in_axes=(None, 0)), in_axes=(0, None))
    return each_ray(angle, walls).min(axis=1, initial=max_range)


def _cross(a: Float[Array, "2"], b: Float[Array, "2"]) -> Float[Array, ""]:
    return a[0] * b[1] - a[1] * b[0]


def arc_cells(
    path: EchoPaths,
    pose: Float[Array, "3"],
    distance: Float[Array, ""],
    walls: Float[Array, "walls 2 2"],
    *,
    resolution: float,
    points: int,
) -> ArcCells:
    """Cells that ONE echo may come from: two at each point of its arc, by linear interpolation across the arc.

    Args:
        path: the echo path, robot frame.
        pose: tile_from_robot.
        distance: corrected range, metres; 0 for padding.
        walls: what hides the cells behind it, as ``visible_distance``.
        resolution: side of a cell, metres.
        points: number of points of the arc; they should be at most one cell apart.
    """
    path = transform_path(path, pose)
    theta = path.start + (jnp.arange(points, dtype=path.width.dtype) + 0.5) * (path.width / points)
    point = jax.vmap(arc_point, in_axes=(None, None, 0))(path, distance, theta)
    spacing = distance * path.width / points
    # Interpolate across the arc, along the axis that its normal is closer to.
    n = normal(theta)
    steep = jnp.abs(n[:, 0]) < jnp.abs(n[:, 1])
    along = jnp.where(steep, point[:, 0], point[:, 1]) / resolution
    across = jnp.where(steep, point[:, 1], point[:, 0]) / resolution
    slope = jnp.where(steep, -n[:, 0] / n[:, 1], -n[:, 1] / n[:, 0])
    cell_along = jnp.floor(along)
    across = across + (cell_along + 0.5 - along) * slope - 0.5
    cell_across = jnp.floor(across)
    upper = across - cell_across
    cell_along = jnp.stack([cell_along, cell_along], axis=-1)
    cell_across = jnp.stack([cell_across, cell_across + 1], axis=-1)
    # An arc point counts as the part of the cell's side that it stands for.
    major = jnp.maximum(jnp.abs(n[:, 0]), jnp.abs(n[:, 1]))
    off_axis = (theta - path.start - path.width / 2) / jnp.maximum(path.width / 2, 1e-6)
    gain = (spacing * major / resolution) * (1 - 0.75 * off_axis**2)
    x, y = point[:, 0] - path.midpoint[0], point[:, 1] - path.midpoint[1]
    far, direction = jnp.sqrt(x * x + y * y), jnp.arctan2(y, x)
    limit = visible_distance(path.midpoint, direction, walls, jnp.asarray(jnp.inf, distance.dtype))
    exists = (path.width > 0) & (distance > jnp.sqrt((path.half_baseline**2).sum())) & (far < limit + resolution)
    weight = jnp.where(exists, gain, 0)[:, None] * jnp.stack([1 - upper, upper], axis=-1)
    column = jnp.where(steep[:, None], cell_along, cell_across).astype(jnp.int32)
    row = jnp.where(steep[:, None], cell_across, cell_along).astype(jnp.int32)
    return ArcCells(column.ravel(), row.ravel(), weight.ravel())


@partial(jax.jit, static_argnames=("resolution", "points"))
def arcs_of_echoes(
    paths: EchoPaths,
    index: Int[Array, " echoes"],
    pose: Float[Array, "echoes 3"],
    distance: Float[Array, " echoes"],
    walls: Float[Array, "walls 2 2"],
    *,
    resolution: float,
    points: int,
) -> ArcCells:
    """``arc_cells`` of many echoes; ``index`` is the row of ``paths`` of each."""

    def one(index: Int[Array, ""], pose: Float[Array, "3"], distance: Float[Array, ""]) -> ArcCells:
        path = jax.tree.map(lambda leaf: leaf[index], paths)
        return arc_cells(path, pose, distance, walls, resolution=resolution, points=points)

    return jax.lax.map(lambda echo: one(*echo), (index, pose, distance), batch_size=64)


class SeenThrough(eqx.Module):
    """Cells of a square tile that one scan saw through."""

    directions: UInt32[Array, "*scans rows columns"]
    """Bit k: a wall in the cell with its normal in direction k (``direction_index``) would have been heard."""
    looks: Float[Array, "*scans rows columns"]
    """Number of looks at the cell, each weighted by its angle off the axis: 1 - (sin off / sin half)^2."""


@partial(jax.jit, static_argnames=("resolution", "size", "cone", "rays"))
def seen_through(
    sensor_pose: Float[Array, "scans sensors 3"],
    cone_corner: Int[Array, "scans sensors 2"],
    half_width: Float[Array, " sensors"],
    first_echo: Float[Array, "scans sensors"],
    walls: Float[Array, "scans walls 2 2"],
    *,
    certain: Float[Array, " sensors"],
    margin: Float[Array, ""],
    resolution: float,
    size: int,
    cone: int,
    rays: int,
) -> SeenThrough:
    """Cells in front of the first echo of each sensor and in front of known walls.

    Each cone is evaluated in a square of its own, which must lie in the tile and hold the cone.

    Args:
        sensor_pose: tile_from_sensor when each sensor fired: x, y (m), heading (rad). Each scan has its own tile.
        cone_corner: first cell (column, row) of the square of each cone.
        half_width: half of the cones, radians, at most pi / 2.
        first_echo: range up to which each sensor heard nothing, metres; 0 for a sensor that did not measure.
        walls: known walls around each scan, in its tile, for ``visible_distance``.
        certain: half of the part of each cone in which a wall is heard for sure, radians.
        margin: cells closer than this to the first echo are left out, metres.
        resolution: side of a cell, metres.
        size: rows and columns of a tile.
        cone: rows and columns of the square of a cone.
        rays: number of sectors of a cone in which the visible distance is computed.
    """
    tolerance = resolution / 2**0.5

    def one_cone(pose, corner, half_width, inner, first_echo, walls):
        cells = jnp.arange(cone, dtype=pose.dtype) + 0.5
        x = (corner[0].astype(pose.dtype) + cells) * resolution - pose[0]
        y = (corner[1].astype(pose.dtype) + cells) * resolution - pose[1]
        cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
        ahead, left = x[None, :] * cos + y[:, None] * sin, y[:, None] * cos - x[None, :] * sin
        distance = jnp.sqrt(ahead * ahead + left * left)
        # The tangent of half the angle off the axis is bounded in front of the sensor, and cheap.
        half_tangent = left / jnp.maximum(distance + ahead, 1e-6)
        widest = jnp.tan(jnp.minimum(half_width + CONE_MARGIN, 0.55 * jnp.pi) / 2)
        edge = 2 * jnp.arctan(jnp.linspace(-1, 1, rays + 1) * widest)
        visible = visible_distance(pose[:2], pose[2] + edge, walls, jnp.asarray(1e6, pose.dtype))
        visible = jnp.minimum(visible[1:], visible[:-1])
        sector = jnp.clip(((half_tangent / widest + 1) * (rays / 2)).astype(jnp.int32), 0, rays - 1)
        clear = (distance < first_echo - margin) & (distance < visible[sector]) & (ahead > -tolerance)
        sine = left / (jnp.sin(half_width) * jnp.maximum(distance, 1e-6))
        looks = jnp.where(clear & (ahead > 0), jnp.maximum(1 - sine * sine, 0), 0)
        # Cells that the inner cone touches count, so that no ring of unknown cells remains around the robot.
        inside = jnp.abs(left) * jnp.cos(inner) - ahead * jnp.sin(inner) <= tolerance
        direction = direction_index(pose[2] + 2 * _arctan(half_tangent))
        return jnp.where(clear & inside, jnp.uint32(1) << direction.astype(jnp.uint32), 0), looks

    def one_scan(scan):
        sensor_pose, corners, first_echo, walls = scan

        bits, looks = jax.vmap(one_cone, in_axes=(0, 0, 0, 0, 0, None))(
            sensor_pose, corners, half_width, certain, first_echo, walls
        )

        def add(k, seen):
            at = corners[k, 1], corners[k, 0]
            old_bits = jax.lax.dynamic_slice(seen[0], at, (cone, cone))
            old_looks = jax.lax.dynamic_slice(seen[1], at, (cone, cone))
            return (
                jax.lax.dynamic_update_slice(seen[0], old_bits | bits[k], at),
                jax.lax.dynamic_update_slice(seen[1], old_looks + looks[k], at),
            )

        nothing = jnp.zeros((size, size), jnp.uint32), jnp.zeros((size, size), sensor_pose.dtype)
        return SeenThrough(*jax.lax.fori_loop(0, len(half_width), add, nothing))

    return jax.lax.map(one_scan, (sensor_pose, cone_corner, first_echo, walls))


def _arctan(x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Arc tangent of numbers from -1 to 1, within 0.0005 rad; it becomes one vectorized loop."""
    square = x * x
    return x * (0.9992150 + square * (-0.3211819 + square * (0.1462766 - square * 0.0389929)))


@partial(jax.jit, static_argnames=("cells", "rounds"))
def expected_echoes(
    cell: Int[Array, "echoes entries"],
    weight: Float[Array, "echoes entries"],
    echoes: Float[Array, " echoes"],
    exposure: Float[Array, " cells"],
    *,
    clutter: Float[Array, ""],
    cells: int,
    rounds: int,
) -> Float[Array, " cells"]:
    """Number of echoes that each cell explains: expectation maximization, one reflector for each echo.

    Args:
        cell: cells of each arc, 0 to cells - 1.
        weight: their weights, 0 for padding.
        echoes: number of echoes that each arc stands for.
        exposure: expected number of echoes of a cell whose reflectivity is 1: the looks at it, silent ones included.
        clutter: expected number of echoes of an arc without a reflector.
        cells: number of cells.
        rounds: number of iterations; few, because the estimate becomes spiky in the end.
    """

    def iterate(_, reflectivity):
        explained = (weight * reflectivity[cell]).sum(-1) + clutter
        share = weight * (echoes / explained)[:, None]
        back = jnp.zeros(cells, weight.dtype).at[cell.ravel()].add(share.ravel())
        return reflectivity * back / exposure

    return exposure * jax.lax.fori_loop(0, rounds, iterate, jnp.full(cells, 0.05, weight.dtype))


@partial(jax.jit, static_argnames=("cells",))
def log_odds(
    cell: Int[Array, "echoes entries"],
    weight: Float[Array, "echoes entries"],
    echoes: Float[Array, " echoes"],
    looks: Float[Array, " cells"],
    *,
    prior: Float[Array, ""],
    detected: Float[Array, ""],
    false: Float[Array, ""],
    missed: Float[Array, ""],
    cells: int,
) -> Float[Array, " cells"]:
    """Log-odds that each cell is occupied, up to the prior: independent cells (Matthies and Elfes 1988).

    A cell on an arc competes with all others of the arc: the longer the arc, the less its echo says about each of them.

    Args:
        cell: cells of each arc, 0 to cells - 1.
        weight: their weights, 0 for padding.
        echoes: number of echoes that each arc stands for.
        looks: number of looks through each cell.
        prior: probability that a cell is occupied.
        detected: probability that a look at an occupied cell brings an echo.
        false: probability of an echo without a reflector.
        missed: log-odds that a look through an occupied cell takes away.
        cells: number of cells.
    """
    others = 1 - (1 - prior) ** jnp.maximum(weight.sum(-1) - 1, 0)
    gain = echoes * jnp.log((detected + false) / (detected * others + false))
    return jnp.zeros(cells, weight.dtype).at[cell.ravel()].add((weight * gain[:, None]).ravel()) - missed * looks
