"""Figures of occupancy grids: one grid with the true walls, and several grids side by side."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxsonar.floor_plans.room import Room
from jaxsonar.occupancy.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from jaxsonar.reports.plot_style import (
    CROSS_COLOR,
    ROBOT_COLOR,
    WALL_COLOR,
    figure_style,
    finish_plan_view,
    plan_view,
)

_MARGIN = 0.2
"""Margin around the grid and the room, metres. Chosen by hand."""
_PANEL_WIDTH = 3.1
"""Width of one of several grids, inches. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class GridPanel:
    """One grid of a figure."""

    title: str
    image: UInt8[np.ndarray, "rows columns"]
    """0 occupied, 205 unknown, 254 free (ROS); row 0 is the top."""
    resolution: float
    """Side of a cell, metres."""
    origin: tuple[float, float]
    """The lower left corner (x, y) of the image in the world frame, metres."""


def grid_figure(
    panel: GridPanel, *, room: Room | None = None, poses: Float[np.ndarray, "scans 3"] | None = None
) -> Figure:
    """Draw an occupancy grid; what it does not cover is unknown.

    Args:
        panel: the grid.
        room: the true walls, if they are to be drawn.
        poses: of the robot, world_from_robot, if they are to be drawn.
    """
    figure, axes = plan_view(panel.title)
    _draw(axes, panel, room, poses)
    return finish_plan_view(figure, axes, _handles(room, poses), width=8.4)


def grid_comparison_figure(
    panels: Sequence[GridPanel], *, room: Room, poses: Float[np.ndarray, "scans 3"] | None = None
) -> Figure:
    """Draw several grids of one room side by side, with the true walls."""
    with figure_style():
        figure = Figure(layout="constrained")
        row = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    low, high = zip(*(_limits(panel, room) for panel in panels), strict=True)
    low, high = np.min(low, axis=0), np.max(high, axis=0)
    for axes, panel in zip(row, panels, strict=True):
        axes.set_title(panel.title, parse_math=False, fontsize="medium")
        axes.set_aspect("equal")
        _draw(axes, panel, room, poses)
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_xlabel("x (m)")
    row[0].set_ylabel("y (m)")
    span = high - low
    figure.set_size_inches(0.6 + _PANEL_WIDTH * len(panels), 1.2 + _PANEL_WIDTH * span[1] / span[0])
    handles = _handles(room, poses)
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=8)
    return figure


def _draw(axes: Axes, panel: GridPanel, room: Room | None, poses: Float[np.ndarray, "scans 3"] | None) -> None:
    rows, columns = panel.image.shape
    (left, low), side = panel.origin, panel.resolution
    box = (left, left + columns * side, low, low + rows * side)
    axes.set_facecolor(str(UNKNOWN / FREE))
    axes.imshow(panel.image, cmap="gray", vmin=OCCUPIED, vmax=FREE, extent=box, interpolation="nearest")
    axes.grid(visible=False)
    if room is not None:
        axes.add_collection(LineCollection(list(room.walls), colors=CROSS_COLOR, linewidths=0.9, zorder=3))
        if len(room.poles):
            axes.plot(*room.poles.T, "x", color=CROSS_COLOR, ms=6, mew=1.6, zorder=3)
    if poses is not None:
        axes.plot(*poses[:, :2].T, ".", color=ROBOT_COLOR, ms=3, zorder=4)
    first, last = _limits(panel, room)
    axes.set_xlim(first[0], last[0])
    axes.set_ylim(first[1], last[1])


def _limits(panel: GridPanel, room: Room | None) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Lower left and upper right corner of a plan view that shows the whole grid and the whole room, metres."""
    size = np.array(panel.image.shape[::-1]) * panel.resolution
    corners = np.stack([panel.origin, np.array(panel.origin) + size])
    if room is not None:
        corners = np.concatenate([corners, room.walls.reshape(-1, 2), room.poles])
    return corners.min(axis=0) - _MARGIN, corners.max(axis=0) + _MARGIN


def _handles(room: Room | None, poses: Float[np.ndarray, "scans 3"] | None) -> list[Line2D]:
    handles = [
        Line2D([], [], marker="s", ls="", ms=8, mec=WALL_COLOR, mew=0.6, mfc=str(value / FREE), label=label)
        for value, label in ((OCCUPIED, "occupied"), (UNKNOWN, "unknown"), (FREE, "free"))
    ]
    if room is not None:
        handles.append(Line2D([], [], color=CROSS_COLOR, lw=0.9, label="true wall"))
        if len(room.poles):
            handles.append(Line2D([], [], color=CROSS_COLOR, marker="x", ls="", mew=1.6, label="pole"))
    if poses is not None:
        handles.append(Line2D([], [], color=ROBOT_COLOR, marker=".", ls="", ms=5, label="pose"))
    return handles
