"""The recorded ring of 24 sonars: lines of every scan against the recording's own minima, where walls are square.

Run ``python -m benchmarks.detection.scitos24 FOLDER -o DIR``; FOLDER holds ``sensor_readings_24.data`` and
``sensor_readings_4.csv`` of the UCI wall-following data set. A wall is square to a sensor if that sensor and its two
neighbors read what a plane ahead would make them read, by the raw ranges alone: neighbors equal within 8 mm and
farther by 4 to 16 mm (10 mm is exact for the ring's radius and 15 deg between sensors).
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
from jaxsonar.reports import plot_scan, plot_style
from jaxsonar.scans.convert import read_scans

DIRECTIONS = {"front": (12, 0), "left": (18, 1), "right": (6, 2)}
"""Sensor that looks there, and column of the recording's own minima."""
NEAR_RHO, NEAR_THETA = 0.10, np.radians(12.0)


@dataclass(frozen=True)
class Agreement:
    """Lines against the minima of one direction, in the scans with a square wall there."""

    square: int
    """Scans in which the raw ranges show a wall square to that direction."""
    rho: Float[np.ndarray, " found"]
    """Distance of the line less that minimum and the ring's radius, metres, where a line was found."""
    theta: Float[np.ndarray, " found"]
    """Direction of the line less the sensor's, radians."""


def dense_ranges(log: Log, sensors: int) -> Float[np.ndarray, "scans sensors"]:
    """Direct echoes as a table, NaN = no echo."""
    ranges = np.full((len(log), sensors), np.nan)
    ranges[log.echo_scan, log.tx] = log.range
    return ranges


def square_walls(
    ranges: Float[np.ndarray, "scans sensors"], sensor: int, radius: float, *, farthest: float = 2.5
) -> Bool[np.ndarray, " scans"]:
    """Scans in which a sensor and both neighbors read what a wall square to it would make them read."""
    sensors = ranges.shape[1]
    before, here, after = (ranges[:, (sensor + k) % sensors] for k in (-1, 0, 1))
    expected = radius * (1 - np.cos(2 * np.pi / sensors))
    farther = (before + after) / 2 - here
    close = np.maximum(np.maximum(before, here), after) <= farthest  # NaN is not
    return close & (np.abs(before - after) < 0.008) & (np.abs(farther - expected) < 0.006)


def agreement(
    models: list[LocalModel],
    minima: Float[np.ndarray, " scans"],
    square: Bool[np.ndarray, " scans"],
    direction: float,
    radius: float,
) -> Agreement:
    """Nearest line to each square wall's minimum, within 100 mm and 12 deg."""
    found = []
    for index in np.flatnonzero(square):
        near = [
            (line.rho - radius - minima[index], float(wrap_angle(line.theta - direction)))
            for line in models[index].lines
        ]
        near = [pair for pair in near if abs(pair[0]) < NEAR_RHO and abs(pair[1]) < NEAR_THETA]
        if near:
            found.append(min(near, key=lambda pair: abs(pair[0])))
    rho, theta = np.array(found).reshape(-1, 2).T
    return Agreement(int(square.sum()), rho, theta)


def heard_off_axis(ranges: Float[np.ndarray, "scans sensors"], radius: float) -> dict[int, tuple[float, float]]:
    """How often sensors off the normal of a square wall hear it too, by degrees off the normal.

    Returns:
        Share of readings within 10 mm of what the wall would make them, and within 10 mm of 80 mm more: chance.
    """
    sensors = ranges.shape[1]
    pitch = 360 / sensors
    shares = {}
    for steps in (2, 3):
        off = []
        for sensor in range(sensors):
            mask = square_walls(ranges, sensor, radius)
            expected = ranges[mask, sensor] + radius * (1 - np.cos(np.radians(steps * pitch)))
            off += [ranges[mask, (sensor + side) % sensors] - expected for side in (-steps, steps)]
        off = np.concatenate(off)
        shares[round(steps * pitch)] = (float(np.mean(np.abs(off) < 0.010)), float(np.mean(np.abs(off - 0.08) < 0.010)))
    return shares


def deviation_figure(found: dict[str, Agreement]) -> Figure:
    """Histograms of the lines' distances against the recording's own minima."""
    with plot_style.figure_style():
        figure = Figure(figsize=(8.4, 2.8), layout="constrained")
        for axes, (name, row) in zip(figure.subplots(1, 3, sharex=True), found.items(), strict=True):
            axes.hist(row.rho * 1e3, bins=np.arange(-40, 41, 2), color=plot_style.DIRECT_COLOR)
            axes.axvline(0, color=plot_style.ROBOT_COLOR, lw=0.8)
            axes.set_title(f"{name}: {len(row.rho)} of {row.square} square walls")
            axes.set_xlabel("line less own minimum (mm)")
            axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        figure.axes[0].set_ylabel("scans")
    return figure


def shuffled(log: Log, rng: np.random.Generator) -> Log:
    """Every sensor's readings in another order of scans: as many echoes, no geometry. Lines found here are chance."""
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
    log = read_scans(options.folder, from_="scitos24")
    minima = np.genfromtxt(options.folder / "sensor_readings_4.csv", delimiter=",", usecols=range(3))
    ranges = dense_ranges(log, shipped.count)
    square = {
        name: square_walls(ranges, sensor, radius) & (np.abs(minima[:, column] - ranges[:, sensor]) < 0.02)
        for name, (sensor, column) in DIRECTIONS.items()
    }
    options.output.mkdir(parents=True, exist_ok=True)
    console = Console(width=110)
    for ring in (shipped, replace(shipped, beam=np.radians(15.0))):
        models = list(local_models(ring, log, method="hough"))
        chance = list(local_models(ring, shuffled(log, np.random.default_rng(0)), method="hough"))
        found = {
            name: agreement(models, minima[:, column], square[name], float(ring.heading[sensor]), radius)
            for name, (sensor, column) in DIRECTIONS.items()
        }
        console.print(agreement_table(f"cones of {np.degrees(ring.beam[0]):.0f} deg", found))
        for what, result in {"as recorded": models, "readings shuffled, chance": chance}.items():
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
    for degrees, (share, chance) in heard_off_axis(ranges, radius).items():
        console.print(
            f"a square wall is heard {degrees} deg off its normal in {share:.1%} of the cases; chance {chance:.1%}"
        )


def agreement_table(what: str, found: dict[str, Agreement]) -> Table:
    """Lines less the recording's own minima, a row a direction."""
    table = Table(
        title=what,
        caption=f"lines less the recording's own minima where a wall is square; counted up to {NEAR_RHO * 1e3:.0f} mm "
        f"and {np.degrees(NEAR_THETA):.0f} deg",
    )
    for column in ("", "square walls", "with a line", "median Δρ (mm)", "RMS Δρ (mm)", "RMS Δθ (deg)"):
        table.add_column(column, justify="left" if not column else "right")
    for name, row in found.items():
        table.add_row(
            name,
            str(row.square),
            f"{len(row.rho) / max(row.square, 1):.1%}",
            f"{np.median(row.rho) * 1e3:.1f}",
            f"{np.sqrt(np.mean(row.rho**2)) * 1e3:.1f}",
            f"{np.degrees(np.sqrt(np.mean(row.theta**2))):.2f}",
        )
    return table


if __name__ == "__main__":
    main()
