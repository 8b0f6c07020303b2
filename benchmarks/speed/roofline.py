"""What the machine allows: votes, cells and bytes of a scan, how fast a core counts and sweeps, and what that makes.

The least time of a scan is that of its votes, each one increment of a counter that lies in the first cache, and of two
passes over its cells, one that sums and one that compares. Square roots, tables and everything after the threshold
cost nothing in it, so nothing can reach it that does the same arithmetic.
"""

import numpy as np
from numba import njit

from benchmarks.metrics import Metric, Options
from benchmarks.speed import timing
from benchmarks.speed.baselines import FusedPeer, Tables
from benchmarks.speed.scan_fixtures import batch, echoes_of
from benchmarks.speed.timing import Contestant
from jaxsonar import HoughSettings, Ring, extract_lines

COPIED = 1 << 26
"""Bytes; far more than the caches hold."""


@njit(cache=True)
def count_votes(votes, cells):
    """The least that voting takes: the cell is known."""
    for cell in cells:
        votes[cell] += 1


@njit(cache=True)
def sweep(votes, sums, high, columns, limit):
    """The least that low pass and threshold take: both passes, without the seams."""
    two = np.float32(2)
    up, here, down = votes[: -2 * columns], votes[columns:-columns], votes[2 * columns :]
    for k in range(len(up)):
        sums[k] = np.float32(up[k]) + two * np.float32(here[k]) + np.float32(down[k])
    left, middle, right = sums[:-2], sums[1:-1], sums[2:]
    for k in range(len(left)):
        high[k] = left[k] + two * middle[k] + right[k] > limit


def measure(options: Options) -> list[Metric]:
    """Metrics of this workload."""
    scans = batch(options.pick(gate=256, quick=256, full=2048), seed=options.seed)
    ring, settings, dense = Ring.circular(), HoughSettings(), scans.dense
    tables, fused = Tables.of(ring, settings), FusedPeer(ring, settings)
    counts = fused.votes(dense)
    votes = float(counts.sum() / len(dense))
    cells = [np.repeat(np.arange(settings.cells), one.ravel()) for one in counts[:32]]
    some = np.random.default_rng(options.seed).permutation(np.concatenate(cells)).astype(np.int64)
    room, sums = np.zeros(settings.cells, np.int32), np.zeros(settings.cells, np.float32)
    high = np.zeros(settings.cells, bool)
    source, target = np.ones(COPIED, np.uint8), np.ones(COPIED, np.uint8)
    entered = {
        "vote": Contestant(lambda: count_votes(room, some), len(some)),
        "cell": Contestant(
            lambda: sweep(counts[0].ravel(), sums, high, settings.rho_cells, np.float32(160)), settings.cells
        ),
        "byte": Contestant(lambda: np.copyto(target, source), 2 * COPIED),
        "hough": Contestant(lambda: extract_lines(ring, dense, method="hough"), len(dense)),
        "numba": Contestant(lambda: fused.lines(dense), len(dense)),
        "numba_votes": Contestant(lambda: fused.occupied(dense), len(dense)),
    }
    taken = timing.round_robin(entered, rounds=options.pick(gate=5, quick=9, full=31))
    least = {name: float(seconds.min()) for name, seconds in taken.items()}
    floor = votes * least["vote"] + settings.cells * least["cell"]
    return [
        Metric("roofline.echoes", float(echoes_of(dense).mean()), "echoes/scan"),
        Metric("roofline.votes", votes, "votes/scan"),
        Metric("roofline.cells", float(settings.cells), "cells"),
        Metric("roofline.accumulator", 4 * settings.cells / 1024, "KiB"),
        Metric("roofline.tables", sum(np.asarray(one).nbytes for one in tables) / 1024, "KiB"),
        Metric("roofline.input", dense[0].nbytes / 1024, "KiB/scan"),
        Metric("roofline.vote", 1e9 * least["vote"], "ns"),
        Metric("roofline.cell", 1e9 * least["cell"], "ns"),
        Metric("roofline.bandwidth", 1e-9 / least["byte"], "GB/s", "higher"),
        Metric("roofline.memory", 1e6 * dense[0].nbytes * least["byte"], "us/scan"),
        Metric("roofline.floor", 1e6 * floor, "us/scan"),
        *(Metric(f"roofline.{name}:floor", least[name] / floor, "x") for name in ("hough", "numba", "numba_votes")),
        *(Metric(f"roofline.{name}.vote", 1e9 * least[name] / votes, "ns") for name in ("hough", "numba")),
    ]
