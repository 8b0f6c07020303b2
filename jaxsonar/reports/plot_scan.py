"""Figures of one scan: the ring, the echo arcs, the accumulator and the lines (paper, figures 1 to 4)."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Wedge
from matplotlib.ticker import MultipleLocator

from jaxsonar import kernels
from jaxsonar.detection.arc_tables import arc_tables
from jaxsonar.detection.connected_components import label_components
from jaxsonar.detection.local_model import LocalModel
from jaxsonar.detection.settings import hough_settings
from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.se2 import compose, transform_points
from jaxsonar.reports.plot_style import (
    CROSS_COLOR,
    DIRECT_COLOR,
    FAINT_COLOR,
    LINE_COLOR,
    PALETTE,
    POINT_COLOR,
    POINT_MARKERS,
    ROBOT_COLOR,
    draw_robot,
    draw_room,
    figure_style,
    finish_plan_view,
    plan_view,
    pole_handles,
    robot_handle,
    wall_handle,
)
from jaxsonar.reports.text import plural
from jaxsonar.scans.echo_batches import pack
from jaxsonar.scans.firing_poses import path_poses
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.measured_paths import measured_paths
from jaxsonar.scans.scan_log import Scan
from jaxsonar.sensors.ring import Ring


def ring_figure(ring: Ring, *, transmitter: int = 0, arc_range: float | None = None) -> Figure:
    """Draw the sensors with their cones, and the arcs of all paths of one transmitter at one range (paper, figure 1).

    Args:
        ring: the sensors.
        transmitter: the transmitter.
        arc_range: half path length of the arcs, metres; by default half the maximum range.
    """
    arc_range = ring.max_range / 2 if arc_range is None else arc_range
    figure, axes = plan_view(f"{ring.name}: {ring.count} sensors, {len(ring.paths)} echo paths")
    for sensor, ((x, y), heading, beam) in enumerate(zip(ring.position, ring.heading, ring.beam, strict=True)):
        from_, to = np.degrees([heading - beam / 2, heading + beam / 2])
        length = arc_range if sensor == transmitter else 0.4 * arc_range
        axes.add_patch(Wedge((x, y), length, from_, to, color=FAINT_COLOR, alpha=0.3, lw=0))
    widths = np.asarray(ring.echo_paths.width)
    audible = np.flatnonzero((ring.paths[:, 0] == transmitter) & (widths > 0))
    offsets = (ring.paths[audible, 1] - transmitter + ring.count // 2) % ring.count - ring.count // 2
    arcs = arc_points(ring, audible, np.full(len(audible), arc_range))
    for arc, offset in zip(arcs, offsets, strict=True):
        axes.plot(*arc.T, color=PALETTE[min(abs(int(offset)), 3)], lw=2.2)
    axes.plot(*ring.position.T, "o", color=ROBOT_COLOR, ms=4)
    axes.plot(*np.asarray(ring.position[transmitter]), "o", color=LINE_COLOR, ms=7)
    for k, ((x, y), heading) in enumerate(zip(ring.position, ring.heading, strict=True)):
        inward = np.array([x, y]) - 0.055 * np.array([np.cos(heading), np.sin(heading)])
        axes.text(inward[0], inward[1], str(k), ha="center", va="center", fontsize=6, color=ROBOT_COLOR)
    handles = [Line2D([], [], color=LINE_COLOR, marker="o", ls="", label=f"transmitter {transmitter}")]
    for distance in sorted({abs(int(o)) for o in offsets}):
        width = np.degrees(widths[audible[np.abs(offsets) == distance][0]])
        label = "direct echo" if distance == 0 else f"cross echo, neighbor {distance}"
        handles.append(Line2D([], [], color=PALETTE[min(distance, 3)], lw=2.2, label=f"{label}: {width:.0f}°"))
    handles.append(Line2D([], [], color=FAINT_COLOR, lw=6, label=f"detection cones, {np.degrees(ring.beam[0]):.0f}°"))
    return finish_plan_view(figure, axes, handles)


def arcs_figure(
    ring: Ring, scan: Scan, *, room: Room | None = None, pose: Float[np.ndarray, "3"] | None = None
) -> Figure:
    """Draw the arcs of a scan; measured paths without an echo as light arcs at the maximum range (paper, figure 3).

    Each arc is drawn where the robot was when the path was measured. Readings that were not renewed are dashed.

    Args:
        ring: the sensors.
        scan: the scan.
        room: the true walls, if known.
        pose: world_from_robot (x, y, theta); by default the robot frame.
    """
    pose = np.zeros(3) if pose is None else pose
    figure, axes = plan_view(f"Scan {scan.scan}: {_echoes(scan)} on {_measured(ring, scan)}")
    handles = _draw_arcs(axes, ring, scan, pose)
    if room is not None:
        draw_room(axes, room)
        handles += [wall_handle(), *pole_handles(room)]
    draw_robot(axes, ring, pose)
    return finish_plan_view(figure, axes, [*handles, robot_handle()])


def lines_figure(
    ring: Ring,
    scan: Scan,
    model: LocalModel,
    *,
    room: Room | None = None,
    pose: Float[np.ndarray, "3"] | None = None,
) -> Figure:
    """Draw the detected lines, corners and edges over the arcs and the true walls (paper, figure 4).

    Args:
        ring: the sensors.
        scan: the scan.
        model: local model of the scan.
        room: the true walls, if known.
        pose: world_from_robot (x, y, theta); by default the robot frame.
    """
    pose = np.zeros(3) if pose is None else pose
    figure, axes = plan_view(f"Scan {scan.scan}: {plural(len(model.lines), 'line')} from {_echoes(scan)}")
    arc_handles = _draw_arcs(axes, ring, scan, pose, alpha=0.35)
    handles = [Line2D([], [], color=LINE_COLOR, lw=3, label="line segment")]
    if room is not None:
        draw_room(axes, room)
        handles.append(wall_handle())
    for number, line in enumerate(model.lines, start=1):
        tangent = _tangent(line.theta)
        footpoint = line.rho * np.array([np.cos(line.theta), np.sin(line.theta)])
        infinite_line = transform_points(pose, footpoint + np.array([[-1.6], [1.6]]) * tangent)
        axes.plot(*infinite_line.T, color=LINE_COLOR, lw=0.8, ls=(0, (4, 3)), zorder=4, scalex=False, scaley=False)
        axes.plot(*transform_points(pose, line.segment).T, color=LINE_COLOR, lw=3.2, solid_capstyle="butt", zorder=5)
        position = transform_points(pose, (footpoint * (1 + 0.12 / max(line.rho, 0.12)))[None])[0]
        axes.text(
            position[0],
            position[1],
            str(number),
            color=LINE_COLOR,
            fontweight="bold",
            ha="center",
            va="center",
            zorder=6,
        )
    handles.append(Line2D([], [], color=LINE_COLOR, lw=0.8, ls=(0, (4, 3)), label="infinite line"))
    handles += _draw_points(axes, model, pose)
    draw_robot(axes, ring, pose)
    return finish_plan_view(figure, axes, [*handles, *arc_handles, robot_handle()])


def accumulator_figure(
    ring: Ring, scan: Scan, model: LocalModel, *, settings: kernels.HoughSettings | None = None
) -> Figure:
    """Draw the accumulator before and after the low pass, and its connected components (paper, section 4)."""
    settings = hough_settings(ring, settings)
    echoes, _ = FlatEchoes.from_log(ring, scan.as_log())
    packed = next(pack(ring, echoes, settings.cells)).packed
    arcs = arc_tables(ring, settings).arcs
    votes, smooth = (np.asarray(image)[0] for image in kernels.accumulators(arcs, packed, settings=settings))
    scans = 1.0 if packed.scans_per_row is None else float(packed.scans_per_row[0])
    level = float(arcs.vote_threshold) * scans  # as kernels.vote: relative to what was measured
    labels = np.abs(label_components((smooth > level)[None])[0][0, :-1])

    with figure_style():
        figure = Figure(figsize=(10.5, 4.2), layout="constrained")
        panels = figure.subplots(1, 3, sharex=True, sharey=True)
    box = (-180, 180, 0, settings.max_rho)
    top = float(votes.max(initial=1))
    titles = ("Votes: points per cell", "After the low pass", f"Components above {level:.0f} points")
    for axes, image, title in zip(panels, (votes, smooth, None), titles, strict=True):
        axes.set_title(title, loc="left", fontsize=10)
        axes.set_xlabel("normal direction θ (deg)")
        axes.xaxis.set_major_locator(MultipleLocator(90))
        if image is not None:
            drawn = axes.imshow(
                np.ma.masked_equal(image.T, 0), origin="lower", extent=box, aspect="auto", cmap="viridis_r", vmax=top
            )
            figure.colorbar(drawn, ax=axes, pad=0.01, aspect=35, label="points")
    palette = ListedColormap(PALETTE)
    labeled = np.ma.masked_equal(labels.T, 0)
    panels[2].imshow((labeled - 1) % 6, origin="lower", extent=box, aspect="auto", cmap=palette, vmin=-0.5, vmax=5.5)
    for line in model.lines:
        panels[2].plot(np.degrees(line.theta), line.rho, "+", color=ROBOT_COLOR, ms=9, mew=1.6)
    panels[2].legend(
        handles=[Line2D([], [], color=ROBOT_COLOR, marker="+", ls="", ms=9, mew=1.6, label="centroid: a line")],
        loc="lower right",
    )
    panels[0].set_ylabel("distance ρ (m)")
    used = np.flatnonzero(votes.any(axis=0))
    panels[0].set_ylim(0, min(settings.max_rho, (used.max(initial=0) + 4) * settings.rho_cell))
    return figure


def arc_points(
    ring: Ring,
    path: Int[np.ndarray, " arcs"],
    half_path: Float[np.ndarray, " arcs"],
    *,
    points: int = 33,
) -> Float[np.ndarray, "arcs points 2"]:
    """Points on echo arcs: circles of direct paths, ellipses of cross paths.

    Args:
        ring: the sensors.
        path: index of the echo path of each arc.
        half_path: half path length of each arc, metres.
        points: points per arc.

    Returns:
        Points in the robot frame, metres.
    """
    return np.asarray(_arc_points(ring.sensors, jnp.asarray(path), jnp.asarray(half_path, jnp.float32), points))


@partial(jax.jit, static_argnames="points")
def _arc_points(sensors: kernels.SensorArray, path: jax.Array, half_path: jax.Array, points: int) -> jax.Array:
    paths = jax.tree.map(lambda leaf: leaf[path], kernels.echo_paths(sensors))
    theta = paths.start[:, None] + paths.width[:, None] * jnp.linspace(0, 1, points)[None]
    one_arc = jax.vmap(kernels.arc_point, in_axes=(None, None, 0))
    return jax.vmap(one_arc)(paths, half_path, theta)


def _draw_points(axes: Axes, model: LocalModel, pose: Float[np.ndarray, "3"]) -> list[Line2D]:
    """Draw corners, edges, circles and undecided reflectors. Returns the legend handles."""
    kinds = {
        POINT_MARKERS["corner"]: ("corner", [(p.x, p.y) for p in model.points if p.kind == "corner"]),
        POINT_MARKERS["edge"]: ("edge or pole", [(p.x, p.y) for p in model.points if p.kind == "edge"]),
        POINT_MARKERS["undecided"]: ("undecided: wall or point", [(u.x, u.y) for u in model.undecided]),
    }
    handles = []
    circles = [p for p in model.points if p.kind == "circle"]
    for one in circles:
        center = transform_points(pose, np.array([[one.x, one.y]]))[0]
        axes.add_patch(Circle((center[0], center[1]), one.radius, fc="white", ec=POINT_COLOR, lw=1.8, zorder=5.5))
    if circles:
        style = {"color": POINT_COLOR, "marker": "o", "ls": "", "ms": 9, "mfc": "white", "mew": 1.8}
        handles.append(Line2D([], [], **style, label="circle (true radius)"))
    for marker, (label, points) in kinds.items():
        style = {"color": POINT_COLOR, "marker": marker, "ls": "", "ms": 7, "mfc": "white", "mew": 1.8, "label": label}
        if points:
            axes.plot(*transform_points(pose, np.array(points)).T, **style, zorder=6)
            handles.append(Line2D([], [], **style))
    return handles


def _tangent(theta: float) -> Float[np.ndarray, "2"]:
    """Unit tangent of a line with this normal direction."""
    return np.array([-np.sin(theta), np.cos(theta)])


def _draw_arcs(axes: Axes, ring: Ring, scan: Scan, pose: Float[np.ndarray, "3"], *, alpha: float = 0.8) -> list[Line2D]:
    """Draw echoes, and paths that were measured and heard nothing. Returns the legend handles."""
    log = scan.as_log()
    path = ring.path_index[scan.tx, scan.rx]
    ranges = np.asarray(ring.corrected(scan.range, scan.tx, scan.rx))
    has_echo = (path >= 0) & (ranges < ring.max_range)  # False for NaN
    audible = measured_paths(ring, log)[0] & (np.asarray(ring.echo_paths.width) > 0)
    no_echo = np.setdiff1d(np.flatnonzero(audible), path[has_echo])
    moved = path_poses(ring, log)
    poses = np.broadcast_to(pose, (len(ring.paths), 3)) if moved is None else compose(pose, moved[0])
    direct, is_old = scan.tx == scan.rx, log.age > 0
    groups: list[tuple[Any, ...]] = [(no_echo, np.full(len(no_echo), ring.max_range), FAINT_COLOR, 0.6, "-")]
    for of_kind, color, width in ((~direct, CROSS_COLOR, 0.9), (direct, DIRECT_COLOR, 1.1)):
        for of_age, style in ((~is_old, "-"), (is_old, (0, (3, 2)))):
            of_it = has_echo & of_kind & of_age
            groups.append((path[of_it], ranges[of_it], color, width, style))
    for rows, arc_ranges, color, width, style in groups:
        if style != "-" and not len(rows):
            continue
        arcs = transform_points(poses[rows][:, None], arc_points(ring, rows, arc_ranges))
        opacity = 1.0 if color == FAINT_COLOR else alpha
        axes.add_collection(LineCollection(list(arcs), colors=color, linewidths=width, alpha=opacity, linestyles=style))
    labels = {DIRECT_COLOR: "direct echo", FAINT_COLOR: f"no echo up to {ring.max_range:g} m"}
    if ring.neighbors:
        labels[CROSS_COLOR] = "cross echo"
    handles = [Line2D([], [], color=color, lw=1.4, label=label) for color, label in labels.items()]
    if (has_echo & is_old).any():
        handles.append(Line2D([], [], color=DIRECT_COLOR, lw=1.4, ls=(0, (3, 2)), label="old reading, not renewed"))
    return handles


def _echoes(scan: Scan) -> str:
    return f"{scan.echo_count} echo{'es' * (scan.echo_count != 1)}"


def _measured(ring: Ring, scan: Scan) -> str:
    """The number of paths that a scan measured, as text."""
    count, paths = int(measured_paths(ring, scan.as_log())[0].sum()), len(ring.paths)
    return plural(paths, "path") if count == paths else f"{plural(count, 'measured path')} of {paths}"
