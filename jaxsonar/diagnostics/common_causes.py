"""Faults that all sensors have in common: numbering, poses, time, speed of sound, noise.

They come before single sensors are judged, because each of them makes healthy sensors look faulty. Descriptions of the
log are compared by the echoes that agree (``alternatives``); the scale of the ranges and the time offset are
estimated (``motion_fit``). The check then goes on with the corrected ring and log.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from jaxsonar.diagnostics.findings import Finding, confidence_of
from jaxsonar.diagnostics.repeated_ranges import repeated_scans
from jaxsonar.diagnostics.time_offset import search_step, search_time_offsets, with_later_poses
from jaxsonar.hardware.messages import REFERENCE_SPEED_OF_SOUND
from jaxsonar.plausibility.alternatives import Alternative, find_mistakes
from jaxsonar.plausibility.implausibility import Implausibility
from jaxsonar.plausibility.implausible_poses import unrelated_poses
from jaxsonar.plausibility.odometry_jumps import implausible_odometry
from jaxsonar.plausibility.pose_agreement import part_of_groups, select_groups
from jaxsonar.plausibility.range_noise import range_noise
from jaxsonar.registration.local_reflectors import PosedEchoes, group_echoes
from jaxsonar.registration.motion_fit import LAG, SCALE, MotionFit, fit_motion
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

_CAUSES = {
    "sensor order": "mirrored ring",
    "first sensor": "rotated ring",
    "heading unit": "headings",
    "heading direction": "headings",
}
"""Causes of findings for kinds of mistakes; others have the same name."""

_Groups = Sequence[Int[np.ndarray, "_"]]


@dataclass(frozen=True)
class CommonCauseSettings:
    """When a common cause is reported. Chosen by hand on random rooms of the simulator."""

    group: int = 16
    """Scans of a group in which scale and time offset are estimated: 1.3 m of the trajectory."""
    min_explained: float = 0.4
    """Share of the echoes that walls and points must explain before scale and time offset are judged."""
    min_lag: float = 0.03
    """Smaller time offsets are not reported, seconds; ..."""
    lag_steps: float = 0.15
    """... nor those below this many steps of the search, in which the robot moves 10 cm."""
    lag_errors: float = 5.0
    """A time offset must be this many standard errors, ..."""
    min_nats: float = 20.0
    """... and raise the log-likelihood by this, nats, ..."""
    nats_per_echo: float = 0.05
    """... and by this for each echo."""
    min_groups: tuple[float, float] = (3.0, 2.0)
    """Groups of scans that scale and time offset must rest on."""
    scale_nats: float = 4.0
    """Evidence from which on a scale error is reported, nats."""
    scale_starts: tuple[float, ...] = (-0.5, 1.0)
    """Scale errors that are tried (one way instead of both, or the reverse) ..."""
    badly_explained: float = 0.75
    """... if less than this share of the echoes is explained, ..."""
    large_scale: float = 0.2
    """From this scale error on it must explain more echoes than none, ..."""
    clearly_more: float = 1.1
    """... by this factor."""
    searches: int = 3
    """Searches for a time offset, each around the last estimate."""
    odometry_scale: float = 0.003
    """Standard deviation of the scale of odometry, which has the same effect as the scale of the ranges."""
    min_scale: float = 0.018
    """Smaller errors of the scale are not reported: 10 K of the air's temperature, or odometry."""
    air: tuple[float, float] = (312.0, 360.5)
    """Speeds of sound in air of -31 to 50 deg C, m/s."""
    noise_ratio: float = 2.5
    """Ratio of measured and stated noise, either way, from which on the statement is wrong."""
    echoes_per_fact: float = 20.0
    """Echoes that share their errors: the log-likelihood of that many echoes counts once."""


SETTINGS = CommonCauseSettings()


@dataclass(frozen=True, eq=False)
class CommonCauses:
    """Findings about a log as a whole, and what single sensors are judged by."""

    ring: Ring
    """The ring with the corrections that the findings name; its sensors have the numbers of the log."""
    log: Log
    """The log with these corrections."""
    sigma: float | None
    """Standard deviation of the ranges, metres; None if it was not stated."""
    findings: tuple[Finding, ...]
    """What is wrong, the most severe first."""


def find_common_causes(ring: Ring, log: Log, *, sigma: float | None = None) -> CommonCauses:
    """Find what is wrong with all sensors, or with the poses, and correct it.

    Without poses, or if the robot hardly moves, only the noise is judged.

    Args:
        ring: the sensors.
        log: full scans, without marks for no echo.
        sigma: the stated standard deviation of the ranges, metres; None if it is unknown.
    """
    findings: list[Finding] = []
    for one in find_mistakes(ring, log):
        findings += _mistake_findings(one)
        ring, log = one.describe(ring, log)
    # In a wrong unit, ordinary steps look like jumps.
    findings += [_jump_finding(one) for one in implausible_odometry(ring, log)]
    # Only the scans of some groups are compared: the rest of a long log costs nothing.
    part, groups = part_of_groups(log, select_groups(log, SETTINGS.group))
    if (repeated := repeated_scans(log)) is not None:
        findings.append(repeated)
    elif groups:
        echoes, step = group_echoes(ring, part, groups), search_step(part)
        fit = _with_other_scale(echoes, _search_motion(ring, part, groups, echoes, step))
        if fit is not None and fit.explained < SETTINGS.min_explained * fit.echoes:
            fit = None
        lag = 0.0
        if fit is not None:
            as_recorded = fit_motion(echoes, free=(True, False))
            if (found := _lag_finding(fit, as_recorded, step)) is not None:
                findings.append(found)
                lag = float(fit.estimate[LAG])
                log = with_later_poses(log, lag)
            elif as_recorded is not None:
                fit = _with_other_scale(echoes, as_recorded, lag_is_free=False)
        if fit is not None and (found := _scale_finding(ring, echoes, fit, lag)) is not None:
            findings.append(found)
            log = replace(log, range=log.range / (1 + fit.estimate[SCALE]))
    if not findings:
        findings += [Finding(one.kind, (), one.what, 0.99, one.cause, one.remedy) for one in unrelated_poses(ring, log)]
    measured = range_noise(ring, log)
    if sigma is not None and max(measured / sigma, sigma / measured) > SETTINGS.noise_ratio:
        findings.append(_noise_finding(sigma, measured))
        sigma = measured
    return CommonCauses(ring, log, sigma, tuple(findings))


def _lag_finding(fit: MotionFit, without: MotionFit | None, step: float) -> Finding | None:
    """The finding about a time offset, by the fits with and without it; None if there is none."""
    lag, error = float(fit.estimate[LAG]), float(fit.error[LAG])
    if fit.groups[LAG] < SETTINGS.min_groups[LAG]:
        return None
    if not abs(lag) > max(SETTINGS.min_lag, SETTINGS.lag_steps * step, SETTINGS.lag_errors * error):
        return None
    if without is None or (nats := fit.log_likelihood - without.log_likelihood) < max(
        SETTINGS.min_nats, SETTINGS.nats_per_echo * fit.echoes
    ):
        return None
    return Finding(
        "time offset",
        (),
        "echoes and poses do not go together in time: the poses are "
        f"{abs(lag):.2f} ± {max(error, 0.01):.2f} s {'late' if lag > 0 else 'early'}",
        confidence_of(nats / SETTINGS.echoes_per_fact),
        f"so shifted, walls and points explain {_share(fit)} of the echoes; as recorded, with any scale of the ranges, "
        f"{_share(without)}",
        f"correct the stamps of the poses by {-lag:+.2f} s before they are joined with the echoes",
    )


def _scale_finding(ring: Ring, echoes: PosedEchoes, fit: MotionFit, lag: float) -> Finding | None:
    """The finding about the scale of the ranges, by the fit with this time offset; None if it is right."""
    scale, groups = float(fit.estimate[SCALE]), float(fit.groups[SCALE])
    if not abs(scale) > SETTINGS.min_scale or groups < SETTINGS.min_groups[SCALE]:  # also if it is NaN
        return None
    if abs(scale) > SETTINGS.large_scale:
        without = fit_motion(echoes, lag=lag, free=(False, lag != 0))
        if without is None or fit.explained < SETTINGS.clearly_more * without.explained:
            return None
    error = float(np.hypot(fit.error[SCALE], SETTINGS.odometry_scale))
    # Student's distribution: the standard error comes from the scatter of a few groups.
    nats = groups / 2 * float(np.log1p((scale / error) ** 2 / (groups - 1)))
    if nats < SETTINGS.scale_nats:
        return None
    speed = float(ring.speed_of_sound) / (1 + scale)
    size = f"{100 * abs(scale):.1f} ± {100 * error:.1f} % too {'long' if scale > 0 else 'short'}"
    confidence = confidence_of(nats)
    other, more = f"{100 * abs(scale):.1f} % too {'short' if scale > 0 else 'long'}", "more" if scale > 0 else "less"
    evidence = (
        f"while the robot moves, the ranges of {fit.explained} echoes change by that much {more} than its motion, "
        f"{abs(scale) / error:.0f} standard errors; odometry that is {other} would look the same"
    )
    if SETTINGS.air[0] < speed < SETTINGS.air[1]:
        sentence = f"all ranges are {size}: the speed of sound is {speed:.1f} m/s, the ring has "
        sentence += f"{float(ring.speed_of_sound):.1f} m/s"
        celsius = 273.15 * ((speed / 331.3) ** 2 - 1)
        remedy = f"set speed_of_sound = {speed:.1f} in the ring (air of {celsius:.0f} deg C)"
        return Finding("speed of sound", (), sentence, confidence, evidence, remedy)
    sentence = f"all ranges are {size}; air has no such speed of sound ({speed:.0f} m/s)"
    remedy = f"multiply times of flight by half of {REFERENCE_SPEED_OF_SOUND} m/s; check the clock of the driver"
    return Finding("range scale", (), sentence, confidence, evidence, remedy)


def _share(fit: MotionFit) -> str:
    return f"{fit.explained / fit.echoes:.0%} (within {1e3 * fit.noise:.1f} mm)"


def _search_motion(ring: Ring, log: Log, groups: _Groups, echoes: PosedEchoes, step: float) -> MotionFit | None:
    """Time offset and scale: the most likely fit among those from several time offsets; None without walls."""
    if not np.isfinite(step):
        return fit_motion(echoes, free=(True, False))
    fits: list[MotionFit] = []
    best: MotionFit | None = None
    tried, center = [0.0], 0.0
    for _ in range(SETTINGS.searches):
        shifted = with_later_poses(log, center) if center else log
        starts = [center + lag for lag in search_time_offsets(ring, shifted, groups)]
        starts = [lag for lag in starts if min(abs(lag - one) for one in tried) > step / 2]
        fits += [fit for lag in ([] if fits else [0.0]) + starts if (fit := fit_motion(echoes, lag=lag)) is not None]
        if not fits:
            return None
        best = max(fits, key=lambda fit: fit.log_likelihood)
        lag = float(best.estimate[LAG])
        if not abs(lag - center) > step / 2:
            break
        tried += [*starts, *(float(fit.estimate[LAG]) for fit in fits)]
        center = lag
    return best


def _mistake_findings(found: Alternative) -> Iterator[Finding]:
    """The findings about mistakes in the description of the log, which explain its echoes together."""
    rival = f", if {found.second} {found.second_support:.0%}" if found.second else ""
    ties = [tie.mistake for tie in found.ties]
    for one in found.corrections:
        yield Finding(
            _CAUSES.get(one.kind, one.kind),
            (),
            ", or ".join([one.mistake, *one.equivalents, *ties]),
            confidence_of(found.second_z**2 / 2),
            f"if {found.mistake}, {found.corrected.mean_support:.0%} of the scans around an echo agree with it, "
            f"as given {found.given.mean_support:.0%}{rival}",
            one.remedy,
        )


def _with_other_scale(echoes: PosedEchoes, fit: MotionFit | None, *, lag_is_free: bool = True) -> MotionFit | None:
    """The fit, or one of a very different scale that explains clearly more."""
    if fit is None or fit.explained > SETTINGS.badly_explained * fit.echoes:
        return fit
    lag = float(fit.estimate[LAG]) if np.isfinite(fit.estimate[LAG]) else 0.0
    free = True, lag_is_free
    others = [fit_motion(echoes, scale=scale, lag=lag, free=free) for scale in SETTINGS.scale_starts]
    best = max((one for one in others if one is not None), key=lambda one: one.log_likelihood, default=fit)
    return best if best.log_likelihood > SETTINGS.clearly_more * fit.log_likelihood else fit


def _jump_finding(found: Implausibility) -> Finding:
    """The finding about jumps of the odometry."""
    evidence = "the step is much faster than all others, and the echoes before and after it do not show it"
    return Finding("odometry jump", (), found.what, 0.99, evidence, found.remedy)


def _noise_finding(sigma: float, measured: float) -> Finding:
    """The finding about a wrong stated noise."""
    return Finding(
        "noise",
        (),
        f"the ranges scatter by {1e3 * measured:.1f} mm, but {1e3 * sigma:.1f} mm were stated",
        0.99,
        "second differences of consecutive ranges of the same path; they depend on neither walls nor poses",
        f"leave the standard deviation of the ranges out, or state {measured:.2g} m",
    )
