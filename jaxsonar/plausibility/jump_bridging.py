"""The motion of a robot during a jump of its odometry, and whether the echoes confirm it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.se2 import compose, interpolate, inverse
from jaxsonar.plausibility.pose_agreement import agreement, part_of_groups, spaced_scans
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class JumpBridgingSettings:
    """Constants of the comparison of scans before and after a jump. Chosen by hand on simulated rooms."""

    side: int = 5
    """Scans on each side that are compared."""
    spacing: float = 0.05
    """They are this far apart, metres, ..."""
    turn: float = float(np.radians(6.0))
    """... or turned by this angle, radians."""
    searched: int = 80
    """They are searched among this many scans on each side."""
    least_scans: int = 3
    """With fewer scans on a side, nothing is stated."""
    least_echoes: int = 24
    """With fewer echoes, nothing is stated."""


SETTINGS = JumpBridgingSettings()


@dataclass(frozen=True)
class JumpSupport:
    """Mean share of the other scans that agree with an echo (``Agreement.mean_support``)."""

    given: float
    """Scans before and after the jump, the step as the odometry gives it."""
    bridged: float
    """The same scans, with the motion before and after the jump instead of it."""
    sides: float
    """Scans before and scans after the jump, each among themselves."""


def bridging_transform(log: Log, before: int, after: int) -> Float[np.ndarray, "3"]:
    """old_from_new: moves the poses after a jump to where the motion before and after it leads.

    Half of the time of the jump passes at the velocity before it, half at the velocity after it.

    Args:
        log: the scans.
        before: row of the last scan with a pose before the jump.
        after: row of the first one after it.
    """
    posed = np.flatnonzero(np.isfinite(log.pose).all(axis=1))
    at = int(np.searchsorted(posed, before))
    earlier, later = int(posed[max(at - 1, 0)]), int(posed[min(at + 2, len(posed) - 1)])
    rows = np.array([earlier, before, after, later])
    time = log.stamp[rows]
    if not (np.diff(time) > 0).all():  # False for NaN
        time = rows.astype(np.float64)
    duration = np.diff(time)
    share = [duration[1] / (2 * one) if one > 0 else 0.0 for one in duration[[0, 2]]]
    middle, middle_of_new = interpolate(
        log.pose[[earlier, after]], log.pose[[before, later]], np.array([1 + share[0], -share[1]])
    )
    return compose(middle, inverse(middle_of_new))


def jump_support(ring: Ring, log: Log, before: int, after: int) -> JumpSupport | None:
    """How well echoes before and after a jump agree; None: too few scans or echoes.

    Args:
        ring: the sensors.
        log: the scans.
        before: row of the last scan with a pose before the jump.
        after: row of the first one after it.
    """
    posed = np.flatnonzero(np.isfinite(log.pose).all(axis=1))
    at = int(np.searchsorted(posed, before)) + 1
    early = _spaced(log.pose, posed[max(at - SETTINGS.searched, 0) : at][::-1])[::-1]
    late = _spaced(log.pose, posed[at : at + SETTINGS.searched])
    if min(len(early), len(late)) < SETTINGS.least_scans:
        return None
    part, (group,) = part_of_groups(log, [np.concatenate([early, late])])
    part = replace(part, odometry=None)
    sides = [group[: len(early)], group[len(early) :]]
    alone = agreement(ring, part, sides, support_only=True)
    if alone.echoes < SETTINGS.least_echoes:
        return None
    pose = part.pose.copy()
    pose[len(early) :] = compose(bridging_transform(log, before, after), pose[len(early) :])
    given = agreement(ring, part, [group], support_only=True)
    bridged = agreement(ring, replace(part, pose=pose), [group], support_only=True)
    return JumpSupport(given.mean_support, bridged.mean_support, alone.mean_support)


def _spaced(pose: Float[np.ndarray, "scans 3"], rows: Int[np.ndarray, " some"]) -> Int[np.ndarray, " spaced"]:
    """The first of some rows, and those that follow at a distance from the last one that was selected."""
    return rows[spaced_scans(pose[rows], SETTINGS.side, spacing=SETTINGS.spacing, turn=SETTINGS.turn)]
