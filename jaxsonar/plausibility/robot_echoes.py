"""Echoes that move with the robot: its own body, a cable, the floor. They are no walls.

Such an echo has the same range wherever the robot is. A constant range alone is no proof: a sensor reads one range
along a whole wall. Geometry tells the difference. After the robot has moved so that none of the walls and points that
may have caused the echo so far can have kept its range, an echo of a wall is gone, and an echo of the robot is not.
Without poses, only the other echoes tell how far the robot has moved.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.robust_statistics import robust_deviation
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.plausibility.constant_ranges import (
    distinct_views,
    independent_places,
    is_contradicted,
    range_resolution,
)
from jaxsonar.plausibility.implausibility import Implausibility
from jaxsonar.scans.firing_poses import reading_poses
from jaxsonar.scans.measured_paths import measured_paths, path_rows
from jaxsonar.scans.readings import explicit_log, is_repeated, without_readings
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class RobotEchoSettings:
    """Constants of the search for constant ranges. Chosen by hand on simulated rooms and rings."""

    spacing: float = 0.08
    """Scans that are compared lie apart by this distance, metres, ..."""
    rotation: float = float(np.radians(8.0))
    """... or by this rotation, radians."""
    most_scans: int = 300
    """Largest number of compared scans, spread over the log."""
    min_scans: int = 6
    """Smallest number of them."""
    windows: int = 3
    """Number of constant ranges of one path that are examined; a wall may have more echoes than the robot."""
    half_widths: tuple[float, ...] = (0.006, 0.012, 0.025, 0.04)
    """Half widths of a window in the ranges of a path that are tried, metres; from exact echoes to those of a rough
    floor."""
    max_half_width: float = 0.16
    """Largest distance from the constant range, metres."""
    present: float = 0.6
    """Share of the measurements of a path that have an echo in the window, at least. A nearer echo may hide it;
    measurements with nearer echoes only do not count, ..."""
    present_in_all: float = 0.2
    """... but this share of all measurements must have it."""
    spread: float = 4.0
    """Echoes within this many standard deviations of the constant range are of the robot."""
    min_half_width: float = 0.004
    """Smallest distance from the constant range within which they are, metres."""
    resolution: float = 1.1
    """Smallest distance, in units of the resolution of the ranges."""
    contrast: float = 3.0
    """A constant range has this many times as many echoes as a window of equal width on either side."""
    alike: float = 0.03
    """Constant ranges of a path and of its reverse path, or of the sensors around the robot, differ by at most this,
    metres, ..."""
    alike_relative: float = 0.05
    """... or by this share of the range."""
    most: float = 0.5
    """Share of the sensors with an echo of the robot, from which on the floor is the likely cause; and share of the
    paths with a constant range that prove it for the others."""
    around: float = 0.3
    """These are at least this share of the sensors of the ring."""
    most_without_poses: float = 0.7
    """Share of the sensors with one constant range, from which on no walls can be the cause, without poses."""
    hidden: float = 0.5
    """Without poses, a path that hears something nearer in more than this share of its measurements contradicts no
    wall, ..."""
    near: float = 0.8
    """... and none contradicts a wall farther away than this multiple of the maximum range."""
    floor_sensors: int = 3
    """Smallest number of sensors that hear the floor."""
    listed: int = 4
    """Number of paths that a warning names."""


SETTINGS = RobotEchoSettings()


@dataclass(frozen=True)
class RobotEcho:
    """An echo of one path that has the same range wherever the robot is."""

    tx: int
    """Transmitter."""
    rx: int
    """Receiver."""
    range: float
    """Reported range, metres."""
    sigma: float
    """Standard deviation of its noise, metres; 0 for a value that is repeated exactly."""
    half_width: float
    """Echoes of the path whose ranges differ by at most this are of the robot, metres."""
    readings: int
    """Number of these echoes in the log."""
    share: float
    """Share of the measurements of the path that have it."""
    places: int
    """Number of poses that have no possible wall or point in common and at which the echo was received, or of scans
    without common echoes in a log without poses; 0 if only other paths prove it."""

    def __str__(self) -> str:
        who = f"sensor {self.tx}" if self.tx == self.rx else f"path {self.tx} to {self.rx}"
        return f"{who} reads {self.range:.3f} +- {self.sigma:.3f} m in {self.share:.0%} of its measurements"


@dataclass(frozen=True)
class RobotEchoes:
    """All echoes of a log that move with the robot. False if there are none."""

    echoes: tuple[RobotEcho, ...]
    """One or more for each path, by path."""
    is_floor: bool
    """Whether half of the sensors have one, so that the floor is the likely cause."""

    def __bool__(self) -> bool:
        return bool(self.echoes)

    @property
    def sensors(self) -> tuple[int, ...]:
        """Sensors whose direct echo is of the robot."""
        return tuple(sorted({one.tx for one in self.echoes if one.tx == one.rx}))

    @property
    def paths(self) -> frozenset[tuple[int, int]]:
        """Their paths (tx, rx)."""
        return frozenset((one.tx, one.rx) for one in self.echoes)

    def mask(self, log: Log) -> Bool[np.ndarray, " readings"]:
        """The readings of a log that are echoes of the robot."""
        found = np.zeros(len(log.range), bool)
        for one in self.echoes:
            of_path = (log.tx == one.tx) & (log.rx == one.rx)
            found |= of_path & (np.abs(log.range - one.range) <= one.half_width)  # False for NaN
        return found

    def warning(self) -> Implausibility:
        """The finding as a warning."""
        # Cross echoes of a sensor that is named are not listed.
        direct = self.sensors
        named = [one for one in self.echoes if one.tx == one.rx or not {one.tx, one.rx} & set(direct)]
        if len(direct) > SETTINGS.listed:
            ranges = [one.range for one in named if one.tx == one.rx]
            listed = f"{len(direct)} sensors read a constant range of {min(ranges):.3f} to {max(ranges):.3f} m"
        else:
            listed = ", ".join(map(str, named[: SETTINGS.listed])) + ", ..." * (len(named) > SETTINGS.listed)
        cause = (
            "they probably hear the floor" if self.is_floor else "probably the robot's own body, a cable or the floor"
        )
        remedy = "these echoes are left out; mount the sensors so that they do not hear it"
        return Implausibility("robot echo", f"{listed}, wherever the robot is", cause, remedy)


def find_robot_echoes(ring: Ring, log: Log) -> RobotEchoes:
    """Find echoes that have the same range wherever the robot is.

    A path has such an echo if all this is true:

    - Most of its measurements have an echo in a narrow window, and few just beside it. Measurements with nearer echoes
      only do not count.
    - The robot was at several poses, of which no two can have received the echo from one wall or point (``may_stay``),
      and the echo was there.
    - Whenever the robot had left all walls and points that may have caused the echo before, the next measurements had
      it about as often as all others.

    Without poses, the scans must differ in nearly all other echoes, and other sensors that look in the same directions
    must not have a constant range, or most sensors around the robot have the same one.

    A path that cannot prove this has the echo, too, if its reverse path has it at the same range, or half of the paths
    with the same distance between transmitter and receiver. A cross echo that the measured reverse path lacks is left
    out: it is crosstalk. A robot that rests or only turns gives no statement, and neither does one that only drives
    along walls.

    Args:
        ring: the sensors; other (tx, rx) pairs are ignored.
        log: the scans. Full scans; see ``group_firings``.
    """
    search = _Search.of(ring, log)
    found = _with_companions(ring, list(search.with_poses() if search.has_poses else search.without_poses()))
    found = [one for one in found if search.is_reciprocal(one, found)]
    direct = {one.tx for one in found if one.tx == one.rx}
    measured = np.unique(log.tx[log.tx == log.rx])
    return RobotEchoes(tuple(found), len(direct) >= max(SETTINGS.floor_sensors, SETTINGS.most * len(measured)))


def without_robot_echoes(log: Log, found: RobotEchoes) -> Log:
    """The log without echoes of the robot; unchanged if it has none.

    A path that heard only its own robot counts as not measured in that scan, because the echo may hide others.
    Therefore the result is explicit: it holds a row without a range for every other path that a scan measured and that
    heard nothing.
    """
    if not found.mask(log).any():
        return log
    log = explicit_log(log)
    return without_readings(log, found.mask(log))


@dataclass(frozen=True, eq=False)
class _Window:
    """A constant range of a path, in the scans that are compared."""

    echo: RobotEcho
    path: int
    scan: Int[np.ndarray, " measurements"]
    """Rows of the scans that tell something about it: with the echo, or without a nearer one only."""
    has_echo: Bool[np.ndarray, " measurements"]
    pose: Float[np.ndarray, "measurements 3"]
    """world_from_robot of these measurements; NaN if unknown."""
    rows: Int[np.ndarray, " echoes"]
    """Rows of the log of the echoes."""


@dataclass(frozen=True, eq=False)
class _Search:
    """Echoes of the scans that are compared."""

    ring: Ring
    log: Log
    has_poses: bool
    chosen: Int[np.ndarray, " chosen"]
    """Rows of these scans."""
    measured: Bool[np.ndarray, "scans paths"]
    """Paths that each scan of the log measured."""
    path: Int[np.ndarray, " readings"]
    """Row of ``Ring.paths`` of each reading of the log; -1: none, or not an echo."""
    row: Int[np.ndarray, " echoes"]
    """Rows of the log of the echoes of the chosen scans, by path and range."""

    @classmethod
    def of(cls, ring: Ring, log: Log) -> "_Search":
        has_poses = bool(np.isfinite(log.pose).any())
        chosen = _spaced_scans(log.pose) if has_poses else np.arange(len(log))
        if len(chosen) > SETTINGS.most_scans:
            chosen = chosen[np.linspace(0, len(chosen) - 1, SETTINGS.most_scans).astype(np.int64)]
        path = path_rows(ring, log.tx, log.rx)
        path[~np.isfinite(log.range) | is_repeated(log)] = -1
        row = np.flatnonzero((path >= 0) & np.isin(log.echo_scan, chosen))
        row = row[np.lexsort((log.range[row], path[row]))]
        return cls(ring, log, has_poses, chosen, measured_paths(ring, log), path, row)

    def is_reciprocal(self, one: RobotEcho, found: list[RobotEcho]) -> bool:
        """Whether the reverse path has the echo, too, or was hardly measured. True for direct echoes."""
        reverse = int(path_rows(self.ring, np.array([one.rx]), np.array([one.tx]))[0])
        if reverse < 0:
            return True
        scan = self.chosen[self.measured[self.chosen, reverse]]
        farthest = self._farthest_echoes(scan, self.row[self.path[self.row] == reverse])
        tells = int((farthest > one.range - _tolerance(one.range)).sum())
        expected = [other.range for other in found if (other.rx, other.tx) == (one.tx, one.rx)]
        return tells < SETTINGS.min_scans or any(abs(one.range - it) <= _tolerance(one.range) for it in expected)

    def with_poses(self) -> Iterator[RobotEcho]:
        """Constant ranges of paths; ``places`` is 0 if they may be of walls."""
        windows = list(self.windows())
        for one, contradicted in zip(windows, self._contradicted(windows), strict=True):
            path, distance, width = one.path, self._corrected(one), one.echo.half_width
            found = independent_places(
                self.ring, path, distance, width, one.pose, one.has_echo, contradicted=contradicted
            )
            yield replace(one.echo, places=found)

    def without_poses(self) -> Iterator[RobotEcho]:
        """As ``with_poses``, for a log without poses."""
        windows = list(self.windows())
        first = self._first_echoes(windows)
        direct = np.array([one.echo.range for one in windows if one.echo.tx == one.echo.rx])
        sensors = int((self._measurements[: self.ring.count] > 0).sum())  # the first paths are the direct ones
        for one, contradicted in zip(windows, self._contradicted(windows), strict=True):
            alike = int((np.abs(direct - one.echo.range) <= _tolerance(one.echo.range)).sum())
            around = alike >= max(SETTINGS.floor_sensors, SETTINGS.most_without_poses * sensors)
            if not around and not contradicted:
                yield one.echo
                continue
            tells, has_echo = np.zeros(len(self.log), bool), np.zeros(len(self.log), bool)
            tells[one.scan], has_echo[one.scan] = True, one.has_echo
            yield replace(one.echo, places=distinct_views(first, tells[self.chosen], has_echo[self.chosen]))

    def _contradicted(self, windows: list[_Window]) -> Iterator[bool]:
        """Whether other sensors contradict that the cause of each constant range is a wall."""
        first, number = self._first_echoes(windows), self._measurements
        constant = np.zeros(len(self.ring.paths), bool)
        constant[[one.path for one in windows]] = True
        for one in windows:
            hidden = (first < one.echo.range).sum(axis=0) > SETTINGS.hidden * number
            near = self._corrected(one) < SETTINGS.near * self.ring.max_range
            yield near and is_contradicted(self.ring, one.path, constant, (number > 0) & ~hidden)

    def _first_echoes(self, windows: list[_Window]) -> Float[np.ndarray, "chosen paths"]:
        """Range of the first echo of each path that is not constant, metres; NaN without one."""
        row = np.setdiff1d(self.row, np.concatenate([np.zeros(0, np.int64), *(one.rows for one in windows)]))
        first = np.full((len(self.chosen), len(self.ring.paths)), np.inf)
        scan = np.searchsorted(self.chosen, self.log.echo_scan[row])
        np.minimum.at(first, (scan, self.path[row]), self.log.range[row])
        return np.where(np.isfinite(first), first, np.nan)

    @cached_property
    def _measurements(self) -> Int[np.ndarray, " paths"]:
        """Number of measurements of each path in the scans that are compared."""
        return self.measured[self.chosen].sum(axis=0)

    def _corrected(self, one: _Window) -> float:
        """Half path length of a constant range, metres."""
        pair = self.ring.paths[one.path : one.path + 1]
        return float(self.ring.corrected(np.array([one.echo.range]), *pair.T)[0])

    def _farthest_echoes(
        self, scan: Int[np.ndarray, " measurements"], rows: Int[np.ndarray, " echoes"]
    ) -> Float[np.ndarray, " measurements"]:
        """Range of the last echo of each measurement of a path, metres; infinite for silence.

        A measurement whose last echo is nearer than a constant range tells nothing about it.

        Args:
            scan: rows of the scans that measured the path, ascending.
            rows: rows of the log of the path's echoes, by range.
        """
        farthest = np.full(len(scan), np.inf)
        heard, last = np.unique(self.log.echo_scan[rows][::-1], return_index=True)
        farthest[np.searchsorted(scan, heard)] = self.log.range[rows][::-1][last]
        return farthest

    def windows(self) -> Iterator[_Window]:
        """Constant ranges of all paths."""
        if len(self.chosen) < SETTINGS.min_scans:
            return
        path, reported, pose = self.path[self.row], self.log.range, reading_poses(self.log)
        number, resolution = self._measurements, range_resolution(reported[self.row])
        edges = np.searchsorted(path, np.arange(len(self.ring.paths) + 1))
        for one in np.flatnonzero(number >= SETTINGS.min_scans).tolist():
            rest = rows = self.row[edges[one] : edges[one + 1]]
            for _ in range(SETTINGS.windows):
                found = _fullest_window(reported[rest], int(number[one]), resolution)
                if found is None:
                    break
                inside = np.abs(reported[rest] - found[0]) <= found[2]
                if (window := self._window(one, found, rows, rest[inside], pose)) is not None:
                    yield window
                rest = rest[~inside]

    def _window(
        self,
        path: int,
        found: tuple[float, float, float],
        rows: Int[np.ndarray, " echoes"],
        inside: Int[np.ndarray, " inside"],
        pose: Float[np.ndarray, "readings 3"],
    ) -> _Window | None:
        """A constant range of a path (center, standard deviation, half width); None if too few measurements have it.

        Args:
            path: row of ``Ring.paths``.
            found: center, standard deviation, half width, metres.
            rows: rows of the log of all echoes of the path, by range.
            inside: those in the window.
            pose: of all readings.
        """
        log, (center, sigma, half_width) = self.log, found
        scan = self.chosen[self.measured[self.chosen, path]]
        at, has_echo, farthest = log.pose[scan].copy(), np.zeros(len(scan), bool), self._farthest_echoes(scan, rows)
        place = np.searchsorted(scan, log.echo_scan[inside])
        at[place], has_echo[place] = pose[inside], True
        tells = has_echo | (farthest > center)
        if has_echo.sum() < max(SETTINGS.present * tells.sum(), SETTINGS.min_scans):
            return None
        tx, rx = self.ring.paths[path].tolist()
        everywhere = (self.path == path) & (np.abs(log.range - center) <= half_width)
        share = len(np.unique(log.echo_scan[everywhere])) / int(self.measured[:, path].sum())
        echo = RobotEcho(tx, rx, center, sigma, half_width, int(everywhere.sum()), share, 0)
        return _Window(echo, path, scan[tells], has_echo[tells], at[tells], inside)


def _spaced_scans(pose: Float[np.ndarray, "scans 3"]) -> Int[np.ndarray, " chosen"]:
    """Scans with a pose that lie apart from the one before."""
    chosen: list[int] = []
    for k in np.flatnonzero(np.isfinite(pose).all(axis=1)).tolist():
        if not chosen or is_apart(pose[chosen[-1]], pose[k]):
            chosen.append(k)
    return np.array(chosen, np.int64)


def is_apart(last: Float[np.ndarray, " 3"], pose: Float[np.ndarray, " 3"]) -> bool:
    """Whether two poses are far enough from each other for their scans to be compared."""
    x, y, theta = (pose - last).tolist()
    return bool(np.hypot(x, y) >= SETTINGS.spacing or abs(wrap_angle(theta)) >= SETTINGS.rotation)


def _fullest_window(
    ordered: Float[np.ndarray, " echoes"], measurements: int, resolution: float
) -> tuple[float, float, float] | None:
    """Center, standard deviation and half width (metres) of a narrow window that holds many echoes; None if none does.

    Args:
        ordered: ranges of a path, ascending, metres.
        measurements: number of measurements of the path.
        resolution: of the ranges, metres.
    """
    least = SETTINGS.present_in_all * measurements
    for trial in SETTINGS.half_widths if len(ordered) >= max(least, 1) else ():
        end = np.searchsorted(ordered, ordered + 2 * trial, side="right")
        begin = int(np.argmax(end - np.arange(len(ordered))))
        if end[begin] - begin < least:
            continue
        center, sigma = float(np.median(ordered[begin : end[begin]])), trial
        for _ in range(3):
            near = ordered[np.abs(ordered - center) <= 3 * max(sigma, SETTINGS.min_half_width / 3)]
            center = float(np.median(near))
            sigma = robust_deviation(near)
        half_width = max(SETTINGS.spread * sigma, SETTINGS.min_half_width, SETTINGS.resolution * resolution)
        deviation = ordered - center
        inside = int((np.abs(deviation) <= half_width).sum())
        beside = max(int(((side > half_width) & (side <= 3 * half_width)).sum()) for side in (deviation, -deviation))
        if half_width <= SETTINGS.max_half_width and inside >= max(least, SETTINGS.contrast * beside):
            return center, sigma, half_width
        return None
    return None


def _with_companions(ring: Ring, candidates: list[RobotEcho]) -> list[RobotEcho]:
    """The proven candidates, and those that have the range of a proven reverse path or of most paths like them."""
    proven: dict[tuple[int, int], float] = {(one.tx, one.rx): one.range for one in candidates if one.places}
    if not proven:
        return []
    offset = {(one.tx, one.rx): (one.rx - one.tx) % ring.count for one in candidates}
    found = []
    for one in candidates:
        pair, reverse = (one.tx, one.rx), (one.rx, one.tx)
        similar = [key for key, value in offset.items() if value == offset[pair]]
        of_these = [proven[key] for key in similar if key in proven]
        expected = [proven[reverse]] if reverse in proven and reverse != pair else []
        if len(of_these) >= max(2, SETTINGS.most * len(similar), SETTINGS.around * ring.count):
            expected.append(float(np.median(of_these)))
        if one.places or any(abs(one.range - other) <= _tolerance(one.range) for other in expected):
            found.append(one)
    return found


def _tolerance(distance: float) -> float:
    """Largest difference between similar constant ranges, metres."""
    return max(SETTINGS.alike, SETTINGS.alike_relative * distance)
