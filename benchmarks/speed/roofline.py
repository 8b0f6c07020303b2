"""Lower bound of the time per scan on this machine, from the rates of increments and of passes over the cells.

The bound counts one increment of a cached counter for each vote, and two passes over the cells, one that sums and one
that compares. Square roots, tables and everything after the threshold are not counted, so no program that does the same
arithmetic reaches it.
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
"""Bytes of the copy, far more than the caches."""


@njit(cache=True)
def count_votes(votes, cells):
    """Lower bound of voting: increments of known cells."""
    for cell in cells:
        votes[cell] += 1


@njit(cache=True)
def sweep(votes, sums, occupied, columns, limit):
    """Lower bound of low pass and threshold: both passes, without the seams."""
    two = np.float32(2)
    up, here, down = votes[: -2 * columns], votes[columns:-columns], votes[2 * columns :]
    for k in range(len(up)):
        sums[k] = np.float32(up[k]) + two * np.float32(here[k]) + np.float32(down[k])
    left, middle, right = sums[:-2], sums[1:-1], sums[2:]
    for k in range(len(left)):
        occupied[k] = left[k] + two * middle[k] + right[k] > limit


def measure(options: Options) -> list[Metric]:
    """Metrics of this workload."""
    scans = batch(options.pick(gate=256, quick=256, full=2048), seed=options.seed)
    ring, settings, dense = Ring.circular(), HoughSettings(), scans.dense
    tables, numba_peer = Tables.of(ring, settings), FusedPeer(ring, settings)
    counts = numba_peer.votes(dense)
    votes = float(counts.sum() / len(dense))
    cells = [np.repeat(np.arange(settings.cells), one.ravel()) for one in counts[:32]]
    shuffled_cells = np.random.default_rng(options.seed).permutation(np.concatenate(cells)).astype(np.int64)
    counters, sums = np.zeros(settings.cells, np.int32), np.zeros(settings.cells, np.float32)
    occupied = np.zeros(settings.cells, bool)
    source, target = np.ones(COPIED, np.uint8), np.ones(COPIED, np.uint8)
    contestants = {
        "vote": Contestant(lambda: count_votes(counters, shuffled_cells), len(shuffled_cells)),
        "cell": Contestant(
            lambda: sweep(counts[0].ravel(), sums, occupied, settings.rho_cells, np.float32(160)), settings.cells
        ),
        "byte": Contestant(lambda: np.copyto(target, source), 2 * COPIED),
        "hough": Contestant(lambda: extract_lines(ring, dense, method="hough"), len(dense)),
        "numba": Contestant(lambda: numba_peer.lines(dense), len(dense)),
        "numba_votes": Contestant(lambda: numba_peer.occupied(dense), len(dense)),
    }
    seconds_of = timing.round_robin(contestants, rounds=options.pick(gate=5, quick=9, full=31))
    fastest = {name: float(seconds.min()) for name, seconds in seconds_of.items()}
    floor = votes * fastest["vote"] + settings.cells * fastest["cell"]
    return [
        Metric("roofline.echoes", float(echoes_of(dense).mean()), "echoes/scan"),
        Metric("roofline.votes", votes, "votes/scan"),
        Metric("roofline.cells", float(settings.cells), "cells"),
        Metric("roofline.accumulator", 4 * settings.cells / 1024, "KiB"),
        Metric("roofline.tables", sum(np.asarray(one).nbytes for one in tables) / 1024, "KiB"),
        Metric("roofline.input", dense[0].nbytes / 1024, "KiB/scan"),
        Metric("roofline.vote", 1e9 * fastest["vote"], "ns"),
        Metric("roofline.cell", 1e9 * fastest["cell"], "ns"),
        Metric("roofline.bandwidth", 1e-9 / fastest["byte"], "GB/s", "higher"),
        Metric("roofline.memory", 1e6 * dense[0].nbytes * fastest["byte"], "us/scan"),
        Metric("roofline.floor", 1e6 * floor, "us/scan"),
        *(Metric(f"roofline.{name}:floor", fastest[name] / floor, "x") for name in ("hough", "numba", "numba_votes")),
        *(Metric(f"roofline.{name}.vote", 1e9 * fastest[name] / votes, "ns") for name in ("hough", "numba")),
    ]
