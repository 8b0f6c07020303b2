"""A log as computations need it: marks for no echo are silent, old readings have an age, single firings are scans."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from jaxsonar.plausibility.held_readings import find_held_readings, with_ages
from jaxsonar.plausibility.implausibility import Implausibility
from jaxsonar.plausibility.implausible_poses import implausible_poses
from jaxsonar.plausibility.implausible_ring import implausible_ring
from jaxsonar.plausibility.implausible_stamps import implausible_stamps
from jaxsonar.plausibility.odometry_jumps import implausible_odometry
from jaxsonar.plausibility.range_units import find_range_unit
from jaxsonar.plausibility.robot_echoes import find_robot_echoes, without_robot_echoes
from jaxsonar.plausibility.unheard_paths import unheard_warning
from jaxsonar.scans.no_echo_values import NoEchoValue, find_no_echo_values, without_no_echo_values
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.single_firings import group_firings
from jaxsonar.sensors.ring import Ring

_EMPTY = Implausibility(
    "empty log", "the log has no scan", "the recording probably ended before the first scan", "record it again"
)


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
        """Prepare a log and look for mistakes.

        - Ranges that mean no echo (``find_no_echo_values``) become silent readings.
        - Firings that are scans of their own are merged into scans (``group_firings``).
        - Readings that repeat the last range because the sensor heard nothing get an age (``find_held_readings``).
        - Echoes that move with the robot are removed (``find_robot_echoes``).

        A probable mistake in the units or the numbering of a log is reported, but not corrected.

        Args:
            ring: the sensors.
            log: the scans, as they were recorded.
        """
        if not len(log):
            return cls(log, (_EMPTY,), ())
        warnings, notes = [*implausible_stamps(log)], []
        if values := find_no_echo_values(log):
            warnings.append(no_echo_warning(values))
            log = without_no_echo_values(log, values)
        if unheard := unheard_warning(ring, log):
            warnings.append(unheard)
        grouped = group_firings(log)
        if grouped is not log:
            scans = f"{len(grouped)} scan{'s' * (len(grouped) != 1)}"
            notes.append(f"{len(log)} scans with one firing each are merged into {scans}")
        if held := find_held_readings(ring, grouped):
            remedy = "let the driver report nothing instead"
            warnings.append(Implausibility("held readings", held.describe(), "each range counts once", remedy))
        prepared = with_ages(grouped, held)
        if robot := find_robot_echoes(ring, prepared):
            warnings.append(robot.warning())
            prepared = without_robot_echoes(prepared, robot)
        # Nothing is concluded from a ring that is wrong itself, nor from ranges whose unit is unknown.
        if not any(implausible_ring(ring)):
            unit = find_range_unit(ring, prepared)
            if unit:
                warnings.append(unit.implausibility)
            if unit is None or np.isfinite(unit.scale):
                warnings += implausible_poses(ring, unit.corrected(prepared) if unit else prepared)
        # In a wrong unit, ordinary steps look like jumps.
        if not any(one.kind in ("pose unit", "heading unit") for one in warnings):
            warnings += implausible_odometry(ring, prepared)
        return cls(prepared, tuple(warnings), tuple(notes))


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
