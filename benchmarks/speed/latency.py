"""Latency: one Scan to its LocalModel after warm-up, by both methods and by plain NumPy + OpenCV.

Quantiles are of wall-clock times, ratios of CPU times: a call that uses other threads waits longer under other load.
"""

import itertools
import time
from collections.abc import Callable

import numpy as np

from benchmarks.metrics import RATIO, Metric, Options
from benchmarks.speed.baselines import NumpyPeer
from benchmarks.speed.scan_fixtures import batch, single_scans
from jaxsonar import HoughSettings, local_model

TARGETS_MS = {"p50": 1.0, "p99": 3.0}


def calls(
    runs: dict[str, Callable[[int], object]], count: int, scans: int
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Wall-clock and CPU seconds of each call, after a warm-up; every scan is processed by all in turn."""
    for run, scan in itertools.product(runs.values(), range(scans)):
        run(scan)
    wall_seconds, cpu_seconds = ({name: np.zeros(count) for name in runs} for _ in range(2))
    for k in range(count):
        for name, run in runs.items():
            start, cpu_start = time.perf_counter(), time.process_time()
            run(k % scans)
            wall_seconds[name][k] = time.perf_counter() - start
            cpu_seconds[name][k] = time.process_time() - cpu_start
    return wall_seconds, cpu_seconds


def measure(options: Options) -> list[Metric]:
    """Metrics of this workload."""
    scans_batch = batch(64, seed=options.seed)
    ring, scans = scans_batch.ring, single_scans(scans_batch.ring, scans_batch.dense)
    numpy_peer = NumpyPeer(ring, HoughSettings())
    runs: dict[str, Callable[[int], object]] = {
        "hough": lambda k: local_model(ring, scans[k], method="hough"),
        "numpy": lambda k: numpy_peer.lines(scans_batch.dense[k]),
    }
    if options.size != "gate":
        runs["ml"] = lambda k: local_model(ring, scans[k], method="ml")
    wall_seconds, cpu_seconds = calls(runs, options.pick(gate=300, quick=400, full=4000), len(scans))
    metrics = []
    for name in ("hough", "ml"):
        if name in wall_seconds:
            value = float(np.median(cpu_seconds["numpy"] / cpu_seconds[name]))
            metrics.append(Metric(f"latency.{name}:numpy", value, RATIO, "higher", 2.0))
    for name, seconds in wall_seconds.items():
        for share, target in TARGETS_MS.items():
            value = 1e3 * float(np.quantile(seconds, int(share[1:]) / 100))
            target_ms = target if name != "numpy" else None
            metrics.append(Metric(f"latency.{name}.{share}", value, "ms", target=target_ms))
    return metrics
