"""Accuracy of SLAM: errors of poses and maps, consistency, loop closures, and the duration of a step.

Run ``python -m benchmarks.slam.accuracy [--quick] [-o FILE]``. Scenes are those of ``scenarios``: one scan in a known
room, the office, twenty ring corridors with rooms, two rooms that look alike, a bare corridor, and a run of 10,000
scans; the paper's ring, sigma 1 mm, odometry with 2 % and 1 deg after one metre. Errors are absolute trajectory errors
(ATE) with the first poses aligned; they are compared with the odometry and with the Cramer-Rao bound (``cramer_rao``).
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

from benchmarks.aggregates import rms
from benchmarks.metrics import environment, without_nan
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
from benchmarks.slam.summary import Outcome, measures, table
from jaxsonar import GlobalMap, SonarError
from jaxsonar.estimation.trajectory import Trajectory
from jaxsonar.evaluation.map_accuracy import evaluate
from jaxsonar.evaluation.trajectory_errors import trajectory_errors
from jaxsonar.fileio.atomic_files import atomic_write, make_folder
from jaxsonar.geometry.se2 import relative, transform_points, wrap_angle
from jaxsonar.graph_slam.initial_poses import LoopClosure
from jaxsonar.mapping.map_from_room import map_from_room

VARIANTS: dict[str, dict[str, Any]] = {"smoothed": {"smooth": True}, "front end": {"smooth": False}}
"""Variants of SLAM: arguments of ``slam``."""
MAX_CLOSURE_ERROR = 0.3, float(np.radians(10.0))
"""Maximum error of a correct closure, metres and radians. Similar corridors are farther apart."""
INITIAL_SD = 0.1, float(np.radians(5.0))
"""Standard deviation of the initial pose of the one scan in a known room, metres and radians."""
_NO_ODOMETRY = 1e3  # m, rad; noise that stands for missing odometry


@dataclass(frozen=True, eq=False)
class Run:
    """Result of one run."""

    trajectory: Trajectory
    """Poses of the registered scans."""
    world: GlobalMap
    closures: Sequence[LoopClosure]
    step_ms: Float[np.ndarray, " scans"]
    """Duration of each step while the robot moves, milliseconds."""


def run_slam(scene: Scene, seed: int, variant: str) -> Run:
    """Run the SLAM of the library."""
    from jaxsonar.estimation.odometry_noise import OdometryNoise
    from jaxsonar.graph_slam.slam import slam

    noise = OdometryNoise(position_per_meter=DISTANCE, heading_per_meter=TURN, heading_per_radian=DISTANCE)
    # Without odometry the scans are registered by their ranges, and there is no front end.
    choices = VARIANTS[variant] if scene.has_odometry else {}
    result = slam(scene.ring, scene.log(seed), odometry_noise=noise, live=True, **choices)
    return Run(result.trajectory, result.world, result.closures, np.asarray(result.step_ms))


def run_one_scan(scene: Scene, seed: int) -> Trajectory:
    """Localize one scan in a known room from a noisy initial pose; no pose if it is ambiguous."""
    from jaxsonar.localization.localize import localize

    sd = np.array([INITIAL_SD[0], INITIAL_SD[0], INITIAL_SD[1]])
    start = scene.poses[0] + sd * np.random.default_rng(seed).standard_normal(3)
    plan, exact = map_from_room(scene.room), (1e-4, 1e-4)
    return localize(scene.ring, plan, scene.log(seed), start=start.tolist(), map_sd=exact).trajectory


def outcome(scene: Scene, variant: str, crb: Bound, *, seed: int = 0) -> Outcome:
    """Run once and compare the result with the truth.

    Args:
        scene: the scene.
        variant: one of ``VARIANTS``.
        crb: Cramer-Rao bound of the scene.
        seed: seed of the odometry.
    """
    truth = Trajectory(scene.simulation.stamps, scene.poses)
    odometry = Trajectory(truth.stamp, scene.odometry(seed))
    odometry_errors = trajectory_errors(odometry, truth, align="first")
    base = Outcome(
        scene.name.rstrip("0123456789 "),
        variant,
        scans=len(truth),
        metres=scene.distance_traveled,
        odometry=odometry_errors.ate if scene.has_odometry else np.nan,
        odometry_heading=odometry_errors.ate_heading if scene.has_odometry else np.nan,
        odometry_aligned=trajectory_errors(odometry, truth).ate if scene.has_odometry else np.nan,
        bound=crb.ate,
        bound_heading=crb.ate_heading,
        walls_bound=rms(np.sqrt(crb.distance)),
    )
    start = time.perf_counter()
    try:
        result = run_slam(scene, seed, variant)
    except (ImportError, SonarError) as error:
        return replace(base, failed=str(error))
    seconds = time.perf_counter() - start
    if not len(result.trajectory):
        return replace(base, failed="no scan was registered")
    first_aligned = trajectory_errors(result.trajectory, truth, align="first")
    aligned = trajectory_errors(result.trajectory, truth)
    accepted = [closure for closure in result.closures if closure.state == "accepted"]
    return replace(
        base,
        placed=first_aligned.poses / len(truth),
        ate=first_aligned.ate,
        ate_heading=first_aligned.ate_heading,
        aligned=aligned.ate,
        relative=first_aligned.relative,
        nees=first_aligned.nees,
        made=len(accepted),
        wrong=sum(wrong(scene.poses, closure) for closure in accepted),
        withdrawn=sum(closure.state == "withdrawn" for closure in result.closures),
        seconds=seconds,
        **_map_measures(scene, result.world, np.zeros(3) if scene.has_odometry else aligned.truth_from_estimate),
        **_times(result.step_ms),
    )


def wrong(poses: Float[np.ndarray, "scans 3"], closure: LoopClosure) -> bool:
    """Whether a closure contradicts the truth in the directions that it determines."""
    error = closure.first_from_second - relative(poses[closure.first], poses[closure.second])
    error[2] = wrap_angle(float(error[2]))
    error = closure.determined @ (closure.determined.T @ error)
    return bool(np.hypot(error[0], error[1]) > MAX_CLOSURE_ERROR[0] or abs(error[2]) > MAX_CLOSURE_ERROR[1])


def _map_measures(scene: Scene, world: GlobalMap, frame: Float[np.ndarray, "3"]) -> dict[str, float]:
    """Measures of a map after a transformation by ``frame``."""
    results = evaluate(transform_points(frame, world.segments), scene.room.walls)
    walls = np.unique(scene.simulation.reflector[scene.simulation.kind == 0])
    covered = results.reference_covered[walls] >= results.reference_length[walls] / 2
    return {
        "missed": float(1 - covered.mean()) if len(walls) else np.nan,
        "false": 1 - results.precision_length,
        "walls": rms(results.distance),
    }


def _times(step_ms: Float[np.ndarray, " scans"]) -> dict[str, float]:
    """Percentiles of the durations of steps. The first one compiles and is listed separately."""
    if len(step_ms) < 2:
        return {}
    steps, tenth = step_ms[1:], max(len(step_ms) // 10, 1)
    growth = float(np.median(step_ms[-tenth:]) / np.median(step_ms[tenth : 2 * tenth])) if tenth > 9 else np.nan
    p50, p99 = np.percentile(steps, [50, 99]).tolist()
    return {"p50": p50, "p99": p99, "first": float(step_ms[0]), "growth": growth}


def one_scans(count: int, *, progress: Callable[[str], None] = lambda what: None) -> list[Outcome]:
    """Localize one scan in each of ``count`` known rooms; the initial pose counts as odometry."""
    results = []
    for seed in range(count):
        scene = one_scan(seed)
        crb = pose_bound(scene)[0]
        base = Outcome(
            "one scan, known room",
            "localized",
            scans=1,
            metres=0.0,
            odometry=INITIAL_SD[0] * np.sqrt(2),
            odometry_heading=INITIAL_SD[1],
            bound=float(np.sqrt(crb[0, 0] + crb[1, 1])),
            bound_heading=float(np.sqrt(crb[2, 2])),
        )
        start = time.perf_counter()
        try:
            result = run_one_scan(scene, seed)
        except (ImportError, SonarError) as error:
            results.append(replace(base, failed=str(error)))
            continue
        seconds = time.perf_counter() - start
        if not len(result):
            results.append(replace(base, failed="no scan was registered"))
            continue
        errors = trajectory_errors(result, Trajectory(scene.simulation.stamps, scene.poses), align="none")
        results.append(
            replace(base, placed=1.0, ate=errors.ate, ate_heading=errors.ate_heading, nees=errors.nees, seconds=seconds)
        )
        progress(_outcome_text(results[-1]))
    return results


def run(
    makers: Mapping[str, Sequence[Callable[[], Scene]]],
    variants: Sequence[str],
    *,
    single_scans: int,
    progress: Callable[[str], None] = lambda what: None,
) -> list[dict[str, Any]]:
    """Run all scenarios.

    Args:
        makers: functions that create the scenes, by scenario.
        variants: names of ``VARIANTS``.
        single_scans: number of rooms with one scan each.
        progress: called with a line of text after each run.
    """
    table = [measures(one_scans(single_scans, progress=progress))] if single_scans else []
    for scenes in makers.values():
        outcomes: dict[str, list[Outcome]] = {variant: [] for variant in variants}
        for make in scenes:
            scene = make()
            crb = bound(scene) if scene.has_odometry else bound(scene, distance=_NO_ODOMETRY, turn=_NO_ODOMETRY)
            for variant in variants:
                outcomes[variant].append(outcome(scene, variant, crb))
                progress(_outcome_text(outcomes[variant][-1]))
        table += [measures(outcomes[variant]) for variant in variants if scenes]
    return table


def _outcome_text(result: Outcome) -> str:
    head = f"{result.scenario}, {result.variant}, {result.scans} scans, {result.metres:.1f} m"
    if result.failed:
        return f"{head}: {result.failed}"
    return (
        f"{head}: {1e3 * result.ate:.1f} mm {np.degrees(result.ate_heading):.2f} deg, "
        f"odometry {1e3 * result.odometry:.0f} mm, "
        f"best aligned {1e3 * result.aligned:.1f} mm, odometry {1e3 * result.odometry_aligned:.0f} mm, "
        f"bound {1e3 * result.bound:.1f} mm, NEES {result.nees:.2f}, closures {result.made}, wrong {result.wrong}, "
        f"withdrawn {result.withdrawn}, walls {1e3 * result.walls:.1f} mm, {result.p50:.1f}/{result.p99:.1f} ms, "
        f"{result.seconds:.1f} s"
    )


def main() -> None:
    """Measure, write, print."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--quick", action="store_true", help="fewer seeds, and a long run of 1000 scans")
    options.add_argument("--seeds", type=int, help="number of seeds (default: 20, with --quick 3)")
    options.add_argument("--scans", type=int, help="scans of the long run (default: 10000, --quick 1000); 0 = none")
    options.add_argument("--only", metavar="TEXT", help="scenarios whose name contains TEXT")
    options.add_argument(
        "--variant", choices=tuple(VARIANTS), help="one variant (default: both, the long run smoothed)"
    )
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
    makers = {name: scenes for name, scenes in makers.items() if wanted(name)}
    variants = [options.variant] if options.variant else list(VARIANTS)
    stderr = Console(stderr=True)

    def print_progress(line: str) -> None:
        stderr.print(line, highlight=False, soft_wrap=True)

    single_scans = seeds if wanted("one scan, known room") else 0
    results = run(makers, variants, single_scans=single_scans, progress=print_progress)
    if scans and wanted("long run"):
        makers = {"long run": [lambda: long_run(scans=scans)]}
        results += run(makers, [options.variant or "smoothed"], single_scans=0, progress=print_progress)
    settings = {"seeds": seeds, "scans": scans, "sigma": SIGMA, "distance": DISTANCE, "turn": TURN}
    content = without_nan({"versions": environment(), "settings": settings, "scenarios": results})
    make_folder(options.output.parent)
    with atomic_write(options.output) as file:
        json.dump(content, file, indent=1, allow_nan=False)
    Console(width=300).print(table(content))
    for why in sorted({row["why"] for row in content["scenarios"]} - {""}):
        print_progress(why)


if __name__ == "__main__":
    main()
