"""Registration, mapping and adjustment in turn: the inner loop of a calibration."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxsonar import kernels
from jaxsonar.calibration.settings import SETTINGS, CalibrationSettings
from jaxsonar.detection.extract import local_models
from jaxsonar.estimation.adjustment_state import AdjustmentResult, AdjustmentState
from jaxsonar.estimation.alternation import SETTINGS as ALTERNATION
from jaxsonar.estimation.alternation import alternate
from jaxsonar.estimation.batch_data import BatchData
from jaxsonar.estimation.explained_share import ExplainedShare
from jaxsonar.estimation.landmark_map import landmark_map_of, map_with_tentative_points
from jaxsonar.estimation.odometry_noise import ProportionalNoise
from jaxsonar.estimation.robust_adjustment import gnc_adjust
from jaxsonar.estimation.sparse_adjustment import marginal_covariances, solve_adjustment
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.registration.sequential_registration import register_scans
from jaxsonar.scans.measured_directions import measured_directions
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_parameters import ParameterBasis


class CalibrationFit(NamedTuple):
    """Ring parameters, poses and maps that fit the echoes."""

    logs: list[Log]
    """One per world, with initial poses."""
    data: BatchData
    maps: list[GlobalMap]
    """One per world."""
    adjustment: AdjustmentResult

    @property
    def explained_count(self) -> int:
        """Number of echoes that the landmarks explain."""
        return int(self.adjustment.used.sum())


@dataclass(frozen=True)
class CalibrationProblem:
    """What is estimated, from which ring."""

    ring: Ring
    """The ring at coordinates 0 of the basis."""
    basis: ParameterBasis
    poses_free: bool
    """Whether poses are estimated; those of the logs are odometry then."""
    odometry: float
    """Standard deviation of the odometry, as a fraction of displacement and rotation."""
    sigma: float | None
    """Standard deviation of the range noise, metres; None: estimated."""
    window: float | None
    """Length of trajectory gathered for one local model, metres; None: single scans."""
    progress: Callable[[str], None]
    settings: CalibrationSettings = SETTINGS

    def fit(self, ring: Ring, logs: Sequence[Log]) -> CalibrationFit:
        """Estimate ring, poses and map with the mean range offset held.

        Unknown poses are found by scan registration, more boldly in each attempt, until all scans have one.

        Args:
            ring: a ring closer to the truth than ``self.ring``.
            logs: the scans as recorded.
        """
        best = None
        attempts = self.settings.registrations if self._registers else self.settings.registrations[:1]
        for noise_scale, margin in attempts:
            fit = self._fit_registered(ring, *self._register(ring, logs, noise_scale, margin))
            if best is None or self._is_better(fit, best):
                best, ring = fit, self.ring_at(fit.adjustment.state)
            if len(best.logs) == len(logs) and best.data.scan_count == sum(len(log) for log in logs):
                break
        assert best is not None
        return best

    def fit_mean_offset(self, fit: CalibrationFit) -> tuple[CalibrationFit, str]:
        """Estimate the mean range offset as well, if second-order echoes determine it.

        A wall shifts with the mean offset, and a corner that is tied to two walls with it; a reflection at both walls
        shifts differently. Returns the new fit and "", or the given fit and the reason why the offset stays held.
        """
        settings, count = self.settings, self.ring.count
        # 1. Tie corners to the walls that meet there.
        landmark_map = landmark_map_of(fit.maps, tie_corners=True)
        if not (np.asarray(landmark_map.candidates.reflection.kind) == kernels.SECOND_ORDER).any():
            return fit, "no two walls of the map end at a common right-angled corner"
        # 2. Adjust with the mean offset free.
        state = fit.adjustment.state._replace(landmark_map=landmark_map)
        tied = self.adjust(fit.data, state, self.basis, 2 * ALTERNATION.later_scale)
        # 3. Accept if the offset is determined and the echoes fit as well as before.
        second_order = tied.used & (np.asarray(tied.problem.factors.reflection.kind) == kernels.SECOND_ORDER)
        echoes = int(second_order.sum())
        sd = float(np.sqrt(self.parameter_covariance(tied)[:count, :count].mean()))
        if echoes < settings.min_second_order_echoes or sd > settings.max_mean_offset_sd:
            needed = f"{1e3 * settings.max_mean_offset_sd:g} mm"
            return fit, f"{echoes} wall to wall echoes determine it to {1e3 * sd:.1f} mm only; needed is {needed}"
        misfit = float(np.sqrt(np.mean(tied.residual[second_order] ** 2))) / tied.sigma
        explained = tied.used.sum() >= settings.min_tied_fraction * fit.explained_count
        if misfit > settings.max_second_order_misfit or not explained:
            return fit, f"wall to wall echoes do not fit the walls ({misfit:.1f} sigma); are they square?"
        return fit._replace(adjustment=tied), ""

    def adjust(
        self, data: BatchData, state: AdjustmentState, basis: ParameterBasis, initial_scale: float
    ) -> AdjustmentResult:
        """Robust adjustment in double precision; ``initial_scale`` of the robust loss in metres."""
        with jax.enable_x64(True):
            return gnc_adjust(
                self.ring,
                data,
                basis,
                state,
                initial_scale=initial_scale,
                poses_free=self.poses_free,
                sigma=self.sigma,
            )

    def ring_at(self, state: AdjustmentState) -> Ring:
        """The ring with the parameters of a state."""
        change, count = self.basis.columns @ state.coordinates, self.ring.count
        return replace(
            self.ring,
            range_offset=np.asarray(self.ring.range_offset) + change[:count],
            speed_of_sound=float(self.ring.speed_of_sound * np.exp(change[count])),
            position=np.asarray(self.ring.position) + change[count + 1 :].reshape(-1, 2),
        )

    def parameter_covariance(self, found: AdjustmentResult) -> Float[np.ndarray, "parameters parameters"]:
        """Covariance of range offsets, log speed of sound and positions; 0 for those that are held."""
        with jax.enable_x64(True):
            cov = marginal_covariances(found.problem, found.solution.unknowns, poses_free=self.poses_free)
        columns = np.asarray(found.problem.basis)
        return columns @ cov.coordinates @ columns.T

    def nominal_residuals(self, fit: CalibrationFit) -> Float[np.ndarray, "scans echoes"]:
        """Residuals of the same echoes with ``self.ring``, landmarks and free poses adjusted to it, metres."""
        found = fit.adjustment
        with jax.enable_x64(True):
            problem = eqx.tree_at(lambda p: p.basis, found.problem, jnp.zeros_like(found.problem.basis))
            start = found.state._replace(coordinates=np.zeros_like(found.state.coordinates))
            fitted = solve_adjustment(problem, start.unknowns(), poses_free=self.poses_free)
            return np.asarray(kernels.residuals(problem, fitted.unknowns))

    @property
    def _registers(self) -> bool:
        """Whether poses come from scan registration. Single scans of sparse rings do not suffice for it."""
        return self.poses_free and self.window is None

    @property
    def _basis_without_mean(self) -> ParameterBasis:
        return self.basis.only(*(name for name in self.basis.names if name != "mean"))

    def _register(
        self, ring: Ring, logs: Sequence[Log], noise_scale: float, margin: float
    ) -> tuple[list[Log], list[Float[np.ndarray, "_ 3"]]]:
        """Logs with initial poses, and their odometry.

        A log whose scans form several clusters without known relative poses becomes several logs, each a world of its
        own.
        """
        registered, odometry = list(logs), [log.pose for log in logs]
        if self._registers:
            self.progress("registering the scans")
            registered, odometry = [], []
            for log in logs:
                measured = log.pose if np.isfinite(log.pose).any() else None
                clusters = register_scans(
                    list(local_models(ring, log)),
                    measured,
                    odometry_sd=self.odometry,
                    margin=margin,
                    noise_scale=noise_scale,
                    directions=measured_directions(ring, log),
                )
                sizes = [np.isfinite(poses[:, 0]).sum() for poses in clusters]
                large = [poses for poses, size in zip(clusters, sizes, strict=True) if size >= self.settings.min_scans]
                registered += [replace(log, pose=poses) for poses in large]
                odometry += [log.pose] * len(large)
        check_calibration_poses(registered)
        return registered, odometry

    def _fit_registered(self, ring: Ring, logs: list[Log], odometry: list[Float[np.ndarray, "_ 3"]]) -> CalibrationFit:
        """Maps and adjustments in turn, from initial poses and a ring close to the truth."""
        basis, settings = self._basis_without_mean, self.settings
        data = BatchData.from_logs(self.ring, logs, odometry, ProportionalNoise(self.odometry))
        coordinates = np.linalg.lstsq(basis.columns, _parameter_change(self.ring, ring), rcond=1e-9)[0]
        start = AdjustmentState(coordinates, data.poses, landmark_map_of([], tie_corners=False))

        def build_maps(state: AdjustmentState) -> list[GlobalMap]:
            current = ring if state is start else self.ring_at(state)
            posed = data.logs_with_poses(logs, state.poses)
            maps = [map_with_tentative_points(current, log, window=self.window) for log in posed]
            if not any(len(one) for one in maps):
                raise SonarError(
                    "calibration: no wall found; allowed are scans of a place with straight walls within range; "
                    f"walls {ExplainedShare(0.0, settings.min_explained).shortfall}"
                )
            return maps

        found = alternate(
            start,
            build_maps=build_maps,
            adjust=lambda state, initial_scale: self.adjust(data, state, basis, initial_scale),
            initial_scale=settings.initial_scale_registered if self.poses_free else settings.initial_scale,
            progress=self.progress,
        )
        if found is None:
            raise SonarError(
                f"calibration: walls {ExplainedShare(0.0, settings.min_explained).shortfall}; "
                "is it the right ring, are poses and units right?"
            )
        return CalibrationFit(logs, data, found.maps, found.adjustment)

    def _is_better(self, fit: CalibrationFit, best: CalibrationFit) -> bool:
        """Whether more echoes are explained, and not because the estimated noise is larger."""
        same_noise = fit.adjustment.sigma < self.settings.max_sigma_growth * best.adjustment.sigma
        return fit.explained_count > best.explained_count and same_noise


def _parameter_change(ring: Ring, other: Ring) -> Float[np.ndarray, " parameters"]:
    """Parameters of another ring relative to a ring: offsets, log speed of sound, positions."""
    return np.concatenate(
        [
            np.asarray(other.range_offset) - np.asarray(ring.range_offset),
            [np.log(float(other.speed_of_sound) / float(ring.speed_of_sound))],
            (np.asarray(other.position) - np.asarray(ring.position)).ravel(),
        ]
    )


def check_calibration_poses(logs: Sequence[Log], *, min_scans: int = SETTINGS.min_scans) -> None:
    """Raise a SonarError if too few scans have a pose."""
    if not logs:
        raise SonarError(
            f"calibration: fewer than {min_scans} scans could be registered; allowed are scans that observe the same "
            "walls in two directions, or odometry"
        )
    for log in logs:
        count = int(np.isfinite(log.pose).all(axis=1).sum())
        if count < min_scans:
            raise SonarError(
                f"calibration: {count} of {len(log)} scans have a pose; allowed are {min_scans} or more in every log, "
                "or poses to be estimated (--poses estimate)"
            )
