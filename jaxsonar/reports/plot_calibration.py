"""The figure of a calibration: offsets, residuals before and after, and the map before and after."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from jaxsonar.calibration.calibration_result import Calibration
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.reports.plot_style import (
    CROSS_COLOR,
    DIRECT_COLOR,
    FAINT_COLOR,
    LINE_COLOR,
    ROBOT_COLOR,
    WALL_COLOR,
    figure_style,
)
from jaxsonar.reports.text import plural

_HISTOGRAM_EDGES = 61
"""Number of edges of the bins of a histogram of residuals. Chosen by hand."""
_HISTOGRAM_SIGMAS = 6.0
"""Half width of the histogram, robust standard deviations. Chosen by hand."""


def calibration_figure(calibration: Calibration) -> Figure:
    """Draw offsets with error bars, residuals before and after, and the map of the first log before and after.

    Args:
        calibration: the result of a calibration.
    """
    with figure_style():
        figure = Figure(figsize=(10.5, 8.2), layout="constrained")
        panels = figure.subplot_mosaic([["offsets", "residuals"], ["before", "after"]], height_ratios=[1, 1.35])
        ring = calibration.ring
        speed = f"{float(ring.speed_of_sound):.2f} m/s"
        if "speed" in calibration.free:
            speed += f" ± {calibration.speed_of_sound_sd:.2f}"
        figure.suptitle(
            f"{ring.name}: {calibration.scans} scans, {len(calibration.residuals)} of {calibration.echoes} echoes; "
            f"speed of sound {speed}",
            x=0.01,
            ha="left",
            fontsize=11,
            parse_math=False,
        )
        _draw_offsets(panels["offsets"], calibration)
        _draw_residuals(panels["residuals"], calibration)
        _draw_map(panels["before"], calibration.maps_before[0], "Map, nominal ring", calibration)
        _draw_map(panels["after"], calibration.maps[0], "Map, calibrated ring", calibration)
        _set_equal_limits(panels["before"], panels["after"], calibration)
    return figure


def _draw_offsets(axes: Axes, calibration: Calibration) -> None:
    ring, nominal = calibration.ring, calibration.nominal
    correction, sd = calibration.effective_correction
    moved = {"position", "radius"} & set(calibration.free)
    values = correction if moved else np.asarray(ring.range_offset) - np.asarray(nominal.range_offset)
    spread = sd if moved else calibration.range_offset_sd
    sensors = np.arange(ring.count)
    axes.axhline(0, color=WALL_COLOR, lw=0.8)
    axes.vlines(sensors, 0, 1e3 * values, color=FAINT_COLOR, lw=3)
    axes.errorbar(sensors, 1e3 * values, 1e3 * spread, fmt="o", color=DIRECT_COLOR, ms=3.5, lw=1, capsize=2)
    quantity = "Effective range correction" if moved else "Range offset against the nominal ring"
    mean = (
        f"; their mean ± {1e3 * calibration.mean_offset_sd:.1f} mm"
        if "mean_offset" not in calibration.held
        else "; mean fixed"
    )
    title = (
        f"{quantity}, ± 1 sigma" if moved else f"{quantity}, ± 1 sigma{mean if 'offset' in calibration.free else ''}"
    )
    axes.set(title=title, xlabel="sensor", ylabel="mm", xlim=(-1, ring.count))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _draw_residuals(axes: Axes, calibration: Calibration) -> None:
    before, after = 1e3 * calibration.residuals_before, 1e3 * calibration.residuals
    limit = _HISTOGRAM_SIGMAS * max(float(np.sqrt(np.median(before**2))), float(np.sqrt(np.median(after**2))), 1e-3)
    edges = np.linspace(-limit, limit, _HISTOGRAM_EDGES)
    for values, color, name in ((before, CROSS_COLOR, "nominal ring"), (after, DIRECT_COLOR, "calibrated ring")):
        rms = float(np.sqrt(np.mean(values**2)))
        axes.hist(
            np.clip(values, -limit, limit),
            edges.tolist(),
            histtype="stepfilled",
            facecolor=(color, 0.35),
            edgecolor=color,
            label=f"{name}: RMS {rms:.2f} mm",
        )
    axes.set(title="Residuals of the ranges", xlabel="reported − expected (mm)", ylabel="echoes", xlim=(-limit, limit))
    axes.legend(loc="upper left", fontsize=8)
    top = axes.get_ylim()[1]
    axes.set_ylim(0, 1.25 * top)


def _draw_map(axes: Axes, world: GlobalMap, title: str, calibration: Calibration) -> None:
    axes.add_collection(LineCollection(list(world.segments), colors=LINE_COLOR, linewidths=2.2, zorder=4))
    if len(world.points):
        axes.plot(*world.points.T, "s", color=ROBOT_COLOR, mfc="white", ms=4, zorder=5)
    pose = calibration.poses[0]
    axes.plot(pose[:, 0], pose[:, 1], ".-", color=WALL_COLOR, ms=3, lw=0.6, zorder=3)
    axes.set(title=f"{title}: {plural(len(world), 'wall')}, {world.length.sum():.1f} m", xlabel="x (m)", ylabel="y (m)")
    handles = [
        Line2D([], [], color=LINE_COLOR, lw=2.2, label="wall"),
        Line2D([], [], color=ROBOT_COLOR, marker="s", mfc="white", ls="", ms=4, label="corner, edge"),
        Line2D([], [], color=WALL_COLOR, marker=".", lw=0.6, label="robot"),
    ]
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3, fontsize=8)
    axes.set_aspect("equal")
    axes.grid(color="#F0F0F0", lw=0.6)
    axes.set_axisbelow(True)


def _set_equal_limits(before: Axes, after: Axes, calibration: Calibration) -> None:
    """Set the same limits for both maps."""
    pose = calibration.poses[0][:, :2]
    parts = [pose[np.isfinite(pose).all(axis=1)]]
    parts += [world.segments.reshape(-1, 2) for world in (calibration.maps_before[0], calibration.maps[0])]
    points = np.concatenate(parts)
    low, high = points.min(axis=0) - 0.2, points.max(axis=0) + 0.2
    for axes in (before, after):
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
