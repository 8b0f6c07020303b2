"""Windows of the path: the echoes of a short stretch gathered in one frame, for rings too sparse for one scan."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.se2 import relative, wrap_angle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.echo_batches import FlatEchoes
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.sensors.ring import Ring

Reading = tuple[int, int, float]
"""Transmitter, receiver and reported range of an echo."""
OVERLAP = 2
"""Every echo enters this many windows: a wall that one window cuts off lies in the middle of the next."""
RENEWAL = 2
"""A reading that stays the same is taken to be renewed with every second scan."""
LENGTHS = (0.01, 100.0)
"""Metres; the shortest and the longest window."""
SAME_PLACE, SAME_HEADING = 0.01, float(np.radians(1.0))
"""Metres and radians; scans within one such step of the path are taken in one place."""
LEAST_GAP = 0.4
"""Metres; readings of a wall closer than this, along it, belong to one segment."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Stretches of a path, each to be treated like one scan taken at its last pose."""

    last: Int[np.ndarray, " windows"]
    """Row of the log's scan in whose frame the window is, its last."""
    echoes: FlatEchoes
    """Echoes of the windows, with the poses that they were taken at in the frame of the last one."""
    scan: Int[np.ndarray, " echoes"]
    """Row of the log's scan that each of these echoes comes from."""
    gap: float
    """Metres of a path that may lie between two readings of one wall; 0 where nothing was gathered."""

    @classmethod
    def of_scans(cls, echoes: FlatEchoes) -> "Windows":
        """Every scan for itself."""
        return cls(np.arange(echoes.scans), echoes, echoes.scan, 0.0)


def gather(ring: Ring, log: Log, *, length: float) -> tuple[Windows, int]:
    """Gather the echoes of a log over windows of its path (each echo with the pose that it was taken at).

    Readings that have not been renewed (``renewed``) are left out: a stale reading belongs to an earlier pose. So are
    the scans of a robot that waits (``moved``), and those without a pose, which no window reaches across.

    Args:
        ring: the sensors.
        log: scans with poses, in the order in which the path was driven.
        length: of a window along the path, metres. Windows follow one another at half this distance.

    Returns:
        The windows, and how many echoes are of pairs that the ring does not listen to, and left out.

    Raises:
        SonarError: a length that is not positive, a sensor number that the ring does not have.
    """
    check_window(length)
    flat, left_out = FlatEchoes.from_log(ring, log)
    new = renewed(flat) & moved(log.pose)[flat.scan]
    return _windows(flat, log.pose, new, *_stretches(log.pose, length), length=length), left_out


@dataclass(frozen=True, eq=False)
class Stretch:
    """The latest stretch of a path, scan by scan: what the next window is gathered from."""

    scans: tuple[Scan, ...] = ()
    """Scans with poses, one window's length of them."""
    way: tuple[float, ...] = ()
    """How far the robot had come at each of them, metres."""
    new: tuple[frozenset[Reading], ...] = ()
    """The readings of each scan that were renewed."""
    runs: Mapping[Reading, int] = field(default_factory=dict)
    """For how many scans each reading of the latest one has been there."""
    place: float = 0.0
    """Count of places, as ``moved`` counts."""

    def including(self, scan: Scan, *, length: float) -> tuple["Stretch", bool]:
        """The stretch with one more scan, and whether that one ends a window; one without a pose breaks the path."""
        readings = [*zip(scan.tx.tolist(), scan.rx.tolist(), scan.range.tolist(), strict=True)]
        runs = {reading: self.runs.get(reading, -1) + 1 for reading in readings}
        if not np.isfinite(scan.pose).all():
            return Stretch(runs=runs, place=self.place), False
        way, place, waits = 0.0, self.place, False
        if self.scans:
            step = scan.pose - self.scans[-1].pose
            forward = float(np.hypot(step[0], step[1]))
            way = self.way[-1] + forward
            place += forward / SAME_PLACE + abs(float(wrap_angle(step[2]))) / SAME_HEADING
            waits = np.floor(place) == np.floor(self.place)
        new = frozenset() if waits else frozenset(r for r, run in runs.items() if run % RENEWAL == 0)
        begin = int(np.searchsorted([*self.way, way], way - length))
        ends = bool(self.scans) and way // (length / OVERLAP) > self.way[-1] // (length / OVERLAP)
        stretch = Stretch((*self.scans, scan)[begin:], (*self.way, way)[begin:], (*self.new, new)[begin:], runs, place)
        return stretch, ends

    def window(self, ring: Ring, *, length: float) -> tuple[Log, Windows]:
        """The window that ends at the latest scan, and the log that it refers to."""
        log = Log.from_scans(self.scans)
        flat, _ = FlatEchoes.from_log(ring, log)
        listened = ring.path_index[log.tx, log.rx] >= 0
        columns = (log.echo_scan[listened], log.tx[listened], log.rx[listened], log.range[listened])
        rows = zip(*(column.tolist() for column in columns), strict=True)
        new = np.array([(tx, rx, reach) in self.new[scan] for scan, tx, rx, reach in rows], dtype=bool)
        begin, last = np.zeros(1, np.int64), np.array([len(log) - 1])
        return log, _windows(flat, log.pose, new, begin, last, length=length)


def _windows(
    flat: FlatEchoes,
    pose: Float[np.ndarray, "scans 3"],
    new: Bool[np.ndarray, " echoes"],
    begin: Int[np.ndarray, " windows"],
    last: Int[np.ndarray, " windows"],
    *,
    length: float,
) -> Windows:
    """The new readings of the scans from ``begin`` to ``last``, in the frame of the last one."""
    first_echo = flat.start[begin]
    counts = flat.start[last + 1] - first_echo
    echo = np.repeat(first_echo - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
    window = np.repeat(np.arange(len(last)), counts)
    kept = new[echo]
    echo, window = echo[kept], window[kept]
    poses = relative(pose[last][window], pose[flat.scan[echo]])
    # A scan of which half the readings are new can add half the votes.
    share = np.bincount(flat.scan[new], minlength=len(pose)) / np.maximum(np.diff(flat.start), 1)
    total = np.append(0, np.cumsum(share))
    gathered = np.maximum(total[last + 1] - total[begin], 1)
    echoes = FlatEchoes(len(last), window, flat.path[echo], flat.reported[echo], pose=poses, gathered=gathered)
    return Windows(last, echoes, flat.scan[echo], gap=max(LEAST_GAP, length / 4))


def check_window(length: float | None) -> None:
    """Raise a SonarError for a window that is no length."""
    low, high = LENGTHS
    if length is not None and not low <= length <= high:  # False for NaN
        raise SonarError(f"window = {length:g} m; allowed is {low:g} to {high:g} m")


def moved(pose: Float[np.ndarray, "scans 3"]) -> Bool[np.ndarray, " scans"]:
    """Scans to which the robot has moved on: of those taken in one place the first, none without a pose.

    A robot that waits hears the same echoes again and again; that must not weigh more than what it heard on its way.
    """
    known = np.all(np.isfinite(pose), axis=1)
    step = np.zeros(len(pose))
    both = known[1:] & known[:-1]
    difference = np.where(both[:, None], np.diff(pose, axis=0), 0.0)
    step[1:] = np.hypot(*difference[:, :2].T) / SAME_PLACE + np.abs(wrap_angle(difference[:, 2])) / SAME_HEADING
    place = np.floor(np.cumsum(step))
    return known & np.append(True, (np.diff(place) > 0) | ~both)[: len(pose)]


def renewed(flat: FlatEchoes) -> Bool[np.ndarray, " echoes"]:
    """Which echoes are new readings, as far as a log can tell.

    A sensor that is slower than the log repeats its last reading. So does one that moves along a wall, and that must
    not be lost. Hence, of a run of scans with the same range on the same path, every ``RENEWAL``-th reading counts.
    """
    order = np.lexsort((flat.scan, flat.reported, flat.path))
    path, reported, scan = flat.path[order], flat.reported[order], flat.scan[order]
    same = (path[1:] == path[:-1]) & (reported[1:] == reported[:-1])
    begins = np.append(True, ~(same & (np.diff(scan) <= 1)))[: len(order)]  # 0: it came twice in one scan
    first = np.maximum.accumulate(np.where(begins, np.arange(len(order)), 0)) if len(order) else order
    fresh = np.ones(len(order), bool)
    fresh[order] = (scan - scan[first]) % RENEWAL == 0
    return fresh


def _stretches(
    pose: Float[np.ndarray, "scans 3"], length: float
) -> tuple[Int[np.ndarray, " windows"], Int[np.ndarray, " windows"]]:
    """First and last scan of every window: each reaches back by ``length`` from its last pose."""
    known = np.all(np.isfinite(pose), axis=1)
    begins, lasts = [], []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]])))
    for start, stop in edges.reshape(-1, 2):  # runs of scans with poses
        way = np.append(0.0, np.cumsum(np.hypot(*np.diff(pose[start:stop, :2], axis=0).T)))
        last = np.append(np.flatnonzero(np.diff(way // (length / OVERLAP)) > 0) + 1, stop - start - 1)
        last = np.unique(last)
        begins.append(start + np.searchsorted(way, way[last] - length))
        lasts.append(start + last)
    nothing = np.zeros(0, np.int64)
    return np.concatenate([nothing, *begins]), np.concatenate([nothing, *lasts])
