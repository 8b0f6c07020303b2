"""Lines on the recording scitos24, compared with the front, left and right distances that the recording contains.

Run ``python -m benchmarks.detection.scitos24 FOLDER -o DIR``; FOLDER holds ``sensor_readings_24.data`` and
``sensor_readings_4.csv`` of the UCI wall-following data set. A wall is perpendicular to a sensor's axis if the raw
ranges of the sensor and its two neighbors fit a plane ahead: the neighbors are equal within 8 mm and 4 to 16 mm farther
(10 mm is exact for the ring's radius and 15 deg between sensors).
"""

import argparse
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from rich.console import Console
from rich.table import Table

from jaxsonar import LocalModel, Log, load_ring, local_models
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.recordings.input_options import InputOptions
from jaxsonar.recordings.load_log import load_log
from jaxsonar.reports import plot_scan, plot_style

DIRECTIONS = {"front": (12, 0), "left": (18, 1), "right": (6, 2)}
"""Sensor of each direction, and column of the recorded minima."""
NEAR_RHO, NEAR_THETA = 0.10, np.radians(12.0)
"""Gates of a matching line, metres and radians."""


@dataclass(frozen=True)
class Agreement:
    """Lines compared with the minima of one direction, in the scans with a perpendicular wall."""

    perpendicular: int
    """Number of scans in which the raw ranges show a perpendicular wall."""
    rho: Float[np.ndarray, " found"]
    """Distance of the line minus the recorded minimum and the ring's radius, metres, where a line was found."""
    theta: Float[np.ndarray, " found"]
    """Direction of the line minus that of the sensor, radians."""


def dense_ranges(log: Log, sensors: int) -> Float[np.ndarray, "scans sensors"]:
    """Ranges of direct echoes; NaN = no echo."""
    ranges = np.full((len(log), sensors), np.nan)
    ranges[log.echo_scan, log.tx] = log.range
    return ranges


def perpendicular_walls(
    ranges: Float[np.ndarray, "scans sensors"], sensor: int, radius: float, *, farthest: float = 2.5
) -> Bool[np.ndarray, " scans"]:
    """Scans in which the ranges of a sensor and its two neighbors fit a wall perpendicular to the sensor's axis."""
    sensors = ranges.shape[1]
    before, here, after = (ranges[:, (sensor + k) % sensors] for k in (-1, 0, 1))
    expected = radius * (1 - np.cos(2 * np.pi / sensors))
    farther = (before + after) / 2 - here
    close = np.maximum(np.maximum(before, here), after) <= farthest  # False for NaN
    return close & (np.abs(before - after) < 0.008) & (np.abs(farther - expected) < 0.006)


def agreement(
    models: list[LocalModel],
    minima: Float[np.ndarray, " scans"],
    perpendicular: Bool[np.ndarray, " scans"],
    direction: float,
    radius: float,
) -> Agreement:
    """The line nearest to the recorded minimum of each perpendicular wall, within the gates."""
    found = []
    for index in np.flatnonzero(perpendicular):
        near = [
            (line.rho - radius - minima[index], float(wrap_angle(line.theta - direction)))
            for line in models[index].lines
        ]
        near = [pair for pair in near if abs(pair[0]) < NEAR_RHO and abs(pair[1]) < NEAR_THETA]
        if near:
            found.append(min(near, key=lambda pair: abs(pair[0])))
    rho, theta = np.array(found).reshape(-1, 2).T
    return Agreement(int(perpendicular.sum()), rho, theta)


def detection_rate_off_axis(
    ranges: Float[np.ndarray, "scans sensors"], radius: float
) -> dict[int, tuple[float, float]]:
    """How often sensors off the normal of a perpendicular wall receive it, by angle off the normal in degrees.

    Returns:
        Share of readings within 10 mm of the expected range, and within 10 mm of 80 mm more (chance).
    """
    sensors = ranges.shape[1]
    pitch = 360 / sensors
    shares = {}
    for steps in (2, 3):
        off = []
        for sensor in range(sensors):
            mask = perpendicular_walls(ranges, sensor, radius)
            expected = ranges[mask, sensor] + radius * (1 - np.cos(np.radians(steps * pitch)))
            off += [ranges[mask, (sensor + side) % sensors] - expected for side in (-steps, steps)]
        off = np.concatenate(off)
        shares[round(steps * pitch)] = (float(np.mean(np.abs(off) < 0.010)), float(np.mean(np.abs(off - 0.08) < 0.010)))
    return shares


def deviation_figure(found: dict[str, Agreement]) -> Figure:
    """Histograms of the differences between lines and recorded minima."""
    with plot_style.figure_style():
        figure = Figure(figsize=(8.4, 2.8), layout="constrained")
        for axes, (name, row) in zip(figure.subplots(1, 3, sharex=True), found.items(), strict=True):
            axes.hist(row.rho * 1e3, bins=np.arange(-40, 41, 2), color=plot_style.DIRECT_COLOR)
            axes.axvline(0, color=plot_style.ROBOT_COLOR, lw=0.8)
            axes.set_title(f"{name}: {len(row.rho)} of {row.perpendicular} perpendicular walls")
            axes.set_xlabel("line minus recorded minimum (mm)")
            axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        figure.axes[0].set_ylabel("scans")
    return figure


def shuffled(log: Log, rng: np.random.Generator) -> Log:
    """Permute the scans of each sensor: as many echoes, but without geometry. Lines found here are due to chance."""
    echo_scan = log.echo_scan.copy()
    for sensor in np.unique(log.tx):
        mine = log.tx == sensor
        echo_scan[mine] = rng.permutation(len(log))[echo_scan[mine]]
    order = np.argsort(echo_scan, kind="stable")
    return Log.from_echoes(
        echo_scan[order], log.tx[order], log.rx[order], log.range[order], stamp=log.stamp, pose=log.pose
    )


def main() -> None:
    """Measure, print, draw."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("folder", type=Path)
    options.add_argument("-o", "--output", type=Path, default=Path("scitos24"))
    options = options.parse_args()
    shipped = load_ring("scitos24")
    radius = float(np.linalg.norm(shipped.position[0]))
    log = load_log(options.folder, options=InputOptions(format="scitos24"))
    minima = np.genfromtxt(options.folder / "sensor_readings_4.csv", delimiter=",", usecols=range(3))
    ranges = dense_ranges(log, shipped.count)
    perpendicular = {
        name: perpendicular_walls(ranges, sensor, radius) & (np.abs(minima[:, column] - ranges[:, sensor]) < 0.02)
        for name, (sensor, column) in DIRECTIONS.items()
    }
    options.output.mkdir(parents=True, exist_ok=True)
    console = Console(width=110)
    for ring in (shipped, replace(shipped, beam=np.radians(15.0))):
        models = list(local_models(ring, log, method="hough"))
        chance = list(local_models(ring, shuffled(log, np.random.default_rng(0)), method="hough"))
        found = {
            name: agreement(models, minima[:, column], perpendicular[name], float(ring.heading[sensor]), radius)
            for name, (sensor, column) in DIRECTIONS.items()
        }
        console.print(agreement_table(f"cones of {np.degrees(ring.beam[0]):.0f} deg", found))
        for what, result in {"as recorded": models, "readings shuffled": chance}.items():
            scans = np.mean([bool(model.lines) for model in result])
            lines = np.mean([len(model.lines) for model in result])
            reasons = Counter(model.empty for model in result if model.empty)
            why = "".join(f"; {count} scans: {reason}" for reason, count in reasons.most_common())
            console.print(f"{what}: {scans:.1%} of {len(log)} scans with lines, {lines:.2f} lines a scan{why}")
        if ring is shipped:
            plot_style.save_figure(deviation_figure(found), options.output / "deviations.svg")
            plot_style.save_figure(deviation_figure(found), options.output / "deviations.png")
            best = max(range(len(models)), key=lambda k: sum(line.echoes for line in models[k].lines[:3]))
            for suffix in ("svg", "png"):
                figure = plot_scan.lines_figure(ring, log[best], models[best])
                plot_style.save_figure(figure, options.output / f"lines.{suffix}")
    for degrees, (share, chance) in detection_rate_off_axis(ranges, radius).items():
        console.print(
            f"sensors {degrees} deg off the normal receive a perpendicular wall in {share:.1%} of the cases; "
            f"by chance {chance:.1%}"
        )


def agreement_table(what: str, found: dict[str, Agreement]) -> Table:
    """Table of the differences between lines and recorded minima, one row per direction."""
    table = Table(
        title=what,
        caption=f"lines minus recorded minima where a wall is perpendicular, within {NEAR_RHO * 1e3:.0f} mm "
        f"and {np.degrees(NEAR_THETA):.0f} deg",
    )
    for column in ("", "perpendicular walls", "with a line", "median Δρ (mm)", "RMS Δρ (mm)", "RMS Δθ (deg)"):
        table.add_column(column, justify="left" if not column else "right")
    for name, row in found.items():
        table.add_row(
            name,
            str(row.perpendicular),
            f"{len(row.rho) / max(row.perpendicular, 1):.1%}",
            f"{np.median(row.rho) * 1e3:.1f}",
            f"{np.sqrt(np.mean(row.rho**2)) * 1e3:.1f}",
            f"{np.degrees(np.sqrt(np.mean(row.theta**2))):.2f}",
        )
    return table


if __name__ == "__main__":
    main()
