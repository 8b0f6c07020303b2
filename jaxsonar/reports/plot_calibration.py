"""Figures of a calibration: offsets, residuals before and after (over range and angle), the map before and after."""

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from jaxsonar.calibration.calibration_result import Calibration
from jaxsonar.calibration.echo_model import EchoStatistics
from jaxsonar.evaluation.laser_range_fit import LaserRangeFit
from jaxsonar.geometry.robust_statistics import robust_deviation
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
_RANGE_BIN, _ANGLE_BIN = 0.25, 5.0
"""Width of a bin of the range (metres) and of the angle (degrees). Chosen by hand."""
_MIN_IN_BIN = 5
"""Echoes that a bin needs for a median. Chosen by hand."""
_SCATTER_SIGMAS = 4.0
"""Residuals beyond this many robust standard deviations are drawn at the border. Chosen by hand."""


def calibration_figure(calibration: Calibration) -> Figure:
    """Draw offsets with error bars, residuals before and after, and the map of the first log before and after.

    Args:
        calibration: the result of a calibration.
    """
    rows, heights, size = "offsets residuals;before after", [1.0, 1.35], 8.2
    if calibration.run is not None:
        rows, heights, size = "offsets detection;range angle;before after", [1.0, 1.1, 1.35], 11.2
    mosaic = [[*row.split()] for row in rows.split(";")]
    with figure_style():
        figure = Figure(figsize=(10.5, size), layout="constrained")
        panels = figure.subplot_mosaic(mosaic, height_ratios=heights)  # pyright: ignore[reportArgumentType, reportCallIssue]
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
        if calibration.run is None:
            _draw_residuals(panels["residuals"], calibration)
        else:
            run = calibration.run
            _draw_over_range(panels["range"], run.distance, run.before, run.after)
            _draw_over_angle(panels["angle"], run.off_axis, run.before, run.after)
            for name in ("range", "angle"):
                panels[name].set_title(f"Residuals over the {name}, against the walls of the calibrated map")
        if calibration.echo_model is not None:
            _draw_detection(panels["detection"], calibration.echo_model)
        _draw_map(panels["before"], calibration.maps_before[0], "Map, nominal ring", calibration)
        _draw_map(panels["after"], calibration.maps[0], "Map, calibrated ring", calibration)
        _set_equal_limits(panels["before"], panels["after"], calibration)
    return figure


def laser_fit_figure(fit: LaserRangeFit) -> Figure:
    """Draw the residuals against the walls of a laser, over range and angle, before and after the fit.

    Args:
        fit: offset and scale of a ring against a laser.
    """
    before, after = fit.ranges.residual(fit.nominal), fit.ranges.residual(fit.ring)
    with figure_style():
        figure = Figure(figsize=(10.5, 4.2), layout="constrained")
        panels = figure.subplot_mosaic([["range", "angle"]])
        figure.suptitle(
            f"{fit.ring.name} against the laser: {len(before)} echoes; scale {fit.scale:.4f} ± {fit.scale_sd:.4f}, "
            f"mean offset {1e3 * fit.offset:.0f} ± {1e3 * fit.offset_sd:.0f} mm",
            x=0.01,
            ha="left",
            fontsize=11,
            parse_math=False,
        )
        _draw_over_range(panels["range"], fit.ranges.true, before, after)
        _draw_over_angle(panels["angle"], fit.ranges.off_axis, before, after)
    return figure


def _draw_over_range(
    axes: Axes,
    distance: Float[np.ndarray, " echoes"],
    before: Float[np.ndarray, " echoes"],
    after: Float[np.ndarray, " echoes"],
) -> None:
    edges = np.arange(0.0, distance.max(initial=1.0) + _RANGE_BIN, _RANGE_BIN)
    _draw_binned(axes, distance, before, after, edges)
    axes.set(title="Residuals over the range", xlabel="distance of the wall (m)", xlim=(0, edges[-1]))


def _draw_over_angle(
    axes: Axes,
    off_axis: Float[np.ndarray, " echoes"],
    before: Float[np.ndarray, " echoes"],
    after: Float[np.ndarray, " echoes"],
) -> None:
    widest = np.ceil(np.degrees(np.abs(off_axis)).max(initial=5.0) / _ANGLE_BIN) * _ANGLE_BIN
    edges = np.arange(-widest, widest + _ANGLE_BIN / 2, _ANGLE_BIN)
    _draw_binned(axes, np.degrees(off_axis), before, after, edges)
    axes.set(title="Residuals over the angle", xlabel="wall off the axis of the sensor (deg)", xlim=(-widest, widest))


def _draw_binned(
    axes: Axes,
    x: Float[np.ndarray, " echoes"],
    before: Float[np.ndarray, " echoes"],
    after: Float[np.ndarray, " echoes"],
    edges: Float[np.ndarray, " edges"],
) -> None:
    """Residuals and their medians in bins, before and after."""
    limit = _SCATTER_SIGMAS * robust_deviation(before) if len(before) else 0.01
    limit = 1e3 * max(limit, float(np.abs(np.median(before))) + limit / 2) if len(before) else 10.0
    axes.axhline(0, color=WALL_COLOR, lw=0.8)
    for values, color, name in ((before, CROSS_COLOR, "nominal ring"), (after, DIRECT_COLOR, "calibrated ring")):
        shown = np.clip(1e3 * values, -limit, limit)
        axes.plot(x, shown, ".", color=color, alpha=0.35, ms=4, mew=0, rasterized=True)
        bins = np.digitize(x, edges) - 1
        full = [k for k in range(len(edges) - 1) if (bins == k).sum() >= _MIN_IN_BIN]
        center = [float(np.median(x[bins == k])) for k in full]
        middle = [1e3 * float(np.median(values[bins == k])) for k in full]
        spread = 1e3 * robust_deviation(values)
        label = f"{name}: medians; robust sigma {spread:.1f} mm"
        axes.plot(center, middle, "o-", color=color, ms=4, lw=1.4, label=label)
    axes.set(ylabel="reported − expected (mm)", ylim=(-limit, 1.35 * limit))
    axes.legend(loc="upper left", fontsize=8)


def _draw_detection(axes: Axes, model: EchoStatistics) -> None:
    """Share of walls that are heard over the angle, with the number of measurements."""
    edges, share = np.degrees(model.off_axis), model.detection
    axes.bar(
        edges[:-1], np.nan_to_num(share), np.diff(edges), align="edge", color=(DIRECT_COLOR, 0.35), ec=DIRECT_COLOR
    )
    for low, high, value, count in zip(edges, edges[1:], np.nan_to_num(share), model.expected, strict=False):
        axes.text((low + high) / 2, value + 0.02, str(count), ha="center", va="bottom", fontsize=8)
    title = f"Walls heard; noise: core {1e3 * model.core_sd:.1f} mm, tails {model.tail_share:.0%}"
    axes.set(title=title, xlabel="wall off the axis (deg); number of measurements", ylabel="share", ylim=(0, 1.15))


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
