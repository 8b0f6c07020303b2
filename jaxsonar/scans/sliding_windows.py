"""Sliding windows along the trajectory: the echoes of several scans in one frame, for rings with few sensors."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.se2 import relative, wrap_angle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.sensors.ring import Ring

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


SETTINGS = WindowSettings()


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

    Three things are omitted: readings that were not renewed (``is_fresh_reading``), because they belong to an earlier
    pose; scans of a robot at rest (``has_moved``); and scans without a pose. Windows end at scans without a pose.

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
    flat, left_out = FlatEchoes.from_log(ring, log)
    used = is_fresh_reading(flat) & has_moved(log.pose)[flat.scan]
    return _build_windows(flat, log.pose, used, *_window_bounds(log.pose, length), length=length), left_out


@dataclass(frozen=True, eq=False)
class WindowBuffer:
    """The scans of the last window length, for building windows scan by scan. The result equals ``gather_windows``."""

    scans: tuple[Scan, ...] = ()
    """Scans with poses, one window length of them."""
    travelled: tuple[float, ...] = ()
    """Length of the trajectory up to each of them, metres."""
    fresh: tuple[frozenset[Reading], ...] = ()
    """The fresh readings of each scan."""
    runs: Mapping[Reading, int] = field(default_factory=dict)
    """Number of earlier consecutive scans that contain each reading of the latest scan."""
    place: float = 0.0
    """Cumulative motion in units of one place (``has_moved``)."""

    def add(self, scan: Scan, *, length: float) -> tuple["WindowBuffer", bool]:
        """The buffer with one more scan, and whether a window ends there. A scan without a pose empties the buffer."""
        readings = [*zip(scan.tx.tolist(), scan.rx.tolist(), scan.range.tolist(), strict=True)]
        runs = {reading: self.runs.get(reading, -1) + 1 for reading in readings}
        if not np.isfinite(scan.pose).all():
            return WindowBuffer(runs=runs, place=self.place), False
        travelled, place, at_rest = 0.0, self.place, False
        if self.scans:
            step = scan.pose - self.scans[-1].pose
            distance = float(np.hypot(step[0], step[1]))
            travelled = self.travelled[-1] + distance
            place += distance / SETTINGS.place_distance + abs(float(wrap_angle(step[2]))) / SETTINGS.place_rotation
            at_rest = np.floor(place) == np.floor(self.place)
        fresh = (
            frozenset() if at_rest else frozenset(r for r, run in runs.items() if run % SETTINGS.renewal_period == 0)
        )
        begin = int(np.searchsorted([*self.travelled, travelled], travelled - length))
        spacing = length / SETTINGS.overlap
        ends = bool(self.scans) and travelled // spacing > self.travelled[-1] // spacing
        buffer = WindowBuffer(
            (*self.scans, scan)[begin:], (*self.travelled, travelled)[begin:], (*self.fresh, fresh)[begin:], runs, place
        )
        return buffer, ends

    def window(self, ring: Ring, *, length: float) -> tuple[Log, Windows]:
        """The window that ends at the latest scan, and the log to which its rows refer."""
        log = Log.from_scans(self.scans)
        flat, _ = FlatEchoes.from_log(ring, log)
        is_path = ring.path_index[log.tx, log.rx] >= 0
        columns = (log.echo_scan[is_path], log.tx[is_path], log.rx[is_path], log.range[is_path])
        rows = zip(*(column.tolist() for column in columns), strict=True)
        used = np.array([(tx, rx, distance) in self.fresh[scan] for scan, tx, rx, distance in rows], dtype=bool)
        begin, last = np.zeros(1, np.int64), np.array([len(log) - 1])
        return log, _build_windows(flat, log.pose, used, begin, last, length=length)


def _build_windows(
    flat: FlatEchoes,
    pose: Float[np.ndarray, "scans 3"],
    used: Bool[np.ndarray, " echoes"],
    begin: Int[np.ndarray, " windows"],
    last: Int[np.ndarray, " windows"],
    *,
    length: float,
) -> Windows:
    """The used echoes of the scans from ``begin`` to ``last`` of each window, in the frame of its last scan."""
    first_echo = flat.start[begin]
    counts = flat.start[last + 1] - first_echo
    echo = np.repeat(first_echo - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
    window = np.repeat(np.arange(len(last)), counts)
    kept = used[echo]
    echo, window = echo[kept], window[kept]
    poses = relative(pose[last][window], pose[flat.scan[echo]])
    # The occupancy threshold scales with the number of scans; a scan counts by its fraction of used readings.
    fraction = np.bincount(flat.scan[used], minlength=len(pose)) / np.maximum(np.diff(flat.start), 1)
    total = np.append(0, np.cumsum(fraction))
    scans_per_window = np.maximum(total[last + 1] - total[begin], 1)
    echoes = FlatEchoes(
        len(last), window, flat.path[echo], flat.reported[echo], pose=poses, scans_per_window=scans_per_window
    )
    return Windows(last, echoes, flat.scan[echo], gap=max(SETTINGS.min_gap, length / 4))


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
