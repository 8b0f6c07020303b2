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
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.console import Console

from benchmarks.calibration.cramer_rao import (
    bound,
)
from benchmarks.calibration.summary import (
    Outcome,
    _rms,
    growth,
    measures,
    tables,
)
from benchmarks.calibration.trials import (
    CONDITIONS,
    SCANS,
    SIGMA,
    Condition,
    Trial,
    path_in,
    slipped,
    trial,
)
from benchmarks.result_files import versions, without_nan
from jaxsonar import Ring, SonarError, calibrate, random_room, simulate
from jaxsonar.fileio.atomic_files import atomic_write, make_folder

TIMED = 25, 100, 1000


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
