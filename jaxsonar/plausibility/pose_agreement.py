"""Do echoes and poses go together? The share of echoes that other scans of the trajectory explain.

Scans that lie close together along the trajectory see the same walls. Every echo votes for all walls that can have
caused it: its isorange arc in a Hough accumulator, in the frame of the group of scans. An echo is explained if more of
the other scans vote for one cell of its arc than by chance. Chance is measured: the same scans, each turned by a random
angle.

The true description of a log explains more echoes than any wrong one. Two descriptions of a log, such as its sensors
numbered counter-clockwise and clockwise, can therefore be compared. NumPy only: nothing is compiled.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from jaxsonar.geometry.se2 import relative, rotate, wrap_angle
from jaxsonar.scans.firing_poses import reading_poses
from jaxsonar.scans.measured_paths import path_rows
from jaxsonar.scans.readings import is_repeated
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class PoseAgreementSettings:
    """Constants of the comparison of echoes with poses. Chosen by hand on simulated rooms."""

    angle_cell: float = float(np.radians(2.0))
    """Size of a cell of the accumulator in the direction of a wall's normal, radians; it divides the full turn."""
    range_cell: float = 0.025
    """Size of a cell in the distance of the wall, metres. Votes reach the neighboring cells."""
    spacing: float = 0.08
    """A scan is used if the robot moved this far since the last one that is used, metres, ..."""
    turn: float = float(np.radians(8.0))
    """... or if it turned this far, radians."""
    group: int = 10
    """Scans of a group."""
    least_group: int = 4
    """Smaller groups are left out."""
    groups: int = 16
    """Largest number of groups, spread over the log."""
    long_log: int = 4000
    """In logs with more scans, only as many scans are looked at as the groups need."""
    nearest: float = 0.05
    """Echoes below this range are left out, metres."""
    farthest: float = 1e9
    """Positions are limited to this distance from the origin, metres, so that no number overflows."""
    by_chance: float = 0.95
    """Quantile of the votes by chance that an explained echo exceeds."""
    least_votes: int = 2
    """Least number of other scans that vote for the wall of an explained echo."""
    seed: int = 0
    """Seed of the random turns."""


SETTINGS = PoseAgreementSettings()

_ANGLES = round(2 * np.pi / SETTINGS.angle_cell)
_COS, _SIN = (f(np.arange(_ANGLES) * SETTINGS.angle_cell).astype(np.float32) for f in (np.cos, np.sin))


@dataclass(frozen=True, eq=False)
class Agreement:
    """Which echoes of a log the other scans explain."""

    reading: Int[np.ndarray, " echoes"]
    """Rows of the compared echoes in the log."""
    scan: Int[np.ndarray, " echoes"]
    """Rows of their scans in the log."""
    explained: Bool[np.ndarray, " echoes"]
    """Whether other scans explain the echo."""
    lucky: Bool[np.ndarray, " echoes"]
    """Whether they do so after all scans were turned by random angles."""
    support: Float[np.ndarray, " echoes"]
    """Share of the other scans of the group that agree with the echo: that vote for the wall with the most votes."""

    @property
    def echoes(self) -> int:
        """Number of compared echoes; 0 if the log has no two poses that can be compared."""
        return len(self.reading)

    @property
    def share(self) -> float:
        """Share of the echoes that are explained; 0 if none is compared."""
        return float(self.explained.mean()) if self.echoes else 0.0

    @property
    def chance(self) -> float:
        """Share that is explained by chance."""
        return float(self.lucky.mean()) if self.echoes else 0.0

    @property
    def mean_support(self) -> float:
        """Mean support of the echoes; 0 if none is compared."""
        return float(self.support.mean()) if self.echoes else 0.0


@dataclass(frozen=True)
class Gain:
    """How much more one description of a log explains than another one."""

    share: float
    """Difference of the shares of explained echoes."""
    sigma: float
    """Standard error of this difference, from the differences of the scans."""
    support: float
    """Difference of the mean support of the echoes. It is more sensitive than the share."""
    support_sigma: float
    """Standard error of it."""

    @property
    def z(self) -> float:
        """The difference of the shares in standard errors."""
        return self.share / self.sigma

    @property
    def support_z(self) -> float:
        """The difference of the support in standard errors."""
        return self.support / self.support_sigma


def bounded(pose: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """The poses with limited positions (``SETTINGS.farthest``), with which one can calculate."""
    limit = np.array([SETTINGS.farthest, SETTINGS.farthest, np.inf])
    return np.clip(pose, -limit, limit)


def select_groups(log: Log, group: int = SETTINGS.group) -> list[Int[np.ndarray, "_"]]:
    """Groups of scans that are compared with each other: rows of the log, in order.

    The scans of a group follow each other along the trajectory at distances at which echoes change. A robot that waits
    adds no scan. The list is empty if the log has no poses or the robot hardly moves.

    Args:
        log: the scans.
        group: scans of a group.
    """
    posed = np.flatnonzero(np.isfinite(log.pose).all(axis=1))
    pose = bounded(log.pose[posed])
    if len(posed) <= SETTINGS.long_log:
        row = spaced_scans(pose, len(pose), spacing=SETTINGS.spacing, turn=SETTINGS.turn)
        groups = [row[k : k + group] for k in range(0, len(row), group)]
    else:
        bounds = np.linspace(0, len(pose), SETTINGS.groups + 1).astype(int)
        pairs = pairwise(bounds)
        limits = {"spacing": SETTINGS.spacing, "turn": SETTINGS.turn}
        groups = [begin + spaced_scans(pose[begin:end], group, **limits) for begin, end in pairs]
    groups = [posed[one] for one in groups if len(one) >= SETTINGS.least_group]
    if len(groups) > SETTINGS.groups:
        groups = [groups[k] for k in np.linspace(0, len(groups) - 1, SETTINGS.groups).round().astype(int)]
    return groups


def part_of_groups(
    log: Log, groups: Sequence[Int[np.ndarray, "_"]], *, most_echoes: int | None = None
) -> tuple[Log, list[Int[np.ndarray, "_"]]]:
    """The echoes of these scans alone, and the groups as rows of this part: descriptions of long logs are then cheap.

    Args:
        log: the scans.
        groups: rows of the scans of each group.
        most_echoes: only as many echoes of each scan, chosen at random; all of them if omitted.
    """
    rows = np.sort(np.concatenate(groups)) if len(groups) else np.zeros(0, np.int64)
    count = np.diff(log.start)[rows]
    begin = np.cumsum(count) - count
    scan = np.repeat(np.arange(len(rows)), count)
    echo = np.arange(len(scan)) + np.repeat(log.start[rows] - begin, count)
    kept = np.isfinite(log.range[echo])
    if log.age.any():
        kept &= ~is_repeated(log)[echo]
    scan, echo = scan[kept], echo[kept]
    if most_echoes is not None:
        order = np.lexsort((np.random.default_rng(SETTINGS.seed).random(len(scan)), scan))
        place = np.arange(len(scan)) - np.searchsorted(scan, scan)
        chosen = np.sort(order[place < most_echoes])
        scan, echo = scan[chosen], echo[chosen]
    part = Log.from_echoes(
        scan,
        log.tx[echo],
        log.rx[echo],
        log.range[echo],
        t=log.t[echo],
        age=log.age[echo],
        stamp=log.stamp[rows],
        pose=log.pose[rows],
        asked=np.zeros((0, 2), np.int64),
        odometry=log.motion,
    )
    return part, [np.searchsorted(rows, group) for group in groups]


def agreement(
    ring: Ring, log: Log, groups: Sequence[Int[np.ndarray, "_"]] | None = None, *, support_only: bool = False
) -> Agreement:
    """Find the echoes of a log that other scans explain, given the poses of the log.

    Args:
        ring: the sensors; echoes of other (tx, rx) pairs and beyond the maximum range are left out.
        log: the scans.
        groups: rows of the scans to compare; ``select_groups`` of the log if omitted. Give the same groups to compare
            two descriptions of a log on the same scans.
        support_only: compute the support only, which takes half the time; no echo counts as explained.
    """
    groups = select_groups(log) if groups is None else groups
    of_scan = np.full(len(log), -1)
    for k, group in enumerate(groups):
        of_scan[group] = k
    scan = log.echo_scan
    path = path_rows(ring, log.tx, log.rx)
    used = (of_scan[scan] >= 0) & (path >= 0) & np.isfinite(log.range)
    if log.age.any():
        used &= ~is_repeated(log)
    row = np.flatnonzero(used)
    distance = np.asarray(ring.corrected(log.range[row], log.tx[row], log.rx[row]))
    near = (distance > SETTINGS.nearest) & (distance < ring.max_range)
    row, distance = row[near], distance[near]
    pose = bounded(reading_poses(log)[row] if log.t.any() or log.age.any() else log.pose[scan[row]])
    rng = np.random.default_rng(SETTINGS.seed)
    explained, lucky, support = np.zeros(len(row), bool), np.zeros(len(row), bool), np.zeros(len(row))
    bounds = np.searchsorted(scan[row], [[one[0], one[-1] + 1] for one in groups]) if len(groups) else []
    for group, (begin, end) in zip(groups, bounds, strict=True):
        one = slice(begin, end)
        place = np.searchsorted(group, scan[row[one]])
        group_from_robot = relative(bounded(log.pose[group[len(group) // 2]]), pose[one])
        compared = path[row[one]], distance[one]
        turn = rng.uniform(-np.pi, np.pi, len(group))[place]
        if end == begin:
            continue
        votes = _votes_of_others(ring, *compared, group_from_robot, place, len(group))
        support[one] = votes / (len(group) - 1)
        if not support_only:
            turned = group_from_robot + np.column_stack([np.zeros((len(turn), 2)), turn])
            by_chance = _votes_of_others(ring, *compared, turned, place, len(group))
            least = max(SETTINGS.least_votes, int(np.quantile(by_chance, SETTINGS.by_chance)) + 1)
            explained[one], lucky[one] = votes >= least, by_chance >= least
    return Agreement(row, scan[row], explained, lucky, support)


def gain(given: Agreement, other: Agreement) -> Gain:
    """How much more ``other`` explains than ``given``; both have echoes of one log, at best of the same scans."""
    return Gain(
        *_difference(given.scan, given.explained, other.scan, other.explained),
        *_difference(given.scan, given.support, other.scan, other.support),
    )


def _difference(
    scan: Int[np.ndarray, " echoes"],
    value: Num[np.ndarray, " echoes"] | Bool[np.ndarray, " echoes"],
    other_scan: Int[np.ndarray, " others"],
    other_value: Num[np.ndarray, " others"] | Bool[np.ndarray, " others"],
) -> tuple[float, float]:
    """Difference of two means over echoes, and its standard error if the echoes of a scan depend on each other."""
    if not (len(scan) and len(other_scan)):
        return 0.0, 1.0
    count = max(scan[-1], other_scan[-1]) + 1
    mean, other_mean = value.mean(), other_value.mean()
    # The contribution of each scan to the difference of the means; those of scans in both descriptions cancel.
    part = np.bincount(other_scan, other_value - other_mean, count) / len(other_scan)
    part -= np.bincount(scan, value - mean, count) / len(scan)
    least = 0.5 / (len(scan) + len(other_scan))
    return float(other_mean - mean), float(np.hypot(np.linalg.norm(part), least))


def spaced_scans(
    pose: Float[np.ndarray, "scans 3"], limit: int, *, spacing: float, turn: float
) -> Int[np.ndarray, " spaced"]:
    """Rows of scans each of which is some distance or angle away from the one before; the first ``limit`` of them.

    Args:
        pose: world_from_robot, metres and radians, without NaN.
        limit: largest number of rows.
        spacing: distance that must be exceeded, metres, ...
        turn: ... or angle, radians.
    """
    rows, at, block = [], 0, 32
    while at < len(pose) and len(rows) < limit:
        rows.append(at)
        last, at = pose[at], at + 1
        width = block
        while at < len(pose):
            ahead = pose[at : at + width]
            moved = np.hypot(*(ahead[:, :2] - last[:2]).T) > spacing
            moved |= np.abs(wrap_angle(ahead[:, 2] - last[2])) > turn
            if moved.any():
                at += int(np.argmax(moved))
                break
            at, width = at + width, 2 * width
    return np.array(rows, np.int64)


def _votes_of_others(
    ring: Ring,
    path: Int[np.ndarray, " echoes"],
    distance: Float[np.ndarray, " echoes"],
    pose: Float[np.ndarray, "echoes 3"],
    place: Int[np.ndarray, " echoes"],
    scans: int,
) -> Int[np.ndarray, " echoes"]:
    """Largest number of other scans of a group that vote for one wall on the arc of each echo.

    Args:
        ring: the sensors.
        path: row of ``Ring.paths`` of each echo.
        distance: corrected range, metres.
        pose: group_from_robot when the echo was measured.
        place: the scan of each echo within the group.
        scans: number of scans of the group.
    """
    paths, size = ring.exact_paths, SETTINGS.angle_cell
    # Directions of the grid in which the path can receive a wall; one at least.
    start = np.mod(paths.start[path] + pose[:, 2], 2 * np.pi)
    first = np.ceil(start / size).astype(np.int64)
    count = np.maximum(np.floor((start + paths.width[path]) / size).astype(np.int64) - first + 1, 1)
    begin = np.cumsum(count) - count
    echo = np.repeat(np.arange(len(path)), count)
    angle = (first[echo] + np.arange(len(echo)) - begin[echo]) % _ANGLES
    # Distance of the wall from the origin of the group for each direction: the isorange arc of the echo.
    midpoint = (pose[:, :2] + rotate(np.asarray(paths.midpoint)[path], pose[:, 2])).astype(np.float32)[echo]
    baseline = rotate(np.asarray(paths.half_baseline)[path], pose[:, 2]).astype(np.float32)[echo]
    cos, sin = _COS[angle], _SIN[angle]
    across = baseline[:, 1] * cos - baseline[:, 0] * sin
    height = np.sqrt(np.maximum(distance.astype(np.float32)[echo] ** 2 - across**2, 0))
    rho = midpoint[:, 0] * cos + midpoint[:, 1] * sin + height
    angle = np.where(rho < 0, (angle + _ANGLES // 2) % _ANGLES, angle)
    # Walls farther away than another scan of the group can see are no common walls.
    cells = int((2 * ring.max_range + SETTINGS.group * SETTINGS.spacing) / SETTINGS.range_cell) + 3
    radius = np.minimum(np.abs(rho) / np.float32(SETTINGS.range_cell), cells).astype(np.int64) + 1
    inside = radius < cells - 1
    cell, voter = (angle * cells + radius)[inside], place[echo[inside]]
    voted = np.zeros((scans, _ANGLES * cells), bool)
    for shift in (-1, 0, 1):
        voted[voter, cell + shift] = True
    others = np.zeros(len(echo), np.int64)
    others[inside] = voted.sum(axis=0, dtype=np.int16)[cell] - 1
    return np.maximum.reduceat(others, begin)
