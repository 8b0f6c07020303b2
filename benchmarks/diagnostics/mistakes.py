"""Wrong and sound inputs for the benchmark of the warnings about inputs."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.diagnostics import faults
from benchmarks.diagnostics.scenes import SCAN_PERIOD, SIGMAS, Scene, random_ring, random_scene, trajectory
from jaxsonar import Log, Ring, Room, random_pose, random_room
from jaxsonar.geometry.se2 import compose, relative
from jaxsonar.sensors.ring import REFERENCE_SPEED_OF_SOUND


@dataclass(frozen=True, eq=False)
class Input:
    """What a person gives."""

    name: str
    ring: Ring
    log: Log | None = None
    room: Room | None = None
    poses: np.ndarray | None = None
    """Trajectory of a simulation."""
    noise: float | None = None
    """Standard deviation of ranges, as given to a simulation, metres."""
    seed: int = 0


# Wrong logs: a function from a scene to a log, or to a ring and a log


def _ranges_times(factor: float) -> Callable[[Scene], Log]:
    return lambda scene: _scaled_ranges(scene.log(), factor)


def _scaled_ranges(log: Log, factor: float) -> Log:
    return replace(log, range=log.range * factor)


def _poses(change: Callable[[np.ndarray], Sequence[np.ndarray]]) -> Callable[[Scene], Log]:
    def wrong(scene: Scene) -> Log:
        log = scene.log()
        return replace(log, pose=np.stack(list(change(log.pose.T)), axis=-1))

    return wrong


def _stamps(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Scene], Log]:
    def wrong(scene: Scene) -> Log:
        log = scene.log()
        return replace(log, stamp=change(1000.0 + log.stamp))

    return wrong


def _backwards(stamp: np.ndarray) -> np.ndarray:
    return np.where(np.arange(len(stamp)) >= len(stamp) // 2, stamp - 500 * SCAN_PERIOD, stamp)


def _jump(scene: Scene) -> Log:
    """The odometry jumps by a metre in one scan."""
    log, k = scene.log(), len(scene.poses) // 2
    pose = log.pose.copy()
    pose[k:, :2] += [0.8, -0.6]
    return replace(log, pose=pose)


def _restart(scene: Scene) -> Log:
    """The odometry starts again at zero."""
    log, k = scene.log(), len(scene.poses) // 2
    rest = relative(np.broadcast_to(log.pose[k], log.pose[k:].shape), log.pose[k:])
    return replace(log, pose=np.concatenate([log.pose[:k], rest]))


def _one_based(scene: Scene) -> Log:
    log = scene.log()
    return replace(log, tx=log.tx + 1, rx=log.rx + 1, asked=log.asked + 1)


def _one_based_last_silent(scene: Scene) -> Log:
    """Sensors numbered from 1, the last one without an echo."""
    log = scene.log()
    kept = np.flatnonzero((log.tx < scene.ring.count - 1) & (log.rx < scene.ring.count - 1))
    pairs = log.asked[(log.asked < scene.ring.count - 1).all(axis=1)] + 1
    rows = {"stamp": log.stamp, "pose": log.pose, "asked": pairs}
    return Log.from_echoes(log.echo_scan[kept], log.tx[kept] + 1, log.rx[kept] + 1, log.range[kept], **rows)


def _of_fault(cause: str) -> Callable[[Scene], Log]:
    fault = faults.FAULTS[cause][0]
    return lambda scene: fault(scene, np.random.default_rng([scene.seed, 22])).log


def _any_ranges(scene: Scene) -> Log:
    """Echoes that have nothing to do with the poses."""
    log = scene.log()
    return replace(log, range=np.random.default_rng(scene.seed).permutation(log.range))


def _direct_only(scene: Scene) -> Log:
    """Only direct echoes, in a file that does not mark silence."""
    log = scene.log()
    kept = np.flatnonzero(log.tx == log.rx)
    rows = {"stamp": log.stamp, "pose": log.pose}
    return Log.from_echoes(log.echo_scan[kept], log.tx[kept], log.rx[kept], log.range[kept], **rows)


_FLIGHT = 2e6 / REFERENCE_SPEED_OF_SOUND
_WRONG_LOGS: dict[str, tuple[Callable[[Scene], Log], str, tuple[str, ...]]] = {
    "ranges in mm": (_ranges_times(1000), r"\bmm\b|millimetre", ()),
    "ranges in cm": (_ranges_times(100), r"\bcm\b|centimetre", ()),
    "ranges in us": (_ranges_times(_FLIGHT), r"\bus\b|µs|microsecond|time of flight", ()),
    "ranges out and back": (_ranges_times(2), r"round trip|out and back|there and back", ()),
    "poses in mm": (_poses(lambda p: (1e3 * p[0], 1e3 * p[1], p[2])), r"\bmm\b|millimetre", ()),
    "poses in cm": (_poses(lambda p: (1e2 * p[0], 1e2 * p[1], p[2])), r"\bcm\b|centimetre", ()),
    "ranges and poses in mm": (
        lambda scene: _scaled_ranges(_poses(lambda p: (1e3 * p[0], 1e3 * p[1], p[2]))(scene), 1000),
        r"range.*(mm\b|millimetre)",
        (),
    ),
    "headings in degrees": (_poses(lambda p: (p[0], p[1], np.degrees(p[2]))), r"degree", ()),
    "headings clockwise": (_poses(lambda p: (p[0], p[1], -p[2])), r"clockwise|y is negated|negated y", ()),
    "headings of a compass": (_poses(lambda p: (p[0], p[1], np.pi / 2 - p[2])), r"clockwise|compass|north", ()),
    "x and y swapped": (_poses(lambda p: (p[1], p[0], p[2])), r"swap|exchang|north|compass", ()),
    "y negated": (_poses(lambda p: (p[0], -p[1], p[2])), r"negat|sign|clockwise|left|right", ()),
    "x negated": (_poses(lambda p: (-p[0], p[1], p[2])), r"negat|sign|clockwise|left|right", ()),
    "sensors clockwise": (_of_fault("mirrored ring"), r"clockwise|mirror", ()),
    "ring rotated": (_of_fault("rotated ring"), r"rotat|turned|first sensor|shift", ()),
    "sensors from 1": (_one_based, r"from 1|one-based|from one", ()),
    "sensors from 1, last silent": (_one_based_last_silent, r"from 1|one-based|from one|rotat|shift", ()),
    "stamps backwards": (_stamps(_backwards), r"stamps fall|backward", ()),
    "stamps in ms": (_stamps(lambda t: 1e3 * t), r"\bms\b|millisecond", ()),
    "stamps in us": (_stamps(lambda t: 1e6 * t), r"\bus\b|µs|microsecond", ()),
    "stamps in ns": (_stamps(lambda t: 1e9 * t), r"\bns\b|nanosecond", ()),
    "odometry jumps": (_jump, r"jump", ()),
    "odometry restarts": (_restart, r"restart|begins again|starts again|reset|jump", ()),
    "no-echo value": (_of_fault("no-echo value"), r"no echo", faults.SINGLE_ECHO),
    "held readings": (_of_fault("held readings"), r"repeats the last range|held", faults.SINGLE_ECHO),
    "own echo": (_of_fault("own echo"), r"robot", ()),
    "floor everywhere": (_of_fault("floor everywhere"), r"robot|floor", ()),
    "unrelated echoes": (_any_ranges, r"explain|agree", ()),
    "direct echoes only": (_direct_only, r"never|heard|measured", ("cross",)),
}
"""Wrong logs, the words of their warnings, and the styles of rings on which they occur."""

_WRONG_RINGS: dict[str, tuple[Callable[[Ring], dict[str, object]], str]] = {
    "beam in radians": (lambda ring: {"beam": np.radians(np.asarray(ring.beam))}, r"radian"),
    "half the beam": (lambda ring: {"beam": np.asarray(ring.beam) / 2}, r"half"),
    "speed in cm/s": (lambda ring: {"speed_of_sound": 34320.0}, r"cm/s|centimetres per second"),
    "speed in km/h": (lambda ring: {"speed_of_sound": 1235.5}, r"km/h|kilometres per hour"),
    "speed in ft/s": (lambda ring: {"speed_of_sound": 1126.0}, r"ft/s|feet"),
    "radius in mm": (lambda ring: {"position": 1000 * np.asarray(ring.position)}, r"\bmm\b|millimetre"),
    "radius in cm": (lambda ring: {"position": 100 * np.asarray(ring.position)}, r"\bcm\b|centimetre"),
    "max_range in mm": (lambda ring: {"max_range": 1000 * ring.max_range}, r"\bmm\b|millimetre"),
    "max_range in cm": (lambda ring: {"max_range": 100 * ring.max_range}, r"\bcm\b|centimetre"),
}

_WRONG_REST = {
    "room in mm": r"\bmm\b|millimetre",
    "room in cm": r"\bcm\b|centimetre",
    "room in degrees": r"degree|longitude",
    "trajectory in mm": r"\bmm\b|millimetre",
    "trajectory in degrees": r"degree",
    "trajectory outside": r"outside",
    "noise in mm": r"\bmm\b|millimetre",
}

WORDS = {name: row[1] for name, row in (_WRONG_LOGS | _WRONG_RINGS).items()} | _WRONG_REST
"""All mistakes: a regular expression of the words that the warning, or the error, must contain."""


def wrong_input(name: str, seed: int) -> Input:
    """A wrong input on a random scene.

    Raises:
        SonarError: the value is refused; the message counts as the warning.
    """
    if name in _WRONG_LOGS:
        change, _, styles = _WRONG_LOGS[name]
        scene = random_scene(seed, scans=150, styles=styles) if styles else random_scene(seed, scans=150)
        return Input(name, scene.ring, change(scene), seed=seed)
    scene = random_scene(seed)
    if name in _WRONG_RINGS:
        changed = _WRONG_RINGS[name][0](scene.ring)
        return Input(name, replace(scene.ring, **changed), scene.log(), seed=seed)
    room, poses = scene.room, scene.poses
    made = {
        "room in mm": lambda: Input(name, scene.ring, room=_scaled_room(room, 1000)),
        "room in cm": lambda: Input(name, scene.ring, room=_scaled_room(room, 100)),
        "room in degrees": lambda: Input(name, scene.ring, room=Room(room.walls * 9e-6 + [8.56, 52.03])),
        "trajectory in mm": lambda: Input(name, scene.ring, room=room, poses=poses * [1e3, 1e3, 1]),
        "trajectory in degrees": lambda: Input(name, scene.ring, room=room, poses=poses * [1, 1, 180 / np.pi]),
        "trajectory outside": lambda: Input(name, scene.ring, room=room, poses=poses + np.array([20.0, 5.0, 0.0])),
        "noise in mm": lambda: Input(name, scene.ring, noise=1e3 * scene.sigma),
    }
    return replace(made[name](), seed=seed)


def _scaled_room(room: Room, factor: float) -> Room:
    return Room(room.walls * factor, room.wall_names, room.poles * factor)


# Sound inputs


def sound_inputs(seed: int = 0) -> Iterator[Input]:
    """About fifty sound inputs that look unusual."""
    for k in range(15):
        scene = random_scene(seed + k, scans=150)
        yield _sound(f"scene, {scene.style}", scene)
    for k, count in enumerate((4, 6, 8, 12, 32, 48)):
        scene = random_scene(seed + 100 + k, scans=150)
        ring = Ring.circular(count=count, radius=0.2, beam=np.radians(40), neighbors=k % 2, max_range=3.0)
        yield _sound(f"{count} sensors", replace(scene, ring=ring, style="direct"))
    for k, celsius in enumerate((-20, -10, 0, 10, 30, 45)):
        scene = random_scene(seed + 200 + k, scans=150)
        speed = 331.3 * float(np.sqrt(1 + celsius / 273.15))
        yield _sound(f"{celsius} deg Celsius", replace(scene, ring=replace(scene.ring, speed_of_sound=speed)))
    for k in range(4):
        scene = replace(random_scene(seed + 300 + k, scans=150), clutter=0.2, dropout=0.2, sigma=SIGMAS[-1])
        yield _sound(f"20 % clutter, {scene.style}", scene)
    for k in range(3):
        scene = random_scene(seed + 400 + k, scans=150)
        yield Input(f"no poses, {scene.style}", scene.ring, _without_poses(scene.log()))
        implicit = _without_asked(scene.log())
        yield Input(f"silence not marked, {scene.style}", scene.ring, implicit)
        scene = replace(scene, poses=np.repeat(scene.poses[:1], 80, axis=0))
        yield _sound(f"robot at rest, {scene.style}", scene)
        turning = scene.poses + np.arange(len(scene.poses))[:, None] * [0, 0, 0.08]
        yield _sound(f"robot turns on the spot, {scene.style}", replace(scene, poses=turning))
        yield _sound(f"few scans, {scene.style}", replace(scene, poses=scene.poses[:5]))
        waiting = faults.case("waiting robot", seed + 500 + k)
        yield Input("waiting robot, coarse ranges", waiting.ring, waiting.log)
    for k in range(3):
        yield _sound("along a corridor", _corridor(seed + k))
        yield _sound("beside one wall", _one_wall(seed + k))
        yield _sound("large hall", _hall(seed + k))
    scene = random_scene(seed + 600, scans=150)
    yield Input("room and trajectory", scene.ring, room=scene.room, poses=scene.poses)
    yield Input("noise of 10 mm", scene.ring, noise=0.01)
    drifting = scene.log()
    moved = compose(np.array([1e3, -2e3, 2.0]), drifting.pose)
    yield Input("odometry in another frame", scene.ring, replace(drifting, pose=moved))
    late = replace(drifting, stamp=1.7e9 + drifting.stamp)
    yield Input("stamps since 1970", scene.ring, late)
    yield Input("lost scans", scene.ring, _with_a_gap(drifting))


def _sound(name: str, scene: Scene) -> Input:
    return Input(name, scene.ring, scene.log(), seed=scene.seed)


def _without_poses(log: Log) -> Log:
    return replace(log, pose=np.full_like(log.pose, np.nan))


def _without_asked(log: Log) -> Log:
    return Log.from_echoes(log.echo_scan, log.tx, log.rx, log.range, stamp=log.stamp, pose=log.pose)


def _with_a_gap(log: Log) -> Log:
    """Twenty scans are missing while the robot went on."""
    kept = np.flatnonzero((log.echo_scan < 60) | (log.echo_scan >= 80))
    scan = np.where(log.echo_scan[kept] >= 80, log.echo_scan[kept] - 20, log.echo_scan[kept])
    rows = {"stamp": np.delete(log.stamp, np.s_[60:80]), "pose": np.delete(log.pose, np.s_[60:80], axis=0)}
    return Log.from_echoes(scan, log.tx[kept], log.rx[kept], log.range[kept], asked=log.asked, **rows)


def _corridor(seed: int) -> Scene:
    """A straight corridor, along its walls without a turn."""
    scene, rng = random_scene(seed), np.random.default_rng([seed, 23])
    half, angle = rng.uniform(0.8, 1.1), rng.uniform(-np.pi, np.pi)
    ends = np.array([[[-12, -half], [12, -half]], [[-12, half], [12, half]]], dtype=np.float64)
    along = np.linspace(-4, 4, 160)
    poses = np.stack([along, 0 * along + rng.uniform(-0.1, 0.1), 0 * along], axis=-1)
    return _turned(scene, ends, poses, angle)


def _one_wall(seed: int) -> Scene:
    """A single wall in an open space."""
    scene, rng = random_scene(seed), np.random.default_rng([seed, 24])
    time = np.linspace(0, 4 * np.pi, 160)
    poses = np.stack([0.3 * time - 2, 0.3 * np.sin(time), 0.3 * np.cos(time)], axis=-1)
    return _turned(scene, np.array([[[-6.0, 1.2], [6.0, 1.2]]]), poses, rng.uniform(-np.pi, np.pi))


def _turned(scene: Scene, walls: np.ndarray, poses: np.ndarray, angle: float) -> Scene:
    cos, sin = np.cos(angle), np.sin(angle)
    world_from_room = np.array([0.0, 0.0, angle])
    return replace(scene, room=Room(walls @ np.array([[cos, sin], [-sin, cos]])), poses=compose(world_from_room, poses))


def _hall(seed: int) -> Scene:
    """A hall larger than the reach of the sensors."""
    rng = np.random.default_rng([seed, 25])
    scene, room = random_scene(seed), random_room(rng)
    room = _scaled_room(room, 3)
    ring = replace(random_ring(rng, "direct"), max_range=5.0)
    start = random_pose(rng, room, clearance=0.6)
    assert np.isfinite(start).all()
    return replace(scene, style="direct", ring=ring, room=room, poses=trajectory(rng, room, 150))
