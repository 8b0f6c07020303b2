"""The demo: the embedded office and 200 random poses, high-resolution ring against a conventional one."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from . import figures, figures_map, figures_scan
from .deviations import Deviations, compare, pooled
from .files import atomic_write, make_folder
from .local import LocalModel, local_models, settings_for
from .logs import Log, save_log
from .modelfile import save_models
from .office import Office, load_office
from .randomrooms import random_pose, random_room
from .ring import Ring
from .ringfile import save_ring
from .roomfile import save_room
from .roompaths import save_path
from .rooms import Room
from .settings import save_settings
from .simulate import Simulation, simulate

SIGMA = 0.003
"""Range noise of every scan in the demo, metres."""
RANDOM_ROOMS, POSES_PER_ROOM = 40, 5
PAPER = {"rho_max_mm": 32.3, "theta_max_deg": 7.41}
"""The paper's largest deviations, over three walls of one scan (section 4)."""


def conventional_ring(ring: Ring) -> Ring:
    """The usual way for comparison: cones of 30 deg, direct echoes only (paper, section 1)."""
    return replace(ring, beam=np.radians(30.0), neighbors=0, name="conventional ring")


def run_demo(
    output: Path, *, seed: int, on_step: Callable[[str], None], on_room: Callable[[int], None] = lambda done: None
) -> list[tuple[str, Deviations]]:
    """Simulate, extract, compare, draw; everything is written to a folder.

    Args:
        output: the folder; made if it does not exist.
        seed: of rooms, poses and noise.
        on_step: told what comes next.
        on_room: told how many random rooms are done.

    Returns:
        Rows of the table: what was looked at, and the deviations.
    """
    make_folder(output)
    office = load_office()
    on_step("the office: 17 scans")
    simulation = simulate(office.ring, office.room, office.poses, sigma=SIGMA, seed=seed, stamps=office.stamps)
    log = simulation.as_log(office.ring, office.poses)
    models = list(local_models(office.ring, log))
    usual = conventional_ring(office.ring)
    usual_simulation = simulate(usual, office.room, office.poses, sigma=SIGMA, seed=seed, max_echoes=1)
    usual_models = list(local_models(usual, usual_simulation.as_log(usual, office.poses)))

    on_step(f"{RANDOM_ROOMS * POSES_PER_ROOM} random poses in {RANDOM_ROOMS} random rooms")
    rows = [
        ("office, first pose", _deviations(office.ring, models[:1], simulation, office)),
        ("office, 17 poses", _deviations(office.ring, models, simulation, office)),
        ("office, 17 poses, conventional ring", _deviations(usual, usual_models, usual_simulation, office, simulation)),
        *_random_rows(office.ring, usual, seed, on_room),
    ]

    on_step("files and figures")
    save_ring(office.ring, output / "ring.toml")
    save_room(office.room, output / "office.geojson")
    save_path(office.poses, office.stamps, output / "path.csv")
    save_log(log, output / "office.csv")
    save_models(models, output / "lines.jsonl")
    save_settings(settings_for(office.ring, None), output / "lines.settings.toml")
    with atomic_write(output / "table.json") as file:
        json.dump([{"what": name, **summary(row)} for name, row in rows], file, indent=1)
    for name, figure in _figures(office, log, models):
        figures.save(figure, output / f"{name}.svg")
        figures.save(figure, output / f"{name}.png")
    return rows


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
    """Both rings in the same random rooms, the walls to be found being those that the first one hears well."""
    rng = np.random.default_rng(seed)
    full, conventional = [], []
    for k in range(RANDOM_ROOMS):
        room: Room = random_room(rng)
        poses = np.stack([random_pose(rng, room) for _ in range(POSES_PER_ROOM)])
        heard = simulate(ring, room, poses, sigma=SIGMA, seed=seed + k)
        models = list(local_models(ring, heard.as_log(ring, poses)))
        full.append(compare(ring, models, heard, room, poses, sigma=SIGMA))
        first = simulate(usual, room, poses, sigma=SIGMA, seed=seed + k, max_echoes=1)
        models = list(local_models(usual, first.as_log(usual, poses)))
        conventional.append(compare(usual, models, first, room, poses, sigma=SIGMA, judge=heard))
        on_room(k + 1)
    what = f"{RANDOM_ROOMS * POSES_PER_ROOM} random poses"
    yield what, pooled(full)
    yield f"{what}, conventional ring", pooled(conventional)


def _figures(office: Office, log: Log, models: list[LocalModel]) -> Iterator[tuple[str, Any]]:
    """The paper's figures 1 to 4, the accumulator, and the segments of all scans (figure 6)."""
    ring, room, pose = office.ring, office.room, office.poses[0]
    yield "1-ring", figures_scan.ring_figure(ring)
    yield "2-reference", figures_scan.reference_figure(room, pose, ring=ring)
    yield "3-arcs", figures_scan.arcs_figure(ring, log[0], room=room, pose=pose)
    yield "4-lines", figures_scan.lines_figure(ring, log[0], models[0], room=room, pose=pose)
    yield "5-accumulator", figures_scan.accumulator_figure(ring, log[0], models[0])
    yield "6-segments", figures_map.aggregate_figure(ring, models, office.poses, room=room)
