"""Time of each stage of a batch and of one scan. Only this file of the suite uses internals of the product.

Each stage is timed alone, on the result of the previous stage; their sum differs from the whole by the work between
them. Times are CPU times of all threads.
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
from jaxsonar.detection.local_model_builder import hough_models
from jaxsonar.detection.ml_detector import ml_detections
from jaxsonar.scans.echo_batches import FAST_SCANS, SLOW_SCANS, BatchPolicy, EchoBatch, pack
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.sliding_windows import Windows

Stages = dict[str, Callable[[], object]]
WHOLE = "whole"


def _batches(
    ring: Ring, echoes: FlatEchoes, settings: HoughSettings, policy: BatchPolicy = FAST_SCANS
) -> list[EchoBatch]:
    return list(pack(ring, echoes, settings.cells, pieces=arc_tables(ring, settings).pieces, policy=policy))


def hough_stages(ring: Ring, ranges: np.ndarray, settings: HoughSettings | None = None) -> Stages:
    """Stages of a batch by the paper's method; ``votes`` is the jitted step up to the threshold."""
    settings = settings or HoughSettings()
    tables = arc_tables(ring, settings)
    arcs = tables.arcs
    echoes = FlatEchoes.from_dense(ring, ranges)
    batches = _batches(ring, echoes, settings)
    votes = [kernels.vote(arcs, echo_batch.packed, settings=settings) for echo_batch in batches]
    masks = [np.asarray(one.occupied) for one in votes]
    labels = [label_components(mask) for mask in masks]
    return {
        WHOLE: lambda: extract_lines(ring, ranges, method="hough", settings=settings),
        "pack": lambda: _batches(ring, FlatEchoes.from_dense(ring, ranges), settings),
        "votes": lambda: jax.block_until_ready(
            [kernels.vote(arcs, echo_batch.packed, settings=settings) for echo_batch in batches]
        ),
        "components": lambda: [label_components(mask) for mask in masks],
        "centroids": lambda: [
            component_centroids(tables, echo_batch, one, *found)
            for echo_batch, one, found in zip(batches, votes, labels, strict=True)
        ],
    }


def ml_stages(ring: Ring, ranges: np.ndarray, settings: HoughSettings | None = None) -> Stages:
    """Stages of a batch by maximum likelihood."""
    settings = settings or HoughSettings()
    arcs, detection_settings = arc_tables(ring, settings).arcs, kernels.DetectionSettings()
    packed = [
        echo_batch.packed for echo_batch in _batches(ring, FlatEchoes.from_dense(ring, ranges), settings, SLOW_SCANS)
    ]
    noise = jnp.asarray(np.nan, jnp.float32)
    found = list(ml_detections(ring, FlatEchoes.from_dense(ring, ranges), settings, None))

    def detect() -> Any:
        return [
            kernels.detect_ml(arcs, one, noise, hough_settings=settings, settings=detection_settings) for one in packed
        ]

    return {
        WHOLE: lambda: extract_lines(ring, ranges, method="ml", settings=settings),
        "pack": lambda: _batches(ring, FlatEchoes.from_dense(ring, ranges), settings, SLOW_SCANS),
        "detect": lambda: jax.block_until_ready(detect()),
        "lines": lambda: [one.lines for one in found],
    }


def single_stages(ring: Ring, ranges: np.ndarray) -> Stages:
    """Stages of single scans from Scan to LocalModel, by the paper's method."""
    settings = HoughSettings()
    logs = [scan.as_log() for scan in single_scans(ring, ranges)]
    scans = single_scans(ring, ranges)
    echoes = [FlatEchoes.from_log(ring, log)[0] for log in logs]
    return {
        WHOLE: lambda: [local_model(ring, scan, method="hough") for scan in scans],
        "convert": lambda: [FlatEchoes.from_log(ring, scan.as_log()) for scan in scans],
        "extract": lambda: [list(hough_detections(ring, one, settings)) for one in echoes],
        "extract and model": lambda: [
            list(hough_models(ring, log, Windows.of_scans(one), settings))
            for log, one in zip(logs, echoes, strict=True)
        ],
    }


def timed(stages: Stages, scans: int, rounds: int) -> dict[str, np.ndarray]:
    """Seconds per scan of each stage in each round."""
    contestants = {name: Contestant(run, scans) for name, run in stages.items()}
    return timing.round_robin(contestants, rounds=rounds, clock=time.process_time)


def stage_metrics(name: str, seconds_of: dict[str, np.ndarray]) -> list[Metric]:
    """Metrics of the stages: shares of the whole, then times."""
    shares = [
        Metric(f"stages.{name}.{stage}.share", 100 * timing.ratio(seconds, seconds_of[WHOLE]), "%")
        for stage, seconds in seconds_of.items()
        if stage != WHOLE
    ]
    return shares + [
        Metric(f"stages.{name}.{stage}", 1e6 * float(seconds.min()), "us/scan") for stage, seconds in seconds_of.items()
    ]


def measure(options: Options) -> list[Metric]:
    """Metrics of this workload."""
    rounds = options.pick(gate=5, quick=3, full=15)
    scans = batch(options.pick(gate=256, quick=512, full=2048), seed=options.seed)
    ring, dense = scans.ring, scans.dense
    numba_peer = FusedPeer(ring, HoughSettings())
    votes = hough_stages(ring, dense) | {"numba": lambda: numba_peer.occupied(dense)}
    seconds_of = timed(votes, len(dense), rounds)
    value = timing.ratio(seconds_of["numba"], seconds_of["votes"])
    metrics = [Metric("stages.votes:numba_votes", value, RATIO, "higher", 2.0, 1.0)]
    del seconds_of["numba"]
    metrics += stage_metrics("hough", seconds_of)
    if options.size == "gate":
        return metrics
    subset = dense[: options.pick(gate=0, quick=64, full=512)]
    metrics += stage_metrics("ml", timed(ml_stages(ring, subset), len(subset), rounds))
    subset = dense[:64]
    return metrics + stage_metrics("single", timed(single_stages(ring, subset), len(subset), rounds))
