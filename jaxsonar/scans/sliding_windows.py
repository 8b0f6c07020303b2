"""Sliding windows along the trajectory: the echoes of several scans in one frame, for rings with few sensors."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.se2 import compose, relative, wrap_angle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.measured_paths import echoes_of_long_wall, equivalent_scans, path_rows
from jaxsonar.scans.readings import SETTINGS as AGES
from jaxsonar.scans.readings import measurement_times
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.sensors.ring import Ring

Pair = tuple[int, int]
"""Transmitter and receiver."""
Reading = tuple[int, int, float]
"""Transmitter, receiver and reported range (metres) of an echo."""


@dataclass(frozen=True)
class WindowSettings:
    """Constants of sliding windows. All chosen by hand."""

    overlap: int = 2
    """Number of windows that contain each echo: a wall that is cut by one window lies in the middle of the next."""
    renewal_period: int = 2
    """Of equal readings in consecutive scans, every reading with this period counts as a fresh one."""
    min_length: float = 0.01
    """Shortest window, metres."""
    max_length: float = 100.0
    """Longest window, metres."""
    place_distance: float = 0.01
    """Distance after which a robot has moved to another place, metres."""
    place_rotation: float = float(np.radians(1.0))
    """Rotation after which a robot has moved to another place, radians."""
    min_gap: float = 0.4
    """Readings of a wall that are closer than this along the wall belong to one segment, metres."""
    scales: tuple[float, ...] = (1.0, 0.5, 2.0)
    """Lengths of the windows of a map, in multiples of the given length. A wall that windows of one length cut badly is
    found in windows of another one."""
    sparse_echoes: float = 4.0
    """Number of measured paths that receive a long wall in one scan; with fewer, scans are gathered over windows."""
    sparse_length: float = 1.5
    """Length of such a window, metres of trajectory, ..."""
    sparse_places: int = 12
    """... and at least this many places of the robot at which it measured."""
    max_sparse_length: float = 6.0
    """Longest window that is chosen automatically, metres."""


SETTINGS = WindowSettings()
_NOTHING = -1.0
"""Stands for the range of a path that heard nothing."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Sections of a trajectory; each one is treated like one scan that was taken at its last pose."""

    last: Int[np.ndarray, " windows"]
    """Row of the last scan of each window in the log; the window is in the robot frame of that scan."""
    echoes: FlatEchoes
    """Echoes of the windows, with model_from_robot poses in the frame of the last scan."""
    scan: Int[np.ndarray, " echoes"]
    """Row in the log of the scan of each of these echoes."""
    gap: float
    """Largest distance along a wall between two readings of one segment, metres; 0 for windows of single scans."""

    @classmethod
    def of_scans(cls, echoes: FlatEchoes) -> "Windows":
        """One window per scan."""
        return cls(np.arange(echoes.scan_count), echoes, echoes.scan, 0.0)


def gather_windows(ring: Ring, log: Log, *, length: float) -> tuple[Windows, int]:
    """Gather the echoes of a log over windows of its trajectory, each echo with the pose at which it was received.

    Three things are omitted: readings that were not renewed, because they belong to an earlier pose; measurements of a
    path that the robot has measured before at the same place (``has_moved``); and scans without a pose. Windows end at
    scans without a pose.

    Args:
        ring: the sensors.
        log: scans with poses, in the order of the trajectory.
        length: length of a window along the trajectory, metres. Consecutive windows start half this length apart.

    Returns:
        The windows, and the number of echoes of (tx, rx) pairs that are no paths of the ring; these are omitted.

    Raises:
        SonarError: a length out of range, or a sensor index that the ring does not have.
    """
    check_window(length)
    found = independent_measurements(ring, log)
    flat, new = found.echoes, found.independent if found.is_explicit else None
    ever = np.any(_measured(ring, flat), axis=0)
    begin, last = _window_bounds(log.pose, length)
    windows = _build_windows(ring, flat, log.pose, found.used, new, ever, begin, last, length=length)
    return windows, found.left_out


class IndependentMeasurements(NamedTuple):
    """The measurements of a log that are new: renewed readings, one of each path at each place of the robot."""

    echoes: FlatEchoes
    """All echoes of the log."""
    used: Bool[np.ndarray, " echoes"]
    """Echoes that count."""
    independent: Bool[np.ndarray, "scans paths"]
    """Measurements that count, whether or not they heard anything."""
    is_explicit: bool
    """Whether the log shows which readings were renewed. Otherwise that of echoes is guessed, and ``independent``
    contains all measurements of scans at new places."""
    left_out: int
    """Number of echoes of (tx, rx) pairs that are no paths of the ring."""


def independent_measurements(ring: Ring, log: Log) -> IndependentMeasurements:
    """The measurements of a log that count in windows.

    Args:
        ring: the sensors.
        log: scans in the order of the trajectory; nothing counts in scans without a pose.

    Raises:
        SonarError: a sensor index that the ring does not have.
    """
    flat, left_out = FlatEchoes.from_log(ring, log)
    if _lists_measurements(log) or log.age.any():
        new = _first_at_place(_measured(ring, flat), log.pose)
        return IndependentMeasurements(flat, new[flat.scan, flat.path], new, True, left_out)
    moved = has_moved(log.pose)
    used = is_fresh_reading(flat) & moved[flat.scan]
    return IndependentMeasurements(flat, used, _measured(ring, flat) & moved[:, None], False, left_out)


class Measurement(NamedTuple):
    """The latest measurement of a pair of sensors."""

    time: float
    """Seconds."""
    ranges: frozenset[float]
    """Reported ranges, metres; ``_NOTHING`` if nothing was heard."""
    place: int
    """Number of the place of the robot (``has_moved``); -1 before a scan without a pose."""


@dataclass(frozen=True, eq=False)
class WindowBuffer:
    """The scans of the last window length, for building windows scan by scan.

    The result equals ``gather_windows``. Only the poses of readings with times or ages of their own are extrapolated
    at the ends of a window, unless the scans have ``Scan.odometry``.
    """

    scans: tuple[Scan, ...] = ()
    """Scans with poses, one window length of them."""
    travelled: tuple[float, ...] = ()
    """Length of the trajectory up to each of them, metres."""
    fresh: tuple[frozenset[Reading], ...] = ()
    """The readings of each scan that count, if the log does not list its measurements (``_lists_measurements``) and
    holds no ages."""
    new: tuple[frozenset[Pair], ...] = ()
    """The pairs of each scan whose measurement counts otherwise. Both are kept, because ages may appear later."""
    runs: Mapping[Reading, int] = field(default_factory=dict)
    """Number of earlier consecutive scans that contain each reading of the latest scan."""
    place: float = 0.0
    """Cumulative motion in units of one place (``has_moved``)."""
    latest: Mapping[Pair, Measurement] = field(default_factory=dict)
    """The latest measurement of each pair."""
    has_ages: bool = False
    """Whether any reading so far had an age."""

    def add(self, scan: Scan, *, length: float) -> tuple["WindowBuffer", bool]:
        """The buffer with one more scan, and whether a window ends there. A scan without a pose empties the buffer."""
        has_ages = self.has_ages or (scan.age is not None and bool(scan.age.any()))
        heard = np.where(np.isnan(scan.range), _NOTHING, scan.range)
        readings = [*zip(scan.tx.tolist(), scan.rx.tolist(), heard.tolist(), strict=True)]
        runs = {reading: self.runs.get(reading, -1) + 1 for reading in readings}
        if not np.isfinite(scan.pose).all():
            latest = _new_measurements(scan, self.latest, self.runs, -1)[1]
            latest = {pair: one._replace(place=-1) for pair, one in latest.items()}
            return WindowBuffer(runs=runs, place=self.place, latest=latest, has_ages=has_ages), False
        travelled, place, at_rest = 0.0, self.place, False
        if self.scans:
            step = scan.pose - self.scans[-1].pose
            distance = float(np.hypot(step[0], step[1]))
            travelled = self.travelled[-1] + distance
            place += distance / SETTINGS.place_distance + abs(float(wrap_angle(step[2]))) / SETTINGS.place_rotation
            at_rest = np.floor(place) == np.floor(self.place)
        new, latest = _new_measurements(scan, self.latest, self.runs, int(np.floor(place)))
        fresh = frozenset()
        if not at_rest:
            fresh = frozenset(r for r, run in runs.items() if run % SETTINGS.renewal_period == 0)
        begin = int(np.searchsorted([*self.travelled, travelled], travelled - length))
        spacing = length / SETTINGS.overlap
        ends = bool(self.scans) and travelled // spacing > self.travelled[-1] // spacing
        buffer = WindowBuffer(
            (*self.scans, scan)[begin:],
            (*self.travelled, travelled)[begin:],
            (*self.fresh, fresh)[begin:],
            (*self.new, new)[begin:],
            runs,
            place,
            latest,
            has_ages,
        )
        return buffer, ends

    def window(self, ring: Ring, *, length: float) -> tuple[Log, Windows]:
        """The window that ends at the latest scan, and the log to which its rows refer."""
        log = Log.from_scans(self.scans)
        flat, _ = FlatEchoes.from_log(ring, log)
        ever = np.any(_measured(ring, flat), axis=0)
        new = None
        if self.has_ages or _lists_measurements(log):
            new = np.zeros((len(log), len(ring.paths)), bool)
            for row, pairs in enumerate(self.new):
                new[row, _rows_of_paths(ring, pairs)] = True
            used = new[flat.scan, flat.path]
            ever[_rows_of_paths(ring, self.latest)] = True
        else:
            columns = (flat.scan, *ring.paths[flat.path].T, flat.reported)
            rows = zip(*(column.tolist() for column in columns), strict=True)
            used = np.array([(tx, rx, distance) in self.fresh[scan] for scan, tx, rx, distance in rows], dtype=bool)
        begin, last = np.zeros(1, np.int64), np.array([len(log) - 1])
        return log, _build_windows(ring, flat, log.pose, used, new, ever, begin, last, length=length)


def _build_windows(
    ring: Ring,
    flat: FlatEchoes,
    pose: Float[np.ndarray, "scans 3"],
    used: Bool[np.ndarray, " echoes"],
    new: Bool[np.ndarray, "scans paths"] | None,
    ever: Bool[np.ndarray, " paths"],
    begin: Int[np.ndarray, " windows"],
    last: Int[np.ndarray, " windows"],
    *,
    length: float,
) -> Windows:
    """The used echoes of the scans from ``begin`` to ``last`` of each window, in the frame of its last scan.

    Args:
        ring: the sensors.
        flat: the echoes of the scans.
        pose: world_from_robot of the scans.
        used: the echoes that count.
        new: the measurements that count; if None, a scan counts by its fraction of used echoes.
        ever: the paths that were measured in any scan of the log.
        begin: first scan of each window.
        last: last scan of each window.
        length: length of the windows, metres.
    """
    first_echo = flat.start[begin]
    counts = flat.start[last + 1] - first_echo
    echo = np.repeat(first_echo - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
    window = np.repeat(np.arange(len(last)), counts)
    kept = used[echo]
    echo, window = echo[kept], window[kept]
    received_at = pose[flat.scan[echo]]
    if flat.echo_pose is not None:
        received_at = compose(received_at, flat.echo_pose[echo])
    # The occupancy threshold scales with the measurements of a window, at least with those of one scan.
    one_scan = equivalent_scans(ring, ever[None])
    if new is None:
        fraction = np.bincount(flat.scan[used], minlength=len(pose)) / np.maximum(np.diff(flat.start), 1)
        total = np.append(0, np.cumsum(fraction))
        scans_per_window = np.maximum(total[last + 1] - total[begin], 1) * one_scan
    else:
        measurements = np.zeros((len(last), len(ever)))
        total = np.pad(np.cumsum(new[:, ever], axis=0, dtype=np.int32), ((1, 0), (0, 0)))
        measurements[:, ever] = total[last + 1] - total[begin]
        scans_per_window = np.maximum(equivalent_scans(ring, measurements), one_scan)
    echoes = FlatEchoes(
        len(last),
        window,
        flat.path[echo],
        flat.reported[echo],
        pose=relative(pose[last][window], received_at),
        scans_per_window=scans_per_window,
    )
    return Windows(last, echoes, flat.scan[echo], gap=max(SETTINGS.min_gap, length / 4))


def _lists_measurements(log: Log | Scan) -> bool:
    """Whether a log holds a reading of all that was measured: ``asked`` is empty.

    In other logs without ages, readings that were not renewed can only be guessed (``is_fresh_reading``).
    """
    return bool(np.isnan(log.range).any()) if log.asked is None else not len(log.asked)


def _measured(ring: Ring, flat: FlatEchoes) -> Bool[np.ndarray, "scans paths"]:
    if flat.measured is not None:
        return flat.measured
    return np.broadcast_to(np.ones(len(ring.paths), bool), (flat.scan_count, len(ring.paths)))


def _first_at_place(
    measured: Bool[np.ndarray, "scans paths"], pose: Float[np.ndarray, "scans 3"]
) -> Bool[np.ndarray, "scans paths"]:
    """The measurements of paths that were not measured before at the same place; none of scans without a pose."""
    new = measured.copy()
    new[~np.isfinite(pose).all(axis=1)] = False
    ever = np.flatnonzero(np.any(new, axis=0))
    here = new[:, ever]
    times = np.cumsum(here, axis=0, dtype=np.int32)
    arrival = np.maximum.accumulate(np.where(has_moved(pose), np.arange(len(pose)), 0))
    new[:, ever] &= times - (times - here)[arrival] == 1
    return new


def _new_measurements(
    scan: Scan, latest: Mapping[Pair, Measurement], before: Mapping[Reading, int], place: int
) -> tuple[frozenset[Pair], dict[Pair, Measurement]]:
    """The pairs of a scan whose measurement counts, and the latest measurements with those of this scan.

    Args:
        scan: the scan.
        latest: the latest measurement of each pair before it.
        before: the readings of the scan before it.
        place: the place of the robot.
    """
    log = scan.as_log()
    columns = (log.tx, log.rx, log.range, measurement_times(log), log.age)
    measured: dict[Pair, tuple[float, set[float]]] = {}
    read: set[Pair] = set()
    for tx, rx, reported, time, age in zip(*(column.tolist() for column in columns), strict=True):
        measurement, heard = latest.get((tx, rx)), reported if np.isfinite(reported) else _NOTHING
        read.add((tx, rx))
        if age == 0:
            repeated = False
        elif not np.isfinite(scan.stamp):
            repeated = (tx, rx, heard) in before
        elif measurement is None or heard not in measurement.ranges:
            repeated = False
        else:
            repeated = abs(time - measurement.time) < AGES.same_measurement
        if not repeated:
            measured.setdefault((tx, rx), (time, set()))[1].add(heard)
    silent = {(tx, rx) for tx, rx in log.asked.tolist()} - read
    measured |= {pair: (float(log.stamp[0]), {_NOTHING}) for pair in silent}
    new = frozenset(pair for pair in measured if pair not in latest or latest[pair].place != place)
    now = {pair: Measurement(time, frozenset(ranges), place) for pair, (time, ranges) in measured.items()}
    return new, {**latest, **now}


def _rows_of_paths(ring: Ring, pairs: Iterable[Pair]) -> Int[np.ndarray, " rows"]:
    """Rows of ``Ring.paths``; other pairs are omitted."""
    tx, rx = np.array([*pairs], np.int64).reshape(-1, 2).T
    rows = path_rows(ring, tx, rx)
    return rows[rows >= 0]


def window_lengths(length: float) -> tuple[float, ...]:
    """Lengths of the windows in which the walls of a map are sought, metres; the given one is the first.

    Raises:
        SonarError: the length is out of range.
    """
    check_window(length)
    low, high = SETTINGS.min_length, SETTINGS.max_length
    return tuple(dict.fromkeys(min(max(scale * length, low), high) for scale in SETTINGS.scales))


def automatic_window(ring: Ring, log: Log) -> float | None:
    """Length of the windows for a log whose single scans cannot determine a line; None for other logs.

    A scan determines lines if enough of its measured paths receive a long wall (``sparse_echoes``). A window is longer
    if the robot measured at few places. None, too, if the robot has driven less than a window, or has no poses.

    Args:
        ring: the sensors.
        log: scans with poses, in the order of the trajectory.
    """
    known = np.isfinite(log.pose).all(axis=1)
    if not known.any() or echoes_of_long_wall(ring, log) >= SETTINGS.sparse_echoes:
        return None
    steps = np.hypot(*np.diff(log.pose[known, :2], axis=0).T)
    moving = steps[steps >= SETTINGS.place_distance]
    spacing = float(np.median(moving)) if len(moving) else 0.0
    length = min(max(SETTINGS.sparse_length, SETTINGS.sparse_places * spacing), SETTINGS.max_sparse_length)
    return round(length, 1) if float(steps.sum()) >= length else None


def check_window(length: float | None) -> None:
    """Raise a SonarError for a window length (metres) that is out of range."""
    low, high = SETTINGS.min_length, SETTINGS.max_length
    if length is not None and not low <= length <= high:  # False for NaN
        raise SonarError(f"window = {length:g} m; allowed is {low:g} to {high:g} m")


def has_moved(pose: Float[np.ndarray, "scans 3"]) -> Bool[np.ndarray, " scans"]:
    """Scans at which the robot has reached another place: the first scan of each place, none without a pose.

    A robot at rest observes the same echoes again and again; they must not outweigh all others.
    """
    known = np.all(np.isfinite(pose), axis=1)
    step = np.zeros(len(pose))
    both = known[1:] & known[:-1]
    difference = np.where(both[:, None], np.diff(pose, axis=0), 0.0)
    step[1:] = np.hypot(*difference[:, :2].T) / SETTINGS.place_distance
    step[1:] += np.abs(wrap_angle(difference[:, 2])) / SETTINGS.place_rotation
    place = np.floor(np.cumsum(step))
    return known & np.append(True, (np.diff(place) > 0) | ~both)[: len(pose)]


def is_fresh_reading(flat: FlatEchoes) -> Bool[np.ndarray, " echoes"]:
    """Echoes that are new measurements, as far as a log shows.

    A sensor that is slower than the log repeats its last reading. A sensor that moves along a wall repeats it, too, and
    those readings must not be lost. Therefore, among consecutive scans with the same range on the same path, every
    reading with the period ``WindowSettings.renewal_period`` counts.
    """
    order = np.lexsort((flat.scan, flat.reported, flat.path))
    path, reported, scan = flat.path[order], flat.reported[order], flat.scan[order]
    same = (path[1:] == path[:-1]) & (reported[1:] == reported[:-1])
    starts = np.append(True, ~(same & (np.diff(scan) <= 1)))[: len(order)]  # difference 0: twice in one scan
    first = np.maximum.accumulate(np.where(starts, np.arange(len(order)), 0)) if len(order) else order
    fresh = np.ones(len(order), bool)
    fresh[order] = (scan - scan[first]) % SETTINGS.renewal_period == 0
    return fresh


def _window_bounds(
    pose: Float[np.ndarray, "scans 3"], length: float
) -> tuple[Int[np.ndarray, " windows"], Int[np.ndarray, " windows"]]:
    """First and last scan of every window; each window extends back from its last pose by ``length``."""
    known = np.all(np.isfinite(pose), axis=1)
    begins, lasts = [], []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]])))
    for start, stop in edges.reshape(-1, 2):  # runs of scans with poses
        travelled = np.append(0.0, np.cumsum(np.hypot(*np.diff(pose[start:stop, :2], axis=0).T)))
        spacing = length / SETTINGS.overlap
        last = np.append(np.flatnonzero(np.diff(travelled // spacing) > 0) + 1, stop - start - 1)
        last = np.unique(last)
        begins.append(start + np.searchsorted(travelled, travelled[last] - length))
        lasts.append(start + last)
    nothing = np.zeros(0, np.int64)
    return np.concatenate([nothing, *begins]), np.concatenate([nothing, *lasts])
