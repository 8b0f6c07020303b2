"""``run_demo``: the embedded office from simulation to map and figures, and 200 random poses."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxsonar.demo.comparison import (
    CONVENTIONAL,
    PAPER,
    PAPER_METHOD,
    DemoSettings,
    conventional_ring,
    line_summary,
    map_summary,
    random_room_accuracy,
    visible_walls,
)
from jaxsonar.demo.demo_page import draw_figures, write_page
from jaxsonar.detection.extract import local_models
from jaxsonar.detection.local_model import LocalModel, save_models
from jaxsonar.detection.settings import hough_settings
from jaxsonar.detection.settings_toml import save_settings
from jaxsonar.evaluation.grid_accuracy import grid_accuracy
from jaxsonar.evaluation.line_accuracy import LineAccuracy, line_accuracy
from jaxsonar.evaluation.map_accuracy import evaluate
from jaxsonar.evaluation.settings import SETTINGS as EVALUATION
from jaxsonar.fileio.atomic_files import atomic_write, make_folder
from jaxsonar.floor_plans.room_geojson import save_room
from jaxsonar.mapping.build_map import add_reflectors, assemble_map
from jaxsonar.mapping.map_evidence import gather_evidence
from jaxsonar.mapping.map_geojson import save_map
from jaxsonar.occupancy.incremental_grid import occupancy
from jaxsonar.occupancy.known_reflectors import KnownReflectors
from jaxsonar.occupancy.nav2_map import save_nav2
from jaxsonar.reports.plot_style import save_figure
from jaxsonar.scans.log_file import save_log
from jaxsonar.scans.readings import explicit_log
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_toml import save_ring
from jaxsonar.simulation.office import load_office
from jaxsonar.simulation.poses_csv import save_poses
from jaxsonar.simulation.reflection_points import wall_reflection_points
from jaxsonar.simulation.simulator import Simulation, simulate

SETTINGS = DemoSettings()


def run_demo(
    output: Path, *, seed: int, on_step: Callable[[str], None], on_room: Callable[[int], None] = lambda done: None
) -> tuple[list[tuple[str, LineAccuracy]], list[dict[str, Any]]]:
    """Simulate, detect, map, compare and draw; write all results to a folder.

    Args:
        output: the folder; created if it does not exist.
        seed: seed of rooms, poses and noise.
        on_step: called with the name of each step.
        on_room: called with the number of finished random rooms.

    Returns:
        Name and accuracy of each comparison of detected lines, and the rows of the table of maps (``map_summary``).
    """
    make_folder(output)
    office = load_office()
    ring, sigma = office.ring, SETTINGS.sigma
    conventional = conventional_ring(ring)

    # 1. Simulate the office, and detect lines: by maximum likelihood, by the paper's method, with a conventional ring.
    on_step("the office: 17 scans")
    simulation = simulate(ring, office.room, office.poses, sigma=sigma, seed=seed, stamps=office.stamps)
    log = simulation.as_log(ring, office.poses)
    models = list(local_models(ring, log))
    paper_models = list(local_models(ring, log, method="hough"))
    conventional_simulation = simulate(conventional, office.room, office.poses, sigma=sigma, seed=seed, max_echoes=1)
    conventional_log = conventional_simulation.as_log(conventional, office.poses)
    conventional_models = list(local_models(conventional, conventional_log, method="hough"))

    # 2. Build the maps and compare them with the true walls.
    on_step("the map of the office")
    evidence = gather_evidence(ring, log, models)
    paper_evidence = gather_evidence(ring, log, paper_models)
    world = add_reflectors(assemble_map(evidence), evidence.scans.measurements())
    heard = wall_reflection_points(ring, office.room, office.poses, simulation)
    grids = {
        "map and echoes": occupancy(ring, log, walls=KnownReflectors.of_map(world)),
        "log-odds": occupancy(ring, log, method="logodds"),
        "expectation maximization": occupancy(ring, log, method="em"),
    }
    visible, gates = visible_walls(simulation, office.room, len(office.poses)), EVALUATION.lines
    map_rows = []
    for name, segments in (
        (f"lines of 17 scans, {PAPER_METHOD}", paper_evidence.segments.endpoints),
        (f"merged, {PAPER_METHOD}", assemble_map(paper_evidence, merging="paper").segments),
        ("lines of 17 scans", evidence.segments.endpoints),
        ("the map", world.segments),
    ):
        evaluation = evaluate(segments, office.room.walls, gate_distance=gates.gate_rho, gate_angle=gates.gate_theta)
        map_rows.append({"what": name, **map_summary(evaluation, visible, sigma=sigma)})

    # 3. Compare the detected lines with the true walls, in the office and in random rooms.
    on_step(f"{SETTINGS.random_rooms * SETTINGS.poses_per_room} random poses in {SETTINGS.random_rooms} random rooms")

    def office_accuracy(
        ring: Ring, models: list[LocalModel], simulation: Simulation, judge: Simulation | None = None
    ) -> LineAccuracy:
        poses = office.poses[: len(models)]
        return line_accuracy(ring, models, simulation, office.room, poses, sigma=sigma, judge=judge)

    comparisons = [
        ("office, first pose", office_accuracy(ring, models[:1], simulation)),
        (f"office, first pose, {PAPER_METHOD}", office_accuracy(ring, paper_models[:1], simulation)),
        ("office, 17 poses", office_accuracy(ring, models, simulation)),
        (f"office, 17 poses, {PAPER_METHOD}", office_accuracy(ring, paper_models, simulation)),
        (
            f"office, 17 poses, {CONVENTIONAL}",
            office_accuracy(conventional, conventional_models, conventional_simulation, simulation),
        ),
        *random_room_accuracy(ring, conventional, SETTINGS, seed=seed, on_room=on_room),
    ]
    line_rows = [{"what": name, **line_summary(accuracy, sigma=sigma)} for name, accuracy in comparisons]

    # 4. Write the files, the figures and the page.
    on_step("files and figures")
    save_ring(ring, output / "ring.toml")
    save_room(office.room, output / "office.geojson")
    save_poses(office.poses, office.stamps, output / "path.csv")
    save_log(explicit_log(log), output / "office.csv")  # the file tells what was measured
    save_models(models, output / "lines.jsonl")
    save_settings(hough_settings(ring, None), output / "lines.settings.toml")
    save_map(world, output / "map.geojson")
    save_nav2(grids["map and echoes"], output / "map.yaml")
    for name, rows in (("table", line_rows), ("map-table", map_rows)):
        with atomic_write(output / f"{name}.json") as file:
            json.dump(rows, file, indent=1)
    scored = {
        name: (grid, grid_accuracy(grid, office.room.walls, office.room.poles, heard).f1)
        for name, grid in grids.items()
    }
    figures = draw_figures(office, log, models, paper_models, world, scored)
    for name, figure in figures.items():
        save_figure(figure, output / f"{name}.svg")
        save_figure(figure, output / f"{name}.png")
    write_page(output / "index.html", figures, line_rows, map_rows, paper=PAPER)
    return comparisons, map_rows
