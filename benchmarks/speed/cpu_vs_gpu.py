"""A long batch by both methods, stage by stage, on JAX's default device and on the processor in the same process.

``python -m benchmarks --only device`` on a machine with a GPU and a JAX build for it takes 100,000 scans; without one
it takes the same on the processor alone, with ``--quick`` 1024 scans.
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
"""Scans that are simulated; a longer batch repeats them."""
ML_ON_PROCESSOR = 16
"""On the processor ml takes every so manieth scan."""


def measure(options: Options) -> list[Metric]:
    """Metrics of this workload."""
    count = options.pick(gate=256, quick=1024, full=100_000)
    some = batch(min(count, DISTINCT), seed=options.seed).dense
    ranges = np.resize(some, (count, *some.shape[1:]))
    default = jax.devices()[0]
    devices = {"processor": jax.devices("cpu")[0]}
    if default.platform != "cpu":
        devices["device"] = default
    taken: dict[str, dict[str, np.ndarray]] = {}
    rounds = options.pick(gate=1, quick=2, full=3)
    for name, device in devices.items():
        with jax.default_device(device):
            ring = Ring.circular()  # a new one: the arcs of a ring are kept, and lie where it was used first
            few = ranges[:: ML_ON_PROCESSOR if device.platform == "cpu" else 1]
            for method, stages, scans in (
                ("hough", hough_stages(ring, ranges), len(ranges)),
                ("ml", ml_stages(ring, few), len(few)),
            ):
                entered = {stage: Contestant(run, scans) for stage, run in stages.items()}
                for stage, seconds in timing.round_robin(entered, rounds=rounds).items():
                    taken.setdefault(f"{method}.{stage}", {})[name] = seconds
    metrics, times = [], []
    for key, rows in taken.items():
        value = float("nan")
        if "device" in rows:
            value = float(rows["processor"].min() / rows["device"].min())
        target = None
        if key.endswith(WHOLE) or value == value:
            metrics.append(Metric(f"device.{key}:processor", value, RATIO, "higher", None, target))
        for name, seconds in rows.items():
            times.append(Metric(f"device.{key}.{name}", 1e6 * float(seconds.min()), "us/scan"))
    return [*metrics, *times, Metric("device.scans", float(count), "scans", "higher")]
