"""Peers of the paper's method on the same scans: NumPy + OpenCV, a fused Numba loop, two Hough transforms of points.

The first two do the same arithmetic as ``extract_lines(..., method="hough")``; tests require the same cells and lines.
The others vote for points instead of tangents: other lines, but the same arcs, cells and points on arcs.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from benchmarks.detection.baselines import Arcs, PointHough
from jaxsonar import HoughSettings, Ring, kernels

MOST_LINES = 100
"""Maximum number of lines of ``cv2.HoughLinesPointSet``."""
Ranges = Float[np.ndarray, "paths slots"]
Batch = Float[np.ndarray, "scans paths slots"]


class Tables(NamedTuple):
    """Tables of a ring for all scans, single precision as in the product."""

    along: Float[np.ndarray, "paths points"]
    """m . n, metres."""
    across2: Float[np.ndarray, "paths points"]
    """(d . t)^2, square metres."""
    normal_x: Float[np.ndarray, "paths points"]
    normal_y: Float[np.ndarray, "paths points"]
    row: Int[np.ndarray, "paths points"]
    """Row of the accumulator."""
    points: Int[np.ndarray, " paths"]
    """Number of points of each arc."""
    half2: Float[np.ndarray, " paths"]
    """Square of the half baseline, square metres."""
    offset: Float[np.ndarray, " paths"]
    """Range offset, metres."""
    sensor: Float[np.ndarray, "paths 2"]
    """Midpoint of transmitter and receiver, metres."""
    scale: np.float32
    """Speed of sound divided by the reference speed of the ranges."""
    max_range: np.float32
    """Maximum range, metres."""
    level: np.float32
    """Threshold, votes."""

    @classmethod
    def of(cls, ring: Ring, settings: HoughSettings) -> "Tables":
        """Compute the tables from the ring, independently of the kernels."""
        paths, f = ring.echo_paths, np.float32
        width = np.asarray(paths.width)
        points = np.where(width > 0, np.maximum(np.round(width / f(settings.point_pitch)), 1), 0).astype(np.int64)
        index = np.arange(int(points.max()), dtype=f)
        step = width / np.maximum(points, 1).astype(f)
        theta = np.asarray(paths.start)[:, None] + (index + f(0.5)) * step[:, None]
        x, y = np.cos(theta), np.sin(theta)
        middle, half = np.asarray(paths.midpoint), np.asarray(paths.half_baseline)
        across = half[:, 1, None] * x - half[:, 0, None] * y
        row = np.floor((theta + f(np.pi)) % f(2 * np.pi) / f(settings.theta_cell)).astype(np.int64)
        return cls(
            along=middle[:, 0, None] * x + middle[:, 1, None] * y,
            across2=across**2,
            normal_x=x,
            normal_y=y,
            row=np.minimum(row, settings.theta_cells - 1).astype(np.int32),
            points=points,
            half2=(half**2).sum(axis=1),
            offset=np.asarray(paths.range_offset),
            sensor=middle,
            scale=f(ring.sensors.range_scale),
            max_range=f(ring.max_range),
            level=f(settings.threshold * kernels.full_wall_votes(paths, settings)),
        )


class NumpyPeer:
    """A straightforward implementation, scan by scan: NumPy arc tables, np.bincount, cv2.filter2D, cv2 components."""

    def __init__(self, ring: Ring, settings: HoughSettings):
        """Compute the tables of the ring."""
        self.tables, self.settings = Tables.of(ring, settings), settings
        self.kernel = np.outer(settings.smoothing, settings.smoothing).astype(np.float32)
        self.kernel /= self.kernel.sum()

    def votes(self, ranges: Ranges) -> tuple[Int[np.ndarray, "theta rho"], tuple[np.ndarray, ...]]:
        """Accumulator of one scan; path, rho and cell (-1: none) of its points, (echoes, points)."""
        t, s = self.tables, self.settings
        path, slot = np.nonzero(~np.isnan(ranges))
        distance = (ranges[path, slot] - t.offset[path]) * t.scale
        valid = (distance < t.max_range) & (distance > 0) & (distance**2 > t.half2[path])
        path, distance = path[valid], distance[valid, None]
        rho = t.along[path] + np.sqrt(np.maximum(distance**2 - t.across2[path], 0))
        row = np.where(rho < 0, t.row[path] + s.theta_cells // 2, t.row[path]) % s.theta_cells
        column = np.floor(np.abs(rho) / np.float32(s.rho_cell)).astype(np.int64)
        in_grid = (np.arange(rho.shape[1]) < t.points[path][:, None]) & (column < s.rho_cells)
        cell = np.where(in_grid, row * s.rho_cells + column, -1)
        votes = np.bincount(cell[in_grid], minlength=s.cells).reshape(s.theta_cells, s.rho_cells)
        return votes, (path, rho, cell)

    def occupied(self, votes: Int[np.ndarray, "theta rho"]) -> Bool[np.ndarray, "theta rho"]:
        """Low pass across both seams, and threshold."""
        half, half_turn = len(self.settings.smoothing) // 2, self.settings.theta_cells // 2
        before = np.roll(votes[:, :half][:, ::-1], half_turn, axis=0)
        padded = np.concatenate([before, votes, np.zeros_like(before)], axis=1).astype(np.float32)
        padded = np.concatenate([padded[len(padded) - half :], padded, padded[:half]])
        smooth = cv2.filter2D(padded, -1, self.kernel)
        rows, columns = votes.shape
        return smooth[half : half + rows, half : half + columns] > self.tables.level

    def lines(self, ranges: Ranges) -> list[tuple[float, float]]:
        """Lines (rho, theta) of one scan, strongest first."""
        t, s = self.tables, self.settings
        votes, (path, rho, cell) = self.votes(ranges)
        count, labels = cv2.connectedComponents(self.occupied(votes).astype(np.uint8), connectivity=8)
        beyond_seam = self._join_seams(labels)
        of_point = np.where(cell >= 0, labels.ravel()[cell], 0)
        sign = np.where((rho < 0) ^ np.where(cell >= 0, beyond_seam.ravel()[cell], False), -1, 1)
        lines = []
        for k in range(1, count):
            in_component = of_point == k
            if in_component.any(axis=1).sum() >= s.min_echoes:
                x = (sign * t.normal_x[path])[in_component].mean()
                y = (sign * t.normal_y[path])[in_component].mean()
                distance, angle = float((sign * rho)[in_component].mean()), float(np.arctan2(y, x))
                if distance < 0:
                    distance, angle = -distance, (angle + 2 * np.pi) % (2 * np.pi) - np.pi
                lines.append((int(in_component.sum()), distance, angle))
        return [(rho, theta) for _, rho, theta in sorted(lines, key=lambda one: -one[0])]

    def _join_seams(self, labels: Int[np.ndarray, "theta rho"]) -> Bool[np.ndarray, "theta rho"]:
        """Merge components that touch across a seam; returns the cells beyond rho = 0."""
        rows = self.settings.theta_cells
        beyond_seam = np.zeros(labels.shape, bool)
        for column in np.flatnonzero(labels[0]):  # the seam of theta
            for b in labels[-1, max(column - 1, 0) : column + 2]:
                if b and b != labels[0, column]:
                    labels[labels == b] = labels[0, column]
        crossed = set()
        for row in np.flatnonzero(labels[:, 0]):  # the cell before rho = 0 is half a turn further
            for turn in (-1, 0, 1):
                b = labels[(row + rows // 2 + turn) % rows, 0]
                if b:
                    labels[labels == b] = labels[row, 0]
                    crossed.add(int(labels[row, 0]))
        for k in crossed & set(np.unique(labels).tolist()):
            cells = np.argwhere(labels == k)
            turn = (cells[:, 0] - cells[0, 0]) % rows
            beyond_seam[tuple(cells[np.minimum(turn, rows - turn) > rows // 4].T)] = True
        return beyond_seam


class FusedPeer:
    """One loop over the scans, compiled by Numba for one thread; all steps of a scan stay in the cache."""

    def __init__(self, ring: Ring, settings: HoughSettings):
        """Compute the tables of the ring."""
        from benchmarks.speed import numba_baseline

        if tuple(settings.smoothing) != (1.0, 2.0, 1.0):
            raise ValueError(f"smoothing {settings.smoothing}; the loop supports only 1, 2, 1")
        self.tables, self.settings, self.loops = Tables.of(ring, settings), settings, numba_baseline
        self.cells = settings.theta_cells, settings.rho_cells, np.float32(settings.rho_cell)

    def votes(self, ranges: Batch) -> Int[np.ndarray, "scans theta rho"]:
        """Accumulators of a batch."""
        return self.loops.votes(ranges, *self._arguments)

    def occupied(self, ranges: Batch) -> Bool[np.ndarray, "scans theta rho"]:
        """Occupied cells of a batch: votes, low pass, threshold."""
        return self.loops.occupied(ranges, *self._arguments)

    def lines(self, ranges: Batch) -> tuple[np.ndarray, ...]:
        """rho, theta, votes, echoes and segments of a batch, strongest first; NaN (0 echoes) for no line."""
        return self.loops.lines(ranges, *self._arguments, self.settings.min_echoes)

    @property
    def _arguments(self) -> tuple:
        return tuple(self.tables), self.cells


class PointSetPeer:
    """``cv2.HoughLinesPointSet`` on the points of the arcs; the points are computed before the timing."""

    def __init__(
        self,
        ring: Ring,
        settings: HoughSettings,
        *,
        rho_cell: float | None = None,
        theta_cell: float | None = None,
    ):
        """Use the cells of the settings, or other cells (metres, radians); half a turn, rho of both signs."""
        self.ring, self.settings = ring, settings
        self.rho_cell, self.theta_cell = rho_cell or settings.rho_cell, theta_cell or settings.theta_cell
        self.point_maker = PointHough(pitch=settings.point_pitch)
        first, last = np.asarray(ring.detection_ranges, dtype=np.float64).T
        self.first, self.width = first, last - first
        self.threshold = int(settings.threshold * float(kernels.full_wall_votes(ring.echo_paths, settings)))

    def points(self, ranges: Ranges) -> Float[np.ndarray, "points 1 2"]:
        """Points (x, y) of one scan's arcs, metres."""
        path, slot = np.nonzero(np.isfinite(ranges))
        tx, rx = self.ring.paths[path].T
        position = np.asarray(self.ring.position, dtype=np.float64)
        half = (position[rx] - position[tx]) / 2
        distance = np.asarray(self.ring.corrected(ranges[path, slot], tx, rx), dtype=np.float64)
        valid = (distance < self.ring.max_range) & (distance > np.linalg.norm(half, axis=1)) & (self.width[path] > 0)
        middle = (position[rx] + position[tx]) / 2
        arcs = Arcs(middle, half, distance, self.first[path], self.width[path], full=0.0).take(valid)
        return self.point_maker.points(arcs).astype(np.float32)[:, None]

    def lines(self, points: Float[np.ndarray, "points 1 2"]) -> object:
        """Votes, rho and theta of lines, as returned by OpenCV."""
        max_rho = self.settings.max_rho
        span = -max_rho, max_rho, self.rho_cell, 0.0, np.pi, self.theta_cell
        return cv2.HoughLinesPointSet(points, MOST_LINES, self.threshold, *span)


class RasterPeer:
    """``skimage.transform.hough_line`` on an image of the arcs; the image is drawn before the timing."""

    def __init__(self, settings: HoughSettings):
        """Use pixels of the size of the cells in rho, and the directions of half a turn."""
        from skimage.transform import hough_line

        self.settings, self.hough_line = settings, hough_line
        self.theta = np.linspace(-np.pi / 2, np.pi / 2, settings.theta_cells // 2, endpoint=False)

    def raster(self, points: Float[np.ndarray, "points 1 2"]) -> Bool[np.ndarray, "y x"]:
        """Image of the points."""
        size = self.settings.rho_cells
        image = np.zeros((2 * size, 2 * size), bool)
        x, y = np.floor(points[:, 0] / self.settings.rho_cell).astype(int).T + size
        inside = (x >= 0) & (x < 2 * size) & (y >= 0) & (y < 2 * size)
        image[y[inside], x[inside]] = True
        return image

    def lines(self, image: Bool[np.ndarray, "y x"]) -> object:
        """Accumulator, directions and distances; no maxima."""
        return self.hough_line(image, theta=self.theta)
