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
"""Metres and radians within which two lines of one scan are one wall: the gates of ``jaxsonar.deviations``."""

TUNING = 1_000_003
"""Seed of the rooms that the peers were tuned on."""

SHORTEST_BASE = 0.03
"""Metres between two virtual sensors from which on their common tangent is a hypothesis."""


@dataclass(frozen=True)
class Arcs:
    """Echoes of one scan as arcs of circles and ellipses, robot frame, metres and radians."""

    middle: Float[np.ndarray, "echoes 2"]
    """Of transmitter and receiver."""
    half: Float[np.ndarray, "echoes 2"]
    """Half the way from transmitter to receiver."""
    reach: Float[np.ndarray, " echoes"]
    """Half the path length."""
    start: Float[np.ndarray, " echoes"]
    """First direction of the detection range, counter-clockwise."""
    width: Float[np.ndarray, " echoes"]
    """Of the detection range."""
    full: float
    """How many of the ring's paths hear a wall, mean over its directions."""

    def take(self, index: Int[np.ndarray, " some"] | Bool[np.ndarray, " echoes"]) -> "Arcs":
        """Some of the arcs."""
        some = (column[index] for column in (self.middle, self.half, self.reach, self.start, self.width))
        return Arcs(*some, full=self.full)

    def sees(self, theta: Float[np.ndarray, "#echoes"] | float) -> Bool[np.ndarray, "..."]:
        """Whether each direction lies in the detection range; the borders are soft by 2 deg, walls are not far away."""
        soft = np.radians(2.0)
        return (theta - self.start + soft) % (2 * np.pi) <= self.width + 2 * soft

    def height(
        self, theta: Float[np.ndarray, "#echoes"] | float
    ) -> tuple[Float[np.ndarray, " echoes"], Float[np.ndarray, " echoes"]]:
        """Distance from the middle to the tangent with this normal, and its derivative by theta."""
        along, across = _along_across(self.half, theta)
        height = np.sqrt(np.maximum(self.reach**2 - across**2, 1e-12))
        return height, across * along / height

    def ranges(self, rho: Float[np.ndarray, "#lines"], theta: Float[np.ndarray, "#lines"]) -> np.ndarray:
        """(lines, echoes) half path lengths of planes."""
        along, _ = _along_across(self.middle, theta[:, None])
        _, across = _along_across(self.half, theta[:, None])
        return np.hypot(rho[:, None] - along, across)


def arcs_of_scans(ring: Ring, log: Log) -> Iterator[Arcs]:
    """The arcs of every scan of a log: its echoes within the maximum range on paths that hear a plane at all."""
    tx, rx = ring.paths.T
    first, last = np.asarray(ring.detection_ranges, dtype=np.float64).T
    width = last - first
    full = float(width.sum() / (2 * np.pi))
    position = np.asarray(ring.position)
    half, middle = (position[rx] - position[tx]) / 2, (position[rx] + position[tx]) / 2
    path = ring.path_index[log.tx, log.rx]
    reach = np.asarray(ring.corrected(log.range, log.tx, log.rx))
    heard = (path >= 0) & (reach < ring.max_range) & (width > 0)[path] & (reach > np.linalg.norm(half, axis=-1)[path])
    for begin, end in itertools.pairwise(log.start):
        own = np.arange(begin, end)[heard[begin:end]]
        row = path[own]
        yield Arcs(middle[row], half[row], reach[own], first[row], width[row], full)


@dataclass(frozen=True)
class PointHough:
    """``cv2.HoughLinesPointSet`` on points of the arcs, then non-maximum suppression."""

    pitch: float = float(np.radians(1.0))
    """Of the points along an arc."""
    rho_cell: float = 0.01
    """Metres."""
    theta_cell: float = float(np.radians(2.0))
    threshold: float = 5.0
    """Votes (points) that a line needs, for every path that hears a wall there."""

    def __call__(self, arcs: Arcs, sigma: float) -> Lines:
        """Lines of one scan; the noise is not used."""
        points = self.points(arcs).astype(np.float32)
        if not len(points):
            return np.zeros((0, 2))
        far = float(np.linalg.norm(points, axis=-1).max()) + self.rho_cell
        # From -far to far in half a turn: the same lines as from 0 to far in a whole turn, without a border at rho = 0.
        span = -far, far, self.rho_cell, 0.0, np.pi, self.theta_cell
        found = cv2.HoughLinesPointSet(points[:, None], 500, round(self.threshold * arcs.full), *span)
        if found is None:
            return np.zeros((0, 2))
        return distinct(_proper(np.asarray(found).reshape(-1, 3)[:, 1:]))

    def points(self, arcs: Arcs) -> Float[np.ndarray, "points 2"]:
        """Where the tangents touch, at equal steps of their normals."""
        count = np.maximum(np.round(arcs.width / self.pitch), 1).astype(int)
        own = np.repeat(np.arange(len(count)), count)
        k = np.arange(len(own)) - np.repeat(np.cumsum(count) - count, count)
        some = arcs.take(own)
        theta = some.start + (k + 0.5) * (arcs.width / count)[own]
        height, slide = some.height(theta)
        return some.middle + height[:, None] * _normal(theta) + slide[:, None] * _normal(theta + np.pi / 2)


@dataclass(frozen=True)
class PairConsensus:
    """RANSAC on pairs of arcs: common tangents, consensus by the residuals of the ranges, the best one, and again."""

    gate: float = 2.5
    """Residual up to which an echo agrees, in standard deviations of the noise."""
    least: float = 0.4
    """Echoes that must agree, as a share of the paths that hear a wall there."""
    hypotheses: int = 1000
    """At most so many pairs of arcs are looked at."""
    seed: int = 0

    def __call__(self, arcs: Arcs, sigma: float) -> Lines:
        """Lines of one scan whose ranges have this noise, metres."""
        gate, least = max(self.gate * sigma, 1e-6), max(self.least * arcs.full, 3)
        rho, theta = self.tangents(arcs)
        agree = (np.abs(arcs.ranges(rho, theta) - arcs.reach) < gate) & arcs.sees(theta[:, None])
        left = np.ones(len(arcs.reach), dtype=bool)
        found: list[np.ndarray] = []
        while True:
            kept = (agree & left).sum(axis=1) >= least
            agree, rho, theta = agree[kept], rho[kept], theta[kept]
            if not len(agree):
                return distinct(_proper(np.array(found).reshape(-1, 2)))
            best = int((agree & left).sum(axis=1).argmax())
            line, mine = _refit(arcs, np.array([rho[best], theta[best]]), left, gate)
            if mine.sum() >= least:
                found.append(line)
                residual = np.abs(arcs.ranges(line[:1], line[1:])[0] - arcs.reach)
                left &= ~((residual < 2 * gate) & arcs.sees(line[1]))
            agree[best] = False

    def tangents(self, arcs: Arcs) -> tuple[Float[np.ndarray, " lines"], Float[np.ndarray, " lines"]]:
        """Lines (rho, theta) that touch two arcs, both within their detection ranges; a sample of all pairs."""
        first, second = np.triu_indices(len(arcs.reach), 1)
        a, b = arcs.take(first), arcs.take(second)
        base = b.middle - a.middle
        apart = np.linalg.norm(base, axis=-1)
        sine = (a.reach - b.reach) / np.maximum(apart, 1e-12)
        crossing = np.flatnonzero((apart > SHORTEST_BASE) & (np.abs(sine) < 1))
        # Two circles: the tangent's normal is at arccos((r1 - r2) / base) on either side of the base.
        side = np.concatenate([crossing, crossing])
        turn = np.repeat([1.0, -1.0], len(crossing)) * np.arccos(sine[side])
        theta = np.arctan2(base[side, 1], base[side, 0]) + turn
        near = a.take(side).sees(theta) & b.take(side).sees(theta)
        side, theta = side[near], theta[near]
        if len(side) > self.hypotheses:
            some = np.random.default_rng(self.seed).choice(len(side), self.hypotheses, replace=False)
            side, theta = side[some], theta[some]
        a, b, base = a.take(side), b.take(side), base[side]
        for _ in range(3):  # two ellipses: Newton on the difference of both distances
            (height_a, slope_a), (height_b, slope_b) = a.height(theta), b.height(theta)
            along, across = _along_across(base, theta)
            slope = across + slope_b - slope_a
            step = (along + height_b - height_a) / np.where(np.abs(slope) < 1e-3, np.inf, slope)
            theta = theta - np.clip(step, -0.1, 0.1)
        rho = _along_across(a.middle, theta)[0] + a.height(theta)[0]
        return rho, theta


def _refit(arcs: Arcs, line: np.ndarray, left: np.ndarray, gate: float) -> tuple[np.ndarray, np.ndarray]:
    """Least squares of the ranges of the echoes that agree, looked for again after every step, and which those are."""
    mine = np.zeros_like(left)
    for _ in range(6):
        rho, theta = line
        reach = arcs.ranges(line[:1], line[1:])[0]
        mine = left & (np.abs(reach - arcs.reach) < gate) & arcs.sees(theta)
        if mine.sum() < 3:
            break
        (m_along, m_across), (d_along, d_across) = (_along_across(v[mine], theta) for v in (arcs.middle, arcs.half))
        height = rho - m_along
        slope = np.stack([height, -height * m_across - d_across * d_along], axis=-1) / reach[mine, None]
        line = line + np.linalg.lstsq(slope, arcs.reach[mine] - reach[mine], rcond=None)[0]
    return line, mine


def distinct(lines: Lines) -> Lines:
    """Lines that are not near a stronger one."""
    kept: list[np.ndarray] = []
    for line in lines:
        other = np.array(kept).reshape(-1, 2)
        turn = np.abs(wrap_angle(other[:, 1] - line[1]))
        if not ((np.abs(other[:, 0] - line[0]) < NEAR_RHO) & (turn < NEAR_THETA)).any():
            kept.append(line)
    return np.array(kept).reshape(-1, 2)


def _proper(lines: Lines) -> Lines:
    """The same lines with rho >= 0 and theta in [-pi, pi)."""
    rho, theta = lines.T
    return np.stack([np.abs(rho), wrap_angle(np.where(rho < 0, theta + np.pi, theta))], axis=-1)


def _normal(theta: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(theta), np.sin(theta)], axis=-1)


def _along_across(vector: np.ndarray, theta: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Components of vectors along the normal and along the tangent of lines."""
    cos, sin = np.cos(theta), np.sin(theta)
    return vector[:, 0] * cos + vector[:, 1] * sin, vector[:, 1] * cos - vector[:, 0] * sin
