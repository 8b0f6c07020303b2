"""Warnings about logs that can be read but are probably not what the person means: units, degrees, clocks."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class PlausibilitySettings:
    """When a log is implausible. Chosen by hand, such that no sound log of the tests and data sets gets a warning."""

    beyond: float = 0.4
    """Share of the echoes beyond the maximum range of the ring."""
    least_echoes: int = 20
    """Logs with fewer echoes give no warning about their ranges."""
    extent: float = 50.0
    """Extent of the trajectory from which on large steps are implausible, metres."""
    least_step: float = 1.0
    """Smallest step between scans that is implausible, metres; steps must also exceed the maximum range."""
    least_steps: int = 8
    """Logs with fewer steps of a moving robot give no warning about poses."""
    least_heading: float = 7.0
    """Headings in radians that are all smaller may be wrapped ones, and are not checked for degrees."""
    along: float = 0.7
    """Mean cosine of twice the angle between heading and direction of motion from which on the robot drives forwards or
    backwards, ..."""
    across: float = 0.3
    """... and up to which it does not."""


SETTINGS = PlausibilitySettings()


def implausible_input(ring: Ring, log: Log) -> Iterator[str]:
    """Probable mistakes of a log, each in one line: what; likely cause; what to do.

    Args:
        ring: the sensors.
        log: the scans.
    """
    fall = np.flatnonzero(np.diff(log.stamp) < 0)  # False for NaN
    if len(fall):
        before, after = log.stamp[fall[0] : fall[0] + 2]
        what = f"the stamps fall {len(fall)} times, first from {before:.3f} s to {after:.3f} s"
        yield f"{what}; the clock was set, or logs were joined; give the scans the times at which they were taken"
    heard = log.range[np.isfinite(log.range)]
    if len(heard) >= SETTINGS.least_echoes and (share := float(np.mean(heard > ring.max_range))) > SETTINGS.beyond:
        what = f"{share:.0%} of the echoes are beyond the maximum range of the ring, {ring.max_range:g} m"
        cause = "the ranges are lengths out and back or have another unit, or the ring is another one"
        yield f"{what}; {cause}; give half path lengths in metres"
    pose = log.pose[np.isfinite(log.pose).all(axis=1)]
    step = np.diff(pose[:, :2], axis=0)
    length = np.hypot(*step.T)
    moving = length > 1e-6
    if moving.sum() < SETTINGS.least_steps:
        return
    typical = float(np.median(length[moving]))
    extent = float(np.hypot(*np.ptp(pose[:, :2], axis=0)))
    if typical > max(ring.max_range, SETTINGS.least_step) and extent > SETTINGS.extent:
        what = f"the robot moves {typical:.3g} m from scan to scan, {extent:.4g} m in all"
        yield f"{what}; the poses are in mm or cm; give x and y in metres"
    step, theta = step[moving], pose[:-1, 2][moving]
    is_large = np.abs(theta).max() > SETTINGS.least_heading
    if is_large and _drives(step, np.radians(theta)) > SETTINGS.along and _drives(step, theta) < SETTINGS.across:
        what = "the robot drives along its heading only if the heading is read as degrees"
        yield f"{what}; theta is in degrees; give theta in radians"


def _drives(step: Float[np.ndarray, "steps 2"], heading: Float[np.ndarray, " steps"]) -> float:
    """Mean cosine of twice the angle between direction of motion and heading, weighted by the length of the steps.

    It is 1 for a robot that drives forwards or backwards, -1 for one that drives sideways, and about 0 for any other.
    """
    angle = np.arctan2(step[:, 1], step[:, 0]) - heading
    length = np.hypot(*step.T)
    return float(np.sum(length * np.cos(2 * angle)) / np.sum(length))
