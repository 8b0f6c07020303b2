"""Calibration of a ring from scans of an unknown environment: autofocus, then bundle adjustment."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Float

from jaxsonar.calibration.alternating_fit import CalibrationFit, CalibrationProblem, check_calibration_poses
from jaxsonar.calibration.autofocus import autofocus_ring
from jaxsonar.calibration.beam_headings import estimate_headings
from jaxsonar.calibration.calibration_result import Calibration
from jaxsonar.calibration.settings import SETTINGS
from jaxsonar.calibration.sparse_ring import calibrate_sparse_ring, is_sparse
from jaxsonar.detection.extract import check_sigma, local_models
from jaxsonar.estimation.estimation_log import estimation_log
from jaxsonar.estimation.explained_share import ExplainedShare
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.build_map import build_map
from jaxsonar.plausibility.implausible_poses import implausible_poses
from jaxsonar.plausibility.range_units import find_range_unit
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.sliding_windows import check_window
from jaxsonar.sensors.ring import Ring, speed_of_sound
from jaxsonar.sensors.ring_parameters import (
    DEFAULT_PARAMETERS,
    PARAMETERS,
    PRIOR,
    check_parameters,
    check_speed_of_sound,
    parameter_basis,
)

POSES = ("trust", "estimate")
"""Choices for the poses of a log: exact, or initial values and odometry."""


def calibrate(
    ring: Ring,
    log: Log | Sequence[Log],
    *,
    free: Sequence[str] = DEFAULT_PARAMETERS,
    poses: str = "trust",
    odometry: float | None = None,
    temperature: float | None = None,
    sigma: float | None = None,
    window: float | None = None,
    on_step: Callable[[str], None] | None = None,
) -> Calibration:
    """Estimate the parameters of a ring from the ranges of its echoes; walls and corners are estimated as well.

    A ring whose single scans carry no line is calibrated from the run (``sparse_ring``), as far as only "offset" and
    "speed" are free: it needs poses or odometry.

    Args:
        ring: the nominal ring.
        log: 17 or more scans from different poses. Each of several logs has a map of its own. Firings that are scans of
            their own are merged first (``estimation_log``).
        free: estimated parameter groups, of "offset", "speed", "position", "radius", "heading"; the others are held.
        poses: "trust" takes the poses of the log as exact; "estimate" takes them as odometry, if there are any.
        odometry: standard deviation of odometry, as a fraction of the displacement and rotation between scans; 0.02 if
            omitted. Only with poses to estimate. A ring that is calibrated from the run needs none: the standard errors
            come from the run itself.
        temperature: measured temperature of the air, deg C: prior mean of the speed of sound.
        sigma: standard deviation of the range noise, metres; estimated from the residuals if left out.
        window: length of trajectory gathered into one local model, metres, as in ``build_map``; for sparse rings, which
            have one by default.
        on_step: called with a description of each step.

    Raises:
        SonarError: an invalid choice, a speed of sound that air does not have, trusted logs without poses, a log that
            agrees better with other units, axes or numbers of the sensors, too few walls or explained echoes, a result
            outside the plausible range.
    """
    logs = [estimation_log(one) for one in ([log] if isinstance(log, Log) else log)]
    progress = on_step or (lambda text: None)
    _check_arguments(ring, logs, free, poses, odometry, temperature, sigma, window)
    poses_free = poses == "estimate"
    for one in logs:
        _check_plausible(ring, one)
    # 1. Priors: the speed of sound of the measured temperature, and a basis of the free parameters.
    prior_ring, speed_sd = ring, PRIOR.speed_sd
    if temperature is not None:
        prior_ring, speed_sd = replace(ring, speed_of_sound=speed_of_sound(temperature)), PRIOR.measured_speed_sd
    if not poses_free:
        check_calibration_poses(logs)
    has_poses = all(np.isfinite(one.pose).any() for one in logs)
    if set(free) <= set(DEFAULT_PARAMETERS) and has_poses and is_sparse(prior_ring, logs):
        if odometry is not None:
            raise SonarError(
                f"calibration: odometry {odometry:g} came for a ring whose single scans carry no line; allowed is "
                "none, because the standard errors come from the run itself"
            )
        return calibrate_sparse_ring(
            ring,
            prior_ring,
            logs,
            free=free,
            held=_not_asked_for(free),
            poses_exact=not poses_free,
            measured_speed_sd=None if temperature is None else speed_sd,
            sigma=sigma,
            window=window,
            progress=progress,
        )
    if odometry is not None and not poses_free:
        raise SonarError(
            f"calibration: odometry {odometry:g} came with poses 'trust'; allowed is poses 'estimate' with it: "
            "trusted poses have no error"
        )
    basis = parameter_basis(prior_ring, free, poses_free=poses_free, speed_sd=speed_sd)
    error = SETTINGS.odometry_error if odometry is None else odometry
    problem = CalibrationProblem(prior_ring, basis, poses_free, error, sigma, window, progress)
    # 2. Autofocus: bring a ring with large errors close enough for echoes to be associated with walls.
    start = prior_ring
    if "offset" in free and window is None:
        progress("autofocus")
        speed_free = "speed" in free and not poses_free
        start = autofocus_ring(prior_ring, max(logs, key=len), poses=not poses_free, speed=speed_free)
    # 3. Bundle adjustment of ring, landmarks and free poses on the ranges; association and map are renewed in between.
    fit = problem.fit(start, logs)
    # 4. The mean range offset, if second-order echoes determine it.
    fit, mean_held = problem.fit_mean_offset(fit) if "offset" in free else (fit, "")
    covariance = problem.parameter_covariance(fit.adjustment)
    _check_result(problem, fit)
    explained = _explained(problem, fit)
    if not explained.suffices:
        raise SonarError(
            f"calibration: walls and corners {explained.shortfall}: is it the right ring, are poses and units right?"
        )
    calibrated, heading_sd = problem.ring_at(fit.adjustment.state), np.zeros(ring.count)
    # 5. Headings, from the directions in which echoes are received at all; ranges do not depend on them.
    if "heading" in free:
        progress("headings")
        with jax.enable_x64(True):
            calibrated, heading_sd = estimate_headings(calibrated, fit.data, fit.adjustment)
    # 6. Maps before and after.
    progress("maps before and after")
    found = fit.adjustment
    final_logs = fit.data.logs_with_poses(fit.logs, found.state.poses)
    return Calibration(
        ring=calibrated,
        nominal=ring,
        free=tuple(free),
        held=_reasons_held(free, mean_held, speed_sd, temperature, covariance),
        covariance=covariance,
        heading_sd=heading_sd,
        sigma=found.sigma,
        residuals=found.residual[found.used],
        residuals_before=problem.nominal_residuals(fit)[found.used],
        echoes=fit.data.echo_count,
        explained=explained,
        scans=fit.data.scan_count,
        poses=tuple(log.pose for log in final_logs),
        maps=tuple(build_map(calibrated, log, window=window) for log in final_logs),
        maps_before=tuple(build_map(ring, log, window=window) for log in fit.logs),
        problem=found.problem,
        unknowns=found.solution.unknowns,
    )


def _reasons_held(
    free: Sequence[str],
    mean_held: str,
    speed_sd: float,
    temperature: float | None,
    covariance: Float[np.ndarray, "parameters parameters"],
) -> dict[str, str]:
    """Parameters that were not estimated, and why."""
    held = _not_asked_for(free)
    if mean_held:
        held["mean_offset"] = mean_held
    if "speed" in free:
        count = (len(covariance) - 1) // 3
        sd = float(np.sqrt(covariance[count, count]))
        source = "the measured temperature" if temperature is not None else "the prior for air"
        if sd > SETTINGS.unobserved_sd * speed_sd:
            held["speed"] = f"these scans do not determine it; it stays at {source}, {100 * speed_sd:.2g} % (one sigma)"
    return held


def _not_asked_for(free: Sequence[str]) -> dict[str, str]:
    """Parameters that are held because nobody asked for them."""
    held = {name: "not asked for" for name in PARAMETERS if name not in free}
    if "heading" in held:
        held["heading"] = "not asked for; ranges do not depend on it"
    return held


def _check_arguments(
    ring: Ring,
    logs: Sequence[Log],
    free: Sequence[str],
    poses: str,
    odometry: float | None,
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
    if odometry is not None and not 1e-4 <= odometry <= 1:  # False for NaN
        raise SonarError(f"odometry {odometry:g}; allowed is 0.0001 to 1, its error as a fraction of the distance")
    if temperature is not None and not -60 <= temperature <= 85:
        raise SonarError(f"temperature {temperature:g} deg C; allowed is -60 to 85")
    check_speed_of_sound(ring)


def _check_plausible(ring: Ring, log: Log) -> None:
    """Raise a SonarError for a log whose echoes agree better with another description, or not with its poses.

    Walls and a ring that fit a part of the echoes by chance can be found for a wrong log, too.
    """
    unit = find_range_unit(ring, log)
    for found in [unit.implausibility] if unit else implausible_poses(ring, log):
        raise SonarError(f"calibration: refused, because {found}")


def _explained(problem: CalibrationProblem, fit: CalibrationFit) -> ExplainedShare:
    """Share of the echoes that the walls and corners of all scans explain.

    Walls and corners of single scans do not depend on the poses. If they explain much more, the poses are wrong.
    """
    measured, required = fit.explained_count / max(fit.data.echo_count, 1), SETTINGS.min_explained
    if problem.window is None:
        alone = max(_explained_alone(problem.ring_at(fit.adjustment.state), log) for log in fit.logs)
        required = max(required, SETTINGS.min_explained_of_alone * alone)
    return ExplainedShare(measured, required)


def _explained_alone(ring: Ring, log: Log) -> float:
    """Share of the echoes of some scans that walls and corners of the same scan explain."""
    posed = np.flatnonzero(np.isfinite(log.pose).all(axis=1))
    rows = posed[:: max(1, len(posed) // SETTINGS.judged_scans)]
    some = Log.from_scans([log[row] for row in rows.tolist()])
    features = [(*model.lines, *model.points) for model in local_models(ring, some)]
    return sum(one.echoes for found in features for one in found) / max(some.echo_count, 1)


def _check_result(problem: CalibrationProblem, fit: CalibrationFit) -> None:
    """Raise a SonarError for a result outside the plausible range."""
    count = problem.ring.count
    change = problem.basis.columns @ fit.adjustment.state.coordinates
    offset, log_speed = change[:count], float(change[count])
    worst = int(np.argmax(np.abs(offset)))
    if abs(offset[worst]) > SETTINGS.max_offset:
        raise SonarError(
            f"calibration: the range offset of sensor {worst} diverged by {1e3 * offset[worst]:.0f} mm; allowed are "
            f"{1e3 * SETTINGS.max_offset:g} mm: these scans do not determine the ring (try more scans, odometry or "
            "known poses)"
        )
    if abs(log_speed) > SETTINGS.max_speed_change:
        raise SonarError(
            f"calibration: the speed of sound diverged by {100 * log_speed:.1f} %; allowed are "
            f"{100 * SETTINGS.max_speed_change:g} %: are the ranges half path lengths at 343.2 m/s, in metres?"
        )
