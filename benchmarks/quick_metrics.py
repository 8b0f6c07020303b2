"""A few figures of the workloads that have commands of their own, from their shortest useful form."""

import time

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage

from benchmarks.calibration.accuracy import outcome, timed
from benchmarks.calibration.summary import growth, measures
from benchmarks.calibration.trials import CONDITIONS
from benchmarks.detection.conditions import BASE
from benchmarks.detection.methods import METHODS
from benchmarks.detection.scenarios import POSES, random_scans
from benchmarks.detection.scoring import score
from benchmarks.mapping import segment_merging as merging
from benchmarks.metrics import RATIO, Metric, Options
from benchmarks.speed import timing
from benchmarks.speed.scaling import exponent
from benchmarks.speed.timing import Contestant


def of_merging(options: Options) -> list[Metric]:
    """``benchmarks.mapping.segment_merging``: walls from segments, against single linkage by SciPy, which only makes the clusters."""
    from jaxsonar.mapping.hough_merging import single_linkage
    from jaxsonar.mapping.observations import merge_cells
    from jaxsonar.mapping.segment_fusion import fuse_segments

    size = options.pick(gate=2_000, quick=3_000, full=10_000)
    pieces, _ = merging.building(size)
    middle = pieces.endpoints.mean(axis=1)
    entered = {
        "fuse": Contestant(lambda: fuse_segments(merge_cells(pieces), gap=merging.GAP), size),
        "linkage": Contestant(lambda: single_linkage(middle, merging.CUT), size),
        "scipy": Contestant(lambda: fcluster(linkage(middle, "single"), merging.CUT, "distance"), size),
    }
    taken = timing.round_robin(entered, rounds=options.pick(gate=3, quick=3, full=5), clock=time.process_time)
    metrics = [
        Metric("merging.linkage:scipy", timing.ratio(taken["scipy"], taken["linkage"]), RATIO, "higher", 2.0),
        Metric("merging.fuse:linkage", timing.ratio(taken["fuse"], taken["linkage"]), RATIO, "lower", 2.0),
    ]
    if options.size == "full":
        sizes = 1_000, 10_000, 100_000
        curve = []
        for count in sizes:
            many, _ = merging.building(count)
            start = time.process_time()
            fuse_segments(merge_cells(many), gap=merging.GAP)
            curve.append((count, time.process_time() - start))
        metrics.append(Metric("merging.fuse.exponent", exponent(curve), ""))
        metrics += [Metric(f"merging.fuse@{count}", seconds, "s") for count, seconds in curve]
    return metrics + [
        Metric(f"merging.{name}", 1e6 * float(seconds.min()), "us/segment") for name, seconds in taken.items()
    ]


def of_calibration(options: Options) -> list[Metric]:
    """``benchmarks.calibration.accuracy``: time of 25 scans, in the full run of 100, and deviations over the bound."""
    known = CONDITIONS[0]
    rows = [timed(scans, known) for scans in ((25,) if options.size != "full" else (25, 100))]
    metrics = [Metric("calibration.first:again", rows[0]["first"] / rows[0]["again"], RATIO)]
    if len(rows) > 1:
        metrics.append(Metric("calibration.exponent", growth(rows)[0], ""))
    if options.size == "full":
        found = measures([outcome(known, seed, "random rooms") for seed in range(4)])
        metrics.append(Metric("calibration.rms:bound", float(found["per_bound"]), RATIO))
    return metrics + [Metric(f"calibration.again@{int(row['scans'])}", row["again"], "s") for row in rows]


def of_streaming(options: Options) -> list[Metric]:
    """``benchmarks.speed.streaming``: what a device on a TCP link gets through, by the paper's method, without a map."""
    from benchmarks.speed import streaming

    rows = streaming.run(
        speed=50.0, seconds=options.pick(gate=3, quick=4, full=20), method="hough", mapping=False, record=None
    )
    told = {name: value for name, value, _ in rows}
    return [
        Metric("streaming.real_time", float(told["times real time"]), RATIO, "higher"),
        Metric("streaming.rate", float(told["scans a second"]), "scans/s", "higher"),
        Metric("streaming.p50", float(told["latency, median"]), "ms"),
        Metric("streaming.p99", float(told["latency, 99th percentile"]), "ms"),
        Metric("streaming.dropped", float(told["dropped"]), "scans"),
    ]


def of_accuracy(options: Options) -> list[Metric]:
    """``benchmarks.detection.accuracy``: that what is fast is right; recall, false lines, and deviations over the bound."""
    rooms = options.pick(gate=2, quick=8, full=64)
    scans = random_scans(BASE, rooms, POSES, seed=options.seed)
    metrics = []
    for method, name in {"hough": "hough (paper)", "ml": "ml"}.items():
        said = list(METHODS[name](scans.ring, scans.log, BASE.sigma))
        found = score(scans.truth, said).measures()
        for what in ("rho_mm", "theta_deg"):
            key = f"accuracy.{method}.{what.partition('_')[0]}:bound"
            metrics.append(Metric(key, found[f"rmse_{what}_per_crb"], RATIO))
        metrics.append(Metric(f"accuracy.{method}.recall", 100 * found["recall"], "%", "higher"))
        metrics.append(Metric(f"accuracy.{method}.false", found["false_per_scan"], "lines/scan"))
    return [one for one in metrics if np.isfinite(one.value)]
