"""Simulator: the echoes of a ring in a room, each with the reflector that caused it, and measurement errors.

The geometry is exact (``echo_tracing``). Amplitudes determine which echoes a threshold detector reports.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.floor_plans.room import Room
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.simulation.acoustics import Acoustics, ranks
from jaxsonar.simulation.echo_detection import BEAMS, detect_echoes
from jaxsonar.simulation.traced_echoes import EchoColumns, EchoKind
from jaxsonar.simulation.transducer_array import TransducerArray
from jaxsonar.simulation.walker import Walker, circles_of_walkers

SCAN_PERIOD = 0.1
"""Time between scans without stamps, seconds: about the period of the paper's ring (8 firing groups of 11.7 ms)."""
MIN_CLUTTER_RANGE = 0.1
"""Smallest range of false echoes, metres; chosen by hand."""


@dataclass(frozen=True, eq=False)
class Simulation:
    """Echoes of all scans, sorted by scan, path and range."""

    scan: Int[np.ndarray, " echoes"]
    """Row of the poses, from 0. A scan without echoes has no entry."""
    path: Int[np.ndarray, " echoes"]
    """Row of ``Ring.paths``."""
    range: Float[np.ndarray, " echoes"]
    """As in a log, metres: half the time of flight times 343.2 m/s, with range offsets and errors."""
    amplitude: Float[np.ndarray, " echoes"]
    """Relative to a wall on the axis at 1 m (``Acoustics``)."""
    kind: Int[np.ndarray, " echoes"]
    """Ground truth: type of the reflector or of the false echo, a value of ``EchoKind``."""
    reflector: Int[np.ndarray, " echoes"]
    """Ground truth: wall (the first of two for second order), vertex of ``Room.junctions`` (corner, edge), pole or
    circle (those of the room, then the walkers); -1 for clutter."""
    reflector_kind: Int[np.ndarray, " echoes"]
    """Ground truth: type of the reflector; as ``kind``, except that crosstalk has the type of its reflector."""
    transmitter: Int[np.ndarray, " echoes"]
    """Ground truth: sensor whose sound it was. It is the transmitter of the path, also for clutter, but for crosstalk
    another sensor of the same firing group."""
    stamps: Float[np.ndarray, " scans"]
    """Seconds, one for every pose."""

    def as_log(self, ring: Ring, poses: Float[np.ndarray, "scans 3"]) -> Log:
        """A scan log of these echoes, with the given poses (x, y, theta; metres, radians) as odometry.

        Every scan measured all paths of the ring.
        """
        tx, rx = ring.paths[self.path].T
        echoes = {"amplitude": self.amplitude, "stamp": self.stamps, "pose": poses}
        return Log.from_echoes(self.scan, tx, rx, self.range, **echoes, asked=ring.paths)

    def dense(self, paths: int, echoes: int) -> Float[np.ndarray, "scans paths echoes"]:
        """Ranges as an argument of ``extract_lines``: (scans, paths, echoes), nearest first, NaN = no echo.

        Args:
            paths: number of echo paths of the ring.
            echoes: number of entries of each path; further echoes are omitted.
        """
        ranges = np.full((len(self.stamps), paths, echoes), np.nan)
        rank = ranks(self.scan * paths + self.path)
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
    beams: str = "soft",
    crosstalk: bool | None = None,
    walkers: Sequence[Walker] = (),
    stamps: Float[np.ndarray, " scans"] | None = None,
    progress: Callable[[int, int], None] | None = None,
    chunk: int = 128,
) -> Simulation:
    """Simulate the echoes of every path of a ring at every pose, with measurement errors.

    The same arguments give the same echoes. Noise, drift, dropout and clutter use separate random streams, so that a
    change of one leaves the others unchanged.

    Args:
        ring: sensors, paths, range offsets, speed of sound, maximum range.
        room: the reflectors.
        poses: (scans, 3) world_from_robot (x, y, theta), metres and radians.
        sigma: standard deviation of the white noise of each range, metres.
        drift: standard deviation of a slow error of each sensor (an Ornstein-Uhlenbeck process), metres; that of a path
            is the mean of its two sensors.
        drift_time: correlation time of the drift (to 1/e), seconds.
        dropout: probability that an echo is lost, 0 to 1.
        clutter: expected number of false echoes per true echo of the scan before dropout; crosstalk does not count.
            Their number is Poisson distributed; they occur on paths with overlapping cones, with uniform ranges from
            0.1 m and amplitudes up to ten thresholds.
        seed: seed of all random streams.
        max_echoes: a path reports at most this many echoes, the nearest ones, clutter included.
        blanking: an echo that is less than this behind the previous reported one is not detected (half path length,
            metres).
        acoustics: amplitudes and detection threshold; ``Acoustics()`` if omitted.
        beams: "soft": a path detects every echo whose amplitude reaches the threshold, also outside of the nominal
            cones, up to 90 deg off the axes. "hard": only echoes within both cones.
        crosstalk: whether a receiver also detects echoes of the other transmitters of the firing group
            (``Ring.firing_groups``). They are reported on its path of this group, with half the true path length from
            their transmitter; their kind is ``EchoKind.CROSSTALK``. Default: with soft beams.
        walkers: walking persons. Each is a circle at its position at the stamp of the scan; their indices as reflectors
            follow those of the circles of the room. Sensors inside of a person detect nothing.
        stamps: (scans,) seconds, not decreasing; 0.1 s apart if omitted. Only drift and walkers depend on them.
        progress: called with (scans done, all scans) from time to time.
        chunk: number of scans that are traced at once; does not change the result.

    Raises:
        SonarError: a value out of range; the message names it and the allowed range.
    """
    acoustics = Acoustics() if acoustics is None else acoustics
    times = np.arange(len(poses)) * SCAN_PERIOD if stamps is None else np.array(stamps, dtype=np.float64)
    if beams not in BEAMS:
        raise SonarError(f"simulate: beams {beams!r}; allowed is {' or '.join(BEAMS)}")
    _check(poses, times, sigma, drift, drift_time, dropout, clutter, seed, max_echoes, blanking, chunk)
    # Trace the echoes and detect those above the threshold.
    array = TransducerArray.of(ring, crosstalk=beams == "soft" if crosstalk is None else crosstalk)
    parts = [EchoColumns.empty()]
    for begin in range(0, len(poses), chunk):
        detected = detect_echoes(
            array,
            room,
            poses[begin : begin + chunk],
            circles_of_walkers(walkers, times[begin : begin + chunk]),
            acoustics=acoustics,
            beams=beams,
            max_echoes=max_echoes,
            blanking=blanking,
        )
        parts.append(detected._replace(scan=detected.scan + begin))
        if progress is not None:
            progress(min(begin + chunk, len(poses)), len(poses))
    echoes = EchoColumns.concatenate(parts).sorted()
    # Draw all errors at once in the order of the sorted echoes, so that chunks do not influence them.
    noise_rng, drift_rng, dropout_rng, clutter_rng = np.random.default_rng(seed).spawn(4)
    false = _clutter(array, echoes, len(poses), clutter, acoustics.threshold, clutter_rng)
    sensor_drift = _drift(times, len(array.heading), drift, drift_time, drift_rng)
    rx = array.paths[echoes.path, 1]
    error = (sensor_drift[echoes.scan, echoes.transmitter] + sensor_drift[echoes.scan, rx]) / 2
    error += sigma * noise_rng.standard_normal(len(error))
    received = dropout_rng.random(len(error)) >= dropout
    # Convert to reported ranges, lose echoes, add clutter.
    echoes = EchoColumns(*(column[received] for column in array.reported(echoes, error)))
    echoes = EchoColumns.concatenate([echoes, array.reported(false, 0.0)]).sorted()
    # A path reports at most max_echoes echoes, and none with a negative time of flight.
    kept = (ranks(echoes.scan * len(array.paths) + echoes.path) < max_echoes) & (echoes.range > 0)
    columns = {name: column[kept] for name, column in echoes._asdict().items() if name != "second"}
    return Simulation(**columns, stamps=times)


def _clutter(
    array: TransducerArray, echoes: EchoColumns, scans: int, clutter: float, threshold: float, rng: np.random.Generator
) -> EchoColumns:
    """False echoes of all scans."""
    if not len(array.overlapping):
        return EchoColumns.empty()
    own = echoes.kind != EchoKind.CROSSTALK
    count = rng.poisson(clutter * np.bincount(echoes.scan[own], minlength=scans))
    total = int(count.sum())
    nearest = min(MIN_CLUTTER_RANGE, array.max_range)
    path = rng.choice(array.overlapping, total)
    return EchoColumns(
        scan=np.repeat(np.arange(scans), count),
        path=path,
        range=rng.uniform(nearest, array.max_range, total),
        amplitude=threshold * 10 ** rng.random(total),
        kind=np.full(total, int(EchoKind.CLUTTER)),
        reflector=np.full(total, -1),
        reflector_kind=np.full(total, int(EchoKind.CLUTTER)),
        transmitter=array.paths[path, 0],
        second=np.full(total, -1),
    )


def _drift(
    stamps: Float[np.ndarray, " scans"], sensors: int, drift: float, drift_time: float, rng: np.random.Generator
) -> Float[np.ndarray, "scans sensors"]:
    """A stationary Ornstein-Uhlenbeck process per sensor, exact for any spacing of the stamps."""
    elapsed = np.diff(stamps, prepend=-np.inf)[:, None] / drift_time
    keep = np.exp(-elapsed)
    value = drift * np.sqrt(-np.expm1(-2 * elapsed)) * rng.standard_normal((len(stamps), sensors))
    # The recursion value[k] = keep[k] value[k - 1] + shock[k], for all k at once: its span doubles with every step.
    step = 1
    while step < len(stamps):
        value[step:] += keep[step:] * value[:-step]
        keep[step:] *= keep[:-step]
        step *= 2
    return value


def _check(poses, stamps, sigma, drift, drift_time, dropout, clutter, seed, max_echoes, blanking, chunk) -> None:
    """Raise a SonarError for an argument of ``simulate`` that is out of range."""
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
