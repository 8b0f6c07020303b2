"""Calibration of a ring whose single scans carry no line, from the run itself.

The scale of the ranges follows from closing tracks (``closing_tracks``), the range offsets of sensors relative to each
other from walls that they share (``wall_fit``), noise and detection probability from the residuals (``echo_model``).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar.calibration.calibration_result import Calibration, RunResiduals
from jaxsonar.calibration.closing_tracks import ScaleEstimate, estimate_scale
from jaxsonar.calibration.echo_model import measure_echo_model
from jaxsonar.calibration.settings import SPARSE_SETTINGS as SETTINGS
from jaxsonar.calibration.wall_echoes import WallEchoes, assign_echoes
from jaxsonar.calibration.wall_fit import OffsetFit, fit_offsets, shared_wall_sensors
from jaxsonar.estimation.explained_share import ExplainedShare
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.messages import REFERENCE_SPEED_OF_SOUND
from jaxsonar.mapping.build_map import build_map
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.registration.wall_readings import distance_travelled, fresh_readings
from jaxsonar.scans.measured_paths import echoes_of_long_wall
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.sliding_windows import SETTINGS as WINDOWS
from jaxsonar.scans.sliding_windows import automatic_window
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class _Scale:
    """Logarithm of the speed of sound relative to the prior ring."""

    log_speed: float
    sd: float
    held: str = ""
    """Why it stays at the prior; empty if it was estimated."""
    contradiction: str = ""
    """Why the measured temperature is no prior; empty if it is one, or if none was measured."""


def is_sparse(ring: Ring, logs: Sequence[Log]) -> bool:
    """Whether a long wall is received by too few paths of a scan for a line, in the log of the usual scan."""
    received = [np.full(len(log), echoes_of_long_wall(ring, log)) for log in logs]
    usual = np.concatenate([np.zeros(0), *received])
    return len(usual) > 0 and float(np.median(usual)) < WINDOWS.sparse_echoes


def calibrate_sparse_ring(
    ring: Ring,
    prior_ring: Ring,
    logs: Sequence[Log],
    *,
    free: Sequence[str],
    held: dict[str, str],
    poses_exact: bool,
    measured_speed_sd: float | None,
    sigma: float | None,
    window: float | None,
    progress: Callable[[str], None],
) -> Calibration:
    """Estimate range scale and relative range offsets of a ring, with noise and detection probability.

    Args:
        ring: the nominal ring.
        prior_ring: the ring with the speed of sound of the measured temperature, if there is one.
        logs: scans with poses, as estimators take them.
        free: "offset" and "speed" as far as they are estimated.
        held: parameters that were not asked for, and why.
        poses_exact: whether the poses of a log are exact everywhere; otherwise only over short stretches.
        measured_speed_sd: standard deviation of the speed of sound of ``prior_ring``, relative, if it was measured.
        sigma: scale of the range noise, metres, in the fits and in the maps; None: estimated, and the default of maps.
        window: length of the windows of the maps, metres; None: chosen for each log (``automatic_window``).
        progress: called with a description of each step.

    Raises:
        SonarError: too few scans with a pose, walls explain too few echoes, or a result outside the plausible range.
    """
    _check_poses(logs)
    fresh = [fresh_readings(ring, log) for log in logs]

    def maps_with(some: Ring) -> tuple[GlobalMap, ...]:
        lengths = [window or automatic_window(ring, log) or WINDOWS.sparse_length for log in logs]
        return tuple(
            build_map(some, log, window=length, sigma=sigma) for log, length in zip(logs, lengths, strict=True)
        )

    # 1. The scale, from sensors that approach static targets.
    progress("closing tracks")
    estimate = estimate_scale(prior_ring, fresh)
    scale = _posterior(estimate, free, measured_speed_sd)
    scaled = replace(prior_ring, speed_of_sound=float(prior_ring.speed_of_sound * np.exp(scale.log_speed)))
    # 2. Maps with this scale, and the echoes that their walls explain.
    progress("walls")
    echoes = _echoes_of_maps(prior_ring, scaled, fresh, maps_with(scaled), np.inf if poses_exact else SETTINGS.stretch)
    _check_explained(echoes, fresh)
    # 3. The offsets of sensors relative to each other, at this scale.
    progress("range offsets")
    fit = fit_offsets(echoes, log_speed=scale.log_speed, log_speed_sd=scale.sd, free="offset" in free, sigma=sigma)
    without = fit_offsets(echoes, log_speed=0.0, free=False, sigma=sigma)
    calibrated = replace(scaled, range_offset=np.asarray(prior_ring.range_offset) + fit.offset)
    _check_result(prior_ring, calibrated)
    # 4. Maps before and after; noise and detection probability.
    progress("maps before and after")
    maps = maps_with(calibrated)
    model = measure_echo_model(calibrated, logs, [one.segments for one in maps])
    determined = shared_wall_sensors(echoes) >= SETTINGS.min_echoes
    return Calibration(
        ring=calibrated,
        nominal=ring,
        free=tuple(free),
        held={**held, **_reasons_held(free, scale, fit, determined)},
        covariance=_covariance(ring.count, free, scale, fit),
        heading_sd=np.zeros(ring.count),
        sigma=fit.sigma,
        residuals=fit.residual,
        residuals_before=without.residual,
        echoes=sum(log.echo_count for log in fresh),
        explained=ExplainedShare(_share(echoes, fresh), SETTINGS.min_explained),
        scans=sum(len(log) for log in logs),
        poses=tuple(log.pose for log in logs),
        maps=maps,
        maps_before=maps_with(ring),
        echo_model=model,
        run=_run_residuals(prior_ring, echoes, fit, estimate),
    )


def _check_poses(logs: Sequence[Log]) -> None:
    """Raise a SonarError for logs without poses and without odometry."""
    for log in logs:
        count = int(np.isfinite(log.pose).all(axis=1).sum())
        if count < SETTINGS.min_scans:
            raise SonarError(
                f"calibration: {count} of {len(log)} scans have a pose; allowed are {SETTINGS.min_scans} or more in "
                "every log, poses or odometry, for a ring whose single scans carry no line"
            )


def _posterior(estimate: ScaleEstimate, free: Sequence[str], measured_speed_sd: float | None) -> _Scale:
    """The estimate together with the prior, or the prior if the estimate says too little.

    A temperature that the estimate contradicts is no prior: the clock of the driver changes the scale, too.
    """
    if "speed" not in free:
        return _Scale(0.0, 0.0)
    value, sd, contradiction = -estimate.log_scale, estimate.sd, ""
    prior = SETTINGS.scale_sd if measured_speed_sd is None else measured_speed_sd
    if measured_speed_sd is not None and abs(value) > SETTINGS.significant * np.hypot(sd, measured_speed_sd):
        prior = SETTINGS.scale_sd
        contradiction = (
            f"not used, because {_found(estimate)} against the speed of sound at this temperature: the clock of the "
            "driver, the odometry or the temperature is wrong"
        )
    if sd > SETTINGS.max_scale_sd and not abs(value) > SETTINGS.significant * sd:
        found = f"{_tracks(estimate)} do not suffice" if np.isinf(sd) else _found(estimate)
        why = f"{found}; needed are {SETTINGS.max_scale_sd:.1%} (one sigma): drive towards walls, or give more logs"
        return _Scale(0.0, min(sd, prior), held=why)
    variance = 1 / (sd**-2 + prior**-2)
    return _Scale(value * variance / sd**2, float(np.sqrt(variance)), contradiction=contradiction)


def _tracks(estimate: ScaleEstimate) -> str:
    return f"{estimate.tracks} tracks of sensors that approach something"


def _found(estimate: ScaleEstimate) -> str:
    """The change of the speed of sound that tracks give, in words."""
    return f"{_tracks(estimate)} give {np.expm1(-estimate.log_scale):+.1%} ± {estimate.sd:.1%}"


def _echoes_of_maps(
    ring: Ring, scaled: Ring, fresh: Sequence[Log], maps: Sequence[GlobalMap], stretch: float
) -> WallEchoes:
    """Echoes at the walls of the map of each log, in one table."""
    tables, walls, begin = [], 0, 0.0
    for new, world in zip(fresh, maps, strict=True):
        travelled = distance_travelled(new.pose)
        one = assign_echoes(ring, new, travelled, world.segments, scaled, stretch=stretch)
        tables.append(replace(one, wall=one.wall + walls, travelled=one.travelled + begin))
        walls += len(one.center)
        # The next log begins in another stretch.
        begin = SETTINGS.jackknife * np.ceil((begin + travelled.max(initial=0)) / SETTINGS.jackknife + 1)
    names = ("path", "reported", "pose", "travelled", "wall", "off_axis", "center", "theta")
    return WallEchoes(ring, *(np.concatenate([getattr(one, name) for one in tables]) for name in names))


def _share(echoes: WallEchoes, fresh: Sequence[Log]) -> float:
    return len(echoes.wall) / max(sum(log.echo_count for log in fresh), 1)


def _check_explained(echoes: WallEchoes, fresh: Sequence[Log]) -> None:
    """Raise a SonarError if the walls explain too few of the fresh echoes."""
    explained = ExplainedShare(_share(echoes, fresh), SETTINGS.min_explained)
    if not len(echoes.wall):
        raise SonarError(
            "calibration: no wall found; allowed are scans of a place with straight walls within range; "
            f"walls {explained.shortfall}"
        )
    if not explained.suffices:
        raise SonarError(f"calibration: walls {explained.shortfall}: is it the right ring, are poses and units right?")


def _check_result(ring: Ring, calibrated: Ring) -> None:
    """Raise a SonarError for a result outside the plausible range."""
    change = np.asarray(calibrated.range_offset) - np.asarray(ring.range_offset)
    worst, speed = int(np.argmax(np.abs(change))), np.log(calibrated.speed_of_sound / ring.speed_of_sound)
    if abs(change[worst]) > SETTINGS.max_offset:
        raise SonarError(
            f"calibration: the range offset of sensor {worst} diverged by {1e3 * change[worst]:.0f} mm; allowed are "
            f"{1e3 * SETTINGS.max_offset:g} mm: these scans do not determine the ring"
        )
    if abs(speed) > SETTINGS.max_log_speed:
        raise SonarError(
            f"calibration: the range scale changed by {100 * speed:.1f} %; allowed are "
            f"{100 * SETTINGS.max_log_speed:g} %: are the ranges half path lengths at 343.2 m/s, in metres?"
        )


def _reasons_held(
    free: Sequence[str], scale: _Scale, fit: OffsetFit, determined: Bool[np.ndarray, " sensors"]
) -> dict[str, str]:
    """What the run does not determine, and why."""
    held = {}
    if scale.held:
        held["speed"] = scale.held
    if scale.contradiction:
        held["temperature"] = scale.contradiction
    if "offset" in free:
        held["mean_offset"] = (
            f"not determined (± {1e3 * fit.mean_offset_sd:.0f} mm, its prior): a ring with a larger one and walls "
            "farther away give the same ranges; a laser determines it"
        )
        few = np.flatnonzero(~determined)
        if len(few):
            held["relative_offset"] = (
                f"hardly determined for sensors {', '.join(map(str, few))}, which share no wall with others "
                f"(prior ± {1e3 * SETTINGS.relative_offset_sd:.0f} mm)"
            )
    return held


def _covariance(
    count: int, free: Sequence[str], scale: _Scale, fit: OffsetFit
) -> Float[np.ndarray, "parameters parameters"]:
    """Covariance of range offsets, log speed of sound and positions; 0 for parameters that are held."""
    covariance = np.zeros((3 * count + 1, 3 * count + 1))
    relative = np.eye(count) - 1 / count
    if "offset" in free:
        covariance[:count, :count] = relative @ fit.covariance[:count, :count] @ relative
        covariance[:count, count] = covariance[count, :count] = relative @ fit.covariance[:count, count]
    covariance[count, count] = scale.sd**2
    return covariance


def _run_residuals(ring: Ring, echoes: WallEchoes, fit: OffsetFit, estimate: ScaleEstimate) -> RunResiduals:
    """Residuals of both rings against the walls of the calibrated ring."""
    offset = np.asarray(ring.range_offset)[ring.paths[echoes.path]].mean(axis=1)
    factor = REFERENCE_SPEED_OF_SOUND / float(ring.speed_of_sound)
    return RunResiduals(
        distance=fit.distance,
        off_axis=echoes.off_axis,
        before=echoes.reported - offset - factor * fit.distance,
        after=fit.residual,
        scale=estimate,
    )
