"""Evidence of scans for the cells of a grid: what was seen through, and the echoes that are to be explained."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt16

from jaxsonar import kernels
from jaxsonar.geometry.se2 import compose, transform_points
from jaxsonar.hardware.errors import SonarError
from jaxsonar.kernels.shape_buckets import pad_rows
from jaxsonar.occupancy.direct_readings import DirectReadings, TransducerArrays, footprint_cells
from jaxsonar.occupancy.echo_arcs import EchoArcs, arc_points, walls_near
from jaxsonar.occupancy.echo_attribution import explained_by_map
from jaxsonar.occupancy.known_reflectors import KnownReflectors
from jaxsonar.occupancy.settings import SETTINGS
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

GridMethod = Literal["counts", "elfes", "wilkes", "logodds", "em"]
"""How echoes become obstacles, see ``occupancy``."""
METHODS: tuple[GridMethod, ...] = ("counts", "elfes", "wilkes", "logodds", "em")
"""All of them."""
_BATCH = 16  # scans of one call of the kernel


class Area(NamedTuple):
    """Cells of the world that a grid covers."""

    corner: tuple[int, int]
    """First cell (column, row)."""
    shape: tuple[int, int]
    """(rows, columns)"""

    @classmethod
    def around(cls, places: Float[np.ndarray, "places 2"], margin: float, resolution: float) -> "Area":
        """The cells within a margin of places, metres.

        Raises:
            SonarError: too many cells.
        """
        if (np.abs(places) > SETTINGS.max_coordinate).any():
            far = f"{np.abs(places).max():g}"
            raise SonarError(f"grid: a pose at {far} m came; allowed are up to {SETTINGS.max_coordinate:g} m")
        half = int(np.ceil(margin / resolution)) + 2
        low, high = (np.floor(end(places, axis=0) / resolution) for end in (np.min, np.max))
        size = high - low + 2 * half + 1
        if np.prod(size) > SETTINGS.max_cells:
            area = " x ".join(f"{side:g}" for side in np.ptp(places, axis=0) + 2 * margin)
            raise SonarError(
                f"grid: {area} m in cells of {resolution:g} m; allowed are {SETTINGS.max_cells} cells at most"
            )
        column, row = (int(k) - half for k in low)
        return cls((column, row), (int(size[1]), int(size[0])))

    def union(self, other: "Area") -> "Area":
        """The smallest area that holds both."""
        low = np.minimum(self.corner, other.corner)
        high = np.maximum(self.end, other.end)
        return Area((int(low[0]), int(low[1])), (int(high[1] - low[1]), int(high[0] - low[0])))

    @property
    def end(self) -> tuple[int, int]:
        """The cell (column, row) after the last."""
        return self.corner[0] + self.shape[1], self.corner[1] + self.shape[0]

    def window(self, corner: Sequence[int], shape: Sequence[int]) -> tuple[slice, slice]:
        """Slices (rows, columns) of a part with this first cell (column, row) and shape."""
        column, row = corner[0] - self.corner[0], corner[1] - self.corner[1]
        return slice(row, row + shape[0]), slice(column, column + shape[1])

    def mask(self, cells: Int[np.ndarray, "cells 2"]) -> np.ndarray:
        """Which cells of the area are among these cells (column, row) of the world."""
        found = np.zeros(self.shape, bool)
        column, row = (cells - self.corner).T
        inside = (column >= 0) & (row >= 0) & (column < self.shape[1]) & (row < self.shape[0])
        found[row[inside], column[inside]] = True
        return found


class GridEvidence:
    """Accumulates scans. Its size grows with the area of the floor, not with the number of scans.

    The order of the scans does not matter, as long as the known reflectors are the same and the arcs are few.
    """

    def __init__(
        self, ring: Ring, *, resolution: float = 0.05, method: GridMethod = "counts", certain: float | None = None
    ):
        """Without any scan.

        Args:
            ring: the sensors.
            resolution: side of a cell, metres.
            method: which echoes are kept.
            certain: angle off the axis up to which walls are heard for sure, radians; a part of the cone if omitted.

        Raises:
            SonarError: an unknown method; a resolution that is not from 1 mm to 10 m, or too fine for the ring's range.
        """
        if method not in METHODS:
            raise SonarError(f"grid: method {method!r}; allowed are {', '.join(METHODS)}")
        if not 1e-3 <= resolution <= 10:
            raise SonarError(f"grid: resolution {resolution:g} m; allowed is 0.001 to 10 m")
        if ring.max_range > SETTINGS.max_range_cells * resolution:
            came = f"max_range {ring.max_range:g} m in cells of {resolution:g} m"
            raise SonarError(f"grid: {came}; allowed is at most {SETTINGS.max_range_cells} cells far")
        self.resolution, self.method, self._certain = resolution, method, certain
        self.set_ring(ring)
        self.area = Area((0, 0), (0, 0))
        self.passes: UInt16[np.ndarray, "directions rows columns"] = np.zeros((kernels.DIRECTIONS, 0, 0), np.uint16)
        """Scans that looked through each cell, by the direction of the walls that they would have heard."""
        self.looks: Int[np.ndarray, "rows columns"] = np.zeros((0, 0), np.int32)
        """Looks through each cell, in 1/16, weighted by the angle off the axis."""
        self.footprint: Int[np.ndarray, "rows columns"] = np.zeros((0, 0), np.int32)
        """Scans in which the robot stood on each cell."""
        self.scans = self.skipped = 0
        """Scans in the grid, and scans that were left out because they have no pose."""
        self._arcs, self._new_arcs = EchoArcs.empty(), list[EchoArcs]()
        self._max_arcs = min(SETTINGS.max_arcs, SETTINGS.max_arc_cells // (2 * arc_points(ring, resolution)))

    def set_ring(self, ring: Ring) -> None:
        """Use another ring from now on: the same sensors, with another speed of sound or calibration."""
        self.ring, self.sensors = ring, TransducerArrays.of(ring)
        half_width = self.sensors.half_width
        given = SETTINGS.free.certain * half_width if self._certain is None else np.full(len(half_width), self._certain)
        self.certain = np.minimum(given, half_width)

    @property
    def arcs(self) -> EchoArcs:
        """Echoes that are to be explained."""
        if self._new_arcs:
            self._arcs = EchoArcs.concatenate([self._arcs, *self._new_arcs]).thinned(self._max_arcs)
            self._new_arcs = []
        return self._arcs

    def add(self, log: Log, known: KnownReflectors) -> None:
        """Add the scans of a log.

        Args:
            log: firings that stand in scans of their own must be grouped (``group_firings``).
            known: reflectors that hide what is behind them and explain echoes.

        Raises:
            SonarError: poses too far apart for a grid; a sensor number that the ring does not have.
        """
        posed = np.asarray(np.isfinite(log.pose).all(axis=-1))
        readings = DirectReadings.of(self.ring, log)
        self._reserve(log, posed, readings)
        self.skipped += int((~posed).sum())
        rows = np.flatnonzero(posed)
        if not len(rows):
            return
        for begin in range(0, len(rows), _BATCH):
            self._see_through(readings, log.pose, rows[begin : begin + _BATCH], known)
        self._keep_echoes(log, posed, known)
        self.scans += len(rows)

    def reserve(self, log: Log) -> None:
        """Make room for the scans of a log, without adding them.

        Raises:
            SonarError: as ``add``; then nothing has changed.
        """
        posed = np.asarray(np.isfinite(log.pose).all(axis=-1))
        self._reserve(log, posed, DirectReadings.of(self.ring, log))

    def _reserve(self, log: Log, posed: Bool[np.ndarray, " scans"], readings: DirectReadings) -> None:
        if posed.any():
            robot = readings.robot[posed][readings.measured[posed]]
            places = np.concatenate([log.pose[posed, :2], robot[:, :2]])
            self._grow(Area.around(places, self.sensors.max_distance, self.resolution))

    def _grow(self, area: Area) -> None:
        """Make room for an area."""
        bigger = area if not self.looks.size else self.area.union(area)
        if bigger == self.area:
            return
        if bigger.shape[0] * bigger.shape[1] > SETTINGS.max_cells:
            side = " x ".join(f"{cells * self.resolution:g}" for cells in bigger.shape[::-1])
            raise SonarError(
                f"grid: {side} m in cells of {self.resolution:g} m; allowed are {SETTINGS.max_cells} cells at most"
            )
        here = bigger.window(self.area.corner, self.area.shape)
        for name in ("passes", "looks", "footprint"):
            old = getattr(self, name)
            new = np.zeros((*old.shape[:-2], *bigger.shape), old.dtype)
            if old.size:
                new[..., *here] = old
            setattr(self, name, new)
        self.area = bigger

    def _see_through(
        self,
        readings: DirectReadings,
        pose: Float[np.ndarray, "scans 3"],
        rows: Int[np.ndarray, " rows"],
        known: KnownReflectors,
    ) -> None:
        """Add what a batch of scans saw through, and where the robot stood."""
        sensors, resolution, free = self.sensors, self.resolution, SETTINGS.free
        here = DirectReadings(readings.measured[rows], readings.first_echo[rows], readings.robot[rows])
        robot, measured = here.robot, here.measured
        for row in rows:
            column, line = (footprint_cells(sensors, pose[row], resolution) - self.area.corner).T
            self.footprint[line, column] += 1
        position = transform_points(robot, sensors.position)
        center = np.floor(pose[rows, :2] / resolution).astype(int)
        far = np.linalg.norm(position - (center * resolution)[:, None], axis=-1)
        motion = float(np.where(measured, far, 0).max(initial=0.0)) - float(
            np.linalg.norm(sensors.position, axis=-1).max()
        )
        size = 2 * (int(np.ceil((sensors.max_distance + max(motion, 0.0)) / resolution)) + 2)
        size = -(-size // 16) * 16
        low = center - size // 2
        sensor_pose = np.concatenate(
            [position - (low * resolution)[:, None], (sensors.heading + robot[..., 2])[..., None]], axis=-1
        )
        first_echo = np.where(measured, np.minimum(here.quiet_range(self.ring.max_range), self.ring.max_range), 0.0)
        walls = walls_near(known.walls, pose[rows, :2], sensors.max_distance + max(motion, 0.0))
        walls = walls[None] - (low * resolution)[:, None, None].astype(np.float32)
        half_width = np.maximum(sensors.half_width, 1e-3)
        cone_corner, cone = _cone_squares(sensor_pose, half_width, self.ring.max_range, resolution, size)
        found = kernels.seen_through(
            pad_rows(sensor_pose.astype(np.float32), _BATCH),
            pad_rows(cone_corner, _BATCH),
            half_width.astype(np.float32),
            pad_rows(first_echo.astype(np.float32), _BATCH),
            pad_rows(walls, _BATCH),
            certain=self.certain.astype(np.float32),
            margin=np.float32(resolution / np.sqrt(2) + free.range_margin),
            resolution=resolution,
            size=size,
            cone=cone,
            rays=int(np.ceil(2 * half_width.max() * self.ring.max_range / resolution)),
        )
        directions = np.asarray(found.directions)[: len(rows)]
        looks = np.rint(16 * np.asarray(found.looks)[: len(rows)]).astype(np.int32)
        column, row = low[:, 0] - self.area.corner[0], low[:, 1] - self.area.corner[1]
        for scan in range(len(rows)):
            # Parts of the tile that no sensor can reach may lie outside of the area.
            first = max(-column[scan], 0), max(-row[scan], 0)
            last = min(self.area.shape[1] - column[scan], size), min(self.area.shape[0] - row[scan], size)
            tile = slice(first[1], last[1]), slice(first[0], last[0])
            place = (
                slice(row[scan] + first[1], row[scan] + last[1]),
                slice(column[scan] + first[0], column[scan] + last[0]),
            )
            bits = directions[scan][tile]
            self.looks[place] += looks[scan][tile]
            for k in np.flatnonzero([(bits & (1 << k)).any() for k in range(kernels.DIRECTIONS)]):
                part = self.passes[k][place]
                part += ((bits >> k) & 1).astype(np.uint16) & (part < np.iinfo(np.uint16).max)

    def _keep_echoes(self, log: Log, posed: Bool[np.ndarray, " scans"], known: KnownReflectors) -> None:
        """Keep the echoes that the method explains."""
        ring = self.ring
        flat, _ = FlatEchoes.from_log(ring, log)
        tx, rx = ring.paths[flat.path].T
        distance = np.asarray(ring.corrected(flat.reported, tx, rx))
        kept = posed[flat.scan] & (distance > 0) & (distance < ring.max_range)
        if self.method in ("elfes", "wilkes"):
            kept &= tx == rx
        if self.method == "elfes":
            first = np.full((len(log), len(ring.paths)), np.inf)
            np.minimum.at(first, (flat.scan, flat.path), np.where(kept, distance, np.inf))
            kept &= distance <= first[flat.scan, flat.path]
        rows = np.flatnonzero(kept)
        pose = log.pose[flat.scan[rows]]
        if flat.path_pose is not None:
            pose = compose(pose, flat.path_pose[flat.scan[rows], flat.path[rows]])
        arcs = EchoArcs(pose, flat.path[rows], distance[rows], np.ones(len(rows), np.int64))
        if self.method == "counts":
            arcs = self._unexplained(arcs, known)
        self._new_arcs.append(arcs)
        if sum(len(part.path) for part in self._new_arcs) > self._max_arcs:
            _ = self.arcs  # thin them now

    def _unexplained(self, arcs: EchoArcs, known: KnownReflectors) -> EchoArcs:
        """The arcs that no known reflector explains."""
        explained = np.zeros(len(arcs.path), bool)
        reach = self.sensors.max_distance + SETTINGS.reflectors.explained
        for begin in range(0, len(explained), 1024):
            part = arcs.take(slice(begin, begin + 1024))
            near = known.near(part.pose[:, :2].min(axis=0) - reach, part.pose[:, :2].max(axis=0) + reach)
            explained[begin : begin + 1024] = explained_by_map(near, self.ring, part)
        return arcs.take(~explained)


def _cone_squares(
    sensor_pose: Float[np.ndarray, "scans sensors 3"],
    half_width: Float[np.ndarray, " sensors"],
    max_range: float,
    resolution: float,
    size: int,
) -> tuple[Int[np.ndarray, "scans sensors 2"], int]:
    """First cells (column, row) of squares that hold the cones of sensors in a tile, and the side of the squares."""
    angle = sensor_pose[..., 2:] + np.linspace(-1, 1, 9) * (half_width[:, None] + kernels.CONE_MARGIN)
    rim = max_range * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    # Between the sampled directions, the cone reaches a little farther than the chord.
    widest = float(half_width.max()) + kernels.CONE_MARGIN
    sagitta = max_range * (1 - np.cos(widest / 8)) + 2 * resolution
    low = np.minimum(rim.min(axis=2), 0) - sagitta
    # In any direction, a cone is at most as long as its radius or its longest chord.
    across = max_range * max(2 * np.sin(min(widest, np.pi / 2)), 1.0) + 2 * sagitta
    cone = min(size, -(-int(np.ceil(across / resolution) + 2) // 8) * 8)
    corner = np.floor((sensor_pose[..., :2] + low) / resolution).astype(np.int32)
    return np.clip(corner, 0, size - cone), cone
