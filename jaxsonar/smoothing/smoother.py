"""Smoothing: all poses and landmarks adjusted together to the raw ranges, the batch back end of SLAM.

``Smoother`` alternates between mapping and least squares (``alternate``), with two restrictions on which scans observe
the same landmark: covisibility (``covisibility.py``) and odometry outliers (``odometry_outliers.py``).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.detection.local_model import LocalModel
from jaxsonar.estimation.adjustment_state import AdjustmentResult, AdjustmentState
from jaxsonar.estimation.alternation import SETTINGS as ALTERNATION_SETTINGS
from jaxsonar.estimation.alternation import AlternationResult, alternate
from jaxsonar.estimation.batch_data import BatchData
from jaxsonar.estimation.landmark_map import LandmarkMap, landmark_map_of, map_with_tentative_points
from jaxsonar.estimation.odometry_noise import OdometryNoiseModel
from jaxsonar.estimation.robust_adjustment import anneal, gnc_adjust
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.build_map import add_reflectors
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.reflectors.posed_scans import PosedScans
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_parameters import ParameterBasis
from jaxsonar.smoothing.covisibility import Traversals
from jaxsonar.smoothing.odometry_outliers import OdometryOutliers, find_odometry_outliers
from jaxsonar.smoothing.settings import SETTINGS
from jaxsonar.smoothing.wall_echo_mask import wall_explained_mask

NO_WALL = "smooth: no wall found; allowed are scans of a place with straight walls in reach"


class NothingExplained(SonarError):
    """No wall, or no echo that fits one."""


class SmoothingFit(NamedTuple):
    """Poses and landmarks after the adjustment."""

    data: BatchData
    alternation: AlternationResult
    poses: Float[np.ndarray, "scans 3"]
    """world_from_robot; NaN for scans without a pose."""
    echo_counts: Int[np.ndarray, " scans"]
    """Echoes of each scan that landmarks explain."""
    outliers: OdometryOutliers | None = None
    """Where points are split; None: not known."""

    @property
    def adjustment(self) -> AdjustmentResult:
        """The last adjustment."""
        return self.alternation.adjustment

    @property
    def explained_count(self) -> int:
        """Number of echoes that landmarks explain."""
        return self.alternation.explained_count


@dataclass(frozen=True)
class Smoother:
    """The problem: scans, their odometry, and what is estimated besides poses and landmarks."""

    ring: Ring
    log: Log
    odometry: Float[np.ndarray, "scans 3"]
    """world_from_robot as measured; NaN where there is none."""
    basis: ParameterBasis
    """Free parameters: speed of sound, scale factors of the odometry."""
    odometry_noise: OdometryNoiseModel
    sigma: float | None
    """Standard deviation of the ranges, metres; None: estimated."""
    models: Sequence[LocalModel]
    """Local models of all scans."""
    traversals: Traversals | None
    """Segments of the trajectory; None: all scans may observe the same landmarks."""
    fixed_row: int
    """Row of the scan whose pose is fixed."""
    progress: Callable[[str], None]

    def fit(self, poses: Float[np.ndarray, "scans 3"]) -> SmoothingFit:
        """Adjust poses and landmarks from a start (NaN: no pose), and split points at odometry outliers.

        Repeated with more split points as long as that leaves fewer outliers.
        """
        fit = self._fit(poses)
        if has_pose(fit.poses).sum() < has_pose(poses).sum():
            fit = self._fit(fit.poses)
        split = outliers = self._odometry_outliers(fit)
        for _ in range(SETTINGS.max_outlier_rounds):
            if not len(outliers):
                break
            self.progress("splitting points at odometry outliers")
            again = self._fit(np.where(has_pose(fit.poses)[:, None], poses, np.nan), split)
            remaining = np.setdiff1d(self._odometry_outliers(again), split)
            explains_less = again.explained_count * SETTINGS.min_decrease < fit.explained_count
            if len(remaining) >= len(outliers) or explains_less:
                break
            fit, outliers, split = again, remaining, np.union1d(split, remaining)
        return fit

    def with_circles(self, fit: SmoothingFit) -> SmoothingFit:
        """The fit adjusted once more with the circles that its poses show as landmarks; the same without a circle.

        Circles need poses: their search uses the echoes of all scans that the walls and corners leave over.
        """
        if fit.outliers is None:
            return fit
        world, placed = fit.alternation.maps[0], replace(self.log, pose=fit.poses)
        measurements = PosedScans.of(self.ring_of(fit.adjustment.state), placed).measurements()
        world = _with_known_circles(world, add_reflectors(world, measurements, sigma=self.sigma))
        if world is None:
            return fit
        landmark_map = self._landmark_map(fit.data, world, fit.outliers)
        state = fit.adjustment.state._replace(landmark_map=landmark_map)
        adjustment = self._adjust(fit.data, state, ALTERNATION_SETTINGS.later_scale)
        again = AlternationResult([world], adjustment)
        return self._fit_of(fit.data, placed, again, fit.outliers)

    def ring_of(self, state: AdjustmentState) -> Ring:
        """The ring with the estimated speed of sound."""
        factor = float(np.exp((self.basis.columns @ state.coordinates)[self.ring.count]))
        return replace(self.ring, speed_of_sound=float(self.ring.speed_of_sound) * factor)

    def _fit(
        self, poses: Float[np.ndarray, "scans 3"], split: Int[np.ndarray, " outliers"] | None = None
    ) -> SmoothingFit:
        """One adjustment from a start; scans with too few explained echoes lose their pose."""
        log = replace(self.log, pose=poses)
        data = self._batch_data(log)
        outliers = OdometryOutliers(np.zeros(0, np.int64) if split is None else split, self._row_of_scan)
        found = self._alternate(data, log, outliers)
        if found is None:
            raise NothingExplained("smooth: no echo fits the walls; is it the right ring, are poses and units right?")
        return self._fit_of(data, log, found, outliers)

    def _fit_of(self, data: BatchData, log: Log, found: AlternationResult, outliers: OdometryOutliers) -> SmoothingFit:
        """The fit of an adjustment; scans with too few explained echoes lose their pose."""
        rows = data.scan_rows[0]
        explained, echoes = np.zeros((2, len(log)), dtype=np.int64)
        explained[rows] = found.adjustment.used.sum(axis=1)[: len(rows)]
        echoes[rows] = np.isfinite(data.reported).sum(axis=1)[: len(rows)]
        lost = self._lost_scans(data, explained, echoes)
        adjusted = data.logs_with_poses([log], found.adjustment.state.poses)[0].pose
        poses = np.where(lost[:, None], np.nan, adjusted)
        return SmoothingFit(data, found, poses, np.where(lost, 0, explained), outliers)

    def _batch_data(self, log: Log) -> BatchData:
        """Echoes, odometry and priors: one pose is fixed, all others and the landmarks are free."""
        data = BatchData.from_logs(self.ring, [log], [self.odometry], self.odometry_noise, keep_empty_scans=True)
        prior_information = np.tile(1 / np.square(SETTINGS.free_pose_sd), (len(data.poses), 1))
        fixed = int(np.flatnonzero(data.scan_rows[0] == self.fixed_row)[0])
        prior_information[fixed] = 1 / SETTINGS.fixed_pose_sd**2
        is_large = data.scan_count > SETTINGS.large_problem
        return replace(
            data,
            prior_information=prior_information,
            landmark_prior_sd=SETTINGS.free_pose_sd[0],
            min_echoes_per_landmark=self._min_echoes_per_landmark,
            cost_tolerance=SETTINGS.cost_tolerance,
            wall_explained=wall_explained_mask(self.ring, data, self.models),
            max_iterations=SETTINGS.large_problem_iterations if is_large else data.max_iterations,
        )

    def _alternate(self, data: BatchData, log: Log, outliers: OdometryOutliers) -> AlternationResult | None:
        """Alternate mapping and adjustment; in the first round the poses stay near the start."""
        near_start = np.maximum(data.prior_information, 1 / np.square(SETTINGS.start_sd))
        state = AdjustmentState(
            np.zeros(self.basis.columns.shape[1]), data.poses, landmark_map_of([], tie_corners=False)
        )
        self.progress("first map")
        first_map = self._build_map(data, log, state, outliers)
        state = state._replace(landmark_map=self._landmark_map(data, first_map, outliers))
        with jax.enable_x64(True):
            state = anneal(
                self.ring,
                replace(data, prior_information=near_start),
                self.basis,
                state,
                initial_scale=SETTINGS.initial_scale,
                sigma=self.sigma,
            )
        is_large = data.scan_count > SETTINGS.large_problem
        return alternate(
            state,
            build_maps=lambda state: [self._build_map(data, log, state, outliers)],
            adjust=lambda state, scale: self._adjust(data, state, scale),
            initial_scale=ALTERNATION_SETTINGS.later_scale,
            progress=self.progress,
            max_maps=SETTINGS.large_problem_maps if is_large else ALTERNATION_SETTINGS.max_maps,
            landmarks_of=lambda maps: self._landmark_map(data, maps[0], outliers),
        )

    def _adjust(self, data: BatchData, state: AdjustmentState, initial_scale: float) -> AdjustmentResult:
        with jax.enable_x64(True):
            return gnc_adjust(
                self.ring, data, self.basis, state, initial_scale=initial_scale, poses_free=True, sigma=self.sigma
            )

    def _build_map(self, data: BatchData, log: Log, state: AdjustmentState, outliers: OdometryOutliers) -> GlobalMap:
        """The map at the poses of a state, with landmarks split by covisibility and odometry outliers."""
        placed = data.logs_with_poses([log], state.poses)[0]
        world = map_with_tentative_points(self.ring_of(state), placed, models=self.models)
        if not len(world):
            raise NothingExplained(NO_WALL)
        if self.traversals is not None:
            world = self.traversals.split_landmarks(world, self._row_of_scan)
        return outliers.split_landmarks(world) if len(outliers.steps) else world

    def _landmark_map(self, data: BatchData, world: GlobalMap, outliers: OdometryOutliers) -> LandmarkMap:
        """The landmarks of a map, and which scans may observe each of them."""
        landmark_map = landmark_map_of([world], tie_corners=False)
        if self.traversals is None and not len(outliers.steps):
            return landmark_map
        mask = outliers.visibility_mask(world, len(self.log))
        if self.traversals is not None:
            segments = self.traversals.visibility_mask(world, self._row_of_scan)
            mask &= segments[self.traversals.segment_id]
        rows = data.scan_rows[0]
        visible = np.zeros((len(data.poses), len(landmark_map.map_index)), dtype=bool)
        visible[: len(rows), : mask.shape[1]] = mask[rows]
        return landmark_map._replace(visible=visible)

    def _odometry_outliers(self, fit: SmoothingFit) -> Int[np.ndarray, " outliers"]:
        """Rows of the scans at which odometry outliers begin."""
        rows, found = fit.data.scan_rows[0], fit.adjustment
        with jax.enable_x64(True):
            residual = np.asarray(kernels.odometry_residuals(found.problem, found.solution.unknowns))
        steps = slice(0, len(rows) - 1)
        return rows[find_odometry_outliers(residual[steps], fit.data.odometry_information[steps])]

    def _lost_scans(
        self, data: BatchData, explained: Int[np.ndarray, " scans"], echoes: Int[np.ndarray, " scans"]
    ) -> Bool[np.ndarray, " scans"]:
        """Scans without odometry to a neighbor of which too few echoes are explained."""
        rows = data.scan_rows[0]
        has_odometry = np.zeros(len(explained), dtype=bool)
        measured = data.odometry_information[: len(rows), 0][:-1] > 0
        has_odometry[rows[:-1]] |= measured
        has_odometry[rows[1:]] |= measured
        average = explained.sum() / max(echoes.sum(), 1)
        least = np.maximum(SETTINGS.min_explained_echoes, SETTINGS.min_explained * average * echoes[rows])
        lost = np.zeros(len(explained), dtype=bool)
        lost[rows] = (explained[rows] < least) & ~has_odometry[rows]
        lost[self.fixed_row] = False
        return lost

    @property
    def _min_echoes_per_landmark(self) -> int:
        """Least number of echoes of one landmark in a scan; a sparse ring has fewer than usual of a whole wall."""
        of_a_long_wall = float(np.asarray(self.ring.echo_paths.width).sum() / (2 * np.pi))
        return min(SETTINGS.min_echoes_per_landmark, max(1, int(of_a_long_wall)))

    @cached_property
    def _row_of_scan(self) -> dict[int, int]:
        """Row of each scan number in the log."""
        return {int(number): row for row, number in enumerate(self.log.scan)}


def _with_known_circles(world: GlobalMap, found: GlobalMap) -> GlobalMap | None:
    """A map with the circles of another one whose radii are known; None if there is none.

    Args:
        world: walls and points.
        found: the same with the reflectors that ``add_reflectors`` finds, and without the short walls that they
            replace.
    """
    is_circle = np.array([kind == "circle" for kind in found.point_kinds], dtype=bool)
    known = is_circle & (found.point_circle_cov[:, 2, 2] < SETTINGS.max_radius_sd**2)
    if not known.any():
        return None
    circles = found.take_points(known)
    distance = np.linalg.norm(world.points[:, None] - circles.points, axis=-1) - circles.point_radius
    points = world.take_points((distance > SETTINGS.circle_margin).all(axis=1))
    return found.with_points(
        np.concatenate([points.points, circles.points]),
        point_kinds=(*points.point_kinds, *circles.point_kinds),
        point_cov=np.concatenate([points.point_cov, circles.point_cov]),
        point_echoes=np.append(points.point_echoes, circles.point_echoes),
        point_scans=(*points.point_scans, *circles.point_scans),
        point_radius=np.append(points.point_radius, circles.point_radius),
        point_circle_cov=np.concatenate([points.point_circle_cov, circles.point_circle_cov]),
        point_probabilities=np.concatenate([points.point_probabilities, circles.point_probabilities]),
    )


def has_pose(poses: Float[np.ndarray, "scans 3"]) -> Bool[np.ndarray, " scans"]:
    """Which rows are poses, not NaN."""
    return np.isfinite(poses[:, 0])
