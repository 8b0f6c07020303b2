"""Calibration of a ring from ordinary scans of a room that nobody measured, by gradients through the echo model."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float

from jaxsonar import kernels
from jaxsonar.calibration.alternating_fit import (
    CalibrationFit,
    CalibrationProblem,
    check_poses,
    parameter_covariance,
    ring_of,
)
from jaxsonar.calibration.autofocus import autofocus_ring
from jaxsonar.calibration.beam_headings import estimate_headings
from jaxsonar.detection.settings import check_sigma
from jaxsonar.estimation.robust_adjustment import AdjustmentResult
from jaxsonar.geometry.se2 import unit
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.build_map import build_map
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.sliding_windows import check_window
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring import speed_of_sound as speed_of_sound
from jaxsonar.sensors.ring_parameters import (
    DEFAULT_PARAMETERS,
    PARAMETERS,
    PRIOR,
    ParameterBasis,
    check_parameters,
    check_speed_of_sound,
    parameter_basis,
)

POSES = ("trust", "estimate")
"""What is made of a log's poses: they are right, or a start and odometry between scans."""
ODOMETRY = 0.02
"""Share of the way and of the turn that odometry is wrong by."""
_MOST_SHIFT = 0.06  # of the speed of sound; beyond, the ranges are no half path lengths of this ring
_MOST_OFFSET = 0.06  # m; beyond, scans were laid together wrongly
_LEAST_EXPLAINED = 0.15  # of the echoes; below, there is no map to calibrate with
_UNKNOWN = 0.7  # of what was expected; a parameter that stays as uncertain was not observed


@dataclass(frozen=True, eq=False)
class Calibration:
    """A ring as its own echoes describe it, and how well they do."""

    ring: Ring
    """The calibrated ring."""
    nominal: Ring
    """The ring to start from."""
    free: tuple[str, ...]
    """What was estimated."""
    held: dict[str, str]
    """What was not, and why."""
    covariance: Float[np.ndarray, "ring ring"]
    """Of range offsets (sensors, metres), log speed of sound, positions (sensors x 2, metres); 0 where held."""
    heading_sd: Float[np.ndarray, " sensors"]
    """Standard deviations of the headings, radians; 0 where held."""
    sigma: float
    """Noise of the ranges as reported, metres."""
    residuals: Float[np.ndarray, " echoes"]
    """Reported minus expected range of the echoes that reflectors explain, metres."""
    residuals_before: Float[np.ndarray, " echoes"]
    """The same echoes with the ring to start from (at the measured temperature, if there is one), walls and free poses
    fitted to it as well as it can be."""
    echoes: int
    """Echoes that came."""
    scans: int
    """Scans that were used."""
    poses: tuple[Float[np.ndarray, "_ 3"], ...]
    """world_from_robot of the scans of every world, given or estimated; NaN where a scan was not used. A log is a
    world; where poses were estimated, so is every part of a log that could not be laid on the others."""
    maps: tuple[GlobalMap, ...]
    """The map of every world with the calibrated ring."""
    maps_before: tuple[GlobalMap, ...]
    """The same with the nominal ring."""
    problem: kernels.LeastSquaresProblem
    """The least squares that the result solves, in double precision: echoes, reflectors, priors. With ``unknowns`` it
    is what ``kernels.residuals`` and ``kernels.cost`` take, for a loss of one's own on top."""
    unknowns: kernels.Unknowns
    """Its solution."""

    @property
    def range_offset_sd(self) -> Float[np.ndarray, " sensors"]:
        """Standard deviations of the range offsets relative to their mean, metres; 0 where they are held."""
        count = self.ring.count
        relative = np.eye(count) - 1 / count
        own = relative @ self.covariance[:count, :count] @ relative
        return np.sqrt(np.maximum(np.diag(own), 0))

    @property
    def mean_offset_sd(self) -> float:
        """Standard deviation of the mean range offset, metres; 0 where it is held."""
        count = self.ring.count
        return float(np.sqrt(max(self.covariance[:count, :count].mean(), 0)))

    @property
    def speed_of_sound_sd(self) -> float:
        """Standard deviation of the speed of sound, metres per second."""
        return float(np.sqrt(self.covariance[self.ring.count, self.ring.count]) * self.ring.speed_of_sound)

    @property
    def position_sd(self) -> Float[np.ndarray, "sensors 2"]:
        """Standard deviations of the positions (x, y), metres."""
        return np.sqrt(np.diag(self.covariance)[self.ring.count + 1 :]).reshape(-1, 2)

    @property
    def radius(self) -> tuple[float, float]:
        """Mean distance of the sensors from their middle, and its standard deviation, metres."""
        outward = np.asarray(self.ring.position) - np.mean(self.ring.position, axis=0)
        far = np.linalg.norm(outward, axis=1)
        weight = (outward / np.where(far > 0, far, 1)[:, None]).ravel() / len(far)
        places = self.covariance[self.ring.count + 1 :, self.ring.count + 1 :]
        return float(far.mean()), float(np.sqrt(max(weight @ places @ weight, 0)))

    @property
    def effective_correction(self) -> tuple[Float[np.ndarray, " sensors"], Float[np.ndarray, " sensors"]]:
        """Range correction of every sensor in its own direction, and its standard deviation, metres.

        The change of its range offset minus that of its place along its heading: a sensor that sits farther out reports
        as much less. Where both are free only this is well known.
        """
        count = self.ring.count
        ahead = unit(np.asarray(self.ring.heading))
        moved = np.asarray(self.ring.position) - np.asarray(self.nominal.position)
        change = np.asarray(self.ring.range_offset) - np.asarray(self.nominal.range_offset) - (ahead * moved).sum(-1)
        along = np.zeros((count, len(self.covariance)))
        sensor = np.arange(count)
        along[sensor, sensor] = 1
        along[sensor, count + 1 + 2 * sensor] = -ahead[:, 0]
        along[sensor, count + 2 + 2 * sensor] = -ahead[:, 1]
        return change, np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", along, self.covariance, along), 0))

    def correlations(self, *, least: float = 0.7, most: int = 12) -> list[tuple[str, str, float]]:
        """Pairs of parameters that the echoes hardly tell apart, the closest first: two names and their correlation.

        Offsets are meant relative to their mean, which is a parameter of its own.
        """
        count, size = self.ring.count, len(self.covariance)
        turn = np.eye(size)
        turn[:count, :count] -= 1 / count
        turn = np.vstack([turn, np.where(np.arange(size) < count, 1 / count, 0)])
        covariance = turn @ self.covariance @ turn.T
        places = (f"{axis} {k}" for k in range(count) for axis in "xy")
        names = [*(f"offset {k}" for k in range(count)), "speed", *places, "mean offset"]
        sd = np.sqrt(np.maximum(np.diag(covariance), 0))
        both = np.outer(sd, sd) * (np.outer(sd, sd) > 1e-12 * sd.max(initial=0) ** 2)
        value = np.where(both > 0, covariance / np.where(both > 0, both, 1), 0)
        a, b = np.triu_indices(len(sd), k=1)
        order = np.argsort(-np.abs(value[a, b]), kind="stable")[:most]
        pairs = [(names[i], names[j], float(value[i, j])) for i, j in zip(a[order], b[order], strict=True)]
        return [pair for pair in pairs if abs(pair[2]) >= least]

    def summary(self) -> tuple[str, ...]:
        """The result in a few plain lines."""
        share = 100 * len(self.residuals) / max(self.echoes, 1)
        lines = [
            f"{self.scans} scans, {len(self.residuals)} of {self.echoes} echoes explained ({share:.0f} %); "
            f"residual RMS {1e3 * self.rms_before:.2f} mm before, {1e3 * self.rms:.2f} mm after"
        ]
        if "offset" in self.free:
            change = np.asarray(self.ring.range_offset) - np.asarray(self.nominal.range_offset)
            lines.append(
                f"range offsets changed by {1e3 * np.sqrt(np.mean(change**2)):.2f} mm RMS, known to "
                f"{1e3 * np.sqrt(np.mean(self.range_offset_sd**2)):.2f} mm relative to their mean"
            )
        if "speed" in self.free:
            lines.append(f"speed of sound {float(self.ring.speed_of_sound):.2f} m/s ± {self.speed_of_sound_sd:.2f}")
        if "radius" in self.free:
            radius, sd = self.radius
            lines.append(f"radius {1e3 * radius:.1f} mm ± {1e3 * sd:.1f}")
        lines += [f"held: {name.replace('_', ' ')}: {why}" for name, why in self.held.items() if "not asked" not in why]
        return tuple(lines)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, metres."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def rms_before(self) -> float:
        """Root mean square of the residuals with the nominal ring, metres."""
        return float(np.sqrt(np.mean(self.residuals_before**2)))


def calibrate(
    ring: Ring,
    log: Log | Sequence[Log],
    *,
    free: Sequence[str] = DEFAULT_PARAMETERS,
    poses: str = "trust",
    odometry: float = ODOMETRY,
    temperature: float | None = None,
    sigma: float | None = None,
    window: float | None = None,
    on_step: Callable[[str], None] | None = None,
) -> Calibration:
    """Find out how a ring really is: sharpen the accumulator, then least squares on the ranges of its echoes.

    Walls and corners of the room are estimated along. Every log is a world of its own.

    Args:
        ring: as it should be.
        log: scans, 17 or more of them from different places.
        free: what is estimated, of "offset", "speed", "position", "radius", "heading"; the rest is held.
        poses: "trust" those of the log, or "estimate" them; then the log's poses are odometry, where it has any.
        odometry: share of the way and of the turn between scans that odometry is wrong by (one standard deviation).
        temperature: of the air, deg C, if it was measured: the speed of sound is expected to be that of this air.
        sigma: standard deviation of the ranges, metres; estimated from the residuals if left out.
        window: metres of path gathered into one local model for the map, as ``build_map``, for sparse rings.
        on_step: told what is being done.

    Raises:
        SonarError: an unknown choice, a speed of sound that no air has, logs without poses that are to be trusted, too
            few walls or echoes that fit, a result that no ring of this kind can have.
    """
    logs = [log] if isinstance(log, Log) else list(log)
    say = on_step or (lambda text: None)
    _check(ring, logs, free, poses, odometry, temperature, sigma, window)
    began, speed_sd = ring, PRIOR.speed_sd
    if temperature is not None:
        began, speed_sd = replace(ring, speed_of_sound=speed_of_sound(temperature)), PRIOR.measured_speed_sd
    estimate = poses == "estimate"
    modes = parameter_basis(began, free, poses_free=estimate, speed_sd=speed_sd)
    if not estimate:
        check_poses(logs)
    plan = CalibrationProblem(began, modes, estimate, odometry, sigma, window, say)

    # 1. Sharpen: the smooth accumulator brings a ring that is far off near enough for echoes to find their walls.
    near = began
    if "offset" in free and window is None:
        say("sharpening the accumulator")
        near = autofocus_ring(began, max(logs, key=len), poses=not estimate, speed="speed" in free and not estimate)
    # 2. Least squares on the ranges: ring, walls, corners and free poses together, association renewed in between.
    fit = plan.fit(near, logs)
    # 3. Wall to wall echoes tell how far off the walls really are, and so the mean offset, where there are any.
    fit, mean = plan.fit_mean_offset(fit) if "offset" in free else (fit, "")
    found = fit.adjustment
    _check_result(fit, modes)
    now, heading_sd = ring_of(began, modes, found.state), np.zeros(ring.count)
    # 4. What was heard at all shows where the sensors look; ranges do not.
    if "heading" in free:
        say("beam centres")
        with jax.enable_x64(True):
            now, heading_sd = estimate_headings(now, fit.data, found)
    say("maps before and after")
    final = fit.data.logs_with_poses(fit.logs, found.state.poses)
    return Calibration(
        ring=now,
        nominal=ring,
        free=tuple(free),
        held=_held(free, mean, speed_sd, temperature, found),
        covariance=parameter_covariance(found),
        heading_sd=heading_sd,
        sigma=found.sigma,
        residuals=found.residual[found.used],
        residuals_before=plan.nominal_residuals(fit)[found.used],
        echoes=fit.data.echo_count,
        scans=fit.data.scan_count,
        poses=tuple(one.pose for one in final),
        maps=tuple(build_map(now, one, window=window) for one in final),
        maps_before=tuple(build_map(ring, one, window=window) for one in fit.logs),
        problem=found.problem,
        unknowns=found.solution.unknowns,
    )


def _held(
    free: Sequence[str], mean: str, speed_sd: float, temperature: float | None, found: AdjustmentResult
) -> dict[str, str]:
    """What was not estimated, and why."""
    held = {name: "not asked for" for name in PARAMETERS if name not in free}
    if "heading" in held:
        held["heading"] = "not asked for; ranges do not depend on it"
    if mean:
        held["mean_offset"] = mean
    if "speed" in free:
        known = parameter_covariance(found)
        sensors = (len(known) - 1) // 3
        sd = float(np.sqrt(known[sensors, sensors]))
        source = "the temperature" if temperature is not None else "what is expected of air"
        if sd > _UNKNOWN * speed_sd:
            held["speed"] = f"these scans do not show it: it stays at {source}, {100 * speed_sd:.2g} % (one sigma)"
    return held


def _check(
    ring: Ring,
    logs: Sequence[Log],
    free: Sequence[str],
    poses: str,
    odometry: float,
    temperature: float | None,
    sigma: float | None,
    window: float | None,
) -> None:
    check_parameters(free)
    check_sigma(sigma)
    check_window(window)
    if poses not in POSES:
        raise SonarError(f"poses {poses!r}; allowed is {' or '.join(POSES)}")
    if not logs:
        raise SonarError("calibration: no log came; allowed is one or more")
    if not 1e-4 <= odometry <= 1:  # False for NaN
        raise SonarError(f"odometry {odometry:g}; allowed is 0.0001 to 1, the share of the way that it is wrong by")
    if temperature is not None and not -60 <= temperature <= 85:
        raise SonarError(f"temperature {temperature:g} deg C; allowed is -60 to 85")
    check_speed_of_sound(ring)


def _check_result(fit: CalibrationFit, modes: ParameterBasis) -> None:
    """Raise a SonarError for a result that is none."""
    share = fit.explained_count / max(fit.data.echo_count, 1)
    if share < _LEAST_EXPLAINED:
        raise SonarError(
            f"calibration: walls and corners explain {100 * share:.0f} % of the {fit.data.echo_count} echoes; needed are "
            f"{100 * _LEAST_EXPLAINED:g} %: is it the right ring, are poses and units right?"
        )
    sensors = (len(modes.columns) - 1) // 3
    shift = float((modes.columns @ fit.adjustment.state.coordinates)[sensors])
    offset = (modes.columns @ fit.adjustment.state.coordinates)[:sensors]
    worst = int(np.argmax(np.abs(offset)))
    if abs(offset[worst]) > _MOST_OFFSET:
        raise SonarError(
            f"calibration: the range offset of sensor {worst} went off by {1e3 * offset[worst]:.0f} mm; allowed are "
            f"{1e3 * _MOST_OFFSET:g} mm: these scans do not show the ring (try more of them, odometry or known poses)"
        )
    if abs(shift) > _MOST_SHIFT:
        raise SonarError(
            f"calibration: the speed of sound went off by {100 * shift:.1f} %; allowed are {100 * _MOST_SHIFT:g} %: "
            "are the ranges half path lengths at 343.2 m/s, in metres?"
        )
