"""Tables of results in Markdown, and pages that hold them between two marks, so that nobody types a number.

A page says where a table goes: between ``<!-- benchmarks: targets -->`` and ``<!-- /benchmarks -->``.
"""

import re
from collections.abc import Callable
from pathlib import Path

from benchmarks.metrics import RATIO, Metric, Results
from jaxsonar.fileio.atomic_files import atomic_write
from jaxsonar.hardware.errors import SonarError

NOTHING = "not measured here"
BLOCK = re.compile(r"<!-- benchmarks: (?P<name>[\w-]+) -->\n(?P<held>.*?)<!-- /benchmarks -->", re.DOTALL)
TARGETS = {
    "throughput.hough:numba": "hough, batch, one core : fused Numba loop with components and centres",
    "stages.votes:numba_votes": "its first step (votes, low pass, threshold) : Numba loop of the same",
    "throughput.hough:numpy": "hough, batch, one core : plain NumPy + OpenCV",
    "throughput.hough:pointset": "hough, batch, one core : `cv2.HoughLinesPointSet` on the points of the arcs",
    "throughput.ml:hough": "time of ml : time of hough, batch, one core",
    "throughput.hough.two:one.processes": "hough, two cores : one",
    "throughput.ml.two:one.processes": "ml, two cores : one",
    "latency.hough.p50": "one scan, hough, median",
    "latency.hough.p99": "one scan, hough, 99th percentile",
    "latency.ml.p50": "one scan, ml, median",
    "latency.ml.p99": "one scan, ml, 99th percentile",
    "startup.hough.again": "`jaxsonar lines`, hough, programs compiled before, to the first result",
    "startup.ml.again": "`jaxsonar lines`, ml, programs compiled before, to the first result",
}
PEERS = {
    "numba": "fused Numba loop, complete: components by flood fill, centres, extents",
    "numba_votes": "fused Numba loop, votes, low pass and threshold only",
    "numpy": "plain NumPy + OpenCV, scan by scan",
    "pointset": "`cv2.HoughLinesPointSet`, the same cells",
    "pointset_fine": "`cv2.HoughLinesPointSet`, 10 mm x 2 deg",
    "raster": "`skimage.transform.hough_line`, accumulator only",
}
GROWTH = {
    "scans": "scans of a batch, 64 and more",
    "echoes": "echoes of a scan",
    "sensors": "sensors",
    "grid": "cells along each side of the accumulator",
    "points": "points of an arc",
}


def said(metric: Metric | None) -> str:
    """Value and unit."""
    if metric is None or metric.value != metric.value:
        return NOTHING
    value = metric.value
    digits = f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return f"{digits} {metric.unit}".strip()


def table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Markdown; the first column is text."""
    if not rows:
        return f"{NOTHING[0].upper()}{NOTHING[1:]}.\n"
    lines = [header, ("---", *["---:"] * (len(header) - 1)), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def wanted(metric: Metric) -> str:
    """The target with its sign."""
    sign = "at least" if metric.direction == "higher" else "at most"
    return "" if metric.target is None else f"{sign} {metric.target:g} {metric.unit}"


def targets(results: Results) -> str:
    """What is aimed at, ratios first."""
    rows = []
    for key, what in TARGETS.items():
        metric = results.metrics.get(key)
        if metric is not None:
            met = {None: "", True: "yes", False: "no"}[metric.met]
            rows.append((what, said(metric), wanted(metric), met))
    return table(("", "measured", "target", "met"), rows)


def peers(results: Results) -> str:
    """The batched hough against what one would use instead."""
    rows = []
    for name, what in {"hough": "**hough, batch**", **PEERS, "ml": "**ml, batch**"}.items():
        rate = results.metrics.get(f"throughput.{name}.rate")
        against = results.metrics.get(f"throughput.hough:{name}")
        if rate is not None:
            inverse = results.value("throughput.ml:hough") if name == "ml" else float("nan")
            ratio = "1" if name == "hough" else said(against) if against else said(Metric("", inverse, RATIO))
            rows.append((what, ratio, said(rate)))
    return table(("on one core", "hough is faster by", "rate"), rows)


def stages(results: Results) -> str:
    """Where the time goes."""
    rows = []
    for key, metric in results.metrics.items():
        head, _, rest = key.partition(".")
        if head == "stages" and rest.endswith(".share"):
            name, stage = rest.removesuffix(".share").split(".", 1)
            time = results.metrics[f"stages.{name}.{stage}"]
            rows.append((f"{name}: {stage}", said(metric), said(time)))
    return table(("stage, alone", "share of the whole", "time"), rows)


def growth(results: Results) -> str:
    """Exponents."""
    rows = []
    for axis, what in GROWTH.items():
        each = [results.metrics.get(f"growth.{axis}.{method}.exponent") for method in ("hough", "ml")]
        if any(each):
            rows.append((what, *(said(one) for one in each)))
    return table(("time grows with n to the, n being", "hough", "ml"), rows)


def listed(names: tuple[str, ...]) -> Callable[[Results], str]:
    """All figures of some workloads, ratios first."""

    def of(results: Results) -> str:
        own = [one for key, one in results.metrics.items() if key.partition(".")[0] in names and "@" not in key]
        own.sort(key=lambda one: one.unit != RATIO)
        return table(("", "measured"), [(f"`{one.key}`", said(one)) for one in own])

    return of


def conditions(results: Results) -> str:
    """Where and when, a sentence."""
    e = results.environment
    versions = ", ".join(f"{name} {e[name]}" for name in ("jax", "jaxlib", "numpy", "numba") if e.get(name))
    commit = (e["commit"] or "no commit")[:10] + ("+" if (e["commit"] or "").endswith("+") else "")
    return (
        f"{e['processor']}, {e['cores']} cores, JAX on {e['platform']} ({e['device']}); {versions}, OpenCV "
        f"{e['opencv-python-headless']}, Python {e['python']}; {commit}, {e['time'][:10]}, "
        f"{results.options['size']} run.\n"
    )


BLOCKS: dict[str, Callable[[Results], str]] = {
    "targets": targets,
    "peers": peers,
    "stages": stages,
    "growth": growth,
    "times": listed(("latency", "startup")),
    "roofline": listed(("roofline",)),
    "others": listed(("merging", "calibration", "streaming", "accuracy")),
    "device": listed(("device",)),
    "conditions": conditions,
}


def filled(text: str, results: Results) -> str:
    """A page with its tables made anew; those of workloads that were not measured stay as they are.

    Raises:
        SonarError: a table that there is not.
    """

    def block(found: re.Match[str]) -> str:
        name = found["name"]
        if name not in BLOCKS:
            raise SonarError(f"benchmarks: {name!r}; allowed are {', '.join(BLOCKS)}")
        made = BLOCKS[name](results)
        held = found["held"] if NOTHING in made.lower() and made.count("\n") == 1 and found["held"].strip() else made
        return f"<!-- benchmarks: {name} -->\n{held}<!-- /benchmarks -->"

    return BLOCK.sub(block, text)


def write(path: Path, results: Results) -> None:
    """Make the tables of a page anew."""
    text = filled(path.read_text(encoding="utf-8"), results)
    with atomic_write(path) as file:
        file.write(text)
