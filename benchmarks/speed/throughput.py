"""Scans a second of a batch: both methods and what one would use instead, on one core; both methods on two.

On one core the time is the processor's, in a process that has this core alone: what else the machine does hardly
counts, and on an idle machine it is the time on the clock. Two cores are timed by the clock.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from benchmarks.metrics import RATIO, Metric, Options
from benchmarks.speed import timing
from benchmarks.speed.timing import Contestant

METHODS = ("hough", "ml")
SLOW = {"numpy": 8, "pointset": 8, "pointset_fine": 16, "raster": 8, "ml": 8}
"""Contestants that take every so manieth scan only."""
TARGETS: dict[str, float] = {"numba": 1.0, "numpy": 10.0, "pointset": 50.0}
"""How many times as fast as each the batched hough is to be."""
STEP = 32
"""Scans of a subset are a multiple of this, so that no contestant pads."""
ML_TO_HOUGH, TWO_TO_ONE = 3.0, 1.8


def contestants(dense: np.ndarray, mixed: np.ndarray, *, gate: bool) -> Iterator[tuple[str, Contestant]]:
    """Everything that runs on one core; ``_mixed`` on scans with fewer echoes."""
    from benchmarks.speed.baselines import FusedPeer, NumpyPeer, PointSetPeer, RasterPeer
    from jaxsonar import HoughSettings, Ring, extract_lines

    ring, settings = Ring.circular(), HoughSettings()
    fused, plain, points = FusedPeer(ring, settings), NumpyPeer(ring, settings), PointSetPeer(ring, settings)

    def some(name: str, ranges: np.ndarray = dense) -> np.ndarray:
        count = max(STEP, len(ranges) // SLOW.get(name, 1) // STEP * STEP)
        return ranges[np.linspace(0, len(ranges) - 1, min(count, len(ranges))).astype(int)]

    yield "hough", Contestant(lambda: extract_lines(ring, dense, method="hough"), len(dense))
    yield "numba", Contestant(lambda: fused.lines(dense), len(dense))
    yield "numba_votes", Contestant(lambda: fused.occupied(dense), len(dense))
    few = some("numpy")
    yield "numpy", Contestant(lambda: [plain.lines(scan) for scan in few], len(few))
    arcs = [points.points(scan) for scan in some("pointset")]
    yield "pointset", Contestant(lambda: [points.lines(one) for one in arcs], len(arcs))
    likeliest = some("ml")
    yield "ml", Contestant(lambda: extract_lines(ring, likeliest, method="ml"), len(likeliest))
    if gate:
        return
    fine = PointSetPeer(ring, settings, rho_cell=points.maker.rho_cell, theta_cell=points.maker.theta_cell)
    finer = arcs[: max(1, len(arcs) // 2)]
    yield "pointset_fine", Contestant(lambda: [fine.lines(one) for one in finer], len(finer))
    raster = RasterPeer(settings)
    images = [raster.raster(one) for one in arcs]
    yield "raster", Contestant(lambda: [raster.lines(image) for image in images], len(images))
    yield "hough_mixed", Contestant(lambda: extract_lines(ring, mixed, method="hough"), len(mixed))
    yield "numba_mixed", Contestant(lambda: fused.lines(mixed), len(mixed))
    likely = some("ml", mixed)
    yield "ml_mixed", Contestant(lambda: extract_lines(ring, likely, method="ml"), len(likely))


def race(scans: Path, *, rounds: int, gate: bool) -> dict[str, list[float]]:
    """Seconds of the processor for a scan, by contestant and round."""
    kept = np.load(scans)
    entered = dict(contestants(kept["dense"], kept["mixed"], gate=gate))
    taken = timing.round_robin(entered, rounds=rounds, clock=time.process_time)
    return {name: seconds.tolist() for name, seconds in taken.items()}


def one_core(scans: Path, *, rounds: int, gate: bool) -> list[Metric]:
    """The race, in a process that has one core."""
    core = next(iter(timing.cores(1)), None)
    call = ("--race", str(scans), str(rounds), *(["--gate"] if gate else []))
    told = timing.result(timing.process("benchmarks.speed.throughput", *call, core=core))
    taken = {name: np.array(seconds) for name, seconds in told.items()}
    metrics = []
    for peer in ("numba", "numba_votes", "numpy", "pointset", "pointset_fine", "raster"):
        if peer in taken:
            value = timing.ratio(taken[peer], taken["hough"])
            metrics.append(Metric(f"throughput.hough:{peer}", value, RATIO, "higher", 2.0, TARGETS.get(peer)))
    value = timing.ratio(taken["ml"], taken["hough"])
    metrics.append(Metric("throughput.ml:hough", value, RATIO, "lower", 2.0, ML_TO_HOUGH))
    metrics.append(Metric("throughput.ml:numpy", timing.ratio(taken["numpy"], taken["ml"]), RATIO, "higher", 2.0))
    metrics += [
        Metric(f"throughput.{name}.rate", 1 / float(seconds.min()), "scans/s", "higher")
        for name, seconds in taken.items()
    ]
    return metrics


def serve(scans: Path, method: str, threads: int) -> None:
    """Answer every line on stdin with the seconds of a batch, split between so many threads."""
    from jaxsonar import Ring, extract_lines

    dense, ring = np.load(scans)["dense"], Ring.circular()
    count = len(dense) // SLOW.get(method, 1)
    parts = np.array_split(dense[: max(1, count // (2 * STEP)) * 2 * STEP], threads)
    with ThreadPoolExecutor(threads) as pool:

        def run() -> float:
            start = time.perf_counter()
            list(pool.map(lambda part: extract_lines(ring, part, method=method), parts))
            return time.perf_counter() - start

        run()
        print("ready", flush=True)
        for _ in sys.stdin:
            print(run(), flush=True)


def two_cores(scans: Path, method: str, *, rounds: int) -> list[Metric]:
    """A batch by one process, by two at once, and by two threads of one process; each process has its own core."""
    keys = {"processes": TWO_TO_ONE, "threads": None}
    cores = timing.cores(2)
    if len(cores) < 2:
        return [
            Metric(f"throughput.{method}.two:one.{way}", float("nan"), RATIO, "higher", None, t)
            for way, t in keys.items()
        ]

    def server(threads: int, core: int | None) -> subprocess.Popen[str]:
        call = ("--serve", str(scans), method, str(threads))
        return timing.process("benchmarks.speed.throughput", *call, core=core, stdin=subprocess.PIPE)

    servers = [server(1, cores[0]), server(1, cores[1]), server(2, None)]
    try:
        for one in servers:
            timing.read(one.stdout)

        def run(*which: int) -> float:
            for k in which:
                timing.written(servers[k].stdin, "go")
            return sum(1 / float(timing.read(servers[k].stdout)) for k in which)

        rates = np.array([(run(k % 2), run(0, 1), run(2)) for k in range(rounds)])
    finally:
        for one in servers:
            if one.stdin is not None:
                one.stdin.close()
            one.terminate()
            one.wait()
    of = {"processes": rates[:, 1], "threads": rates[:, 2]}
    return [
        Metric(f"throughput.{method}.two:one.{way}", timing.ratio(rate, rates[:, 0]), RATIO, "higher", None, keys[way])
        for way, rate in of.items()
    ]


def measure(options: Options) -> list[Metric]:
    """Metrics of this workload."""
    from benchmarks.speed.scan_fixtures import batch, echoes_of

    scans = batch(options.pick(gate=512, quick=1000, full=10_000), seed=options.seed)
    with tempfile.TemporaryDirectory() as folder:
        kept = Path(folder) / "scans.npz"
        np.savez(kept, dense=scans.dense, mixed=scans.mixed)
        gate = options.size == "gate"
        metrics = one_core(kept, rounds=options.pick(gate=5, quick=5, full=15), gate=gate)
        for method in () if gate else METHODS:
            metrics += two_cores(kept, method, rounds=options.pick(gate=3, quick=3, full=9))
    for name, ranges in {"dense": scans.dense, "mixed": scans.mixed}.items():
        metrics.append(Metric(f"throughput.echoes.{name}", float(echoes_of(ranges).mean()), "echoes/scan"))
    return [*metrics, Metric("throughput.scans", len(scans.dense), "scans", "higher")]


def main() -> None:
    """Be one of the processes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--race", nargs=2, metavar=("SCANS", "ROUNDS"))
    parser.add_argument("--gate", action="store_true")
    parser.add_argument("--serve", nargs=3, metavar=("SCANS", "METHOD", "THREADS"))
    options = parser.parse_args()
    if options.race:
        scans, rounds = options.race
        print(json.dumps(race(Path(scans), rounds=int(rounds), gate=options.gate)))
    elif options.serve:
        scans, method, threads = options.serve
        serve(Path(scans), method, int(threads))
    else:
        parser.error("run python -m benchmarks --only throughput")


if __name__ == "__main__":
    main()
