"""Ranges that mean "no echo": what many drivers report instead of nothing. They must not be taken for walls.

A driver reports a fixed value (its minimum, its maximum, 65535 mm) or a noisy one. Such a value stands out in the
histogram of most sensors, wherever the robot is. A wall does not: only the sensors that face it read its distance, and
only as long as the robot moves parallel to it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.robust_statistics import robust_deviation
from jaxsonar.scans.readings import explicit_log, without_readings
from jaxsonar.scans.scan_log import InvalidLogValue, Log


@dataclass(frozen=True)
class NoEchoSettings:
    """Constants of the search for ranges that mean no echo.

    Chosen by hand, such that no sound log of a simulation or of the published data sets has such a value.
    """

    noise: tuple[float, ...] = (1e-3, 3e-3, 0.01, 0.02, 0.05, 0.1)
    """Standard deviations of a noisy value that are tried, metres."""
    half_width: float = 3.0
    """A window holds the readings within this many standard deviations of a value."""
    cell: float = 4.0
    """Side of a square in which the robot counts as at one place, in half widths of the window. A sensor that moves
    towards a wall does not read one value in many of them."""
    min_cell: float = 0.1
    """Smallest side of such a square, metres."""
    largest_noise: float = 0.04
    """Largest standard deviation of a noisy value, relative to the value."""
    contrast: float = 4.0
    """A noisy value has this many times as many readings as a window of equal width on either side, and an exact value
    this many times as many as any other value near it."""
    neighbors: float = 0.12
    """Values within this distance are near an exact value, metres; more than two steps of a resolution of 5 cm."""
    paths: float = 0.8
    """Share of the paths that read a value. In a corridor, only the sensors that face its walls read their distance."""
    repeated: float = 0.05
    """Share of the other echoes that have a value in common, from which on ranges have a coarse resolution."""
    paths_of_fine_ranges: float = 0.3
    """Share of the paths that read an exact value, if the resolution is so fine that no other value is repeated."""
    paths_of_isolated_value: float = 0.5
    """Share of the paths that read an isolated exact value: the largest one, far above all others."""
    isolation: float = 0.25
    """Nothing is read between this share of an isolated value below it and the value itself."""
    at_once: float = 0.2
    """Mean share of the paths that read an isolated value in one scan; more than face one wall."""
    min_paths: int = 4
    """Smallest number of paths that read a noisy value, ..."""
    min_paths_exact: int = 2
    """... and an exact one."""
    path_share: float = 0.15
    """Share of the places at which each of these paths reads a noisy value, or an exact one of a coarse resolution."""
    places: int = 3
    """Number of different places at which each of these paths reads an exact value."""
    path_readings: int = 8
    """Paths with fewer readings do not count."""
    coverage: float = 0.9
    """Share of the measurements without a nearer echo that have a noisy value, or one beyond it, at least: a driver
    that sends it instead of nothing sends it always. An echo of the floor is lost now and then."""
    noisy_readings: float = 0.2
    """Share of the echoes that have a noisy value, at least."""
    exact_readings: float = 0.01
    """Share of the echoes that have an exact value, at least."""
    most_readings: float = 0.95
    """Largest share of the echoes: where hardly any other value is read, this one does not replace silence."""
    beyond_exact: float = 0.005
    """Largest share of the echoes that are beyond an exact value: it is the smallest or the largest range."""
    certain_readings: float = 0.2
    """Beyond this share of the echoes, an exact value of ranges with a fine resolution may also lie between others."""
    beside: float = 0.02
    """Largest share of its readings with another reading of the same path in the scan: where it stands for no echo,
    there is none."""
    beyond_noisy: float = 0.05
    """Largest share of the echoes that are above a noisy value: it is about the largest range."""
    equal: float = 1e-6
    """Ranges that differ by less, relative to their value, are equal; larger than the rounding of 32-bit floats."""
    refinements: int = 10
    """Iterations for the center and the standard deviation of a noisy value."""
    most_values: int = 4
    """Number of values in one log that are looked for."""
    most_scans: int = 4000
    """Number of scans that are examined, spread over the log."""


SETTINGS = NoEchoSettings()


@dataclass(frozen=True)
class NoEchoValue:
    """A range that means no echo."""

    value: float
    """Metres."""
    sigma: float
    """Standard deviation of its noise, metres; 0 for a value that is repeated exactly."""
    readings: int
    """Number of readings of the log that have it."""
    share: float
    """Share of the readings of the log that have it."""

    @property
    def half_width(self) -> float:
        """Readings that differ from ``value`` by at most this have it, metres."""
        return max((SETTINGS.half_width + 0.5) * self.sigma, SETTINGS.equal * self.value)

    def __str__(self) -> str:
        noise = f" +- {self.sigma:.3f}" if self.sigma else ""
        return f"{self.value:.3f}{noise} m ({self.share:.0%} of the readings)"


def find_no_echo_values(log: Log) -> tuple[NoEchoValue, ...]:
    """Ranges of a log that mean no echo, as far as the log shows; neither a ring nor a map is needed.

    - An exact value is repeated by most paths at different places, far more often than the values near it.
    - A noisy value is a mode of the histogram of most paths, at many places of the robot, in a log that has an echo for
      nearly every measurement.
    - Fewer paths are enough for the largest range if it is far above all others and many paths read it in one scan.
    - Hardly any reading is beyond the value: it is the smallest or the largest range that the device reports, and the
      largest one if it is noisy.

    Without poses, only exact maxima of ranges with a fine resolution are found. A robot at rest tells nothing.

    Returns:
        The values, the most frequent one first; empty for a sound log.
    """
    stride = max(1, -(-len(log) // SETTINGS.most_scans))
    found: list[NoEchoValue] = []
    rest = _Sample.of(log[::stride] if stride > 1 else log)
    while len(found) < SETTINGS.most_values and (best := next(_found(rest), None)) is not None:
        rest = rest.without(best)
        of_it = _has_value(log.range, best)
        found.append(replace(best, readings=int(of_it.sum()), share=float(of_it.sum() / max(log.echo_count, 1))))
    return tuple(sorted(found, key=lambda one: -one.readings))


def without_no_echo_values(log: Log, values: Sequence[NoEchoValue | float]) -> Log:
    """The log with silent readings in place of ranges that mean no echo.

    An implicit log becomes an explicit one: the pairs that all its scans measured get a silent reading where a scan
    holds none. A log without these ranges is returned unchanged.

    Args:
        log: the scans.
        values: results of ``find_no_echo_values``, or exact ranges in metres.
    """
    marks = [one if isinstance(one, NoEchoValue) else NoEchoValue(one, 0.0, 0, 0.0) for one in values]
    marked = np.zeros(len(log.range), bool)
    for mark in marks:
        marked |= _has_value(log.range, mark)
    if not marked.any():
        return log
    # A path with another reading in the scan did hear something; of several marked readings, one stays as silence.
    sensors = int(max(log.tx.max(), log.rx.max())) + 1
    path = (log.echo_scan * sensors + log.tx) * sensors + log.rx
    stays = np.zeros(len(marked), bool)
    stays[np.flatnonzero(marked)[np.unique(path[marked], return_index=True)[1]]] = True
    stays &= ~np.isin(path, path[~marked])
    log, marked = without_readings(log, marked & ~stays), stays[~marked | stays]
    silent = {name: np.where(marked, np.nan, getattr(log, name)) for name in ("range", "amplitude")}
    return explicit_log(replace(log, **silent))


def as_range(mark: float) -> float:
    """What a log holds instead of a range that means no echo and is no valid range, such as 0 or -1 m."""
    return mark if mark > 0 else float(np.finfo(np.float64).tiny)


def with_valid_ranges(ranges: Float[np.ndarray, " readings"], marks: Sequence[float]) -> Float[np.ndarray, " readings"]:
    """Ranges as a file holds them, with ``as_range`` in place of the marks for no echo, metres."""
    for mark in marks:
        if not mark > 0:
            ranges = np.where(ranges == mark, as_range(mark), ranges)
    return ranges


def no_echo_hint(fault: InvalidLogValue) -> str:
    """What to do about an invalid range that can mean no echo; empty for other values."""
    if fault.column != "range" or not (isinstance(fault.value, float) and -np.inf < fault.value <= 0):
        return ""
    return f"; if {fault.value:g} means no echo, give --no-echo {fault.value:g}"


@dataclass(frozen=True, eq=False)
class _Sample:
    """Echoes of a log for the search, and what was measured."""

    path: Int[np.ndarray, " echoes"]
    """Number of the (tx, rx) pair, 0 to paths - 1."""
    range: Float[np.ndarray, " echoes"]
    scan: Int[np.ndarray, " echoes"]
    position: Float[np.ndarray, "scans 2"]
    """x, y of the robot, metres; NaN if unknown."""
    measured: Bool[np.ndarray, "scans paths"]
    """Paths that each scan measured."""

    @classmethod
    def of(cls, log: Log) -> "_Sample":
        pair = log.tx << 32 | log.rx
        pairs, path = np.unique(pair, return_inverse=True)
        measured = np.zeros((len(log), len(pairs)), bool)
        measured[:, np.isin(pairs, log.asked[:, 0] << 32 | log.asked[:, 1])] = True
        measured[log.echo_scan, path] = True
        position = log.pose[:, :2]
        heard = np.isfinite(log.range) & (log.age == 0)
        if np.isfinite(position).any():  # leave out the scans without a pose
            heard &= np.isfinite(position[log.echo_scan, 0])
            measured &= np.isfinite(position[:, :1])
        return cls(path[heard], log.range[heard], log.echo_scan[heard], position, measured)

    def without(self, value: NoEchoValue) -> "_Sample":
        rest = ~_has_value(self.range, value)
        return replace(self, path=self.path[rest], range=self.range[rest], scan=self.scan[rest])

    @property
    def has_poses(self) -> bool:
        return bool(np.isfinite(self.position).any())

    @property
    def echo_counts(self) -> Int[np.ndarray, " paths"]:
        return np.bincount(self.path, minlength=self.measured.shape[1])

    def visited(self, side: float) -> tuple[Int[np.ndarray, " scans"], Int[np.ndarray, " paths"]]:
        """The place of each scan, a square of this side, and at how many places each path was measured."""
        square = np.floor(np.nan_to_num(self.position) / side).astype(np.int64)
        places, place = np.unique(square[:, 0] << 32 ^ square[:, 1] & 0xFFFFFFFF, return_inverse=True)
        at_place = np.zeros((len(places), self.measured.shape[1]), bool)
        np.logical_or.at(at_place, place, self.measured)
        return place, at_place.sum(axis=0)

    def place_counts(
        self, echoes: Bool[np.ndarray, " echoes"], place: Int[np.ndarray, " scans"]
    ) -> Int[np.ndarray, " paths"]:
        """At how many places each path has one of these echoes."""
        pairs = np.unique(self.path[echoes].astype(np.int64) << 32 | place[self.scan[echoes]])
        return np.bincount(pairs >> 32, minlength=self.measured.shape[1])

    def has_others_beside(self, echoes: Bool[np.ndarray, " echoes"]) -> bool:
        """Whether paths often have another echo in the scan beside one of these."""
        key = self.scan * self.measured.shape[1] + self.path
        return bool(np.isin(key[echoes], key[~echoes]).mean() > SETTINGS.beside)

    def run_counts(self, echoes: Bool[np.ndarray, " echoes"]) -> Int[np.ndarray, " paths"]:
        """Number of runs of these echoes among those of each path."""
        order = np.lexsort((self.scan, self.path))
        path, chosen = self.path[order], echoes[order]
        starts = chosen & np.append(True, ~chosen[:-1] | (np.diff(path) > 0))
        return np.bincount(path[starts], minlength=self.measured.shape[1])


def _found(sample: _Sample) -> Iterator[NoEchoValue]:
    """Values that mean no echo, the exact ones first."""
    if len(sample.range) < SETTINGS.path_readings:
        return
    for value in _frequent(sample.range):
        if (mark := _exact(sample, value)) is not None:
            yield mark
    if sample.has_poses:
        for sigma in SETTINGS.noise:
            value = _mode(sample.range, sigma)
            if sigma <= SETTINGS.largest_noise * value and (mark := _noisy(sample, value, sigma)) is not None:
                yield mark


def _exact(sample: _Sample, value: float) -> NoEchoValue | None:
    """A value that is repeated exactly, if it means no echo."""
    width = SETTINGS.equal * value
    has_it = np.abs(sample.range - value) <= width
    share = float(has_it.mean())
    beyond = (np.mean(sample.range < value - width), np.mean(sample.range > value + width))
    if not SETTINGS.exact_readings <= share <= SETTINGS.most_readings or has_it.sum() < SETTINGS.path_readings:
        return None
    # With a resolution of 1 cm, readings of a wall are equal, too; but then its neighbours are frequent.
    near = ~has_it & (np.abs(sample.range - value) <= SETTINGS.neighbors)
    if SETTINGS.contrast * max(np.unique(sample.range[near], return_counts=True)[1], default=0) > has_it.sum():
        return None
    _, which, count = np.unique(sample.range[~has_it], return_inverse=True, return_counts=True)
    is_fine = len(which) == 0 or float(np.mean(count[which] > 1)) < SETTINGS.repeated
    is_certain = is_fine and share >= SETTINGS.certain_readings and not sample.has_others_beside(has_it)
    if not is_certain and (min(beyond) if sample.has_poses else beyond[1]) > SETTINGS.beyond_exact:
        return None
    if not sample.has_poses and not is_fine:
        return None
    counted = sample.echo_counts >= SETTINGS.path_readings
    if sample.has_poses:
        place, visited = sample.visited(SETTINGS.min_cell)
        places = sample.place_counts(has_it, place)
        least = SETTINGS.places if is_fine else np.maximum(SETTINGS.path_share * visited, SETTINGS.places)
        shared = counted & (places >= least)
    else:
        shared = counted & (sample.run_counts(has_it) >= SETTINGS.places)
    paths = SETTINGS.paths_of_isolated_value if _is_isolated(sample, value, has_it) else SETTINGS.paths
    paths = SETTINGS.paths_of_fine_ranges if is_fine else paths
    enough = shared.sum() >= max(SETTINGS.min_paths_exact, paths * counted.sum())
    return NoEchoValue(float(value), 0.0, int(has_it.sum()), share) if enough else None


def _is_isolated(sample: _Sample, value: float, has_it: Bool[np.ndarray, " echoes"]) -> bool:
    """Whether a value is far above all others, and more paths read it in one scan than face one wall."""
    nearest = float(np.max(sample.range[~has_it], initial=0))
    at_once = has_it.sum() / max(len(np.unique(sample.scan[has_it])), 1)
    enough = max(SETTINGS.min_paths_exact, SETTINGS.at_once * sample.measured.shape[1])
    return bool(nearest < (1 - SETTINGS.isolation) * value and at_once >= enough)


def _noisy(sample: _Sample, value: float, sigma: float) -> NoEchoValue | None:
    """A value with noise, if it means no echo."""
    width = SETTINGS.half_width * sigma
    deviation = sample.range - value
    has_it = np.abs(deviation) <= width
    share = float(has_it.mean())
    beyond = np.mean(deviation > width)
    if not SETTINGS.noisy_readings <= share <= SETTINGS.most_readings or beyond > SETTINGS.beyond_noisy:
        return None
    nearer = int((deviation < -width).sum())
    if len(deviation) - nearer < SETTINGS.coverage * (sample.measured.sum() - nearer):
        return None
    if sample.has_others_beside(has_it):
        return None
    below = np.sum((deviation < -width) & (deviation >= -3 * width)) / 2
    above = np.sum((deviation > width) & (deviation <= 3 * width)) / 2
    if SETTINGS.contrast * max(below, above) > has_it.sum():
        return None
    place, visited = sample.visited(max(SETTINGS.cell * width, SETTINGS.min_cell))
    read = sample.place_counts(has_it, place)
    counted = (sample.echo_counts >= SETTINGS.path_readings) & (visited >= 2 * SETTINGS.places)
    shared = counted & (read >= np.maximum(SETTINGS.places, SETTINGS.path_share * visited))
    if shared.sum() < max(SETTINGS.min_paths, SETTINGS.paths * counted.sum()):
        return None
    center, spread = _center_and_spread(sample.range, value, sigma)
    return NoEchoValue(center, 0.0 if spread <= SETTINGS.equal * center else spread, int(has_it.sum()), share)


def _center_and_spread(reported: Float[np.ndarray, " echoes"], center: float, spread: float) -> tuple[float, float]:
    """Median and standard deviation of a noisy value; a first window that is too narrow is widened."""
    for _ in range(SETTINGS.refinements):
        near = reported[np.abs(reported - center) <= SETTINGS.half_width * spread]
        center = float(np.median(near))
        # The deviation of a truncated normal distribution is too small; the factor holds without truncation.
        spread = min(robust_deviation(near), SETTINGS.noise[-1])
        if spread == 0:
            break
    return center, spread


def _frequent(reported: Float[np.ndarray, " echoes"]) -> list[float]:
    """The values that are repeated most often, and the smallest and the largest one."""
    value, count = np.unique(reported, return_counts=True)
    return np.unique(np.concatenate([value[np.argsort(count)[-5:]], value[:1], value[-1:]]))[::-1].tolist()


def _mode(reported: Float[np.ndarray, " echoes"], sigma: float) -> float:
    """Center of the fullest window of the histogram."""
    ordered = np.sort(reported)
    end = np.searchsorted(ordered, ordered + 2 * SETTINGS.half_width * sigma, side="right")
    begin = int(np.argmax(end - np.arange(len(ordered))))
    return float(np.median(ordered[begin : end[begin]]))


def _has_value(reported: Float[np.ndarray, " readings"], value: NoEchoValue) -> Bool[np.ndarray, " readings"]:
    return np.abs(reported - value.value) <= value.half_width  # False for NaN
