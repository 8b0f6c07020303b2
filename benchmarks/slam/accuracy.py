"""How far from the truth poses are that nobody measured, how near to what is possible, and how long a step takes.

Run ``python -m benchmarks.slam.accuracy [--quick] [-o FILE]``. Places are those of ``slam_scenes``: one scan in a known room,
the office, twenty corridors in rings with rooms, two rooms that look alike, a bare corridor, and a run of 10,000 scans;
the paper's ring, sigma 1 mm, odometry wrong by 2 % and 1 deg after one metre. Errors are those of the poses with the
first one in its place (ATE), and are held against odometry and against the Cramer-Rao bound (``slam_bound``).
"""

import argparse
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.console import Console

from benchmarks.result_files import versions, without_nan
from benchmarks.slam.cramer_rao import Bound, bound, pose_bound
from benchmarks.slam.scenarios import (
    DISTANCE,
    SIGMA,
    TURN,
    Scene,
    corridor,
    echoes_alone,
    long_run,
    loop,
    office,
    one_scan,
    twins,
)
from benchmarks.slam.summary import Outcome, _rms, measures, table
from jaxsonar import GlobalMap, SonarError
from jaxsonar.estimation.trajectory import Trajectory
from jaxsonar.evaluation.map_accuracy import evaluate
from jaxsonar.evaluation.trajectory_errors import trajectory_errors
from jaxsonar.fileio.atomic_files import atomic_write, make_folder
from jaxsonar.geometry.se2 import relative, transform_points, wrap_angle
from jaxsonar.graph_slam.initial_poses import LoopClosure
from jaxsonar.mapping.floor_plan import map_from_room

WAYS: dict[str, dict[str, Any]] = {"smoothed": {"smooth": True}, "front end": {"smooth": False}}
"""What ``run_slam`` is told, besides how wrong the odometry is, which the bound knows, too."""
WRONG = 0.3, float(np.radians(10.0))
"""Metres and radians by which a closure may be off the truth; corridors look alike at more than that."""
GUESS = 0.1, float(np.radians(5.0))
"""Standard deviation of what is known of the pose before the one scan in a known room, metres and radians."""
_NO_WHEELS = 1e3  # m, rad; what odometry that is none is wrong by


@dataclass(frozen=True, eq=False)
class Run:
    """What came of one run."""

    trajectory: Trajectory
    """Of the scans that could be placed, by their stamps."""
    world: GlobalMap
    closures: Sequence[LoopClosure]
    step_ms: Float[np.ndarray, " scans"]
    """Of everything that a scan costs while the robot drives."""


def run_slam(scene: Scene, seed: int, way: str) -> Run:
    """The one call of the library's SLAM."""
    from jaxsonar.estimation.odometry_noise import OdometryNoise
    from jaxsonar.graph_slam.slam import slam

    slip = OdometryNoise(position_per_meter=DISTANCE, heading_per_meter=TURN, heading_per_radian=DISTANCE)
    choices = WAYS[way] if scene.wheels else {}  # placed by the ranges, there is no front end
    got = slam(scene.ring, scene.log(seed), odometry_noise=slip, live=True, **choices)
    return Run(got.trajectory, got.world, got.closures, np.asarray(got.step_ms))


def run_one_scan(scene: Scene, seed: int) -> Trajectory:
    """The pose of one scan in a room whose walls are known, from a guess beside the truth; none where it is unsure."""
    from jaxsonar.localization.localize import localize

    sd = np.array([GUESS[0], GUESS[0], GUESS[1]])
    start = scene.poses[0] + sd * np.random.default_rng(seed).standard_normal(3)
    return localize(scene.ring, map_from_room(scene.room), scene.log(seed), start=start.tolist()).trajectory


def outcome(scene: Scene, way: str, least: Bound, *, seed: int = 0) -> Outcome:
    """Run once, and hold it against the truth.

    Args:
        scene: the place.
        way: one of ``WAYS``.
        least: what is possible there.
        seed: of the odometry.
    """
    truth = Trajectory(scene.heard.stamps, scene.poses)
    told = Trajectory(truth.stamp, scene.odometry(seed))
    wheels = trajectory_errors(told, truth, align="first")
    base = Outcome(
        scene.name.rstrip("0123456789 "),
        way,
        scans=len(truth),
        metres=scene.way,
        odometry=wheels.ate if scene.wheels else np.nan,
        odometry_heading=wheels.ate_heading if scene.wheels else np.nan,
        odometry_aligned=trajectory_errors(told, truth).ate if scene.wheels else np.nan,
        bound=least.ate,
        bound_heading=least.ate_heading,
        walls_bound=_rms(np.sqrt(least.distance)),
    )
    begin = time.perf_counter()
    try:
        got = run_slam(scene, seed, way)
    except (ImportError, SonarError) as error:
        return replace(base, failed=str(error))
    seconds = time.perf_counter() - begin
    if not len(got.trajectory):
        return replace(base, failed="no scan was placed")
    own, best = trajectory_errors(got.trajectory, truth, align="first"), trajectory_errors(got.trajectory, truth)
    counted = [one for one in got.closures if one.state == "counted"]
    return replace(
        base,
        placed=own.poses / len(truth),
        ate=own.ate,
        ate_heading=own.ate_heading,
        aligned=best.ate,
        relative=own.relative,
        nees=own.nees,
        made=len(counted),
        wrong=sum(wrong(scene.poses, one) for one in counted),
        withdrawn=sum(one.state == "withdrawn" for one in got.closures),
        seconds=seconds,
        **_map_measures(scene, got.world, np.zeros(3) if scene.wheels else best.truth_from_estimate),
        **_times(got.step_ms),
    )


def wrong(poses: Float[np.ndarray, "scans 3"], tie: LoopClosure) -> bool:
    """Whether a closure says something else than the truth does, in what it determines."""
    off = tie.first_from_second - relative(poses[tie.first], poses[tie.second])
    off[2] = wrap_angle(float(off[2]))
    off = tie.determined @ (tie.determined.T @ off)
    return bool(np.hypot(off[0], off[1]) > WRONG[0] or abs(off[2]) > WRONG[1])


def _map_measures(scene: Scene, world: GlobalMap, frame: Float[np.ndarray, "3"]) -> dict[str, float]:
    """Of a map, after it was moved by ``frame``."""
    found = evaluate(transform_points(frame, world.segments), scene.room.walls)
    heard = np.unique(scene.heard.reflector[scene.heard.kind == 0])
    covered = found.reference_covered[heard] >= found.reference_length[heard] / 2
    return {
        "missed": float(1 - covered.mean()) if len(heard) else np.nan,
        "false": 1 - found.precision_length,
        "walls": _rms(found.distance),
    }


def _times(step_ms: Float[np.ndarray, " scans"]) -> dict[str, float]:
    """Percentiles of the steps but the first one, which compiles."""
    if len(step_ms) < 2:
        return {}
    steps, tenth = step_ms[1:], max(len(step_ms) // 10, 1)
    growth = float(np.median(step_ms[-tenth:]) / np.median(step_ms[tenth : 2 * tenth])) if tenth > 9 else np.nan
    p50, p99 = np.percentile(steps, [50, 99]).tolist()
    return {"p50": p50, "p99": p99, "first": float(step_ms[0]), "growth": growth}


def one_scans(count: int, *, progress: Callable[[str], None] = lambda what: None) -> list[Outcome]:
    """One scan in each of so many known rooms; the guess that it begins with counts as odometry."""
    found = []
    for seed in range(count):
        scene = one_scan(seed)
        least = pose_bound(scene)[0]
        base = Outcome(
            "one scan, known room",
            "localized",
            scans=1,
            metres=0.0,
            odometry=GUESS[0] * np.sqrt(2),
            odometry_heading=GUESS[1],
            bound=float(np.sqrt(least[0, 0] + least[1, 1])),
            bound_heading=float(np.sqrt(least[2, 2])),
        )
        begin = time.perf_counter()
        try:
            got = run_one_scan(scene, seed)
        except (ImportError, SonarError) as error:
            found.append(replace(base, failed=str(error)))
            continue
        seconds = time.perf_counter() - begin
        if not len(got):
            found.append(replace(base, failed="no scan was placed"))
            continue
        own = trajectory_errors(got, Trajectory(scene.heard.stamps, scene.poses), align="none")
        found.append(
            replace(base, placed=1.0, ate=own.ate, ate_heading=own.ate_heading, nees=own.nees, seconds=seconds)
        )
        progress(_told(found[-1]))
    return found


def run(
    makers: Mapping[str, Sequence[Callable[[], Scene]]],
    ways: Sequence[str],
    *,
    ones: int,
    progress: Callable[[str], None] = lambda what: None,
) -> list[dict[str, Any]]:
    """Everything.

    Args:
        makers: scenarios, and what makes each of their scenes.
        ways: some of ``WAYS``.
        ones: how many rooms for one scan each.
        progress: told what was done.
    """
    table = [measures(one_scans(ones, progress=progress))] if ones else []
    for some in makers.values():
        outcomes: dict[str, list[Outcome]] = {way: [] for way in ways}
        for make in some:
            scene = make()
            least = bound(scene) if scene.wheels else bound(scene, distance=_NO_WHEELS, turn=_NO_WHEELS)
            for way in ways:
                outcomes[way].append(outcome(scene, way, least))
                progress(_told(outcomes[way][-1]))
        table += [measures(outcomes[way]) for way in ways if some]
    return table


def _told(one: Outcome) -> str:
    head = f"{one.scenario}, {one.way}, {one.scans} scans, {one.metres:.1f} m"
    if one.failed:
        return f"{head}: {one.failed}"
    return (
        f"{head}: {1e3 * one.ate:.1f} mm {np.degrees(one.ate_heading):.2f} deg, odometry {1e3 * one.odometry:.0f} mm, "
        f"best aligned {1e3 * one.aligned:.1f} mm, odometry {1e3 * one.odometry_aligned:.0f} mm, "
        f"bound {1e3 * one.bound:.1f} mm, NEES {one.nees:.2f}, closures {one.made}, wrong {one.wrong}, "
        f"withdrawn {one.withdrawn}, walls {1e3 * one.walls:.1f} mm, {one.p50:.1f}/{one.p99:.1f} ms, "
        f"{one.seconds:.1f} s"
    )


def main() -> None:
    """Measure, print."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--quick", action="store_true", help="few seeds, and a long run of 1000 scans")
    options.add_argument("--seeds", type=int, help="rings of corridors, and rooms; 20, with --quick 3")
    options.add_argument("--scans", type=int, help="of the long run; 10000, with --quick 1000; 0 = none")
    options.add_argument("--only", metavar="TEXT", help="scenarios whose name holds this")
    options.add_argument("--way", choices=tuple(WAYS), help="one of the two; default: both, the long run smoothed")
    options.add_argument("-o", "--output", type=Path, default=Path("benchmark-results/slam.json"))
    options = options.parse_args()
    seeds = options.seeds or (3 if options.quick else 20)
    scans = (1000 if options.quick else 10_000) if options.scans is None else options.scans
    wanted = lambda name: options.only is None or options.only in name  # noqa: E731
    makers: dict[str, list[Callable[[], Scene]]] = {
        "office": [office],
        "echoes alone": [lambda k=k: echoes_alone(k) for k in range(max(seeds // 3, 1))],
        "loop": [lambda k=k: loop(k) for k in range(seeds)],
        "twin rooms": [lambda k=k: twins(k) for k in range(max(seeds // 4, 1))],
        "corridor": [lambda k=k: corridor(k) for k in range(max(seeds // 4, 1))],
    }
    makers = {name: some for name, some in makers.items() if wanted(name)}
    ways = [options.way] if options.way else list(WAYS)
    stderr = Console(stderr=True)
    say = lambda what: stderr.print(what, highlight=False, soft_wrap=True)  # noqa: E731
    found = run(makers, ways, ones=seeds if wanted("one scan, known room") else 0, progress=say)
    if scans and wanted("long run"):
        found += run({"long run": [lambda: long_run(scans=scans)]}, [options.way or "smoothed"], ones=0, progress=say)
    settings = {"seeds": seeds, "scans": scans, "sigma": SIGMA, "distance": DISTANCE, "turn": TURN}
    told = without_nan({"versions": versions(), "settings": settings, "scenarios": found})
    make_folder(options.output.parent)
    with atomic_write(options.output) as file:
        json.dump(told, file, indent=1, allow_nan=False)
    Console(width=300).print(table(told))
    for why in sorted({row["why"] for row in told["scenarios"]} - {""}):
        say(why)


if __name__ == "__main__":
    main()
