"""Speed compared with other implementations: runs the workloads, writes figures and pages, checks the gate.

    python -m benchmarks                      everything, some minutes
    python -m benchmarks --quick              a minute, once everything is compiled
    python -m benchmarks --gate               compare the ratios with benchmarks/baseline.json, as CI does
    python -m benchmarks --update-baseline    measure as the gate does and write a new baseline
    python -m benchmarks --only device        on a machine with a GPU
    python -m benchmarks --write docs/speed.md

Compiled programs are kept in JAX_COMPILATION_CACHE_DIR, or in a folder of the user's cache.
"""

import argparse
import importlib
import os
import sys
import time
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.metrics import BASELINE, RATIO, SIZES, Metric, Options, Results, failures, load_baseline, save_baseline
from jaxsonar.fileio.atomic_files import make_folder, read_bytes
from jaxsonar.hardware.errors import SonarError

WORKLOADS = {
    "throughput": ("speed.throughput.measure", "scans per second of a batch and of its peers, on one core and on two"),
    "latency": ("speed.latency.measure", "one scan, warm"),
    "stages": ("speed.stage_breakdown.measure", "time of each stage"),
    "growth": ("speed.scaling.measure", "scaling with scans, echoes, sensors, cells, points of an arc"),
    "merging": ("quick_metrics.of_merging", "merging of segments to walls"),
    "startup": ("speed.startup.measure", "a command in a new process"),
    "roofline": ("speed.roofline.measure", "lower bound on this machine"),
    "streaming": ("quick_metrics.of_streaming", "a device on a TCP link"),
    "calibration": ("quick_metrics.of_calibration", "calibration of a ring"),
    "accuracy": ("quick_metrics.of_accuracy", "recall, false lines and errors of the detection"),
    "diagnosis": ("quick_metrics.of_diagnosis", "findings of the health check, warnings about inputs"),
    "device": ("speed.cpu_vs_gpu.measure", "a long batch on a GPU and on the CPU"),
}
DEFAULT_WORKLOADS = {
    "gate": ("throughput", "latency", "stages", "growth", "merging"),
    "quick": ("throughput", "latency", "stages", "growth", "merging", "startup", "roofline"),
    "full": tuple(name for name in WORKLOADS if name != "device"),
}
"""Workloads of a run without ``--only``; a full run on a GPU adds ``device``."""
ATTEMPTS = 3
"""Attempts of the gate; the best value counts."""
STDOUT = Console(width=110)
STDERR = Console(stderr=True, soft_wrap=True, highlight=False)


def measured(names: list[str], options: Options) -> list[Metric]:
    """All metrics of some workloads."""
    metrics = []
    for name in names:
        module, _, function = WORKLOADS[name][0].rpartition(".")
        start = time.perf_counter()
        metrics += getattr(importlib.import_module(f".{module}", __package__), function)(options)
        STDERR.print(f"{name}: {time.perf_counter() - start:.0f} s")
    return metrics


def gate(names: list[str], options: Options, baseline: Path) -> tuple[dict[str, Metric], list[str]]:
    """Measure up to three times; returns the best metrics, and the ratios that are worse than the baseline allows."""
    reference, best, worse = load_baseline(baseline), {}, {}
    remaining = names
    for k in range(ATTEMPTS):
        for metric in measured(remaining, options):
            best[metric.key] = best[metric.key].better(metric) if metric.key in best else metric
        worse = failures(best, reference, only=names)
        remaining = [name for name in remaining if any(key.partition(".")[0] == name for key in worse)]
        if not remaining:
            return best, []
        STDERR.print("\n".join(worse.values()) + ("\nmeasuring again" if k + 1 < ATTEMPTS else ""))
    return best, list(worse.values())


def medians(runs: list[list[Metric]]) -> list[Metric]:
    """The median of each metric over several runs, for a baseline."""
    found = []
    for same in zip(*runs, strict=True):
        found.append(sorted(same, key=lambda one: one.value)[len(same) // 2])
    return found


def enable_compilation_cache() -> None:
    """Enable the compilation cache for this process and its children, in a folder that only the user can write to."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home) / "jaxsonar-benchmarks"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")


def results_table(results: Results) -> Table:
    """Table of all metrics, ratios first."""
    from benchmarks.markdown_tables import conditions, target_text, value_text

    table = Table(caption=conditions(results).strip())
    for column in ("", "measured", "target", "met"):
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    for one in sorted(results.metrics.values(), key=lambda one: one.unit != RATIO):
        met = {None: "", True: "yes", False: "no"}[one.met]
        table.add_row(one.key, value_text(one), target_text(one), met, end_section=False)
    return table


def write_pages(pages: list[Path], results: Results) -> None:
    """Update the tables of each page, and the figures that it shows as ``speed_NAME.svg``."""
    from benchmarks import markdown_tables, plots
    from jaxsonar.reports import plot_style

    for path in pages:
        markdown_tables.write(path, results)
        text = path.read_text(encoding="utf-8")
        for name, figure in plots.all_of(results).items():
            if f"speed_{name}.svg" in text:
                plot_style.save_figure(figure, path.parent / f"speed_{name}.svg")


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="fewer scans, rounds and sizes")
    size.add_argument("--gate", action="store_true", help="exit code 1 if a ratio is worse than the baseline allows")
    size.add_argument("--update-baseline", action="store_true", help="measure as the gate does, and write the baseline")
    size.add_argument("--from", dest="source", type=Path, metavar="JSON", help="use these results instead of measuring")
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=WORKLOADS, help="workloads; see --list")
    parser.add_argument("--list", action="store_true", help="list the workloads")
    parser.add_argument("--seed", type=int, default=0, help="seed of rooms, poses and noise")
    parser.add_argument("--baseline", type=Path, default=BASELINE)
    parser.add_argument(
        "--write", nargs="+", type=Path, default=[], metavar="PAGE", help="update the tables of these pages"
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("benchmark-results/suite"), help="JSON and figures")
    options = parser.parse_args(arguments)
    if options.only and (options.update_baseline or options.source):
        parser.error("--only is not allowed with --update-baseline or --from")
    if options.list:
        for name, (_, what) in WORKLOADS.items():
            runs = ", ".join(size for size in SIZES if name in DEFAULT_WORKLOADS[size])
            print(f"{name:12} {what}{f' ({runs})' if runs else ''}")
        return 0
    try:
        return run(options)
    except SonarError as error:
        STDERR.print(str(error))
        return 2


def run(options: argparse.Namespace) -> int:
    """Measure as the options say, write the results, check the gate; returns the exit code."""
    enable_compilation_cache()
    for page in options.write:
        read_bytes(page, what="a page with tables of this suite")
    make_folder(options.output)
    size = "gate" if options.gate or options.update_baseline else "quick" if options.quick else "full"
    measurement, worse = Options(size, options.seed), []
    if options.source is not None:
        results = Results.load(options.source)
    else:
        names = options.only or list(DEFAULT_WORKLOADS[size])
        if options.only is None and size == "full" and _has_gpu():
            names.append("device")
        choices = asdict(measurement) | {"only": options.only}
        if options.gate:
            load_baseline(options.baseline)  # an unreadable baseline is an error before the work starts
            best, worse = gate(names, measurement, options.baseline)
            results = Results.of(best.values(), choices)
        elif options.update_baseline:
            results = Results.of(medians([measured(names, measurement) for _ in range(ATTEMPTS)]), choices)
        else:
            results = Results.of(measured(names, measurement), choices)
        results.save(options.output / "suite.json")
    if options.update_baseline:
        save_baseline(results, options.baseline)
    STDOUT.print(results_table(results))
    if not options.gate:
        from benchmarks import plots

        make_folder(options.output)
        plots.write(results, options.output)
    write_pages(options.write, results)
    if worse:
        STDERR.print(f"worse than {options.baseline}, {ATTEMPTS} times:\n" + "\n".join(worse))
    return 1 if worse else 0


def _has_gpu() -> bool:
    import jax

    return jax.default_backend() != "cpu"


if __name__ == "__main__":
    sys.exit(main())
