"""Time of the line extraction: one scan, a batch of 1000, where it goes, and plain NumPy + OpenCV on the same scans.

Run ``python -m benchmarks.speed``. Ratios come from one run on one machine; compare only those across machines.
"""

import argparse
import itertools
import os
import platform
import time
from collections.abc import Callable

import cv2
import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from jaxsonar import HoughSettings, Ring, extract_lines, kernels
from jaxsonar.components import label_components
from jaxsonar.echoes import FlatEchoes, room_for
from jaxsonar.local import arcs_of
from jaxsonar.randomrooms import random_pose, random_room
from jaxsonar.simulate import simulate

SLOTS = 3


def scans_of_random_rooms(ring: Ring, count: int, *, seed: int = 0) -> np.ndarray:
    """(count, paths, SLOTS) ranges of scans in 20 random rooms, noise 3 mm."""
    rng = np.random.default_rng(seed)
    parts = []
    for k in range(20):
        room = random_room(rng)
        poses = np.stack([random_pose(rng, room) for _ in range(-(-count // 20))])
        parts.append(simulate(ring, room, poses, sigma=0.003, seed=k).dense(len(ring.paths), SLOTS))
    return np.concatenate(parts)[:count].astype(np.float32)


class NumpyPeer:
    """What one would write first: arc tables in NumPy, scan by scan np.bincount, cv2.filter2D and cv2 components."""

    def __init__(self, ring: Ring, settings: HoughSettings):
        """Tables for every path of the ring."""
        paths = ring.echo_paths
        count = np.maximum(np.round(np.asarray(paths.width) / settings.point_pitch), 1)
        index = np.arange(int(count.max()))
        self.counts = index < count[:, None]
        self.theta = np.asarray(paths.start)[:, None] + (index + 0.5) * (np.asarray(paths.width) / count)[:, None]
        n = np.stack([np.cos(self.theta), np.sin(self.theta)], axis=-1)
        t = np.stack([-n[..., 1], n[..., 0]], axis=-1)
        self.along = np.einsum("pkc,pc->pk", n, np.asarray(paths.midpoint))
        self.across2 = np.einsum("pkc,pc->pk", t, np.asarray(paths.half_baseline)) ** 2
        self.settings, self.max_range = settings, ring.max_range
        self.level = settings.threshold * float(kernels.full_wall_votes(paths, settings))

    def lines(self, ranges: np.ndarray) -> list[tuple[float, float]]:
        """(rho, theta) of one scan's lines; ranges are (paths, echoes)."""
        s = self.settings
        path, echo = np.nonzero(ranges < self.max_range)
        reach = ranges[path, echo][:, None]
        rho = self.along[path] + np.sqrt(np.maximum(reach**2 - self.across2[path], 0))
        theta = np.where(rho < 0, self.theta[path] + np.pi, self.theta[path])
        rho, used = np.abs(rho), self.counts[path]
        row = np.floor((theta + np.pi) / s.theta_cell).astype(int) % s.theta_cells
        column = np.floor(rho / s.rho_cell).astype(int)
        used &= column < s.rho_cells
        cell = row * s.rho_cells + column
        votes = np.bincount(cell[used], minlength=s.cells).reshape(s.theta_cells, s.rho_cells)
        wide = np.pad(votes.astype(np.float32), ((1, 1), (0, 0)), mode="wrap")
        kernel = np.outer([1, 2, 1], [1, 2, 1]).astype(np.float32) / 16
        smooth = cv2.filter2D(wide, -1, kernel, borderType=cv2.BORDER_CONSTANT)[1:-1]
        count, labels = cv2.connectedComponents((smooth > self.level).astype(np.uint8), connectivity=8)
        for a, b in zip(labels[0], labels[-1], strict=True):  # theta wraps
            if a and b and a != b:
                labels[labels == b] = a
        of_point = np.where(used, labels.ravel()[np.where(used, cell, 0)], 0)
        found = []
        for k in range(1, count):
            mine = of_point == k
            if mine.any(axis=1).sum() >= s.min_echoes:
                angle = np.arctan2(np.sin(theta[mine]).mean(), np.cos(theta[mine]).mean())
                found.append((float(rho[mine].mean()), float(angle)))
        return found


def seconds(run: Callable[[], object], *, repeats: int) -> np.ndarray:
    """Duration of every run after a warm-up that is the same call."""
    run()
    times = np.empty(repeats)
    for k in range(repeats):
        start = time.perf_counter()
        run()
        times[k] = time.perf_counter() - start
    return times


def main() -> None:
    """Measure and print."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--scans", type=int, default=1000)
    options.add_argument("--quick", action="store_true", help="a fifth of the repetitions")
    options = options.parse_args()
    repeats = 3 if options.quick else 15
    ring, settings = Ring.circular(), HoughSettings()
    ranges = scans_of_random_rooms(ring, options.scans)
    scans, peer = len(ranges), NumpyPeer(ring, settings)

    start = time.perf_counter()
    extract_lines(ring, ranges[:1], method="hough", settings=settings)
    cold = time.perf_counter() - start
    one_by_one = itertools.cycle(ranges[k : k + 1] for k in range(scans))
    single = seconds(
        lambda: extract_lines(ring, next(one_by_one), method="hough", settings=settings), repeats=20 * repeats
    )
    batch = seconds(lambda: extract_lines(ring, ranges, method="hough", settings=settings), repeats=repeats)
    plain = seconds(lambda: [peer.lines(scan) for scan in ranges], repeats=max(repeats // 3, 2))

    arcs = arcs_of(ring, settings)
    steps = list(FlatEchoes.from_dense(ring, ranges).steps(settings.cells))
    packed = [step.packed for step in steps]
    masks = [kernels.occupied_cells(arcs, echoes, settings=settings) for echoes in packed]
    labelled = [label_components(np.asarray(mask)) for mask in masks]
    size = room_for(max(int(counts.max()) for _, counts in labelled), least=16)
    on_device = [jax.numpy.asarray(labels) for labels, _ in labelled]

    def votes() -> object:
        return jax.block_until_ready([kernels.occupied_cells(arcs, echoes, settings=settings) for echoes in packed])

    def centres() -> object:
        return jax.block_until_ready(
            [
                kernels.cluster_lines(arcs, echoes, labels, settings=settings, size=size)
                for echoes, labels in zip(packed, on_device, strict=True)
            ]
        )

    stages = {
        "pack the echoes": lambda: list(FlatEchoes.from_dense(ring, ranges).steps(settings.cells)),
        "votes, low pass, threshold (one jitted step)": votes,
        "connected components (OpenCV, whole batch)": lambda: [label_components(np.asarray(mask)) for mask in masks],
        "centres of gravity, extents (jitted)": centres,
    }
    table = Table(
        title=f"{scans} scans, {np.isfinite(ranges).sum() / scans:.0f} echoes a scan, {len(ring.paths)} paths",
        caption=f"jax {jax.__version__} on {jax.devices()[0].device_kind}, {os.cpu_count()} cores, "
        f"Python {platform.python_version()}; medians",
    )
    for column in ("", "us/scan", "share or ratio"):
        table.add_column(column, justify="left" if not column else "right")

    def per_scan(times: np.ndarray) -> float:
        return float(np.median(times)) / scans * 1e6

    whole = per_scan(batch)
    table.add_row(f"batch of {scans}", f"{whole:.0f}", "1")
    for name, stage in stages.items():
        took = per_scan(seconds(stage, repeats=repeats))
        table.add_row(f"  {name}, alone", f"{took:.0f}", f"{took / whole:.0%}")
    for name, took in {
        "plain NumPy + OpenCV, scan by scan": per_scan(plain),
        "one scan, warm, median": float(np.median(single)) * 1e6,
        "one scan, warm, 99th percentile": float(np.quantile(single, 0.99)) * 1e6,
        "first call, compilation included": cold * 1e6,
    }.items():
        table.add_row(name, f"{took:.0f}", f"{took / whole:.1f} x batch")
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
