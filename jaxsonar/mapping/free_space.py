"""Directional free space: where a wall with a given normal would have been detected and was not.

A sensor without an echo does not prove that its whole cone is empty, because a smooth wall reflects sound back only if
it faces the sensor. A missing echo excludes walls at a position with a direction. Therefore the map of free space has a
cell for every position on the floor and every direction of a wall's normal. Each cell stores the times of the latest
scans that would have detected a wall there. Only paths that were measured can miss a wall.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.se2 import compose, perpendicular, rotate, tangent_of, unit
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.sensors.ring import Ring

_FREE = SETTINGS.free_space


@dataclass(frozen=True, eq=False)
class DirectionalFreeSpace:
    """The latest scans that saw through each position and direction.

    The size grows with the area of the floor, not with the number of scans.
    """

    tiles: Mapping[tuple[int, int], Float[np.ndarray, "tile tile directions remembered"]] = field(default_factory=dict)
    """Times as in ``WallSegments.last_seen``, latest first, -inf for none. Tiles are immutable."""

    def query(
        self, points: Float[np.ndarray, "points 2"], theta: Float[np.ndarray, " points"]
    ) -> Float[np.ndarray, "points remembered"]:
        """Times at which walls at these points (metres) with these normals (radians) were seen through."""
        cell, direction = np.floor(points / _FREE.cell).astype(np.int64), _sector_of(theta)
        tile, inside = np.divmod(cell, _FREE.tile_cells)
        times = np.full((len(points), _FREE.remembered), -np.inf)
        for key in {tuple(t) for t in tile.tolist()} & self.tiles.keys():
            here = (tile == key).all(axis=1)
            times[here] = self.tiles[key][inside[here, 0], inside[here, 1], direction[here]]
        return times

    def query_neighborhood(
        self, points: Float[np.ndarray, "points 2"], theta: Float[np.ndarray, " points"]
    ) -> Float[np.ndarray, "points remembered"]:
        """As ``query``, but including scans that saw through the wall one cell further along it.

        The rays of a scan are sparser than the cells. Neighbors count only up to the latest time of the point itself.
        """
        beside = _FREE.cell * tangent_of(theta)
        times = np.concatenate([self.query(points + k * beside, theta) for k in (0, -1, 1)], axis=-1)
        seen_itself = np.isfinite(times[:, :1])
        times = -np.sort(-np.where(seen_itself, np.minimum(times, times[:, :1]), -np.inf), axis=-1)
        repeated = np.zeros(times.shape, dtype=bool)
        repeated[:, 1:] = times[:, 1:] == times[:, :-1]
        return -np.sort(-np.where(repeated, -np.inf, times), axis=-1)[:, : _FREE.remembered]

    def updated(self, cells: Int[np.ndarray, "cells 3"], times: Float[np.ndarray, " cells"]) -> "DirectionalFreeSpace":
        """With more scans added, in any order.

        Args:
            cells: (cell x, cell y, direction) that a scan saw through.
            times: the time of that scan.
        """
        if not len(cells):
            return self
        tiles = dict(self.tiles)
        tile, inside = np.divmod(cells[:, :2], _FREE.tile_cells)
        # Sort by cell, latest first, and rank the times within each cell.
        code, _, _ = _encode(np.column_stack([tile, inside, cells[:, 2]]).T)
        order = np.lexsort((-times, code))
        tile, inside, cells, times = tile[order], inside[order], cells[order], times[order]
        new = np.append(True, np.diff(code[order]) != 0)
        row = np.arange(len(cells))
        rank = row - np.maximum.accumulate(np.where(new, row, 0))
        remembered = rank < _FREE.remembered
        edges = np.flatnonzero(np.append(True, (np.diff(tile, axis=0) != 0).any(axis=1)))
        for first, last in zip(edges, [*edges[1:], len(tile)], strict=True):
            key = (int(tile[first, 0]), int(tile[first, 1]))
            part = np.arange(first, last)[remembered[first:last]]
            # Only cells with new times change.
            index = np.cumsum(new[part]) - 1
            at = tuple(np.column_stack([inside[part], cells[part, 2]])[new[part]].T)
            before = tiles.get(key)
            shape = (_FREE.tile_cells, _FREE.tile_cells, _FREE.directions, _FREE.remembered)
            tile_times = np.full(shape, -np.inf) if before is None else before.copy()
            both = np.full((len(at[0]), 2 * _FREE.remembered), -np.inf)
            both[:, : _FREE.remembered] = tile_times[at]
            both[index, _FREE.remembered + rank[part]] = times[part]
            tile_times[at] = _latest(both)
            tiles[key] = tile_times
        return DirectionalFreeSpace(tiles)

    def union(self, other: "DirectionalFreeSpace") -> "DirectionalFreeSpace":
        """The latest scans of both."""
        tiles = dict(self.tiles)
        for key, times in other.tiles.items():
            tiles[key] = _latest(np.concatenate([tiles.get(key, np.full_like(times, -np.inf)), times], axis=-1))
        return DirectionalFreeSpace(tiles)


def _latest(times: Float[np.ndarray, "*cells both"]) -> Float[np.ndarray, "*cells remembered"]:
    return -np.sort(-times, axis=-1)[..., : _FREE.remembered]


def observe_free_space(
    ring: Ring,
    pose: Float[np.ndarray, "scans 3"],
    scan: Int[np.ndarray, " echoes"],
    path: Int[np.ndarray, " echoes"],
    distance: Float[np.ndarray, " echoes"],
    walls: Sequence[Float[np.ndarray, "_ 2 2"]],
    *,
    measured: Bool[np.ndarray, "scans paths"] | None = None,
    path_pose: Float[np.ndarray, "scans paths 3"] | None = None,
) -> tuple[Int[np.ndarray, "cells 3"], Int[np.ndarray, " cells"]]:
    """Cells in which each scan would have detected a wall and did not.

    Only direct paths that were measured contribute. A cell is free for a sensor that faces it if its first echo comes
    from farther away. If the cones cover every direction at least twice, two sensors must agree within 20 cm; one is
    enough where the scan did not measure the others. Cells that the echo arc of any path crosses, and cells behind a
    wall that the scan itself shows, are left out.

    Args:
        ring: the sensors.
        pose: world_from_robot of the scans, metres and radians, all finite.
        scan: row of ``pose`` of each echo.
        path: row of ``ring.paths`` of each echo.
        distance: corrected half path length of each echo, metres.
        walls: for each scan, the wall segments that it shows, world frame, metres.
        measured: paths that each scan measured, among them all with an echo; all of them if omitted.
        path_pose: scan_from_robot when each path was measured; all at the pose of the scan if omitted.

    Returns:
        The cells (cell x, cell y, direction), and the row of ``pose`` of the scan that saw through each.
    """
    return ScanViews.of(ring, pose, scan, path, distance, measured=measured, path_pose=path_pose).free_cells(walls)


@dataclass(frozen=True, eq=False)
class ScanViews:
    """What scans show of free space before the walls of their own models occlude a part of it.

    The walls depend on the length of the windows, the views do not.
    """

    free: "_RayViews"
    """Cells in front of the first echoes."""
    visible: "_RayViews | None"
    """Cells that all sensors would have seen without echoes, in the scans that did not measure all direct paths; None
    where a single sensor decides, or every scan measured all of them."""
    on_arcs: Int[np.ndarray, "4 points"]
    """Cells that the arcs of echoes cross: rows of scan, cell x, cell y, direction."""
    measured: Bool[np.ndarray, "scans direct"]
    """Direct paths that each scan measured."""
    confirms: bool
    """Whether a second sensor must agree."""

    @classmethod
    def of(
        cls,
        ring: Ring,
        pose: Float[np.ndarray, "scans 3"],
        scan: Int[np.ndarray, " echoes"],
        path: Int[np.ndarray, " echoes"],
        distance: Float[np.ndarray, " echoes"],
        *,
        measured: Bool[np.ndarray, "scans paths"] | None = None,
        path_pose: Float[np.ndarray, "scans paths 3"] | None = None,
    ) -> "ScanViews":
        """The views of scans; arguments as for ``observe_free_space``."""
        direct = np.flatnonzero((ring.paths[:, 0] == ring.paths[:, 1]) & (np.asarray(ring.echo_paths.width) > 0))
        path_at = np.broadcast_to(pose[:, None], (len(pose), len(ring.paths), 3))
        if path_pose is not None:
            path_at = compose(path_at, path_pose)
        measured = np.ones((len(pose), len(ring.paths)), bool) if measured is None else measured
        reach = _FREE.certain * ring.max_range + _FREE.margin
        first = np.where(measured, reach, 0.0)
        np.minimum.at(first, (scan, path), distance)
        confirms = bool(np.asarray(ring.echo_paths.width)[direct].sum() >= 2 * 2 * np.pi)
        partial = ~measured[:, direct].all(axis=1)
        visible = None
        if confirms and partial.any():
            without_echoes = np.tile(np.where(partial, reach, 0.0)[:, None], len(direct))
            visible = _RayViews.of(ring, path_at, direct, without_echoes)
        return cls(
            free=_RayViews.of(ring, path_at, direct, first[:, direct]),
            visible=visible,
            on_arcs=_cells_on_arcs(ring, path_at[scan, path], path, distance, scan),
            measured=measured[:, direct],
            confirms=confirms,
        )

    def free_cells(
        self, walls: Sequence[Float[np.ndarray, "_ 2 2"]]
    ) -> tuple[Int[np.ndarray, "cells 3"], Int[np.ndarray, " cells"]]:
        """Cells that each scan saw through, and the scans; ``walls`` and results as for ``observe_free_space``."""
        occluded_from = self.free.distance_to_walls(walls)
        free, sensor = self.free.unoccluded(occluded_from)
        code, low, size = _encode(np.concatenate([free, self.on_arcs], axis=1))
        cells, echo_cells = code[: free.shape[1]], code[free.shape[1] :]
        if self.confirms:
            views = free[:, :0], sensor[:0]
            if self.visible is not None:
                views = self.visible.unoccluded(occluded_from)
            cells = cells[_is_agreed(free, sensor, *views, self.measured)]
        cells = _sorted_unique(cells)
        cells = cells[~_is_in(cells, np.sort(echo_cells))]
        who, x, y, direction = (value + least for value, least in zip(np.unravel_index(cells, size), low, strict=True))
        return np.column_stack([x, y, direction]), who


@dataclass(frozen=True, eq=False)
class _RayViews:
    """Cells in front of the first echo of a sensor that faces them, found along rays. A cell may be repeated."""

    cells: Int[np.ndarray, "4 views"]
    """Rows of scan, cell x, cell y, direction."""
    sensor: Int[np.ndarray, " views"]
    """Index into the direct paths."""
    ray: Int[np.ndarray, " views"]
    """Row of the ray among those of all scans and sensors."""
    depth: Float[np.ndarray, " views"]
    """Distance of the cell from the sensor, metres: that along the ray or that of its center, the larger one."""
    position: Float[np.ndarray, "scans direct 2"]
    """Positions of the sensors, world frame, metres."""
    directions: Float[np.ndarray, "scans direct rays 2"]
    """Unit vectors of the rays."""

    @classmethod
    def of(
        cls,
        ring: Ring,
        path_at: Float[np.ndarray, "scans paths 3"],
        direct: Int[np.ndarray, " direct"],
        first: Float[np.ndarray, "scans direct"],
    ) -> "_RayViews":
        """The views of all scans.

        Args:
            ring: the sensors.
            path_at: world_from_robot when each path was measured.
            direct: rows of ``ring.paths``, the direct paths.
            first: distance of the first echo of each scan and direct path, metres.
        """
        geometry = ring.echo_paths
        midpoint, start, width = (np.asarray(v)[direct] for v in (geometry.midpoint, geometry.start, geometry.width))
        distances = np.arange(_FREE.cell / 2, _FREE.certain * ring.max_range, _FREE.cell * 0.7)
        # Arrays are (scans, direct paths, rays).
        fraction = 0.5 + _FREE.certain * np.linspace(-0.5, 0.5, _FREE.rays)
        robot = path_at[:, direct]
        theta = robot[..., None, 2] + (start[:, None] + width[:, None] * fraction)
        sensor = robot[..., :2] + rotate(midpoint[None], robot[..., 2])
        ray = unit(theta)
        free_until = first - _FREE.margin
        # A sensor faces a cell only if it would hear walls of every direction in the cell's sector.
        direction = _sector_of(theta)
        begin = direction * _FREE.sector - robot[..., None, 2] - start[:, None]
        faces = np.mod(begin, 2 * np.pi) <= width[:, None] - _FREE.sector
        is_free = distances < free_until[..., None]
        who, sensor_row, ray_row, step = np.nonzero(is_free[:, :, None] & faces[..., None])
        of_sensor = who * len(direct) + sensor_row
        ray_of = of_sensor * theta.shape[-1] + ray_row
        from_x, from_y = sensor.reshape(-1, 2)[of_sensor].T
        toward, distance = ray.reshape(-1, 2)[ray_of], distances[step]
        cell_x = np.floor((from_x + distance * toward[:, 0]) / _FREE.cell)
        cell_y = np.floor((from_y + distance * toward[:, 1]) / _FREE.cell)
        # The center of the cell must be closer than the echo, too.
        to_center = np.hypot((cell_x + 0.5) * _FREE.cell - from_x, (cell_y + 0.5) * _FREE.cell - from_y)
        near = to_center < free_until.ravel()[of_sensor]
        cell_x, cell_y = cell_x[near].astype(np.int64), cell_y[near].astype(np.int64)
        return cls(
            cells=np.stack([who[near], cell_x, cell_y, direction.ravel()[ray_of[near]]]),
            sensor=sensor_row[near],
            ray=ray_of[near],
            depth=np.maximum(distance, to_center)[near],
            position=sensor,
            directions=ray,
        )

    def distance_to_walls(self, walls: Sequence[Float[np.ndarray, "_ 2 2"]]) -> Float[np.ndarray, "scans direct rays"]:
        """Distance along each ray to the first wall that its scan shows, metres; inf for none."""
        distance = np.full(self.directions.shape[:3], np.inf)
        # Consecutive scans of one window show the same walls.
        for _, group in groupby(range(len(walls)), key=lambda k: id(walls[k])):
            rows = list(group)
            if len(walls[rows[0]]):
                rows = slice(rows[0], rows[-1] + 1)
                distance[rows] = _distance_to_walls(self.position[rows], self.directions[rows], walls[rows.start])
        return distance

    def unoccluded(
        self, occluded_from: Float[np.ndarray, "scans direct rays"]
    ) -> tuple[Int[np.ndarray, "4 views"], Int[np.ndarray, " views"]]:
        """Cells and sensors of the views before the rays are occluded."""
        kept = self.depth < (occluded_from.ravel() - _FREE.margin)[self.ray]
        return self.cells[:, kept], self.sensor[kept]


def _is_agreed(
    free: Int[np.ndarray, "4 views"],
    sensor: Int[np.ndarray, " views"],
    visible: Int[np.ndarray, "4 visible"],
    observer: Int[np.ndarray, " visible"],
    measured: Bool[np.ndarray, "scans direct"],
) -> Bool[np.ndarray, " views"]:
    """Which views of free cells a second sensor confirms, or no other sensor could confirm for lack of a measurement.

    Args:
        free: scan, cell x, cell y, direction of each view.
        sensor: index into the direct paths of each view.
        visible: as ``free``, all views that all sensors would have without echoes, in the scans that did not measure
            all direct paths.
        observer: index into the direct paths of each of these.
        measured: direct paths that each scan measured.
    """
    # Sensors that see the same wall differ by up to a cell in its position: compare blocks of 2 x 2 cells.
    scan, x, y, direction = np.concatenate([free, visible], axis=1)
    block, _, _ = _encode(np.stack([scan, x // 2, y // 2, direction]))
    sensors = int(max(sensor.max(initial=0), observer.max(initial=0))) + 1
    block, visible_block = block[: len(sensor)], block[len(sensor) :]
    view = _sorted_unique(block * sensors + sensor) // sensors
    agreed = _is_in(block, view[1:][view[1:] == view[:-1]])
    if not len(visible_block):
        return agreed
    # One view is enough if other sensors can see the block, but its own is the only one of them with a measurement.
    view, first = np.unique(visible_block * sensors + observer, return_index=True)
    blocks, of_view = np.unique(view // sensors, return_inverse=True)
    alone = (np.bincount(of_view) > 1) & (np.bincount(of_view, measured[visible[0, first], view % sensors]) == 1)
    return agreed | _is_in(block, blocks[alone])


def _cells_on_arcs(
    ring: Ring,
    robot: Float[np.ndarray, "echoes 3"],
    path: Int[np.ndarray, " echoes"],
    distance: Float[np.ndarray, " echoes"],
    scan: Int[np.ndarray, " echoes"],
) -> Int[np.ndarray, "4 points"]:
    """Cells that the arcs of echoes cross: rows of scan, cell x, cell y, direction. A cell may be repeated."""
    geometry = ring.echo_paths
    midpoint, start, width = (np.asarray(v)[path] for v in (geometry.midpoint, geometry.start, geometry.width))
    theta = robot[:, 2, None] + (start[:, None] + width[:, None] * np.linspace(0, 1, _FREE.arc_points))
    origin = robot[:, :2] + rotate(midpoint, robot[:, 2])
    reach = distance[:, None] + np.array([-_FREE.cell / 2, 0.0, _FREE.cell / 2])
    point = origin[:, None, None] + reach[:, None, :, None] * unit(theta)[:, :, None]
    who = np.broadcast_to(scan[:, None, None], point.shape[:3]).ravel()
    direction = np.broadcast_to(_sector_of(theta)[..., None], point.shape[:3]).ravel()
    cell_x, cell_y = np.floor(point / _FREE.cell).astype(np.int64).reshape(-1, 2).T
    return np.stack([who, cell_x, cell_y, direction])


def _distance_to_walls(
    sensor: Float[np.ndarray, "scans sensors 2"],
    ray: Float[np.ndarray, "scans sensors rays 2"],
    segments: Float[np.ndarray, "walls 2 2"],
) -> Float[np.ndarray, "scans sensors rays"]:
    """Distance along each ray to the first wall, or to where a wall may extend beyond its end, metres; inf for none."""
    along = segments[:, 1] - segments[:, 0]
    length = np.linalg.norm(along, axis=-1)
    tangent = along / np.maximum(length, 1e-9)[:, None]
    normal = perpendicular(tangent)
    offset = segments[:, 0] - sensor[..., None, :]
    toward = np.einsum("nsrk,wk->nsrw", ray, normal)
    distance = (offset * normal).sum(-1)[..., None, :] / np.where(np.abs(toward) > 1e-9, toward, np.nan)
    position = distance * np.einsum("nsrk,wk->nsrw", ray, tangent) - (offset * tangent).sum(-1)[..., None, :]
    # A ray that faces the wall would have detected the extension, so the extension occludes nothing from it.
    extension = np.where(np.abs(toward) < np.cos(_FREE.facing), _FREE.extension, 0.0)
    meets = (distance > 0) & (position > -extension) & (position < length + extension)
    return np.where(meets, distance, np.inf).min(axis=-1)


def _sector_of(theta: Float[np.ndarray, "*any"]) -> Int[np.ndarray, "*any"]:
    return np.floor(np.mod(theta, 2 * np.pi) / _FREE.sector).astype(np.int64) % _FREE.directions


def _sorted_unique(numbers: Int[np.ndarray, " some"]) -> Int[np.ndarray, " distinct"]:
    """As ``np.unique``, several times as fast."""
    numbers = np.sort(numbers)
    return numbers[np.append(True, numbers[1:] != numbers[:-1])] if len(numbers) else numbers


def _is_in(numbers: Int[np.ndarray, " some"], ordered: Int[np.ndarray, " ordered"]) -> Bool[np.ndarray, " some"]:
    """As ``np.isin``, for a sorted second argument."""
    if not len(ordered):
        return np.zeros(len(numbers), dtype=bool)
    return ordered[np.minimum(np.searchsorted(ordered, numbers), len(ordered) - 1)] == numbers


def _encode(
    rows: Int[np.ndarray, "columns rows"],
) -> tuple[Int[np.ndarray, " rows"], Int[np.ndarray, " columns"], tuple[int, ...]]:
    """An integer code for each column vector, in lexicographic order; the least value and the size of each row."""
    low = rows.min(axis=1, initial=0)
    size = tuple((rows.max(axis=1, initial=0) - low + 1).tolist())
    return np.asarray(np.ravel_multi_index(tuple(rows - low[:, None]), size)), low, size
