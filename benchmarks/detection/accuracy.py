"""Accuracy of local models in random rooms, with noise, lost and false echoes, compared with two baselines.

Run ``python -m benchmarks.detection.accuracy [--quick] [-o DIR]``. Each condition is simulated once, and all methods
get the same echoes: those of walls, corners, edges, poles, columns and second order without the lost ones, crosstalk,
and false ones.
Errors are compared with the Cramer-Rao bound (CRB) of all received first-order echoes of a wall, even if a method does
not use them. A wall counts if it has 8 such echoes, another reflector if it has 4. A line matches a wall within 100 mm
and 15 deg, one to one. Standard errors assume independent rooms, not independent scans. Most of the time of a quick run
is compilation; with JAX_COMPILATION_CACHE_DIR set it happens once.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.detection import plots
from benchmarks.detection.bayes_error import bayes_error
from benchmarks.detection.conditions import BASE, CONDITIONS, ISOLATED, THREE_WALLS, Condition
from benchmarks.detection.methods import CLASSIFYING_METHODS, METHODS, Method
from benchmarks.detection.plots import KINDS
from benchmarks.detection.scenarios import (
    POSES,
    RANGES,
    Scans,
    random_scans,
    single_reflectors,
    three_walls,
)
from benchmarks.detection.scoring import (
    CLEAR_REFLECTOR,
    Score,
    answers,
    score,
    worst_of_three,
)
from benchmarks.metrics import environment, without_nan
from jaxsonar.evaluation.settings import SETTINGS as EVALUATION
from jaxsonar.fileio.atomic_files import atomic_write, make_folder
from jaxsonar.reports import plot_style

PAPER = {"rho_mm": 32.3, "theta_deg": 7.41}
"""Largest deviations of three walls from one scan in the paper (section 4)."""


def run(
    conditions: Sequence[Condition],
    isolated: Sequence[Condition],
    methods: dict[str, Method],
    *,
    rooms: int,
    poses: int,
    single: int,
    seed: int,
    progress: Callable[[str], None],
) -> dict[str, Any]:
    """Score all methods: ``conditions``, ``isolated`` reflectors and ``three`` walls, each by condition and method."""

    def scored(scans: Scans, chosen_methods: dict[str, Method], sigma: float) -> dict[str, Score]:
        return {
            name: score(scans.truth, list(method(scans.ring, scans.log, sigma)))
            for name, method in chosen_methods.items()
        }

    found: dict[str, dict[Condition, dict[str, Score]]] = {"conditions": {}, "isolated": {}, "three": {}}
    for k, condition in enumerate(conditions):
        progress(f"{k + 1} of {len(conditions)}: {condition.name}")
        found["conditions"][condition] = scored(random_scans(condition, rooms, poses, seed), methods, condition.sigma)
    for condition in isolated:
        progress(condition.name)
        chosen_methods = {name: method for name, method in methods.items() if name in CLASSIFYING_METHODS}
        parts = [scored(scans, chosen_methods, condition.sigma) for scans in single_scans(condition, single, seed)]
        found["isolated"][condition] = {
            name: replace(parts[0][name], confusion=np.sum([part[name].confusion for part in parts], axis=0))
            for name in chosen_methods
        }
    progress(THREE_WALLS.name)
    found["three"][THREE_WALLS] = scored(three_walls(THREE_WALLS, single, seed), methods, THREE_WALLS.sigma)
    return found


def single_scans(condition: Condition, count: int, seed: int) -> list[Scans]:
    """Scans with one reflector, the same number of each kind."""
    return [single_reflectors(condition, kind, count, seed) for kind in KINDS]


def summary(found: dict[str, Any], settings: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """All measures by condition and method, as in the JSON file."""
    measures_of: dict[str, Callable[[Score], dict[str, Any]]] = {
        "conditions": lambda one: one.measures() | {"confusion": one.confusion.tolist()},
        "isolated": lambda one: answers(one.confusion) | {"confusion": one.confusion.tolist()},
        "three": worst_of_three,
    }
    content = {
        part: [
            asdict(condition) | {"methods": {name: measures_of[part](one) for name, one in scores.items()}}
            for condition, scores in found[part].items()
        ]
        for part in measures_of
    }
    for row, condition in zip(content["isolated"], found["isolated"], strict=True):
        row["bayes_error"] = bayes_error(single_scans(condition, settings["single"], settings["seed"]), condition.sigma)
    return content


def figures_of(found: dict[str, dict[Condition, dict[str, Score]]]) -> dict[str, Any]:
    """The four figures by file name."""
    measured = {condition: {m: s.measures() for m, s in row.items()} for condition, row in found["conditions"].items()}

    def varied(field: str, start: Condition) -> plots.Series:
        """The conditions that differ from ``start`` in one field only: values of the field, measures of the methods."""
        others = [c for c in measured if replace(c, name="", quick=False, **{field: getattr(start, field)}) == start]
        return {getattr(c, field): measured[c] for c in sorted(others, key=lambda c: getattr(c, field))}

    base = replace(BASE, name="", quick=False)
    clean = replace(base, lost=0.0, false=0.0)
    chosen = found["conditions"][BASE]
    return {
        "crb": plots.crb_figure(
            {"10 % lost, 2 % false": varied("sigma", base), "none lost or false": varied("sigma", clean)}
        ),
        "robustness": plots.robustness_figure(
            {"echoes lost (%)": varied("lost", base), "false echoes for each 100 true": varied("false", base)}
        ),
        "confusion": plots.confusion_figure({m: one.confusion for m, one in chosen.items()}),
        "nees": plots.nees_figure({m: one.nees for m, one in chosen.items()}),
    }


def write(found: dict[str, Any], output: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Write accuracy.json and the figures into a folder; returns the content of the file."""
    make_folder(output)
    counts = {"clear_echoes": EVALUATION.lines.min_echoes, "clear_reflector": CLEAR_REFLECTOR, "ranges_m": RANGES}
    content = {"versions": environment(), "settings": settings | counts, "paper": PAPER, **summary(found, settings)}
    with atomic_write(output / "accuracy.json") as file:
        json.dump(without_nan(content), file, indent=1, allow_nan=False)
    for name, figure in figures_of(found).items():
        for suffix in ("svg", "png"):
            plot_style.save_figure(figure, output / f"{name}.{suffix}")
    return content


def main() -> None:
    """Measure, write, print."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--quick", action="store_true", help="few rooms and conditions, about a minute")
    options.add_argument("--seed", type=int, default=0, help="seed of rooms, poses and noise")
    options.add_argument("--rooms", type=int, help="number of random rooms (default: 64, with --quick 12)")
    options.add_argument("-o", "--output", type=Path, default=Path("benchmark-results/accuracy"))
    options = options.parse_args()
    rooms = options.rooms or (12 if options.quick else 64)
    settings = {"seed": options.seed, "rooms": rooms, "poses": POSES, "single": 48 if options.quick else 768}
    conditions, isolated = (
        [c for c in chosen_methods if c.quick or not options.quick] for chosen_methods in (CONDITIONS, ISOLATED)
    )
    stderr = Console(stderr=True)
    found = run(conditions, isolated, METHODS, **settings, progress=lambda what: stderr.print(what, highlight=False))
    content = write(found, options.output, settings)
    stdout = Console(width=170)
    for table in plots.tables(content):
        stdout.print(table)


if __name__ == "__main__":
    main()
