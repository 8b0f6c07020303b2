"""Simulated scans with the true reflectors: random rooms, single reflectors, three walls."""

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from benchmarks.detection.conditions import Condition
from benchmarks.detection.plots import KINDS
from jaxsonar import Log, Ring, Room, random_pose, random_room, simulate
from jaxsonar.evaluation.line_accuracy import cramer_rao_bound
from jaxsonar.floor_plans.room import walls_in_robot_frame
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.simulation.acoustics import Acoustics
from jaxsonar.simulation.traced_echoes import EchoKind

POSES = 4
"""Poses in each room. 64 rooms fill a batch of 256 scans, 12 rooms (quick) three of 16: few programs are compiled."""

RANGES = 0.5, 1.8
"""Minimum and maximum distance of single reflectors and of the three walls, metres."""
RADII = 0.05, 0.1, 0.2, 0.5, 1.0
"""Radii of single circles, metres: from the leg of a table to a round wall, as in the observability of a ring."""


@dataclass(frozen=True)
class Truth:
    """True reflectors of one scan that produced echoes, robot frame."""

    room: int
    """Index of the room. Scans of one room are not independent."""
    polar: Float[np.ndarray, "reflectors 2"]
    """Distance (metres) and direction (radians); rho and theta of a plane; the nearest point of a circle."""
    kind: Int[np.ndarray, " reflectors"]
    """Index into KINDS."""
    echoes: Int[np.ndarray, " reflectors"]
    """Number of received first-order echoes."""
    bound: Float[np.ndarray, "reflectors 2"]
    """Cramer-Rao bound of planes: standard deviations of rho and theta; infinite for other kinds."""

    @classmethod
    def of(cls, ring: Ring, polar, kind, owner, path, *, sigma: float, room: int) -> "Truth":
        """From all reflectors, and for each echo the row of its reflector, or -1."""
        echoes = np.bincount(owner[owner >= 0], minlength=len(polar))
        bound = np.full((len(polar), 2), np.inf)
        position = np.asarray(ring.position)
        for row in np.flatnonzero((kind == 0) & (echoes > 0)):
            tx, rx = ring.paths[path[owner == row]].T
            bound[row] = cramer_rao_bound(polar[row], position[tx], position[rx], sigma)
        some = echoes > 0
        return cls(room, polar[some], np.asarray(kind)[some], echoes[some], bound[some])


@dataclass(frozen=True)
class Scans:
    """Scans of one ring with the truth for each."""

    ring: Ring
    log: Log
    truth: list[Truth]


def random_scans(condition: Condition, rooms: int, poses: int, seed: int) -> Scans:
    """Random poses in random rooms. The same seed gives the same rooms and poses in every condition."""
    ring, truth, parts = condition.ring, [], []
    for k in range(rooms):
        rng = np.random.default_rng([seed, k])
        room = random_room(rng, columns=condition.columns)
        pose = np.stack([random_pose(rng, room) for _ in range(poses)])
        echoes = simulate(
            ring,
            room,
            pose,
            sigma=condition.sigma,
            dropout=condition.lost,
            clutter=condition.false,
            beams=condition.beams,
            seed=int(rng.integers(2**31)),
        )
        parts.append((echoes.scan + k * poses, echoes.path, echoes.range))
        for index in range(poses):
            mine = echoes.scan == index
            polar, kind, owner = reflectors_in(room, pose[index], echoes.kind[mine], echoes.reflector[mine])
            truth.append(Truth.of(ring, polar, kind, owner, echoes.path[mine], sigma=condition.sigma, room=k))
    scan, path, ranges = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Scans(ring, log_of(ring, scan, path, ranges, rooms * poses), truth)


def reflectors_in(
    room: Room, pose: Float[np.ndarray, "3"], kind: Int[np.ndarray, " echoes"], reflector: Int[np.ndarray, " echoes"]
) -> tuple[Float[np.ndarray, "reflectors 2"], Int[np.ndarray, " reflectors"], Int[np.ndarray, " echoes"]]:
    """Polar position and kind of all reflectors in the robot frame, and the reflector of each echo.

    Echoes of second order, false ones and crosstalk have none (-1). Collinear walls, such as the two parts beside a
    door, are one plane.
    """
    walls = np.stack(walls_in_robot_frame(room, pose), axis=-1)
    apart = np.abs(walls[:, None] - walls)
    line = ((apart[..., 0] < 1e-6) & (np.minimum(apart[..., 1], 2 * np.pi - apart[..., 1]) < 1e-6)).argmax(axis=1)
    vertices = room.junctions.vertices
    points = np.concatenate([vertices, vertices, room.poles, room.circles[:, :2]]) - pose[:2]
    radius = np.append(np.zeros(len(points) - len(room.circles)), room.circles[:, 2])
    bearing = wrap_angle(np.arctan2(points[:, 1], points[:, 0]) - pose[2])
    point_polar = np.stack([np.hypot(*points.T) - radius, bearing], axis=-1)
    first = {
        EchoKind.CORNER: len(walls),
        EchoKind.EDGE: len(walls) + len(vertices),
        EchoKind.POLE: len(walls) + 2 * len(vertices),
        EchoKind.CIRCLE: len(walls) + 2 * len(vertices) + len(room.poles),
    }
    owner = np.full(len(kind), -1)
    plane = kind == EchoKind.PLANE
    owner[plane] = line[reflector[plane]]
    for of, begin in first.items():
        owner[kind == of] = begin + reflector[kind == of]
    counts = len(walls), len(vertices), len(vertices), len(room.poles), len(room.circles)
    kinds = np.repeat([KINDS.index(kind) for kind in ("plane", "corner", "edge", "edge", "circle")], counts)
    return np.concatenate([walls, point_polar]), kinds, owner


def single_reflectors(condition: Condition, kind: str, count: int, seed: int) -> Scans:
    """Scans of one plane, one right-angled corner, one edge (the end of a thin wall) or one circle each."""
    ring = condition.ring
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    distance, heading = rng.uniform(*RANGES, count), rng.uniform(-np.pi, np.pi, count)
    far = 50.0
    center, circles = np.zeros((count, 2)), np.zeros((0, 3))
    if kind == "plane":  # the robot is at -x from a wall along y
        walls, bearing = [[[0, -far], [0, far]]], np.full(count, np.pi)
    elif kind == "corner":  # the ring keeps clear of both walls
        clear = float(np.linalg.norm(np.asarray(ring.position), axis=-1).max()) + 0.02
        walls = [[[0, 0], [far, 0]], [[0, 0], [0, far]]]
        bearing = np.pi / 4 + rng.uniform(-1, 1, count) * (np.pi / 4 - np.arcsin(clear / distance))
    elif kind == "edge":
        walls, bearing = [[[0, 0], [-far, 0]]], rng.uniform(-np.pi / 6, np.pi / 6, count)
    else:  # one room with all circles, far from each other
        walls, bearing = np.zeros((0, 2, 2)), rng.uniform(-np.pi, np.pi, count)
        circles = np.array([(far * k, 0.0, radius) for k, radius in enumerate(RADII)])
        center = circles[rng.integers(len(circles), size=count)]
    away = distance + (center[:, 2] if kind == "circle" else 0.0)
    place = center[:, :2] + (away * np.array([np.cos(bearing), np.sin(bearing)])).T
    pose = np.column_stack([place, heading])
    polar = np.stack([distance, wrap_angle(bearing + np.pi - heading)], axis=-1)
    room = Room(np.array(walls, dtype=float), circles=circles)
    return echoes_of_one(condition, room, pose, polar, kind, 1, seed)


def three_walls(condition: Condition, count: int, seed: int) -> Scans:
    """Scans of three long walls in random directions at least 60 deg apart."""
    rng = np.random.default_rng(seed)
    gap = np.pi / 3 + np.pi * rng.dirichlet(np.ones(3), count)
    theta = wrap_angle(rng.uniform(-np.pi, np.pi, (count, 1)) + np.cumsum(gap, axis=1)).ravel()
    distance = rng.uniform(*RANGES, 3 * count)
    pose = np.stack([-distance, np.zeros(3 * count), -theta], axis=-1)
    wall = Room(np.array([[[0.0, -50.0], [0.0, 50.0]]]))
    return echoes_of_one(condition, wall, pose, np.stack([distance, theta], axis=-1), "plane", 3, seed)


def echoes_of_one(condition: Condition, room: Room, pose, polar, kind: str, poses_per_scan: int, seed: int) -> Scans:
    """Scans with the echoes of one kind of reflector only; with hard cones without an amplitude threshold.

    The echoes of each group of ``poses_per_scan`` consecutive poses form one scan.
    """
    ring, beams = condition.ring, condition.beams
    acoustics = Acoustics(threshold=0.0) if beams == "hard" else Acoustics()
    alone = {"seed": seed, "max_echoes": 9, "blanking": 0.0, "crosstalk": False}
    echoes = simulate(ring, room, pose, sigma=condition.sigma, beams=beams, acoustics=acoustics, **alone)
    own = echoes.kind == EchoKind[kind.upper()]
    scan, row = np.divmod(echoes.scan[own], poses_per_scan)
    path, kinds = echoes.path[own], np.full(poses_per_scan, KINDS.index(kind))
    scans = len(pose) // poses_per_scan
    border = np.searchsorted(scan, np.arange(scans + 1))
    truth = []
    for k, some in enumerate(slice(*pair) for pair in itertools.pairwise(border)):
        point_polar = polar[k * poses_per_scan : (k + 1) * poses_per_scan]
        truth.append(Truth.of(ring, point_polar, kinds, row[some], path[some], sigma=condition.sigma, room=k))
    return Scans(ring, log_of(ring, scan, path, echoes.range[own], scans), truth)


def log_of(ring: Ring, scan: np.ndarray, path: np.ndarray, ranges: np.ndarray, scans: int) -> Log:
    """A log without poses."""
    tx, rx = ring.paths[path].T
    stamp, pose = 0.1 * np.arange(scans), np.full((scans, 3), np.nan)
    return Log.from_echoes(scan, tx, rx, ranges, stamp=stamp, pose=pose, asked=ring.paths)
