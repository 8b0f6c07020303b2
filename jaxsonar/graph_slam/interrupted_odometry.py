"""Odometry that jumps: continued where the robot stayed at its place, otherwise separate parts of the trajectory."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.geometry.se2 import compose
from jaxsonar.plausibility.jump_bridging import bridging_transform
from jaxsonar.plausibility.odometry_jumps import OdometryJump, find_odometry_jumps
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class InterruptionSettings:
    """Constants of interrupted odometry; chosen by hand."""

    bridged_sd: tuple[float, float] = (0.03, 0.05)
    """Standard deviations of the motion of a robot that seems to rest during a jump, metres and radians."""
    bridged_fraction: float = 0.5
    """The same of a robot that moves, as a fraction of its displacement and rotation."""
    max_bridged_steps: float = 5.0
    """Longest jump about which the echoes tell nothing that is bridged, in scans and in usual durations of a step."""


SETTINGS = InterruptionSettings()


@dataclass(frozen=True)
class InterruptedOdometryNoise:
    """Noise model (``OdometryNoiseModel``) of odometry with bridged jumps."""

    noise: OdometryNoise
    """Of all other steps."""
    bridged: Int[np.ndarray, " jumps"]
    """Rows of the first scans after the jumps."""

    def __call__(
        self, measured: Float[np.ndarray, "scans 3"], rows: Int[np.ndarray, " rows"]
    ) -> Float[np.ndarray, "_ 3"]:
        """See ``OdometryNoiseModel``."""
        sd = self.noise(measured, rows)
        jumps = np.searchsorted(self.bridged, rows, side="right")
        crosses = np.diff(jumps) > 0
        fraction, (position, heading) = SETTINGS.bridged_fraction, SETTINGS.bridged_sd
        step = measured[rows[1:]] - measured[rows[:-1]]
        displacement = position + fraction * np.hypot(step[:, 0], step[:, 1])
        rotation = heading + fraction * np.abs(np.sin(step[:, 2]))
        bridged = np.stack([displacement, displacement, rotation], axis=-1)
        return np.where(crosses[:, None], np.maximum(sd, bridged), sd)


@dataclass(frozen=True, eq=False)
class ContinuedOdometry:
    """A log whose odometry goes on over jumps, as far as the echoes show that the robot stayed at its place."""

    log: Log
    """The log. Poses after a bridged jump are in the frame of the poses before it."""
    jumps: tuple[OdometryJump, ...]
    """The jumps, in the rows of the log."""
    bridged: Int[np.ndarray, " bridged"]
    """Rows of the first scans after bridged jumps."""
    parts: tuple[slice, ...]
    """Rows of the parts of the log between jumps that are not bridged. Their relative poses are unknown."""

    @property
    def largest_part(self) -> slice:
        """The part with most scans, the first one of several."""
        return max(self.parts, key=lambda part: part.stop - part.start)


def continue_odometry(ring: Ring, log: Log) -> ContinuedOdometry:
    """Bridge the jumps of the odometry by the motion before and after them; a log without jumps is returned unchanged.

    A jump is bridged if the ranges are the same before and after it, or if it is short and there are too few echoes.

    Args:
        ring: the sensors.
        log: full scans; their poses are odometry.
    """
    jumps = find_odometry_jumps(ring, log)
    bridged, begin = [], [0]
    for jump in jumps:
        if _is_bridged(log, jump):
            log = _bridge(log, jump)
            bridged.append(jump.after)
        else:
            begin.append(jump.after)
    parts = tuple(map(slice, begin, [*begin[1:], len(log)]))
    return ContinuedOdometry(log, jumps, np.array(bridged, dtype=np.int64), parts)


def _is_bridged(log: Log, jump: OdometryJump) -> bool:
    """Whether the robot was at nearly the same place before and after a jump."""
    if jump.ranges_continue is not None:
        return jump.ranges_continue
    usual = np.nanmedian(np.diff(log.stamp)) if np.isfinite(jump.seconds) else np.inf
    return jump.after - jump.before <= SETTINGS.max_bridged_steps and not (
        jump.seconds > SETTINGS.max_bridged_steps * usual  # False for NaN
    )


def _bridge(log: Log, jump: OdometryJump) -> Log:
    """The log with poses after a jump moved to where the motion before and after it leads."""
    old_from_new = bridging_transform(log, jump.before, jump.after)
    pose = log.pose.copy()
    pose[jump.after :] = compose(old_from_new, pose[jump.after :])
    return replace(log, pose=pose, odometry=_moved_samples(log, jump, old_from_new))


def _moved_samples(log: Log, jump: OdometryJump, old_from_new: Float[np.ndarray, "3"]) -> np.ndarray | None:
    """Odometry at its own rate, moved from its largest step within the jump on."""
    samples = log.odometry
    if samples is None:
        return None
    first, last = np.searchsorted(samples[:, 0], log.stamp[[jump.before, jump.after]])
    inside = samples[max(int(first) - 1, 0) : int(last) + 2, 1:]
    step = np.hypot(*np.diff(inside[:, :2], axis=0).T) + np.abs(np.sin(np.diff(inside[:, 2]) / 2))
    begin = max(int(first) - 1, 0) + 1 + int(step.argmax()) if len(step) else len(samples)
    moved = samples.copy()
    moved[begin:, 1:] = compose(old_from_new, samples[begin:, 1:])
    return moved
