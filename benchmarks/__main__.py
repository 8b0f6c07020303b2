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
    "throughput": ("throughput.measure", "scans a second of a batch, and of its peers, on one core and on two"),
    "latency": ("latency.measure", "one scan, warm"),
    "stages": ("stages.measure", "where the time goes"),
    "growth": ("growth.measure", "with scans, echoes, sensors, cells, points of an arc"),
    "merging": ("others.of_merging", "walls from segments"),
    "startup": ("startup.measure", "a command in a new process"),
    "roofline": ("roofline.measure", "what the machine allows"),
    "streaming": ("others.of_streaming", "a device on a TCP link"),
    "calibration": ("others.of_calibration", "a ring from its echoes"),
    "accuracy": ("others.of_accuracy", "that what is fast is right"),
    "device": ("device.measure", "a long batch on a GPU and on the processor"),
}
SHORT = {
    "gate": ("throughput", "latency", "stages", "growth", "merging"),
    "quick": ("throughput", "latency", "stages", "growth", "merging", "startup", "roofline"),
    "full": tuple(name for name in WORKLOADS if name != "device"),
}
"""What runs if nothing is named; on a GPU device, too."""
TRIES = 3
"""Of the gate; the best value counts."""
PRINTED = Console(width=110)
SAID = Console(stderr=True, soft_wrap=True, highlight=False)


def measured(names: list[str], options: Options) -> list[Metric]:
    """All metrics of some workloads."""
    metrics = []
    for name in names:
        module, _, function = WORKLOADS[name][0].partition(".")
        start = time.perf_counter()
        metrics += getattr(importlib.import_module(f".{module}", __package__), function)(options)
        SAID.print(f"{name}: {time.perf_counter() - start:.0f} s")
    return metrics


def gate(names: list[str], options: Options, baseline: Path) -> tuple[dict[str, Metric], list[str]]:
    """Metrics, each the best of what was needed of three tries, and what is still worse than the baseline allows."""
    held, best, wrong = load_baseline(baseline), {}, {}
    left = names
    for k in range(TRIES):
        for metric in measured(left, options):
            best[metric.key] = best[metric.key].better(metric) if metric.key in best else metric
        wrong = failures(best, held, only=names)
        left = [name for name in left if any(key.partition(".")[0] == name for key in wrong)]
        if not left:
            return best, []
        SAID.print("\n".join(wrong.values()) + ("\nonce more" if k + 1 < TRIES else ""))
    return best, list(wrong.values())


def usual(runs: list[list[Metric]]) -> list[Metric]:
    """Of each metric that run whose value is the median: a baseline is what is usual."""
    found = []
    for same in zip(*runs, strict=True):
        found.append(sorted(same, key=lambda one: one.value)[len(same) // 2])
    return found


def keep_compiled() -> None:
    """Let this process and those it starts keep compiled programs, in a folder that only the user can write to."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home) / "jaxsonar-benchmarks"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")


def shown(results: Results) -> Table:
    """Ratios first, then times."""
    from benchmarks.markdown_tables import conditions, said, wanted

    table = Table(caption=conditions(results).strip())
    for column in ("", "measured", "target", "met"):
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    for one in sorted(results.metrics.values(), key=lambda one: one.unit != RATIO):
        met = {None: "", True: "yes", False: "no"}[one.met]
        table.add_row(one.key, said(one), wanted(one), met, end_section=False)
    return table


def write_pages(pages: list[Path], results: Results) -> None:
    """Tables of each page, and the figures that it shows as ``speed_NAME.svg``."""
    from benchmarks import markdown_tables, plots
    from jaxsonar.reports import plot_style

    for path in pages:
        markdown_tables.write(path, results)
        text = path.read_text(encoding="utf-8")
        for name, figure in plots.all_of(results).items():
            if f"speed_{name}.svg" in text:
                plot_style.save_figure(figure, path.parent / f"speed_{name}.svg")


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="fewer scans, rounds and sizes")
    size.add_argument("--gate", action="store_true", help="exit code 1 if a ratio is worse than the baseline allows")
    size.add_argument("--update-baseline", action="store_true", help="measure as the gate does, and write the baseline")
    size.add_argument("--from", dest="source", type=Path, metavar="JSON", help="measure nothing, take these results")
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=WORKLOADS, help="workloads; see --list")
    parser.add_argument("--list", action="store_true", help="the workloads")
    parser.add_argument("--seed", type=int, default=0, help="of rooms, poses and noise")
    parser.add_argument("--baseline", type=Path, default=BASELINE)
    parser.add_argument(
        "--write", nargs="+", type=Path, default=[], metavar="PAGE", help="make the tables of pages anew"
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("benchmark-results/suite"), help="JSON and figures")
    options = parser.parse_args(arguments)
    if options.only and (options.update_baseline or options.source):
        parser.error("--only with --update-baseline or --from; allowed is it with what measures some workloads")
    if options.list:
        for name, (_, what) in WORKLOADS.items():
            runs = ", ".join(size for size in SIZES if name in SHORT[size])
            print(f"{name:12} {what}{f' ({runs})' if runs else ''}")
        return 0
    try:
        return run(options)
    except SonarError as error:
        SAID.print(str(error))
        return 2


def run(options: argparse.Namespace) -> int:
    """What was asked for."""
    keep_compiled()
    for page in options.write:
        read_bytes(page, what="a page with tables of this suite")
    make_folder(options.output)
    size = "gate" if options.gate or options.update_baseline else "quick" if options.quick else "full"
    chosen, wrong = Options(size, options.seed), []
    if options.source is not None:
        results = Results.load(options.source)
    else:
        names = options.only or list(SHORT[size])
        if options.only is None and size == "full" and _has_gpu():
            names.append("device")
        asked = asdict(chosen) | {"only": options.only}
        if options.gate:
            load_baseline(options.baseline)  # what cannot be read is said before the work
            best, wrong = gate(names, chosen, options.baseline)
            results = Results.of(best.values(), asked)
        elif options.update_baseline:
            results = Results.of(usual([measured(names, chosen) for _ in range(TRIES)]), asked)
        else:
            results = Results.of(measured(names, chosen), asked)
        results.save(options.output / "suite.json")
    if options.update_baseline:
        save_baseline(results, options.baseline)
    PRINTED.print(shown(results))
    if not options.gate:
        from benchmarks import plots

        make_folder(options.output)
        plots.write(results, options.output)
    write_pages(options.write, results)
    if wrong:
        SAID.print(f"worse than {options.baseline}, {TRIES} times:\n" + "\n".join(wrong))
    return 1 if wrong else 0


def _has_gpu() -> bool:
    import jax

    return jax.default_backend() != "cpu"


if __name__ == "__main__":
    sys.exit(main())
