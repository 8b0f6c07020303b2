"""Initial poses of a log, before smoothing: odometry as it is, tracked with odometry, or registered without."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsonar.detection.extract import local_models
from jaxsonar.detection.local_model import LocalModel
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.geometry.se2 import compose, relative, wrap_angle
from jaxsonar.graph_slam.tracker import Tracker, TrackerState
from jaxsonar.loop_closure.submap_graph import SubmapGraph
from jaxsonar.registration.agglomerative_registration import register_by_ranges
from jaxsonar.registration.sequential_registration import register_scans
from jaxsonar.scans.firing_poses import path_poses
from jaxsonar.scans.measured_directions import measured_directions
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.smoothing.covisibility import Traversals
from jaxsonar.smoothing.settings import SETTINGS as SMOOTHING_SETTINGS

Progress = Callable[[str, int, int], None]
"""Called with the current task, the number of finished scans, and the number of scans; (0, 0) where it is unknown."""


@dataclass(frozen=True)
class InitialPoseSettings:
    """Constants of the initial poses; chosen by hand."""

    max_registered_by_ranges: int = 64
    """Scans; a log without odometry is registered by ranges up to this length, which takes some seconds for each scan.
    Longer logs are registered by walls and corners alone, which leaves more scans without a pose."""


SETTINGS = InitialPoseSettings()


class LoopClosure(NamedTuple):
    """A loop closure between two submaps."""

    first: int
    """Row of the first scan of the earlier submap."""
    second: int
    """Row of the first scan of the later submap."""
    first_from_second: Float[np.ndarray, "3"]
    """Pose of the later submap in the frame of the earlier one, metres and radians."""
    state: str
    """One of "accepted" (in the graph), "withdrawn" (accepted, later removed), "refused" (contradicts the graph),
    "proposed" (undecided)."""
    determined: Float[np.ndarray, "3 rank"]
    """Unit vectors of (x, y, theta) that the measurement determines, in the earlier frame. Parallel walls leave one
    direction undetermined; there ``first_from_second`` is that of the graph."""


@dataclass(frozen=True, eq=False)
class InitialPoses:
    """Poses of a log before smoothing, and what was estimated together with them."""

    poses: Float[np.ndarray, "scans 3"]
    """world_from_robot; NaN for scans without an estimate."""
    covariance: Float[np.ndarray, "scans 3 3"]
    """With respect to the first scan; NaN where it is not estimated."""
    odometry: Float[np.ndarray, "scans 3"]
    """world_from_robot by odometry; NaN for scans without odometry."""
    models: Sequence[LocalModel] | None = None
    """Local models of all scans; None with windows."""
    closures: tuple[LoopClosure, ...] = ()
    traversals: Traversals | None = None
    """The submaps and how well they are known relative to each other; None without submaps."""
    step_ms: Float[np.ndarray, " steps"] = field(default_factory=lambda: np.zeros(0))
    """Milliseconds of each tracked scan; empty where the log was not tracked."""


def detect(ring: Ring, log: Log, *, sigma: float | None, progress: Progress) -> list[LocalModel]:
    """The local models of all scans."""
    models: list[LocalModel] = []
    for model in local_models(ring, log, sigma=sigma):
        models.append(model)
        progress("local models", len(models), len(log))
    return models


def initial_poses(
    ring: Ring,
    log: Log,
    models: Sequence[LocalModel] | None,
    *,
    window: float | None,
    sigma: float | None,
    odometry_noise: OdometryNoise,
    progress: Progress,
) -> InitialPoses:
    """Initial poses of all scans.

    With windows the odometry as it is; otherwise tracked with odometry, or registered without.

    Args:
        ring: the sensors.
        log: scans whose poses are odometry; NaN where there is none.
        models: local models of all scans. None with windows, or if the tracker shall detect them scan by scan.
        window: metres of trajectory of one window; None: without windows.
        sigma: standard deviation of the ranges, metres; None: estimated.
        odometry_noise: noise model of the odometry.
        progress: is informed after each scan.
    """
    has_odometry = np.asarray(np.isfinite(log.pose).all(axis=1))
    odometry = np.where(has_odometry[:, None], log.pose, np.nan)
    if window is not None:
        return InitialPoses(odometry, np.full((len(log), 3, 3), np.nan), odometry)
    if has_odometry.any():
        tracker = Tracker(ring=ring, sigma=sigma, odometry_noise=odometry_noise)
        return _track(tracker, log, models, odometry, progress=progress)
    models = models or detect(ring, log, sigma=sigma, progress=progress)
    poses, covariance = _register(ring, log, models, sigma=sigma, progress=progress)
    return InitialPoses(poses, covariance, odometry, models)


def _track(
    tracker: Tracker,
    log: Log,
    models: Sequence[LocalModel] | None,
    odometry: Float[np.ndarray, "scans 3"],
    *,
    progress: Progress,
) -> InitialPoses:
    """Track all scans of a log with odometry, and close loops; without local models the tracker detects them."""
    # 1. The pose of every scan in its submap, and the graph of submaps.
    state, found, step_ms = tracker.start(), [], np.zeros(len(log))
    motion = path_poses(tracker.ring, log)
    for row in range(len(log)):
        begin = perf_counter()
        path_pose = None if motion is None else motion[row]
        model = None if models is None else models[row]
        state, step = tracker.step(state, log[row], model=model, path_pose=path_pose)
        step_ms[row] = 1e3 * (perf_counter() - begin)
        found.append(step.model)
        progress("tracking", row + 1, len(log))
    # 2. The last loop closures, and all poses after them.
    state = tracker.finish(state)
    poses, covariance = tracker.poses(state)
    closures, traversals = loop_closures(state.graph), submap_traversals(state)
    return InitialPoses(poses, covariance, odometry, found, closures, traversals, step_ms)


def _register(
    ring: Ring, log: Log, models: Sequence[LocalModel], *, sigma: float | None, progress: Progress
) -> tuple[Float[np.ndarray, "scans 3"], Float[np.ndarray, "scans 3 3"]]:
    """Poses and covariances of scans without odometry; scans outside of the largest reliable cluster have no pose."""

    def report(done: int, total: int) -> None:
        progress("placing", done, total)

    if len(log) <= SETTINGS.max_registered_by_ranges:
        cluster = register_by_ranges(ring, log, models, sigma=sigma, progress=report)[0]
        return cluster.poses, cluster.pose_covariance
    scale = SMOOTHING_SETTINGS.local_model_noise_scale
    directions = measured_directions(ring, log)
    poses = register_scans(models, None, noise_scale=scale, directions=directions, progress=report)[0]
    return poses, np.full((len(log), 3, 3), np.nan)


def submap_traversals(state: TrackerState) -> Traversals | None:
    """The submaps of a finished run, and the covariances of their relative poses; None without submaps."""
    submaps = state.graph.submaps
    if not submaps:
        return None
    segment = np.full(state.scan_count, -1)
    for number, submap in enumerate(submaps):
        segment[submap.rows] = number
    segment = np.maximum(np.maximum.accumulate(segment), 0)
    nodes = np.arange(len(submaps))
    covariances = state.graph.graph.relative_covariances(nodes)
    return Traversals(segment, compose(state.world_from_first, state.graph.poses[nodes]), covariances)


def loop_closures(graph: SubmapGraph) -> tuple[LoopClosure, ...]:
    """The loop closures of a graph, by the rows of scans."""
    first_row = [int(submap.rows[0]) for submap in graph.submaps]
    closures = []
    for candidate in graph.verifier.candidates:
        estimate = relative(graph.poses[candidate.earlier], graph.poses[candidate.newest])
        basis = candidate.measurement.basis
        residual = candidate.measurement.earlier_from_newest - estimate
        residual[2] = wrap_angle(float(residual[2]))
        pose = estimate + basis @ (basis.T @ residual)
        rows = first_row[candidate.earlier], first_row[candidate.newest]
        closures.append(LoopClosure(*rows, pose, candidate.state, basis))
    return tuple(closures)
