"""Walls and points around short pieces of the trajectory, by the poses of the log. NumPy only, nothing is compiled.

Each group of consecutive scans votes for walls in a Hough accumulator, in which every scan has one vote per cell. The
echoes of a peak are fitted by a wall and by a point, and the better one is kept.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.geometry.robust_statistics import robust_deviation
from jaxsonar.geometry.se2 import rotate, transform_points, unit, wrap_angle
from jaxsonar.scans.firing_poses import poses_at, reading_poses
from jaxsonar.scans.measured_paths import path_rows
from jaxsonar.scans.readings import is_repeated, measurement_times
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.range_models import RANGE_OF_KIND
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class LocalReflectorSettings:
    """Constants of the local walls. Chosen by hand on random rooms of the simulator."""

    min_scans: int = 4
    """Scans of a group that must see a wall or point."""
    min_range: float = 0.05
    """Shorter echoes are left out, metres."""
    extent: float = 30.0
    """Scans farther than this from the middle of their group, and walls farther than this plus the maximum range, are
    left out, metres: the pose of a glitch is of no use."""
    angle_cell: float = float(np.radians(2.0))
    """Cell of the accumulator, radians, ..."""
    range_cell: float = 0.025
    """... and metres."""
    walls: int = 8
    """Usual largest number of walls and points of a group."""
    gate: float = 0.08
    """An echo farther than this from the range of a peak does not belong to it, metres."""
    cone_margin: float = float(np.radians(4.0))
    """Margin of the detection cones, radians."""
    suppressed: tuple[float, float] = (float(np.radians(10.0)), 0.15)
    """Neighborhood of a peak in which no other one is sought, radians and metres."""
    iterations: int = 8
    """Iterations of the fit of one wall or point."""
    tukey: float = 4.685
    """Tuning constant of Tukey's biweight, standard deviations: 95 % efficiency for normally distributed errors."""
    min_noise: float = 0.002
    """Least standard deviation of the residuals in these fits, metres."""


SETTINGS = LocalReflectorSettings()


@dataclass(frozen=True, eq=False)
class PosedEchoes:
    """Echoes of groups of consecutive scans. A group's frame has the axes of the world and its middle as origin."""

    ring: Ring
    path: Int[np.ndarray, " echoes"]
    """Row of ``Ring.paths``."""
    range: Float[np.ndarray, " echoes"]
    """Corrected range, metres."""
    scan: Int[np.ndarray, " echoes"]
    """Row of the scan in the log."""
    group: Int[np.ndarray, " echoes"]
    """Group of the scan, ascending."""
    pose: Float[np.ndarray, "echoes 3"]
    """group_from_robot when the echo was measured: x, y (m), theta (rad)."""
    time: Float[np.ndarray, " echoes"]
    """When the echo was measured, seconds."""
    origin: Float[np.ndarray, "echoes 2"]
    """Origin of the group of the echo, world frame, metres."""
    samples: Float[np.ndarray, "samples 4"]
    """Times (s) and poses of the robot, world frame, in ascending order."""

    @property
    def count(self) -> int:
        """Number of groups."""
        return int(self.group[-1]) + 1 if len(self.group) else 0

    @cached_property
    def has_times(self) -> bool:
        """Whether poses at other times are known."""
        return len(self.samples) > 1

    def poses_after(self, lag: float, echo: Int[np.ndarray, " rows"]) -> Float[np.ndarray, "rows 3"]:
        """group_from_robot a time (seconds) after echoes were measured."""
        if not (lag and self.has_times):
            return self.pose[echo]
        pose = poses_at(self.samples[:, 0], self.samples[:, 1:], self.time[echo] + lag)
        pose[:, :2] -= self.origin[echo]
        return pose

    def geometry(
        self, pose: Float[np.ndarray, "rows 3"], path: Int[np.ndarray, " rows"]
    ) -> tuple[Float[np.ndarray, "rows 2"], Float[np.ndarray, "rows 2"]]:
        """Midpoints and half baselines of paths with these poses of the robot, frame of the group, metres."""
        paths = self.ring.exact_paths
        midpoint, baseline = np.asarray(paths.midpoint)[path], np.asarray(paths.half_baseline)[path]
        return transform_points(pose, midpoint), rotate(baseline, pose[:, 2])


@dataclass(frozen=True, eq=False)
class LocalReflectors:
    """Walls and points of all groups, and the echoes that they explain."""

    kind: Int[np.ndarray, " reflectors"]
    """PLANE or CORNER."""
    parameters: Float[np.ndarray, "reflectors 2"]
    """(rho, theta) of a wall, (x, y) of a point, frame of its group; metres, radians."""
    group: Int[np.ndarray, " reflectors"]
    """Its group."""
    echo: Int[np.ndarray, " explained"]
    """Echo of ``PosedEchoes``."""
    reflector: Int[np.ndarray, " explained"]
    """The reflector that explains it."""


def group_echoes(ring: Ring, log: Log, groups: Sequence[Int[np.ndarray, "_"]]) -> PosedEchoes:
    """The echoes of groups of scans.

    Args:
        ring: the sensors.
        log: the scans.
        groups: rows of the scans of each group, all with a pose (``pose_agreement.select_groups``).
    """
    of_scan, origin = np.full(len(log), -1), np.zeros((len(log), 2))
    for number, rows in enumerate(groups):
        of_scan[rows] = number
        origin[rows] = np.median(log.pose[rows, :2], axis=0)
    path = path_rows(ring, log.tx, log.rx)
    corrected = np.asarray(ring.corrected(log.range, log.tx, log.rx))
    used = (of_scan[log.echo_scan] >= 0) & (path >= 0) & ~is_repeated(log)
    used &= (corrected > SETTINGS.min_range) & (corrected < ring.max_range)  # False for silent readings
    used[used] = np.hypot(*(reading_poses(log)[used, :2] - origin[log.echo_scan[used]]).T) < SETTINGS.extent
    row = np.flatnonzero(used)
    scan = log.echo_scan[row]
    row = row[np.argsort(of_scan[scan], kind="stable")]
    scan = log.echo_scan[row]
    _, group = np.unique(of_scan[scan], return_inverse=True)
    pose = reading_poses(log)[row]
    pose[:, :2] -= origin[scan]
    samples = log.pose_samples
    samples = samples[np.isfinite(samples).all(axis=1)]
    _, first = np.unique(samples[:, 0], return_index=True)
    return PosedEchoes(
        ring, path[row], corrected[row], scan, group, pose, measurement_times(log)[row], origin[scan], samples[first]
    )


def find_reflectors(
    groups: PosedEchoes, pose: Float[np.ndarray, "echoes 3"], most: int = SETTINGS.walls
) -> LocalReflectors:
    """Find walls and points in each group.

    Args:
        groups: the echoes.
        pose: group_from_robot of each echo: x, y (m), theta (rad).
        most: largest number of walls and points of a group.
    """
    found = [
        (number, *one)
        for number in range(groups.count)
        for one in _reflectors_of_group(groups, np.flatnonzero(groups.group == number), pose, most)
    ]
    kind, parameters = np.array([one[1] for one in found], int), np.array([one[2] for one in found]).reshape(-1, 2)
    echoes = [one[3] for one in found]
    reflector = np.repeat(np.arange(len(found)), [len(one) for one in echoes])
    echo = np.concatenate([np.zeros(0, int), *echoes])
    return LocalReflectors(kind, parameters, np.array([one[0] for one in found], int), echo, reflector)


def _reflectors_of_group(
    groups: PosedEchoes, echo: Int[np.ndarray, " echoes"], pose: Float[np.ndarray, "all 3"], most: int
) -> Iterator[tuple[int, Float[np.ndarray, " 2"], Int[np.ndarray, " explained"]]]:
    """Kind, parameters and echoes of the reflectors of a group, the one with the most scans first."""
    votes, start = _votes(groups, echo, pose[echo])
    half = np.asarray(groups.ring.exact_paths.width)[groups.path[echo]] / 2
    center = np.asarray(groups.ring.exact_paths.start)[groups.path[echo]] + half + pose[echo, 2]
    midpoint, baseline = groups.geometry(pose[echo], groups.path[echo])
    free, scan = np.ones(len(echo), bool), groups.scan[echo]
    around = np.ceil(np.array(SETTINGS.suppressed) / [SETTINGS.angle_cell, SETTINGS.range_cell]).astype(int)
    for _ in range(most):
        angle, distance = np.unravel_index(votes.argmax(), votes.shape)
        if votes[angle, distance] < SETTINGS.min_scans:
            return
        near = np.arange(angle - around[0], angle + around[0] + 1) % len(votes)
        votes[near, max(0, distance - around[1]) : distance + around[1] + 1] = 0
        theta, rho = angle * SETTINGS.angle_cell, (distance + 0.5) * SETTINGS.range_cell + start
        seen = free & (np.abs(wrap_angle(theta - center)) < half + SETTINGS.cone_margin)
        predicted = RANGE_OF_KIND[kernels.PLANE](np.array([rho, theta]), midpoint, baseline).range
        row = np.flatnonzero(seen & (np.abs(groups.range[echo] - predicted) < SETTINGS.gate))
        if len(np.unique(scan[row])) < SETTINGS.min_scans:
            continue
        kind, parameters, inlier = _best_kind(
            np.array([rho, theta]), groups.range[echo[row]], midpoint[row], baseline[row]
        )
        row = row[inlier]
        if len(np.unique(scan[row])) >= SETTINGS.min_scans and len(row) > SETTINGS.min_scans:
            free[row] = False
            yield kind, parameters, echo[row]


def _votes(
    groups: PosedEchoes, echo: Int[np.ndarray, " echoes"], pose: Float[np.ndarray, "echoes 3"]
) -> tuple[Int[np.ndarray, "angles distances"], float]:
    """Number of scans that vote for each wall (theta, rho), and the first rho, metres."""
    paths, path = groups.ring.exact_paths, groups.path[echo]
    width = np.asarray(paths.width)[path]
    angles = round(2 * np.pi / SETTINGS.angle_cell)
    steps = np.arange(int(np.ceil(width.max(initial=0) / SETTINGS.angle_cell)) + 1)
    theta = np.asarray(paths.start)[path][:, None] + pose[:, None, 2] + steps * SETTINGS.angle_cell
    normal, (midpoint, baseline) = unit(theta), groups.geometry(pose, path)
    across = baseline[:, None, 1] * normal[..., 0] - baseline[:, None, 0] * normal[..., 1]
    height = np.sqrt(np.maximum(groups.range[echo][:, None] ** 2 - across**2, 0))
    rho = (midpoint[:, None] * normal).sum(axis=-1) + height
    inside = (steps * SETTINGS.angle_cell <= width[:, None]) & (np.abs(rho) < SETTINGS.extent + groups.ring.max_range)
    start = float(rho.min(initial=0, where=inside)) - SETTINGS.range_cell
    column = (np.where(inside, rho - start, 0) / SETTINGS.range_cell).astype(int)
    row = np.round(theta / SETTINGS.angle_cell).astype(int) % angles
    _, scan = np.unique(groups.scan[echo], return_inverse=True)
    voted = np.zeros((int(scan.max(initial=0)) + 1, angles, int(column.max(initial=0)) + 2), bool)
    voted[np.broadcast_to(scan[:, None], row.shape)[inside], row[inside], column[inside]] = True
    wide = voted.copy()
    wide[..., 1:] |= voted[..., :-1]
    wide[..., :-1] |= voted[..., 1:]
    return wide.sum(axis=0, dtype=np.int64), start


def _best_kind(
    plane: Float[np.ndarray, " 2"],
    measured: Float[np.ndarray, " echoes"],
    midpoint: Float[np.ndarray, "echoes 2"],
    baseline: Float[np.ndarray, "echoes 2"],
) -> tuple[int, Float[np.ndarray, " 2"], Bool[np.ndarray, " echoes"]]:
    """The wall, or the point, that fits echoes better, and the echoes that it explains."""
    point = midpoint.mean(axis=0) + np.median(measured) * unit(plane[1])
    fits = []
    for kind, parameters in ((kernels.PLANE, plane), (kernels.CORNER, point)):
        residual = np.zeros(len(measured))
        for _ in range(SETTINGS.iterations):
            predicted = RANGE_OF_KIND[kind](parameters, midpoint, baseline)
            residual = measured - predicted.range
            weight = biweight(residual, residual_noise(residual))
            jacobian = predicted.d_range_d_landmark
            information = jacobian.T @ (weight[:, None] * jacobian) + 1e-6 * np.eye(2)
            step = np.linalg.solve(information, jacobian.T @ (weight * residual))
            parameters = parameters + np.clip(step, -0.2, 0.2)
        fits.append((kind, parameters, residual))
    noise = min(residual_noise(fit[2]) for fit in fits)
    limit = SETTINGS.tukey * noise
    kind, parameters, residual = min(fits, key=lambda fit: float(np.minimum(np.abs(fit[2]), limit).sum()))
    return kind, parameters, np.abs(residual) < limit


def residual_noise(residual: Float[np.ndarray, " echoes"]) -> float:
    """Robust standard deviation of residuals, metres, at least ``min_noise``."""
    return max(robust_deviation(residual, center=0.0), SETTINGS.min_noise)


def biweight(residual: Float[np.ndarray, " echoes"], noise: float) -> Float[np.ndarray, " echoes"]:
    """Tukey's weights of residuals with this standard deviation."""
    return np.clip(1 - (residual / (SETTINGS.tukey * noise)) ** 2, 0, None) ** 2
