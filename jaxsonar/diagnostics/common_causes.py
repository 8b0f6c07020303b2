"""Faults that all sensors have in common: numbering, poses, time, speed of sound, noise.

They come before single sensors are judged, because each of them makes healthy sensors look faulty. Descriptions of the
log are compared by the echoes that agree (``wrong_descriptions``); the scale of the ranges and the time offset are
estimated (``motion_fit``). The check then goes on with the corrected ring and log.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from jaxsonar.diagnostics.findings import Finding, confidence_of
from jaxsonar.diagnostics.local_reflectors import EchoGroups, group_echoes
from jaxsonar.diagnostics.motion_fit import LAG, SCALE, MotionFit, fit_motion
from jaxsonar.diagnostics.time_offset import search_step, search_time_offsets, with_later_poses
from jaxsonar.diagnostics.wrong_descriptions import Comparison, best_description
from jaxsonar.hardware.messages import REFERENCE_SPEED_OF_SOUND
from jaxsonar.plausibility.pose_agreement import select_groups
from jaxsonar.plausibility.range_noise import range_noise
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

_Groups = Sequence[Int[np.ndarray, "_"]]


@dataclass(frozen=True)
class CommonCauseSettings:
    """When a common cause is reported. Chosen by hand on random rooms of the simulator."""

    mistakes: int = 2
    """Wrong descriptions that are sought one after the other."""
    min_lag: float = 0.03
    """Smaller time offsets are not reported, seconds; ..."""
    lag_steps: float = 0.15
    """... nor those below this many steps of the search, in which the robot moves 10 cm."""
    lag_errors: float = 5.0
    """A time offset must be this many standard errors, ..."""
    min_nats: float = 20.0
    """... and raise the log-likelihood by this, nats."""
    searches: int = 3
    """Searches for a time offset, each around the last estimate."""
    odometry_scale: float = 0.005
    """Standard deviation of the scale of odometry, which has the same effect as the scale of the ranges."""
    min_scale: float = 0.017
    """Smaller errors of the scale are not reported: 10 K of the air's temperature, or odometry."""
    scale_errors: float = 3.5
    """A scale error must be this many standard errors."""
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
    groups = select_groups(log)
    for _ in range(SETTINGS.mistakes if groups else 0):
        if (comparison := best_description(ring, log, groups)) is None:
            break
        findings.append(_description_finding(comparison))
        ring, log = comparison.best.ring, comparison.best.log
    if groups and (motion := _estimate_motion(ring, log, groups)) is not None:
        offset = motion.lag_finding()
        if offset is not None:
            findings.append(offset)
            log = with_later_poses(log, motion.lag)
        scale = motion.scale_finding(ring)
        if scale is not None:
            findings.append(scale)
            log = replace(log, range=log.range / (1 + motion.scale))
    measured = range_noise(ring, log)
    if sigma is not None and max(measured / sigma, sigma / measured) > SETTINGS.noise_ratio:
        findings.append(_noise_finding(sigma, measured))
        sigma = measured
    return CommonCauses(ring, log, sigma, tuple(findings))


@dataclass(frozen=True, eq=False)
class _Motion:
    """Time offset and scale of the ranges, with the fits that they are compared with."""

    both: MotionFit
    """Both are estimated."""
    no_lag: MotionFit
    """Only the scale is estimated."""
    no_scale: MotionFit
    """Only the time offset is estimated."""
    step: float
    """Step of the search for a time offset, seconds."""

    @property
    def lag(self) -> float:
        """Time after an echo at which the poses of the log fit, seconds."""
        return float(self.both.estimate[LAG])

    @property
    def scale(self) -> float:
        """Corrected range divided by true range, minus 1."""
        return float(self.both.estimate[SCALE])

    def lag_finding(self) -> Finding | None:
        """The finding about a time offset; None if there is none."""
        least = max(SETTINGS.min_lag, SETTINGS.lag_steps * self.step)
        error = float(self.both.error[LAG])
        nats = self.both.log_likelihood - self.no_lag.log_likelihood
        if not (abs(self.lag) > max(least, SETTINGS.lag_errors * error) and nats > SETTINGS.min_nats):
            return None
        side = "late" if self.lag > 0 else "early"
        sign = "-" if self.lag > 0 else "+"
        return Finding(
            "time offset",
            (),
            f"echoes and poses do not go together in time: the poses are {abs(self.lag):.2f} ± {error:.2f} s {side}",
            confidence_of(nats / SETTINGS.echoes_per_fact),
            f"so shifted, walls and points explain {_share(self.both)} of the echoes; as recorded, with any scale of the "
            f"ranges, {_share(self.no_lag)}",
            f"correct the stamps of the poses by {sign}{abs(self.lag):.2f} s before they are joined with the echoes",
        )

    def scale_finding(self, ring: Ring) -> Finding | None:
        """The finding about the scale of the ranges; None if it is right."""
        error = float(np.hypot(self.both.error[SCALE], SETTINGS.odometry_scale))
        if not abs(self.scale) > max(SETTINGS.min_scale, SETTINGS.scale_errors * error):
            return None
        low, high = SETTINGS.air
        speed = float(ring.speed_of_sound) / (1 + self.scale)
        size = f"{100 * abs(self.scale):.1f} ± {100 * error:.1f} % too {'long' if self.scale > 0 else 'short'}"
        nats = (self.scale / error) ** 2 / 2
        evidence = (
            f"this is how ranges change while the robot moves: walls and points explain {_share(self.both)} of the "
            f"echoes, with the stated scale {_share(self.no_scale)}; odometry that is {100 * abs(self.scale):.1f} % "
            f"too {'short' if self.scale > 0 else 'long'} would look the same"
        )
        if low < speed < high:
            celsius = 273.15 * ((speed / 331.3) ** 2 - 1)
            sentence = f"all ranges are {size}: the speed of sound is {speed:.1f} m/s, the ring has "
            sentence += f"{float(ring.speed_of_sound):.1f} m/s"
            remedy = f"set speed_of_sound = {speed:.1f} in the ring (air of {celsius:.0f} deg C)"
            return Finding("speed of sound", (), sentence, confidence_of(nats), evidence, remedy)
        sentence = f"all ranges are {size}; air has no such speed of sound ({speed:.0f} m/s)"
        remedy = f"multiply times of flight by half of {REFERENCE_SPEED_OF_SOUND} m/s; check the clock of the driver"
        return Finding("range scale", (), sentence, confidence_of(nats), evidence, remedy)


def _share(fit: MotionFit) -> str:
    return f"{fit.explained / fit.echoes:.0%} (within {1e3 * fit.noise:.1f} mm)"


def _estimate_motion(ring: Ring, log: Log, groups: _Groups) -> _Motion | None:
    """Fit time offset and scale; None if the robot sees too few walls."""
    echoes = group_echoes(ring, log, groups)
    no_lag = fit_motion(echoes, free=(True, False))
    if no_lag is None:
        return None
    step = search_step(log)
    both = _search_motion(ring, log, groups, echoes, step) if np.isfinite(step) else None
    both = no_lag if both is None else both
    lag = float(both.estimate[LAG])
    no_scale = fit_motion(echoes, lag=lag, free=(False, False))
    return _Motion(both, no_lag, both if no_scale is None else no_scale, float(np.nan_to_num(step)))


def _search_motion(ring: Ring, log: Log, groups: _Groups, echoes: EchoGroups, step: float) -> MotionFit | None:
    """The most likely fit among those that start from several time offsets."""
    best, center = None, 0.0
    for _ in range(SETTINGS.searches):
        shifted = with_later_poses(log, center) if center else log
        starts = [center, *(center + lag for lag in search_time_offsets(ring, shifted, groups))]
        fits = [fit for lag in starts if (fit := fit_motion(echoes, lag=lag)) is not None]
        best = max([*fits, *([] if best is None else [best])], key=lambda fit: fit.log_likelihood, default=None)
        if best is None or not abs(best.estimate[LAG] - center) > step / 2:
            break
        center = float(best.estimate[LAG])
    return best


def _description_finding(comparison: Comparison) -> Finding:
    """The finding about a wrong description."""
    best, second = comparison.best, comparison.second
    rival = f", if {second} {comparison.second_support:.0%}" if second else ""
    return Finding(
        best.cause,
        (),
        best.mistake,
        confidence_of(comparison.z**2 / 2),
        f"so, {comparison.result.mean_support:.0%} of the scans around an echo agree with it, as given "
        f"{comparison.given.mean_support:.0%}{rival}",
        best.remedy,
    )


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
