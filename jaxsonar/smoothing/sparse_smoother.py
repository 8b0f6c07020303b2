"""Smoothing for sparse rings: poses and walls of windows, adjusted together to echoes with heavy tails.

A scan of a sparse ring shows no wall. Maps of windows alternate with adjustments of all poses
(``heavy_tailed_adjust``). Where walls hardly add to what the odometry knows, the odometry is kept: then errors of the
map would harm more than its information helps.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxsonar.estimation.adjustment_state import AdjustmentResult, AdjustmentState
from jaxsonar.estimation.alternation import AlternationResult
from jaxsonar.estimation.batch_data import BatchData
from jaxsonar.estimation.heavy_tailed_adjustment import heavy_tailed_adjust
from jaxsonar.estimation.landmark_map import landmark_map_of
from jaxsonar.estimation.odometry_noise import OdometryNoise, OdometryNoiseModel
from jaxsonar.estimation.robust_adjustment import explained_echoes
from jaxsonar.estimation.sparse_adjustment import marginal_covariances
from jaxsonar.mapping.build_map import build_map
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_parameters import ParameterBasis
from jaxsonar.smoothing.covisibility import select_landmarks
from jaxsonar.smoothing.settings import SETTINGS
from jaxsonar.smoothing.smoother import NO_WALL, NothingExplained, SmoothingFit


@dataclass(frozen=True)
class SparseSmootherSettings:
    """Constants for sparse rings; chosen by hand."""

    maps: int = 4
    """Maps that are built, each from better poses."""
    min_length: float = 1.0
    """Metres; shorter walls do not move poses: many of them are recesses and doors. Nor do corners and edges, which
    direct echoes do not tell apart."""
    explained: float = 0.1
    """Metres; echoes nearer to the range of a wall are explained by it, like those of an uneven wall."""
    least_heading_gain: float = 0.2
    """Least share of the variance of the headings that walls must remove; with less the odometry is kept."""
    heading_per_meter: float = float(np.radians(0.6))
    """Standard deviation of the heading by odometry after one metre, radians. On two recorded runs it is 0.3 to 0.7 deg
    after one metre; the larger default of ``OdometryNoise`` would leave the heading to uneven walls."""


SPARSE_SETTINGS = SparseSmootherSettings()
SPARSE_ODOMETRY_NOISE = OdometryNoise(heading_per_meter=SPARSE_SETTINGS.heading_per_meter)
"""Usual noise of the odometry of robots with sparse rings."""


class SparseFit(NamedTuple):
    """Poses and walls after the adjustment."""

    fit: SmoothingFit
    world: GlobalMap
    """The map at these poses."""
    heading_gain: float
    """Share of the variance of the headings by odometry that the walls remove; with too little of it, the poses are
    those of the odometry."""


@dataclass(frozen=True)
class SparseSmoother:
    """The problem: scans of a sparse ring and their odometry."""

    ring: Ring
    log: Log
    odometry: Float[np.ndarray, "scans 3"]
    """world_from_robot as measured; NaN where there is none."""
    basis: ParameterBasis
    """Free parameters: speed of sound, scale factors of the odometry."""
    odometry_noise: OdometryNoiseModel
    sigma: float | None
    """Standard deviation of the ranges, metres; None: estimated."""
    window: float
    """Metres of trajectory gathered into one local model."""
    fixed_row: int
    """Row of the scan whose pose is fixed."""
    progress: Callable[[str], None]

    def fit(self, poses: Float[np.ndarray, "scans 3"]) -> SparseFit:
        """Adjust poses and walls from a start (NaN: no pose)."""
        data = self._batch_data(replace(self.log, pose=poses))
        state = AdjustmentState(
            np.zeros(self.basis.columns.shape[1]), data.poses, landmark_map_of([], tie_corners=False)
        )
        start, found, walls, long = state, None, None, np.zeros(0, np.int64)
        for _ in range(SPARSE_SETTINGS.maps):
            self.progress("building the map")
            world = self._map_at(state, data)
            if not len(world):
                raise NothingExplained(NO_WALL)
            long = np.flatnonzero(_lengths(world) >= SPARSE_SETTINGS.min_length)
            rows = long if len(long) else np.arange(len(world))
            walls = select_landmarks(world, [(row, world.scans[row]) for row in rows.tolist()], [])
            state = state._replace(landmark_map=landmark_map_of([walls], tie_corners=False))
            self.progress("least squares")
            with jax.enable_x64(True):
                found = heavy_tailed_adjust(self.ring, data, self.basis, state, sigma=self.sigma)
            state = found.state
        assert found is not None
        assert walls is not None
        gain = self._heading_gain(found, data) if len(long) else 0.0
        if gain < SPARSE_SETTINGS.least_heading_gain:
            found = _without_echoes(found, start, data)
        # The share of explained echoes is that of the whole map, also of its short walls.
        adjusted = data.logs_with_poses([self.log], found.state.poses)[0].pose
        world = self._map_at(found.state, data)
        with jax.enable_x64(True):
            explained = explained_echoes(
                self.ring_of(found.state),
                replace(data, poses=np.asarray(found.state.poses)),
                landmark_map_of([world], tie_corners=False),
                gate=SPARSE_SETTINGS.explained,
            )
        counts, rows = np.zeros(len(self.log), np.int64), data.scan_rows[0]
        counts[rows] = explained.sum(axis=1)[: len(rows)]
        found = found._replace(used=explained)
        return SparseFit(SmoothingFit(data, AlternationResult([walls], found), adjusted, counts), world, gain)

    def ring_of(self, state: AdjustmentState) -> Ring:
        """The ring with the estimated speed of sound."""
        factor = float(np.exp((self.basis.columns @ state.coordinates)[self.ring.count]))
        return replace(self.ring, speed_of_sound=float(self.ring.speed_of_sound) * factor)

    def _map_at(self, state: AdjustmentState, data: BatchData) -> GlobalMap:
        log = data.logs_with_poses([self.log], state.poses)[0]
        return build_map(self.ring_of(state), log, window=self.window, sigma=self.sigma, reflectors=False)

    def _batch_data(self, log: Log) -> BatchData:
        """Echoes, odometry and priors: one pose is fixed, all others and the walls are free."""
        data = BatchData.from_logs(self.ring, [log], [self.odometry], self.odometry_noise, keep_empty_scans=True)
        prior_information = np.tile(1 / np.square(SETTINGS.free_pose_sd), (len(data.poses), 1))
        prior_information[data.scan_rows[0].tolist().index(self.fixed_row)] = 1 / SETTINGS.fixed_pose_sd**2
        return replace(
            data,
            prior_information=prior_information,
            landmark_prior_sd=SETTINGS.free_pose_sd[0],
            cost_tolerance=SETTINGS.cost_tolerance,
            max_iterations=SETTINGS.large_problem_iterations,
        )

    def _heading_gain(self, found: AdjustmentResult, data: BatchData) -> float:
        """Share of the variance of the headings by odometry that the walls remove."""
        rows = slice(0, len(data.scan_rows[0]))
        with jax.enable_x64(True):
            after, before = (
                marginal_covariances(one.problem, one.solution.unknowns, poses_free=True).poses[rows, 2, 2].sum()
                for one in (found, _without_echoes(found, found.state, data))
            )
        return float(1 - after / max(before, 1e-12))


def _without_echoes(found: AdjustmentResult, state: AdjustmentState, data: BatchData) -> AdjustmentResult:
    """An adjustment to odometry and priors only, whose result is a state (with the landmarks of the adjustment)."""
    state = state._replace(landmark_map=found.state.landmark_map)
    factors = replace(found.problem.factors, weight=jnp.zeros_like(found.problem.factors.weight))
    odometry_information = jnp.asarray(data.odometry_information)  # without the weights of the adjustment
    problem = replace(found.problem, factors=factors, odometry_information=odometry_information)
    with jax.enable_x64(True):
        solution = found.solution._replace(unknowns=state.unknowns())
    return found._replace(state=state, problem=problem, solution=solution)


def _lengths(world: GlobalMap) -> Float[np.ndarray, " walls"]:
    """Lengths of the walls of a map, metres."""
    return np.linalg.norm(world.segments[:, 1] - world.segments[:, 0], axis=-1)
