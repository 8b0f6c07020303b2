"""Maps that grow scan by scan: the robot keeps what the walls amount to, and forgets the scans (paper, section 5)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from jaxsonar import kernels
from jaxsonar.detection.extract import local_model
from jaxsonar.detection.local_map import LocalModel
from jaxsonar.detection.local_map_builder import hough_models
from jaxsonar.detection.settings import check_method, check_sigma, hough_settings
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.geometry.se2 import transform_points
from jaxsonar.graph_slam.submap_evidence import SubmapEvidence
from jaxsonar.graph_slam.tracker import Tracker
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.build_map import assemble_map, check_merging, required_scans
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.mapping.map_evidence import MapEvidence, gather_evidence
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.scans.sliding_windows import WindowBuffer, check_window
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True, eq=False)
class MapState:
    """What a robot remembers between two scans; grows with the walls and the floor, not with the scans."""

    evidence: MapEvidence
    """What all scans so far say of the walls."""
    window_buffer: WindowBuffer
    """The path of the window that is being gathered; empty without windows."""
    waiting: tuple[Scan, ...]
    """Scans of that window that are not in the evidence yet."""
    submap_evidence: SubmapEvidence | None = None
    """Where poses are estimated: the scans by submap; their evidence is gathered when a map is asked for."""


@dataclass(frozen=True, eq=False)
class StepInfo:
    """What one scan came to."""

    model: LocalModel | None
    """The local model; None while a window is being gathered."""
    segments: Float[np.ndarray, "segments 2 2"]
    """Its segments in the world frame, metres."""
    ignored: str
    """Why the scan is not in the map; empty if it is."""
    pose: Float[np.ndarray, "3"] | None = None
    """Where poses are estimated: world_from_robot, metres and radians."""
    covariance: Float[np.ndarray, "3 3"] | None = None
    """Of that pose, with respect to the first one."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Mapper:
    """Builds a map scan by scan: ``state, info = mapper.step(state, scan)``; ``mapper.map(state)`` is the map so far.

    With ``odometry_noise`` the poses of the scans are odometry, and the robot's own are estimated step by step (``slam``); the
    scans are kept then, because closing a loop moves them.

    The evidence adds up, so the order of the scans does not matter, and the map is that of ``build_map`` on the same
    scans (to rounding, 1e-6 m and rad; only the latest ``SCANS_KEPT`` scans of a piece are listed). With windows the
    scans must come along the path.

    Raises:
        SonarError: arguments as for ``build_map``.
    """

    ring: Ring
    method: str = "ml"
    settings: kernels.HoughSettings | None = None
    sigma: float | None = None
    """Standard deviation of the ranges, metres; None: estimated for each scan."""
    window: float | None = None
    """Metres of path gathered into one local model; None: every scan is one."""
    merging: str = "fused"
    odometry_noise: OdometryNoise | None = None
    """How wrong the poses of the scans are, as odometry; None: they are right."""

    def __post_init__(self):
        check_method(self.method)
        check_sigma(self.sigma)
        check_merging(self.merging)
        check_window(self.window)
        if self.odometry_noise is not None and (self.window is not None or self.merging == "paper"):
            raise SonarError("mapper: odometry_noise came with a window or the paper's merging; allowed is either")
        object.__setattr__(self, "settings", hough_settings(self.ring, self.settings, window=self.window))

    def start(self) -> MapState:
        """A state that knows nothing."""
        nothing = MapEvidence.empty()
        return MapState(
            nothing, WindowBuffer(), (), None if self._tracker is None else SubmapEvidence(self._tracker.start())
        )

    def step(
        self,
        state: MapState,
        scan: Scan,
        *,
        model: LocalModel | None = None,
        path_pose: Float[np.ndarray, "paths 3"] | None = None,
    ) -> tuple[MapState, StepInfo]:
        """Take in one scan; the state given is left as it was.

        Args:
            state: so far.
            scan: its pose is right, or odometry (``odometry_noise``).
            model: its local model, if it is known already; not with windows.
            path_pose: of a robot that moved during the scan, as ``local_model`` takes it; not with windows.

        Raises:
            SonarError: a sensor number that the ring does not have.
        """
        if state.submap_evidence is not None and self._tracker is not None:
            journey, step = state.submap_evidence.step(self._tracker, scan, model=model, path_pose=path_pose)
            segments = [transform_points(step.pose, line.segment) for line in step.model.lines]
            info = StepInfo(step.model, np.array(segments).reshape(-1, 2, 2), "", step.pose, step.covariance)
            return replace(state, submap_evidence=journey), info
        if self.window is None:
            if not np.isfinite(scan.pose).all():
                return state, _nothing("no pose")
            if model is None:
                choices = {"method": self.method, "settings": self.settings, "sigma": self.sigma}
                model = local_model(self.ring, scan, **choices, path_pose=path_pose)
            return self._with(state, model, Log.from_scans([scan]))
        if not np.isfinite(scan.pose).all():
            state, info = self._closed(state)
            window_buffer, _ = state.window_buffer.add(scan, length=self.window)
            return replace(state, window_buffer=window_buffer), replace(info, ignored="no pose")
        window_buffer, ends = state.window_buffer.add(scan, length=self.window)
        state = replace(state, window_buffer=window_buffer, waiting=(*state.waiting, scan))
        return self._closed(state) if ends else (state, _nothing(""))

    def including(self, state: MapState, scans: Sequence[Scan], models: Sequence[LocalModel]) -> MapState:
        """Take in scans whose local models are known, in one step; those without a pose are left out. Not for windows.

        Args:
            state: is left as it was.
            scans: with different numbers.
            models: of these scans, in the same order.

        Raises:
            SonarError: a sensor number that the ring does not have.
        """
        placed = [(s, m) for s, m in zip(scans, models, strict=True) if np.isfinite(s.pose).all()]
        if not placed:
            return state
        log = Log.from_scans([scan for scan, _ in placed])
        return self._joined(state, gather_evidence(self.ring, log, [model for _, model in placed]))

    def finish(self, state: MapState) -> MapState:
        """Take in what is left of the last window."""
        return self._closed(state)[0]

    def map(self, state: MapState) -> GlobalMap:
        """The map so far."""
        evidence = (
            state.evidence
            if state.submap_evidence is None
            else state.submap_evidence.evidence(self.ring) or state.evidence
        )
        return assemble_map(evidence, merging=self.merging, min_scans=required_scans(self.window))

    def trajectory(self, state: MapState) -> tuple[Float[np.ndarray, "scans 3"], Float[np.ndarray, "scans 3 3"]]:
        """Where poses are estimated: those of all scans so far, and their covariances with respect to the first one."""
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

    def _closed(self, state: MapState) -> tuple[MapState, StepInfo]:
        """The window ends here."""
        if self.window is None or not state.waiting:
            return state, _nothing("")
        assert self.settings is not None
        log, windows = state.window_buffer.window(self.ring, length=self.window)
        model = next(hough_models(self.ring, log, windows, self.settings))
        return self._with(replace(state, waiting=()), model, Log.from_scans(state.waiting))

    def _with(self, state: MapState, model: LocalModel, log: Log) -> tuple[MapState, StepInfo]:
        new = gather_evidence(self.ring, log, [model])
        return self._joined(state, new), StepInfo(model, new.segments.endpoints, "")

    def _joined(self, state: MapState, new: MapEvidence) -> MapState:
        evidence = state.evidence.union(new)
        if self.merging != "paper":
            evidence = evidence.condensed()
        return replace(state, evidence=evidence)


def _nothing(why: str) -> StepInfo:
    return StepInfo(None, np.zeros((0, 2, 2)), why)
