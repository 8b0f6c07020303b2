"""Some figures of benchmarks that have commands of their own, from short runs."""

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
from benchmarks.diagnostics.confusion import outcome as diagnosis
from benchmarks.diagnostics.faults import FAULTS, case
from benchmarks.diagnostics.mistakes import WORDS, sound_inputs
from benchmarks.diagnostics.warning_rates import warned, wrong_of
from benchmarks.mapping import segment_merging as merging
from benchmarks.metrics import RATIO, Metric, Options
from benchmarks.speed import timing
from benchmarks.speed.scaling import exponent
from benchmarks.speed.timing import Contestant


def of_merging(options: Options) -> list[Metric]:
    """Fusion of segments to walls, compared with single linkage (jaxsonar and SciPy), which only makes the clusters."""
    from jaxsonar.mapping.hough_merging import single_linkage
    from jaxsonar.mapping.observations import merge_cells
    from jaxsonar.mapping.segment_fusion import fuse_segments

    size = options.pick(gate=2_000, quick=3_000, full=10_000)
    pieces, _ = merging.building(size)
    middle = pieces.endpoints.mean(axis=1)
    contestants = {
        "fuse": Contestant(lambda: fuse_segments(merge_cells(pieces), gap=merging.GAP), size),
        "linkage": Contestant(lambda: single_linkage(middle, merging.CUT), size),
        "scipy": Contestant(lambda: fcluster(linkage(middle, "single"), merging.CUT, "distance"), size),
    }
    seconds_of = timing.round_robin(contestants, rounds=options.pick(gate=3, quick=3, full=5), clock=time.process_time)
    metrics = [
        Metric("merging.linkage:scipy", timing.ratio(seconds_of["scipy"], seconds_of["linkage"]), RATIO, "higher", 2.0),
        Metric("merging.fuse:linkage", timing.ratio(seconds_of["fuse"], seconds_of["linkage"]), RATIO, "lower", 2.0),
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
        Metric(f"merging.{name}", 1e6 * float(seconds.min()), "us/segment") for name, seconds in seconds_of.items()
    ]


def of_calibration(options: Options) -> list[Metric]:
    """Time of a calibration of 25 scans, in the full run of 100, and errors over the Cramer-Rao bound."""
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
    """Rate and latency of a device on a TCP link, by the paper's method, without a map."""
    from benchmarks.speed import streaming

    rows = streaming.run(
        speed=50.0, seconds=options.pick(gate=3, quick=4, full=20), method="hough", mapping=False, record=None
    )
    values = {name: value for name, value, _ in rows}
    return [
        Metric("streaming.real_time", float(values["times real time"]), RATIO, "higher"),
        Metric("streaming.rate", float(values["scans a second"]), "scans/s", "higher"),
        Metric("streaming.p50", float(values["latency, median"]), "ms"),
        Metric("streaming.p99", float(values["latency, 99th percentile"]), "ms"),
        Metric("streaming.dropped", float(values["dropped"]), "scans"),
    ]


def of_accuracy(options: Options) -> list[Metric]:
    """Recall, false lines, and errors over the Cramer-Rao bound of both methods."""
    rooms = options.pick(gate=2, quick=8, full=64)
    scans = random_scans(BASE, rooms, POSES, seed=options.seed)
    metrics = []
    for method, name in {"hough": "hough (paper)", "ml": "ml"}.items():
        reported = list(METHODS[name](scans.ring, scans.log, BASE.sigma))
        found = score(scans.truth, reported).measures()
        for what in ("rho_mm", "theta_deg"):
            key = f"accuracy.{method}.{what.partition('_')[0]}:bound"
            metrics.append(Metric(key, found[f"rmse_{what}_per_crb"], RATIO))
        metrics.append(Metric(f"accuracy.{method}.recall", 100 * found["recall"], "%", "higher"))
        metrics.append(Metric(f"accuracy.{method}.false", found["false_per_scan"], "lines/scan"))
    return [one for one in metrics if np.isfinite(one.value)]


def of_diagnosis(options: Options) -> list[Metric]:
    """Shares of correct findings of the health check, of named mistakes in inputs, and of false alarms."""
    logs, inputs = options.pick(gate=1, quick=1, full=4), options.pick(gate=1, quick=1, full=3)
    seeds = range(options.seed, options.seed + max(logs, inputs))
    found = [diagnosis(case(cause, seed)) for seed in seeds[:logs] for cause in FAULTS]
    named = [wrong_of(name, seed).result == "named" for seed in seeds[:inputs] for name in WORDS]
    alarms = [warned(one).result != "silent" for one in sound_inputs(options.seed)]
    shares = {
        "correct": [one.result == "correct" for one in found],
        "accused": [bool(one.accused) for one in found],
        "named": named,
        "alarms": alarms,
    }
    return [
        Metric(
            f"diagnosis.{name}",
            100 * float(np.mean(values)),
            "%",
            "higher" if name in ("correct", "named") else "lower",
        )
        for name, values in shares.items()
    ]
