"""The figure of what a ring can observe: bounds and error rates over distance."""

import math
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Wedge
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from jaxsonar.observability.reflectors import NAME_OF_KIND, THREE_KINDS
from jaxsonar.observability.ring_bounds import DistanceBounds, RingBounds
from jaxsonar.reports.plot_style import DIRECT_COLOR, FAINT_COLOR, LINE_COLOR, PALETTE, ROBOT_COLOR, figure_style
from jaxsonar.sensors.ring import Ring

_KIND_COLORS = dict(zip((NAME_OF_KIND[kind] for kind in THREE_KINDS), PALETTE, strict=False))
_MAX_RADIUS_SD = 10.0
"""Bounds of a radius above this are not drawn, metres: nothing is known then."""


def observability_figure(ring: Ring, bounds: RingBounds) -> Figure:
    """Draw the array, and over the distance of a surface: bounds, error rates of the kinds, and numbers of echoes."""
    with figure_style():
        figure = Figure(figsize=(11.5, 6.8), layout="constrained")
        axes = figure.subplots(2, 3)
        _draw_array(axes[0, 0], ring, bounds)
        _draw_kinds(axes[0, 1], bounds, lambda row, kind: 1e3 * row.range_sd[kind])
        axes[0, 1].set_title("Bound of the distance (mm)")
        _draw_kinds(axes[0, 2], bounds, lambda row, kind: math.degrees(row.bearing_sd[kind]))
        axes[0, 2].set_title("Bound of the direction (deg)")
        _draw_radii(axes[1, 0], bounds)
        _draw_errors(axes[1, 1], bounds)
        _draw_kinds(axes[1, 2], bounds, lambda row, kind: row.echoes[kind])
        axes[1, 2].set_title("Echoes")
        for one in axes.ravel()[1:]:
            one.set_xlabel("distance of the surface from the array's center (m)")
            one.grid(color="#F0F0F0", lw=0.6)
            one.set_axisbelow(True)
            one.set_xlim(0, 1.05 * bounds.scan[-1].distance)
        for one in (axes[0, 1], axes[0, 2], axes[1, 0]):
            _use_log_scale(one)
        axes[1, 2].set_ylim(bottom=0)
        figure.legend(handles=_handles(), loc="outside lower center", ncols=6)
        figure.suptitle(
            f"{ring.name}: what can be observed, range noise sigma = {1e3 * bounds.sigma:g} mm",
            x=0.01,
            ha="left",
            parse_math=False,
        )
    return figure


def _handles() -> list[Line2D]:
    kinds = [Line2D([], [], color=color, lw=2, label=_label(kind)) for kind, color in _KIND_COLORS.items()]
    return [
        *kinds,
        Line2D([], [], color=ROBOT_COLOR, ls="-", marker="o", ms=3, label="one scan"),
        Line2D([], [], color=ROBOT_COLOR, ls="--", marker="o", ms=3, mfc="white", label="one shot"),
    ]


def _label(kind: str) -> str:
    return "wall" if kind == "plane" else kind


def _draw_array(axes: Axes, ring: Ring, bounds: RingBounds) -> None:
    axes.set_title(f"Array; sensor {bounds.transmitter} fires the one shot")
    position, heading, beam = (np.asarray(one, np.float64) for one in (ring.position, ring.heading, ring.beam))
    size = float(max(np.ptp(position, axis=0).max(), 0.1))
    for k, (place, axis, width) in enumerate(zip(position, np.degrees(heading), np.degrees(beam), strict=True)):
        chosen = k == bounds.transmitter
        cone = Wedge(
            tuple(place), 0.35 * size, axis - width / 2, axis + width / 2,
            color=DIRECT_COLOR if chosen else FAINT_COLOR, alpha=0.6 if chosen else 0.35, lw=0, zorder=1 + chosen,
        )  # fmt: skip
        axes.add_patch(cone)
    axes.plot(*position.T, "o", color=ROBOT_COLOR, ms=3, zorder=4)
    center = position.mean(axis=0)
    end = center + 0.95 * size * np.array([np.cos(bounds.bearing), np.sin(bounds.bearing)])
    axes.update_datalim([end])
    axes.annotate(
        "", xy=tuple(end), xytext=tuple(center), arrowprops={"arrowstyle": "-|>", "color": LINE_COLOR}, zorder=5
    )
    axes.annotate("surface", tuple(end), (0, 6), textcoords="offset points", color=LINE_COLOR, fontsize=8, ha="right")
    axes.set_aspect("equal")
    axes.margins(0.08)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.yaxis.set_major_locator(MaxNLocator(6))
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")


def _draw(
    axes: Axes, rows: Sequence[DistanceBounds], values: Sequence[float], color: str, *, scan: bool, width: float = 1.5
) -> None:
    """One curve; values that are not finite are left out."""
    known = [(row.distance, value) for row, value in zip(rows, values, strict=True) if math.isfinite(value)]
    if known:
        axes.plot(*np.transpose(known), "-" if scan else "--", color=color, marker="o", ms=3, lw=width,
                  mfc=color if scan else "white")  # fmt: skip


def _draw_kinds(axes: Axes, bounds: RingBounds, value: Callable[[DistanceBounds, str], float]) -> None:
    for width, (kind, color) in zip((2.6, 1.8, 1.1), _KIND_COLORS.items(), strict=True):  # curves may coincide
        for rows in (bounds.shot, bounds.scan):
            _draw(axes, rows, [value(row, kind) for row in rows], color, scan=rows is bounds.scan, width=width)


def _draw_radii(axes: Axes, bounds: RingBounds) -> None:
    axes.set_title("Bound of the radius of a circle (mm)")
    handles = []
    for color, radius in zip(PALETTE[3:], bounds.scan[0].radius_sd, strict=False):
        for rows in (bounds.shot, bounds.scan):
            values = [row.radius_sd[radius] for row in rows]
            values = [1e3 * value if value < _MAX_RADIUS_SD else math.inf for value in values]
            _draw(axes, rows, values, color, scan=rows is bounds.scan)
        axes.axhline(1e3 * radius, color=color, lw=0.8, ls=":")
        handles.append(Line2D([], [], color=color, lw=2, label=f"radius {radius:g} m"))
    handles.append(Line2D([], [], color=ROBOT_COLOR, lw=0.8, ls=":", label="as large as the radius"))
    axes.legend(handles=handles, fontsize=8, frameon=True, edgecolor="none", framealpha=0.85)


def _draw_errors(axes: Axes, bounds: RingBounds) -> None:
    axes.set_title("Wrong kind (%)")
    for color, name in ((LINE_COLOR, "three_kinds_error"), (PALETTE[4], "four_kinds_error")):
        for rows in (bounds.shot, bounds.scan):
            _draw(axes, rows, [100 * getattr(row, name) for row in rows], color, scan=rows is bounds.scan)
    axes.axhline(100 * 2 / 3, color=LINE_COLOR, lw=0.8, ls=":")
    axes.axhline(75, color=PALETTE[4], lw=0.8, ls=":")
    axes.set_ylim(-2, 108)
    axes.set_yticks(range(0, 101, 20))
    handles = [
        Line2D([], [], color=LINE_COLOR, lw=2, label="wall, corner, edge"),
        Line2D([], [], color=PALETTE[4], lw=2, label="and circle"),
        Line2D([], [], color=ROBOT_COLOR, lw=0.8, ls=":", label="guessing"),
    ]
    axes.legend(handles=handles, fontsize=7, ncols=3, loc="upper right", columnspacing=1.0, handlelength=1.5)


def _use_log_scale(axes: Axes) -> None:
    """A logarithmic scale with plain numbers, if there is a curve."""
    if axes.lines:
        axes.set_yscale("log")
        span = axes.get_ylim()[1] / axes.get_ylim()[0]
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0, 7.0) if span < 10 else (1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
