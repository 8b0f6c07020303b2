"""Sweep of the detection threshold: recall, false lines and deviations in random rooms; origin of the default.

Run ``python -m benchmarks.detection.threshold_sweep``. The rooms are not those of the demo (other seeds). Range noise
3 mm.
"""

import argparse
from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.table import Table

from jaxsonar import Ring, local_models, random_pose, random_room, simulate
from jaxsonar.detection.settings import hough_settings
from jaxsonar.evaluation.line_accuracy import line_accuracy, pool

SIGMA = 0.003
"""Range noise, metres."""


def main() -> None:
    """Sweep and print."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--rooms", type=int, default=60)
    options = options.parse_args()
    ring = Ring.circular()
    scenes = []
    for k in range(options.rooms):
        rng = np.random.default_rng(1000 + k)
        room = random_room(rng)
        poses = np.stack([random_pose(rng, room) for _ in range(5)])
        scenes.append((room, poses, simulate(ring, room, poses, sigma=SIGMA, seed=k)))
    table = Table(title=f"{5 * options.rooms} random poses, sigma = {SIGMA * 1e3:g} mm")
    for column in ("threshold", "recall", "false/scan", "RMS Δρ (mm)", "RMS Δθ (deg)"):
        table.add_column(column, justify="right")
    for threshold in (0.10, 0.15, 0.20, 0.25, 0.30, 0.40):
        settings = replace(hough_settings(ring, None), threshold=threshold)
        row = pool(
            [
                line_accuracy(
                    ring,
                    list(local_models(ring, simulation.as_log(ring, poses), method="hough", settings=settings)),
                    simulation,
                    room,
                    poses,
                    sigma=SIGMA,
                )
                for room, poses, simulation in scenes
            ]
        )
        table.add_row(
            f"{threshold:.2f}",
            f"{row.recall:.3f}",
            f"{row.false_per_scan:.2f}",
            f"{np.sqrt(np.mean(row.rho_error**2)) * 1e3:.1f}",
            f"{np.degrees(np.sqrt(np.mean(row.theta_error**2))):.2f}",
        )
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
