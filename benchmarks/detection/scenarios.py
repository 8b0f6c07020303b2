"""test_scans."""

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
"""Poses in each room; 64 rooms fill a batch of 256 scans, 12 (quick) three of 16, so that few programs compile."""

RANGES = 0.5, 1.8
"""Metres from the robot of single reflectors and of the three walls."""


@dataclass(frozen=True)
class Truth:
    """What there is to find in one scan: reflectors with echoes, robot frame."""

    room: int
    """Scans of one room are not independent."""
    place: Float[np.ndarray, "reflectors 2"]
    """Distance (metres) and direction (radians): rho and theta of a plane."""
    kind: Int[np.ndarray, " reflectors"]
    """Which of KINDS."""
    heard: Int[np.ndarray, " reflectors"]
    """First-order echoes that arrived."""
    bound: Float[np.ndarray, "reflectors 2"]
    """CRB of planes: standard deviations of rho and theta; infinite for others."""

    @classmethod
    def of(cls, ring: Ring, place, kind, owner, path, *, sigma: float, room: int) -> "Truth":
        """From reflectors, and echoes that each name the row of theirs, or -1."""
        heard = np.bincount(owner[owner >= 0], minlength=len(place))
        bound = np.full((len(place), 2), np.inf)
        position = np.asarray(ring.position)
        for row in np.flatnonzero((kind == 0) & (heard > 0)):
            tx, rx = ring.paths[path[owner == row]].T
            bound[row] = cramer_rao_bound(place[row], position[tx], position[rx], sigma)
        some = heard > 0
        return cls(room, place[some], np.asarray(kind)[some], heard[some], bound[some])


@dataclass(frozen=True)
class Scans:
    """Scans of one ring, and what there is to find in each."""

    ring: Ring
    log: Log
    truth: list[Truth]


def random_scans(condition: Condition, rooms: int, poses: int, seed: int) -> Scans:
    """Random poses in random rooms: of one seed the same ones in every condition."""
    ring, truth, parts = condition.ring, [], []
    for k in range(rooms):
        rng = np.random.default_rng([seed, k])
        room = random_room(rng)
        pose = np.stack([random_pose(rng, room) for _ in range(poses)])
        heard = simulate(
            ring,
            room,
            pose,
            sigma=condition.sigma,
            dropout=condition.lost,
            clutter=condition.false,
            seed=int(rng.integers(2**31)),
        )
        parts.append((heard.scan + k * poses, heard.path, heard.range))
        for index in range(poses):
            mine = heard.scan == index
            place, kind, owner = reflectors_in(room, pose[index], heard.kind[mine], heard.reflector[mine])
            truth.append(Truth.of(ring, place, kind, owner, heard.path[mine], sigma=condition.sigma, room=k))
    scan, path, reach = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Scans(ring, log_of(ring, scan, path, reach, rooms * poses), truth)


def reflectors_in(
    room: Room, pose: Float[np.ndarray, "3"], kind: Int[np.ndarray, " echoes"], reflector: Int[np.ndarray, " echoes"]
) -> tuple[Float[np.ndarray, "reflectors 2"], Int[np.ndarray, " reflectors"], Int[np.ndarray, " echoes"]]:
    """Place and kind of all reflectors as seen from a pose, and which one each echo came from.

    Walls on one line, as the two parts beside a door, are one plane.
    """
    walls = np.stack(walls_in_robot_frame(room, pose), axis=-1)
    apart = np.abs(walls[:, None] - walls)
    line = ((apart[..., 0] < 1e-6) & (np.minimum(apart[..., 1], 2 * np.pi - apart[..., 1]) < 1e-6)).argmax(axis=1)
    vertices = room.junctions.vertices
    points = np.concatenate([vertices, vertices, room.poles]) - pose[:2]
    seen = np.stack([np.hypot(*points.T), wrap_angle(np.arctan2(points[:, 1], points[:, 0]) - pose[2])], axis=-1)
    first = {
        EchoKind.CORNER: len(walls),
        EchoKind.EDGE: len(walls) + len(vertices),
        EchoKind.POLE: len(walls) + 2 * len(vertices),
    }
    owner = np.full(len(kind), -1)
    plane = kind == EchoKind.PLANE
    owner[plane] = line[reflector[plane]]
    for of, begin in first.items():
        owner[kind == of] = begin + reflector[kind == of]
    kinds = np.repeat([0, 1, 2, 2], [len(walls), len(vertices), len(vertices), len(room.poles)])
    return np.concatenate([walls, seen]), kinds, owner


def single_reflectors(condition: Condition, kind: str, count: int, seed: int) -> Scans:
    """Scans that hear one plane, one right-angled corner or one edge (the end of a thin wall), and nothing else."""
    ring = condition.ring
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    away, heading = rng.uniform(*RANGES, count), rng.uniform(-np.pi, np.pi, count)
    far = 50.0
    if kind == "plane":  # the robot at -x from a wall along y
        walls, bearing = [[[0, -far], [0, far]]], np.full(count, np.pi)
    elif kind == "corner":  # clear of both walls
        clear = float(np.linalg.norm(np.asarray(ring.position), axis=-1).max()) + 0.02
        walls = [[[0, 0], [far, 0]], [[0, 0], [0, far]]]
        bearing = np.pi / 4 + rng.uniform(-1, 1, count) * (np.pi / 4 - np.arcsin(clear / away))
    else:
        walls, bearing = [[[0, 0], [-far, 0]]], rng.uniform(-np.pi / 6, np.pi / 6, count)
    pose = np.stack([away * np.cos(bearing), away * np.sin(bearing), heading], axis=-1)
    place = np.stack([away, wrap_angle(bearing + np.pi - heading)], axis=-1)
    return echoes_of_one(condition, Room(np.array(walls, dtype=float)), pose, place, kind, 1, seed)


def three_walls(condition: Condition, count: int, seed: int) -> Scans:
    """Scans of three long walls in random directions, 60 deg or more apart, and of nothing else."""
    rng = np.random.default_rng(seed)
    gap = np.pi / 3 + np.pi * rng.dirichlet(np.ones(3), count)
    theta = wrap_angle(rng.uniform(-np.pi, np.pi, (count, 1)) + np.cumsum(gap, axis=1)).ravel()
    away = rng.uniform(*RANGES, 3 * count)
    pose = np.stack([-away, np.zeros(3 * count), -theta], axis=-1)
    wall = Room(np.array([[[0.0, -50.0], [0.0, 50.0]]]))
    return echoes_of_one(condition, wall, pose, np.stack([away, theta], axis=-1), "plane", 3, seed)


def echoes_of_one(condition: Condition, room: Room, pose, place, kind: str, together: int, seed: int) -> Scans:
    """Echoes of one kind of reflector from every pose, however faint, those of so many poses together in one scan."""
    ring = condition.ring
    everything = Acoustics(threshold=0.0)
    heard = simulate(
        ring, room, pose, sigma=condition.sigma, seed=seed, max_echoes=9, blanking=0.0, acoustics=everything
    )
    own = heard.kind == EchoKind[kind.upper()]
    scan, row = np.divmod(heard.scan[own], together)
    path, kinds = heard.path[own], np.full(together, KINDS.index(kind))
    scans = len(pose) // together
    border = np.searchsorted(scan, np.arange(scans + 1))
    truth = []
    for k, some in enumerate(slice(*pair) for pair in itertools.pairwise(border)):
        seen = place[k * together : (k + 1) * together]
        truth.append(Truth.of(ring, seen, kinds, row[some], path[some], sigma=condition.sigma, room=k))
    return Scans(ring, log_of(ring, scan, path, heard.range[own], scans), truth)


def log_of(ring: Ring, scan: np.ndarray, path: np.ndarray, reach: np.ndarray, scans: int) -> Log:
    """A log without poses."""
    tx, rx = ring.paths[path].T
    return Log.from_echoes(scan, tx, rx, reach, stamp=0.1 * np.arange(scans), pose=np.full((scans, 3), np.nan))
