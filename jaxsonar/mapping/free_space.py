"""No echo is free space: where, and facing which way, a wall would have been heard and was not.

A sensor that stays silent does not say that its whole cone is empty: a smooth wall answers only where it faces the
sensor. So what silence rules out is a wall at a place WITH a direction, and that is what is remembered: for every cell
of the floor and every direction of the normal the latest scans that would have heard a wall there.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.sensors.ring import Ring

CELL = 0.1
"""Side of a cell of the floor, metres."""
DIRECTIONS = 36
"""Directions of the normal that are told apart around the full turn."""
LATEST = 3
"""So many of the latest scans are remembered: what no fewer later ones see through is gone."""
MARGIN = 0.10
"""Metres that a wall must be nearer than the first echo, to have been missed for certain."""
SURE = 0.85
"""Share of the cone's width and of the maximum range within which a wall is heard for certain."""
HIDDEN = 1.0
"""Metres that a wall is taken to go on beyond its ends, hiding what is behind."""
FACING = float(np.radians(15.0))
"""Radians; a ray within this of a wall's normal faces the wall."""
_TILE = 32
_SECTOR = 2 * np.pi / DIRECTIONS
_RAYS, _POINTS = 17, 33  # of a cone, and on an arc


@dataclass(frozen=True, eq=False)
class SeenThrough:
    """The latest scans that saw through each place and direction; grows with the floor, not with the scans."""

    tiles: Mapping[tuple[int, int], Float[np.ndarray, "tile tile directions latest"]] = field(default_factory=dict)
    """When: seconds or scan numbers, as ``Pieces.latest``, latest first, -inf for never; tiles are never changed."""

    def look(
        self, points: Float[np.ndarray, "points 2"], theta: Float[np.ndarray, " points"]
    ) -> Float[np.ndarray, "points latest"]:
        """When walls at these points (metres) with these normals (radians) were seen through, latest first."""
        cell, direction = np.floor(points / CELL).astype(np.int64), _direction(theta)
        tile, inside = np.divmod(cell, _TILE)
        found = np.full((len(points), LATEST), -np.inf)
        for key in {tuple(t) for t in tile.tolist()} & self.tiles.keys():
            here = (tile == key).all(axis=1)
            found[here] = self.tiles[key][inside[here, 0], inside[here, 1], direction[here]]
        return found

    def look_around(
        self, points: Float[np.ndarray, "points 2"], theta: Float[np.ndarray, " points"]
    ) -> Float[np.ndarray, "points latest"]:
        """As ``look``, but scans that saw through the wall a cell's width further along it count as well.

        The rays of a scan are not as dense as the cells. Where none went through the very place, no neighbor counts.
        """
        beside = CELL * np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
        times = np.concatenate([self.look(points + k * beside, theta) for k in (0, -1, 1)], axis=-1)
        here = np.isfinite(times[:, :1])
        times = -np.sort(-np.where(here, np.minimum(times, times[:, :1]), -np.inf), axis=-1)
        again = np.zeros(times.shape, dtype=bool)
        again[:, 1:] = times[:, 1:] == times[:, :-1]
        return -np.sort(-np.where(again, -np.inf, times), axis=-1)[:, :LATEST]

    def including(self, cells: Int[np.ndarray, "cells 3"], when: Float[np.ndarray, " cells"]) -> "SeenThrough":
        """With further scans: (cell x, cell y, direction) that each saw through, and when. Order does not matter."""
        if not len(cells):
            return self
        tiles = dict(self.tiles)
        tile, inside = np.divmod(cells[:, :2], _TILE)
        order = np.lexsort((-when, cells[:, 2], cells[:, 1], cells[:, 0], tile[:, 1], tile[:, 0]))
        tile, inside, cells, when = tile[order], inside[order], cells[order], when[order]
        new = np.ones(len(cells), dtype=bool)
        new[1:] = (np.diff(cells, axis=0) != 0).any(axis=1)
        row = np.arange(len(cells))
        rank = row - np.maximum.accumulate(np.where(new, row, 0))
        late = rank < LATEST
        edges = np.flatnonzero(np.append(True, (np.diff(tile, axis=0) != 0).any(axis=1)))
        for first, last in zip(edges, [*edges[1:], len(tile)], strict=True):
            key = (int(tile[first, 0]), int(tile[first, 1]))
            part = np.arange(first, last)[late[first:last]]
            known = tiles.get(key)
            times = np.full((_TILE, _TILE, DIRECTIONS, 2 * LATEST), -np.inf)
            if known is not None:
                times[..., :LATEST] = known
            times[inside[part, 0], inside[part, 1], cells[part, 2], LATEST + rank[part]] = when[part]
            times = -np.sort(-times, axis=-1)
            tiles[key] = times[..., :LATEST]
        return SeenThrough(tiles)

    def joined(self, other: "SeenThrough") -> "SeenThrough":
        """The latest of both."""
        tiles = dict(self.tiles)
        for key, times in other.tiles.items():
            both = np.concatenate([tiles.get(key, np.full_like(times, -np.inf)), times], axis=-1)
            tiles[key] = -np.sort(-both, axis=-1)[..., :LATEST]
        return SeenThrough(tiles)


def silence(
    ring: Ring,
    pose: Float[np.ndarray, "scans 3"],
    scan: Int[np.ndarray, " echoes"],
    path: Int[np.ndarray, " echoes"],
    reach: Float[np.ndarray, " echoes"],
    walls: Sequence[Float[np.ndarray, "_ 2 2"]],
) -> tuple[Int[np.ndarray, "cells 3"], Int[np.ndarray, " cells"]]:
    """Where each scan would have heard a wall and did not: (cell x, cell y, direction), and whose scan it was.

    Only direct echoes speak: of the places before its first echo that a sensor faces, at least two must agree where two
    sensors face the same way (within 20 cm), and no echo of another path may come from there. What stands behind a wall
    that the scan itself shows is not judged.

    Args:
        ring: the sensors.
        pose: world_from_robot, metres and radians, all finite.
        scan: row of ``pose`` of each echo.
        path: row of ``ring.paths``.
        reach: corrected half path lengths, metres.
        walls: segments that each scan shows, world frame, metres.
    """
    geometry = ring.echo_paths
    midpoint, start, width = (np.asarray(values) for values in (geometry.midpoint, geometry.start, geometry.width))
    direct = np.flatnonzero((ring.paths[:, 0] == ring.paths[:, 1]) & (width > 0))
    first = np.full((len(pose), len(ring.paths)), SURE * ring.max_range + MARGIN)
    np.minimum.at(first, (scan, path), reach)
    ahead = np.arange(CELL / 2, SURE * ring.max_range, CELL * 0.7)

    # Sensors x directions x distances of all scans at once.
    turn = start[direct, None] + width[direct, None] * (0.5 + SURE * np.linspace(-0.5, 0.5, _RAYS))
    theta = pose[:, None, None, 2] + turn
    c, s = np.cos(pose[:, 2])[:, None], np.sin(pose[:, 2])[:, None]
    x, y = midpoint[direct, 0], midpoint[direct, 1]
    sensor = pose[:, None, :2] + np.stack([c * x - s * y, s * x + c * y], axis=-1)
    ray = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    free = np.broadcast_to(first[:, direct, None] - MARGIN, theta.shape).copy()
    for k, segments in enumerate(walls):
        if len(segments):
            free[k] = np.minimum(free[k], _hidden_from(sensor[k], ray[k], segments) - MARGIN)
    # A place is faced in a direction only if all walls with normals in that sector would be heard.
    facing = _direction(theta)
    begin = facing * _SECTOR - pose[:, None, None, 2] - start[direct, None]
    wide = np.mod(begin, 2 * np.pi) <= width[direct, None] - _SECTOR
    who, sensor_row, ray_row, step = np.nonzero((ahead < free[..., None]) & wide[..., None])
    ray_of = (who * len(direct) + sensor_row) * theta.shape[-1] + ray_row
    from_x, from_y = sensor.reshape(-1, 2)[who * len(direct) + sensor_row].T
    toward, way = ray.reshape(-1, 2)[ray_of], ahead[step]
    cell_x, cell_y = np.floor((from_x + way * toward[:, 0]) / CELL), np.floor((from_y + way * toward[:, 1]) / CELL)
    # A cell is nearer than the echo only if its middle is.
    near = np.hypot((cell_x + 0.5) * CELL - from_x, (cell_y + 0.5) * CELL - from_y) < free.ravel()[ray_of]
    who, sensor_row = who[near], sensor_row[near]
    claims = (who, cell_x[near].astype(np.int64), cell_y[near].astype(np.int64), facing.ravel()[ray_of[near]])
    # An echo of any path speaks against it, wherever its arc passes.
    turn = start[path, None] + width[path, None] * np.linspace(0, 1, _POINTS)
    theta = pose[scan, 2][:, None] + turn
    c, s = np.cos(pose[scan, 2]), np.sin(pose[scan, 2])
    x, y = midpoint[path, 0], midpoint[path, 1]
    origin = pose[scan, :2] + np.stack([c * x - s * y, s * x + c * y], axis=-1)
    ray = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    distance = reach[:, None] + np.array([-CELL / 2, 0.0, CELL / 2])
    point = origin[:, None, None] + distance[:, None, :, None] * ray[:, :, None]
    own = np.broadcast_to(scan[:, None, None], point.shape[:3]).ravel()
    facing = np.broadcast_to(_direction(theta)[..., None], point.shape[:3]).ravel()
    heard = (own, *np.floor(point / CELL).astype(np.int64).reshape(-1, 2).T, facing)

    code, low, size = _coded(np.concatenate([claims, heard], axis=1))
    count = len(who)
    cells = code[:count]
    if width[direct].sum() >= 2 * 2 * np.pi:  # two sensors face every way; they stand apart, and so do their places
        x, y = (np.asarray(values) // 2 for values in claims[1:3])
        around, _, _ = _coded(np.stack([claims[0], x, y, claims[3]]))
        place = _distinct(around * len(direct) + sensor_row) // len(direct)
        agreed = place[1:][place[1:] == place[:-1]]
        cells = cells[_among(around, agreed)]
    cells = _distinct(cells)
    cells = cells[~_among(cells, np.sort(code[count:]))]
    scan_of, x, y, facing = (value + first for value, first in zip(np.unravel_index(cells, size), low, strict=True))
    return np.column_stack([x, y, facing]), scan_of


def _distinct(numbers: Int[np.ndarray, " some"]) -> Int[np.ndarray, " distinct"]:
    """Each once, in order; ``np.unique`` takes several times as long."""
    numbers = np.sort(numbers)
    return numbers[np.append(True, numbers[1:] != numbers[:-1])] if len(numbers) else numbers


def _among(numbers: Int[np.ndarray, " some"], of: Int[np.ndarray, " ordered"]) -> Bool[np.ndarray, " some"]:
    """Which of the numbers are among others, which are in order."""
    if not len(of):
        return np.zeros(len(numbers), dtype=bool)
    return of[np.minimum(np.searchsorted(of, numbers), len(of) - 1)] == numbers


def _hidden_from(
    sensor: Float[np.ndarray, "sensors 2"],
    ray: Float[np.ndarray, "sensors rays 2"],
    segments: Float[np.ndarray, "walls 2 2"],
) -> Float[np.ndarray, "sensors rays"]:
    """How far each ray goes until it meets one of the walls, or where the wall may go on, metres."""
    along = segments[:, 1] - segments[:, 0]
    length = np.linalg.norm(along, axis=-1)
    tangent = along / np.maximum(length, 1e-9)[:, None]
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    offset = segments[:, 0] - sensor[:, None]
    toward = np.einsum("srk,wk->srw", ray, normal)
    way = (offset * normal).sum(-1)[:, None] / np.where(np.abs(toward) > 1e-9, toward, np.nan)
    where = way * np.einsum("srk,wk->srw", ray, tangent) - (offset * tangent).sum(-1)[:, None]
    # Where it is only guessed to go on, it would have been heard by whoever faces it, and hides nothing from them.
    further = np.where(np.abs(toward) < np.cos(FACING), HIDDEN, 0.0)
    meets = (way > 0) & (where > -further) & (where < length + further)
    return np.where(meets, way, np.inf).min(axis=-1)


def _direction(theta: Float[np.ndarray, "*any"]) -> Int[np.ndarray, "*any"]:
    return np.floor(np.mod(theta, 2 * np.pi) / _SECTOR).astype(np.int64) % DIRECTIONS


def _coded(
    rows: Int[np.ndarray, "columns rows"],
) -> tuple[Int[np.ndarray, " rows"], Int[np.ndarray, " columns"], tuple[int, ...]]:
    """One whole number for each row, the smallest value of each column, and how many values each may have."""
    low = rows.min(axis=1, initial=0)
    size = tuple((rows.max(axis=1, initial=0) - low + 1).tolist())
    return np.asarray(np.ravel_multi_index(tuple(rows - low[:, None]), size)), low, size
