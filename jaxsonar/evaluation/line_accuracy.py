"""Accuracy of extracted lines against true walls: matches, false lines, errors, and their Cramer-Rao bounds."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from jaxsonar.detection.local_model import LocalModel
from jaxsonar.evaluation.settings import SETTINGS
from jaxsonar.floor_plans.room import Room, walls_in_robot_frame
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.sensors.range_models import plane_range
from jaxsonar.sensors.ring import Ring
from jaxsonar.simulation.simulator import Simulation
from jaxsonar.simulation.traced_echoes import EchoKind

_GATES = SETTINGS.lines


@dataclass(frozen=True)
class LineAccuracy:
    """Extracted lines compared with the walls of a simulated room, over a number of scans."""

    scans: int
    """Number of scans."""
    echoes: int
    """Number of echoes in the scans."""
    walls: int
    """Number of walls with enough first-order echoes, counted once per scan."""
    found: int
    """Number of those walls that match a line."""
    lines: int
    """Number of extracted lines."""
    false: int
    """Number of unmatched lines: no wall with a first-order echo, or a second line on one."""
    false_at_corners: int
    """Number of false lines that pass through a right-angled corner, perpendicular to the line of sight."""
    rho_error: Float[np.ndarray, " matches"]
    """Signed errors in rho of all matched lines, metres."""
    theta_error: Float[np.ndarray, " matches"]
    """Signed errors in theta of all matched lines, radians."""
    rho_bound: Float[np.ndarray, " matches"]
    """Cramer-Rao bounds of rho of those lines, metres."""
    theta_bound: Float[np.ndarray, " matches"]
    """Cramer-Rao bounds of theta of those lines, radians."""

    @property
    def recall(self) -> float:
        """Fraction of the walls that were found; NaN without walls."""
        return self.found / self.walls if self.walls else float("nan")

    @property
    def false_per_scan(self) -> float:
        """False lines per scan; NaN without scans."""
        return self.false / self.scans if self.scans else float("nan")


def line_accuracy(
    ring: Ring,
    models: Sequence[LocalModel],
    simulation: Simulation,
    room: Room,
    poses: Float[np.ndarray, "scans 3"],
    *,
    sigma: float,
    judge: Simulation | None = None,
) -> LineAccuracy:
    """Match the lines of each scan with the true walls, one to one, within the gates.

    Args:
        ring: the sensors.
        models: one local model per scan.
        simulation: the echoes of these scans, with their origin; further scans do not matter.
        room: the room in which they were simulated.
        poses: world_from_robot of each scan.
        sigma: standard deviation of the ranges, metres, for the bounds.
        judge: another simulation of the same scans, whose echoes determine which walls should be found.
    """
    judge = simulation if judge is None else judge
    counts = dict.fromkeys(("walls", "found", "lines", "false", "false_at_corners"), 0)
    position = np.asarray(ring.position)
    rows = [np.zeros((0, 4))]
    for index, (model, pose) in enumerate(zip(models, poses, strict=True)):
        truth = np.stack(walls_in_robot_frame(room, pose), axis=-1)
        from_plane = _first_order_echoes(simulation, index)
        echoes = np.bincount(simulation.reflector[from_plane], minlength=len(truth))
        judged = np.bincount(judge.reflector[_first_order_echoes(judge, index)], minlength=len(truth))
        expected = judged >= _GATES.min_echoes
        lines = np.array([(line.rho, line.theta) for line in model.lines]).reshape(-1, 2)
        line_index, wall_index = match_lines(lines, np.where((echoes > 0)[:, None], truth, np.nan))
        false = np.delete(lines, line_index, axis=0)
        counts["walls"] += int(expected.sum())
        counts["found"] += int(expected[wall_index].sum())
        counts["lines"] += len(lines)
        counts["false"] += len(false)
        counts["false_at_corners"] += int(_passes_corner(false, room, pose).sum())
        for line, wall in zip(line_index, wall_index, strict=True):
            tx, rx = ring.paths[simulation.path[from_plane & (simulation.reflector == wall)]].T
            bound = cramer_rao_bound(truth[wall], position[tx], position[rx], sigma)
            theta_error = wrap_angle(lines[line, 1] - truth[wall, 1])
            rows.append(np.array([[lines[line, 0] - truth[wall, 0], theta_error, *bound]]))
    table = np.concatenate(rows)
    return LineAccuracy(
        scans=len(models),
        echoes=int((simulation.scan < len(models)).sum()),
        rho_error=table[:, 0],
        theta_error=table[:, 1],
        rho_bound=table[:, 2],
        theta_bound=table[:, 3],
        **counts,
    )


def pool(parts: Sequence[LineAccuracy]) -> LineAccuracy:
    """Several comparisons as one."""
    table: dict[str, Any] = {}
    for field in fields(LineAccuracy):
        values = [getattr(part, field.name) for part in parts]
        table[field.name] = np.concatenate(values) if isinstance(values[0], np.ndarray) else sum(values)
    return LineAccuracy(**table)


def match_lines(
    lines: Float[np.ndarray, "lines 2"], truth: Float[np.ndarray, "walls 2"]
) -> tuple[Int[np.ndarray, " matches"], Int[np.ndarray, " matches"]]:
    """One-to-one pairs of lines and walls (rho, theta) within the gates.

    The number of pairs is as large as possible, then the sum of their distances as small as possible. NaN matches
    nothing.

    Returns:
        The rows of the lines and of the walls.
    """
    angle = np.abs(wrap_angle(lines[:, None, 1] - truth[None, :, 1])) / _GATES.gate_theta
    distance = np.abs(lines[:, None, 0] - truth[None, :, 0]) / _GATES.gate_rho
    near = (angle <= 1) & (distance <= 1)
    cost = np.where(near, np.hypot(angle, distance), 1e6)
    line, wall = linear_sum_assignment(cost)
    good = near[line, wall]
    return line[good], wall[good]


def cramer_rao_bound(
    line: Float[np.ndarray, "2"],
    tx: Float[np.ndarray, "echoes 2"],
    rx: Float[np.ndarray, "echoes 2"],
    sigma: float,
) -> Float[np.ndarray, "2"]:
    """Cramer-Rao bound of a wall from its echoes: standard deviations of rho (metres) and theta (radians).

    Infinite if the echoes do not determine the line.

    Args:
        line: (rho, theta).
        tx: positions of the transmitters, metres.
        rx: positions of the receivers, metres.
        sigma: standard deviation of each range, independent, metres.
    """
    jacobian = plane_range(line, (tx + rx) / 2, (rx - tx) / 2).d_range_d_landmark
    information = jacobian.T @ jacobian
    if np.linalg.matrix_rank(information) < 2:
        return np.full(2, np.inf)
    return sigma * np.sqrt(np.diag(np.linalg.inv(information)))


def _first_order_echoes(simulation: Simulation, scan: int) -> Bool[np.ndarray, " echoes"]:
    return (simulation.scan == scan) & (simulation.kind == EchoKind.PLANE)


def _passes_corner(
    lines: Float[np.ndarray, "lines 2"], room: Room, pose: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, " lines"]:
    """Lines whose footpoint is a right-angled corner, within the gates; the echoes of a corner resemble them."""
    junctions = room.junctions
    corners = junctions.vertices[np.unique(junctions.wedge_vertex[junctions.corners])]
    offset = corners - pose[:2]
    direction = np.arctan2(offset[:, 1], offset[:, 0]) - pose[2]
    angle = np.abs(wrap_angle(lines[:, None, 1] - direction))
    distance = np.abs(lines[:, None, 0] - np.hypot(*offset.T))
    return ((angle <= _GATES.gate_theta) & (distance <= _GATES.gate_rho)).any(axis=1)
