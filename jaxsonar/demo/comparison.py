"""Accuracy of the demo's lines and maps, against the paper's method and a conventional ring, as rows of tables."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool

from jaxsonar.detection.extract import local_models
from jaxsonar.evaluation.line_accuracy import LineAccuracy, line_accuracy, pool
from jaxsonar.evaluation.map_accuracy import Evaluation, max_abs, rms
from jaxsonar.evaluation.settings import SETTINGS as EVALUATION
from jaxsonar.floor_plans.room import Room
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.simulation.random_rooms import random_pose, random_room
from jaxsonar.simulation.simulator import Simulation, simulate
from jaxsonar.simulation.traced_echoes import EchoKind


@dataclass(frozen=True)
class DemoSettings:
    """Noise and size of the demo. All values are chosen by hand."""

    sigma: float = 0.003
    """Standard deviation of the range noise of every scan, metres."""
    random_rooms: int = 40
    """Number of random rooms."""
    poses_per_room: int = 5
    """Number of random poses in each room."""


PAPER_METHOD, CONVENTIONAL = "paper's method", "conventional ring"
"""Names of the comparisons: the Hough transform instead of maximum likelihood, and a conventional ring with it."""
PAPER = {"rho_max_mm": 32.3, "theta_max_deg": 7.41}
"""The paper's largest deviations, over three walls of one scan (section 4)."""
_DEGREES = 180 / np.pi


def conventional_ring(ring: Ring) -> Ring:
    """The conventional use of the ring: cones of 30 deg, direct echoes only (paper, section 1)."""
    return replace(ring, beam=np.radians(30.0), neighbors=0, name="conventional ring")


def visible_walls(simulation: Simulation, room: Room, scans: int) -> Bool[np.ndarray, " walls"]:
    """Walls with enough echoes in at least one of the scans to be detected."""
    plane = simulation.kind == EchoKind.PLANE
    echoes = np.zeros((scans, len(room.walls)), dtype=np.int64)
    np.add.at(echoes, (simulation.scan[plane], simulation.reflector[plane]), 1)
    return np.any(echoes >= EVALUATION.lines.min_echoes, axis=0)


def map_summary(evaluation: Evaluation, visible: Bool[np.ndarray, " walls"], *, sigma: float) -> dict[str, Any]:
    """One row of the table of maps. A number without data is None.

    Args:
        evaluation: segments of a map against the true walls.
        visible: walls that can be in the map (``visible_walls``).
        sigma: range noise, metres.
    """
    matched = evaluation.segment_matched >= evaluation.segment_length / 2
    return {
        "sigma_mm": sigma * 1e3,
        "segments": len(matched),
        "false": int((~matched).sum()),
        "length_m": float(evaluation.segment_length.sum()),
        "walls": int(visible.sum()),
        "walls_found": int(visible[np.unique(evaluation.reference)].sum()),
        "rho_max_mm": _statistic(max_abs, evaluation.distance, 1e3),
        "rho_rms_mm": _statistic(rms, evaluation.distance, 1e3),
        "theta_max_deg": _statistic(max_abs, evaluation.angle, _DEGREES),
        "theta_rms_deg": _statistic(rms, evaluation.angle, _DEGREES),
    }


def line_summary(accuracy: LineAccuracy, *, sigma: float) -> dict[str, Any]:
    """One row of the table of detected lines. A number without data is None.

    Args:
        accuracy: detected lines against the true walls.
        sigma: range noise, metres.
    """
    bounded = np.isfinite(accuracy.rho_bound)
    return {
        "sigma_mm": sigma * 1e3,
        "scans": accuracy.scans,
        "echoes_per_scan": accuracy.echoes / accuracy.scans,
        "walls": accuracy.walls,
        "recall": accuracy.recall if accuracy.walls else None,
        "lines": accuracy.lines,
        "false_per_scan": accuracy.false_per_scan,
        "false_at_corners_per_scan": accuracy.false_at_corners / accuracy.scans,
        "rho_max_mm": _statistic(max_abs, accuracy.rho_error, 1e3),
        "rho_rms_mm": _statistic(rms, accuracy.rho_error, 1e3),
        "rho_rms_over_crb": _statistic(rms, accuracy.rho_error[bounded] / accuracy.rho_bound[bounded], 1.0),
        "theta_max_deg": _statistic(max_abs, accuracy.theta_error, _DEGREES),
        "theta_rms_deg": _statistic(rms, accuracy.theta_error, _DEGREES),
        "theta_rms_over_crb": _statistic(rms, accuracy.theta_error[bounded] / accuracy.theta_bound[bounded], 1.0),
    }


def random_room_accuracy(
    ring: Ring, conventional: Ring, settings: DemoSettings, *, seed: int, on_room: Callable[[int], None]
) -> Iterator[tuple[str, LineAccuracy]]:
    """Compare both methods and both rings in the same random rooms. Recall refers to walls that the first ring sees.

    Args:
        ring: the ring of the demo.
        conventional: the conventional ring.
        settings: noise, and numbers of rooms and poses.
        seed: seed of rooms, poses and noise.
        on_room: called with the number of finished rooms.

    Yields:
        Name of the comparison, and its accuracy over all rooms.
    """
    rng = np.random.default_rng(seed)
    sigma, poses_per_room = settings.sigma, settings.poses_per_room
    rooms, room_poses, simulations, conventional_simulations = [], [], [], []
    for k in range(settings.random_rooms):
        room: Room = random_room(rng)
        poses = np.stack([random_pose(rng, room) for _ in range(poses_per_room)])
        simulations.append(simulate(ring, room, poses, sigma=sigma, seed=seed + k))
        conventional_simulations.append(simulate(conventional, room, poses, sigma=sigma, seed=seed + k, max_echoes=1))
        rooms.append(room)
        room_poses.append(poses)
        on_room(k + 1)

    def accuracy(ring: Ring, own_simulations: list[Simulation], method: str) -> LineAccuracy:
        logs = [one.as_log(ring, poses) for one, poses in zip(own_simulations, room_poses, strict=True)]
        scans = [replace(scan, scan=number) for number, scan in enumerate(scan for log in logs for scan in log)]
        models = list(local_models(ring, Log.from_scans(scans), method=method))
        per_room = zip(own_simulations, simulations, rooms, room_poses, strict=True)
        return pool(
            [
                line_accuracy(
                    ring, models[k * poses_per_room :][:poses_per_room], own, room, poses, sigma=sigma, judge=judge
                )
                for k, (own, judge, room, poses) in enumerate(per_room)
            ]
        )

    name = f"{settings.random_rooms * poses_per_room} random poses"
    yield name, accuracy(ring, simulations, "ml")
    yield f"{name}, {PAPER_METHOD}", accuracy(ring, simulations, "hough")
    yield f"{name}, {CONVENTIONAL}", accuracy(conventional, conventional_simulations, "hough")


def _statistic(statistic: Callable[[np.ndarray], float], values: np.ndarray, unit: float) -> float | None:
    return statistic(values) * unit if len(values) else None
