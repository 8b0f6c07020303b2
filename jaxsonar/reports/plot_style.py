"""What all figures share: their style, plan views in metres, and how a figure becomes a file.

Each function of ``figures_scan`` and ``figures_map`` draws one figure and returns it; ``save`` writes it. Colours stay
distinct for colour-blind readers.
"""

import io
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxsonar.fileio.atomic_files import FIGURE_FORMATS as FORMATS
from jaxsonar.fileio.atomic_files import atomic_write, shown
from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.se2 import to_world
from jaxsonar.hardware.errors import SonarError
from jaxsonar.sensors.ring import Ring

PALETTE = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
"""Okabe and Ito's colours, told apart by colour-blind readers too."""
DIRECT, CROSS, LINE, WALL, FAINT, ROBOT = PALETTE[0], PALETTE[1], "#B5123E", "#8C8C8C", "#DDDDDD", "#222222"
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "savefig.dpi": 160,
    "svg.hashsalt": "jaxsonar",  # the same figure gives the same file
}
_LONG_PLAN, _LONG_WIDTH, _TALLEST, _NARROWEST = 0.45, 10.0, 8.5, 4.2  # height / width; inches


def styled() -> AbstractContextManager[None]:
    """The context in which figures of this house are made and written."""
    return rc_context(STYLE)


def save(figure: Figure, path: Path | str) -> None:
    """Write a figure as .svg, .png or .pdf, whole or not at all.

    Raises:
        SonarError: another suffix, or a place that cannot be written to.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise SonarError(f"{shown(path)}: figure format {path.suffix!r}; allowed are {', '.join(FORMATS)}")
    with atomic_write(path, binary=True) as file:
        file.write(rendered(figure, path.suffix.lower()[1:]))


def rendered(figure: Figure, kind: str) -> bytes:
    """A figure as the bytes of an svg, png or pdf file; the same figure gives the same bytes."""
    metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
    file = io.BytesIO()
    with styled():
        figure.savefig(file, format=kind, metadata=metadata)
    return file.getvalue()


def plan(title: str) -> tuple[Figure, Axes]:
    """An empty plan view in metres."""
    with styled():
        figure = Figure(layout="constrained")
        axes = figure.add_subplot()
        axes.set_title(title, parse_math=False)  # names of files may hold dollars
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.grid(color="#F0F0F0", lw=0.6)
    axes.set_axisbelow(True)
    return figure, axes


def finish(figure: Figure, axes: Axes, handles: list[Line2D], *, width: float = 6.8) -> Figure:
    """Paper to the size of the plan, and the legend below it, where it covers nothing.

    Args:
        figure: the figure.
        axes: its only axes, with everything drawn.
        handles: of the legend.
        width: of the paper, inches; long corridors get more, tall plans less.
    """
    axes.autoscale_view()
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    aspect = (high - low) / (right - left)
    width = max(width, _LONG_WIDTH) if aspect < _LONG_PLAN else width
    across = min(width - 0.7, _TALLEST / aspect)
    width = max(across + 0.7, _NARROWEST)
    columns = max(int(width / 2.1), 1)
    legend_rows = -(-len(handles) // columns)
    figure.set_size_inches(width, across * aspect + 1.0 + 0.22 * legend_rows)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False, fontsize=8)
    return figure


def draw_walls(axes: Axes, room: Room) -> None:
    """The true walls, grey, and poles as crosses."""
    axes.add_collection(LineCollection(list(room.walls), colors=WALL, linewidths=1.4, zorder=3))
    if len(room.poles):
        axes.plot(*room.poles.T, "x", color=WALL, ms=6, mew=1.6, zorder=3)


def draw_robot(axes: Axes, ring: Ring, pose: Float[np.ndarray, "3"]) -> None:
    """The sensors at a pose, and an arrow that points forward."""
    sensors = to_world(pose, np.asarray(ring.position))
    axes.plot(*sensors.T, "o", color=ROBOT, ms=2.2, zorder=6)
    nose = to_world(pose, np.array([[0.0, 0.0], [0.18, 0.0]]))
    axes.update_datalim(nose)
    axes.annotate("", xy=tuple(nose[1]), xytext=tuple(nose[0]), arrowprops={"arrowstyle": "-|>", "color": ROBOT})


def wall_handle() -> Line2D:
    """Legend of the true walls."""
    return Line2D([], [], color=WALL, lw=1.4, label="true wall")


def pole_handles(room: Room) -> list[Line2D]:
    """Legend of the poles, if there are any."""
    return [Line2D([], [], color=WALL, marker="x", ls="", mew=1.6, label="pole")] if len(room.poles) else []


def robot_handle() -> Line2D:
    """Legend of the robot."""
    return Line2D([], [], color=ROBOT, marker="o", ls="", ms=3, label="sensors; the arrow is forward")
