"""How accurate local models are, and how often right: random rooms, noise, lost and false echoes, and two peers.

Run ``python -m benchmarks.detection.accuracy [--quick] [-o DIR]``. Every condition is simulated once, and all methods get the
same echoes: those of walls, corners, edges, poles and second order, less the lost ones, and false ones. Errors are held
against the Cramer-Rao bound (CRB) of all first-order echoes of a wall that arrived, whatever a method uses of them.
Walls count from 8 such echoes on, other reflectors from 4; a line is a wall within 100 mm and 15 deg, one to one.
Standard errors treat rooms as independent, not scans. Most of a quick run is compilation; with
JAX_COMPILATION_CACHE_DIR set it happens once.
"""

import argparse
import importlib.metadata
import itertools
import json
import os
import platform
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
from jaxtyping import Float, Int
from rich.console import Console

from benchmarks.detection import baselines as accuracy_peers
from benchmarks.detection import plots as accuracy_figures
from benchmarks.detection.plots import ANSWERS, KINDS
from jaxsonar import LocalModel, Log, Ring, Room, local_models, random_pose, random_room, simulate
from jaxsonar.evaluation.line_accuracy import CLEAR_ECHOES, line_bound, match
from jaxsonar.fileio.atomic_files import atomic_write, make_folder
from jaxsonar.floor_plans.room import walls_in_robot_frame
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.reports import plot_style as figures
from jaxsonar.simulation.acoustics import Acoustics
from jaxsonar.simulation.traced_echoes import EchoKind

POSES = 4
"""Poses in each room; 64 rooms fill a batch of 256 scans, 12 (quick) three of 16, so that few programs compile."""
CLEAR_REFLECTOR = 4
"""Echoes from which on a reflector counts in the confusion of kinds."""
RANGES = 0.5, 1.8
"""Metres from the robot of single reflectors and of the three walls."""
PAPER = {"rho_mm": 32.3, "theta_deg": 7.41}
"""The paper's worst deviations of three walls from one scan (section 4)."""


@dataclass(frozen=True)
class Condition:
    """What is simulated; the defaults are the base that one thing at a time is varied from."""

    name: str
    sigma: float = 0.003
    """Range noise, metres."""
    lost: float = 0.1
    """Share of the echoes that are lost."""
    false: float = 0.02
    """False echoes for each true one."""
    cone_deg: float = 60.0
    sensors: int = 24
    quick: bool = False
    """Part of the quick run."""

    @property
    def ring(self) -> Ring:
        """Listens as far around as the cones overlap well: 45 deg, with cones of 120 deg 105 deg."""
        around = 105 if self.cone_deg > 90 else 45
        neighbors = around * self.sensors // 360
        return Ring.circular(count=self.sensors, beam=np.radians(self.cone_deg), neighbors=neighbors)


BASE = Condition("base", quick=True)
HARD = Condition("5 mm, 30 % lost, 20 % false", sigma=0.005, lost=0.3, false=0.2, quick=True)
CONDITIONS = (
    BASE,
    Condition("sigma 1 mm", sigma=0.001, quick=True),
    Condition("sigma 5 mm", sigma=0.005),
    Condition("sigma 10 mm", sigma=0.010, quick=True),
    Condition("none lost", lost=0.0),
    Condition("30 % lost", lost=0.3, quick=True),
    Condition("50 % lost", lost=0.5),
    Condition("none false", false=0.0),
    Condition("20 % false", false=0.2, quick=True),
    Condition("50 % false", false=0.5),
    Condition("cones of 120 deg", cone_deg=120.0),
    Condition("32 sensors", sensors=32),
    Condition("none lost or false, 1 mm", sigma=0.001, lost=0.0, false=0.0, quick=True),
    Condition("none lost or false, 3 mm", lost=0.0, false=0.0),
    Condition("none lost or false, 5 mm", sigma=0.005, lost=0.0, false=0.0),
    HARD,
    Condition("5 mm, 10 % lost, 50 % false", sigma=0.005, false=0.5),
    Condition("5 mm, cones of 120 deg", sigma=0.005, cone_deg=120.0),
)
ISOLATED = (
    Condition("one reflector, 1 mm, cones of 60 deg", sigma=0.001, lost=0.0, false=0.0, quick=True),
    Condition("one reflector, 5 mm, cones of 120 deg", sigma=0.005, lost=0.0, false=0.0, cone_deg=120.0),
)
THREE_WALLS = Condition("three walls, 1 mm", sigma=0.001, lost=0.0, false=0.0)


@dataclass(frozen=True)
class Reported:
    """What a method says of one scan, robot frame."""

    lines: Float[np.ndarray, "lines 2"]
    """(rho, theta), metres and radians."""
    cov: Float[np.ndarray, "lines 2 2"]
    """Of those; NaN where the method gives none."""
    others: Float[np.ndarray, "others 2"]
    """Distance and direction of what is no line, or not decided."""
    answers: Int[np.ndarray, " others"]
    """Which of ANSWERS each of them is."""

    @classmethod
    def of_lines(cls, lines: Float[np.ndarray, "lines 2"]) -> "Reported":
        """Nothing but lines."""
        return cls(lines, np.full((len(lines), 2, 2), np.nan), np.zeros((0, 2)), np.zeros(0, dtype=int))

    @classmethod
    def of_model(cls, model: LocalModel) -> "Reported":
        """Lines, points and undecided reflectors of a local model."""
        others = [(np.hypot(point.x, point.y), np.arctan2(point.y, point.x)) for point in model.points]
        others += [(one.rho, one.theta) for one in model.undecided]
        answers = [ANSWERS.index(point.kind) for point in model.points]
        answers += [ANSWERS.index("undecided")] * len(model.undecided)
        unknown = np.full((2, 2), np.nan)
        return cls(
            np.array([(line.rho, line.theta) for line in model.lines]).reshape(-1, 2),
            np.array([unknown if line.cov is None else line.cov for line in model.lines]).reshape(-1, 2, 2),
            np.array(others).reshape(-1, 2),
            np.array(answers, dtype=int),
        )


Method = Callable[[Ring, Log, float], Iterator[Reported]]


def by_hough(ring: Ring, log: Log, sigma: float) -> Iterator[Reported]:
    """The paper's way; it does not use the noise."""
    return (Reported.of_model(model) for model in local_models(ring, log, method="hough"))


def by_ml(ring: Ring, log: Log, sigma: float, *, known: bool = True, direct: bool = False) -> Iterator[Reported]:
    """Most likely reflectors, with the noise or without it, from all echoes or from direct ones."""
    ring = replace(ring, neighbors=0) if direct else ring
    models = local_models(ring, log, method="ml", sigma=sigma if known else None)
    return (Reported.of_model(model) for model in models)


def by_peer(
    ring: Ring, log: Log, sigma: float, *, peer: accuracy_peers.PointHough | accuracy_peers.PairConsensus
) -> Iterator[Reported]:
    """Lines of a peer, scan by scan."""
    return (Reported.of_lines(peer(arcs, sigma)) for arcs in accuracy_peers.arcs_of_scans(ring, log))


METHODS: dict[str, Method] = {
    "hough (paper)": by_hough,
    "ml": by_ml,
    "ml, sigma estimated": partial(by_ml, known=False),
    "ml, direct echoes only": partial(by_ml, direct=True),
    "cv2.HoughLinesPointSet": partial(by_peer, peer=accuracy_peers.PointHough()),
    "consensus of pairs": partial(by_peer, peer=accuracy_peers.PairConsensus()),
}
TELL_KINDS = ("hough (paper)", "ml", "ml, sigma estimated")
"""Methods that single reflectors are shown to."""


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
            bound[row] = line_bound(place[row], position[tx], position[rx], sigma)
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


@dataclass(frozen=True)
class Score:
    """What a method made of a number of scans."""

    room: Int[np.ndarray, " scans"]
    counts: Int[np.ndarray, "scans 4"]
    """Walls with CLEAR_ECHOES or more, how many of them were found, and left undecided; false lines."""
    scan: Int[np.ndarray, " matches"]
    """Of each wall found; walls with CLEAR_ECHOES or more only, here and below."""
    error: Float[np.ndarray, "matches 2"]
    """Signed, in rho (metres) and theta (radians)."""
    bound: Float[np.ndarray, "matches 2"]
    """CRB of the same."""
    cov: Float[np.ndarray, "matches 2 2"]
    """As reported; NaN where it was not."""
    confusion: Int[np.ndarray, "4 5"]
    """KINDS and nothing against ANSWERS: reflectors with CLEAR_REFLECTOR echoes or more, and reports of nothing."""

    @property
    def nees(self) -> Float[np.ndarray, " reported"]:
        """Squared errors in units of the reported covariance, both dimensions together; mean 2 if it is right."""
        return nees(self.error, self.cov)

    def measures(self) -> dict[str, float]:
        """Everything that is told of it; NaN where there is nothing to tell, _se are standard errors."""
        own = self.room[self.scan]
        walls, found, undecided, false = self.counts.T
        squared = self.nees
        reported = own[np.isfinite(self.cov).all(axis=(1, 2))]
        told = {"scans": len(self.room), "walls": int(walls.sum())}
        told |= _named("recall", *ratio(found, walls, self.room))
        told |= _named("undecided", *ratio(undecided, walls, self.room))
        told |= _named("false_per_scan", *ratio(false, np.ones_like(false), self.room))
        for column, (name, scale) in enumerate({"rho_mm": 1e3, "theta_deg": np.degrees(1.0)}.items()):
            error, bound = self.error[:, column], self.bound[:, column]
            told |= _named(f"rmse_{name}", *_root(*ratio(error**2, np.ones_like(error), own), scale))
            told |= _named(f"rmse_{name}_per_crb", *_root(*ratio(error**2, bound**2, own)))
            told[f"median_{name}"] = _quantile(np.abs(error), 0.5) * scale
            told[f"crb_{name}"] = _root(*ratio(bound**2, np.ones_like(bound), own), scale)[0]
            told[f"p99_{name}_per_crb"] = _quantile(np.abs(error) / bound, 0.99)
        told |= _named("nees", *ratio(squared, np.ones_like(squared), reported))
        told["nees_median"] = _quantile(squared, 0.5)
        return told


def score(truth: list[Truth], reported: list[Reported]) -> Score:
    """Hold what was reported against the truth, scan by scan."""
    counts, rows, covs = [], [np.zeros((0, 5))], [np.zeros((0, 2, 2))]
    confusion = np.zeros((4, 5), dtype=int)
    for k, (true, said) in enumerate(zip(truth, reported, strict=True)):
        plane = true.kind == 0
        walls, clear = true.place[plane], true.heard[plane] >= CLEAR_ECHOES
        line, wall = match(said.lines, walls)
        good = clear[wall]
        missed = np.delete(walls, np.append(wall, np.flatnonzero(~clear)), axis=0)
        undecided, _ = match(said.others[said.answers == ANSWERS.index("undecided")], missed)
        counts.append((clear.sum(), good.sum(), len(undecided), len(said.lines) - len(line)))
        line, wall = line[good], wall[good]
        error = said.lines[line] - walls[wall]
        error[:, 1] = wrap_angle(error[:, 1])
        rows.append(np.column_stack([np.full(len(line), k), error, true.bound[plane][wall]]))
        covs.append(said.cov[line])
        confusion += confusion_of(true, said)
    table = np.concatenate(rows)
    return Score(
        room=np.array([true.room for true in truth]),
        counts=np.array(counts),
        scan=table[:, 0].astype(int),
        error=table[:, 1:3],
        bound=table[:, 3:],
        cov=np.concatenate(covs),
        confusion=confusion,
    )


def confusion_of(true: Truth, said: Reported) -> Int[np.ndarray, "4 5"]:
    """Kinds of one scan's reflectors (rows) against what was reported there; the last row: where there is nothing."""
    place = np.concatenate([said.lines, said.others])
    answer = np.append(np.zeros(len(said.lines), dtype=int), said.answers)
    table = np.zeros((4, 5), dtype=int)
    report, reflector = match(place, true.place)
    there = np.full(len(true.kind), ANSWERS.index("nothing"))
    there[reflector] = answer[report]
    clear = true.heard >= CLEAR_REFLECTOR
    np.add.at(table, (true.kind[clear], there[clear]), 1)
    np.add.at(table[3], np.delete(answer, report), 1)
    return table


def nees(error: Float[np.ndarray, "errors 2"], cov: Float[np.ndarray, "errors 2 2"]) -> Float[np.ndarray, " finite"]:
    """Normalised estimation error squared, of those that have a covariance."""
    some = np.isfinite(cov).all(axis=(1, 2))
    return np.einsum("ki,ki->k", error[some], np.linalg.solve(cov[some], error[some, :, None])[..., 0])


def ratio(top: np.ndarray, bottom: np.ndarray, group: Int[np.ndarray, " rows"]) -> tuple[float, float]:
    """Sum over sum, and its standard error if groups of rows are independent (linearised)."""
    if not len(group) or not bottom.sum():
        return float("nan"), float("nan")
    value = top.sum() / bottom.sum()
    rest = np.bincount(group, top - value * bottom)[np.unique(group)]
    spread = np.sqrt((rest**2).sum() * len(rest) / (len(rest) - 1)) if len(rest) > 1 else float("nan")
    return float(value), float(spread / bottom.sum())


def _root(value: float, error: float, scale: float = 1.0) -> tuple[float, float]:
    """Square root of a value with its standard error."""
    root = float(np.sqrt(value))
    return scale * root, scale * error / (2 * root) if root else float("nan")


def _named(name: str, value: float, error: float) -> dict[str, float]:
    return {name: value, f"{name}_se": error}


def _quantile(values: np.ndarray, share: float) -> float:
    return float(np.quantile(values, share)) if len(values) else float("nan")


def answers(confusion: Int[np.ndarray, "4 5"]) -> dict[str, float]:
    """Shares of a table of kinds: right among decided, undecided and nothing among all reflectors."""
    table = confusion[:3]
    decided, total = int(table[:, :3].sum()), int(table.sum())
    right = int(np.trace(table[:, :3]))
    share = right / decided if decided else float("nan")
    return {
        "reflectors": total,
        "right": share,
        "right_se": float(np.sqrt(share * (1 - share) / decided)) if decided else float("nan"),
        "undecided": int(table[:, 3].sum()) / total,
        "nothing": int(table[:, 4].sum()) / total,
    }


def worst_of_three(found: Score) -> dict[str, float]:
    """Quantiles of the worst deviation of three walls, of scans in which all were found."""
    full = np.flatnonzero(np.bincount(found.scan, minlength=len(found.room)) == 3)
    worst = np.abs(found.error[np.isin(found.scan, full)]).reshape(-1, 3, 2).max(axis=1)
    told = {"scans": len(found.room), "all_found": len(full) / len(found.room)}
    for column, (name, scale) in enumerate({"rho_mm": 1e3, "theta_deg": np.degrees(1.0)}.items()):
        told |= {f"{name}_p{share}": _quantile(worst[:, column], share / 100) * scale for share in (50, 90)}
    return told


def run(
    conditions: Sequence[Condition],
    isolated: Sequence[Condition],
    methods: dict[str, Method],
    *,
    rooms: int,
    poses: int,
    single: int,
    seed: int,
    progress: Callable[[str], None],
) -> dict[str, Any]:
    """All scores: those of conditions, of single reflectors and of three walls, each by condition and method."""

    def scored(scans: Scans, some: dict[str, Method], sigma: float) -> dict[str, Score]:
        return {name: score(scans.truth, list(way(scans.ring, scans.log, sigma))) for name, way in some.items()}

    found: dict[str, dict[Condition, dict[str, Score]]] = {"conditions": {}, "isolated": {}, "three": {}}
    for k, condition in enumerate(conditions):
        progress(f"{k + 1} of {len(conditions)}: {condition.name}")
        found["conditions"][condition] = scored(random_scans(condition, rooms, poses, seed), methods, condition.sigma)
    for condition in isolated:
        progress(condition.name)
        some = {name: way for name, way in methods.items() if name in TELL_KINDS}
        parts = [scored(single_reflectors(condition, kind, single, seed), some, condition.sigma) for kind in KINDS]
        found["isolated"][condition] = {
            name: replace(parts[0][name], confusion=np.sum([part[name].confusion for part in parts], axis=0))
            for name in some
        }
    progress(THREE_WALLS.name)
    found["three"][THREE_WALLS] = scored(three_walls(THREE_WALLS, single, seed), methods, THREE_WALLS.sigma)
    return found


def versions() -> dict[str, Any]:
    """What the numbers hang on."""
    names = ("jaxsonar", "jax", "jaxlib", "numpy", "scipy")
    root = Path(__file__).parent
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=root, capture_output=True, text=True, check=False)
    return {name: importlib.metadata.version(name) for name in names} | {
        "cv2": cv2.__version__,
        "python": platform.python_version(),
        "device": jax.devices()[0].device_kind,
        "cores": os.cpu_count(),
        "commit": commit.stdout.strip(),
    }


def summary(found: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """All measures, by condition and method."""
    tell: dict[str, Callable[[Score], dict[str, Any]]] = {
        "conditions": lambda one: one.measures() | {"confusion": one.confusion.tolist()},
        "isolated": lambda one: answers(one.confusion) | {"confusion": one.confusion.tolist()},
        "three": worst_of_three,
    }
    return {
        part: [
            asdict(condition) | {"methods": {name: tell[part](one) for name, one in scores.items()}}
            for condition, scores in found[part].items()
        ]
        for part in tell
    }


def figures_of(found: dict[str, dict[Condition, dict[str, Score]]]) -> dict[str, Any]:
    """The four figures, by the name of their files."""
    measured = {condition: {m: s.measures() for m, s in row.items()} for condition, row in found["conditions"].items()}

    def along(field: str, start: Condition) -> accuracy_figures.Series:
        """Conditions that differ from one in this alone: its values, each with the measures of the methods."""
        same = [c for c in measured if replace(c, name="", quick=False, **{field: getattr(start, field)}) == start]
        return {getattr(c, field): measured[c] for c in sorted(same, key=lambda c: getattr(c, field))}

    base = replace(BASE, name="", quick=False)
    clean = replace(base, lost=0.0, false=0.0)
    chosen = found["conditions"][BASE]
    return {
        "crb": accuracy_figures.crb_figure(
            {"10 % lost, 2 % false": along("sigma", base), "none lost or false": along("sigma", clean)}
        ),
        "robustness": accuracy_figures.robustness_figure(
            {"echoes lost (%)": along("lost", base), "false echoes for each 100 true": along("false", base)}
        ),
        "confusion": accuracy_figures.confusion_figure({m: one.confusion for m, one in chosen.items()}),
        "nees": accuracy_figures.nees_figure({m: one.nees for m, one in chosen.items()}),
    }


def write(found: dict[str, Any], output: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """accuracy.json and the figures in a folder; what the file holds."""
    make_folder(output)
    counts = {"clear_echoes": CLEAR_ECHOES, "clear_reflector": CLEAR_REFLECTOR, "ranges_m": RANGES}
    told = {"versions": versions(), "settings": settings | counts, "paper": PAPER, **summary(found)}
    with atomic_write(output / "accuracy.json") as file:
        json.dump(without_nan(told), file, indent=1, allow_nan=False)
    for name, figure in figures_of(found).items():
        for suffix in ("svg", "png"):
            figures.save(figure, output / f"{name}.{suffix}")
    return told


def without_nan(value: Any) -> Any:
    """NaN as null, which JSON has."""
    if isinstance(value, dict):
        return {key: without_nan(one) for key, one in value.items()}
    if isinstance(value, list):
        return [without_nan(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def main() -> None:
    """Measure, print, draw."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--quick", action="store_true", help="few rooms and conditions: under a minute")
    options.add_argument("--seed", type=int, default=0, help="of rooms, poses and noise")
    options.add_argument("--rooms", type=int, help="random rooms; 64, with --quick 12")
    options.add_argument("-o", "--output", type=Path, default=Path("benchmark-results/accuracy"))
    options = options.parse_args()
    rooms = options.rooms or (12 if options.quick else 64)
    settings = {"seed": options.seed, "rooms": rooms, "poses": POSES, "single": 48 if options.quick else 768}
    conditions, isolated = ([c for c in some if c.quick or not options.quick] for some in (CONDITIONS, ISOLATED))
    stderr = Console(stderr=True)
    found = run(conditions, isolated, METHODS, **settings, progress=lambda what: stderr.print(what, highlight=False))
    told = write(found, options.output, settings)
    stdout = Console(width=170)
    for table in accuracy_figures.tables(told):
        stdout.print(table)


if __name__ == "__main__":
    main()
