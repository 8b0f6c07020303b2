"""The demo: the embedded office and its map, and 200 random poses, against the paper's method and a usual ring."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from jaxsonar.demo.demo_page import draw, write_page
from jaxsonar.detection.extract import local_models
from jaxsonar.detection.local_map import LocalModel, save_models
from jaxsonar.detection.settings import hough_settings
from jaxsonar.detection.settings_toml import save_settings
from jaxsonar.evaluation.line_accuracy import CLEAR_ECHOES, GATE_RHO, GATE_THETA, Deviations, compare, pooled
from jaxsonar.evaluation.map_accuracy import Evaluation, evaluate, largest, rms
from jaxsonar.fileio.atomic_files import atomic_write, make_folder
from jaxsonar.floor_plans.room import Room
from jaxsonar.floor_plans.room_geojson import save_room
from jaxsonar.mapping.build_map import assemble_map
from jaxsonar.mapping.map_evidence import gather_evidence
from jaxsonar.mapping.map_geojson import save_map
from jaxsonar.occupancy.nav2_map import save_nav2
from jaxsonar.occupancy.occupancy_grid import occupancy
from jaxsonar.reports import plot_style as figures
from jaxsonar.scans.log_file import save_log
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_toml import save_ring
from jaxsonar.simulation.office import Office, load_office
from jaxsonar.simulation.poses_csv import save_poses
from jaxsonar.simulation.random_rooms import random_pose, random_room
from jaxsonar.simulation.simulator import Simulation, simulate
from jaxsonar.simulation.traced_echoes import EchoKind

SIGMA = 0.003
"""Range noise of every scan in the demo, metres."""
RANDOM_ROOMS, POSES_PER_ROOM = 40, 5
PAPERS, USUAL = "paper's method", "conventional ring"
"""What else is compared: the Hough step alone, and the usual ring with it."""
PAPER = {"rho_max_mm": 32.3, "theta_max_deg": 7.41}
"""The paper's largest deviations, over three walls of one scan (section 4)."""


def conventional_ring(ring: Ring) -> Ring:
    """The usual way for comparison: cones of 30 deg, direct echoes only (paper, section 1)."""
    return replace(ring, beam=np.radians(30.0), neighbors=0, name="conventional ring")


def run_demo(
    output: Path, *, seed: int, on_step: Callable[[str], None], on_room: Callable[[int], None] = lambda done: None
) -> tuple[list[tuple[str, Deviations]], list[dict[str, Any]]]:
    """Simulate, extract, map, compare, draw; everything is written to a folder.

    Args:
        output: the folder; made if it does not exist.
        seed: of rooms, poses and noise.
        on_step: told what comes next.
        on_room: told how many random rooms are done.

    Returns:
        Lines of scans: what was looked at, and the deviations. And the rows of the table of maps (``map_summary``).
    """
    make_folder(output)
    office = load_office()
    on_step("the office: 17 scans")
    simulation = simulate(office.ring, office.room, office.poses, sigma=SIGMA, seed=seed, stamps=office.stamps)
    log = simulation.as_log(office.ring, office.poses)
    models = list(local_models(office.ring, log))
    paper_models = list(local_models(office.ring, log, method="hough"))
    usual = conventional_ring(office.ring)
    usual_simulation = simulate(usual, office.room, office.poses, sigma=SIGMA, seed=seed, max_echoes=1)
    usual_models = list(local_models(usual, usual_simulation.as_log(usual, office.poses), method="hough"))

    on_step("the map of the office")
    evidence = gather_evidence(office.ring, log, models)
    paper_evidence = gather_evidence(office.ring, log, paper_models)
    world = assemble_map(evidence)
    grid = occupancy(office.ring, log, walls=world.segments)
    in_reach = walls_in_reach(simulation, office.room, len(office.poses))
    maps = [
        {"what": name}
        | map_summary(evaluate(segments, office.room.walls, gate_distance=GATE_RHO, gate_angle=GATE_THETA), in_reach)
        for name, segments in (
            (f"lines of 17 scans, {PAPERS}", paper_evidence.segments.endpoints),
            (f"merged, {PAPERS}", assemble_map(paper_evidence, merging="paper").segments),
            ("lines of 17 scans", evidence.segments.endpoints),
            ("the map", world.segments),
        )
    ]

    on_step(f"{RANDOM_ROOMS * POSES_PER_ROOM} random poses in {RANDOM_ROOMS} random rooms")
    rows = [
        ("office, first pose", _deviations(office.ring, models[:1], simulation, office)),
        (f"office, first pose, {PAPERS}", _deviations(office.ring, paper_models[:1], simulation, office)),
        ("office, 17 poses", _deviations(office.ring, models, simulation, office)),
        (f"office, 17 poses, {PAPERS}", _deviations(office.ring, paper_models, simulation, office)),
        (f"office, 17 poses, {USUAL}", _deviations(usual, usual_models, usual_simulation, office, simulation)),
        *_random_rows(office.ring, usual, seed, on_room),
    ]

    on_step("files and figures")
    save_ring(office.ring, output / "ring.toml")
    save_room(office.room, output / "office.geojson")
    save_poses(office.poses, office.stamps, output / "path.csv")
    save_log(log, output / "office.csv")
    save_models(models, output / "lines.jsonl")
    save_settings(hough_settings(office.ring, None), output / "lines.settings.toml")
    save_map(world, output / "map.geojson")
    save_nav2(grid, output / "map.yaml")
    line_rows = [{"what": name, **summary(row)} for name, row in rows]
    for name, table in (("table", line_rows), ("map-table", maps)):
        with atomic_write(output / f"{name}.json") as file:
            json.dump(table, file, indent=1)
    drawn = draw(office, log, models, paper_models, world, grid)
    for name, figure in drawn.items():
        figures.save(figure, output / f"{name}.svg")
        figures.save(figure, output / f"{name}.png")
    write_page(output / "index.html", drawn, line_rows, maps, paper=PAPER)
    return rows, maps


def walls_in_reach(simulation: Simulation, room: Room, scans: int) -> Bool[np.ndarray, " walls"]:
    """Walls with so many echoes in one of the scans that it should show them."""
    plane = simulation.kind == EchoKind.PLANE
    heard = np.zeros((scans, len(room.walls)), dtype=np.int64)
    np.add.at(heard, (simulation.scan[plane], simulation.reflector[plane]), 1)
    return np.any(heard >= CLEAR_ECHOES, axis=0)


def map_summary(row: Evaluation, in_reach: Bool[np.ndarray, " walls"]) -> dict[str, Any]:
    """The numbers of one row of the table of maps; None where there is nothing to measure.

    Args:
        row: segments against walls.
        in_reach: which of the walls can be in a map.
    """
    matched = row.segment_matched >= row.segment_length / 2
    some = len(row.distance) > 0
    return {
        "sigma_mm": SIGMA * 1e3,
        "segments": len(matched),
        "false": int((~matched).sum()),
        "length_m": float(row.segment_length.sum()),
        "walls": int(in_reach.sum()),
        "walls_found": int(in_reach[np.unique(row.reference)].sum()),
        "rho_max_mm": largest(row.distance) * 1e3 if some else None,
        "rho_rms_mm": rms(row.distance) * 1e3 if some else None,
        "theta_max_deg": float(np.degrees(largest(row.angle))) if some else None,
        "theta_rms_deg": float(np.degrees(rms(row.angle))) if some else None,
    }


def summary(row: Deviations) -> dict[str, Any]:
    """The numbers of one row of the table; None where there is nothing to measure."""

    def largest(values: np.ndarray, unit: float) -> float | None:
        return float(np.abs(values).max() * unit) if len(values) else None

    def rms(values: np.ndarray, unit: float = 1.0) -> float | None:
        return float(np.sqrt(np.mean(values**2)) * unit) if len(values) else None

    bounded = np.isfinite(row.bound_rho)
    return {
        "sigma_mm": SIGMA * 1e3,
        "scans": row.scans,
        "echoes_per_scan": row.echoes / row.scans,
        "walls": row.walls,
        "recall": row.recall if row.walls else None,
        "lines": row.lines,
        "false_per_scan": row.false_per_scan,
        "false_at_corners_per_scan": row.false_at_corners / row.scans,
        "rho_max_mm": largest(row.rho, 1e3),
        "rho_rms_mm": rms(row.rho, 1e3),
        "rho_rms_over_crb": rms(row.rho[bounded] / row.bound_rho[bounded]),
        "theta_max_deg": largest(row.theta, 180 / np.pi),
        "theta_rms_deg": rms(row.theta, 180 / np.pi),
        "theta_rms_over_crb": rms(row.theta[bounded] / row.bound_theta[bounded]),
    }


def _deviations(
    ring: Ring, models: list[LocalModel], simulation: Simulation, office: Office, judge: Simulation | None = None
) -> Deviations:
    return compare(ring, models, simulation, office.room, office.poses[: len(models)], sigma=SIGMA, judge=judge)


def _random_rows(
    ring: Ring, usual: Ring, seed: int, on_room: Callable[[int], None]
) -> Iterator[tuple[str, Deviations]]:
    """Both methods and both rings in the same random rooms; to be found are walls that the first ring hears well."""
    rng = np.random.default_rng(seed)
    rooms, places, full, conventional = [], [], [], []
    for k in range(RANDOM_ROOMS):
        room: Room = random_room(rng)
        poses = np.stack([random_pose(rng, room) for _ in range(POSES_PER_ROOM)])
        full.append(simulate(ring, room, poses, sigma=SIGMA, seed=seed + k))
        conventional.append(simulate(usual, room, poses, sigma=SIGMA, seed=seed + k, max_echoes=1))
        rooms.append(room)
        places.append(poses)
        on_room(k + 1)

    def compared(ring: Ring, heard: list[Simulation], method: str) -> Deviations:
        logs = [simulation.as_log(ring, poses) for simulation, poses in zip(heard, places, strict=True)]
        scans = [replace(scan, scan=number) for number, scan in enumerate(scan for log in logs for scan in log)]
        models = list(local_models(ring, Log.from_scans(scans), method=method))
        return pooled(
            [
                compare(ring, models[k * POSES_PER_ROOM :][:POSES_PER_ROOM], one, room, poses, sigma=SIGMA, judge=judge)
                for k, (one, judge, room, poses) in enumerate(zip(heard, full, rooms, places, strict=True))
            ]
        )

    what = f"{RANDOM_ROOMS * POSES_PER_ROOM} random poses"
    yield what, compared(ring, full, "ml")
    yield f"{what}, {PAPERS}", compared(ring, full, "hough")
    yield f"{what}, {USUAL}", compared(usual, conventional, "hough")
