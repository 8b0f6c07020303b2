"""How near to what is possible a ring is calibrated, how honest its standard deviations are, and how long it takes.

Run ``python -m benchmarks.calibration.accuracy [--quick] [-o DIR]``. The paper's ring, sigma 1 mm, 25 scans along a smooth path
through another random room with every seed, and the 17 scans of the office. Errors are held against the Cramer-Rao
bound (CRB) of all first-order echoes that arrived, with the association that the simulator knows; its Jacobians are
finite differences of range formulas of its own. Echoes of second order are no part of it, nor is that corners lie where
walls meet, so that it is a little too large where the library uses them. Offsets are meant relative to their mean.
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from benchmarks.detection.accuracy import versions, without_nan
from jaxsonar import Log, Ring, Room, SonarError, calibrate, random_pose, random_room, simulate
from jaxsonar.fileio.atomic_files import atomic_write, make_folder
from jaxsonar.geometry.se2 import compose, relative, wrap_angle
from jaxsonar.geometry.segments import point_to_segments
from jaxsonar.simulation.office import load_office
from jaxsonar.simulation.simulator import Simulation
from jaxsonar.simulation.traced_echoes import EchoKind

SIGMA = 0.001
"""Metres; noise of the ranges."""
SCANS = 25
"""Of a path; steps and clearance as below."""
STEP = 0.2, 0.4
"""Metres."""
CLEARANCE = 0.45
"""Metres from the robot's centre to anything."""
SPEED_SD, OFFSET_SD, LOOSE = 0.015, 0.03, 1.0
"""What the library expects, too: of the speed of sound (relative), offsets (m), reflectors and poses (m, rad)."""
SLIP, TURN = (0.0005, 0.001), 0.5
"""Odometry (m, rad) where the robot stands, and radians in which it slips as over a metre, as the library expects."""
NUDGE = 1e-6
"""Metres, radians or relative; of the central differences."""
CONVERGED = 3.0
"""Root mean square of the errors over that of the bound, and whitened, up to which a start led to the right ring."""
FIRST_ORDER = (EchoKind.PLANE, EchoKind.CORNER, EchoKind.EDGE, EchoKind.POLE)
TIMED = 25, 100, 1000


@dataclass(frozen=True)
class Condition:
    """What is wrong with the ring, with its echoes, and what is known of the poses."""

    name: str
    offset: float = 0.005
    """Standard deviation of the range offsets, metres."""
    extra: float = 0.0
    """Metres by which two sensors are off besides, one either way."""
    speed: float = 0.01
    """By which the speed of sound is off, either way, relative."""
    poses: str = "trust"
    odometry: float | None = None
    """Share that odometry is wrong by; None: no odometry."""
    false: float = 0.0
    """False echoes for each true one."""
    lost: float = 0.0
    """Share of the echoes that are lost."""


CONDITIONS = (
    Condition("poses known"),
    Condition("poses estimated, no odometry", poses="estimate"),
    Condition("poses estimated, 2 % odometry", poses="estimate", odometry=0.02),
    Condition("hard start: 2 %, 20 mm, poses known", offset=0.003, extra=0.02, speed=0.02),
    Condition("20 % false, 10 % lost, poses known", false=0.2, lost=0.1),
)


class Trial(NamedTuple):
    """One ring in one room."""

    nominal: Ring
    true: Ring
    room: Room
    poses: Float[np.ndarray, "scans 3"]
    heard: Simulation
    log: Log


def trial(condition: Condition, seed: int, place: str) -> Trial:
    """A ring as the condition says, and what it hears in the office or in a random room of its own.

    Rooms, paths and signs are the same under all conditions.
    """
    for_room, for_ring, for_odometry = np.random.default_rng(seed).spawn(3)
    office = load_office()
    room, poses = office.room, office.poses
    if place != "office":
        room = random_room(for_room)
        poses = path_in(room, for_room, SCANS)
    count = office.ring.count
    offset = condition.offset * for_ring.standard_normal(count)
    offset[for_ring.choice(count, 2, replace=False)] += condition.extra * np.array([1.0, -1.0])
    speed = float(office.ring.speed_of_sound) * (1 + condition.speed * for_ring.choice([-1.0, 1.0]))
    true = replace(office.ring, range_offset=offset, speed_of_sound=speed)
    heard = simulate(true, room, poses, sigma=SIGMA, clutter=condition.false, dropout=condition.lost, seed=seed)
    given = poses
    if condition.poses == "estimate":
        odometry = condition.odometry
        given = np.full_like(poses, np.nan) if odometry is None else slipped(poses, odometry, for_odometry)
    return Trial(office.ring, true, room, poses, heard, heard.as_log(true, given))


def path_in(room: Room, rng: np.random.Generator, count: int) -> Float[np.ndarray, "scans 3"]:
    """A smooth way through the free space of a room, metres and radians; it turns more sharply where it has to."""
    poses = [random_pose(rng, room, clearance=CLEARANCE)]
    while len(poses) < count:
        sharp = np.repeat([0.3, 1.0, 3.0], 64)
        heading = poses[-1][2] + sharp * rng.standard_normal(len(sharp))
        ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        to = poses[-1][:2] + rng.uniform(*STEP, len(sharp))[:, None] * ahead
        # No step is long enough to pass through a wall that both of its ends are clear of.
        clear = (point_to_segments(to, room.walls) >= CLEARANCE).all(axis=1)
        clear &= (np.linalg.norm(to[:, None] - room.poles, axis=-1) >= CLEARANCE).all(axis=1)
        if not clear.any():
            poses = [random_pose(rng, room, clearance=CLEARANCE)]  # a nook: begin elsewhere
            continue
        first = int(np.argmax(clear))
        poses.append(np.append(to[first], wrap_angle(heading[first])))
    return np.array(poses)


def slipped(
    poses: Float[np.ndarray, "scans 3"], share: float, rng: np.random.Generator
) -> Float[np.ndarray, "scans 3"]:
    """Poses by odometry: every component of every step wrong by this share (one standard deviation), chained."""
    steps = relative(poses[:-1], poses[1:])
    steps *= 1 + share * rng.standard_normal(steps.shape)
    out = [poses[0]]
    for step in steps:
        out.append(compose(out[-1], step))
    return np.array(out)


def reports(
    kind: np.ndarray,
    place: Float[np.ndarray, "echoes 2"],
    pose: Float[np.ndarray, "echoes 3"],
    ends: Float[np.ndarray, "echoes 2 2"],
    scale: Float[np.ndarray, " echoes"],
) -> Float[np.ndarray, " echoes"]:
    """Reported ranges without offsets, metres.

    Args:
        kind: values of ``Kind``.
        place: (rho, theta) of planes, (x, y) of points; world frame, metres and radians.
        pose: world_from_robot.
        ends: transmitter and receiver, robot frame, metres.
        scale: 343.2 m/s over the speed of sound.
    """
    cos, sin = np.cos(pose[:, 2, None]), np.sin(pose[:, 2, None])
    x, y = ends[..., 0], ends[..., 1]
    at = pose[:, None, :2] + np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    normal = np.stack([np.cos(place[:, 1]), np.sin(place[:, 1])], axis=-1)
    height = (at * normal[:, None]).sum(-1) - place[:, :1]
    base = ((at[:, 0] - at[:, 1]) ** 2).sum(-1)
    wall = np.sqrt(np.maximum(base + 4 * height[:, 0] * height[:, 1], 0)) / 2
    corner = np.linalg.norm(at.mean(axis=1) - place, axis=-1)
    edge = np.linalg.norm(at - place[:, None], axis=-1).mean(axis=1)
    return np.select([kind == EchoKind.PLANE, kind == EchoKind.CORNER], [wall, corner], edge) * scale


def scene(room: Room, heard: Simulation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which echoes are of first order, the reflector of each of these, and where those are (as ``reports`` has it)."""
    first = np.flatnonzero(np.isin(heard.kind, FIRST_ORDER))
    found, own = np.unique(np.stack([heard.kind, heard.reflector])[:, first], axis=1, return_inverse=True)
    places = np.zeros((found.shape[1], 2))
    for k, (kind, number) in enumerate(found.T):
        if kind == EchoKind.PLANE:
            along = room.walls[number, 1] - room.walls[number, 0]
            theta = np.arctan2(-along[0], along[1])
            places[k] = room.walls[number, 0] @ [np.cos(theta), np.sin(theta)], theta
        else:
            places[k] = (room.poles if kind == EchoKind.POLE else room.junctions.vertices)[number]
    return first, own.ravel(), places


def bound(
    one: Trial, *, mean_free: bool, poses_free: bool = False, odometry: float | None = None, sigma: float = SIGMA
) -> Float[np.ndarray, "known known"]:
    """Covariance that no unbiased estimate goes below: relative offsets (metres), then logarithm of the speed of sound.

    Args:
        one: the truth and what was heard.
        mean_free: whether the mean offset is estimated, too; it is known otherwise.
        poses_free: whether the poses are; the first one is known.
        odometry: share that odometry between the scans is wrong by; None: no odometry.
        sigma: noise of the ranges, metres.
    """
    first, own, places = scene(one.room, one.heard)
    kind, scan = one.heard.kind[first], one.heard.scan[first]
    pairs = one.true.paths[one.heard.path[first]]
    rows, sensors, scans = np.arange(len(first)), one.true.count, len(one.poses)
    ends = np.asarray(one.true.position)[pairs]
    scale = np.full(len(first), 343.2 / float(one.true.speed_of_sound))
    count = sensors + 1 + places.size + 3 * scans * poses_free
    jacobian = np.zeros((len(first), count))
    for column in pairs.T:  # the report of a path has half of each offset
        np.add.at(jacobian, (rows, column), 0.5)

    def slope(**change: np.ndarray) -> np.ndarray:
        """By central differences."""
        at = {"place": places[own], "pose": one.poses[scan], "scale": np.log(scale)}
        up, down = ({name: value + way * change.get(name, 0) for name, value in at.items()} for way in (1, -1))
        high, low = (reports(kind, s["place"], s["pose"], ends, np.exp(s["scale"])) for s in (up, down))
        return (high - low) / (2 * NUDGE)

    jacobian[:, sensors] = slope(scale=-NUDGE * np.ones(len(first)))
    for k in range(2):
        jacobian[rows, sensors + 1 + 2 * own + k] = slope(place=NUDGE * np.eye(2)[k])
    for k in range(3 * poses_free):
        jacobian[rows, sensors + 1 + places.size + 3 * scan + k] = slope(pose=NUDGE * np.eye(3)[k])
    expected = np.full(count, 1 / LOOSE**2)
    expected[:sensors], expected[sensors] = 1 / OFFSET_SD**2, 1 / SPEED_SD**2
    information = jacobian.T @ jacobian / sigma**2 + np.diag(expected)
    if poses_free:
        begin = sensors + 1 + places.size
        information[begin:, begin:] += _links(one.poses, odometry)
    # Offsets that are known but for those that leave the mean as it is, unless the mean is free.
    turn, _ = np.linalg.qr(np.column_stack([np.ones(sensors), np.eye(sensors)[:, 1:]]))
    basis = np.zeros((count, count - 1 + mean_free))
    kept = turn if mean_free else turn[:, 1:]
    basis[:sensors, : kept.shape[1]] = kept
    basis[sensors:, kept.shape[1] :] = np.eye(count - sensors)
    covariance = basis @ np.linalg.inv(basis.T @ information @ basis) @ basis.T
    flat = np.eye(sensors + 1)
    flat[:sensors, :sensors] -= 1 / sensors
    return flat @ covariance[: sensors + 1, : sensors + 1] @ flat


def _links(poses: Float[np.ndarray, "scans 3"], odometry: float | None) -> np.ndarray:
    """Information of poses that odometry and the known first pose bring."""
    information = np.zeros((poses.size, poses.size))
    information[:3, :3] = np.eye(3) * 1e12
    if odometry is None:
        return information
    step = relative(poses[:-1], poses[1:])
    way, turn = np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2])
    off = np.stack([odometry * way + SLIP[0]] * 2 + [odometry * (turn + TURN * way) + SLIP[1]], axis=-1)
    jacobian = np.zeros((poses.size - 3, poses.size))
    for column in range(poses.size):
        change = np.zeros(poses.size)
        change[column] = NUDGE
        up, down = poses + change.reshape(-1, 3), poses - change.reshape(-1, 3)
        difference = relative(up[:-1], up[1:]) - relative(down[:-1], down[1:])
        difference[:, 2] = wrap_angle(difference[:, 2])
        jacobian[:, column] = difference.ravel() / (2 * NUDGE)
    jacobian /= off.ravel()[:, None]
    return information + jacobian.T @ jacobian


@dataclass(frozen=True)
class Outcome:
    """One calibration against the truth."""

    seed: int
    failed: str = ""
    """Why there is no result."""
    rms: float = np.nan
    """Of the errors of the relative offsets, metres."""
    rms_bound: float = np.nan
    """What the bound says of that, metres."""
    whitened: float = np.nan
    """Root mean square of the errors of relative offsets and speed in directions and units in which the bound is 1: a
    sensor of which nothing is known hides nothing."""
    within: float = np.nan
    """Share of these errors within one standard deviation."""
    nees: float = np.nan
    """Of relative offsets and speed, over their degrees of freedom; 1 is right."""
    speed: float = np.nan
    """Relative error of the speed of sound."""
    speed_sd: float = np.nan
    speed_bound: float = np.nan
    mean: float = np.nan
    """Error of the mean offset, metres."""
    mean_free: bool = False
    placed: float = np.nan
    """Share of the scans that were used."""
    worlds: int = 0
    explained: float = np.nan
    """Share of the echoes that reflectors explain."""
    sigma: float = np.nan
    """Noise of the ranges as estimated, metres."""
    seconds: float = np.nan

    @property
    def converged(self) -> bool:
        """Whether this is the right ring."""
        return not self.failed and self.rms < CONVERGED * self.rms_bound and self.whitened < CONVERGED


def outcome(condition: Condition, seed: int, place: str) -> Outcome:
    """Calibrate once."""
    one = trial(condition, seed, place)
    begin = time.perf_counter()
    try:
        got = calibrate(one.nominal, one.log, **_settings(condition))
    except SonarError as error:
        return Outcome(seed, failed=str(error))
    seconds = time.perf_counter() - begin
    against = compared(got.ring, got.covariance, one, condition, mean_free="mean_offset" not in got.held)
    return replace(
        against,
        seed=seed,
        placed=got.scans / len(one.poses),
        worlds=len(got.maps),
        explained=len(got.residuals) / max(len(one.heard.range), 1),
        sigma=got.sigma,
        seconds=seconds,
    )


def _settings(condition: Condition) -> dict[str, Any]:
    return {"poses": condition.poses} | ({} if condition.odometry is None else {"odometry": condition.odometry})


def compared(
    ring: Ring, covariance: Float[np.ndarray, "ring ring"], one: Trial, condition: Condition, *, mean_free: bool
) -> Outcome:
    """A ring that was found, and its ``Calibration.covariance``, against the truth and the bound."""
    count = one.true.count
    least = bound(one, mean_free=mean_free, poses_free=condition.poses == "estimate", odometry=condition.odometry)
    off = np.asarray(ring.range_offset) - np.asarray(one.true.range_offset)
    error = np.append(off - off.mean(), np.log(float(ring.speed_of_sound) / float(one.true.speed_of_sound)))
    flat = np.eye(count + 1)
    flat[:count, :count] -= 1 / count
    said = flat @ covariance[: count + 1, : count + 1] @ flat
    sd, size = np.sqrt(np.diag(said)), np.sqrt(np.diag(least))
    # In units of the bound, so that millimetres and per cent can be inverted together.
    scaled = error / size
    nees, ideal = (
        scaled @ np.linalg.pinv(c / np.outer(size, size), rcond=1e-8) @ scaled / count for c in (said, least)
    )
    return Outcome(
        seed=-1,
        rms=_rms(error[:count]),
        rms_bound=_rms(size[:count]),
        within=float(np.mean(np.abs(error[:count]) < sd[:count])),
        whitened=float(np.sqrt(ideal)),
        nees=float(nees),
        speed=float(error[count]),
        speed_sd=float(sd[count]),
        speed_bound=float(size[count]),
        mean=float(off.mean()),
        mean_free=mean_free,
    )


def _rms(values: Sequence[float] | np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else np.nan


def measures(some: Sequence[Outcome]) -> dict[str, float]:
    """Over all seeds; figures other than shares are of those that gave a result."""
    good = [one for one in some if not one.failed]
    ratio = [one.rms / one.rms_bound for one in good]
    return {
        "seeds": len(some),
        "failed": len(some) - len(good),
        "converged": float(np.mean([one.converged for one in some])),
        "rms_mm": 1e3 * _median([one.rms for one in good]),
        "bound_mm": 1e3 * _median([one.rms_bound for one in good]),
        "per_bound": _rms(ratio),
        "per_bound_median": _median(ratio),
        "per_bound_worst": max(ratio, default=np.nan),
        "whitened": _rms([one.whitened for one in good]),
        "within": _mean([one.within for one in good]),
        "nees": _mean([one.nees for one in good]),
        "nees_median": _median([one.nees for one in good]),
        "nees_worst": max((one.nees for one in good), default=np.nan),
        "speed_percent": 100 * _rms([one.speed for one in good]),
        "speed_per_bound": _rms([one.speed / one.speed_bound for one in good]),
        "speed_per_sd": _rms([one.speed / one.speed_sd for one in good]),
        "mean_mm": 1e3 * _rms([one.mean for one in good]),
        "mean_free": _mean([float(one.mean_free) for one in good]),
        "placed": _mean([one.placed for one in good]),
        "explained": _mean([one.explained for one in good]),
        "seconds": _median([one.seconds for one in good]),
    }


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else np.nan


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else np.nan


def timed(scans: int, condition: Condition, seed: int = 0) -> dict[str, float]:
    """Seconds of a first call and of a second one with the same shapes; and of the processor in that, all cores."""
    rng = np.random.default_rng(seed)
    base = trial(condition, seed, "office")
    room = random_room(rng)
    poses = path_in(room, rng, scans)
    given = poses if condition.odometry is None else slipped(poses, condition.odometry, rng)
    seconds, busy = [], []
    log = simulate(base.true, room, poses, sigma=SIGMA, seed=seed).as_log(base.true, given)
    got = None
    for _ in range(2):
        begin, began = time.perf_counter(), time.process_time()
        got = calibrate(base.nominal, log, **_settings(condition))
        seconds.append(time.perf_counter() - begin)
        busy.append(time.process_time() - began)
    assert got is not None
    times = {"first": seconds[0], "again": seconds[1], "processor": busy[1]}
    return {"scans": scans, "echoes": got.echoes, "placed": got.scans / scans} | times


def growth(rows: Sequence[dict[str, float]]) -> list[float]:
    """Exponents of the processor's time between neighboring numbers of scans; others may use the machine, too."""
    return [float(np.log(b["processor"] / a["processor"]) / np.log(b["scans"] / a["scans"])) for a, b in pairwise(rows)]


def run(
    conditions: Sequence[Condition],
    places: dict[str, int],
    counts: Sequence[int],
    *,
    seed: int = 0,
    progress: Callable[[str], None] = lambda what: None,
) -> dict[str, Any]:
    """Everything.

    Args:
        conditions: what to do.
        places: "office" or "random rooms", and how many seeds.
        counts: numbers of scans to take the time of.
        seed: the first one.
        progress: told what was done.
    """
    table = []
    for condition in conditions:
        for place, seeds in places.items():
            outcomes = []
            for k in range(seeds):
                outcomes.append(outcome(condition, seed + k, place))
                progress(f"{condition.name}, {place}, seed {seed + k}: {_told(outcomes[-1])}")
            runs = [asdict(one) | {"converged": one.converged} for one in outcomes]
            table.append(asdict(condition) | {"place": place, **measures(outcomes), "runs": runs})
    times = []
    for condition in (CONDITIONS[0], CONDITIONS[2]) if counts else ():
        rows = []
        for scans in counts:
            rows.append(timed(scans, condition, seed))
            progress(f"{condition.name}, {scans} scans: {rows[-1]['again']:.1f} s")
        times.append({"name": condition.name, "rows": rows, "growth": growth(rows)})
    return {"conditions": table, "times": times}


def _told(one: Outcome) -> str:
    if one.failed:
        return one.failed
    ratio, off = one.rms / one.rms_bound, 100 * one.speed
    return (
        f"{1e3 * one.rms:.3f} mm, {ratio:.2f} CRB, whitened {one.whitened:.2f}, NEES {one.nees:.2f}, "
        f"speed {off:+.3f} %, mean offset {1e3 * one.mean:+.2f} mm{'' if one.mean_free else ' (held)'}, "
        f"{100 * one.placed:.0f} % of scans, {100 * one.explained:.0f} % of echoes, {one.seconds:.1f} s"
    )


def tables(told: dict[str, Any]) -> list[Table]:
    """What is printed, from what the JSON file holds; times where they were taken."""
    v = told["versions"]
    accuracy = Table(
        title=f"Calibration, paper's ring, sigma {1e3 * SIGMA:g} mm, {SCANS} scans in random rooms, 17 in the office",
        caption="RMS, CRB: of range offsets less their mean, median over seeds; /CRB: root mean square over seeds, and "
        "the worst; whitened: the same of all directions, speed too; 1 sd: errors within one standard deviation, 68 is "
        "right; NEES: over degrees of freedom, mean, median and worst, 1 is right; "
        f"conv.: RMS below {CONVERGED:g} CRB, whitened, too; mean: % of seeds in which the mean offset is estimated. "
        f"jax {v['jax']} on {v['device']}, {v['commit'][:10]}",
    )
    columns = ["seeds", "failed", "conv. (%)", "RMS (mm)", "CRB", "/CRB", "worst", "whitened", "1 sd (%)"]
    columns += ["NEES", "med.", "worst", "speed (%)", "/CRB", "/sd", "placed (%)", "echoes (%)", "mean", "s"]
    for column in ["", *columns]:
        accuracy.add_column(column, justify="right" if column else "left", no_wrap=True)
    for got in told["conditions"]:
        two = (_said(got[key]) for key in ("per_bound", "per_bound_worst", "whitened"))
        three = (_said(got[key]) for key in ("nees", "nees_median", "nees_worst"))
        accuracy.add_row(
            f"{got['name']}, {got['place']}",
            *(str(got[key]) for key in ("seeds", "failed")),
            _said(100 * got["converged"], 0),
            *(_said(got["rms_mm"], 3), _said(got["bound_mm"], 3), *two, _percent(got["within"]), *three),
            *(_said(got["speed_percent"], 3), _said(got["speed_per_bound"]), _said(got["speed_per_sd"])),
            *(_percent(got[key]) for key in ("placed", "explained", "mean_free")),
            _said(got["seconds"], 1),
        )
    times = Table(title="Time (s); again: a second call with the same shapes, so that nothing is compiled")
    for column in ("", "scans", "echoes", "placed (%)", "first", "again", "processor", "grows with n to the"):
        times.add_column(column, justify="right" if column else "left")
    for got in told["times"]:
        for row, power in zip(got["rows"], [None, *got["growth"]], strict=True):
            many = str(row["scans"]), str(row["echoes"]), _percent(row["placed"])
            times.add_row(
                got["name"], *many, *(_said(row[key], 1) for key in ("first", "again", "processor")), _said(power)
            )
    return [accuracy, times] if told["times"] else [accuracy]


def _said(value: float | None, digits: int = 2) -> str:
    return "" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "" if value is None else _said(100 * value, 0)


def write(found: dict[str, Any], output: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """calibration.json in a folder; what the file holds."""
    make_folder(output)
    told = without_nan({"versions": versions(), "settings": settings, **found})
    with atomic_write(output / "calibration.json") as file:
        json.dump(told, file, indent=1, allow_nan=False)
    return told


def main() -> None:
    """Measure, print."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--quick", action="store_true", help="few seeds, and times up to 100 scans")
    options.add_argument("--seeds", type=int, help="random rooms, and runs in the office; 20, with --quick 4")
    options.add_argument("--seed", type=int, default=0, help="the first one")
    options.add_argument("--only", metavar="TEXT", help="conditions whose name holds this, or 'time'")
    options.add_argument("-o", "--output", type=Path, default=Path("benchmark-results/calibration"))
    options = options.parse_args()
    seeds = options.seeds or (4 if options.quick else 20)
    conditions = [one for one in CONDITIONS if options.only is None or options.only in one.name]
    counts = [n for n in TIMED if n <= 100 or not options.quick] if options.only in (None, "time") else []
    settings = {"seed": options.seed, "seeds": seeds, "sigma": SIGMA, "scans": SCANS, "quick": options.quick}
    places = {"random rooms": seeds, "office": seeds}
    stderr = Console(stderr=True)
    say = lambda what: stderr.print(what, highlight=False, soft_wrap=True)  # noqa: E731
    found = run(conditions, places, counts, seed=options.seed, progress=say)
    told = write(found, options.output, settings)
    stdout = Console(width=240)
    for table in tables(told):
        stdout.print(table)


if __name__ == "__main__":
    main()
