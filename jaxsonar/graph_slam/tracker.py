"""Online SLAM: ``Tracker.step`` takes one scan, and the front end and the graph of submaps estimate its pose."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsonar import kernels
from jaxsonar.detection.extract import local_model
from jaxsonar.detection.local_model import LocalModel
from jaxsonar.detection.settings import check_method, check_sigma, hough_settings
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.geometry.se2 import compose, compose_with_covariance, rotate_covariance
from jaxsonar.graph_slam.frontend import (
    SETTINGS,
    SubmapState,
    finish_submap,
    predict,
    start_submap,
    update,
    update_pose_only,
)
from jaxsonar.graph_slam.scan_echoes import SETTINGS as ECHO_SETTINGS
from jaxsonar.loop_closure.submap_graph import SubmapGraph
from jaxsonar.loop_closure.verification import ClosureDecision
from jaxsonar.scans.firing_poses import path_poses_of_scan
from jaxsonar.scans.scan_log import Scan
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True, eq=False)
class TrackerState:
    """The memory of a tracker between two scans."""

    submap: SubmapState
    """The submap around the robot."""
    graph: SubmapGraph
    """All finished submaps. Never changed in place: a step that adds to it works on a copy."""
    world_from_first: Float[np.ndarray, "3"]
    """Pose of the first scan: its odometry, or the origin."""
    scan_count: int
    """Number of scans so far."""


class TrackerStep(NamedTuple):
    """The result of one scan."""

    model: LocalModel
    """Its local model."""
    pose: Float[np.ndarray, "3"]
    """world_from_robot, metres and radians."""
    covariance: Float[np.ndarray, "3 3"]
    """Covariance of ``pose`` with respect to the first scan."""
    decisions: tuple[ClosureDecision, ...]
    """Decisions on loop closures that were made in this step."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Tracker:
    """Estimates poses scan by scan: ``state, step = tracker.step(state, scan)``; the poses of the scans are odometry.

    The cost of a step does not grow with the number of scans, except for the graph, which has a node every few metres.

    Raises:
        SonarError: invalid arguments, as for ``local_model``.
    """

    ring: Ring
    method: str = "ml"
    """Detection method."""
    settings: kernels.HoughSettings | None = None
    """Of the accumulator."""
    sigma: float | None = None
    """Standard deviation of the ranges, metres; None: estimated from the scans."""
    odometry_noise: OdometryNoise = field(default_factory=OdometryNoise)

    def __post_init__(self):
        check_method(self.method)
        check_sigma(self.sigma)
        object.__setattr__(self, "settings", hough_settings(self.ring, self.settings))

    def start(self) -> TrackerState:
        """The state before the first scan."""
        graph = SubmapGraph(reliable_range=ECHO_SETTINGS.reliable_range_fraction * float(self.ring.max_range))
        return TrackerState(start_submap(), graph, np.zeros(3), 0)

    def step(
        self,
        state: TrackerState,
        scan: Scan,
        *,
        model: LocalModel | None = None,
        path_pose: Float[np.ndarray, "paths 3"] | None = None,
    ) -> tuple[TrackerState, TrackerStep]:
        """Estimate the pose of one scan; the given state is not changed.

        Args:
            state: after the scan before.
            scan: its pose is odometry; NaN where there is none.
            model: its local model, if it is known already.
            path_pose: pose of the robot when each path fired, as ``local_model`` takes it; if left out, interpolated in
                ``Scan.odometry``.

        Raises:
            SonarError: a sensor number that the ring does not have.
        """
        if path_pose is None:
            path_pose = path_poses_of_scan(self.ring, scan)
        # 1. Detect walls and points.
        if model is None:
            model = local_model(
                self.ring, scan, method=self.method, settings=self.settings, sigma=self.sigma, path_pose=path_pose
            )
        row, submap, graph, decisions = state.scan_count, state.submap, state.graph, ()
        options = {"row": row, "sigma": self.sigma, "path_pose": path_pose}
        has_odometry = bool(np.isfinite(scan.pose).all())
        # 2. Predict by odometry, and update pose and landmarks by the ranges.
        bridged = not has_odometry and submap.odometry is not None and submap.dead_reckoned < SETTINGS.max_dead_reckoned
        if bridged:
            submap = update_pose_only(self.ring, submap, scan, model, self.odometry_noise, **options)
        else:
            predicted = predict(submap, scan.pose, self.odometry_noise)
            submap = update(self.ring, predicted, scan, model, **options)
        # 3. Finish a complete submap, or do a part of the pending work on loop closures.
        if not bridged and (submap.is_complete or submap.track_lost):
            graph = graph.copy()
            decisions = graph.add(finish_submap(submap))
            # The next submap starts with the same scan, because the pose in its frame must be known exactly.
            submap = update(self.ring, start_submap(submap), scan, model, **options)
        elif graph.has_pending_work:
            graph = graph.copy()
            decisions = graph.process_next()
        # 4. The pose in the world.
        is_origin = row == 0 and has_odometry
        state = TrackerState(submap, graph, scan.pose if is_origin else state.world_from_first, row + 1)
        pose, covariance = self._current_pose(state)
        return state, TrackerStep(model, pose, covariance, decisions)

    def finish(self, state: TrackerState) -> TrackerState:
        """Finish the last submap and all work on loop closures; the next scan starts a new submap."""
        graph = state.graph.copy()
        graph.process_all()
        if len(state.submap.rows) < 2:  # a single scan is also in the submap before
            return replace(state, graph=graph)
        graph.add(finish_submap(state.submap))
        graph.process_all()
        return replace(state, submap=start_submap(state.submap), graph=graph)

    def poses(self, state: TrackerState) -> tuple[Float[np.ndarray, "scans 3"], Float[np.ndarray, "scans 3 3"]]:
        """world_from_robot of all scans so far, and their covariances with respect to the first scan."""
        pose, cov = np.full((state.scan_count, 3), np.nan), np.full((state.scan_count, 3, 3), np.nan)
        node_covs = state.graph.covariances()
        submaps = [(one.rows, one.poses, one.pose_covariances) for one in state.graph.submaps]
        current = state.submap
        submaps.append((np.array(current.rows, np.int64), np.array(current.poses), np.array(current.covariances)))
        for node, (rows, own_poses, own_covs) in enumerate(submaps):
            base = state.graph.poses[node]
            for k, row in enumerate(rows.tolist()):
                pose[row], cov[row] = compose_with_covariance(base, node_covs[node], own_poses[k], own_covs[k])
        return _in_world(state, pose, cov)

    def _current_pose(self, state: TrackerState) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
        graph, submap = state.graph, state.submap
        base = graph.poses[len(graph.submaps)]
        pose, cov = compose_with_covariance(base, graph.last_covariance, submap.poses[-1], submap.covariances[-1])
        return _in_world(state, pose, cov)


def _in_world(
    state: TrackerState, pose: Float[np.ndarray, "*scans 3"], cov: Float[np.ndarray, "*scans 3 3"]
) -> tuple[Float[np.ndarray, "*scans 3"], Float[np.ndarray, "*scans 3 3"]]:
    """Poses in the frame of the first scan, and their covariances, in the world."""
    world_from_first = state.world_from_first
    return compose(world_from_first, pose), rotate_covariance(world_from_first[2], cov)
