"""How far extracted lines are from true walls: matches, false lines, deviations, and the bound to hold them against."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from jaxsonar.detection.local_map import LocalModel
from jaxsonar.floor_plans.room import Room, walls_in_robot_frame
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.sensors.range_models import plane_range
from jaxsonar.sensors.ring import Ring
from jaxsonar.simulation.simulator import Simulation
from jaxsonar.simulation.traced_echoes import EchoKind

GATE_RHO = 0.10
"""Metres up to which a line counts as that wall; the paper's largest deviation is a third of it."""
GATE_THETA = float(np.radians(15.0))
"""Radians up to which a line counts as that wall; the paper's largest deviation is half of it."""
CLEAR_ECHOES = 8
"""First-order echoes from which on a wall is expected to be found."""


@dataclass(frozen=True)
class Deviations:
    """Extracted lines against the walls of a simulated room, over a number of scans."""

    scans: int
    echoes: int
    """Echoes that the scans hold."""
    walls: int
    """Walls with CLEAR_ECHOES or more first-order echoes, counted once a scan."""
    found: int
    """How many of those have a line."""
    lines: int
    """Extracted lines."""
    false: int
    """Lines left over: no wall with a first-order echo, or a second line on one."""
    false_at_corners: int
    """Of those, lines that pass a right-angled corner which answered, square to the view of it."""
    rho: Float[np.ndarray, " matches"]
    """Signed deviations in distance of all lines that are walls, metres."""
    theta: Float[np.ndarray, " matches"]
    """Signed deviations in direction, radians."""
    bound_rho: Float[np.ndarray, " matches"]
    """Cramer-Rao bounds of those lines, metres."""
    bound_theta: Float[np.ndarray, " matches"]
    """Cramer-Rao bounds of those lines, radians."""

    @property
    def recall(self) -> float:
        """Share of the walls that have a line; NaN without walls."""
        return self.found / self.walls if self.walls else float("nan")

    @property
    def false_per_scan(self) -> float:
        """False lines a scan; NaN without scans."""
        return self.false / self.scans if self.scans else float("nan")


def compare(
    ring: Ring,
    models: Sequence[LocalModel],
    simulation: Simulation,
    room: Room,
    poses: Float[np.ndarray, "scans 3"],
    *,
    sigma: float,
    judge: Simulation | None = None,
) -> Deviations:
    """Match the lines of each scan to the true walls, one to one, nearest first within the gates.

    Args:
        ring: the sensors that the models come from.
        models: one a scan.
        simulation: the echoes of these scans, with their origin; further scans do not matter.
        room: where they were taken.
        poses: world_from_robot of each scan.
        sigma: range noise, metres, for the bounds.
        judge: simulation of the same scans whose echoes say which walls are to be found, if it is another one.
    """
    judge = simulation if judge is None else judge
    counts = dict.fromkeys(("walls", "found", "lines", "false", "false_at_corners"), 0)
    position = np.asarray(ring.position)
    rows = [np.zeros((0, 4))]
    for index, (model, pose) in enumerate(zip(models, poses, strict=True)):
        truth = np.stack(walls_in_robot_frame(room, pose), axis=-1)
        mine = _plane_echoes(simulation, index)
        heard = np.bincount(simulation.reflector[mine], minlength=len(truth))
        expected = np.bincount(judge.reflector[_plane_echoes(judge, index)], minlength=len(truth)) >= CLEAR_ECHOES
        found = np.array([(line.rho, line.theta) for line in model.lines]).reshape(-1, 2)
        line_index, wall_index = match(found, np.where((heard > 0)[:, None], truth, np.nan))
        false = np.delete(found, line_index, axis=0)
        counts["walls"] += int(expected.sum())
        counts["found"] += int(expected[wall_index].sum())
        counts["lines"] += len(found)
        counts["false"] += len(false)
        counts["false_at_corners"] += int(_at_corner(false, room, pose).sum())
        for line, wall in zip(line_index, wall_index, strict=True):
            tx, rx = ring.paths[simulation.path[mine & (simulation.reflector == wall)]].T
            bound = line_bound(truth[wall], position[tx], position[rx], sigma)
            turn = wrap_angle(found[line, 1] - truth[wall, 1])
            rows.append(np.array([[found[line, 0] - truth[wall, 0], turn, *bound]]))
    table = np.concatenate(rows)
    return Deviations(
        scans=len(models),
        echoes=int((simulation.scan < len(models)).sum()),
        rho=table[:, 0],
        theta=table[:, 1],
        bound_rho=table[:, 2],
        bound_theta=table[:, 3],
        **counts,
    )


def pooled(parts: Sequence[Deviations]) -> Deviations:
    """Several comparisons as one."""
    table: dict[str, Any] = {}
    for field in fields(Deviations):
        values = [getattr(part, field.name) for part in parts]
        table[field.name] = np.concatenate(values) if isinstance(values[0], np.ndarray) else sum(values)
    return Deviations(**table)


def match(
    found: Float[np.ndarray, "lines 2"], truth: Float[np.ndarray, "walls 2"]
) -> tuple[Int[np.ndarray, " matches"], Int[np.ndarray, " matches"]]:
    """One-to-one pairs of lines (rho, theta) within the gates, as many as there can be, then as near as can be."""
    turn = np.abs(wrap_angle(found[:, None, 1] - truth[None, :, 1])) / GATE_THETA
    apart = np.abs(found[:, None, 0] - truth[None, :, 0]) / GATE_RHO
    near = (turn <= 1) & (apart <= 1)
    cost = np.where(near, np.hypot(turn, apart), 1e6)
    lines, walls = linear_sum_assignment(cost)
    good = near[lines, walls]
    return lines[good], walls[good]


def line_bound(
    line: Float[np.ndarray, "2"],
    tx: Float[np.ndarray, "echoes 2"],
    rx: Float[np.ndarray, "echoes 2"],
    sigma: float,
) -> Float[np.ndarray, "2"]:
    """Cramer-Rao bound (standard deviations of rho, metres, and theta, radians) of a plane from its echoes.

    Infinite where the echoes do not determine the line. From the derivatives of the image-source range.

    Args:
        line: (rho, theta).
        tx: transmitters of the echoes, metres.
        rx: receivers of the echoes, metres.
        sigma: independent noise of each range, metres.
    """
    jacobian = plane_range(line, (tx + rx) / 2, (rx - tx) / 2).d_range_d_landmark
    information = jacobian.T @ jacobian
    if np.linalg.matrix_rank(information) < 2:
        return np.full(2, np.inf)
    return sigma * np.sqrt(np.diag(np.linalg.inv(information)))


def _plane_echoes(simulation: Simulation, scan: int) -> Bool[np.ndarray, " echoes"]:
    return (simulation.scan == scan) & (simulation.kind == EchoKind.PLANE)


def _at_corner(
    lines: Float[np.ndarray, "lines 2"], room: Room, pose: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, " lines"]:
    """Lines whose nearest point to the robot is a right-angled corner, within the gates: how a corner's echoes look."""
    junctions = room.junctions
    corners = junctions.vertices[np.unique(junctions.wedge_vertex[junctions.corners])]
    offset = corners - pose[:2]
    direction = np.arctan2(offset[:, 1], offset[:, 0]) - pose[2]
    turn = np.abs(wrap_angle(lines[:, None, 1] - direction))
    apart = np.abs(lines[:, None, 0] - np.hypot(*offset.T))
    return ((turn <= GATE_THETA) & (apart <= GATE_RHO)).any(axis=1)
