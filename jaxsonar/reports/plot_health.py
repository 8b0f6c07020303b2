"""The figure of a health check: residuals, detection rate, detection cones, and the faulty sensors."""

import textwrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Wedge
from matplotlib.ticker import MaxNLocator, MultipleLocator

from jaxsonar.diagnostics.beam_width import detection_probability
from jaxsonar.diagnostics.health_report import Health
from jaxsonar.reports.plot_style import (
    CROSS_COLOR,
    DIRECT_COLOR,
    FAINT_COLOR,
    LINE_COLOR,
    PALETTE,
    ROBOT_COLOR,
    figure_style,
)

_MAX_LINES = 7
"""Maximum number of text lines for findings; more do not fit into the panel."""


def health_figure(health: Health) -> Figure:
    """Draw residuals and detection rate of each sensor, detection probability by off-axis angle, ring, and findings."""
    with figure_style():
        figure = Figure(figsize=(11.0, 8.2), layout="constrained")
        grid = figure.add_gridspec(3, 2, width_ratios=(1.75, 1), height_ratios=(1, 1, 0.42))
        residuals, ring = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
        rate, beam_pattern = figure.add_subplot(grid[1, 0], sharex=residuals), figure.add_subplot(grid[1, 1])
        text = figure.add_subplot(grid[2, :])
        _draw_residuals(residuals, health)
        _draw_detection_rate(rate, health)
        _draw_beam_pattern(beam_pattern, health)
        _draw_ring(ring, health)
        _write_findings(text, health)
        walls = "observations of walls by the poses" if health.source == "poses" else "walls from single scans"
        figure.suptitle(
            f"{health.ring.name}: {health.scans} scans, {health.walls} {walls}", x=0.01, ha="left", parse_math=False
        )
    return figure


def _draw_residuals(axes: Axes, health: Health) -> None:
    axes.set_title("Residuals of direct echoes against walls from the other echoes")
    has_median = np.flatnonzero(np.isfinite(health.median))
    low, first, third, high = 1e3 * health.quartiles[has_median].T
    axes.axhline(0, color=FAINT_COLOR, lw=1, zorder=0)
    axes.vlines(has_median, low, high, color=DIRECT_COLOR, lw=1, alpha=0.5)
    axes.vlines(has_median, first, third, color=DIRECT_COLOR, lw=5, alpha=0.5)
    axes.plot(has_median, 1e3 * health.median[has_median], "_", color=DIRECT_COLOR, ms=9, mew=2)
    has_offset = np.flatnonzero(np.isfinite(health.offset))
    axes.errorbar(
        has_offset + 0.3,
        1e3 * health.offset[has_offset],
        1e3 * health.offset_error[has_offset],
        fmt="o",
        color=ROBOT_COLOR,
        ms=3,
        lw=1,
        capsize=2,
    )
    faulty = np.flatnonzero(["offset" in remark for remark in health.remarks])
    axes.plot(faulty + 0.3, 1e3 * health.offset[faulty], "o", color=LINE_COLOR, ms=6)
    axes.set_ylabel("reported – expected (mm)")
    axes.set_xlim(-0.7, health.ring.count - 0.1)
    axes.tick_params(labelbottom=False)
    handles = [
        Line2D([], [], color=DIRECT_COLOR, marker="_", ls="", ms=9, mew=2, label="median, quartiles, 5–95 %"),
        Line2D([], [], color=ROBOT_COLOR, marker="o", ms=3, lw=1, label="offset ± standard error"),
    ]
    if len(faulty):
        handles.append(Line2D([], [], color=LINE_COLOR, marker="o", ls="", label="finding"))
    if len(has_median):
        reach = 1e3 * (np.abs(health.offset) + np.nan_to_num(health.offset_error))[has_offset]
        limit = max(1.0, float(np.abs([low, high]).max()), float(np.max(reach, initial=0.0)))
        axes.set_ylim(-1.1 * limit, 1.6 * limit)  # the legend is above all bars
        _mark_blanks(axes, np.setdiff1d(np.arange(health.ring.count), [*has_median, *has_offset]), 0.0)
        axes.legend(handles=handles, loc="upper right", ncols=3, fontsize=8)
    else:
        _write_no_data(axes)


def _draw_detection_rate(axes: Axes, health: Health) -> None:
    axes.set_title("Detection rate")
    columns = (
        (DIRECT_COLOR, "direct echoes", -0.27, health.expected[:, 0], health.heard[:, 0]),
        (CROSS_COLOR, "cross, as transmitter", 0.0, health.expected[:, 1], health.heard[:, 1]),
        (PALETTE[2], "cross, as receiver", 0.27, health.expected[:, 2], health.heard[:, 2]),
    )
    drawn = [column for column in columns if column[3].any()]
    width = 0.27 if len(drawn) > 1 else 0.6
    for color, label, shift, expected, detected in drawn:
        sensors = np.flatnonzero(expected)
        height = 100 * detected[sensors] / expected[sensors]
        axes.bar(sensors + (shift if len(drawn) > 1 else 0), height, width * 0.9, color=color, label=label)
    axes.set_ylim(0, 125)
    axes.set_yticks(range(0, 101, 25))
    axes.set_ylabel("detected (%)")
    axes.set_xlabel("sensor")
    axes.xaxis.set_major_locator(MaxNLocator(24, integer=True))
    for k, remark in enumerate(health.remarks):
        if remark:
            axes.axvspan(k - 0.5, k + 0.5, color=LINE_COLOR, alpha=0.12, lw=0)
    if drawn:
        expected = np.sum([column[3] for column in drawn], axis=0)
        _mark_blanks(axes, np.flatnonzero(expected == 0), 3.0)
        axes.legend(loc="upper right", ncols=3, fontsize=8)
    else:
        _write_no_data(axes)


def _draw_beam_pattern(axes: Axes, health: Health) -> None:
    width, error = np.degrees(health.beam)
    nominal = np.degrees(health.nominal)
    measured = "not enough data" if np.isnan(width) else f"{width:.1f} ± {error:.1f}° wide, nominal {nominal:.0f}°"
    axes.set_title(f"Cones: {measured}")
    edges = np.linspace(-90, 90, len(health.asked) + 1)
    middle = (edges[1:] + edges[:-1]) / 2
    enough = health.asked >= 3
    rate = 100 * health.answered / np.maximum(health.asked, 1)
    size = np.clip(4 * np.sqrt(health.asked / max(1, health.asked.max())), 1.5, None) ** 2
    axes.scatter(middle[enough], rate[enough], size[enough] * 1.6, color=DIRECT_COLOR, label="detected walls, by angle")
    if np.isfinite(width):
        angles = np.linspace(-90, 90, 721)
        axes.plot(
            angles,
            100 * detection_probability(health.curve, np.radians(angles)),
            color=LINE_COLOR,
            lw=1.4,
            label="fitted",
        )
    for side in (-1, 1):
        label = "nominal border" if side == 1 else None
        axes.plot([side * nominal / 2] * 2, [0, 100], color=ROBOT_COLOR, lw=1, ls=(0, (4, 3)), label=label)
    axes.set_xlim(-90, 90)
    axes.set_ylim(0, 135)
    axes.xaxis.set_major_locator(MultipleLocator(30))
    axes.set_yticks(range(0, 101, 25))
    axes.set_xlabel("off-axis angle (deg)")
    axes.set_ylabel("detected (%)")
    axes.legend(loc="upper center", ncols=2, fontsize=8)


def _draw_ring(axes: Axes, health: Health) -> None:
    ring = health.ring
    position, heading = np.asarray(ring.position, np.float64), np.asarray(ring.heading, np.float64)
    axes.set_title("The ring; sensors with a finding in red")
    extent = max(0.1, float(np.abs(position).max()))
    for (x, y), direction, beam in zip(position, np.degrees(heading), np.degrees(np.asarray(ring.beam)), strict=True):
        axes.add_patch(
            Wedge(
                (x, y), 0.45 * extent, direction - beam / 2, direction + beam / 2, color=FAINT_COLOR, alpha=0.25, lw=0
            )
        )
    faulty = np.array([bool(remark) for remark in health.remarks])
    axes.plot(*position[~faulty].T, "o", color=ROBOT_COLOR, ms=4)
    axes.plot(*position[faulty].T, "o", color=LINE_COLOR, ms=8)
    inward = position - 0.16 * extent * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    for k, (x, y) in enumerate(inward):
        weight, color = ("bold", LINE_COLOR) if faulty[k] else ("normal", ROBOT_COLOR)
        axes.text(x, y, str(k), ha="center", va="center", fontsize=7, color=color, fontweight=weight)
    axes.annotate(
        "",
        xy=(0.35 * extent, 0),
        xytext=(0, 0),
        arrowprops={"arrowstyle": "-|>", "color": ROBOT_COLOR},
        annotation_clip=False,
    )
    axes.set_aspect("equal")
    axes.set_xlim(-1.5 * extent, 1.5 * extent)
    axes.set_ylim(-1.5 * extent, 1.5 * extent)
    axes.set_xlabel("x (m), forward")
    axes.set_ylabel("y (m), left")


def _write_findings(axes: Axes, health: Health) -> None:
    """Write the findings, as many as fit."""
    axes.axis("off")
    findings = [finding.sentence for finding in health.findings] or ["no findings" if health.source else ""]
    if health.empty:
        findings.insert(0, f"sensors are not compared with walls: {health.empty}")
    if health.unmeasured:
        findings.append(f"not measured: {', '.join(health.unmeasured)}")
    if health.source == "poses":
        findings.append("walls by the poses of the log: residuals include errors of the poses")
    lines = [line for text in findings if text for line in textwrap.wrap(f"• {text}", 150, subsequent_indent="   ")]
    if len(lines) > _MAX_LINES:
        lines = [*lines[: _MAX_LINES - 1], f"… and more: {len(health.findings)} findings in all"]
    color = LINE_COLOR if health.findings else ROBOT_COLOR
    axes.text(0, 1, "\n".join(lines), va="top", fontsize=9, color=color, parse_math=False, transform=axes.transAxes)


def _mark_blanks(axes: Axes, sensors: np.ndarray, height: float) -> None:
    """Write for each sensor without data that it has none."""
    for k in sensors:
        vertical = "bottom" if height else "center"
        axes.text(k, height, "no data", rotation=90, ha="center", va=vertical, fontsize=6.5, color=ROBOT_COLOR)


def _write_no_data(axes: Axes) -> None:
    axes.text(0.5, 0.5, "not enough data", transform=axes.transAxes, ha="center", va="center", color=ROBOT_COLOR)
