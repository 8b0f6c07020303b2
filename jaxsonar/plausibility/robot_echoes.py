"""Echoes that move with the robot: its own body, a cable, the floor. They are no walls.

Such an echo has the same range wherever the robot is. A constant range alone is no proof: a sensor reads one range along
a whole wall. The echo of a wall is recognized by geometry. After the robot has moved so that none of the walls and points
that may have caused the echo so far can have kept its range, an echo of a wall is gone, and an echo of the robot is not.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.plausibility.constant_ranges import may_stay, range_resolution
from jaxsonar.scans.firing_poses import reading_poses
from jaxsonar.scans.measured_paths import measured_paths, path_rows
from jaxsonar.scans.readings import explicit_log, is_repeated, without_readings
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class RobotEchoSettings:
    """Constants of the search for echoes of the robot. Chosen by hand on simulated rooms and rings."""

    spacing: float = 0.08
    """Scans that are compared lie apart by this distance, metres, ..."""
    rotation: float = float(np.radians(8.0))
    """... or by this rotation, radians."""
    most_scans: int = 300
    """Largest number of compared scans, spread over the log."""
    half_widths: tuple[float, ...] = (0.006, 0.012, 0.025, 0.04)
    """Half widths of a window in the ranges of a path that are tried, metres; from exact echoes to those of a rough
    floor."""
    present: float = 0.5
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
    min_change: float = 0.03
    """Change of the range of a wall from which on it must show, metres; larger than the errors of odometry within a few
    scans."""
    places: int = 6
    """Number of poses, none of which shares a possible wall or point with another, at which the echo must be."""
    enough: int = 18
    """The search ends after this many."""
    returned: float = 0.6
    """After the robot has left all walls and points that may have caused the echo, the next measurements have the echo
    with this probability, at least."""
    extent: float = 0.25
    """Distance between two of these poses, at least, metres. A robot that only turns may be in a regular room."""
    floor: float = 0.6
    """Share of the sensors with an echo of the robot, from which on the floor is the likely cause."""


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
    """Number of poses that have no possible wall or point in common and at which the echo was received."""

    def __str__(self) -> str:
        who = f"sensor {self.tx}" if self.tx == self.rx else f"path {self.tx} to {self.rx}"
        noise = f" +- {self.sigma:.3f}" if self.sigma else ""
        return f"{who} {self.range:.3f}{noise} m"


@dataclass(frozen=True)
class RobotEchoes:
    """All echoes of a log that move with the robot. False if there are none."""

    echoes: tuple[RobotEcho, ...]
    """One for each path and range, by path."""
    is_floor: bool
    """Whether most sensors have one, so that the floor is the likely cause."""

    def __bool__(self) -> bool:
        return bool(self.echoes)

    @property
    def sensors(self) -> tuple[int, ...]:
        """Sensors whose direct echo is of the robot."""
        return tuple(sorted({one.tx for one in self.echoes if one.tx == one.rx}))

    def mask(self, log: Log) -> Bool[np.ndarray, " readings"]:
        """The readings of a log that are echoes of the robot."""
        found = np.zeros(len(log.range), bool)
        for one in self.echoes:
            of_path = (log.tx == one.tx) & (log.rx == one.rx)
            found |= of_path & (np.abs(log.range - one.range) <= one.half_width)  # False for NaN
        return found


def find_robot_echoes(ring: Ring, log: Log) -> RobotEchoes:
    """Find echoes that have the same range wherever the robot is.

    A path has such an echo if all this is true:

    - Most of its measurements have an echo in a narrow window, and few just beside it.
    - The robot was at several poses, of which no two can have received the echo from one wall or point (``may_stay``),
      and the echo was there.
    - Whenever the robot had left all walls and points that may have caused the echo before, most of the next
      measurements had it again.

    A robot that rests or only turns gives no statement, and neither does one that only drives along walls.

    Args:
        ring: the sensors; other (tx, rx) pairs are ignored.
        log: the scans. Full scans; see ``group_firings``.
    """
    found = list(_with_poses(ring, log))
    direct = {one.tx for one in found if one.tx == one.rx}
    measured = {int(tx) for tx, rx in zip(log.tx, log.rx, strict=True) if tx == rx}
    return RobotEchoes(tuple(found), bool(found) and len(direct) >= max(2, SETTINGS.floor * len(measured)))


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


def _with_poses(ring: Ring, log: Log) -> Iterator[RobotEcho]:
    """The echoes of the robot in a log with poses."""
    chosen = _spaced_scans(log.pose)
    if len(chosen) < SETTINGS.places:
        return
    path = path_rows(ring, log.tx, log.rx)
    used = (path >= 0) & np.isfinite(log.range) & ~is_repeated(log)
    compared = np.zeros(len(log), bool)
    compared[chosen] = True
    row = np.flatnonzero(used & compared[log.echo_scan])
    row = row[np.lexsort((log.range[row], path[row]))]
    measured = measured_paths(ring, log)
    number, resolution = measured[chosen].sum(axis=0), range_resolution(log.range[row])
    edges = np.searchsorted(path[row], np.arange(len(ring.paths) + 1))
    pose = reading_poses(log)
    for one in range(len(ring.paths)):
        mine = row[edges[one] : edges[one + 1]]
        if number[one] < SETTINGS.places:
            continue
        window = _window(log.range[mine], int(number[one]), resolution)
        if window is None:
            continue
        center, sigma, half_width = window
        hit = mine[np.abs(log.range[mine] - center) <= half_width]
        # The pose of each measurement, and whether it has the echo. A measurement with nearer echoes only is neither.
        scan = chosen[measured[chosen, one]]
        at, has_echo, farthest = log.pose[scan].copy(), np.zeros(len(scan), bool), np.full(len(scan), np.inf)
        last = np.unique(log.echo_scan[mine][::-1], return_index=True)
        farthest[np.searchsorted(scan, last[0])] = log.range[mine][::-1][last[1]]
        position = np.searchsorted(scan, log.echo_scan[hit])
        at[position], has_echo[position] = pose[hit], True
        tells = has_echo | (farthest > center)
        if has_echo.sum() < max(SETTINGS.present * tells.sum(), SETTINGS.places):
            continue
        at, has_echo = at[tells], has_echo[tells]
        places = _independent_places(ring, one, center, half_width, at, has_echo)
        if not places:
            continue
        tx, rx = ring.paths[one].tolist()
        all_of_path = used & (path == one) & (np.abs(log.range - center) <= half_width)
        readings = int(all_of_path.sum())
        share = len(np.unique(log.echo_scan[all_of_path])) / int(measured[:, one].sum())
        yield RobotEcho(tx, rx, center, sigma, half_width, readings, share, places)


def _spaced_scans(pose: Float[np.ndarray, "scans 3"]) -> Int[np.ndarray, " chosen"]:
    """Scans that lie apart from the one before, spread over the trajectory."""
    chosen: list[int] = []
    x, y, theta = pose.T
    last = np.full(3, np.nan)
    for k in np.flatnonzero(np.isfinite(pose).all(axis=1)).tolist():
        far = np.hypot(x[k] - last[0], y[k] - last[1]) >= SETTINGS.spacing
        if far or abs(wrap_angle(theta[k] - last[2])) >= SETTINGS.rotation or not chosen:
            chosen.append(k)
            last = pose[k]
    rows = np.array(chosen, np.int64)
    if len(rows) > SETTINGS.most_scans:
        rows = rows[np.linspace(0, len(rows) - 1, SETTINGS.most_scans).astype(np.int64)]
    return rows


def _window(
    ordered: Float[np.ndarray, " echoes"], measurements: int, resolution: float
) -> tuple[float, float, float] | None:
    """Center, standard deviation and half width (metres) of a window that holds one echo of most measurements.

    Args:
        ordered: ranges of a path, ascending, metres.
        measurements: number of measurements of the path.
        resolution: of the ranges, metres.
    """
    least = SETTINGS.present_in_all * measurements
    if len(ordered) < least:
        return None
    for trial in SETTINGS.half_widths:
        end = np.searchsorted(ordered, ordered + 2 * trial, side="right")
        begin = int(np.argmax(end - np.arange(len(ordered))))
        if end[begin] - begin < least:
            continue
        center, sigma = float(np.median(ordered[begin : end[begin]])), trial
        for _ in range(3):
            near = ordered[np.abs(ordered - center) <= 3 * max(sigma, SETTINGS.min_half_width / 3)]
            center = float(np.median(near))
            sigma = 1.4826 * float(np.median(np.abs(near - center)))
        half_width = max(SETTINGS.spread * sigma, SETTINGS.min_half_width, SETTINGS.resolution * resolution)
        deviation = ordered - center
        inside = int((np.abs(deviation) <= half_width).sum())
        beside = max(int(((side > half_width) & (side <= 3 * half_width)).sum()) for side in (deviation, -deviation))
        if half_width <= 4 * SETTINGS.half_widths[-1] and inside >= max(least, SETTINGS.contrast * beside):
            return center, sigma, half_width
        return None
    return None


def _independent_places(
    ring: Ring,
    path: int,
    distance: float,
    half_width: float,
    pose: Float[np.ndarray, "measurements 3"],
    has_echo: Bool[np.ndarray, " measurements"],
) -> int:
    """Number of poses at which the echo cannot have come from a common wall or point; 0 if they prove nothing.

    Args:
        ring: the sensors.
        path: row of ``Ring.paths``.
        distance: the constant range, metres.
        half_width: half width of the window, metres.
        pose: world_from_robot of the measurements of the path.
        has_echo: whether each measurement has the echo.
    """
    margin = max(SETTINGS.min_change, 2 * half_width)
    explained, places, lost, k = np.zeros(len(pose), bool), [], 0, 0
    while len(places) < SETTINGS.enough and len(fresh := np.flatnonzero(~explained[k:])):
        k += int(fresh[0])
        if not has_echo[k]:
            lost += 1
            k += 1
            continue
        places.append(k)
        here = np.broadcast_to(pose[k], pose[k:].shape)
        count = len(here)
        explained[k:] |= may_stay(ring, np.full(count, path), np.full(count, distance), here, pose[k:], margin)
        explained[k] = True
    if len(places) < SETTINGS.places or len(places) < SETTINGS.returned * (len(places) + lost):
        return 0
    extent = float(np.hypot(*np.ptp(pose[places, :2], axis=0)))
    return len(places) if extent >= SETTINGS.extent else 0
