"""Figures of many scans: segments in the world frame, maps, laser references (paper, figures 5 to 7)."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Affine2D

from jaxsonar.detection.local_model import Line, LocalModel
from jaxsonar.evaluation.laser_polygonal_model import PolygonalModel
from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.se2 import transform_points
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.reports.plot_style import (
    CROSS_COLOR,
    DIRECT_COLOR,
    LINE_COLOR,
    PALETTE,
    ROBOT_COLOR,
    WALL_COLOR,
    draw_map_points,
    draw_robot,
    draw_room,
    finish_plan_view,
    plan_view,
    pole_handles,
    robot_handle,
    wall_handle,
)
from jaxsonar.reports.text import plural, point_counts
from jaxsonar.sensors.ring import Ring

MAX_NUMBERED_POSES = 40
"""Up to this many robot positions are numbered; more are drawn as a trajectory. Chosen by hand."""
_POINT_SIZES = {"corner": 5.5, "edge": 4.5}
"""Marker sizes, points."""
_MARGIN = 0.25
"""Margin around the shown points of a detail, metres. Chosen by hand."""


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
    """Draw how segments get their endpoints from the outermost perpendicular reflection lines (paper, figure 5).

    Args:
        ring: the sensors.
        models: local model of each scan.
        poses: world_from_robot (x, y, theta) of each scan.
        scans: indices of the models to draw.
        near: center (x, y) of a detail in the world frame, metres; by default everything is drawn.
        within: maximum distance of a segment's middle from ``near``, metres.
        room: the true walls, if known.
    """
    figure, axes = plan_view("Segments; their endpoints are the outermost reflection points")
    handles, shown = [], [np.zeros((0, 2))]
    for order, scan in enumerate(scans):
        color, pose = PALETTE[order % len(PALETTE)], poses[scan]
        for line in models[scan].lines:
            segment = transform_points(pose, line.segment.astype(float))
            if near is not None and np.linalg.norm(segment.mean(axis=0) - near) > within:
                continue
            rays = transform_points(pose, reflection_lines(ring, line))
            axes.add_collection(LineCollection(list(rays[1:-1]), colors=color, linewidths=0.35, zorder=4))
            outer = [*rays[:1], *rays[-1:]]
            axes.add_collection(LineCollection(outer, colors=color, linewidths=1.1, zorder=4))
            axes.plot(*segment.T, color=color, lw=4, solid_capstyle="butt", zorder=5)
            shown.append(segment)
        draw_robot(axes, ring, pose)
        axes.text(
            pose[0], pose[1], str(scan + 1), color=color, fontweight="bold", ha="center", va="center", zorder=7,
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
        )  # fmt: skip
        shown.append(transform_points(pose, np.asarray(ring.position)))
        handles.append(Line2D([], [], color=color, lw=4, label=f"segments from position {scan + 1}"))
    handles += [
        Line2D([], [], color=WALL_COLOR, lw=1.1, label="outermost reflection lines"),
        Line2D([], [], color=WALL_COLOR, lw=0.35, label="reflection lines of the other sensors"),
        robot_handle(),
    ]
    if room is not None:
        draw_room(axes, room)
        handles.append(wall_handle())
    points = np.concatenate(shown)
    if len(points):
        low, high = points.min(axis=0) - _MARGIN, points.max(axis=0) + _MARGIN
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    return finish_plan_view(figure, axes, handles)


def reflection_lines(ring: Ring, line: Line) -> Float[np.ndarray, "paths 2 2"]:
    """The perpendiculars from the involved (virtual) sensors to a line.

    A virtual sensor is the midpoint of transmitter and receiver of a cross path (paper, section 5).

    Returns:
        Sensor and footpoint of each path, robot frame, metres, sorted along the line.
    """
    sensors = ring.position[line.paths].mean(axis=1)
    normal = np.array([np.cos(line.theta), np.sin(line.theta)])
    footpoints = sensors + (line.rho - sensors @ normal)[:, None] * normal
    along = sensors @ np.array([-normal[1], normal[0]])
    return np.stack([sensors, footpoints], axis=1)[np.argsort(along, kind="stable")]


def aggregate_figure(
    ring: Ring, models: Sequence[LocalModel], poses: Float[np.ndarray, "scans 3"], *, room: Room | None = None
) -> Figure:
    """Draw the segments of all scans in the world frame (paper, figure 6)."""
    found = sum(len(model.lines) for model in models)
    figure, axes = plan_view(f"{found} segments from {len(models)} scans")
    handles = [Line2D([], [], color=LINE_COLOR, lw=2.2, label="segment from one scan")]
    if room is not None:
        draw_room(axes, room)
        handles += [wall_handle(), *pole_handles(room)]
    segments = aggregated_segments(models, poses)
    axes.add_collection(
        LineCollection(list(segments), colors=LINE_COLOR, linewidths=2.2, alpha=0.75, capstyle="butt", zorder=4)
    )
    handles.append(_draw_trajectory(axes, poses))
    return finish_plan_view(figure, axes, handles, width=8.4)


def aggregated_segments(
    models: Sequence[LocalModel], poses: Float[np.ndarray, "scans 3"]
) -> Float[np.ndarray, "segments 2 2"]:
    """The segments of all scans in the world frame, metres, in order of the scans (paper, section 5)."""
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
    """Draw a map over the other known data of the same environment (paper, figure 7).

    Args:
        world: the map.
        aggregated: the segments of all scans before merging.
        poses: world_from_robot (x, y, theta); numbered if there are at most ``MAX_NUMBERED_POSES``.
        room: the true walls, if known.
        reference: endpoints of walls measured by another sensor.
        laser_points: laser measurements.
        title: title of the figure; by default the numbers of segments and points.

    All coordinates are in the world frame, metres.
    """
    if title is None:
        title = ", ".join([plural(len(world), "merged segment"), *point_counts(world.point_kinds)])
    figure, axes = plan_view(title)
    handles = _draw_map(axes, world)
    if aggregated is not None:
        axes.add_collection(LineCollection(list(aggregated), colors=CROSS_COLOR, linewidths=1, alpha=0.7, zorder=4))
        handles.append(Line2D([], [], color=CROSS_COLOR, lw=1, label="segment of a local model"))
    if room is not None:
        draw_room(axes, room)
        handles += [wall_handle(), *pole_handles(room)]
    if reference is not None:
        axes.add_collection(LineCollection(list(reference), colors=ROBOT_COLOR, linewidths=0.6, zorder=3))
        handles.append(Line2D([], [], color=ROBOT_COLOR, lw=0.6, label="reference wall"))
    if laser_points is not None:
        # Thousands of dots are rasterized within the SVG.
        axes.plot(*laser_points.T, ".", color=WALL_COLOR, ms=1.5, mew=0, alpha=0.5, zorder=1, rasterized=True)
        handles.append(Line2D([], [], color=WALL_COLOR, marker=".", ls="", label="laser points"))
    if poses is not None:
        handles.append(_draw_trajectory(axes, poses))
    return finish_plan_view(figure, axes, handles, width=8.4)


def laser_figure(
    walls: Float[np.ndarray, "walls 2 2"] | PolygonalModel, points: Float[np.ndarray, "points 2"]
) -> Figure:
    """Draw walls from a laser over its points, of a whole run or of one scan (paper, figure 2).

    Args:
        walls: endpoints of the walls, or the polygonal model of a scan, metres.
        points: laser measurements in the same frame, metres.
    """
    model = walls if isinstance(walls, PolygonalModel) else PolygonalModel(walls)
    figure, axes = plan_view(f"{len(model.segments)} line segments from a laser")
    axes.add_collection(LineCollection(list(model.segments), colors=ROBOT_COLOR, linewidths=1.6, zorder=3))
    handles = [Line2D([], [], color=ROBOT_COLOR, lw=1.6, label="line segment")]
    if len(model.pseudo):
        dashes = LineCollection(
            list(model.pseudo), colors=DIRECT_COLOR, linewidths=0.9, linestyles=(0, (4, 3)), zorder=2
        )
        axes.add_collection(dashes)
        handles.append(Line2D([], [], color=DIRECT_COLOR, lw=0.9, ls=(0, (4, 3)), label="pseudo line segment"))
    if len(model.intersections):
        axes.plot(*model.intersections.T, "o", color=LINE_COLOR, ms=4, zorder=4)
        handles.append(Line2D([], [], color=LINE_COLOR, marker="o", ls="", ms=4, label="intersection"))
    corners = np.concatenate([model.segments, model.pseudo]).reshape(-1, 2)
    if len(corners):
        low, high = corners.min(axis=0) - 1, corners.max(axis=0) + 1
        points = points[((points > low) & (points < high)).all(axis=1)]
    axes.plot(*points.T, ".", color=WALL_COLOR, ms=1.5, mew=0, alpha=0.5, zorder=1, rasterized=True)
    handles.append(Line2D([], [], color=WALL_COLOR, marker=".", ls="", label="laser points"))
    return finish_plan_view(figure, axes, handles, width=8.4)


def _draw_map(axes: Axes, world: GlobalMap) -> list[Line2D]:
    """Draw segments with a tick across each end, so that adjacent segments can be distinguished, and points."""
    axes.add_collection(
        LineCollection(list(world.segments), colors=LINE_COLOR, linewidths=2.6, capstyle="butt", zorder=5),
    )
    along = world.segments[:, 1] - world.segments[:, 0]
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    across = across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
    # Positions in metres, lengths in points: the ticks have the same size at every scale.
    ticks = 4 * np.repeat(across, 2, axis=0)[:, None] * np.array([[-1.0], [1.0]])
    figure = axes.figure
    axes.add_collection(
        LineCollection(
            list(ticks), colors=LINE_COLOR, linewidths=1, zorder=5, offsets=world.segments.reshape(-1, 2),
            offset_transform=axes.transData, transform=Affine2D().scale(1 / 72) + figure.dpi_scale_trans,
        ),
        autolim=False,
    )  # fmt: skip
    handles = [Line2D([], [], color=LINE_COLOR, lw=2.6, marker="|", ms=8, mew=1, label="merged segment and its ends")]
    return handles + draw_map_points(axes, world, sizes=_POINT_SIZES, edge_width=1.2, zorder=6)


def _draw_trajectory(axes: Axes, poses: Float[np.ndarray, "scans 3"]) -> Line2D:
    """Draw robot positions: numbered crosses, or a trajectory with a cross at regular intervals."""
    step = -(-len(poses) // MAX_NUMBERED_POSES) or 1
    axes.plot(*poses[:, :2].T, color=DIRECT_COLOR, lw=0.7, zorder=2)
    axes.plot(*poses[::step, :2].T, "+", color=DIRECT_COLOR, ms=7 if step == 1 else 4, zorder=3)
    for number, (x, y, theta) in enumerate(poses if step == 1 else poses[:0], start=1):
        axes.annotate(
            str(number), (x, y), xytext=(4 * np.sin(theta), -8), textcoords="offset points", fontsize=6.5,
            color=DIRECT_COLOR, ha="center", va="center",
        )  # fmt: skip
    label = "robot positions" if step == 1 else f"trajectory, a cross every {step} positions"
    return Line2D([], [], color=DIRECT_COLOR, marker="+", lw=0.7, ms=7, label=label)
