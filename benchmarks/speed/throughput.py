"""Throughput: scans per second of a batch, by both methods and their peers on one core, by both methods on two cores.

One-core figures are CPU times in a process pinned to the core, so other load hardly matters. Two-core figures are
wall-clock times.
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
"""Slow contestants process only one scan of this many."""
TARGETS: dict[str, float] = {"numba": 1.0, "numpy": 10.0, "pointset": 50.0}
"""Targets for the speed of the batched hough relative to each peer."""
STEP = 32
"""Subsets have a multiple of this many scans, so that no contestant pads."""
ML_TO_HOUGH, TWO_TO_ONE = 3.0, 1.8
"""Targets: time of ml relative to hough, speed of two cores relative to one."""


def contestants(dense: np.ndarray, mixed: np.ndarray, *, gate: bool) -> Iterator[tuple[str, Contestant]]:
    """All contestants on one core; names with ``_mixed`` use scans with fewer echoes."""
    from benchmarks.speed.baselines import FusedPeer, NumpyPeer, PointSetPeer, RasterPeer
    from jaxsonar import HoughSettings, Ring, extract_lines

    ring, settings = Ring.circular(), HoughSettings()
    numba_peer, numpy_peer, points = FusedPeer(ring, settings), NumpyPeer(ring, settings), PointSetPeer(ring, settings)

    def subset(name: str, ranges: np.ndarray = dense) -> np.ndarray:
        count = max(STEP, len(ranges) // SLOW.get(name, 1) // STEP * STEP)
        return ranges[np.linspace(0, len(ranges) - 1, min(count, len(ranges))).astype(int)]

    yield "hough", Contestant(lambda: extract_lines(ring, dense, method="hough"), len(dense))
    yield "numba", Contestant(lambda: numba_peer.lines(dense), len(dense))
    yield "numba_votes", Contestant(lambda: numba_peer.occupied(dense), len(dense))
    numpy_scans = subset("numpy")
    yield "numpy", Contestant(lambda: [numpy_peer.lines(scan) for scan in numpy_scans], len(numpy_scans))
    arcs = [points.points(scan) for scan in subset("pointset")]
    yield "pointset", Contestant(lambda: [points.lines(one) for one in arcs], len(arcs))
    ml_scans = subset("ml")
    yield "ml", Contestant(lambda: extract_lines(ring, ml_scans, method="ml"), len(ml_scans))
    if gate:
        return
    fine = PointSetPeer(ring, settings, rho_cell=points.point_maker.rho_cell, theta_cell=points.point_maker.theta_cell)
    finer = arcs[: max(1, len(arcs) // 2)]
    yield "pointset_fine", Contestant(lambda: [fine.lines(one) for one in finer], len(finer))
    raster = RasterPeer(settings)
    images = [raster.raster(one) for one in arcs]
    yield "raster", Contestant(lambda: [raster.lines(image) for image in images], len(images))
    yield "hough_mixed", Contestant(lambda: extract_lines(ring, mixed, method="hough"), len(mixed))
    yield "numba_mixed", Contestant(lambda: numba_peer.lines(mixed), len(mixed))
    ml_mixed_scans = subset("ml", mixed)
    yield "ml_mixed", Contestant(lambda: extract_lines(ring, ml_mixed_scans, method="ml"), len(ml_mixed_scans))


def race(scans: Path, *, rounds: int, gate: bool) -> dict[str, list[float]]:
    """CPU seconds per scan, by contestant and round."""
    scans_file = np.load(scans)
    entrants = dict(contestants(scans_file["dense"], scans_file["mixed"], gate=gate))
    seconds_of = timing.round_robin(entrants, rounds=rounds, clock=time.process_time)
    return {name: seconds.tolist() for name, seconds in seconds_of.items()}


def one_core(scans: Path, *, rounds: int, gate: bool) -> list[Metric]:
    """Run the race in a process pinned to one core."""
    core = next(iter(timing.cores(1)), None)
    call = ("--race", str(scans), str(rounds), *(["--gate"] if gate else []))
    output = timing.result(timing.process("benchmarks.speed.throughput", *call, core=core))
    seconds_of = {name: np.array(seconds) for name, seconds in output.items()}
    metrics = []
    for peer in ("numba", "numba_votes", "numpy", "pointset", "pointset_fine", "raster"):
        if peer in seconds_of:
            value = timing.ratio(seconds_of[peer], seconds_of["hough"])
            metrics.append(Metric(f"throughput.hough:{peer}", value, RATIO, "higher", 2.0, TARGETS.get(peer)))
    value = timing.ratio(seconds_of["ml"], seconds_of["hough"])
    metrics.append(Metric("throughput.ml:hough", value, RATIO, "lower", 2.0, ML_TO_HOUGH))
    metrics.append(
        Metric("throughput.ml:numpy", timing.ratio(seconds_of["numpy"], seconds_of["ml"]), RATIO, "higher", 2.0)
    )
    metrics += [
        Metric(f"throughput.{name}.rate", 1 / float(seconds.min()), "scans/s", "higher")
        for name, seconds in seconds_of.items()
    ]
    return metrics


def serve(scans: Path, method: str, threads: int) -> None:
    """Process a batch for every line on stdin, divided between threads, and print the seconds."""
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
    """Rates of one process, of two processes with a core each, and of two threads of one process."""
    keys = {"processes": TWO_TO_ONE, "threads": None}
    cores = timing.cores(2)
    if len(cores) < 2:
        return [
            Metric(f"throughput.{method}.two:one.{kind}", float("nan"), RATIO, "higher", None, t)
            for kind, t in keys.items()
        ]

    def server(threads: int, core: int | None) -> subprocess.Popen[str]:
        call = ("--serve", str(scans), method, str(threads))
        return timing.process("benchmarks.speed.throughput", *call, core=core, stdin=subprocess.PIPE)

    servers = [server(1, cores[0]), server(1, cores[1]), server(2, None)]
    try:
        for one in servers:
            timing.read_line(one.stdout)

        def run(*which: int) -> float:
            for k in which:
                timing.write_line(servers[k].stdin, "go")
            return sum(1 / float(timing.read_line(servers[k].stdout)) for k in which)

        rates = np.array([(run(k % 2), run(0, 1), run(2)) for k in range(rounds)])
    finally:
        for one in servers:
            if one.stdin is not None:
                one.stdin.close()
            one.terminate()
            one.wait()
    parallel_rates = {"processes": rates[:, 1], "threads": rates[:, 2]}
    return [
        Metric(
            f"throughput.{method}.two:one.{kind}", timing.ratio(rate, rates[:, 0]), RATIO, "higher", None, keys[kind]
        )
        for kind, rate in parallel_rates.items()
    ]


def measure(options: Options) -> list[Metric]:
    """Metrics of this workload."""
    from benchmarks.speed.scan_fixtures import batch, echoes_of

    scans = batch(options.pick(gate=512, quick=1000, full=10_000), seed=options.seed)
    with tempfile.TemporaryDirectory() as folder:
        scans_file = Path(folder) / "scans.npz"
        np.savez(scans_file, dense=scans.dense, mixed=scans.mixed)
        gate = options.size == "gate"
        metrics = one_core(scans_file, rounds=options.pick(gate=5, quick=5, full=15), gate=gate)
        for method in () if gate else METHODS:
            metrics += two_cores(scans_file, method, rounds=options.pick(gate=3, quick=3, full=9))
    for name, ranges in {"dense": scans.dense, "mixed": scans.mixed}.items():
        metrics.append(Metric(f"throughput.echoes.{name}", float(echoes_of(ranges).mean()), "echoes/scan"))
    return [*metrics, Metric("throughput.scans", len(scans.dense), "scans", "higher")]


def main() -> None:
    """Run one of the measured processes."""
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
