"""The log as the health check needs it, and findings about what was removed: marks, held and constant readings.

Ranges in another unit become metres if the poses tell the unit.
"""

from typing import NamedTuple

import numpy as np

from jaxsonar.diagnostics.findings import Finding
from jaxsonar.diagnostics.settings import SETTINGS
from jaxsonar.plausibility.constant_ranges import range_resolution
from jaxsonar.plausibility.implausibility import Implausibility
from jaxsonar.plausibility.prepared_log import CleanedLog, no_echo_warning
from jaxsonar.plausibility.robot_echoes import RobotEcho, RobotEchoes
from jaxsonar.plausibility.unheard_paths import unheard_warning
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

_FINDINGS = SETTINGS.findings


class CheckedLog(NamedTuple):
    """A log without readings that are no echoes of the surroundings."""

    log: Log
    """Without marks for no echo and without echoes of the robot; old readings have an age."""
    reported: Log
    """The same with the echoes of the robot."""
    findings: tuple[Finding, ...]
    """What was found."""


def checked_log(ring: Ring, log: Log) -> CheckedLog:
    """Remove readings that are no echoes of the surroundings.

    Args:
        ring: the sensors.
        log: one scan or more, as they were recorded.
    """
    cleaned = CleanedLog.of(ring, log)
    findings = [_of_input(one) for one in cleaned.stamps]
    if values := cleaned.no_echo:
        listed = ", ".join(map(str, values))
        findings.append(
            Finding(
                "no-echo value",
                (),
                f"most sensors read {listed}, wherever the robot is: a mark for no echo, which counts as silence",
                _FINDINGS.certain,
                "most sensors share the value, and it does not change while the robot moves",
                no_echo_warning(values).remedy,
            )
        )
    if held := cleaned.held:
        findings.append(
            Finding(
                "held readings",
                (),
                held.describe(),
                _FINDINGS.certain,
                "no wall or point in the detection cones can keep its range during these motions",
                "let the driver report nothing instead of the last range",
            )
        )
    findings += _robot_findings(cleaned.reported, cleaned.robot)
    checked, reported, unit = cleaned.log, cleaned.reported, cleaned.unit
    if unit is not None:
        by_poses = bool(np.isfinite(unit.share))
        findings.insert(0, _of_input(unit.implausibility, _FINDINGS.certain if by_poses else 0.5))
        if by_poses:
            checked, reported = unit.corrected(checked), unit.corrected(reported)
    if unheard := unheard_warning(ring, cleaned.heard):
        findings.append(_of_input(unheard))
    return CheckedLog(checked, reported, tuple(findings))


def _of_input(found: Implausibility, confidence: float = _FINDINGS.certain) -> Finding:
    """The finding about a mistake in the log, with its kind as cause."""
    return Finding(found.kind, (), f"{found.what}; {found.cause}", confidence, "", found.remedy)


def _robot_findings(log: Log, found: RobotEchoes) -> list[Finding]:
    """Echoes that move with the robot: of its body, a cable, or the floor."""
    remedy = "mount {} so that {} not hear the robot or the floor; maps leave these echoes out"
    if found.is_floor:
        ranges = [one.range for one in found.echoes]
        text = f"{len(found.sensors)} sensors hear the floor: a range of {min(ranges):.2f} to {max(ranges):.2f} m"
        sentence = f"{text}, wherever the robot is"
        evidence = "no wall has the same range in all directions and at all places"
        return [
            Finding("floor echo", (), sentence, _confidence(found.echoes), evidence, remedy.format("them", "they do"))
        ]
    is_fine = range_resolution(log.range) < _FINDINGS.fine_resolution
    findings = []
    for one in found.echoes:
        # A value that never changes at all is no echo: the sensor is stuck, which its repetitions tell.
        if (one.sigma == 0 and is_fine) or (one.tx != one.rx and {one.tx, one.rx} & set(found.sensors)):
            continue
        who = f"sensor {one.tx}" if one.tx == one.rx else f"path {one.tx} to {one.rx}"
        floor = one.range > _FINDINGS.floor_range and one.sigma > _FINDINGS.floor_sigma
        what = "the floor" if floor else "its own robot (body, mount or cable)"
        sentence = f"{who} hears {what}: it reads {one.range:.3f} ± {one.sigma:.3f} m wherever the robot is"
        evidence = f"in {one.share:.0%} of its measurements"
        if one.places:
            evidence += f", at {one.places} poses at which no common wall or point can have this range"
        sensors = (one.tx,) if one.tx == one.rx else ()
        cause = "floor echo" if floor else "own echo"
        findings.append(Finding(cause, sensors, sentence, _confidence([one]), evidence, remedy.format("it", "it does")))
    return findings


def _confidence(echoes: "tuple[RobotEcho, ...] | list[RobotEcho]") -> float:
    """Each further place halves the probability of a wall."""
    return 1 - 0.5 ** (1 + max(one.places for one in echoes))
