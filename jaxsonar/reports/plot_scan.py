"""Figures of one scan: the ring, the echoes, the accumulator and the lines (paper, figures 1 to 4).

Each function draws one figure and returns it; ``figures.save`` writes it.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Wedge
from matplotlib.ticker import MultipleLocator

from jaxsonar import kernels
from jaxsonar.detection.arc_tables import arc_tables
from jaxsonar.detection.connected_components import label_components
from jaxsonar.detection.local_map import LocalModel
from jaxsonar.detection.settings import hough_settings
from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.se2 import transform_points
from jaxsonar.reports.plot_style import (
    CROSS,
    DIRECT,
    FAINT,
    LINE,
    PALETTE,
    ROBOT,
    draw_robot,
    draw_walls,
    finish,
    plan,
    pole_handles,
    robot_handle,
    styled,
    wall_handle,
)
from jaxsonar.scans.echo_batches import pack
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Scan
from jaxsonar.sensors.ring import Ring


def ring_figure(ring: Ring, *, transmitter: int = 0, reach: float | None = None) -> Figure:
    """The sensors with their cones, and the arcs of all paths of one transmitter at one range (paper, figure 1).

    Args:
        ring: the sensors.
        transmitter: the sensor that fires.
        reach: half path length of the drawn arcs, metres; half the maximum range if left out.
    """
    reach = ring.max_range / 2 if reach is None else reach
    figure, axes = plan(f"{ring.name}: {ring.count} sensors, {len(ring.paths)} echo paths")
    for sensor, ((x, y), heading, beam) in enumerate(zip(ring.position, ring.heading, ring.beam, strict=True)):
        from_, to = np.degrees([heading - beam / 2, heading + beam / 2])
        length = reach if sensor == transmitter else 0.4 * reach
        axes.add_patch(Wedge((x, y), length, from_, to, color=FAINT, alpha=0.3, lw=0))
    widths = np.asarray(ring.echo_paths.width)
    audible = np.flatnonzero((ring.paths[:, 0] == transmitter) & (widths > 0))
    offsets = (ring.paths[audible, 1] - transmitter + ring.count // 2) % ring.count - ring.count // 2
    shades = PALETTE
    arcs = arc_points(ring, audible, np.full(len(audible), reach))
    for arc, offset in zip(arcs, offsets, strict=True):
        axes.plot(*arc.T, color=shades[min(abs(int(offset)), 3)], lw=2.2)
    axes.plot(*ring.position.T, "o", color=ROBOT, ms=4)
    axes.plot(*np.asarray(ring.position[transmitter]), "o", color=LINE, ms=7)
    for k, ((x, y), heading) in enumerate(zip(ring.position, ring.heading, strict=True)):
        inward = np.array([x, y]) - 0.055 * np.array([np.cos(heading), np.sin(heading)])
        axes.text(inward[0], inward[1], str(k), ha="center", va="center", fontsize=6, color=ROBOT)
    handles = [Line2D([], [], color=LINE, marker="o", ls="", label=f"sensor {transmitter} fires")]
    for distance in sorted({abs(int(o)) for o in offsets}):
        width = np.degrees(widths[audible[np.abs(offsets) == distance][0]])
        who = "direct echo" if distance == 0 else f"cross echo, neighbor {distance}"
        handles.append(Line2D([], [], color=shades[min(distance, 3)], lw=2.2, label=f"{who}: {width:.0f}°"))
    handles.append(Line2D([], [], color=FAINT, lw=6, label=f"detection cones, {np.degrees(ring.beam[0]):.0f}°"))
    return finish(figure, axes, handles)


def arcs_figure(
    ring: Ring, scan: Scan, *, room: Room | None = None, pose: Float[np.ndarray, "3"] | None = None
) -> Figure:
    """All arcs of one scan, paths without an echo as light arcs at the maximum range (paper, figure 3).

    Args:
        ring: the sensors.
        scan: its echoes.
        room: the true walls, if they are known.
        pose: world_from_robot (x, y, theta); the robot frame if left out.
    """
    pose = np.zeros(3) if pose is None else pose
    figure, axes = plan(f"Scan {scan.scan}: {len(scan.tx)} echoes on {len(ring.paths)} paths")
    _draw_arcs(axes, ring, scan, pose)
    handles = _arc_handles(ring)
    if room is not None:
        draw_walls(axes, room)
        handles += [wall_handle(), *pole_handles(room)]
    draw_robot(axes, ring, pose)
    return finish(figure, axes, [*handles, robot_handle()])


def lines_figure(
    ring: Ring,
    scan: Scan,
    model: LocalModel,
    *,
    room: Room | None = None,
    pose: Float[np.ndarray, "3"] | None = None,
) -> Figure:
    """Extracted lines in bold, corners and edges, over the arcs and, if it is known, the reference (paper, figure 4).

    Args:
        ring: the sensors.
        scan: its echoes.
        model: what was found in it.
        room: the true walls, if they are known.
        pose: world_from_robot (x, y, theta); the robot frame if left out.
    """
    pose = np.zeros(3) if pose is None else pose
    count = len(model.lines)
    figure, axes = plan(f"Scan {scan.scan}: {count} line{'' if count == 1 else 's'} from {len(scan.tx)} echoes")
    _draw_arcs(axes, ring, scan, pose, alpha=0.35)
    handles = [Line2D([], [], color=LINE, lw=3, label="extracted line, its extent")]
    if room is not None:
        draw_walls(axes, room)
        handles.append(wall_handle())
    for number, line in enumerate(model.lines, start=1):
        along = _tangent(line.theta)
        foot = line.rho * np.array([np.cos(line.theta), np.sin(line.theta)])
        infinite = transform_points(pose, foot + np.array([[-1.6], [1.6]]) * along)
        axes.plot(*infinite.T, color=LINE, lw=0.8, ls=(0, (4, 3)), zorder=4, scalex=False, scaley=False)
        axes.plot(*transform_points(pose, line.segment).T, color=LINE, lw=3.2, solid_capstyle="butt", zorder=5)
        place = transform_points(pose, (foot * (1 + 0.12 / max(line.rho, 0.12)))[None])[0]
        axes.text(place[0], place[1], str(number), color=LINE, fontweight="bold", ha="center", va="center", zorder=6)
    handles.append(Line2D([], [], color=LINE, lw=0.8, ls=(0, (4, 3)), label="the same line, continued"))
    handles += _draw_points(axes, model, pose)
    draw_robot(axes, ring, pose)
    handles += _arc_handles(ring)
    return finish(figure, axes, [*handles, robot_handle()])


def accumulator_figure(
    ring: Ring, scan: Scan, model: LocalModel, *, settings: kernels.HoughSettings | None = None
) -> Figure:
    """The accumulator before and after the low pass, and the components above the threshold (paper, section 4)."""
    settings = hough_settings(ring, settings)
    echoes, _ = FlatEchoes.from_log(ring, scan.as_log())
    packed = next(pack(echoes, settings.cells)).packed
    arcs = arc_tables(ring, settings).arcs
    votes, smooth = (np.asarray(image)[0] for image in kernels.accumulators(arcs, packed, settings=settings))
    level = float(arcs.level)
    labels = np.abs(label_components((smooth > level)[None])[0][0, :-1])

    with styled():
        figure = Figure(figsize=(10.5, 4.2), layout="constrained")
        panels = figure.subplots(1, 3, sharex=True, sharey=True)
    box = (-180, 180, 0, settings.max_rho)
    top = float(votes.max(initial=1))
    titles = ("Votes: points per cell", "After the low pass", f"Components above {level:.0f} points")
    for axes, image, title in zip(panels, (votes, smooth, None), titles, strict=True):
        axes.set_title(title, loc="left", fontsize=10)
        axes.set_xlabel("direction of the normal θ (deg)")
        axes.xaxis.set_major_locator(MultipleLocator(90))
        if image is not None:
            drawn = axes.imshow(
                np.ma.masked_equal(image.T, 0), origin="lower", extent=box, aspect="auto", cmap="viridis_r", vmax=top
            )
            figure.colorbar(drawn, ax=axes, pad=0.01, aspect=35, label="points")
    palette = ListedColormap(PALETTE)
    labelled = np.ma.masked_equal(labels.T, 0)
    panels[2].imshow((labelled - 1) % 6, origin="lower", extent=box, aspect="auto", cmap=palette, vmin=-0.5, vmax=5.5)
    for line in model.lines:
        panels[2].plot(np.degrees(line.theta), line.rho, "+", color=ROBOT, ms=9, mew=1.6)
    panels[2].legend(
        handles=[Line2D([], [], color=ROBOT, marker="+", ls="", ms=9, mew=1.6, label="centre of gravity: a line")],
        loc="lower right",
    )
    panels[0].set_ylabel("distance ρ (m)")
    used = np.flatnonzero(votes.any(axis=0))
    panels[0].set_ylim(0, min(settings.max_rho, (used.max(initial=0) + 4) * settings.rho_cell))
    return figure


def arc_points(
    ring: Ring,
    path: Int[np.ndarray, " arcs"],
    reach: Float[np.ndarray, " arcs"],
    *,
    points: int = 33,
) -> Float[np.ndarray, "arcs points 2"]:
    """Points of echo arcs in the robot frame, metres: circles of direct, ellipses of cross paths."""
    return np.asarray(_arc_points(ring.sensors, jnp.asarray(path), jnp.asarray(reach, jnp.float32), points))


@partial(jax.jit, static_argnames="points")
def _arc_points(sensors: kernels.Sensors, path: jax.Array, reach: jax.Array, points: int) -> jax.Array:
    paths = jax.tree.map(lambda leaf: leaf[path], kernels.echo_paths(sensors))
    theta = paths.start[:, None] + paths.width[:, None] * jnp.linspace(0, 1, points)[None]
    one_arc = jax.vmap(kernels.arc_point, in_axes=(None, None, 0))
    return jax.vmap(one_arc)(paths, reach, theta)


def _draw_points(axes: Axes, model: LocalModel, pose: Float[np.ndarray, "3"]) -> list[Line2D]:
    """Corners, edges and what is undecided, and their handles."""
    kinds = {
        "s": ("corner", [(p.x, p.y) for p in model.points if p.kind == "corner"]),
        "D": ("edge or pole", [(p.x, p.y) for p in model.points if p.kind == "edge"]),
        "o": ("wall or point, not decided", [(u.x, u.y) for u in model.undecided]),
    }
    handles = []
    for marker, (label, places) in kinds.items():
        style = {"color": LINE, "marker": marker, "ls": "", "ms": 7, "mfc": "white", "mew": 1.8, "label": label}
        if places:
            axes.plot(*transform_points(pose, np.array(places)).T, **style, zorder=6)
            handles.append(Line2D([], [], **style))
    return handles


def _tangent(theta: float) -> Float[np.ndarray, "2"]:
    """Unit tangent of a line."""
    return np.array([-np.sin(theta), np.cos(theta)])


def _draw_arcs(axes: Axes, ring: Ring, scan: Scan, pose: Float[np.ndarray, "3"], *, alpha: float = 0.8) -> None:
    path = ring.path_index[scan.tx, scan.rx]
    audible = np.asarray(ring.echo_paths.width) > 0
    reach = np.asarray(ring.corrected(scan.range, scan.tx, scan.rx))
    heard = (path >= 0) & (reach < ring.max_range)
    silent = np.setdiff1d(np.flatnonzero(audible), path[heard])
    direct = scan.tx == scan.rx
    for rows, ranges, colour, width in (
        (silent, np.full(len(silent), ring.max_range), FAINT, 0.6),
        (path[heard & ~direct], reach[heard & ~direct], CROSS, 0.9),
        (path[heard & direct], reach[heard & direct], DIRECT, 1.1),
    ):
        arcs = transform_points(pose, arc_points(ring, rows, ranges))
        axes.add_collection(
            LineCollection(list(arcs), colors=colour, linewidths=width, alpha=1.0 if colour == FAINT else alpha)
        )


def _arc_handles(ring: Ring) -> list[Line2D]:
    labels = {DIRECT: "direct echo", FAINT: f"no echo up to {ring.max_range:g} m"}
    if ring.neighbors:
        labels[CROSS] = "cross echo"
    return [Line2D([], [], color=colour, lw=1.4, label=label) for colour, label in labels.items()]
