"""Warnings about poses and numbers of sensors with which the echoes of a log do not agree."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.plausibility.alternatives import find_mistakes
from jaxsonar.plausibility.implausibility import Implausibility
from jaxsonar.plausibility.pose_agreement import agreement, bounded, part_of_groups, select_groups
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class ImplausiblePoseSettings:
    """When poses are implausible although no alternative agrees better. Chosen by hand.

    In simulated rooms and real recordings of this kind, a share of 0.4 is explained at least.
    """

    unexplained: float = 0.2
    """A smaller share of explained echoes is implausible, ..."""
    step: float = 0.3
    """... if the compared scans are usually this close together, metres, ..."""
    turn: float = float(np.radians(30.0))
    """... and turned by this angle at most, radians, ..."""
    least_echoes: int = 150
    """... and if as many echoes were compared."""
    most_echoes: int = 32
    """Echoes of a scan that are compared."""
    far: float = 4.0
    """Scans at a distance of this many maximum ranges have nothing in common."""
    least_steps: int = 5
    """Fewer steps show nothing by their length."""


SETTINGS = ImplausiblePoseSettings()


def implausible_poses(ring: Ring, log: Log) -> Iterator[Implausibility]:
    """Probable mistakes in the poses of a log and in the numbering of its sensors.

    Args:
        ring: the sensors.
        log: the scans; ranges in metres.
    """
    found = find_mistakes(ring, log)
    for one in found:
        yield from one.implausibilities()
    if not found:
        yield from unrelated_poses(ring, log)


def unrelated_poses(ring: Ring, log: Log) -> Iterator[Implausibility]:
    """Poses that have nothing to do with the echoes, whatever the mistake (see ``find_mistakes``).

    Args:
        ring: the sensors.
        log: the scans; ranges in metres.
    """
    yield from _distant_scans(ring, log) or _unexplained_echoes(ring, log)


def _distant_scans(ring: Ring, log: Log) -> list[Implausibility]:
    """Scans so far apart that no two of them can hear the same wall."""
    position = bounded(log.pose[np.isfinite(log.pose).all(axis=1)])[:, :2]
    step = np.hypot(*np.diff(position, axis=0).T)
    if len(step) < SETTINGS.least_steps or np.median(step) < SETTINGS.far * ring.max_range:
        return []
    what = f"the robot moves by {np.median(step):.3g} m from scan to scan, but the sensors reach {ring.max_range:g} m"
    cause = "x and y of the poses are probably in millimetres or centimetres"
    return [Implausibility("pose unit", what, cause, "give metres (of a table: --pose-unit)")]


def _unexplained_echoes(ring: Ring, log: Log) -> list[Implausibility]:
    """Echoes that do not agree with the poses although scans close together must hear the same walls."""
    part, groups = part_of_groups(log, select_groups(log), most_echoes=SETTINGS.most_echoes)
    if not groups:
        return []
    steps = np.concatenate([np.diff(part.pose[group], axis=0) for group in groups])
    near = np.median(np.hypot(*steps[:, :2].T)) <= SETTINGS.step
    if not (near and np.median(np.abs(wrap_angle(steps[:, 2]))) <= SETTINGS.turn):
        return []
    given = agreement(ring, part, groups)
    if given.echoes < SETTINGS.least_echoes or given.share > SETTINGS.unexplained:
        return []
    what = f"only {given.share:.0%} of the echoes agree with the scans around them, {given.chance:.0%} do so by chance"
    cause = "the poses have another unit or belong to another run, or the ring is another one"
    return [Implausibility("explained share", what, cause, "compare poses, clocks and ring with the robot")]
