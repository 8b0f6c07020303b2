"""Common parts of all figures: colors and style, plan views in metres, legends, and saving.

Each function of the other ``plot_*`` modules draws one figure and returns it; ``save_figure`` writes it.
"""

import io
from collections.abc import Mapping
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
from matplotlib.patches import Circle

from jaxsonar.fileio.atomic_files import FIGURE_FORMATS, atomic_write, shown
from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.se2 import transform_points
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.sensors.ring import Ring

PALETTE = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
"""Colours of Okabe and Ito, distinct for color-blind readers."""
DIRECT_COLOR, CROSS_COLOR = PALETTE[0], PALETTE[1]
"""Direct and cross echoes."""
LINE_COLOR = "#B5123E"
"""Detected lines and walls."""
POINT_COLOR = LINE_COLOR
"""Outline of corners and edges; they are filled with white."""
WALL_COLOR = "#8C8C8C"
"""True walls."""
FAINT_COLOR = "#DDDDDD"
"""Paths without an echo, and detection cones."""
ROBOT_COLOR = "#222222"
POINT_MARKERS = {"corner": "s", "edge": "D", "undecided": "*"}
"""Matplotlib markers of corners, edges and undecided reflectors."""
_LARGER = 1.8
"""Size of stars, in sizes of the largest other marker."""
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "savefig.dpi": 160,
    "svg.hashsalt": "jaxsonar",  # makes files reproducible
}
_LONG_PLAN_ASPECT = 0.45
"""Height over width of a plan; a flatter plan gets a wider figure."""
_LONG_PLAN_WIDTH, _MAX_HEIGHT, _MIN_WIDTH = 10.0, 8.5, 4.2
"""Inches."""


def figure_style() -> AbstractContextManager[None]:
    """Context with the matplotlib settings for drawing and saving a figure."""
    return rc_context(STYLE)


def save_figure(figure: Figure, filename: Path | str) -> None:
    """Write a figure as .svg, .png or .pdf, atomically.

    Raises:
        SonarError: another suffix, or a file that cannot be written.
    """
    filename = Path(filename)
    if filename.suffix.lower() not in FIGURE_FORMATS:
        raise SonarError(
            f"{shown(filename)}: figure format {filename.suffix!r}; allowed are {', '.join(FIGURE_FORMATS)}"
        )
    with atomic_write(filename, binary=True) as file:
        file.write(render_figure(figure, filename.suffix.lower()[1:]))


def render_figure(figure: Figure, kind: str) -> bytes:
    """Render a figure to the bytes of an svg, png or pdf file. The same figure gives the same bytes."""
    metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
    file = io.BytesIO()
    with figure_style():
        figure.savefig(file, format=kind, metadata=metadata)
    return file.getvalue()


def plan_view(title: str) -> tuple[Figure, Axes]:
    """An empty plan view in metres."""
    with figure_style():
        figure = Figure(layout="constrained")
        axes = figure.add_subplot()
        axes.set_title(title, parse_math=False)  # filenames may contain dollar signs
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.grid(color="#F0F0F0", lw=0.6)
    axes.set_axisbelow(True)
    return figure, axes


def finish_plan_view(figure: Figure, axes: Axes, handles: list[Line2D], *, width: float = 6.8) -> Figure:
    """Fit the figure size to the plan, and add the legend below the axes.

    Args:
        figure: the figure.
        axes: its only axes, with everything drawn.
        handles: handles of the legend.
        width: width of the figure, inches; long corridors get more, tall plans less.
    """
    axes.autoscale_view()
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    aspect = (high - low) / (right - left)
    width = max(width, _LONG_PLAN_WIDTH) if aspect < _LONG_PLAN_ASPECT else width
    across = min(width - 0.7, _MAX_HEIGHT / aspect)
    width = max(across + 0.7, _MIN_WIDTH)
    columns = max(int(width / 2.1), 1)
    legend_rows = -(-len(handles) // columns)
    figure.set_size_inches(width, across * aspect + 1.0 + 0.22 * legend_rows)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False, fontsize=8)
    return figure


def draw_room(axes: Axes, room: Room) -> None:
    """Draw the true walls and circles of a floor plan in grey, and its poles as crosses."""
    for x, y, radius in room.circles:
        axes.add_patch(Circle((x, y), radius, fill=False, color=WALL_COLOR, lw=1.4, zorder=3))
    axes.add_collection(LineCollection(list(room.walls), colors=WALL_COLOR, linewidths=1.4, zorder=3))
    if len(room.poles):
        axes.plot(*room.poles.T, "x", color=WALL_COLOR, ms=6, mew=1.6, zorder=3)


def draw_robot(axes: Axes, ring: Ring, pose: Float[np.ndarray, "3"]) -> None:
    """Draw the sensors at a pose (world_from_robot), and an arrow in driving direction."""
    sensors = transform_points(pose, np.asarray(ring.position))
    axes.plot(*sensors.T, "o", color=ROBOT_COLOR, ms=2.2, zorder=6)
    nose = transform_points(pose, np.array([[0.0, 0.0], [0.18, 0.0]]))
    axes.update_datalim(nose)
    axes.annotate("", xy=tuple(nose[1]), xytext=tuple(nose[0]), arrowprops={"arrowstyle": "-|>", "color": ROBOT_COLOR})


def draw_map_points(
    axes: Axes, world: GlobalMap, *, sizes: Mapping[str, float], edge_width: float, zorder: int
) -> list[Line2D]:
    """Draw the points of a map, circles with their true radius. Returns the legend handles.

    Args:
        axes: axes of a plan view.
        world: the map.
        sizes: marker size of each kind, points.
        edge_width: line width of the markers, points.
        zorder: drawing order.
    """
    handles, style = [], dict[str, Any]()
    round_ones = world.with_kinds("circle")
    for (x, y), radius in zip(round_ones.points.tolist(), round_ones.point_radius.tolist(), strict=True):
        axes.add_patch(Circle((x, y), radius, fc="white", ec=POINT_COLOR, lw=edge_width + 0.8, zorder=zorder - 0.5))
        axes.plot(x, y, "+", color=POINT_COLOR, ms=4, mew=edge_width, zorder=zorder)
    if len(round_ones.points):
        style = {"marker": "o", "ls": "", "ms": 8, "mfc": "white", "mec": POINT_COLOR, "mew": edge_width + 0.8}
        handles.append(Line2D([], [], **style, label="circle"))
    for kind, marker in POINT_MARKERS.items():
        points = world.points[np.array(world.point_kinds, dtype=np.str_) == kind]
        if len(points):
            size = sizes.get(kind, _LARGER * max(sizes.values()))
            style = {"marker": marker, "ls": "", "ms": size, "mfc": "white", "mec": POINT_COLOR, "mew": edge_width}
            axes.plot(*points.T, **style, zorder=zorder)
            handles.append(Line2D([], [], **style, label=kind))
    return handles


def wall_handle() -> Line2D:
    """Legend handle of the true walls."""
    return Line2D([], [], color=WALL_COLOR, lw=1.4, label="true wall")


def pole_handles(room: Room) -> list[Line2D]:
    """Legend handle of the poles, if there are any."""
    return [Line2D([], [], color=WALL_COLOR, marker="x", ls="", mew=1.6, label="pole")] if len(room.poles) else []


def robot_handle() -> Line2D:
    """Legend handle of the robot."""
    return Line2D([], [], color=ROBOT_COLOR, marker="o", ls="", ms=3, label="sensors; arrow: forward")
