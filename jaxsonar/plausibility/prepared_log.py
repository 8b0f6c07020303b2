"""A log as computations need it: marks for no echo are silent, old readings have an age, single firings are scans."""

from collections.abc import Callable

from jaxsonar.plausibility.held_readings import find_held_readings, with_ages
from jaxsonar.plausibility.implausible_input import implausible_input
from jaxsonar.plausibility.unheard_paths import unheard_warning
from jaxsonar.scans.no_echo_values import find_no_echo_values, without_no_echo_values
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.single_firings import group_firings
from jaxsonar.sensors.ring import Ring


def prepared_log(ring: Ring, log: Log, *, on_note: Callable[[str], None]) -> Log:
    """Prepare a log for detection, maps and poses. A sound log of full scans is returned unchanged.

    - Ranges that mean no echo (``find_no_echo_values``) become silent readings.
    - Firings that are scans of their own are merged into scans (``group_firings``).
    - Readings that repeat the last range because the sensor heard nothing get an age (``find_held_readings``).

    Args:
        ring: the sensors.
        log: the scans, as they were recorded.
        on_note: called with one line for each change; a line that begins with ``warning:`` is about a probable
            mistake: what, likely cause, what to do.
    """
    for text in implausible_input(ring, log):
        on_note(f"warning: {text}")
    if values := find_no_echo_values(log):
        listed = ", ".join(map(str, values))
        exact = " ".join(f"--no-echo {one.value:.6g}" for one in values if not one.sigma)
        remedy = f"confirm with {exact}" if exact else "let the driver report nothing instead"
        cause = "it probably means no echo, and does not count as one"
        on_note(f"warning: most sensors read {listed}, wherever the robot is; {cause}; {remedy}")
        log = without_no_echo_values(log, values)
    if (text := unheard_warning(ring, log)) is not None:
        on_note(f"warning: {text}")
    grouped = group_firings(log)
    if grouped is not log:
        scans = f"{len(grouped)} scan{'s' * (len(grouped) != 1)}"
        on_note(f"{len(log)} scans with one firing each are merged into {scans}")
    if held := find_held_readings(ring, grouped):
        on_note(f"warning: {held.describe()}; each range counts once; let the driver report nothing instead")
    return with_ages(grouped, held)
