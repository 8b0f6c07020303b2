"""Tune the two baselines on rooms that the accuracy benchmark does not use.

Run ``python -m benchmarks.detection.tune_baselines``.
"""

import argparse
import itertools

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.detection.baselines import TUNING, PairConsensus, PointHough, arcs_of_scans


def main() -> None:
    """Sweep the parameters. Among F1 scores within 0.01 of the best, the smallest errors were chosen."""
    from benchmarks.detection.conditions import Condition
    from benchmarks.detection.methods import DetectionResult
    from benchmarks.detection.scenarios import random_scans
    from benchmarks.detection.scoring import score

    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--rooms", type=int, default=10)
    options = options.parse_args()
    scenes = []
    for cone_deg in (60.0, 120.0):
        for condition in (Condition("", cone_deg=cone_deg), Condition("", 0.005, 0.3, 0.2, cone_deg=cone_deg)):
            scans = random_scans(condition, options.rooms, 2, seed=TUNING)
            scenes.append((condition.sigma, scans.truth, list(arcs_of_scans(scans.ring, scans.log))))
    table = Table(title="cones of 60 and 120 deg; 3 mm, 10 % lost, 2 % false and 5 mm, 30 % lost, 20 % false")
    for column in ("", "recall", "false/scan", "F1", "median |Δρ| (mm)", "median |Δθ| (deg)"):
        table.add_column(column, justify="left" if not column else "right")
    cells = itertools.product((0.01, 0.02), (1, 2, 4), (3.0, 4.0, 5.0, 6.0))
    sweep: dict[str, PointHough | PairConsensus] = {
        f"points: {rho * 1e3:g} mm, {deg} deg, {threshold:g} votes a path": PointHough(
            rho_cell=rho, theta_cell=float(np.radians(deg)), threshold=threshold
        )
        for rho, deg, threshold in cells
    }
    for gate, min_inliers in itertools.product((2.5, 3.0, 4.0), (0.3, 0.4, 0.5, 0.6)):
        sweep[f"pairs: {gate:g} sigma, {min_inliers:.0%} of the paths"] = PairConsensus(
            gate=gate, min_inliers=min_inliers
        )
    for name, method in sweep.items():
        found = [
            score(truth, [DetectionResult.of_lines(method(arcs, sigma)) for arcs in scans])
            for sigma, truth, scans in scenes
        ]
        walls, good, _, false = np.sum([one.counts.sum(axis=0) for one in found], axis=0)
        rho, theta = np.median(np.abs(np.concatenate([one.error for one in found])), axis=0)
        table.add_row(
            name,
            f"{good / walls:.3f}",
            f"{false / sum(len(one.room) for one in found):.2f}",
            f"{2 * good / (good + walls + false):.3f}",
            f"{rho * 1e3:.2f}",
            f"{np.degrees(theta):.2f}",
        )
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
