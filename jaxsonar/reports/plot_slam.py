"""The figure of a run with unknown poses: where odometry believed the robot, where it was, and the map of it.

The function draws one figure and returns it; ``figures.save`` writes it.
"""

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
    CROSS,
    DIRECT,
    LINE,
    PALETTE,
    ROBOT,
    WALL,
    draw_walls,
    finish,
    plan,
    pole_handles,
    wall_handle,
)

SIGMAS = 2
"""Standard deviations from the middle of an ellipse to its border, in every direction."""
HELD = 1 - np.exp(-(SIGMAS**2) / 2)
"""Share of the poses that lie within such an ellipse of their own, if they are normal: 86 %."""
MOST_ELLIPSES = 24
_SEEN = 0.008  # of the size of the path: smaller ellipses are drawn larger, and the legend says how much
_ENLARGED = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_ODOMETRY, _TRUTH, _CLOSURE, _WITHDRAWN = WALL, ROBOT, PALETTE[2], CROSS
_POINTS = {"corner": ("s", 3.5), "edge": ("D", 3.0)}  # marker, points


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
    """Paths over the map: by odometry, as estimated with its covariance, and as it was if that is known.

    Covariances are ellipses of two standard deviations at some of the poses, larger than they are where they would not
    be seen; the legend says by how much.

    Args:
        world: walls, corners and edges.
        trajectory: the estimated poses, and their covariance if they have one.
        odometry: the poses of the log; rows that are not finite are gaps.
        truth: the true poses, moved to where the estimate begins if they are in another frame.
        closures: rows (of ``trajectory``) of poses that were tied together because the robot came back.
        withdrawn: the same of those that were taken back later.
        room: the true walls, if they are known.
        title: above the figure; the way, the walls and the closures if left out.

    All coordinates are in the world frame, metres and radians.
    """
    ties = 0 if closures is None else len(closures)
    count = f"{trajectory.way[-1]:.1f} m driven" if len(trajectory) else "no scan"
    count += f", {len(world)} wall{'' if len(world) == 1 else 's'}"
    count += f", {ties} loop closure{'' if ties == 1 else 's'}"
    figure, axes = plan(count if title is None else title)
    handles: list[Line2D] = []

    def path(poses: np.ndarray, label: str, **look) -> None:
        axes.plot(poses[:, 0], poses[:, 1], **look)
        handles.append(Line2D([], [], label=label, **{key: look[key] for key in look if key != "zorder"}))

    if odometry is not None and np.isfinite(odometry).any():
        path(odometry, "path by odometry", color=_ODOMETRY, lw=0.9, zorder=2)
    if truth is not None:
        path(truth, "true path", color=_TRUTH, lw=0.8, ls=(0, (4, 2)), zorder=8)
    path(trajectory.poses, "estimated path", color=DIRECT, lw=1.3, zorder=7)
    if len(trajectory):
        look = {"color": DIRECT, "marker": "o", "ms": 5, "mec": "white", "mew": 0.8}
        axes.plot(*trajectory.poses[0, :2], ls="", zorder=9, **look)
        handles.append(Line2D([], [], ls="", label="start", **look))
    size = float(np.ptp(trajectory.poses[:, :2], axis=0).max(initial=0)) if len(trajectory) else 0.0
    if trajectory.covariance is not None and len(trajectory):
        handles.append(_draw_covariances(axes, trajectory, trajectory.covariance, size))
    for rows, colour, style, label in (
        (closures, _CLOSURE, "-", "loop closure"),
        (withdrawn, _WITHDRAWN, (0, (2, 1.5)), "loop closure withdrawn"),
    ):
        if rows is not None and len(rows):
            links = trajectory.poses[rows][..., :2]  # (closures, 2, 2); a short one is seen by its ends
            axes.add_collection(LineCollection(list(links), colors=colour, linewidths=0.9, linestyles=style, zorder=8))
            axes.plot(*links.reshape(-1, 2).T, "o", color=colour, ms=2.6, mew=0, zorder=8)
            handles.append(Line2D([], [], color=colour, lw=0.9, ls=style, marker="o", ms=2.6, label=label))
    handles += _draw_world(axes, world)
    if room is not None:
        draw_walls(axes, room)
        handles += [wall_handle(), *pole_handles(room)]
    return finish(figure, axes, handles, width=8.4)


def _draw_world(axes: Axes, world: GlobalMap) -> list[Line2D]:
    """Walls, corners and edges, finer than in ``figures_map``: buildings are large, and the paths matter here."""
    axes.add_collection(LineCollection(list(world.segments), colors=LINE, linewidths=1.6, capstyle="butt", zorder=4))
    handles = [Line2D([], [], color=LINE, lw=1.6, label="wall")]
    kinds = np.array(world.point_kinds, dtype=np.str_)
    for kind, (marker, size) in _POINTS.items():
        places = world.points[kinds == kind]
        if len(places):
            look = {"marker": marker, "ls": "", "ms": size, "mfc": "white", "mec": LINE, "mew": 0.9}
            axes.plot(*places.T, **look, zorder=5)
            handles.append(Line2D([], [], **look, label=kind))
    return handles


def _draw_covariances(axes: Axes, trajectory: Trajectory, covariance: np.ndarray, size: float) -> Line2D:
    """Ellipses at poses that stand evenly along the way; ``size`` of the path is in metres."""
    marks = np.linspace(0.0, trajectory.way[-1], min(len(trajectory), MOST_ELLIPSES + 1))[1:]
    rows = np.unique(np.clip(np.searchsorted(trajectory.way, marks), 0, len(trajectory) - 1))
    halves, turn = ellipses(covariance[rows, :2, :2])
    typical = float(np.median(halves[:, 0])) if len(rows) else 0.0
    wanted = _SEEN * size / typical if typical else 1.0
    times = next((times for times in _ENLARGED if times >= wanted), _ENLARGED[-1])
    for place, half, angle in zip(trajectory.poses[rows, :2], halves, turn, strict=True):
        width, height = (2 * times * half).tolist()
        shape = {"width": width, "height": height, "angle": float(np.degrees(angle))}
        axes.add_patch(Ellipse(tuple(place), **shape, fc=to_rgba(DIRECT, 0.15), ec=DIRECT, lw=0.7, zorder=6))
    larger = f", {times} x enlarged" if times > 1 else ""  # short: columns of the legend are narrow
    label = f"{SIGMAS} sigma ({100 * HELD:.0f} %){larger}"
    return Line2D([], [], ls="", marker="o", ms=9, mfc=to_rgba(DIRECT, 0.15), mec=DIRECT, mew=0.7, label=label)


def ellipses(
    covariance: Float[np.ndarray, "poses 2 2"],
) -> tuple[Float[np.ndarray, "poses 2"], Float[np.ndarray, " poses"]]:
    """Half axes, ``SIGMAS`` standard deviations, the longer first, metres; and the direction of that one, radians."""
    value, vector = np.linalg.eigh(covariance)
    longest = vector[:, :, 1]
    return SIGMAS * np.sqrt(np.maximum(value[:, ::-1], 0)), np.arctan2(longest[:, 1], longest[:, 0])
