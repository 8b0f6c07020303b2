"""Readings that a driver holds: while a sensor hears nothing, it reports the last range again.

Such a reading tells nothing about the pose of the robot at which it is reported. A repeated range alone is no proof: a
sensor with a coarse resolution reads one value along a whole wall, and a slow sensor is read several times. A held
reading is recognized by geometry: the robot moved so that neither a wall nor a point in the detection cone can have
kept its range.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int

from jaxsonar.plausibility.constant_ranges import may_stay, range_resolution
from jaxsonar.scans.firing_poses import reading_poses
from jaxsonar.scans.measured_paths import path_rows
from jaxsonar.scans.readings import measurement_times
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class HeldReadingSettings:
    """Constants of the search for held readings. Chosen by hand."""

    min_change: float = 0.03
    """Change of the range from which on it must show in the reading, metres; larger than the errors of odometry within
    a few scans."""
    steps: float = 2.0
    """Added to it, in units of the resolution. Readings that differ by this at most are nearly equal."""
    present: float = 0.99
    """A held sensor has a reading in at least this share of the scans since its first one."""
    min_readings: int = 20
    """Readings of a path that is examined."""
    min_held: int = 10
    """Proven held readings that are needed."""
    min_runs: int = 5
    """Different runs of equal readings that they come from."""
    contrast: float = 8.0
    """A fresh reading equals an old one by chance as often as it differs by one step of the resolution. There must be
    this many times as many runs of equal readings."""
    most_of_one_value: float = 0.3
    """Largest share of the runs that have the same range; more of them are a mark for no echo, or the robot itself."""
    renewal_quantile: float = 0.1
    """Quantile of the lengths of runs of equal readings that gives the renewal period of a slow sensor, in scans."""
    min_changed: float = 0.1
    """A scan counts only if at least this share of its readings changed; else the robot may be at rest, whatever its
    odometry says."""
    block: int = 20_000
    """Pairs of readings that are compared at a time."""


SETTINGS = HeldReadingSettings()


@dataclass(frozen=True, eq=False)
class HeldReadings:
    """Readings that repeat an old range because the sensor heard nothing. False if there are none."""

    reading: Int[np.ndarray, " held"]
    """Rows of the readings in the log."""
    source: Int[np.ndarray, " held"]
    """Rows of the readings that they repeat."""
    sensors: tuple[int, ...]
    """Receivers of these readings."""
    share: float
    """Share of all readings of the log."""

    def __bool__(self) -> bool:
        return len(self.reading) > 0

    def describe(self) -> str:
        """The finding in one sentence."""
        count = len(self.sensors)
        who = f"{count} sensors" if count > 4 else f"sensor{'s' * (count > 1)} {', '.join(map(str, self.sensors))}"
        return (
            f"the driver repeats the last range of a sensor that hears nothing: {len(self.reading)} readings "
            f"({self.share:.0%}) of {who} stay equal to the last digit while the robot moves"
        )


def find_held_readings(ring: Ring, log: Log) -> HeldReadings:
    """Find readings that were held, in a log that marks neither silence nor ages and has poses.

    The driver holds readings if all this is true of the paths that have a reading in every scan since their first one:

    - Readings stay equal although the robot moved so that they must have changed (``may_stay``), in several runs with
      different values.
    - Readings that are nearly equal under the same conditions are much rarer. Equal readings are therefore no chance.
    - The runs are longer than the renewal period of the sensors.

    Args:
        ring: the sensors; other (tx, rx) pairs are ignored.
        log: the scans. Full scans; see ``group_firings``.
    """
    none = HeldReadings(np.zeros(0, np.int64), np.zeros(0, np.int64), (), 0.0)
    if np.isnan(log.range).any() or log.age.any() or len(log) < SETTINGS.min_readings:
        return none
    row = _complete_paths(ring, log)
    if not len(row):
        return none
    path, scan, reported = ring.path_index[log.tx[row], log.rx[row]], log.echo_scan[row], log.range[row]
    follows = np.append(False, (np.diff(path) == 0) & (np.diff(scan) == 1))
    equal = follows & np.append(False, np.diff(reported) == 0)
    # Runs of equal readings: the first and the last reading of the run of each one, and the first of the run before it.
    number, starts = np.cumsum(~equal) - 1, np.flatnonzero(~equal)
    first, length = starts[number], np.diff(np.append(starts, len(row)))
    last, before = first + length[number] - 1, np.append(0, first[:-1])
    resolution = range_resolution(reported)
    near = follows & ~equal & (np.abs(reported - reported[before]) <= SETTINGS.steps * resolution)
    # Did the robot move too far for an equal reading, or for the end of a run that is nearly equal to the run before?
    changes = np.bincount(scan[follows & ~equal], minlength=len(log))
    moving = changes >= SETTINGS.min_changed * np.maximum(np.bincount(scan[follows], minlength=len(log)), 1)
    compared = np.flatnonzero((equal | near) & moving[scan])
    margin = SETTINGS.min_change + SETTINGS.steps * resolution
    pose, moved = reading_poses(log)[row], np.zeros(len(row), bool)
    for begin in range(0, len(compared), SETTINGS.block):
        one = compared[begin : begin + SETTINGS.block]
        early, late = np.where(equal[one], first[one], before[one]), np.where(equal[one], one, last[one])
        moved[one] = ~may_stay(ring, path[one], reported[early], pose[early], pose[late], margin)
    # A slow sensor is read several times; only longer runs are held. Runs are counted, whatever their length.
    period = int(np.quantile(length, SETTINGS.renewal_quantile))
    proven = equal & moved & (np.arange(len(row)) - first > period)
    runs = np.unique(first[proven])
    most_of_one_value = np.unique(reported[runs], return_counts=True)[1].max(initial=0)
    by_chance = SETTINGS.contrast / (2 * SETTINGS.steps)
    if (
        proven.sum() < SETTINGS.min_held
        or len(runs) < max(SETTINGS.min_runs, by_chance * (near & moved).sum())
        or most_of_one_value > SETTINGS.most_of_one_value * len(runs)
    ):
        return none
    # With a fine resolution, no fresh reading is equal to an old one. Otherwise only the motion distinguishes them.
    is_fine = by_chance * near.sum() < (length > period).sum()
    held = equal if is_fine else equal & _since_first(equal & moved, first)
    sensors = np.unique(log.rx[row[held]])
    return HeldReadings(row[held], row[first[held]], tuple(sensors.tolist()), float(held.sum() / len(log.range)))


def with_ages(log: Log, found: HeldReadings) -> Log:
    """The log in which held readings have the age of the reading that they repeat; unchanged if there are none."""
    if not found:
        return log
    time, age = measurement_times(log), log.age.copy()
    age[found.reading] = np.maximum(time[found.reading] - time[found.source], 0)
    return replace(log, age=age)


def _complete_paths(ring: Ring, log: Log) -> Int[np.ndarray, " rows"]:
    """Readings of the paths with one reading in every scan since their first one, sorted by path and scan."""
    path, scan = path_rows(ring, log.tx, log.rx), log.echo_scan
    row = np.lexsort((scan, path))
    path, scan = path[row], scan[row]
    row, scan, path = row[path >= 0], scan[path >= 0], path[path >= 0]
    count = np.bincount(path, minlength=len(ring.paths))
    since = np.full(len(ring.paths), len(log))
    np.minimum.at(since, path, scan)
    twice = np.zeros(len(ring.paths), bool)
    twice[path[1:][(np.diff(path) == 0) & (np.diff(scan) == 0)]] = True
    complete = ~twice & (count >= SETTINGS.min_readings) & (count >= SETTINGS.present * (len(log) - since))
    return row[complete[path]]


def _since_first(proven: Bool[np.ndarray, " rows"], first: Int[np.ndarray, " rows"]) -> Bool[np.ndarray, " rows"]:
    """Readings from the first proven one of their run on."""
    count = np.cumsum(proven)
    return count > (count - proven)[first]
