"""Baselines on the same arcs: a Hough transform of their points, and consensus of pairs of arcs.

Run ``python -m benchmarks.detection.tune_baselines`` to tune both on rooms that the accuracy benchmark does not use.
The defaults below are the result. Each takes the arcs of one scan and gives its lines (rho, theta), strongest first.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import Log, Ring
from jaxsonar.geometry.se2 import wrap_angle

Lines = Float[np.ndarray, "lines 2"]

NEAR_RHO, NEAR_THETA = 0.10, float(np.radians(15.0))
"""Metres and radians within which two lines of one scan are one wall: the gates of ``evaluation.line_accuracy``."""

TUNING = 1_000_003
"""Seed of the rooms on which the baselines were tuned."""

SHORTEST_BASE = 0.03
"""Minimum distance of two virtual sensors whose common tangent is a hypothesis, metres."""


@dataclass(frozen=True)
class Arcs:
    """Echoes of one scan as arcs of circles and ellipses, robot frame, metres and radians."""

    middle: Float[np.ndarray, "echoes 2"]
    """Midpoint of transmitter and receiver."""
    half: Float[np.ndarray, "echoes 2"]
    """Half of the vector from transmitter to receiver."""
    distance: Float[np.ndarray, " echoes"]
    """Half of the path length."""
    start: Float[np.ndarray, " echoes"]
    """Start of the detection range, counter-clockwise."""
    width: Float[np.ndarray, " echoes"]
    """Width of the detection range."""
    full: float
    """Mean number of the ring's paths that receive a wall, over its directions."""

    def take(self, index: Int[np.ndarray, " some"] | Bool[np.ndarray, " echoes"]) -> "Arcs":
        """A selection of the arcs."""
        some = (column[index] for column in (self.middle, self.half, self.distance, self.start, self.width))
        return Arcs(*some, full=self.full)

    def sees(self, theta: Float[np.ndarray, "#echoes"] | float) -> Bool[np.ndarray, "..."]:
        """Whether each direction is in the detection range. The tolerance of 2 deg is for near walls."""
        soft = np.radians(2.0)
        return (theta - self.start + soft) % (2 * np.pi) <= self.width + 2 * soft

    def height(
        self, theta: Float[np.ndarray, "#echoes"] | float
    ) -> tuple[Float[np.ndarray, " echoes"], Float[np.ndarray, " echoes"]]:
        """Distance from the midpoint to the tangent with this normal, and its derivative with respect to theta."""
        along, across = _along_across(self.half, theta)
        height = np.sqrt(np.maximum(self.distance**2 - across**2, 1e-12))
        return height, across * along / height

    def ranges(self, rho: Float[np.ndarray, "#lines"], theta: Float[np.ndarray, "#lines"]) -> np.ndarray:
        """(lines, echoes) half path lengths of planes."""
        along, _ = _along_across(self.middle, theta[:, None])
        _, across = _along_across(self.half, theta[:, None])
        return np.hypot(rho[:, None] - along, across)


def arcs_of_scans(ring: Ring, log: Log) -> Iterator[Arcs]:
    """The arcs of every scan of a log: echoes within the maximum range on paths that can receive a plane."""
    tx, rx = ring.paths.T
    first, last = np.asarray(ring.detection_ranges, dtype=np.float64).T
    width = last - first
    full = float(width.sum() / (2 * np.pi))
    position = np.asarray(ring.position)
    half, middle = (position[rx] - position[tx]) / 2, (position[rx] + position[tx]) / 2
    path = ring.path_index[log.tx, log.rx]
    distance = np.asarray(ring.corrected(log.range, log.tx, log.rx))
    valid = (
        (path >= 0) & (distance < ring.max_range) & (width > 0)[path] & (distance > np.linalg.norm(half, axis=-1)[path])
    )
    for begin, end in itertools.pairwise(log.start):
        index = np.arange(begin, end)[valid[begin:end]]
        row = path[index]
        yield Arcs(middle[row], half[row], distance[index], first[row], width[row], full)


@dataclass(frozen=True)
class PointHough:
    """``cv2.HoughLinesPointSet`` on points of the arcs, then non-maximum suppression."""

    pitch: float = float(np.radians(1.0))
    """Angle between the points along an arc, radians."""
    rho_cell: float = 0.01
    """Size of a cell in rho, metres."""
    theta_cell: float = float(np.radians(2.0))
    """Size of a cell in theta, radians."""
    threshold: float = 5.0
    """Votes (points) that a line needs, per path that can receive it."""

    def __call__(self, arcs: Arcs, sigma: float) -> Lines:
        """Lines of one scan. The noise is not used."""
        points = self.points(arcs).astype(np.float32)
        if not len(points):
            return np.zeros((0, 2))
        far = float(np.linalg.norm(points, axis=-1).max()) + self.rho_cell
        # rho from -far to far over half a turn gives the same lines as 0 to far over a full turn, without a seam.
        span = -far, far, self.rho_cell, 0.0, np.pi, self.theta_cell
        found = cv2.HoughLinesPointSet(points[:, None], 500, round(self.threshold * arcs.full), *span)
        if found is None:
            return np.zeros((0, 2))
        return distinct(_normalized(np.asarray(found).reshape(-1, 3)[:, 1:]))

    def points(self, arcs: Arcs) -> Float[np.ndarray, "points 2"]:
        """Points of tangency at equal steps of the normal."""
        count = np.maximum(np.round(arcs.width / self.pitch), 1).astype(int)
        index = np.repeat(np.arange(len(count)), count)
        k = np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count)
        some = arcs.take(index)
        theta = some.start + (k + 0.5) * (arcs.width / count)[index]
        height, slide = some.height(theta)
        return some.middle + height[:, None] * _normal(theta) + slide[:, None] * _normal(theta + np.pi / 2)


@dataclass(frozen=True)
class PairConsensus:
    """RANSAC on pairs of arcs: common tangents are hypotheses, the range residuals decide, the best line is removed."""

    gate: float = 2.5
    """Maximum residual of an inlier, in standard deviations of the noise."""
    min_inliers: float = 0.4
    """Minimum number of inliers, as a share of the paths that can receive the line."""
    hypotheses: int = 1000
    """Maximum number of pairs of arcs."""
    seed: int = 0

    def __call__(self, arcs: Arcs, sigma: float) -> Lines:
        """Lines of one scan. ``sigma`` is the noise of the ranges, metres."""
        gate, min_inliers = max(self.gate * sigma, 1e-6), max(self.min_inliers * arcs.full, 3)
        rho, theta = self.tangents(arcs)
        agree = (np.abs(arcs.ranges(rho, theta) - arcs.distance) < gate) & arcs.sees(theta[:, None])
        remaining = np.ones(len(arcs.distance), dtype=bool)
        found: list[np.ndarray] = []
        while True:
            kept = (agree & remaining).sum(axis=1) >= min_inliers
            agree, rho, theta = agree[kept], rho[kept], theta[kept]
            if not len(agree):
                return distinct(_normalized(np.array(found).reshape(-1, 2)))
            best = int((agree & remaining).sum(axis=1).argmax())
            line, inliers = _refit(arcs, np.array([rho[best], theta[best]]), remaining, gate)
            if inliers.sum() >= min_inliers:
                found.append(line)
                residual = np.abs(arcs.ranges(line[:1], line[1:])[0] - arcs.distance)
                remaining &= ~((residual < 2 * gate) & arcs.sees(line[1]))
            agree[best] = False

    def tangents(self, arcs: Arcs) -> tuple[Float[np.ndarray, " lines"], Float[np.ndarray, " lines"]]:
        """Common tangents (rho, theta) of pairs of arcs within both detection ranges; a sample of all pairs."""
        first, second = np.triu_indices(len(arcs.distance), 1)
        a, b = arcs.take(first), arcs.take(second)
        base = b.middle - a.middle
        apart = np.linalg.norm(base, axis=-1)
        sine = (a.distance - b.distance) / np.maximum(apart, 1e-12)
        crossing = np.flatnonzero((apart > SHORTEST_BASE) & (np.abs(sine) < 1))
        # Two circles: the normal of the tangent is at arccos((r1 - r2) / base) on each side of the base.
        side = np.concatenate([crossing, crossing])
        angle = np.repeat([1.0, -1.0], len(crossing)) * np.arccos(sine[side])
        theta = np.arctan2(base[side, 1], base[side, 0]) + angle
        near = a.take(side).sees(theta) & b.take(side).sees(theta)
        side, theta = side[near], theta[near]
        if len(side) > self.hypotheses:
            some = np.random.default_rng(self.seed).choice(len(side), self.hypotheses, replace=False)
            side, theta = side[some], theta[some]
        a, b, base = a.take(side), b.take(side), base[side]
        for _ in range(3):  # two ellipses: Newton steps on the difference of the two distances
            (height_a, slope_a), (height_b, slope_b) = a.height(theta), b.height(theta)
            along, across = _along_across(base, theta)
            slope = across + slope_b - slope_a
            step = (along + height_b - height_a) / np.where(np.abs(slope) < 1e-3, np.inf, slope)
            theta = theta - np.clip(step, -0.1, 0.1)
        rho = _along_across(a.middle, theta)[0] + a.height(theta)[0]
        return rho, theta


def _refit(arcs: Arcs, line: np.ndarray, remaining: np.ndarray, gate: float) -> tuple[np.ndarray, np.ndarray]:
    """Refit a line to the ranges of its inliers, selected again in every step; returns the line and the inliers."""
    inliers = np.zeros_like(remaining)
    for _ in range(6):
        rho, theta = line
        distance = arcs.ranges(line[:1], line[1:])[0]
        inliers = remaining & (np.abs(distance - arcs.distance) < gate) & arcs.sees(theta)
        if inliers.sum() < 3:
            break
        (m_along, m_across), (d_along, d_across) = (_along_across(v[inliers], theta) for v in (arcs.middle, arcs.half))
        height = rho - m_along
        slope = np.stack([height, -height * m_across - d_across * d_along], axis=-1) / distance[inliers, None]
        line = line + np.linalg.lstsq(slope, arcs.distance[inliers] - distance[inliers], rcond=None)[0]
    return line, inliers


def distinct(lines: Lines) -> Lines:
    """Remove lines that are near a stronger one."""
    kept: list[np.ndarray] = []
    for line in lines:
        other = np.array(kept).reshape(-1, 2)
        angle = np.abs(wrap_angle(other[:, 1] - line[1]))
        if not ((np.abs(other[:, 0] - line[0]) < NEAR_RHO) & (angle < NEAR_THETA)).any():
            kept.append(line)
    return np.array(kept).reshape(-1, 2)


def _normalized(lines: Lines) -> Lines:
    """The same lines with rho >= 0 and theta in [-pi, pi)."""
    rho, theta = lines.T
    return np.stack([np.abs(rho), wrap_angle(np.where(rho < 0, theta + np.pi, theta))], axis=-1)


def _normal(theta: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(theta), np.sin(theta)], axis=-1)


def _along_across(vector: np.ndarray, theta: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Components of vectors along the normal and along the tangent of lines."""
    cos, sin = np.cos(theta), np.sin(theta)
    return vector[:, 0] * cos + vector[:, 1] * sin, vector[:, 1] * cos - vector[:, 0] * sin
