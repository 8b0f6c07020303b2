"""Scaling of the time with the number of scans, echoes, sensors, cells and points of an arc: times and exponents.

Everything else is constant: 256 scans of the paper's ring with about 64 echoes. The paths, seven per sensor, and the
echoes grow with the sensors. The exponent is the least-squares slope of log time over log size for the larger half of
the sizes; for the number of scans it is that of the batch, otherwise that of one scan. Times are CPU times of all
threads.
"""

import time
from collections.abc import Iterator

import numpy as np

from benchmarks.metrics import RATIO, Metric, Options
from benchmarks.speed import timing
from benchmarks.speed.scan_fixtures import batch, scans_of_random_rooms
from benchmarks.speed.timing import Contestant
from jaxsonar import HoughSettings, Ring, extract_lines

SIZES: dict[str, dict[str, tuple[int, ...]]] = {
    "scans": {"gate": (256, 1024), "quick": (64, 256, 1024), "full": (16, 64, 256, 1024, 4096, 16384)},
    "echoes": {"gate": (), "quick": (32, 128), "full": (8, 16, 32, 64, 128, 256)},
    "sensors": {"gate": (), "quick": (), "full": (12, 24, 48, 96)},
    "grid": {"gate": (), "quick": (50, 200), "full": (50, 100, 200, 400)},
    "points": {"gate": (), "quick": (30, 120), "full": (15, 30, 60, 120, 240)},
}
"""Sizes by quantity: scans, echoes per scan, sensors, cells along each side, points of the widest arc."""
ML = {"scans": 1024, "echoes": 128}
"""Maximum sizes for ml, in the full run; its programs take long to compile."""
SCANS = 256
"""Number of scans where it is constant."""


def with_echoes(dense: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """The same scans with exactly ``count`` echoes: removed at random, or with false echoes added."""
    flat = dense.reshape(len(dense), -1)
    order = np.argsort(np.isnan(flat) + 0.9 * rng.random(flat.shape), axis=1)[:, :count]
    taken = np.take_along_axis(flat, order, axis=1)
    taken = np.where(np.isnan(taken), rng.uniform(0.5, 1.9, taken.shape), taken)
    out = np.full_like(flat, np.nan)
    np.put_along_axis(out, order, taken.astype(np.float32), axis=1)
    return out.reshape(dense.shape)


def cases(axis: str, sizes: tuple[int, ...], seed: int) -> Iterator[tuple[int, Ring, np.ndarray, HoughSettings]]:
    """Ring, scans and settings of each size."""
    ring, settings, rng = Ring.circular(), HoughSettings(), np.random.default_rng(seed)
    dense = batch(SCANS, seed=seed, ring=ring).dense
    for size in sizes:
        if axis == "scans":
            yield size, ring, np.resize(dense, (size, *dense.shape[1:])), settings
        elif axis == "echoes":
            yield size, ring, with_echoes(dense, size, rng), settings
        elif axis == "sensors":
            other = Ring.circular(count=size)
            yield size, other, scans_of_random_rooms(other, SCANS, seed=seed), settings
        elif axis == "grid":
            yield size, ring, dense, HoughSettings(theta_cells=size, rho_cells=size, rho_cell=4.0 / size)
        else:
            yield size, ring, dense, HoughSettings(point_pitch=float(ring.beam[0]) / size)


def exponent(points: list[tuple[int, float]]) -> float:
    """Slope of log value over log size for the larger half of the sizes, at least two."""
    if len(points) < 2:
        return float("nan")
    x, y = np.log(points[-max(2, (len(points) + 1) // 2) :]).T
    return float(np.polyfit(x, y, 1)[0])


def measure(options: Options) -> list[Metric]:
    """Metrics of this workload."""
    rounds = options.pick(gate=5, quick=3, full=7)
    metrics, points = [], []
    for axis, of_size in SIZES.items():
        for method in ("hough", "ml"):
            max_ml_size = ML.get(axis, 0) if options.size == "full" else 0
            sizes = tuple(size for size in of_size[options.size] if method == "hough" or size <= max_ml_size)
            if not sizes:
                continue
            contestants = {
                str(size): Contestant(
                    lambda r=ring, x=ranges, s=settings, m=method: extract_lines(r, x, method=m, settings=s),
                    len(ranges),
                )
                for size, ring, ranges, settings in cases(axis, sizes, options.seed)
            }
            taken = timing.round_robin(contestants, rounds=rounds, clock=time.process_time)
            curve = [(size, float(taken[str(size)].min())) for size in sizes]
            points += [Metric(f"growth.{axis}.{method}@{size}", 1e6 * seconds, "us/scan") for size, seconds in curve]
            totals = [(size, seconds * (size if axis == "scans" else 1)) for size, seconds in curve]
            if options.size != "gate":
                metrics.append(Metric(f"growth.{axis}.{method}.exponent", exponent(totals), ""))
            if axis == "scans" and method == "hough":
                value = timing.ratio(taken["1024"], taken["256"])
                metrics.append(Metric("growth.scan_of_1024:scan_of_256", value, RATIO, "lower", 2.0))
    return metrics + points
