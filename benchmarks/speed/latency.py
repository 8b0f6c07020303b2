"""One scan, warm: from a Scan to its LocalModel, components included, by both methods and by plain NumPy + OpenCV.

Quantiles are of the time on the clock, ratios of the processor's time: a call that hands work to other threads waits
for them the longer, the more others use the machine.
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
    """Seconds of each call on the clock, and of the processor; every scan goes to all in turn, after a warm-up."""
    for run, scan in itertools.product(runs.values(), range(scans)):
        run(scan)
    taken, busy = ({name: np.zeros(count) for name in runs} for _ in range(2))
    for k in range(count):
        for name, run in runs.items():
            start, began = time.perf_counter(), time.process_time()
            run(k % scans)
            taken[name][k] = time.perf_counter() - start
            busy[name][k] = time.process_time() - began
    return taken, busy


def measure(options: Options) -> list[Metric]:
    """Metrics of this workload."""
    some = batch(64, seed=options.seed)
    ring, scans = some.ring, single_scans(some.ring, some.dense)
    plain = NumpyPeer(ring, HoughSettings())
    runs: dict[str, Callable[[int], object]] = {
        "hough": lambda k: local_model(ring, scans[k], method="hough"),
        "numpy": lambda k: plain.lines(some.dense[k]),
    }
    if options.size != "gate":
        runs["ml"] = lambda k: local_model(ring, scans[k], method="ml")
    taken, busy = calls(runs, options.pick(gate=300, quick=400, full=4000), len(scans))
    metrics = []
    for name in ("hough", "ml"):
        if name in taken:
            value = float(np.median(busy["numpy"] / busy[name]))
            metrics.append(Metric(f"latency.{name}:numpy", value, RATIO, "higher", 2.0))
    for name, seconds in taken.items():
        for share, target in TARGETS_MS.items():
            value = 1e3 * float(np.quantile(seconds, int(share[1:]) / 100))
            wanted = target if name != "numpy" else None
            metrics.append(Metric(f"latency.{name}.{share}", value, "ms", target=wanted))
    return metrics
