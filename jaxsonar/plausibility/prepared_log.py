"""A log as computations need it: marks for no echo are silent, old readings have an age, single firings are scans."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from jaxsonar.plausibility.held_readings import HeldReadings, find_held_readings, with_ages
from jaxsonar.plausibility.implausibility import Implausibility
from jaxsonar.plausibility.implausible_poses import implausible_poses
from jaxsonar.plausibility.implausible_ring import implausible_ring
from jaxsonar.plausibility.implausible_stamps import implausible_stamps
from jaxsonar.plausibility.odometry_jumps import implausible_odometry
from jaxsonar.plausibility.range_units import RangeUnit, find_range_unit
from jaxsonar.plausibility.robot_echoes import RobotEchoes, find_robot_echoes, without_robot_echoes
from jaxsonar.plausibility.unheard_paths import unheard_warning
from jaxsonar.scans.no_echo_values import NoEchoValue, find_no_echo_values, without_no_echo_values
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.single_firings import group_firings
from jaxsonar.sensors.ring import Ring

_EMPTY = Implausibility(
    "empty log", "the log has no scan", "the recording probably ended before the first scan", "record it again"
)


@dataclass(frozen=True, eq=False)
class CleanedLog:
    """A log without readings that are no echoes of the surroundings, with what was found on the way."""

    log: Log
    """Full scans without marks for no echo and without echoes of the robot; old readings have an age. A sound log of
    full scans is unchanged."""
    reported: Log
    """The same with the echoes of the robot."""
    heard: Log
    """The log as it was recorded, without marks for no echo."""
    is_merged: bool
    """Whether firings were scans of their own."""
    stamps: tuple[Implausibility, ...]
    """Probable mistakes of the stamps."""
    no_echo: tuple[NoEchoValue, ...]
    """Ranges that mean no echo."""
    held: HeldReadings
    """Readings that repeat the last range because the sensor heard nothing."""
    robot: RobotEchoes
    """Echoes that move with the robot."""
    unit: RangeUnit | None
    """A probable other unit of the ranges; None if it is metres, or if the ring itself is implausible."""
    ring_is_plausible: bool
    """Whether something can be concluded from the ring."""

    @classmethod
    def of(cls, ring: Ring, log: Log) -> "CleanedLog":
        """Remove what is no echo of the surroundings, and test stamps and units.

        - Ranges that mean no echo (``find_no_echo_values``) become silent readings.
        - Firings that are scans of their own are merged into scans (``group_firings``).
        - Readings that repeat the last range because the sensor heard nothing get an age (``find_held_readings``).
        - Echoes that move with the robot are removed (``find_robot_echoes``).

        Args:
            ring: the sensors.
            log: one scan or more, as they were recorded.
        """
        stamps = tuple(implausible_stamps(log))
        values = tuple(find_no_echo_values(log))
        heard = without_no_echo_values(log, values) if values else log
        grouped = group_firings(heard)
        held = find_held_readings(ring, grouped)
        reported = with_ages(grouped, held)
        robot = find_robot_echoes(ring, reported)
        cleaned = without_robot_echoes(reported, robot)
        # Nothing is concluded from a ring that is wrong itself.
        plausible = not any(implausible_ring(ring))
        unit = find_range_unit(ring, cleaned) if plausible else None
        return cls(cleaned, reported, heard, grouped is not heard, stamps, values, held, robot, unit, plausible)


@dataclass(frozen=True, eq=False)
class PreparedLog:
    """A log that is prepared for computations, with everything that was noticed about it."""

    log: Log
    """The log. A sound log of full scans is unchanged."""
    warnings: tuple[Implausibility, ...]
    """Probable mistakes."""
    notes: tuple[str, ...]
    """Other changes, each in one line."""

    @classmethod
    def of(cls, ring: Ring, log: Log) -> "PreparedLog":
        """Prepare a log (``CleanedLog.of``) and look for mistakes.

        A probable mistake in the units or the numbering of a log is reported, but not corrected.

        Args:
            ring: the sensors.
            log: the scans, as they were recorded.
        """
        if not len(log):
            return cls(log, (_EMPTY,), ())
        found = CleanedLog.of(ring, log)
        warnings, notes = [*found.stamps], []
        if found.no_echo:
            warnings.append(no_echo_warning(found.no_echo))
        if unheard := unheard_warning(ring, found.heard):
            warnings.append(unheard)
        if found.is_merged:
            scans = f"{len(found.log)} scan{'s' * (len(found.log) != 1)}"
            notes.append(f"{len(log)} scans with one firing each are merged into {scans}")
        if found.held:
            remedy = "let the driver report nothing instead"
            warnings.append(Implausibility("held readings", found.held.describe(), "each range counts once", remedy))
        if found.robot:
            warnings.append(found.robot.warning())
        unit = found.unit
        if unit:
            warnings.append(unit.implausibility)
        # Nothing is concluded from a ring that is wrong itself, nor from ranges whose unit is unknown.
        if found.ring_is_plausible and (unit is None or np.isfinite(unit.scale)):
            warnings += implausible_poses(ring, unit.corrected(found.log) if unit else found.log)
        # In a wrong unit, ordinary steps look like jumps.
        if not any(one.kind in ("pose unit", "heading unit") for one in warnings):
            warnings += implausible_odometry(ring, found.log)
        return cls(found.log, tuple(warnings), tuple(notes))


def prepared_log(ring: Ring, log: Log, *, on_note: Callable[[str], None]) -> Log:
    """The log that ``PreparedLog.of`` gives.

    Args:
        ring: the sensors.
        log: the scans, as they were recorded.
        on_note: called with one line for each change; a line that begins with ``warning:`` is about a probable
            mistake: what, likely cause, what to do.
    """
    prepared = PreparedLog.of(ring, log)
    for warning in prepared.warnings:
        on_note(f"warning: {warning}")
    for note in prepared.notes:
        on_note(note)
    return prepared.log


def no_echo_warning(values: Sequence[NoEchoValue]) -> Implausibility:
    """A warning about ranges that mean no echo."""
    exact = " ".join(f"--no-echo {one.value:.6g}" for one in values if not one.sigma)
    what = f"most sensors read {', '.join(map(str, values))}, wherever the robot is"
    cause = "it probably means no echo, and does not count as one"
    remedy = f"confirm with {exact}" if exact else "let the driver report nothing instead"
    return Implausibility("no-echo value", what, cause, remedy)
