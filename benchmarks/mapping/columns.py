"""Columns and lone poles in maps of five poses: what they become, beside the Bayes error of their kind.

Run ``python -m benchmarks.mapping.columns``. Each scene is a rectangular room with one column, one pole, or neither;
the robot passes at 0.5 to 1.1 m and scans at five poses on 0.5 to 1 m. Scenes are determined by their seed; seeds from
1000 on served for the choice of settings, so that the default seeds are others.
"""

import argparse
import time
from collections import Counter
from dataclasses import dataclass
from math import erfc, sqrt
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from jaxsonar import Log, Ring, Room, build_map, simulate
from jaxsonar.evaluation.point_accuracy import evaluate_points
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.reflectors.kind_fit import CIRCLE, EDGE, PLANE, fit_kinds, near_echoes
from jaxsonar.reflectors.range_measurements import RangeMeasurements
from jaxsonar.simulation.traced_echoes import EchoKind

OUTCOMES = ("circle", "edge", "corner", "undecided", "wall", "missing")
"""What a reflector is in the map."""
FIRST_SEED = 0
RING = Ring.circular()
POSES = 5
LOST, FALSE = 0.1, 0.02
"""Share of lost and of false echoes."""


class Scene(NamedTuple):
    """A room and a short trajectory past one reflector."""

    room: Room
    poses: Float[np.ndarray, "scans 3"]
    center: Float[np.ndarray, "2"]
    radius: float


@dataclass(frozen=True)
class Case:
    """Scenes of one kind."""

    kind: str
    """ "circle", "pole" or "none"."""
    sigma: float
    """Range noise, metres."""
    radius: tuple[float, float] = (0.0, 0.0)
    """Limits of the radius, metres."""

    @property
    def title(self) -> str:
        """One line."""
        low, high = self.radius
        size = f" {low:g}-{high:g} m" if self.kind == "circle" else ""
        return f"{self.kind}{size}, {1e3 * self.sigma:g} mm"


CASES = (
    *(Case("circle", sigma, (0.1, 0.5)) for sigma in (0.001, 0.003)),
    *(Case("circle", 0.005, limits) for limits in ((0.1, 0.2), (0.2, 0.5))),
    *(Case("pole", sigma) for sigma in (0.001, 0.003, 0.005)),
    *(Case("none", sigma) for sigma in (0.001, 0.003, 0.005)),
)


def scene(case: Case, seed: int) -> Scene:
    """The scene of a seed."""
    rng = np.random.default_rng([seed, ["circle", "pole", "none"].index(case.kind)])
    while True:
        size = rng.uniform(3.2, 5.0, 2)
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size
        radius = rng.uniform(*case.radius)
        middle, away, toward = rng.uniform(0.9, size - 0.9), rng.uniform(0.5, 1.1), rng.uniform(-np.pi, np.pi)
        center = middle + (away + radius) * np.array([np.cos(toward), np.sin(toward)])
        length, course = rng.uniform(0.5, 1.0), toward + np.pi / 2 + rng.uniform(-0.5, 0.5)
        along = np.linspace(-length / 2, length / 2, POSES)
        position = middle + along[:, None] * np.array([np.cos(course), np.sin(course)])
        heading = course + rng.uniform(-np.pi, np.pi) + rng.normal(0, 0.1, POSES)
        clear = np.hypot(*(position - center).T).min() - radius > 0.4 or case.kind == "none"
        inside = ((center > radius + 0.15) & (center < size - radius - 0.15)).all() or case.kind == "none"
        if clear and inside and ((position > 0.45) & (position < size - 0.45)).all():
            break
    walls = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    circles = np.array([[*center, radius]]) if case.kind == "circle" else np.zeros((0, 3))
    poles = center[None] if case.kind == "pole" else np.zeros((0, 2))
    return Scene(Room(walls, poles=poles, circles=circles), np.column_stack([position, heading]), center, radius)


def scan_log(one: Scene, sigma: float, seed: int) -> Log:
    """The scans of a scene."""
    sim = simulate(RING, one.room, one.poses, sigma=sigma, dropout=LOST, clutter=FALSE, seed=seed)
    return sim.as_log(RING, one.poses)


def bayes_error(one: Scene, sigma: float) -> float:
    """Error of the best decision between a column and the plane or edge that resembles it most, all echoes known."""
    sim = simulate(RING, one.room, one.poses, seed=0)
    own = sim.kind == EchoKind.CIRCLE
    more = {"stamp": sim.stamps, "pose": one.poses, "asked": RING.paths}
    tx, rx = RING.paths[sim.path[own]].T
    log = Log.from_echoes(sim.scan[own], tx, rx, sim.range[own], **more)
    measurements = RangeMeasurements.from_log(RING, log)
    free = np.flatnonzero(np.isfinite(measurements.distance))
    weight, seed = np.ones(len(measurements)), (one.center[None], np.array([one.radius]))
    near, _ = near_echoes(measurements, free, *seed)
    if near.sum() < 4:
        return 0.5
    (fits,) = fit_kinds(measurements, free, weight, *seed, near, 0.01)
    if fits is None:
        return 0.5
    apart = np.sqrt((fits.residual**2).sum(axis=1))
    return 0.5 * erfc(float(min(apart[PLANE], apart[EDGE]) - apart[CIRCLE]) / (2 * sqrt(2) * sigma))


def outcome(world: GlobalMap, one: Scene) -> tuple[str, float, float, int]:
    """What the reflector is in the map, errors of position and radius (metres), and the number of false points."""
    kinds = ("circle",) * len(one.room.circles) + ("pole",) * len(one.room.poles)
    there = np.concatenate([one.room.circles[:, :2], one.room.poles])
    radii = np.append(one.room.circles[:, 2], np.zeros(len(one.room.poles)))
    segments, points = np.array(world.segments), np.array(world.points)
    radius = np.array(world.point_radius)
    found = evaluate_points(points, world.point_kinds, radius, segments, there, kinds, radii, one.room.walls)
    if not kinds:
        return "", np.nan, np.nan, len(found.false)
    name = "wall" if found.as_wall[0] else found.match_kinds[0] or "missing"
    return name, float(found.position_error[0]), float(found.radius_error[0]), len(found.false)


def measure(case: Case, scenes: int, *, reflectors: bool) -> list[str]:
    """One row of the table."""
    count, errors, seconds, bayes = Counter[str](), [], 0.0, []
    false, circles = 0, 0
    for seed in range(FIRST_SEED, FIRST_SEED + scenes):
        one = scene(case, seed)
        log = scan_log(one, case.sigma, seed)
        start = time.perf_counter()
        world = build_map(RING, log, reflectors=reflectors)
        seconds += time.perf_counter() - start
        name, position, radius, wrong = outcome(world, one)
        count[name] += 1
        false += wrong
        circles += world.point_kinds.count("circle") - (name == "circle")
        if name == "circle":
            errors.append((position, radius))
        if case.kind == "circle":
            bayes.append(bayes_error(one, case.sigma))
    rms = np.sqrt(np.mean(np.square(errors), axis=0)) if errors else (np.nan, np.nan)
    shares = [f"{count[name] / scenes:.2f}" if case.kind != "none" else "" for name in OUTCOMES]
    accuracy = [f"{1e3 * value:.0f}" if np.isfinite(value) else "" for value in rms]
    expected = f"{np.mean(bayes):.3f}" if bayes else ""
    return [
        case.title,
        *shares,
        expected,
        *accuracy,
        f"{circles / scenes:.2f}",
        f"{false / scenes:.2f}",
        f"{1e3 * seconds / scenes:.0f}",
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=40, help="scenes of each row (default: 40)")
    parser.add_argument("--walls-only", action="store_true", help="maps without the search for reflectors, to compare")
    options = parser.parse_args()
    table = Table(title=f"Columns and poles, {POSES} poses, {options.scenes} scenes a row, soft beams")
    headings = (
        "truth",
        *OUTCOMES,
        "Bayes\nerror",
        "Δ position\n(mm)",
        "Δ radius\n(mm)",
        "other\ncircles",
        "false\npoints",
        "ms",
    )
    for heading in headings:
        table.add_column(heading, justify="left" if heading == "truth" else "right")
    console = Console(width=140)
    for case in CASES:
        table.add_row(*measure(case, options.scenes, reflectors=not options.walls_only))
    console.print(table)


if __name__ == "__main__":
    main()
