"""Markdown tables of results, written into pages between two HTML comments.

The table ``targets`` replaces the text between ``<!-- benchmarks: targets -->`` and ``<!-- /benchmarks -->``.
"""

import re
from collections.abc import Callable
from pathlib import Path

from benchmarks.metrics import RATIO, Metric, Results
from jaxsonar.fileio.atomic_files import atomic_write
from jaxsonar.hardware.errors import SonarError

NOT_MEASURED = "not measured here"
BLOCK = re.compile(r"<!-- benchmarks: (?P<name>[\w-]+) -->\n(?P<held>.*?)<!-- /benchmarks -->", re.DOTALL)
TARGETS = {
    "throughput.hough:numba": "hough, batch, one core : fused Numba loop with components and centroids",
    "stages.votes:numba_votes": "first step of hough (votes, low pass, threshold) : the same in a Numba loop",
    "throughput.hough:numpy": "hough, batch, one core : plain NumPy + OpenCV",
    "throughput.hough:pointset": "hough, batch, one core : `cv2.HoughLinesPointSet` on the points of the arcs",
    "throughput.ml:hough": "time of ml : time of hough, batch, one core",
    "throughput.hough.two:one.processes": "hough, two cores : one core",
    "throughput.ml.two:one.processes": "ml, two cores : one core",
    "latency.hough.p50": "one scan, hough, median",
    "latency.hough.p99": "one scan, hough, 99th percentile",
    "latency.ml.p50": "one scan, ml, median",
    "latency.ml.p99": "one scan, ml, 99th percentile",
    "startup.hough.again": "`jaxsonar lines`, hough, with compiled programs, time to the first result",
    "startup.ml.again": "`jaxsonar lines`, ml, with compiled programs, time to the first result",
}
PEERS = {
    "numba": "fused Numba loop, complete: components by flood fill, centroids, segments",
    "numba_votes": "fused Numba loop, votes, low pass and threshold only",
    "numpy": "plain NumPy + OpenCV, scan by scan",
    "pointset": "`cv2.HoughLinesPointSet`, the same cells",
    "pointset_fine": "`cv2.HoughLinesPointSet`, 10 mm x 2 deg",
    "raster": "`skimage.transform.hough_line`, accumulator only",
}
GROWTH = {
    "scans": "scans in a batch, from 64",
    "echoes": "echoes per scan",
    "sensors": "sensors",
    "grid": "cells along each side of the accumulator",
    "points": "points per arc",
}


def value_text(metric: Metric | None) -> str:
    """Text of a value with its unit."""
    if metric is None or metric.value != metric.value:
        return NOT_MEASURED
    value = metric.value
    digits = f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return f"{digits} {metric.unit}".strip()


def table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A Markdown table; the first column is text, the others are numbers."""
    if not rows:
        return f"{NOT_MEASURED[0].upper()}{NOT_MEASURED[1:]}.\n"
    lines = [header, ("---", *["---:"] * (len(header) - 1)), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def target_text(metric: Metric) -> str:
    """Text of a target: at least or at most."""
    sign = "at least" if metric.direction == "higher" else "at most"
    return "" if metric.target is None else f"{sign} {metric.target:g} {metric.unit}"


def targets(results: Results) -> str:
    """Targets and whether they are met."""
    rows = []
    for key, what in TARGETS.items():
        metric = results.metrics.get(key)
        if metric is not None:
            met = {None: "", True: "yes", False: "no"}[metric.met]
            rows.append((what, value_text(metric), target_text(metric), met))
    return table(("", "measured", "target", "met"), rows)


def peers(results: Results) -> str:
    """Rates of all implementations on one core."""
    rows = []
    for name, what in {"hough": "**hough, batch**", **PEERS, "ml": "**ml, batch**"}.items():
        rate = results.metrics.get(f"throughput.{name}.rate")
        against = results.metrics.get(f"throughput.hough:{name}")
        if rate is not None:
            inverse = results.value("throughput.ml:hough") if name == "ml" else float("nan")
            ratio = (
                "1" if name == "hough" else value_text(against) if against else value_text(Metric("", inverse, RATIO))
            )
            rows.append((what, ratio, value_text(rate)))
    return table(("on one core", "hough is faster by", "rate"), rows)


def stages(results: Results) -> str:
    """Time of each stage and its share of the whole."""
    rows = []
    for key, metric in results.metrics.items():
        head, _, rest = key.partition(".")
        if head == "stages" and rest.endswith(".share"):
            name, stage = rest.removesuffix(".share").split(".", 1)
            time = results.metrics[f"stages.{name}.{stage}"]
            rows.append((f"{name}: {stage}", value_text(metric), value_text(time)))
    return table(("stage, alone", "share of the whole", "time"), rows)


def growth(results: Results) -> str:
    """Exponents of the time."""
    rows = []
    for axis, what in GROWTH.items():
        each = [results.metrics.get(f"growth.{axis}.{method}.exponent") for method in ("hough", "ml")]
        if any(each):
            rows.append((what, *(value_text(one) for one in each)))
    return table(("exponent of the time over the number of", "hough", "ml"), rows)


def listed(names: tuple[str, ...]) -> Callable[[Results], str]:
    """A function that lists all metrics of some workloads, ratios first."""

    def listing(results: Results) -> str:
        selected = [one for key, one in results.metrics.items() if key.partition(".")[0] in names and "@" not in key]
        selected.sort(key=lambda one: one.unit != RATIO)
        return table(("", "measured"), [(f"`{one.key}`", value_text(one)) for one in selected])

    return listing


def conditions(results: Results) -> str:
    """Machine, versions, commit and date in one sentence."""
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


def updated(text: str, results: Results) -> str:
    """A page with updated tables. Tables of workloads that were not measured stay unchanged.

    Raises:
        SonarError: unknown name of a table.
    """

    def block(found: re.Match[str]) -> str:
        name = found["name"]
        if name not in BLOCKS:
            raise SonarError(f"benchmarks: {name!r}; allowed are {', '.join(BLOCKS)}")
        table_text = BLOCKS[name](results)
        content = (
            found["held"]
            if NOT_MEASURED in table_text.lower() and table_text.count("\n") == 1 and found["held"].strip()
            else table_text
        )
        return f"<!-- benchmarks: {name} -->\n{content}<!-- /benchmarks -->"

    return BLOCK.sub(block, text)


def write(path: Path, results: Results) -> None:
    """Update the tables of a page."""
    text = updated(path.read_text(encoding="utf-8"), results)
    with atomic_write(path) as file:
        file.write(text)
