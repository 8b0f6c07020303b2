"""Figures of the suite."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from benchmarks.markdown_tables import GROWTH
from benchmarks.metrics import Results
from jaxsonar.reports import plot_style

BARS = {
    "throughput.hough:numba": "fused Numba loop, complete",
    "throughput.hough:numba_votes": "fused Numba loop, votes to threshold only",
    "throughput.hough:numpy": "plain NumPy + OpenCV",
    "throughput.hough:pointset": "cv2.HoughLinesPointSet, same cells",
    "throughput.hough:pointset_fine": "cv2.HoughLinesPointSet, 10 mm x 2 deg",
    "throughput.hough:raster": "skimage hough_line, accumulator only",
}
TEXT_BOX = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
"""Background of text, so that no line crosses it."""
STAGE_GROUPS = {"hough": "hough, batch", "ml": "ml, batch", "single": "hough, one scan"}
LINES = {"hough": plot_style.PALETTE[0], "ml": plot_style.PALETTE[1]}


def peers_figure(results: Results) -> Figure:
    """Speed of the batched hough relative to each peer, and the targets."""
    rows = [results.metrics[key] for key in BARS if key in results.metrics]
    with plot_style.figure_style():
        figure = Figure(figsize=(7.6, 0.5 * len(rows) + 1.3), layout="constrained")
        axes = figure.subplots()
        position = np.arange(len(rows))[::-1]
        values = np.array([one.value for one in rows])
        targets = np.array([np.nan if one.target is None else one.target for one in rows])
        axes.barh(position, values, left=0, height=0.55, color=plot_style.PALETTE[0])
        axes.set_xscale("log")
        axes.axvline(1, color=plot_style.WALL_COLOR, lw=1, ls="--")
        axes.plot(targets, position, ls="", marker="|", ms=16, mew=2.5, color=plot_style.PALETTE[5], label="target")
        both = np.append(values, targets[np.isfinite(targets)])
        axes.set_xlim(min(0.5, float(np.nanmin(both)) / 2), float(np.nanmax(both)) * 3)
        label_position = np.fmax(values, np.where(targets > values, np.where(targets < 2.5 * values, targets, 0), 0))
        for y, value, x in zip(position, values, label_position, strict=True):
            axes.annotate(f"{value:.3g} x", (x, y), (6, 0), textcoords="offset points", va="center", bbox=TEXT_BOX)
        axes.set_yticks(position, [BARS[one.key] for one in rows])
        axes.tick_params(axis="y", length=0)
        _plain(axes.xaxis)
        axes.set_xlabel("hough, batch, one core: speed relative to the peer")
        if np.isfinite(targets).any():
            axes.legend(loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.1)
        return figure


def stages_figure(results: Results) -> Figure:
    """Shares of the stages of a batch and of one scan."""
    rows = {name: dict(_shares(results, name)) for name in STAGE_GROUPS}
    rows = {name: shares for name, shares in rows.items() if shares}
    with plot_style.figure_style():
        figure = Figure(figsize=(7.6, 0.95 * len(rows) + 1.0), layout="constrained")
        axes = figure.subplots()
        for y, (_, shares) in enumerate(reversed(rows.items())):
            left, above = 0.0, 0
            for k, (stage, share) in enumerate(shares.items()):
                axes.barh(y, share, left=left, height=0.4, color=plot_style.PALETTE[k % 6], edgecolor="white")
                label = f"{stage} {share:.0f} %"
                wide = share >= 1.3 * len(label)
                if wide:
                    axes.text(left + share / 2, y, label, ha="center", va="center", color="white")
                elif share >= 1:  # beside the bar: above, below, above, ...
                    up = above % 2 == 0
                    axes.text(left, y + (0.24 if up else -0.24), label, ha="left", va="bottom" if up else "top")
                    above += 1
                left += share
        axes.axvline(100, color=plot_style.WALL_COLOR, lw=1, ls="--")
        names = [f"{STAGE_GROUPS[name]}\n{results.value(f'stages.{name}.whole'):,.0f} us per scan" for name in rows]
        axes.set_yticks(range(len(rows)), names[::-1])
        axes.tick_params(axis="y", length=0)
        axes.set_ylim(-0.6, len(rows) - 0.4)
        axes.set_xlabel("stages, each measured alone (% of the whole)")
        return figure


def growth_figure(results: Results) -> Figure:
    """Times over the varied size, log-log, with the exponents."""
    curves = {axis: {m: p for m in LINES if (p := _points(results, axis, m))} for axis in GROWTH}
    curves = {axis: lines for axis, lines in curves.items() if lines}
    across = min(3, max(1, len(curves)))
    down = -(-len(curves) // across)
    with plot_style.figure_style():
        figure = Figure(figsize=(3.1 * across, 2.7 * max(1, down)), layout="constrained")
        grid = figure.subplots(max(1, down), across, squeeze=False).ravel()
        for axes in grid[len(curves) :]:
            axes.set_axis_off()
        for axes, (axis, lines) in zip(grid, curves.items(), strict=False):
            whole = axis == "scans"
            for method, points in lines.items():
                x, y = np.array(points).T
                y = 1e-6 * y * x if whole else y
                slope = results.value(f"growth.{axis}.{method}.exponent")
                label = method if np.isnan(slope) else f"{method}, n$^{{{slope:.2f}}}$"
                axes.plot(x, y, marker="o", ms=4, color=LINES[method], label=label)
            axes.set_xscale("log", base=2)
            axes.set_yscale("log")
            ticks = sorted({point[0] for points in lines.values() for point in points})
            axes.set_xticks(ticks[:: max(1, len(ticks) // 4)])
            low, high = axes.get_ylim()
            axes.set_ylim(low / 1.4, high * 4)  # room for the legend
            _plain(axes.xaxis)
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            _plain(axes.yaxis)
            axes.set_title({"grid": "cells along each side", "scans": "scans"}.get(axis, GROWTH[axis]))
            axes.set_ylabel("s a batch" if whole else "us per scan")
            axes.legend(loc="upper left")
        return figure


def _shares(results: Results, name: str) -> Iterator[tuple[str, float]]:
    for key, metric in results.metrics.items():
        if key.startswith(f"stages.{name}.") and key.endswith(".share"):
            stage = key.removeprefix(f"stages.{name}.").removesuffix(".share")
            if " and " not in stage:  # a sum that contains another stage
                yield stage, metric.value


def _points(results: Results, axis: str, method: str) -> list[tuple[int, float]]:
    head = f"growth.{axis}.{method}@"
    return sorted(
        (int(key.removeprefix(head)), one.value) for key, one in results.metrics.items() if key.startswith(head)
    )


def _plain(axis) -> None:
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def all_of(results: Results) -> dict[str, Figure]:
    """Figures of the measured workloads, by name."""
    figures = {}
    if any(key in results.metrics for key in BARS):
        figures["peers"] = peers_figure(results)
    if any(key.startswith("stages.hough.") for key in results.metrics):
        figures["stages"] = stages_figure(results)
    if any(key.startswith("growth.") for key in results.metrics):
        figures["growth"] = growth_figure(results)
    return figures


def write(
    results: Results, folder: Path, *, prefix: str = "", suffixes: tuple[str, ...] = (".svg", ".png")
) -> list[Path]:
    """Write all figures."""
    filenames = []
    for name, figure in all_of(results).items():
        for suffix in suffixes:
            filenames.append(folder / f"{prefix}{name}{suffix}")
            plot_style.save_figure(figure, filenames[-1])
    return filenames
