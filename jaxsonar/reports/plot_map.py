"""Figures of many scans: line elements, their segments in the world frame, global maps (paper, figures 5 to 7).

Each function draws one figure and returns it; ``figures.save`` writes it.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Affine2D

from jaxsonar.detection.local_map import Line, LocalModel
from jaxsonar.evaluation.laser_segments import PolygonalModel
from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.se2 import transform_points
from jaxsonar.mapping.global_map import POINT_KINDS, GlobalMap
from jaxsonar.occupancy.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from jaxsonar.reports.plot_style import (
    CROSS,
    DIRECT,
    LINE,
    PALETTE,
    ROBOT,
    WALL,
    draw_robot,
    draw_walls,
    finish,
    plan,
    pole_handles,
    robot_handle,
    wall_handle,
)
from jaxsonar.sensors.ring import Ring

MOST_NUMBERS = 40
"""More robot positions than this are drawn as a path without numbers."""
_POINT_MARKERS = {"corner": ("s", 5.5), "edge": ("D", 4.5)}  # marker, points
_MARGIN = 0.25  # m around what a cut-out shows


def modeling_figure(
    ring: Ring,
    models: Sequence[LocalModel],
    poses: Float[np.ndarray, "scans 3"],
    *,
    scans: Sequence[int],
    near: tuple[float, float] | None = None,
    within: float = np.inf,
    room: Room | None = None,
) -> Figure:
    """How line elements get their extent: the outermost perpendicular reflection lines (paper, figure 5).

    Args:
        ring: the sensors.
        models: the lines found in each scan.
        poses: world_from_robot (x, y, theta) of each scan.
        scans: which of the models to draw, counted from 0.
        near: a place (x, y) in the world frame, metres, such as a corner; everywhere if left out.
        within: how far from there the middle of a line element may be, metres.
        room: the true walls, if they are known.
    """
    figure, axes = plan("Line elements; the outermost reflection lines give their extent")
    handles, shown = [], [np.zeros((0, 2))]
    for order, scan in enumerate(scans):
        colour, pose = PALETTE[order % len(PALETTE)], poses[scan]
        for line in models[scan].lines:
            segment = transform_points(pose, line.segment.astype(float))
            if near is not None and np.linalg.norm(segment.mean(axis=0) - near) > within:
                continue
            rays = transform_points(pose, reflection_lines(ring, line))
            axes.add_collection(LineCollection(list(rays[1:-1]), colors=colour, linewidths=0.35, zorder=4))
            outer = [*rays[:1], *rays[-1:]]
            axes.add_collection(LineCollection(outer, colors=colour, linewidths=1.1, zorder=4))
            axes.plot(*segment.T, color=colour, lw=4, solid_capstyle="butt", zorder=5)
            shown.append(segment)
        draw_robot(axes, ring, pose)
        axes.text(
            pose[0], pose[1], str(scan + 1), color=colour, fontweight="bold", ha="center", va="center", zorder=7,
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
        )  # fmt: skip
        shown.append(transform_points(pose, np.asarray(ring.position)))
        handles.append(Line2D([], [], color=colour, lw=4, label=f"line elements from position {scan + 1}"))
    handles += [
        Line2D([], [], color=WALL, lw=1.1, label="outermost reflection lines"),
        Line2D([], [], color=WALL, lw=0.35, label="those of the other sensors"),
        robot_handle(),
    ]
    if room is not None:
        draw_walls(axes, room)
        handles.append(wall_handle())
    points = np.concatenate(shown)
    if len(points):
        low, high = points.min(axis=0) - _MARGIN, points.max(axis=0) + _MARGIN
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    return finish(figure, axes, handles)


def reflection_lines(ring: Ring, line: Line) -> Float[np.ndarray, "paths 2 2"]:
    """From each involved sensor square to the line: (sensor, its foot), robot frame, metres, in order along the line.

    A virtual sensor is in the middle of the two that make up the cross echo path (paper, section 5).
    """
    sensors = ring.position[line.paths].mean(axis=1)
    normal = np.array([np.cos(line.theta), np.sin(line.theta)])
    feet = sensors + (line.rho - sensors @ normal)[:, None] * normal
    along = sensors @ np.array([-normal[1], normal[0]])
    return np.stack([sensors, feet], axis=1)[np.argsort(along, kind="stable")]


def aggregate_figure(
    ring: Ring, models: Sequence[LocalModel], poses: Float[np.ndarray, "scans 3"], *, room: Room | None = None
) -> Figure:
    """The segments of all scans at their poses, in the world frame (paper, figure 6)."""
    found = sum(len(model.lines) for model in models)
    figure, axes = plan(f"{found} segments from {len(models)} scans")
    handles = [Line2D([], [], color=LINE, lw=2.2, label="segment from one scan")]
    if room is not None:
        draw_walls(axes, room)
        handles += [wall_handle(), *pole_handles(room)]
    segments = aggregated_segments(models, poses)
    axes.add_collection(
        LineCollection(list(segments), colors=LINE, linewidths=2.2, alpha=0.75, capstyle="butt", zorder=4)
    )
    handles.append(_draw_path(axes, poses))
    return finish(figure, axes, handles, width=8.4)


def aggregated_segments(
    models: Sequence[LocalModel], poses: Float[np.ndarray, "scans 3"]
) -> Float[np.ndarray, "segments 2 2"]:
    """The segments of all scans in the world frame, metres, scan by scan (paper, section 5)."""
    found = [
        transform_points(pose, line.segment.astype(float))
        for model, pose in zip(models, poses, strict=True)
        for line in model.lines
    ]
    return np.array(found).reshape(-1, 2, 2)


def map_figure(
    world: GlobalMap,
    *,
    aggregated: Float[np.ndarray, "segments 2 2"] | None = None,
    poses: Float[np.ndarray, "scans 3"] | None = None,
    room: Room | None = None,
    reference: Float[np.ndarray, "walls 2 2"] | None = None,
    laser_points: Float[np.ndarray, "points 2"] | None = None,
    title: str | None = None,
) -> Figure:
    """The merged segments in bold over whatever else is known of the place (paper, figure 7).

    Args:
        world: the merged segments.
        aggregated: the segments of all scans that they were merged from.
        poses: world_from_robot (x, y, theta); numbered if there are at most ``MOST_NUMBERS``.
        room: the true walls, if they are known.
        reference: walls by another sensor, both ends of each.
        laser_points: where a laser saw something.
        title: above the figure; the numbers of segments, corners and edges if left out.

    All coordinates are in the world frame, metres.
    """
    count = f"{len(world)} merged segment{'' if len(world) == 1 else 's'}"
    for kind in POINT_KINDS:
        found = world.point_kinds.count(kind)
        count += f", {found} {kind}{'' if found == 1 else 's'}" if found else ""
    figure, axes = plan(count if title is None else title)
    handles = _draw_map(axes, world)
    if aggregated is not None:
        axes.add_collection(LineCollection(list(aggregated), colors=CROSS, linewidths=1, alpha=0.7, zorder=4))
        handles.append(Line2D([], [], color=CROSS, lw=1, label="segment of a local model"))
    if room is not None:
        draw_walls(axes, room)
        handles += [wall_handle(), *pole_handles(room)]
    if reference is not None:
        axes.add_collection(LineCollection(list(reference), colors=ROBOT, linewidths=0.6, zorder=3))
        handles.append(Line2D([], [], color=ROBOT, lw=0.6, label="reference wall"))
    if laser_points is not None:
        # Thousands of dots are an image within the SVG, not as many elements.
        axes.plot(*laser_points.T, ".", color=WALL, ms=1.5, mew=0, alpha=0.5, zorder=1, rasterized=True)
        handles.append(Line2D([], [], color=WALL, marker=".", ls="", label="laser points"))
    if poses is not None:
        handles.append(_draw_path(axes, poses))
    return finish(figure, axes, handles, width=8.4)


def laser_figure(
    walls: Float[np.ndarray, "walls 2 2"] | PolygonalModel, points: Float[np.ndarray, "points 2"]
) -> Figure:
    """Walls from a laser over its points: of a whole run, or the polygonal model of one scan (paper, figure 2).

    Args:
        walls: both ends of each, or the model with its pseudo segments and intersections, metres.
        points: where the laser saw something, the same frame, metres.
    """
    model = walls if isinstance(walls, PolygonalModel) else PolygonalModel(walls)
    figure, axes = plan(f"{len(model.segments)} line segments from a laser")
    axes.add_collection(LineCollection(list(model.segments), colors=ROBOT, linewidths=1.6, zorder=3))
    handles = [Line2D([], [], color=ROBOT, lw=1.6, label="line segment")]
    if len(model.pseudo):
        dashes = LineCollection(list(model.pseudo), colors=DIRECT, linewidths=0.9, linestyles=(0, (4, 3)), zorder=2)
        axes.add_collection(dashes)
        handles.append(Line2D([], [], color=DIRECT, lw=0.9, ls=(0, (4, 3)), label="pseudo line segment"))
    if len(model.intersections):
        axes.plot(*model.intersections.T, "o", color=LINE, ms=4, zorder=4)
        handles.append(Line2D([], [], color=LINE, marker="o", ls="", ms=4, label="intersection"))
    corners = np.concatenate([model.segments, model.pseudo]).reshape(-1, 2)
    if len(corners):
        low, high = corners.min(axis=0) - 1, corners.max(axis=0) + 1
        points = points[((points > low) & (points < high)).all(axis=1)]
    axes.plot(*points.T, ".", color=WALL, ms=1.5, mew=0, alpha=0.5, zorder=1, rasterized=True)
    handles.append(Line2D([], [], color=WALL, marker=".", ls="", label="laser points"))
    return finish(figure, axes, handles, width=8.4)


def grid_figure(
    image: UInt8[np.ndarray, "rows columns"],
    *,
    resolution: float,
    origin: tuple[float, float],
    world: GlobalMap | None = None,
) -> Figure:
    """An occupancy grid, and the merged segments over it.

    Args:
        image: 0 occupied, 205 unknown, 254 free, as ROS has them; row 0 is the top.
        resolution: side of a cell, metres.
        origin: the lower left corner (x, y) of the image in the world frame, metres.
        world: the segments, if they are to be seen.
    """
    rows, columns = image.shape
    figure, axes = plan(f"Occupancy grid: {columns} x {rows} cells of {resolution:g} m")
    (left, low), width, height = origin, columns * resolution, rows * resolution
    box = (left, left + width, low, low + height)
    axes.imshow(image, cmap="gray", vmin=OCCUPIED, vmax=FREE, extent=box, interpolation="nearest")
    axes.grid(visible=False)
    handles = [
        Line2D([], [], marker="s", ls="", ms=8, mec=WALL, mew=0.6, mfc=str(value / FREE), label=label)
        for value, label in ((OCCUPIED, "occupied"), (UNKNOWN, "unknown"), (FREE, "free"))
    ]
    if world is not None:
        handles += _draw_map(axes, world)
    return finish(figure, axes, handles, width=8.4)


def _draw_map(axes: Axes, world: GlobalMap) -> list[Line2D]:
    """Segments in bold, a tick across each end, so that neighbors on one wall can be told apart; corners and edges."""
    axes.add_collection(
        LineCollection(list(world.segments), colors=LINE, linewidths=2.6, capstyle="butt", zorder=5),
    )
    along = world.segments[:, 1] - world.segments[:, 0]
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    across = across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
    # Lengths in points at places in metres: a tick has the same size in a cupboard and in a corridor.
    ticks = 4 * np.repeat(across, 2, axis=0)[:, None] * np.array([[-1.0], [1.0]])
    figure = axes.figure
    axes.add_collection(
        LineCollection(
            list(ticks), colors=LINE, linewidths=1, zorder=5, offsets=world.segments.reshape(-1, 2),
            offset_transform=axes.transData, transform=Affine2D().scale(1 / 72) + figure.dpi_scale_trans,
        ),
        autolim=False,
    )  # fmt: skip
    handles = [Line2D([], [], color=LINE, lw=2.6, marker="|", ms=8, mew=1, label="merged segment and its ends")]
    for kind, (marker, size) in _POINT_MARKERS.items():
        places = world.points[np.array(world.point_kinds, dtype=np.str_) == kind]
        if len(places):
            look = {"marker": marker, "ls": "", "ms": size, "mfc": "white", "mec": LINE, "mew": 1.2}
            axes.plot(*places.T, **look, zorder=6)
            handles.append(Line2D([], [], **look, label=kind))
    return handles


def _draw_path(axes: Axes, poses: Float[np.ndarray, "scans 3"]) -> Line2D:
    """Robot positions: numbered crosses if they are few, else a path with a cross here and there."""
    step = -(-len(poses) // MOST_NUMBERS) or 1
    axes.plot(*poses[:, :2].T, color=DIRECT, lw=0.7, zorder=2)
    axes.plot(*poses[::step, :2].T, "+", color=DIRECT, ms=7 if step == 1 else 4, zorder=3)
    for number, (x, y, theta) in enumerate(poses if step == 1 else poses[:0], start=1):
        axes.annotate(
            str(number), (x, y), xytext=(4 * np.sin(theta), -8), textcoords="offset points", fontsize=6.5, color=DIRECT,
            ha="center", va="center",
        )  # fmt: skip
    each = "robot positions" if step == 1 else f"robot path, a cross every {step} positions"
    return Line2D([], [], color=DIRECT, marker="+", lw=0.7, ms=7, label=each)
