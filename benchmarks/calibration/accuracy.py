"""Accuracy of calibration, consistency of its standard deviations, and its computing time.

Run ``python -m benchmarks.calibration.accuracy [--quick] [-o DIR]``. The paper's ring, sigma 1 mm; 25 scans along a
smooth trajectory through a different random room for each seed, and the 17 scans of the office. Errors are compared
with the Cramer-Rao bound (``cramer_rao``). All errors of offsets are relative to their mean.
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.console import Console

from benchmarks.aggregates import rms
from benchmarks.calibration.cramer_rao import (
    bound,
)
from benchmarks.calibration.summary import Outcome, growth, measures, tables
from benchmarks.calibration.trials import (
    CONDITIONS,
    SCANS,
    SIGMA,
    Condition,
    Trial,
    noisy_odometry,
    trajectory_in,
    trial,
)
from benchmarks.metrics import environment, without_nan
from jaxsonar import Ring, SonarError, calibrate, random_room, simulate
from jaxsonar.fileio.atomic_files import atomic_write, make_folder

TIMED = 25, 100, 1000
"""Numbers of scans whose computing time is measured."""


def outcome(condition: Condition, seed: int, place: str) -> Outcome:
    """Run one calibration and compare it with the truth."""
    case = trial(condition, seed, place)
    start = time.perf_counter()
    try:
        calibration = calibrate(case.nominal, case.log, **_settings(condition))
    except SonarError as error:
        return Outcome(seed, failed=str(error))
    seconds = time.perf_counter() - start
    comparison = compared(
        calibration.ring, calibration.covariance, case, condition, mean_free="mean_offset" not in calibration.held
    )
    return replace(
        comparison,
        seed=seed,
        placed=calibration.scans / len(case.poses),
        worlds=len(calibration.maps),
        explained=len(calibration.residuals) / max(len(case.simulation.range), 1),
        sigma=calibration.sigma,
        seconds=seconds,
    )


def _settings(condition: Condition) -> dict[str, Any]:
    return {"poses": condition.poses} | ({} if condition.odometry is None else {"odometry": condition.odometry})


def compared(
    ring: Ring, covariance: Float[np.ndarray, "ring ring"], case: Trial, condition: Condition, *, mean_free: bool
) -> Outcome:
    """Compare a calibrated ring and its ``Calibration.covariance`` with the truth and the bound."""
    count = case.true.count
    crb = bound(case, mean_free=mean_free, poses_free=condition.poses == "estimate", odometry=condition.odometry)
    offset_error = np.asarray(ring.range_offset) - np.asarray(case.true.range_offset)
    error = np.append(
        offset_error - offset_error.mean(), np.log(float(ring.speed_of_sound) / float(case.true.speed_of_sound))
    )
    centering = np.eye(count + 1)
    centering[:count, :count] -= 1 / count
    reported = centering @ covariance[: count + 1, : count + 1] @ centering
    sd, size = np.sqrt(np.diag(reported)), np.sqrt(np.diag(crb))
    # In units of the bound, so that the matrix of metres and logarithms is well conditioned.
    scaled = error / size
    nees, whitened_squared = (
        scaled @ np.linalg.pinv(c / np.outer(size, size), rcond=1e-8) @ scaled / count for c in (reported, crb)
    )
    return Outcome(
        seed=-1,
        rms=rms(error[:count]),
        rms_bound=rms(size[:count]),
        within=float(np.mean(np.abs(error[:count]) < sd[:count])),
        whitened=float(np.sqrt(whitened_squared)),
        nees=float(nees),
        speed=float(error[count]),
        speed_sd=float(sd[count]),
        speed_bound=float(size[count]),
        mean=float(offset_error.mean()),
        mean_free=mean_free,
    )


def timed(scans: int, condition: Condition, seed: int = 0) -> dict[str, float]:
    """Seconds of a first call and of a second call with the same shapes, and CPU seconds of the second on all cores."""
    rng = np.random.default_rng(seed)
    base = trial(condition, seed, "office")
    room = random_room(rng)
    poses = trajectory_in(room, rng, scans)
    log_poses = poses if condition.odometry is None else noisy_odometry(poses, condition.odometry, rng)
    seconds, cpu_seconds = [], []
    log = simulate(base.true, room, poses, sigma=SIGMA, seed=seed).as_log(base.true, log_poses)
    calibration = None
    for _ in range(2):
        start, cpu_start = time.perf_counter(), time.process_time()
        calibration = calibrate(base.nominal, log, **_settings(condition))
        seconds.append(time.perf_counter() - start)
        cpu_seconds.append(time.process_time() - cpu_start)
    assert calibration is not None
    times = {"first": seconds[0], "again": seconds[1], "processor": cpu_seconds[1]}
    return {"scans": scans, "echoes": calibration.echoes, "placed": calibration.scans / scans} | times


def run(
    conditions: Sequence[Condition],
    places: dict[str, int],
    counts: Sequence[int],
    *,
    seed: int = 0,
    progress: Callable[[str], None] = lambda what: None,
) -> dict[str, Any]:
    """Run all conditions and time measurements.

    Args:
        conditions: the conditions to run.
        places: number of seeds for "office" and "random rooms".
        counts: numbers of scans whose time is measured.
        seed: first seed.
        progress: called with a line of text after each step.
    """
    table = []
    for condition in conditions:
        for place, seeds in places.items():
            outcomes = []
            for k in range(seeds):
                outcomes.append(outcome(condition, seed + k, place))
                progress(f"{condition.name}, {place}, seed {seed + k}: {_outcome_text(outcomes[-1])}")
            runs = [asdict(result) | {"converged": result.converged} for result in outcomes]
            table.append(asdict(condition) | {"place": place, **measures(outcomes), "runs": runs})
    times = []
    for condition in (CONDITIONS[0], CONDITIONS[2]) if counts else ():
        rows = []
        for scans in counts:
            rows.append(timed(scans, condition, seed))
            progress(f"{condition.name}, {scans} scans: {rows[-1]['again']:.1f} s")
        times.append({"name": condition.name, "rows": rows, "growth": growth(rows)})
    return {"conditions": table, "times": times}


def _outcome_text(result: Outcome) -> str:
    if result.failed:
        return result.failed
    ratio, offset_error = result.rms / result.rms_bound, 100 * result.speed
    return (
        f"{1e3 * result.rms:.3f} mm, {ratio:.2f} CRB, whitened {result.whitened:.2f}, NEES {result.nees:.2f}, "
        f"speed {offset_error:+.3f} %, mean offset {1e3 * result.mean:+.2f} mm{'' if result.mean_free else ' (held)'}, "
        f"{100 * result.placed:.0f} % of scans, {100 * result.explained:.0f} % of echoes, {result.seconds:.1f} s"
    )


def write(results: dict[str, Any], output: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Write calibration.json into a folder; returns its content."""
    make_folder(output)
    content = without_nan({"versions": environment(), "settings": settings, **results})
    with atomic_write(output / "calibration.json") as file:
        json.dump(content, file, indent=1, allow_nan=False)
    return content


def main() -> None:
    """Measure, write, print."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--quick", action="store_true", help="fewer seeds, and times of up to 100 scans")
    options.add_argument("--seeds", type=int, help="number of seeds (default: 20, with --quick 4)")
    options.add_argument("--seed", type=int, default=0, help="first seed (default: 0)")
    options.add_argument("--only", metavar="TEXT", help="conditions whose name contains TEXT, or 'time'")
    options.add_argument("-o", "--output", type=Path, default=Path("benchmark-results/calibration"))
    options = options.parse_args()
    seeds = options.seeds or (4 if options.quick else 20)
    conditions = [condition for condition in CONDITIONS if options.only is None or options.only in condition.name]
    counts = [n for n in TIMED if n <= 100 or not options.quick] if options.only in (None, "time") else []
    settings = {"seed": options.seed, "seeds": seeds, "sigma": SIGMA, "scans": SCANS, "quick": options.quick}
    places = {"random rooms": seeds, "office": seeds}
    stderr = Console(stderr=True)

    def print_progress(line: str) -> None:
        stderr.print(line, highlight=False, soft_wrap=True)

    results = run(conditions, places, counts, seed=options.seed, progress=print_progress)
    content = write(results, options.output, settings)
    stdout = Console(width=240)
    for table in tables(content):
        stdout.print(table)


if __name__ == "__main__":
    main()
