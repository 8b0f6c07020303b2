"""A long batch by both methods, stage by stage, on JAX's default device and on the CPU in the same process.

``python -m benchmarks --only device`` processes 100,000 scans on a GPU; without a GPU it measures the CPU alone. With
``--quick`` it processes 1024 scans.
"""

import jax
import numpy as np

from benchmarks.metrics import RATIO, Metric, Options
from benchmarks.speed import timing
from benchmarks.speed.scan_fixtures import batch
from benchmarks.speed.stage_breakdown import WHOLE, hough_stages, ml_stages
from benchmarks.speed.timing import Contestant
from jaxsonar import Ring

DISTINCT = 4096
"""Number of simulated scans; a longer batch repeats them."""
ML_ON_PROCESSOR = 16
"""On the CPU, ml processes one scan of this many."""


def measure(options: Options) -> list[Metric]:
    """Metrics of this workload."""
    count = options.pick(gate=256, quick=1024, full=100_000)
    distinct = batch(min(count, DISTINCT), seed=options.seed).dense
    ranges = np.resize(distinct, (count, *distinct.shape[1:]))
    default = jax.devices()[0]
    devices = {"processor": jax.devices("cpu")[0]}
    if default.platform != "cpu":
        devices["device"] = default
    seconds_of: dict[str, dict[str, np.ndarray]] = {}
    rounds = options.pick(gate=1, quick=2, full=3)
    for name, device in devices.items():
        with jax.default_device(device):
            ring = Ring.circular()  # a new object, because the arcs of a ring are cached on the first device
            ml_ranges = ranges[:: ML_ON_PROCESSOR if device.platform == "cpu" else 1]
            for method, stages, scans in (
                ("hough", hough_stages(ring, ranges), len(ranges)),
                ("ml", ml_stages(ring, ml_ranges), len(ml_ranges)),
            ):
                contestants = {stage: Contestant(run, scans) for stage, run in stages.items()}
                for stage, seconds in timing.round_robin(contestants, rounds=rounds).items():
                    seconds_of.setdefault(f"{method}.{stage}", {})[name] = seconds
    metrics, times = [], []
    for key, rows in seconds_of.items():
        value = float("nan")
        if "device" in rows:
            value = float(rows["processor"].min() / rows["device"].min())
        target = None
        if key.endswith(WHOLE) or value == value:
            metrics.append(Metric(f"device.{key}:processor", value, RATIO, "higher", None, target))
        for name, seconds in rows.items():
            times.append(Metric(f"device.{key}.{name}", 1e6 * float(seconds.min()), "us/scan"))
    return [*metrics, *times, Metric("device.scans", float(count), "scans", "higher")]
