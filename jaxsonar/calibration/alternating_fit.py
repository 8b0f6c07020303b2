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
from jaxsonar.estimation.alternation import AGAIN, alternated
from jaxsonar.estimation.landmark_map import seen_world, surroundings
from jaxsonar.estimation.odometry_noise import Share
from jaxsonar.estimation.robust_adjustment import Data, Settled, State, settle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.registration.sequential import place_parts
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_parameters import RingModes

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


class Fitted(NamedTuple):
    """A ring that fits scans, their poses and a map."""

    logs: list[Log]
    """One for every world."""
    data: Data
    worlds: list[GlobalMap]
    settled: Settled

    @property
    def used(self) -> int:
        """Echoes that are explained."""
        return int(self.settled.used.sum())


@dataclass(frozen=True)
class Plan:
    """What is asked for."""

    ring: Ring
    """Where the modes begin."""
    modes: RingModes
    estimate: bool
    """Whether poses are estimated; those of the logs are odometry then."""
    odometry: float
    """Share of the way and of the turn that it is wrong by."""
    sigma: float | None
    """Noise of the ranges, metres."""
    window: float | None
    """Metres of path for a local model."""
    say: Callable[[str], None]

    @property
    def held(self) -> RingModes:
        """The modes without the mean offset."""
        return self.modes.only(*(name for name in self.modes.names if name != "mean"))

    def fitted(self, near: Ring, logs: Sequence[Log]) -> Fitted:
        """Ring, poses and map that fit, the mean offset held; poses, where they are estimated, are found first.

        Args:
            near: a ring that is nearer to the truth than the one that the modes begin at.
            logs: as they came.
        """
        best = None
        for blur, margin in _PLACINGS if self.estimate and self.window is None else _PLACINGS[:1]:
            fit = self._fitted(near, *self._placed(near, logs, blur, margin))
            if best is None or _better(fit, best):
                best, near = fit, moved_ring(self.ring, self.modes, fit.settled.state)
            if len(best.logs) == len(logs) and best.data.scans == sum(len(log) for log in logs):
                break
        assert best is not None
        return best

    def _fitted(self, near: Ring, logs: list[Log], measured: list[Float[np.ndarray, "_ 3"]]) -> Fitted:
        """Ring, poses and reflectors settle around the map; the map is made anew with that ring, and so on."""
        data = Data.of(self.ring, logs, measured, Share(self.odometry))
        start = State(_coordinates(self.held, _change(self.ring, near)), data.poses, surroundings([], tied=False))

        def mapped(state: State) -> list[GlobalMap]:
            ring = near if state is start else moved_ring(self.ring, self.held, state)
            worlds = [seen_world(ring, one, window=self.window) for one in data.placed(logs, state.poses)]
            if not any(len(world) for world in worlds):
                raise SonarError(
                    "calibration: no wall found; allowed are scans of a place with straight walls in reach"
                )
            return worlds

        found = alternated(
            start,
            mapped=mapped,
            settle=lambda state, widest: self.settle(data, state, self.held, widest),
            widest=_WIDE_PLACED if self.estimate else _WIDE,
            say=self.say,
        )
        if found is None:
            raise SonarError("calibration: no echo fits the walls; is it the right ring, are poses and units right?")
        return Fitted(logs, data, *found)

    def settle(self, data: Data, state: State, modes: RingModes, widest: float) -> Settled:
        """In double precision."""
        with jax.enable_x64(True):
            return settle(self.ring, data, modes, state, widest=widest, poses_free=self.estimate, sigma=self.sigma)

    def _placed(
        self, ring: Ring, logs: Sequence[Log], blur: float, margin: float
    ) -> tuple[list[Log], list[Float[np.ndarray, "_ 3"]]]:
        """Logs with poses from their local models, and their odometry; as they came where poses are given.

        What cannot be laid together becomes several logs, each with a world of its own. Where single scans are sparse,
        odometry alone must do.
        """
        placed, measured = list(logs), [log.pose for log in logs]
        if self.estimate and self.window is None:
            self.say("placing the scans")
            placed, measured = [], []
            for log in logs:
                odometry = log.pose if np.isfinite(log.pose).any() else None
                models = list(local_models(ring, log))
                parts = place_parts(models, odometry, slip=self.odometry, margin=margin, blur=blur)
                enough = [part for part in parts if np.isfinite(part[:, 0]).sum() >= LEAST_SCANS]
                placed += [replace(log, pose=part) for part in enough]
                measured += [log.pose] * len(enough)
        check_poses(placed)
        return placed, measured

    def pinned(self, alone: Fitted) -> tuple[Fitted, str]:
        """The same with the mean offset free, where wall to wall echoes pin it; or as it is, and why."""
        around = surroundings(alone.worlds, tied=True)
        if not (np.asarray(around.candidates.reflection.kind) == kernels.SECOND).any():
            return (
                alone,
                "no two walls of the map end at a common right-angled corner",
            )
        state = alone.settled.state._replace(around=around)
        tied = self.settle(alone.data, state, self.modes, 2 * AGAIN)
        second = tied.used & (np.asarray(tied.problem.heard.reflection.kind) == kernels.SECOND)
        count = int(second.sum())
        sd = float(np.sqrt(covariance(tied)[: self.ring.count, : self.ring.count].mean()))
        if count < _LEAST_SECOND or sd > PINNED:
            return alone, f"{count} wall to wall echoes pin it to {1e3 * sd:.1f} mm only; needed is {1e3 * PINNED:g} mm"
        misfit = float(np.sqrt(np.mean(tied.residual[second] ** 2))) / tied.sigma
        if misfit > _MISFIT or tied.used.sum() < _KEEPS * alone.used:
            return alone, f"wall to wall echoes do not fit the walls ({misfit:.1f} sigma); are they square?"
        return alone._replace(settled=tied), ""

    def before(self, fit: Fitted) -> Float[np.ndarray, "scans echoes"]:
        """Residuals of the same echoes with the ring as it was, reflectors and free poses fitted to it, metres."""
        found = fit.settled
        nothing = np.zeros(found.problem.modes.shape)
        with jax.enable_x64(True):
            problem = eqx.tree_at(lambda p: p.modes, found.problem, jnp.asarray(nothing))
            start = kernels.Unknowns(
                jnp.asarray(nothing[0]),
                jnp.asarray(found.state.poses),
                jnp.asarray(found.state.around.scene.parameters),
            )
            fitted = kernels.adjust(problem, start, poses_free=self.estimate)
            return np.asarray(kernels.residuals(problem, fitted.unknowns))


def _better(fit: Fitted, best: Fitted) -> bool:
    """Whether more echoes are explained, and not by taking more for noise."""
    return fit.used > best.used and fit.settled.sigma < _NOISIER * best.settled.sigma


def covariance(found: Settled) -> Float[np.ndarray, "ring ring"]:
    """Of offsets, log speed and positions; 0 for what was held."""
    columns = np.asarray(found.problem.modes)
    size = columns.shape[1]
    return columns @ np.asarray(found.adjusted.covariance)[:size, :size] @ columns.T


def moved_ring(ring: Ring, modes: RingModes, state: State) -> Ring:
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


def _coordinates(modes: RingModes, change: Float[np.ndarray, " ring"]) -> Float[np.ndarray, " modes"]:
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
