"""Occupancy grids of simulated rooms: the grid of ``jaxsonar map``, the related work's Bayesian grids, the line map.

Run ``python -m benchmarks.mapping.occupancy_grids`` for the table of the office and 12 random rooms, and with
``--train`` for the parameters of the Bayesian grids, which come from other rooms.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
import shapely
from rich.console import Console
from rich.table import Table

from jaxsonar.evaluation.grid_accuracy import GridAccuracy, grid_accuracy
from jaxsonar.floor_plans.room import Room
from jaxsonar.mapping.build_map import build_map
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.occupancy.grid_evidence import GridMethod
from jaxsonar.occupancy.incremental_grid import IncrementalGrid, occupancy
from jaxsonar.occupancy.known_reflectors import KnownReflectors
from jaxsonar.occupancy.occupancy_grid import OccupancyGrid
from jaxsonar.occupancy.settings import SETTINGS, BayesSettings
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.simulation.office import load_office
from jaxsonar.simulation.random_rooms import random_pose, random_room
from jaxsonar.simulation.reflection_points import wall_reflection_points
from jaxsonar.simulation.simulator import simulate

SIGMA = 0.003
"""Standard deviation of the ranges, metres."""
POSES = 12
"""Random poses in each room."""
ROOMS, TRAINING_ROOMS = 12, 6
TRAINING_SEED = 9000
"""Added to the seed of the test rooms for the training rooms."""
BAYESIAN: dict[GridMethod, str] = {
    "elfes": "log-odds, first direct echoes (Elfes)",
    "wilkes": "log-odds, all direct echoes (Wilkes)",
    "logodds": "log-odds, direct and cross echoes",
    "em": "expectation maximization",
}
DEFAULT, LINES = "grid of `jaxsonar map`", "line map"


class Scene(NamedTuple):
    """A room, a log in it, and the map of the log."""

    name: str
    ring: Ring
    room: Room
    log: Log
    heard: np.ndarray
    world: GlobalMap


class Row(NamedTuple):
    """Scores of one grid of one room."""

    accuracy: GridAccuracy
    outside: float
    """Free area outside of the room, square metres."""
    free: float
    """Share of the floor that is free."""


def scenes(seed: int, rooms: int, *, office: bool = True) -> Iterator[Scene]:
    """The office of the demo, and random rooms."""
    rng, demo = np.random.default_rng(seed), load_office()
    places = [("office", demo.room, demo.poses)] if office else []
    for number in range(rooms):
        room = random_room(rng)
        places.append((f"room {number}", room, np.stack([random_pose(rng, room) for _ in range(POSES)])))
    for number, (name, room, poses) in enumerate(places):
        simulation = simulate(demo.ring, room, poses, sigma=SIGMA, seed=seed + number)
        log = simulation.as_log(demo.ring, poses)
        heard = wall_reflection_points(demo.ring, room, poses, simulation)
        yield Scene(name, demo.ring, room, log, heard, build_map(demo.ring, log))


def grids(scene: Scene) -> Iterator[tuple[str, Row]]:
    """Scores of all grids of a scene."""
    known = KnownReflectors.of_map(scene.world)
    grid = occupancy(scene.ring, scene.log, walls=known)
    yield DEFAULT, score(scene, grid)
    for method, name in BAYESIAN.items():
        bayesian = occupancy(scene.ring, scene.log, method=method)
        yield name, score(scene, bayesian, free=likely_free(bayesian, method))
    lines = np.zeros_like(grid.occupied)
    column, row = (known.cells(grid.resolution) - np.array(grid.corner, int)).T
    inside = (column >= 0) & (row >= 0) & (column < lines.shape[1]) & (row < lines.shape[0])
    lines[row[inside], column[inside]] = True
    yield LINES, score(scene, grid, occupied=lines, free=np.zeros_like(lines))


def likely_free(grid: OccupancyGrid, method: GridMethod) -> np.ndarray:
    """Free cells as the related work has them: looked through, with more evidence against an obstacle than for one."""
    least = SETTINGS.em.occupied / 2 if method == "em" else 0.0
    return (grid.looks >= 1) & (grid.evidence < least) & ~grid.occupied


def score(scene: Scene, grid: OccupancyGrid, **cells: np.ndarray) -> Row:
    """Scores of one grid, or of other cells of it."""
    free = cells.get("free", grid.free)
    row, column = np.nonzero(free)
    x, y = ((np.stack([column, row], axis=-1) + grid.corner + 0.5) * grid.resolution).T
    outline = floor(scene.room)
    inside = shapely.contains_xy(outline, x, y)
    area = grid.resolution**2
    accuracy = grid_accuracy(grid, scene.room.walls, scene.room.poles, scene.heard, **cells)
    return Row(accuracy, float(area * (~inside).sum()), float(area * inside.sum() / outline.area))


def floor(room: Room) -> shapely.Polygon:
    """The outline of a room: the largest closed face of its walls."""
    faces = shapely.polygonize([shapely.LineString(wall) for wall in room.walls]).geoms
    polygons = [shapely.Polygon(face.exterior) for face in faces if isinstance(face, shapely.Polygon)]
    return max(polygons, key=lambda face: face.area)


def train(seed: int) -> dict[GridMethod, tuple[float, BayesSettings]]:
    """The best mean F1 of each Bayesian grid in the training rooms, and its parameters."""
    rooms = list(scenes(TRAINING_SEED + seed, TRAINING_ROOMS, office=False))
    best: dict[GridMethod, tuple[float, BayesSettings]] = {}
    for method in BAYESIAN:
        growing = []
        for scene in rooms:
            growing.append(IncrementalGrid(scene.ring, method=method))
            growing[-1].add(scene.log)
        priors = (0.05,) if method == "em" else (0.01, 0.03, 0.1)
        for prior, missed in product(priors, (0.005, 0.02, 0.05, 0.15)):
            parameters = replace(getattr(SETTINGS, method), prior=prior, missed=missed)
            found = [grid.update(parameters=parameters) for grid in growing]
            thresholds = (
                (0.03, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5) if method == "em" else np.arange(0.0, 5.1, 0.25).tolist()
            )
            for threshold in thresholds:
                scores = [
                    grid_accuracy(
                        grid, scene.room.walls, scene.room.poles, scene.heard, occupied=grid.evidence > threshold
                    ).f1
                    for scene, grid in zip(rooms, found, strict=True)
                ]
                mean = float(np.mean(scores))
                if method not in best or mean > best[method][0]:
                    best[method] = mean, replace(parameters, occupied=threshold)
    return best


def main() -> None:
    """Print the table, or the trained parameters."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=22, help="of the rooms")
    parser.add_argument("--rooms", type=int, default=ROOMS)
    parser.add_argument("--train", action="store_true", help="find the parameters of the Bayesian grids")
    options = parser.parse_args()
    console = Console(width=160)
    if options.train:
        for method, (f1, parameters) in train(options.seed).items():
            console.print(f"{method}: F1 {f1:.3f} with {parameters}")
        return
    rows: dict[str, list[Row]] = {}
    for scene in scenes(options.seed, options.rooms):
        for name, row in grids(scene):
            rows.setdefault(name, []).append(row)
        console.print(
            f"{scene.name}: " + "; ".join(f"{name} {found[-1].accuracy.f1:.3f}" for name, found in rows.items()),
            highlight=False,
        )
    table = Table(title=f"office and {options.rooms} random rooms, sigma {1e3 * SIGMA:g} mm, seed {options.seed}")
    for column in ("grid", "F1", "lowest F1", "precision", "walls in free cells", "free outside", "floor that is free"):
        table.add_column(column, justify="left" if column == "grid" else "right")
    for name, found in rows.items():
        f1 = [row.accuracy.f1 for row in found]
        free_wall = sum(row.accuracy.free_wall for row in found) / sum(row.accuracy.wall for row in found)
        table.add_row(
            name, f"{np.mean(f1):.3f}", f"{min(f1):.3f}", f"{np.mean([row.accuracy.precision for row in found]):.3f}",
            *(("-",) * 3 if name == LINES else (
                f"{100 * free_wall:.2f} %",
                f"{sum(row.outside for row in found):.3f} m2",
                f"{100 * np.mean([row.free for row in found]):.0f} %",
            )),
        )  # fmt: skip
    console.print(table)


if __name__ == "__main__":
    main()
