"""The arcs of echoes that a grid keeps: few for each viewpoint, so that their number grows with the building only."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.kernels.sensor_array import EchoPaths
from jaxsonar.kernels.shape_buckets import bucket_size, next_power_of_two, pad_rows
from jaxsonar.occupancy.settings import SETTINGS
from jaxsonar.sensors.ring import Ring

_CHUNK, _SMALL_CHUNK = 2048, 256  # sizes of arrays, so that few programs are compiled


class EchoArcs(NamedTuple):
    """Echoes with the poses at which they were received. Echoes that say the same are one arc."""

    pose: Float[np.ndarray, "arcs 3"]
    """world_from_robot, metres and radians."""
    path: Int[np.ndarray, " arcs"]
    """Row of ``Ring.paths``."""
    distance: Float[np.ndarray, " arcs"]
    """Corrected half path length, metres."""
    echoes: Int[np.ndarray, " arcs"]
    """Number of echoes that each arc stands for."""

    @classmethod
    def empty(cls) -> "EchoArcs":
        """No arc."""
        return cls(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64))

    @classmethod
    def concatenate(cls, parts: Sequence["EchoArcs"]) -> "EchoArcs":
        """All arcs of several collections."""
        return cls(*(np.concatenate(columns) for columns in zip(cls.empty(), *parts, strict=True)))

    def take(self, rows: Int[np.ndarray, " some"] | Bool[np.ndarray, " arcs"] | slice) -> "EchoArcs":
        """Some of the arcs (numbers, mask or slice)."""
        return EchoArcs(*(column[rows] for column in self))

    def thinned(self, limit: int) -> "EchoArcs":
        """One arc for all echoes of a path from about the same place, in the same direction and of the same range.

        The order of the echoes does not matter, unless there are more than ``limit`` arcs: then the cells of place,
        direction and range grow until so many remain.
        """
        size = 1.0
        while True:
            kept = self._merged(size)
            if len(kept.path) <= limit:
                return kept
            size *= 1.5

    def _merged(self, size: float) -> "EchoArcs":
        place, angle, step = (size * cell for cell in SETTINGS.arc_cell)
        key = np.column_stack(
            [self.path, np.floor(self.pose[:, :2] / place), np.floor(self.pose[:, 2] % (2 * np.pi) / angle)]
        )
        key = np.column_stack([key, np.floor(self.distance / step)]).astype(np.int64)
        order = np.lexsort((*self.pose.T, self.distance, *key.T))
        if not len(order):
            return self
        new = np.ones(len(order), bool)
        new[1:] = (np.diff(key[order], axis=0) != 0).any(axis=1)
        first = np.flatnonzero(new)
        rows = order[first]
        return EchoArcs(
            self.pose[rows], self.path[rows], self.distance[rows], np.add.reduceat(self.echoes[order], first)
        )


class ArcTable(NamedTuple):
    """Cells of arcs as indices into a flat grid; entries outside of the grid have weight 0."""

    cell: Int[np.ndarray, "arcs entries"]
    weight: Float[np.ndarray, "arcs entries"]


def soft_paths(ring: Ring) -> EchoPaths:
    """The echo paths, each with the arc of a direct path.

    Within two nominal cones, a wall is heard in the narrow range of directions that both cones share. Real beams end
    gradually: an echo is loud enough if the sum of its two losses is small, for neighbors in almost the same range of
    directions as for one sensor (``kernels.detection_cones.echo_level``).
    """
    paths = ring.echo_paths
    beam = np.minimum(np.asarray(ring.beam)[ring.paths].min(axis=1), np.pi)
    start, width = np.asarray(paths.start), np.asarray(paths.width)
    wide = np.where(width > 0, np.maximum(beam, width), 0).astype(width.dtype)
    return eqx.tree_at(
        lambda p: (p.start, p.width), paths, (jnp.asarray(start + (width - wide) / 2), jnp.asarray(wide))
    )


def arc_points(ring: Ring, resolution: float) -> int:
    """Number of points of an arc: at most a cell apart on the longest."""
    width = float(np.asarray(soft_paths(ring).width).max())
    return bucket_size(int(np.ceil(1.25 * ring.max_range * width / resolution)), least=16)


def arc_table(
    ring: Ring,
    arcs: EchoArcs,
    corner: tuple[int, int],
    shape: tuple[int, int],
    walls: Float[np.ndarray, "walls 2 2"],
    *,
    resolution: float,
) -> ArcTable:
    """Cells that each echo may come from.

    Args:
        ring: the sensors.
        arcs: the echoes.
        corner: first cell (column, row) of the grid, in cells of the world.
        shape: (rows, columns) of the grid.
        walls: known walls, which hide the cells behind them.
        resolution: side of a cell, metres.
    """
    paths, points = soft_paths(ring), arc_points(ring, resolution)
    entries = 2 * points
    cell, weight = np.zeros((len(arcs.path), entries), np.int32), np.zeros((len(arcs.path), entries), np.float32)
    origin = np.array([*corner, 0]) * [resolution, resolution, 0.0]
    # Echoes that are near each other share their walls.
    order = np.lexsort((arcs.pose[:, 1] // 4, arcs.pose[:, 0] // 4))
    for begin in range(0, len(order), _CHUNK):
        rows = order[begin : begin + _CHUNK]
        near = walls_near(walls, arcs.pose[rows, :2], 2 * ring.max_range)
        size = _CHUNK if len(rows) > _SMALL_CHUNK else _SMALL_CHUNK
        found = kernels.arcs_of_echoes(
            paths,
            pad_rows(arcs.path[rows], size),
            pad_rows((arcs.pose[rows] - origin).astype(np.float32), size),
            pad_rows(arcs.distance[rows].astype(np.float32), size),
            near - origin[:2].astype(np.float32),
            resolution=resolution,
            points=points,
        )
        column, row = np.asarray(found.column)[: len(rows)], np.asarray(found.row)[: len(rows)]
        inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
        cell[rows] = np.where(inside, row * shape[1] + column, 0)
        weight[rows] = np.where(inside, np.asarray(found.weight)[: len(rows)], 0)
    return ArcTable(cell, weight)


def walls_near(
    walls: Float[np.ndarray, "walls 2 2"], places: Float[np.ndarray, "places 2"], margin: float
) -> Float[np.ndarray, "padded 2 2"]:
    """Walls around places (metres), padded by walls without length to one of a few sizes."""
    low, high = places.min(axis=0) - margin, places.max(axis=0) + margin
    near: Bool[np.ndarray, " walls"] = ((walls.max(axis=1) >= low) & (walls.min(axis=1) <= high)).all(axis=1)
    return pad_rows(walls[near].astype(np.float32), next_power_of_two(int(near.sum()), least=16))
