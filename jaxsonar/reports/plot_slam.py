"""The figure of a SLAM run: odometry, estimated trajectory with covariances, loop closures, true trajectory, map."""

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse

from jaxsonar.estimation.trajectory import Trajectory
from jaxsonar.floor_plans.room import Room
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.reports.plot_style import (
    CROSS_COLOR,
    DIRECT_COLOR,
    LINE_COLOR,
    PALETTE,
    ROBOT_COLOR,
    WALL_COLOR,
    draw_map_points,
    draw_room,
    finish_plan_view,
    plan_view,
    pole_handles,
    wall_handle,
)
from jaxsonar.reports.text import plural

ELLIPSE_SIGMAS = 2
"""Standard deviations from the center of a covariance ellipse to its border."""
ELLIPSE_PROBABILITY = 1 - np.exp(-(ELLIPSE_SIGMAS**2) / 2)
"""Probability that a normally distributed position is inside its ellipse: 86 %."""
MAX_ELLIPSES = 24
"""Number of ellipses along the trajectory. Chosen by hand."""
_MIN_ELLIPSE = 0.008
"""Minimum half axis relative to the size of the trajectory; smaller ellipses are enlarged. Chosen by hand."""
_ENLARGEMENTS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""Factors by which ellipses may be enlarged: round numbers, because the legend shows the factor."""
_ODOMETRY_COLOR, _TRUTH_COLOR, _CLOSURE_COLOR, _WITHDRAWN_COLOR = WALL_COLOR, ROBOT_COLOR, PALETTE[2], CROSS_COLOR
_POINT_SIZES = {"corner": 3.5, "edge": 3.0}
"""Marker sizes, points."""


def slam_figure(
    world: GlobalMap,
    trajectory: Trajectory,
    *,
    odometry: Float[np.ndarray, "scans 3"] | None = None,
    truth: Float[np.ndarray, "poses 3"] | None = None,
    closures: Int[np.ndarray, "closures 2"] | None = None,
    withdrawn: Int[np.ndarray, "withdrawn 2"] | None = None,
    room: Room | None = None,
    title: str | None = None,
) -> Figure:
    """Draw the trajectories over the map: odometry, estimate with covariances, and truth if known.

    Covariances are drawn as ellipses of two standard deviations at some of the poses. Ellipses that would be invisible
    are enlarged; the legend states the factor.

    Args:
        world: the map.
        trajectory: the estimated poses, with their covariances if available.
        odometry: the poses of the log; rows that are not finite are gaps.
        truth: the true poses in the frame of the estimate.
        closures: pairs of rows of ``trajectory`` that accepted loop closures connect.
        withdrawn: pairs of rows that withdrawn loop closures connected.
        room: the true walls, if known.
        title: title of the figure; by default length of the trajectory, walls and loop closures.

    All coordinates are in the world frame, metres and radians.
    """
    if title is None:
        length = f"{trajectory.distance_traveled[-1]:.1f} m driven" if len(trajectory) else "no scan"
        closure_count = plural(0 if closures is None else len(closures), "loop closure")
        title = f"{length}, {plural(len(world), 'wall')}, {closure_count}"
    figure, axes = plan_view(title)
    handles: list[Line2D] = []

    def draw_trajectory(poses: np.ndarray, label: str, **look) -> None:
        axes.plot(poses[:, 0], poses[:, 1], **look)
        handles.append(Line2D([], [], label=label, **{key: look[key] for key in look if key != "zorder"}))

    if odometry is not None and np.isfinite(odometry).any():
        draw_trajectory(odometry, "odometry", color=_ODOMETRY_COLOR, lw=0.9, zorder=2)
    if truth is not None:
        draw_trajectory(truth, "true trajectory", color=_TRUTH_COLOR, lw=0.8, ls=(0, (4, 2)), zorder=8)
    draw_trajectory(trajectory.poses, "estimated trajectory", color=DIRECT_COLOR, lw=1.3, zorder=7)
    if len(trajectory):
        look = {"color": DIRECT_COLOR, "marker": "o", "ms": 5, "mec": "white", "mew": 0.8}
        axes.plot(*trajectory.poses[0, :2], ls="", zorder=9, **look)
        handles.append(Line2D([], [], ls="", label="start", **look))
    size = float(np.ptp(trajectory.poses[:, :2], axis=0).max(initial=0)) if len(trajectory) else 0.0
    if trajectory.covariance is not None and len(trajectory):
        handles.append(_draw_covariances(axes, trajectory, trajectory.covariance, size))
    for rows, color, style, label in (
        (closures, _CLOSURE_COLOR, "-", "loop closure"),
        (withdrawn, _WITHDRAWN_COLOR, (0, (2, 1.5)), "withdrawn loop closure"),
    ):
        if rows is not None and len(rows):
            links = trajectory.poses[rows][..., :2]  # (closures, 2, 2); short ones are visible by their end points
            axes.add_collection(LineCollection(list(links), colors=color, linewidths=0.9, linestyles=style, zorder=8))
            axes.plot(*links.reshape(-1, 2).T, "o", color=color, ms=2.6, mew=0, zorder=8)
            handles.append(Line2D([], [], color=color, lw=0.9, ls=style, marker="o", ms=2.6, label=label))
    handles += _draw_map(axes, world)
    if room is not None:
        draw_room(axes, room)
        handles += [wall_handle(), *pole_handles(room)]
    return finish_plan_view(figure, axes, handles, width=8.4)


def _draw_map(axes: Axes, world: GlobalMap) -> list[Line2D]:
    """Draw walls, corners and edges, finer than in ``plot_map``: buildings are large, and trajectories matter here."""
    axes.add_collection(
        LineCollection(list(world.segments), colors=LINE_COLOR, linewidths=1.6, capstyle="butt", zorder=4)
    )
    handles = [Line2D([], [], color=LINE_COLOR, lw=1.6, label="wall")]
    return handles + draw_map_points(axes, world, sizes=_POINT_SIZES, edge_width=0.9, zorder=5)


def _draw_covariances(axes: Axes, trajectory: Trajectory, covariance: np.ndarray, size: float) -> Line2D:
    """Draw ellipses at regular distances along the trajectory; ``size`` is its extent, metres."""
    marks = np.linspace(0.0, trajectory.distance_traveled[-1], min(len(trajectory), MAX_ELLIPSES + 1))[1:]
    rows = np.unique(np.clip(np.searchsorted(trajectory.distance_traveled, marks), 0, len(trajectory) - 1))
    fill = to_rgba(DIRECT_COLOR, 0.15)
    half_axes, direction = ellipses(covariance[rows, :2, :2])
    typical_half_axis = float(np.median(half_axes[:, 0])) if len(rows) else 0.0
    wanted = _MIN_ELLIPSE * size / typical_half_axis if typical_half_axis else 1.0
    factor = next((factor for factor in _ENLARGEMENTS if factor >= wanted), _ENLARGEMENTS[-1])
    for position, half, angle in zip(trajectory.poses[rows, :2], half_axes, direction, strict=True):
        width, height = (2 * factor * half).tolist()
        shape = {"width": width, "height": height, "angle": float(np.degrees(angle))}
        axes.add_patch(Ellipse(tuple(position), **shape, fc=fill, ec=DIRECT_COLOR, lw=0.7, zorder=6))
    larger = f", {factor} x enlarged" if factor > 1 else ""  # short: the columns of the legend are narrow
    label = f"{ELLIPSE_SIGMAS} sigma ({100 * ELLIPSE_PROBABILITY:.0f} %){larger}"
    return Line2D([], [], ls="", marker="o", ms=9, mfc=fill, mec=DIRECT_COLOR, mew=0.7, label=label)


def ellipses(
    covariance: Float[np.ndarray, "poses 2 2"],
) -> tuple[Float[np.ndarray, "poses 2"], Float[np.ndarray, " poses"]]:
    """Covariance ellipses of ``ELLIPSE_SIGMAS`` standard deviations.

    Returns:
        Half axes, the longer first, metres; and the direction of the longer one, radians.
    """
    value, vector = np.linalg.eigh(covariance)
    longest = vector[:, :, 1]
    return ELLIPSE_SIGMAS * np.sqrt(np.maximum(value[:, ::-1], 0)), np.arctan2(longest[:, 1], longest[:, 0])
