"""The inner loop of a calibration: place the scans, build the map, let everything settle, and again while it helps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxsonar import kernels
from jaxsonar.detection.extract import local_models
from jaxsonar.estimation.alternation import AGAIN, alternate
from jaxsonar.estimation.batch_data import BatchData
from jaxsonar.estimation.landmark_map import map_with_tentative_points, landmark_map_of
from jaxsonar.estimation.odometry_noise import ProportionalNoise
from jaxsonar.estimation.robust_adjustment import AdjustmentResult, AdjustmentState, gnc_adjust
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.registration.sequential import register_scans
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_parameters import ParameterBasis

PINNED = 0.001
"""Metres; the mean range offset is estimated where its standard deviation is at most this."""
LEAST_SCANS = 3
"""Scans that must be laid on one another to tell anything."""
_WIDE, _WIDE_PLACED = 0.04, 0.08  # m; scale of the first association: poses given, poses found
_PLACINGS = ((1.0, 4.0), (0.2, 2.0), (0.2, 1.0))  # blur and margin (nats), until all scans are placed: surely at first
_NOISIER = 1.15  # a fit with so much more noise has laid scans together that do not belong together
_LEAST_SECOND = 10  # wall to wall echoes
_MISFIT = 1.5  # sigma; of wall to wall echoes where walls do meet as the map says
_KEEPS = 0.97  # of the echoes that were explained with corners of their own


class CalibrationFit(NamedTuple):
    """A ring that fits scans, their poses and a map."""

    logs: list[Log]
    """One for every world."""
    data: BatchData
    maps: list[GlobalMap]
    adjustment: AdjustmentResult

    @property
    def explained_count(self) -> int:
        """Echoes that are explained."""
        return int(self.adjustment.used.sum())


@dataclass(frozen=True)
class CalibrationProblem:
    """What is asked for."""

    ring: Ring
    """Where the modes begin."""
    basis: ParameterBasis
    poses_free: bool
    """Whether poses are estimated; those of the logs are odometry then."""
    odometry: float
    """Share of the way and of the turn that it is wrong by."""
    sigma: float | None
    """Noise of the ranges, metres."""
    window: float | None
    """Metres of path for a local model."""
    progress: Callable[[str], None]

    @property
    def basis_without_mean(self) -> ParameterBasis:
        """The modes without the mean offset."""
        return self.basis.only(*(name for name in self.basis.names if name != "mean"))

    def fit(self, near: Ring, logs: Sequence[Log]) -> CalibrationFit:
        """Ring, poses and map that fit, the mean offset held; poses, where they are estimated, are found first.

        Args:
            near: a ring that is nearer to the truth than the one that the modes begin at.
            logs: as they came.
        """
        best = None
        for blur, margin in _PLACINGS if self.poses_free and self.window is None else _PLACINGS[:1]:
            fit = self._fit_registered(near, *self._register(near, logs, blur, margin))
            if best is None or _better(fit, best):
                best, near = fit, ring_of(self.ring, self.basis, fit.adjustment.state)
            if len(best.logs) == len(logs) and best.data.scan_count == sum(len(log) for log in logs):
                break
        assert best is not None
        return best

    def _fit_registered(self, near: Ring, logs: list[Log], measured: list[Float[np.ndarray, "_ 3"]]) -> CalibrationFit:
        """Ring, poses and reflectors settle around the map; the map is made anew with that ring, and so on."""
        data = BatchData.from_logs(self.ring, logs, measured, ProportionalNoise(self.odometry))
        start = AdjustmentState(_coordinates(self.basis_without_mean, _change(self.ring, near)), data.poses, landmark_map_of([], tie_corners=False))

        def mapped(state: AdjustmentState) -> list[GlobalMap]:
            ring = near if state is start else ring_of(self.ring, self.basis_without_mean, state)
            worlds = [map_with_tentative_points(ring, one, window=self.window) for one in data.logs_with_poses(logs, state.poses)]
            if not any(len(world) for world in worlds):
                raise SonarError(
                    "calibration: no wall found; allowed are scans of a place with straight walls in reach"
                )
            return worlds

        found = alternate(
            start,
            build_maps=mapped,
            adjust=lambda state, widest: self.adjust(data, state, self.basis_without_mean, widest),
            initial_scale=_WIDE_PLACED if self.poses_free else _WIDE,
            progress=self.progress,
        )
        if found is None:
            raise SonarError("calibration: no echo fits the walls; is it the right ring, are poses and units right?")
        return CalibrationFit(logs, data, *found)

    def adjust(self, data: BatchData, state: AdjustmentState, modes: ParameterBasis, widest: float) -> AdjustmentResult:
        """In double precision."""
        with jax.enable_x64(True):
            return gnc_adjust(self.ring, data, modes, state, initial_scale=widest, poses_free=self.poses_free, sigma=self.sigma)

    def _register(
        self, ring: Ring, logs: Sequence[Log], blur: float, margin: float
    ) -> tuple[list[Log], list[Float[np.ndarray, "_ 3"]]]:
        """Logs with poses from their local models, and their odometry; as they came where poses are given.

        What cannot be laid together becomes several logs, each with a world of its own. Where single scans are sparse,
        odometry alone must do.
        """
        placed, measured = list(logs), [log.pose for log in logs]
        if self.poses_free and self.window is None:
            self.progress("placing the scans")
            placed, measured = [], []
            for log in logs:
                odometry = log.pose if np.isfinite(log.pose).any() else None
                models = list(local_models(ring, log))
                parts = register_scans(models, odometry, odometry_sd=self.odometry, margin=margin, noise_scale=blur)
                enough = [part for part in parts if np.isfinite(part[:, 0]).sum() >= LEAST_SCANS]
                placed += [replace(log, pose=part) for part in enough]
                measured += [log.pose] * len(enough)
        check_poses(placed)
        return placed, measured

    def fit_mean_offset(self, alone: CalibrationFit) -> tuple[CalibrationFit, str]:
        """The same with the mean offset free, where wall to wall echoes pin it; or as it is, and why."""
        around = landmark_map_of(alone.maps, tie_corners=True)
        if not (np.asarray(around.candidates.reflection.kind) == kernels.SECOND_ORDER).any():
            return (
                alone,
                "no two walls of the map end at a common right-angled corner",
            )
        state = alone.adjustment.state._replace(landmark_map=around)
        tied = self.adjust(alone.data, state, self.basis, 2 * AGAIN)
        second = tied.used & (np.asarray(tied.problem.factors.reflection.kind) == kernels.SECOND_ORDER)
        count = int(second.sum())
        sd = float(np.sqrt(parameter_covariance(tied)[: self.ring.count, : self.ring.count].mean()))
        if count < _LEAST_SECOND or sd > PINNED:
            return alone, f"{count} wall to wall echoes pin it to {1e3 * sd:.1f} mm only; needed is {1e3 * PINNED:g} mm"
        misfit = float(np.sqrt(np.mean(tied.residual[second] ** 2))) / tied.sigma
        if misfit > _MISFIT or tied.used.sum() < _KEEPS * alone.explained_count:
            return alone, f"wall to wall echoes do not fit the walls ({misfit:.1f} sigma); are they square?"
        return alone._replace(adjustment=tied), ""

    def nominal_residuals(self, fit: CalibrationFit) -> Float[np.ndarray, "scans echoes"]:
        """Residuals of the same echoes with the ring as it was, reflectors and free poses fitted to it, metres."""
        found = fit.adjustment
        nothing = np.zeros(found.problem.basis.shape)
        with jax.enable_x64(True):
            problem = eqx.tree_at(lambda p: p.modes, found.problem, jnp.asarray(nothing))
            start = kernels.Unknowns(
                jnp.asarray(nothing[0]),
                jnp.asarray(found.state.poses),
                jnp.asarray(found.state.landmark_map.landmarks.parameters),
            )
            fitted = kernels.adjust(problem, start, poses_free=self.poses_free)
            return np.asarray(kernels.residuals(problem, fitted.unknowns))


def _better(fit: CalibrationFit, best: CalibrationFit) -> bool:
    """Whether more echoes are explained, and not by taking more for noise."""
    return fit.explained_count > best.explained_count and fit.adjustment.sigma < _NOISIER * best.adjustment.sigma


def parameter_covariance(found: AdjustmentResult) -> Float[np.ndarray, "ring ring"]:
    """Of offsets, log speed and positions; 0 for what was held."""
    columns = np.asarray(found.problem.basis)
    size = columns.shape[1]
    return columns @ np.asarray(found.solution.covariance)[:size, :size] @ columns.T


def ring_of(ring: Ring, modes: ParameterBasis, state: AdjustmentState) -> Ring:
    """The ring after its change along the modes."""
    change, count = modes.columns @ state.coordinates, ring.count
    return replace(
        ring,
        range_offset=np.asarray(ring.range_offset) + change[:count],
        speed_of_sound=float(ring.speed_of_sound * np.exp(change[count])),
        position=np.asarray(ring.position) + change[count + 1 :].reshape(-1, 2),
    )


def _change(ring: Ring, other: Ring) -> Float[np.ndarray, " ring"]:
    """From one ring to another one: offsets, log speed, positions."""
    return np.concatenate(
        [
            np.asarray(other.range_offset) - np.asarray(ring.range_offset),
            [np.log(float(other.speed_of_sound) / float(ring.speed_of_sound))],
            (np.asarray(other.position) - np.asarray(ring.position)).ravel(),
        ]
    )


def _coordinates(modes: ParameterBasis, change: Float[np.ndarray, " ring"]) -> Float[np.ndarray, " modes"]:
    return np.linalg.lstsq(modes.columns, change, rcond=1e-9)[0]


def check_poses(logs: Sequence[Log]) -> None:
    """Raise a SonarError where too few scans have a pose."""
    if not logs:
        raise SonarError(
            f"calibration: no {LEAST_SCANS} scans could be laid on one another; allowed are scans that see the same "
            "walls in two directions, or odometry"
        )
    for log in logs:
        count = int(np.isfinite(log.pose).all(axis=1).sum())
        if count < LEAST_SCANS:
            raise SonarError(
                f"calibration: {count} of {len(log)} scans have a pose; allowed are {LEAST_SCANS} or more in every "
                "log, or poses to be estimated (--poses estimate)"
            )
