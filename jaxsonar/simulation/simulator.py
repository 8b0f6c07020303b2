"""What a ring hears in a room: the echoes of a scan log, with the reflector that each of them came from.

Geometry is exact (``jaxsonar.reflections``); amplitudes decide only which echoes a threshold detector hears.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import REFERENCE_SPEED_OF_SOUND, Ring
from jaxsonar.simulation.image_sources import Kind as Kind
from jaxsonar.simulation.image_sources import Reflections, trace

SECONDS_PER_SCAN = 0.1
"""Between scans that come without stamps: about the rate of the paper's ring (8 firing groups of 11.7 ms)."""
NEAREST_CLUTTER = 0.1
"""Metres; false echoes lie between here and the maximum range."""


@dataclass(frozen=True)
class Acoustics:
    """From geometry to loudness. Amplitudes are relative to a large smooth wall on the axis at 1 m, direct echo = 1.

    Raises:
        SonarError: a value out of the range given.
    """

    reflectivity: float = 1.0
    """Share of the amplitude that a wall sends back, once per reflection, (0, 1]; smooth hard walls: about 1."""
    edge_strength: float = 0.02
    """Amplitude of an edge 1 m from both sensors, >= 0; falls with sqrt(d1 d2 (d1 + d2)) of the two distances, a
    cylindrical wave from a point source. 0.02 is a half plane at 40 kHz away from its specular direction (Keller's
    diffraction coefficient 1 / sqrt(8 pi k) and its obliquity factor of 1 to 2)."""
    pole_strength: float = 0.1
    """Amplitude of a thin pole 1 m from both sensors, >= 0; falls likewise. 0.1 is a smooth pole of 1 cm radius, a
    table leg: sqrt(radius / distance) of a wall there."""
    beam_edge_db: float = 6.0
    """Loss at the border of a sensor's cone, one way, dB, >= 0; Gaussian in the off-axis angle between. 6 dB is how
    data sheets define the beam angle of such transducers."""
    absorption_db_per_m: float = 1.3
    """Loss in air along the whole path beyond (gain: before) the 2 m of the reference wall, dB/m, >= 0. 1.3 dB/m is
    40 kHz at 20 deg C and 50 % relative humidity (ISO 9613-1)."""
    threshold: float = 0.02
    """Fainter echoes are not heard, >= 0."""

    def __post_init__(self):
        for field in fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value >= 0):
                raise SonarError(f"acoustics: {field.name} {value:g}; allowed are finite numbers, 0 or more")
        if not 0 < self.reflectivity <= 1:
            raise SonarError(f"acoustics: reflectivity {self.reflectivity:g}; allowed is more than 0 and at most 1")


@dataclass(frozen=True, eq=False)
class Simulation:
    """Echoes of all scans, sorted by scan, path and range."""

    scan: Int[np.ndarray, " echoes"]
    """Row of the poses, from 0. A scan that heard nothing has no entry."""
    path: Int[np.ndarray, " echoes"]
    """Row of ``Ring.paths``."""
    range: Float[np.ndarray, " echoes"]
    """As a log has it, metres: time of flight times 343.2 m/s, halved, with offsets and errors (``Ring.corrected``)."""
    amplitude: Float[np.ndarray, " echoes"]
    """Relative to a wall on the axis at 1 m (``Acoustics``)."""
    kind: Int[np.ndarray, " echoes"]
    """Truth: what it came from, a value of ``Kind``."""
    reflector: Int[np.ndarray, " echoes"]
    """Truth: wall (for second order the first of the two), vertex of ``Room.junctions`` (corner, edge) or pole; -1 for
    clutter."""
    stamps: Float[np.ndarray, " scans"]
    """Seconds, one for every pose."""

    def as_log(self, ring: Ring, poses: Float[np.ndarray, "scans 3"]) -> Log:
        """A scan log of these echoes, the given poses (x, y, theta; metres, radians) in it as odometry."""
        tx, rx = ring.paths[self.path].T
        return Log.from_echoes(self.scan, tx, rx, self.range, amplitude=self.amplitude, stamp=self.stamps, pose=poses)

    def dense(self, paths: int, echoes: int) -> Float[np.ndarray, "scans paths echoes"]:
        """Ranges as ``extract_lines`` takes them: (scans, paths, echoes), nearest first, NaN = no echo.

        Args:
            paths: number of echo paths of the ring.
            echoes: slots for each path; echoes beyond are left out.
        """
        ranges = np.full((len(self.stamps), paths, echoes), np.nan)
        rank = _rank(self.scan * paths + self.path)
        kept = rank < echoes
        ranges[self.scan[kept], self.path[kept], rank[kept]] = self.range[kept]
        return ranges


def simulate(
    ring: Ring,
    room: Room,
    poses: Float[np.ndarray, "scans 3"],
    *,
    sigma: float = 0.0,
    drift: float = 0.0,
    drift_time: float = 10.0,
    dropout: float = 0.0,
    clutter: float = 0.0,
    seed: int = 0,
    max_echoes: int = 3,
    blanking: float = 0.03,
    acoustics: Acoustics | None = None,
    stamps: Float[np.ndarray, " scans"] | None = None,
    progress: Callable[[int, int], None] | None = None,
    chunk: int = 128,
) -> Simulation:
    """Echoes of every path of a ring at every pose: walls, corners, edges, poles, wall to wall, and what goes wrong.

    The same arguments give the same echoes. The errors (noise, drift, loss, clutter) draw from separate streams, so
    that changing one leaves the others as they were.

    Args:
        ring: sensors, paths, range offsets, speed of sound, maximum range.
        room: what reflects.
        poses: (scans, 3) world_from_robot (x, y, theta), metres and radians.
        sigma: standard deviation of the white noise of each range, metres.
        drift: standard deviation of a slow error of each sensor (an Ornstein-Uhlenbeck process), metres; a path gets
            the mean of its two sensors.
        drift_time: time in which the drift's correlation falls to 1/e, seconds.
        dropout: probability that an echo is lost, 0 to 1.
        clutter: expected number of false echoes for every real one of the scan before losses: a Poisson number, on
            paths with overlapping cones, uniform in range from 0.1 m, amplitude up to ten thresholds.
        seed: of all randomness.
        max_echoes: a path reports its nearest ones up to this number, clutter included.
        blanking: an echo so little (half path length, metres) after the last one that was kept is not heard.
        acoustics: amplitudes and threshold; default ``Acoustics()``.
        stamps: (scans,) seconds, not decreasing; default 0.1 s apart. Only the drift depends on them.
        progress: called with (scans done, scans) now and then.
        chunk: scans traced at once; has no influence on the result.

    Raises:
        SonarError: a value out of range, named with what is allowed.
    """
    sound = Acoustics() if acoustics is None else acoustics
    times = np.arange(len(poses)) * SECONDS_PER_SCAN if stamps is None else np.array(stamps, dtype=np.float64)
    _check(poses, times, sigma, drift, drift_time, dropout, clutter, seed, max_echoes, blanking, chunk)
    array = _Array.of(ring)
    parts = [_none()]
    for begin in range(0, len(poses), chunk):
        heard = _heard(array, room, poses[begin : begin + chunk], sound, max_echoes, blanking)
        parts.append(_both_ways(array, heard._replace(scan=heard.scan + begin)))
        if progress is not None:
            progress(min(begin + chunk, len(poses)), len(poses))
    # Errors are drawn for all scans at once, in the order of the sorted echoes, so that chunks cannot matter.
    echoes = _sorted(_joined(parts))
    for_noise, for_drift, for_loss, for_clutter = np.random.default_rng(seed).spawn(4)
    false = _clutter(array, echoes, len(poses), clutter, sound.threshold, for_clutter)
    wander = _drift(times, len(array.heading), drift, drift_time, for_drift)
    tx, rx = array.paths[echoes.path].T
    error = (wander[echoes.scan, tx] + wander[echoes.scan, rx]) / 2
    error += sigma * for_noise.standard_normal(len(error))
    left = for_loss.random(len(error)) >= dropout
    echoes = _Echoes(*(column[left] for column in array.reported(echoes, error)))
    echoes = _sorted(_joined([echoes, array.reported(false, 0.0)]))
    # No detector reports more than it has slots for, nor an echo from before it fired.
    kept = (_rank(echoes.scan * len(array.paths) + echoes.path) < max_echoes) & (echoes.range > 0)
    scan, path, reported, amplitude, kind, reflector, _ = (column[kept] for column in echoes)
    return Simulation(scan, path, reported, amplitude, kind, reflector, times)


class _Echoes(NamedTuple):
    """Columns of echoes; at first a path is an unordered pair and a range half the true path length."""

    scan: np.ndarray
    path: np.ndarray
    range: np.ndarray
    amplitude: np.ndarray
    kind: np.ndarray
    reflector: np.ndarray
    second: np.ndarray  # second wall, becomes the first on the way back


class _Array(NamedTuple):
    """A ring as plain arrays. (i, j) and (j, i) hear the same: each unordered pair is traced once, entered twice."""

    position: np.ndarray  # (sensors, 2)
    heading: np.ndarray  # (sensors,)
    half_beam: np.ndarray  # (sensors,)
    max_range: float
    speed: float
    paths: np.ndarray  # (paths, 2)
    offset: np.ndarray  # (paths,)
    audible: np.ndarray  # rows of paths whose cones overlap
    pairs: np.ndarray  # (pairs, 2) unordered sensors
    path_of: np.ndarray  # (pairs, 2) the path there and the path back, -1 where the ring has none

    @classmethod
    def of(cls, ring: Ring) -> "_Array":
        heading, beam, offset = (np.asarray(x, dtype=np.float64) for x in (ring.heading, ring.beam, ring.range_offset))
        tx, rx = ring.paths.T
        pairs, pair = np.unique(np.sort(ring.paths, axis=1), axis=0, return_inverse=True)
        path_of = np.full((len(pairs), 2), -1)
        path_of[pair, (tx > rx).astype(int)] = np.arange(len(tx))
        apart = np.abs(wrap_angle(heading[tx] - heading[rx]))
        return cls(
            position=np.asarray(ring.position, dtype=np.float64),
            heading=heading,
            half_beam=beam / 2,
            max_range=ring.max_range,
            speed=float(ring.speed_of_sound),
            paths=ring.paths,
            offset=(offset[tx] + offset[rx]) / 2,
            audible=np.flatnonzero(apart < (beam[tx] + beam[rx]) / 2),
            pairs=pairs,
            path_of=path_of,
        )

    def reported(self, echoes: _Echoes, error: np.ndarray | float) -> _Echoes:
        """With ranges as a log has them instead of half path lengths."""
        scale = REFERENCE_SPEED_OF_SOUND / self.speed
        return echoes._replace(range=echoes.range * scale + self.offset[echoes.path] + error)


def _heard(array: _Array, room: Room, poses: np.ndarray, sound: Acoustics, max_echoes: int, blanking: float) -> _Echoes:
    """What a threshold detector makes of the echoes of a few scans, exact ranges."""
    cos, sin = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
    x, y = array.position.T
    sensors = poses[:, None, :2] + np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    heading = poses[:, 2, None] + array.heading
    axis = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    found = trace(room, sensors, array.pairs, max_range=array.max_range, axis=axis, half_beam=array.half_beam)
    amplitude = _amplitude(array, found, sensors, axis, sound)
    loud = amplitude >= sound.threshold
    found, amplitude = found[loud], amplitude[loud]
    order = np.lexsort((found.second, found.reflector, found.kind, found.length, found.pair, found.group))
    found, amplitude = found[order], amplitude[order]
    kept = _unblanked(found.group * len(array.pairs) + found.pair, found.length / 2, blanking, max_echoes)
    found, amplitude = found[kept], amplitude[kept]
    return _Echoes(found.group, found.pair, found.length / 2, amplitude, found.kind, found.reflector, found.second)


def _amplitude(
    array: _Array, found: Reflections, sensors: np.ndarray, axis: np.ndarray, sound: Acoustics
) -> np.ndarray:
    tx, rx = array.pairs[found.pair].T
    out, departing = _leg(sensors[found.group, tx], axis[found.group, tx], found.first)
    back, arriving = _leg(sensors[found.group, rx], axis[found.group, rx], found.last)
    with np.errstate(divide="ignore"):
        scattered = np.sqrt(2.0 / (out * back * (out + back)))
    reflections = np.where(found.kind == Kind.PLANE, 1, 2)
    strength = np.select(
        [found.kind == Kind.EDGE, found.kind == Kind.POLE],
        [sound.edge_strength * scattered, sound.pole_strength * scattered],
        sound.reflectivity**reflections / (found.length / 2),
    )
    off_axis = (departing / array.half_beam[tx]) ** 2 + (arriving / array.half_beam[rx]) ** 2
    loss_db = sound.beam_edge_db * off_axis + sound.absorption_db_per_m * (found.length - 2.0)
    return strength * 10 ** (-loss_db / 20)


def _leg(sensor: np.ndarray, axis: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Length of the leg from a sensor to a point, metres, and its angle off the axis, radians."""
    leg = point - sensor
    across = axis[:, 0] * leg[:, 1] - axis[:, 1] * leg[:, 0]
    return np.linalg.norm(leg, axis=-1), np.abs(np.arctan2(across, (axis * leg).sum(-1)))


def _unblanked(key: np.ndarray, distance: np.ndarray, blanking: float, max_echoes: int) -> np.ndarray:
    """Indices of the echoes kept on every path: the first one, then the first that is ``blanking`` further, and so on.

    Args:
        key: which path; echoes are sorted by it, then by distance.
        distance: half path lengths, metres.
        blanking: metres.
        max_echoes: kept on a path.
    """
    first = np.flatnonzero(np.diff(key, prepend=-1))
    rank = _rank(key)
    table = np.full((len(first), rank.max(initial=0) + 1), np.inf)
    table[np.cumsum(rank == 0) - 1, rank] = distance
    index = np.arange(table.shape[1])
    column = np.zeros(len(first), dtype=int)
    kept = [first]
    for _ in range(1, min(max_echoes, table.shape[1])):
        last = np.take_along_axis(table, column[:, None], axis=1)
        later = np.isfinite(table) & (index > column[:, None]) & (table >= last + blanking)
        more = later.any(axis=1)
        table, first, column = table[more], first[more], later[more].argmax(axis=1)
        kept.append(first + column)
    return np.sort(np.concatenate(kept))


def _rank(key: np.ndarray) -> np.ndarray:
    """Position of each entry among those of its key; keys are sorted and not negative."""
    first = np.flatnonzero(np.diff(key, prepend=-1))
    return np.arange(len(key)) - np.repeat(first, np.diff(np.append(first, len(key))))


def _both_ways(array: _Array, echoes: _Echoes) -> _Echoes:
    """The echoes of pairs as echoes of the paths there and back; the way back meets the walls in the other order."""
    there, back = array.path_of[echoes.path].T
    swapped = np.where(echoes.kind == Kind.SECOND_ORDER, echoes.second, echoes.reflector)
    both = _joined([echoes._replace(path=there), echoes._replace(path=back, reflector=swapped)])
    return _Echoes(*(column[both.path >= 0] for column in both))


def _clutter(
    array: _Array, echoes: _Echoes, scans: int, clutter: float, threshold: float, rng: np.random.Generator
) -> _Echoes:
    if not len(array.audible):
        return _none()
    count = rng.poisson(clutter * np.bincount(echoes.scan, minlength=scans))
    total = int(count.sum())
    nearest = min(NEAREST_CLUTTER, array.max_range)
    return _Echoes(
        scan=np.repeat(np.arange(scans), count),
        path=rng.choice(array.audible, total),
        range=rng.uniform(nearest, array.max_range, total),
        amplitude=threshold * 10 ** rng.random(total),
        kind=np.full(total, int(Kind.CLUTTER)),
        reflector=np.full(total, -1),
        second=np.full(total, -1),
    )


def _drift(
    stamps: np.ndarray, sensors: int, drift: float, drift_time: float, rng: np.random.Generator
) -> Float[np.ndarray, "scans sensors"]:
    """A stationary Ornstein-Uhlenbeck process a sensor, exact at any spacing of the stamps."""
    waited = np.diff(stamps, prepend=-np.inf)[:, None] / drift_time
    keep = np.exp(-waited)
    value = drift * np.sqrt(-np.expm1(-2 * waited)) * rng.standard_normal((len(stamps), sensors))
    # value[k] = keep[k] value[k - 1] + shock[k] for all k at once: spans of the recursion double with every step.
    step = 1
    while step < len(stamps):
        value[step:] += keep[step:] * value[:-step]
        keep[step:] *= keep[:-step]
        step *= 2
    return value


def _joined(parts: list[_Echoes]) -> _Echoes:
    return _Echoes(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _sorted(echoes: _Echoes) -> _Echoes:
    order = np.lexsort((echoes.second, echoes.reflector, echoes.kind, echoes.range, echoes.path, echoes.scan))
    return _Echoes(*(column[order] for column in echoes))


def _none() -> _Echoes:
    whole, real = np.zeros(0, dtype=int), np.zeros(0)
    return _Echoes(whole, whole, real, real, whole, whole, whole)


def _check(poses, stamps, sigma, drift, drift_time, dropout, clutter, seed, max_echoes, blanking, chunk) -> None:
    if poses.ndim != 2 or poses.shape[1] != 3:
        raise SonarError(f"simulate: poses of shape {poses.shape}; allowed is (scans, 3): x, y, theta")
    if not np.isfinite(poses).all():
        row = int(np.argmin(np.all(np.isfinite(poses), axis=1)))
        raise SonarError(f"simulate: pose {row} is {poses[row].tolist()}; allowed are finite x, y (m) and theta (rad)")
    if stamps.shape != (len(poses),):
        raise SonarError(f"simulate: stamps of shape {stamps.shape}; allowed is one for each of the {len(poses)} poses")
    if not (np.isfinite(stamps).all() and (np.diff(stamps) >= 0).all()):
        raise SonarError("simulate: stamps fall or are not finite; allowed are finite seconds that do not decrease")
    limits = {
        "sigma": (sigma, 0.0, np.inf),
        "drift": (drift, 0.0, np.inf),
        "drift_time": (drift_time, np.finfo(float).tiny, np.inf),
        "dropout": (dropout, 0.0, 1.0),
        "clutter": (clutter, 0.0, np.inf),
        "blanking": (blanking, 0.0, np.inf),
        "seed": (seed, 0, np.inf),
        "max_echoes": (max_echoes, 1, np.inf),
        "chunk": (chunk, 1, np.inf),
    }
    for name, (value, low, high) in limits.items():
        if not (np.isfinite(value) and low <= value <= high):
            allowed = f"{low:g} to {high:g}" if np.isfinite(high) else f"{low:g} or more"
            allowed = "more than 0" if name == "drift_time" else allowed
            raise SonarError(f"simulate: {name} {value:g}; allowed is {allowed}")
