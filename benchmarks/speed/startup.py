"""Start-up: ``jaxsonar lines`` on one scan in a new process, with an empty and with a filled compilation cache.

The peer is a process that imports JAX, NumPy, SciPy and OpenCV and adds two numbers.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.metrics import RATIO, Metric, Options
from benchmarks.speed.scan_fixtures import batch, single_scans
from jaxsonar import Log, save_log

TARGET = 1.5
"""Target for the first line of the result with compiled programs in the cache, seconds."""
BARE = "import cv2, jax, jax.numpy as jnp, numpy, scipy.sparse; print(jnp.ones(1) + 1)"
COMMAND = "import sys; from jaxsonar.cli import main; sys.exit(main(sys.argv[1:]))"


def seconds(call: list[str], cache: Path) -> tuple[float, float]:
    """Seconds from the start of a process to its first line of output and to its end, with this compilation cache."""
    cache_variables = {"JAX_COMPILATION_CACHE_DIR": str(cache), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    environment = {key: value for key, value in os.environ.items() if key != "JAXSONAR_CACHE"} | cache_variables
    start = time.perf_counter()
    with subprocess.Popen(call, stdout=subprocess.PIPE, env=environment) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        first = time.perf_counter() - start
        process.stdout.read()
    if process.returncode or not line:
        raise RuntimeError(f"{call}: exit code {process.returncode}")
    return first, time.perf_counter() - start


def measure(options: Options) -> list[Metric]:
    """Metrics of this workload. ml compiles for long, so only the full run includes it."""
    repeats = options.pick(gate=1, quick=1, full=7)
    scans = batch(60, seed=options.seed)
    metrics, times = [], []
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "one.csv"
        save_log(Log.from_scans(single_scans(scans.ring, scans.dense)[:1]), log)
        for method in ("hough", "ml") if options.size == "full" else ("hough",):
            cache = Path(folder) / method
            call = [sys.executable, "-c", COMMAND, "lines", str(log), "--ring", "faw", "--method", method, "-o", "-"]
            first, _ = seconds(call, cache)
            rows = np.array(
                [(*seconds(call, cache), seconds([sys.executable, "-c", BARE], cache)[1]) for _ in range(repeats)]
            )
            warm, whole, bare = rows.min(axis=0)
            value = float(np.median(rows[:, 0] / rows[:, 2]))
            metrics.append(Metric(f"startup.{method}.again:bare", value, RATIO, "lower", 2.0))
            metrics.append(Metric(f"startup.{method}.first:again", first / float(warm), RATIO))
            times.append(Metric(f"startup.{method}.first", first, "s"))
            times.append(Metric(f"startup.{method}.again", float(warm), "s", target=TARGET))
            times.append(Metric(f"startup.{method}.again.end", float(whole), "s"))
            times.append(Metric(f"startup.{method}.bare", float(bare), "s"))
    return metrics + times
