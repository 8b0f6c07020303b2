"""Where the time of a batch and of one scan goes, stage by stage: the one file of the suite that knows internals.

Each stage is timed alone, on what the stage before it made; what they take together differs from the whole by what
happens between them. Times are those of the processor, all threads together.
"""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.metrics import RATIO, Metric, Options
from benchmarks.speed import timing
from benchmarks.speed.baselines import FusedPeer
from benchmarks.speed.scan_fixtures import batch, single_scans
from benchmarks.speed.timing import Contestant
from jaxsonar import HoughSettings, Ring, extract_lines, kernels, local_model
from jaxsonar.detection.arc_tables import arc_tables
from jaxsonar.detection.component_centroids import component_centroids
from jaxsonar.detection.connected_components import label_components
from jaxsonar.detection.hough_detector import hough_detections
from jaxsonar.detection.local_map_builder import hough_models
from jaxsonar.detection.ml_detector import ml_detections
from jaxsonar.scans.echo_batches import FAST_SCANS, SLOW_SCANS, BatchPolicy, EchoBatch, pack
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.sliding_windows import Windows

Stages = dict[str, Callable[[], object]]
WHOLE = "whole"


def _batches(
    ring: Ring, echoes: FlatEchoes, settings: HoughSettings, policy: BatchPolicy = FAST_SCANS
) -> list[EchoBatch]:
    return list(pack(echoes, settings.cells, pieces=arc_tables(ring, settings).pieces, policy=policy))


def hough_stages(ring: Ring, ranges: np.ndarray, settings: HoughSettings | None = None) -> Stages:
    """A batch by the paper's method; ``votes`` is the jitted step up to the threshold."""
    settings = settings or HoughSettings()
    tables = arc_tables(ring, settings)
    arcs = tables.arcs
    echoes = FlatEchoes.from_dense(ring, ranges)
    steps = _batches(ring, echoes, settings)
    voted = [kernels.vote(arcs, step.packed, settings=settings) for step in steps]
    masks = [np.asarray(one.occupied) for one in voted]
    labelled = [label_components(mask) for mask in masks]
    return {
        WHOLE: lambda: extract_lines(ring, ranges, method="hough", settings=settings),
        "pack": lambda: _batches(ring, FlatEchoes.from_dense(ring, ranges), settings),
        "votes": lambda: jax.block_until_ready([kernels.vote(arcs, step.packed, settings=settings) for step in steps]),
        "components": lambda: [label_components(mask) for mask in masks],
        "centres": lambda: [
            component_centroids(tables, step, one, *found)
            for step, one, found in zip(steps, voted, labelled, strict=True)
        ],
    }


def ml_stages(ring: Ring, ranges: np.ndarray, settings: HoughSettings | None = None) -> Stages:
    """A batch by maximum likelihood."""
    settings = settings or HoughSettings()
    arcs, expected = arc_tables(ring, settings).arcs, kernels.DetectionSettings()
    packed = [step.packed for step in _batches(ring, FlatEchoes.from_dense(ring, ranges), settings, SLOW_SCANS)]
    noise = jnp.asarray(np.nan, jnp.float32)
    found = list(ml_detections(ring, FlatEchoes.from_dense(ring, ranges), settings, None))

    def explain() -> Any:
        return [kernels.detect_ml(arcs, one, noise, hough_settings=settings, settings=expected) for one in packed]

    return {
        WHOLE: lambda: extract_lines(ring, ranges, method="ml", settings=settings),
        "pack": lambda: _batches(ring, FlatEchoes.from_dense(ring, ranges), settings, SLOW_SCANS),
        "explain": lambda: jax.block_until_ready(explain()),
        "lines": lambda: [one.lines for one in found],
    }


def single_stages(ring: Ring, ranges: np.ndarray) -> Stages:
    """One scan after the other from Scan to LocalModel, by the paper's method."""
    settings = HoughSettings()
    logs = [scan.as_log() for scan in single_scans(ring, ranges)]
    scans = single_scans(ring, ranges)
    tables = arc_tables(ring, settings)
    echoes = [FlatEchoes.from_log(ring, log)[0] for log in logs]
    return {
        WHOLE: lambda: [local_model(ring, scan, method="hough") for scan in scans],
        "convert": lambda: [FlatEchoes.from_log(ring, scan.as_log()) for scan in scans],
        "extract": lambda: [list(hough_detections(ring, one, settings, tables)) for one in echoes],
        "extract and model": lambda: [
            list(hough_models(ring, log, Windows.of_scans(one), settings))
            for log, one in zip(logs, echoes, strict=True)
        ],
    }


def timed(stages: Stages, scans: int, rounds: int) -> dict[str, np.ndarray]:
    """Seconds a scan of every stage, round by round."""
    entered = {name: Contestant(run, scans) for name, run in stages.items()}
    return timing.round_robin(entered, rounds=rounds, clock=time.process_time)


def told(name: str, taken: dict[str, np.ndarray]) -> list[Metric]:
    """Shares of the whole first, then times."""
    shares = [
        Metric(f"stages.{name}.{stage}.share", 100 * timing.ratio(seconds, taken[WHOLE]), "%")
        for stage, seconds in taken.items()
        if stage != WHOLE
    ]
    return shares + [
        Metric(f"stages.{name}.{stage}", 1e6 * float(seconds.min()), "us/scan") for stage, seconds in taken.items()
    ]


def measure(options: Options) -> list[Metric]:
    """Metrics of this workload."""
    rounds = options.pick(gate=5, quick=3, full=15)
    scans = batch(options.pick(gate=256, quick=512, full=2048), seed=options.seed)
    ring, dense = scans.ring, scans.dense
    fused = FusedPeer(ring, HoughSettings())
    votes = hough_stages(ring, dense) | {"numba": lambda: fused.occupied(dense)}
    taken = timed(votes, len(dense), rounds)
    value = timing.ratio(taken["numba"], taken["votes"])
    metrics = [Metric("stages.votes:numba_votes", value, RATIO, "higher", 2.0, 1.0)]
    del taken["numba"]
    metrics += told("hough", taken)
    if options.size == "gate":
        return metrics
    few = dense[: options.pick(gate=0, quick=64, full=512)]
    metrics += told("ml", timed(ml_stages(ring, few), len(few), rounds))
    few = dense[:64]
    return metrics + told("single", timed(single_stages(ring, few), len(few), rounds))
