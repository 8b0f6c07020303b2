"""Incremental mapping: a map that grows scan by scan, from evidence that adds up (paper, section 5)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from jaxsonar import kernels
from jaxsonar.detection.extract import local_model
from jaxsonar.detection.local_model import LocalModel
from jaxsonar.detection.local_model_builder import hough_models
from jaxsonar.detection.settings import check_method, check_sigma, hough_settings
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.geometry.se2 import transform_points
from jaxsonar.graph_slam.submap_evidence import SubmapEvidence
from jaxsonar.graph_slam.tracker import Tracker
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.build_map import (
    add_reflectors,
    assemble_map,
    check_merging,
    required_scans,
    seeks_reflectors,
)
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.mapping.map_evidence import MapEvidence, gather_evidence
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.scans.sliding_windows import WindowBuffer, check_window
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True, eq=False)
class MapState:
    """The memory of a mapper between two scans; it grows with walls and floor area, not with the number of scans."""

    evidence: MapEvidence
    """Evidence of all scans so far."""
    window_buffer: WindowBuffer
    """The trajectory of the unfinished window; empty without windows."""
    pending_scans: tuple[Scan, ...]
    """Scans of that window, which are not in the evidence yet."""
    submap_evidence: SubmapEvidence | None = None
    """With pose estimation: the scans by submap; their evidence is gathered when a map is requested."""


@dataclass(frozen=True, eq=False)
class StepInfo:
    """The result of one scan."""

    model: LocalModel | None
    """The local model; None while a window is unfinished."""
    segments: Float[np.ndarray, "segments 2 2"]
    """Its walls in the world frame, metres."""
    ignored: str
    """Reason why the scan is not in the map; empty if it is."""
    pose: Float[np.ndarray, "3"] | None = None
    """With pose estimation: world_from_robot, metres and radians."""
    covariance: Float[np.ndarray, "3 3"] | None = None
    """Covariance of that pose with respect to the first one."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Mapper:
    """Builds a map scan by scan: ``state, info = mapper.step(state, scan)``; ``mapper.map(state)`` is the map so far.

    With ``odometry_noise`` the poses of the scans are odometry, and the mapper estimates the poses (``Tracker``). It
    then keeps all scans, because loop closures move them. Otherwise the poses of the scans are used as they are.

    Evidence adds up: the order of the scans does not matter, and the map equals that of ``build_map`` for the same
    scans (up to rounding, 1e-6 m and rad; only the latest scans of each wall are listed). With windows the scans must
    come in the order of the trajectory, and the map equals that of ``build_map`` with ``grow=False``.

    Raises:
        SonarError: invalid arguments, as for ``build_map``.
    """

    ring: Ring
    method: str = "ml"
    """Detection method."""
    settings: kernels.HoughSettings | None = None
    """Of the accumulator."""
    sigma: float | None = None
    """Standard deviation of the ranges, metres; None: estimated for each scan."""
    window: float | None = None
    """Metres of trajectory gathered into one local model; None: every scan has one."""
    merging: str = "fused"
    """Merging method, as for ``build_map``."""
    odometry_noise: OdometryNoise | None = None
    """Noise of the poses of the scans if they are odometry; None: they are exact."""

    def __post_init__(self):
        check_method(self.method)
        check_sigma(self.sigma)
        check_merging(self.merging)
        check_window(self.window)
        if self.odometry_noise is not None and (self.window is not None or self.merging == "paper"):
            raise SonarError("mapper: odometry_noise with a window or the paper's merging; allowed is one of them")
        object.__setattr__(self, "settings", hough_settings(self.ring, self.settings, window=self.window))

    def start(self) -> MapState:
        """The state before the first scan."""
        submap_evidence = None if self._tracker is None else SubmapEvidence(self._tracker.start())
        return MapState(MapEvidence.empty(), WindowBuffer(), (), submap_evidence)

    def step(
        self,
        state: MapState,
        scan: Scan,
        *,
        model: LocalModel | None = None,
        path_pose: Float[np.ndarray, "paths 3"] | None = None,
    ) -> tuple[MapState, StepInfo]:
        """Add one scan; the given state is not changed.

        Args:
            state: after the scan before.
            scan: its pose is exact, or odometry (``odometry_noise``).
            model: its local model, if it is known already; not with windows.
            path_pose: pose of the robot when each path fired, as ``local_model`` takes it; not with windows.

        Raises:
            SonarError: a sensor number that the ring does not have.
        """
        if state.submap_evidence is not None and self._tracker is not None:
            evidence, step = state.submap_evidence.step(self._tracker, scan, model=model, path_pose=path_pose)
            segments = [transform_points(step.pose, line.segment) for line in step.model.lines]
            info = StepInfo(step.model, np.array(segments).reshape(-1, 2, 2), "", step.pose, step.covariance)
            return replace(state, submap_evidence=evidence), info
        if self.window is not None:
            return self._step_of_window(state, scan, self.window)
        if not np.isfinite(scan.pose).all():
            return state, _without_model("no pose")
        if model is None:
            options = {"method": self.method, "settings": self.settings, "sigma": self.sigma}
            model = local_model(self.ring, scan, **options, path_pose=path_pose)
        return self._with_model(state, model, Log.from_scans([scan]))

    def _step_of_window(self, state: MapState, scan: Scan, length: float) -> tuple[MapState, StepInfo]:
        """Add a scan to the unfinished window; a scan without a pose ends the window."""
        if not np.isfinite(scan.pose).all():
            state, info = self._end_window(state)
            window_buffer, _ = state.window_buffer.add(scan, length=length)
            return replace(state, window_buffer=window_buffer), replace(info, ignored="no pose")
        window_buffer, ends = state.window_buffer.add(scan, length=length)
        state = replace(state, window_buffer=window_buffer, pending_scans=(*state.pending_scans, scan))
        return self._end_window(state) if ends else (state, _without_model(""))

    def add_scans(self, state: MapState, scans: Sequence[Scan], models: Sequence[LocalModel]) -> MapState:
        """Add scans with known local models in one step; scans without a pose are ignored. Not for windows.

        Args:
            state: before; it is not changed.
            scans: with different scan numbers.
            models: the local model of each of them.

        Raises:
            SonarError: a sensor number that the ring does not have.
        """
        with_pose = [(s, m) for s, m in zip(scans, models, strict=True) if np.isfinite(s.pose).all()]
        if not with_pose:
            return state
        log = Log.from_scans([scan for scan, _ in with_pose])
        return self._add_evidence(state, gather_evidence(self.ring, log, [model for _, model in with_pose]))

    def finish(self, state: MapState) -> MapState:
        """Add the unfinished window."""
        return self._end_window(state)[0]

    def map(self, state: MapState) -> GlobalMap:
        """The map so far."""
        evidence = state.evidence
        if state.submap_evidence is not None:
            evidence = state.submap_evidence.evidence(self.ring) or evidence
        world = assemble_map(evidence, merging=self.merging, min_scans=required_scans(self.window))
        if not seeks_reflectors(self.method, self.window, self.merging):
            return world
        return add_reflectors(world, evidence.scans.measurements(), sigma=self.sigma)

    def trajectory(self, state: MapState) -> tuple[Float[np.ndarray, "scans 3"], Float[np.ndarray, "scans 3 3"]]:
        """With pose estimation: poses of all scans so far, and their covariances with respect to the first one."""
        if state.submap_evidence is None or self._tracker is None:
            raise SonarError("mapper: no poses are estimated; allowed is a mapper with odometry_noise")
        return self._tracker.poses(state.submap_evidence.tracker_state)

    @cached_property
    def _tracker(self) -> Tracker | None:
        if self.odometry_noise is None:
            return None
        return Tracker(
            ring=self.ring,
            method=self.method,
            settings=self.settings,
            sigma=self.sigma,
            odometry_noise=self.odometry_noise,
        )

    def _end_window(self, state: MapState) -> tuple[MapState, StepInfo]:
        """Make the local model of the unfinished window, and add its evidence."""
        if self.window is None or not state.pending_scans:
            return state, _without_model("")
        assert self.settings is not None
        log, windows = state.window_buffer.window(self.ring, length=self.window)
        model = next(hough_models(self.ring, log, windows, self.settings))
        return self._with_model(replace(state, pending_scans=()), model, Log.from_scans(state.pending_scans))

    def _with_model(self, state: MapState, model: LocalModel, log: Log) -> tuple[MapState, StepInfo]:
        new = gather_evidence(self.ring, log, [model])
        return self._add_evidence(state, new), StepInfo(model, new.segments.endpoints, "")

    def _add_evidence(self, state: MapState, new: MapEvidence) -> MapState:
        evidence = state.evidence.union(new)
        if self.merging != "paper":
            evidence = evidence.condensed()
        return replace(state, evidence=evidence)


def _without_model(ignored: str) -> StepInfo:
    return StepInfo(None, np.zeros((0, 2, 2)), ignored)
