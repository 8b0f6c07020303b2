"""Faults of the diagnostics benchmark: a log, the ring it is said to come from, and what is wrong."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from benchmarks.diagnostics.scenes import Scene, random_scene, with_geometry
from jaxsonar import Log, Ring
from jaxsonar.sensors.ring import REFERENCE_SPEED_OF_SOUND

LEAST_NOISE = 0.003
"""Least true standard deviation of the ranges where a wrong one is stated, metres."""
LEAST_ECHOES = 50
"""Direct echoes that a sensor has before its fault, so that the fault shows. A turned or exchanged sensor has as many
with its fault: one that hears nothing then might as well be dead."""
SINGLE_ECHO = "direct", "half rings"
"""Styles of rings whose drivers report one range a sensor."""


@dataclass(frozen=True, eq=False)
class Case:
    """What a health check gets, and what it must find."""

    cause: str
    ring: Ring
    log: Log
    sensors: tuple[int, ...] = ()
    """The faulty sensors; empty if all are concerned, or none."""
    sigma: float | None = None
    """Standard deviation of the ranges that the check is given."""
    detail: str = ""
    """The fault in numbers."""
    seed: int = 0


def case(cause: str, seed: int) -> Case:
    """The case of a cause, on a random scene."""
    fault, styles = FAULTS[cause]
    scene = random_scene(seed, styles=styles) if styles else random_scene(seed)
    made = fault(scene, np.random.default_rng([seed, 21]))
    return replace(made, cause=cause, seed=seed)


# Nothing is wrong


def _healthy(scene: Scene, rng: np.random.Generator) -> Case:
    return Case("", scene.ring, scene.log())


def _waiting_robot(scene: Scene, rng: np.random.Generator) -> Case:
    """The robot waits once or twice for 4 to 8 s; ranges in steps of 1 mm or 1 cm."""
    repeats = np.ones(len(scene.poses), int)
    repeats[rng.choice(len(repeats), rng.integers(1, 3), replace=False)] = rng.integers(40, 80)
    log = replace(scene, poses=np.repeat(scene.poses, repeats, axis=0)).log()
    resolution = float(rng.choice([0.001, 0.01]))
    quantized = np.maximum(np.round(log.range / resolution), 1) * resolution
    return Case("", scene.ring, replace(log, range=quantized), detail=f"steps of {1e3 * resolution:g} mm")


# Common causes


def _speed_of_sound(scene: Scene, rng: np.random.Generator) -> Case:
    """Air of -15 to 5 or 35 to 45 degrees Celsius."""
    celsius = rng.uniform(-15, 5) if rng.random() < 0.6 else rng.uniform(35, 45)
    speed = 331.3 * float(np.sqrt(1 + celsius / 273.15))
    return Case("", scene.ring, scene.log(replace(scene.ring, speed_of_sound=speed)), detail=f"{speed:.1f} m/s")


def _range_scale(scene: Scene, rng: np.random.Generator) -> Case:
    """Ranges 8 to 15 % too long or too short."""
    scale = 1 + rng.choice([-1, 1]) * rng.uniform(0.08, 0.15)
    log = scene.log(replace(scene.ring, speed_of_sound=REFERENCE_SPEED_OF_SOUND / scale))
    return Case("", scene.ring, log, detail=f"ranges x {scale:.3f}")


def _time_offset(scene: Scene, rng: np.random.Generator) -> Case:
    """Poses 2 to 6 scans late or early."""
    log, scans = scene.log(), int(rng.integers(2, 7))
    late = bool(rng.random() < 0.7)
    pose = log.pose[:-scans] if late else log.pose[scans:]
    part = log[scans:] if late else log[:-scans]
    sign = "late" if late else "early"
    return Case("", scene.ring, replace(part, pose=pose), detail=f"poses {0.1 * scans:.1f} s {sign}")


def _mirrored(scene: Scene, rng: np.random.Generator) -> Case:
    """The sensors are numbered the other way round."""
    ring = scene.ring
    true = with_geometry(ring, np.asarray(ring.position) * [1, -1], -np.asarray(ring.heading))
    return Case("", ring, scene.log(true))


def _rotated(scene: Scene, rng: np.random.Generator) -> Case:
    """The ring is mounted rotated, by a multiple of the spacing of its sensors."""
    ring, count = scene.ring, scene.ring.count
    angle = 2 * np.pi * int(rng.integers(1, count)) / count if scene.style != "half rings" else np.pi / 2
    angle *= rng.choice([-1, 1])
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    true = with_geometry(ring, np.asarray(ring.position) @ turn, np.asarray(ring.heading) + angle)
    return Case("", ring, scene.log(true), detail=f"{np.degrees(angle):.0f} deg")


def _headings(scene: Scene, rng: np.random.Generator) -> Case:
    """Headings in degrees, clockwise, or as a compass counts them."""
    log = scene.log()
    x, y, theta = log.pose.T
    kind = str(rng.choice(["degrees", "clockwise", "compass"]))
    wrong = {"degrees": np.degrees(theta), "clockwise": -theta, "compass": np.pi / 2 - theta}[kind]
    return Case("", scene.ring, replace(log, pose=np.stack([x, y, wrong], axis=-1)), detail=kind)


def _held(scene: Scene, rng: np.random.Generator) -> Case:
    """The driver repeats the last range of a sensor that hears nothing."""
    ranges = _ranges(scene.log(), scene.ring.count)
    last = np.full(scene.ring.count, np.nan)
    for row in ranges:
        row[np.isnan(row)] = last[np.isnan(row)]
        last = row.copy()
    return Case("", scene.ring, _log_of_ranges(ranges, scene.log()))


def _no_echo_value(scene: Scene, rng: np.random.Generator) -> Case:
    """Without an echo a sensor reports a fixed range, with or without noise."""
    log = scene.log()
    ranges = _ranges(log, scene.ring.count)
    value, noise = scene.ring.max_range * rng.uniform(0.8, 1.0), float(rng.choice([0.0, 0.02]))
    silent = np.isnan(ranges)
    ranges[silent] = value + noise * rng.standard_normal(silent.sum())
    return Case("", scene.ring, _log_of_ranges(ranges, log), detail=f"{value:.3f} m +- {1e3 * noise:g} mm")


def _noise(scene: Scene, rng: np.random.Generator) -> Case:
    """The stated standard deviation is a fifth to a tenth of the true one."""
    scene = replace(scene, sigma=max(scene.sigma, LEAST_NOISE))
    stated = scene.sigma / rng.uniform(5, 10)
    detail = f"{1e3 * scene.sigma:g} mm, stated {1e3 * stated:.2f} mm"
    return Case("", scene.ring, scene.log(), sigma=stated, detail=detail)


def _beam_width(scene: Scene, rng: np.random.Generator) -> Case:
    """The cones are narrower or wider than the ring states."""
    factor = float(rng.choice([0.5, 1.8]))
    stated = replace(scene.ring, beam=np.asarray(scene.ring.beam) * factor)
    return Case("", stated, scene.log(), detail=f"stated x {factor:g}")


def _floor_everywhere(scene: Scene, rng: np.random.Generator) -> Case:
    """All sensors hear the floor."""
    sensors = np.arange(scene.ring.count)
    return replace(_constant_echo(scene, rng, sensors, rng.uniform(0.6, 1.1), 0.01, 0.8), sensors=())


# Single sensors


def _own_echo(scene: Scene, rng: np.random.Generator) -> Case:
    """A sensor hears its own robot."""
    return _constant_echo(scene, rng, np.array([_sensor(scene, rng)]), rng.uniform(0.12, 0.5), 0.003, 1.0)


def _floor_echo(scene: Scene, rng: np.random.Generator) -> Case:
    """A sensor hears the floor."""
    return _constant_echo(scene, rng, np.array([_sensor(scene, rng)]), rng.uniform(0.6, 1.1), 0.01, 0.8)


def _dead(scene: Scene, rng: np.random.Generator) -> Case:
    return _losing(scene, rng, lambda log, k: (log.tx == k) | (log.rx == k))


def _deaf(scene: Scene, rng: np.random.Generator) -> Case:
    return _losing(scene, rng, lambda log, k: (log.rx == k) & (log.tx != k))


def _mute(scene: Scene, rng: np.random.Generator) -> Case:
    return _losing(scene, rng, lambda log, k: (log.tx == k) & (log.rx != k))


def _weak(scene: Scene, rng: np.random.Generator) -> Case:
    rate = rng.uniform(0.65, 0.8)
    return _losing(scene, rng, lambda log, k: ((log.tx == k) | (log.rx == k)) & (rng.random(len(log.tx)) < rate))


def _swapped(scene: Scene, rng: np.random.Generator) -> Case:
    """Two sensors, half of the time neighbors, are exchanged; each of them has the echoes of the other one."""
    a = _sensor(scene, rng)
    b = (a + 1) % scene.ring.count
    if rng.random() < 0.5 or _direct_echoes(scene.log(), scene.ring.count)[b] < LEAST_ECHOES:
        b = _sensor(scene, rng, other=a)
    place = np.arange(scene.ring.count)
    place[[a, b]] = b, a
    ring = scene.ring
    true = with_geometry(ring, np.asarray(ring.position)[place], np.asarray(ring.heading)[place])
    return Case("", ring, scene.log(true), sensors=(min(a, b), max(a, b)))


def _turned(scene: Scene, rng: np.random.Generator) -> Case:
    """A sensor points 20 to 40 degrees aside, and still hears something."""
    ring, tries = scene.ring, 10
    while True:
        k, turn = _sensor(scene, rng), rng.choice([-1, 1]) * np.radians(rng.uniform(20, 40))
        heading = np.array(ring.heading, dtype=np.float64)
        heading[k] += turn
        log, tries = scene.log(with_geometry(ring, np.asarray(ring.position), heading)), tries - 1
        if not tries or _direct_echoes(log, ring.count)[k] >= LEAST_ECHOES:
            return Case("", ring, log, sensors=(k,), detail=f"{np.degrees(turn):.0f} deg")


def _offset(scene: Scene, rng: np.random.Generator) -> Case:
    k, offset = _sensor(scene, rng), rng.choice([-1, 1]) * rng.uniform(0.025, 0.06)
    offsets = np.where(np.arange(scene.ring.count) == k, offset, 0.0)
    log = scene.log(replace(scene.ring, range_offset=offsets))
    return Case("", scene.ring, log, sensors=(k,), detail=f"{1e3 * offset:.0f} mm")


def _stale(scene: Scene, rng: np.random.Generator) -> Case:
    """The readings of one sensor are renewed in every third to sixth scan only."""
    log, k, period = scene.log(), _sensor(scene, rng), int(rng.integers(3, 7))
    by_scan = np.split(np.arange(len(log.tx)), log.start[1:-1])
    rows, scans = [], []
    for scan, own in enumerate(by_scan):
        kept, old = own[log.rx[own] != k], by_scan[scan - scan % period]
        chosen = np.concatenate([kept, old[log.rx[old] == k]])
        rows.append(chosen)
        scans.append(np.full(len(chosen), scan))
    row, scan = np.concatenate(rows), np.concatenate(scans)
    return Case("", scene.ring, _rebuilt(log, scan, row), sensors=(k,), detail=f"every {period} scans")


FAULTS: dict[str, tuple[Callable[[Scene, np.random.Generator], Case], tuple[str, ...]]] = {
    "healthy": (_healthy, ()),
    "waiting robot": (_waiting_robot, ()),
    "speed of sound": (_speed_of_sound, ()),
    "range scale": (_range_scale, ()),
    "time offset": (_time_offset, ()),
    "mirrored ring": (_mirrored, ()),
    "rotated ring": (_rotated, ()),
    "headings": (_headings, ()),
    "held readings": (_held, SINGLE_ECHO),
    "no-echo value": (_no_echo_value, SINGLE_ECHO),
    "noise": (_noise, ()),
    "beam width": (_beam_width, ()),
    "floor everywhere": (_floor_everywhere, ()),
    "own echo": (_own_echo, ()),
    "floor echo": (_floor_echo, ()),
    "dead": (_dead, ()),
    "deaf": (_deaf, ("cross",)),
    "mute": (_mute, ("cross",)),
    "weak": (_weak, ()),
    "swapped": (_swapped, ()),
    "turned": (_turned, ()),
    "offset": (_offset, ()),
    "stale": (_stale, ()),
}
"""The fault of each cause, and the styles of rings on which it occurs; empty for all."""

ACCEPTED = {
    "speed of sound": ("speed of sound", "range scale"),
    "range scale": ("range scale", "speed of sound"),
    "floor everywhere": ("floor echo", "own echo"),
    "own echo": ("own echo", "floor echo"),
    "floor echo": ("floor echo", "own echo"),
    "held readings": ("held readings",),
    "stale": ("stale", "held readings"),
}
"""Causes that count as correct, where that is not the cause alone: those that one log cannot tell apart."""


# Changes of logs


def _sensor(scene: Scene, rng: np.random.Generator, *, other: int = -1) -> int:
    """A random sensor, other than this one, with enough direct echoes; the one with most of them if none has."""
    echoes = _direct_echoes(scene.log(), scene.ring.count) * (np.arange(scene.ring.count) != other)
    enough = np.flatnonzero(echoes >= LEAST_ECHOES)
    return int(rng.choice(enough)) if len(enough) else int(np.argmax(echoes))


def _direct_echoes(log: Log, count: int) -> Int[np.ndarray, " sensors"]:
    return np.bincount(log.tx[log.tx == log.rx], minlength=count)


def _constant_echo(
    scene: Scene, rng: np.random.Generator, sensors: np.ndarray, distance: float, sigma: float, rate: float
) -> Case:
    """Sensors hear something that moves with the robot; a sensor with one range reports the nearer echo."""
    log = scene.log()
    scan, sensor = (one.ravel() for one in np.meshgrid(np.arange(len(log)), sensors, indexing="ij"))
    heard = rng.random(len(scan)) < rate
    scan, sensor = scan[heard], sensor[heard]
    extra = distance + sigma * rng.standard_normal(len(scan))
    columns = [np.append(log.echo_scan, scan), np.append(log.tx, sensor), np.append(log.rx, sensor)]
    columns.append(np.append(log.range, extra))
    order = np.lexsort((columns[3], columns[2], columns[1], columns[0]))
    index, tx, rx, reported = (column[order] for column in columns)
    first = np.append(True, (np.diff(index) != 0) | (np.diff(tx) != 0) | (np.diff(rx) != 0))
    kept = first if scene.style != "cross" else np.ones(len(first), bool)
    changed = _log(log, index[kept], tx[kept], rx[kept], reported[kept])
    who = tuple(int(k) for k in sensors)
    return Case("", scene.ring, changed, sensors=who, detail=f"{distance:.2f} m +- {1e3 * sigma:g} mm")


def _losing(scene: Scene, rng: np.random.Generator, lost: Callable[[Log, int], Bool[np.ndarray, " readings"]]) -> Case:
    """One sensor loses echoes."""
    log, k = scene.log(), _sensor(scene, rng)
    kept = np.flatnonzero(~lost(log, k))
    return Case("", scene.ring, _rebuilt(log, log.echo_scan[kept], kept), sensors=(k,))


def _ranges(log: Log, count: int) -> Float[np.ndarray, "scans sensors"]:
    """Direct ranges, one a sensor; NaN without an echo."""
    ranges = np.full((len(log), count), np.nan)
    ranges[log.echo_scan, log.tx] = log.range
    return ranges


def _log_of_ranges(ranges: Float[np.ndarray, "scans sensors"], log: Log) -> Log:
    """Direct ranges as a log with the poses of another one."""
    scan, sensor = np.nonzero(np.isfinite(ranges))
    return _log(log, scan, sensor, sensor, ranges[scan, sensor])


def _rebuilt(log: Log, scan: Int[np.ndarray, " readings"], row: Int[np.ndarray, " readings"]) -> Log:
    """The log with these readings in these scans."""
    return _log(log, scan, log.tx[row], log.rx[row], log.range[row])


def _log(log: Log, scan: np.ndarray, tx: np.ndarray, rx: np.ndarray, reported: np.ndarray) -> Log:
    """Other readings with the poses, stamps and measured paths of a log."""
    return Log.from_echoes(scan, tx, rx, reported, stamp=log.stamp, pose=log.pose, asked=log.asked)
