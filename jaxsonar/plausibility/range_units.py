"""The unit of the ranges of a log: half path lengths in metres, or what a driver reports instead."""

from dataclasses import dataclass, replace

import numpy as np

from jaxsonar.hardware.messages import REFERENCE_SPEED_OF_SOUND
from jaxsonar.plausibility.alternatives import best_alternative
from jaxsonar.plausibility.implausibility import Implausibility
from jaxsonar.plausibility.pose_agreement import Agreement, agreement, gain, part_of_groups, select_groups
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class RangeUnitSettings:
    """When ranges have another unit. Chosen by hand on simulated rooms."""

    least_echoes: int = 20
    """Logs with fewer echoes give no warning about their ranges."""
    beyond: float = 0.8
    """Share of the echoes beyond the maximum range of the ring that is implausible without further evidence. In a large
    hall, half of them may be."""
    fits: float = 0.95
    """Share of the echoes that must be within the maximum range in the right unit."""
    too_near: float = 0.035
    """No sensor has nearly all of its echoes below this range, metres: the share ``fits``."""
    nearest: float = 0.05
    """In the right unit, the farthest echoes are at least this far away, metres."""
    farther: float = 2.0
    """In the right unit, the same share is within this many maximum ranges, for poses to tell units apart; ..."""
    usual: float = 0.25
    """... without poses, it is within the maximum range and fills this share of it, or within ..."""
    slightly: float = 1.5
    """... this many maximum ranges."""
    reach: float = 4.0
    """Ranges up to this many times the maximum range are compared with the poses as they are."""
    alternative: float = 0.1
    """Other mistakes that explain at least as much as the unit, less this share, are preferred to a unit whose ranges
    are within the maximum range."""
    driven: float = 0.25
    """Scans are compared with poses that the robot drives over this distance at least, metres."""
    most_echoes: int = 40
    """As many echoes of a scan are compared with poses."""
    gain: float = 0.1
    """The right unit explains at least this much more of the echoes than the given one, ..."""
    sigmas: float = 4.0
    """... and this many standard errors, ..."""
    share: float = 0.5
    """... and at least this share, ..."""
    above_chance: float = 0.2
    """... and this much more than chance."""


SETTINGS = RangeUnitSettings()

_TIME_OF_FLIGHT = REFERENCE_SPEED_OF_SOUND / 2
_UNITS = (
    (1000.0, "kilometres"),
    (_TIME_OF_FLIGHT, "times of flight in seconds"),
    (2.0, "half path lengths that were halved again"),
    (0.5, "lengths of the round trip, out and back"),
    (0.3048, "feet"),
    (1e-3 * _TIME_OF_FLIGHT, "times of flight in milliseconds"),
    (0.0254, "inches"),
    (0.01, "centimetres"),
    (0.001, "millimetres"),
    (1e-6 * _TIME_OF_FLIGHT, "times of flight in microseconds"),
    (1e-9 * _TIME_OF_FLIGHT, "times of flight in nanoseconds"),
)
"""Metres per unit, and its name, from the largest one."""
_ROUND_TRIP = 0.5
_HALVED = 2.0


@dataclass(frozen=True)
class RangeUnit:
    """A unit that the ranges of a log have instead of metres."""

    scale: float
    """Metres per unit; NaN if no unit fits."""
    share: float
    """Share of the echoes that agree with the poses in this unit; NaN if unknown."""
    implausibility: Implausibility
    """The mistake in words."""

    def corrected(self, log: Log) -> Log:
        """The log with ranges in metres; unchanged if no unit fits."""
        return replace(log, range=log.range * self.scale) if np.isfinite(self.scale) else log


def find_range_unit(ring: Ring, log: Log) -> RangeUnit | None:
    """The unit of the ranges if it is not metres; None if nothing speaks against metres.

    Most echoes beyond the maximum range of the ring, or at no distance at all, show another unit. Where the log has
    poses, they decide between units, and they show a wrong unit whose ranges are within the maximum range.

    Args:
        ring: the sensors.
        log: the scans.
    """
    distance = log.range[np.isfinite(log.range)] * float(ring.speed_of_sound / REFERENCE_SPEED_OF_SOUND)
    if len(distance) < SETTINGS.least_echoes:
        return None
    beyond = float(np.mean(distance > ring.max_range))
    most = float(np.quantile(distance, SETTINGS.fits))
    candidates = [unit for unit in _UNITS if SETTINGS.nearest <= most * unit[0] <= SETTINGS.farther * ring.max_range]
    if most < SETTINGS.too_near:
        what = f"{SETTINGS.fits:.0%} of the echoes are nearer than {most * 1000:.2g} mm"
        candidates = [unit for unit in candidates if unit[0] > _HALVED]
    elif beyond > SETTINGS.beyond:
        what = f"{beyond:.0%} of the echoes are beyond the maximum range of the ring, {ring.max_range:g} m"
        candidates = [unit for unit in candidates if unit[0] < 1]
    else:
        # Units whose values can be within the maximum range.
        least = min(_ROUND_TRIP, 0.3 / most)
        candidates = [unit for unit in candidates if least <= unit[0] <= _ROUND_TRIP or unit[0] == _HALVED]
        best = _best_by_poses(ring, log, most, candidates)
        if best is None or best.scale == 1.0:
            return None
        # Wrong poses or numbers of sensors look like a wrong unit; the one that explains clearly more is the mistake.
        other = best_alternative(ring, log)
        return best if other is None or other.corrected.share < best.share - SETTINGS.alternative else None
    found = _best_by_poses(ring, log, most, candidates)
    if found is not None and found.scale == 1.0:
        cause = "the poses agree with metres, so the maximum range of the ring is too small"
        return RangeUnit(np.nan, np.nan, Implausibility("range unit", what, cause, "set max_range in the ring"))
    if found is not None:
        return RangeUnit(found.scale, found.share, replace(found.implausibility, what=what))
    if not candidates:
        cause = "the ranges have another unit, or the ring is another one"
        return RangeUnit(np.nan, np.nan, Implausibility("range unit", what, cause, "give half path lengths in metres"))
    scale, name = _by_reach(most / ring.max_range, candidates)
    cause = f"the ranges are probably {name}, or the ring is another one"
    return RangeUnit(scale, np.nan, Implausibility("range unit", what, cause, _remedy(scale)))


def _by_reach(most: float, candidates: list[tuple[float, str]]) -> tuple[float, str]:
    """The unit in which most ranges are within the maximum range and fill it.

    Args:
        most: range that hardly any echo exceeds, in the unit of the log, divided by the maximum range.
        candidates: units, from the largest one.
    """
    within = [unit for unit in candidates if most * unit[0] <= 1.02]
    beyond = [unit for unit in candidates if 1.02 < most * unit[0] <= SETTINGS.slightly]
    if beyond and not (within and most * within[0][0] >= SETTINGS.usual):
        return beyond[-1]
    return (within or candidates)[0]


def _best_by_poses(ring: Ring, log: Log, most: float, candidates: list[tuple[float, str]]) -> RangeUnit | None:
    """The unit with which the poses agree best and clearly; None if there is none. Metres have the scale 1.

    Args:
        ring: the sensors.
        log: the scans.
        most: range that hardly any echo exceeds, in the unit of the log.
        candidates: units that are compared with metres.
    """
    # A robot that only turns does not show the scale of the ranges.
    groups = [one for one in select_groups(log) if np.ptp(log.pose[one, :2], axis=0).max() >= SETTINGS.driven]
    if not groups or not candidates:
        return None
    log, groups = part_of_groups(log, groups, most_echoes=SETTINGS.most_echoes)
    given = None
    if most <= SETTINGS.reach * ring.max_range and most >= SETTINGS.nearest:
        # With a larger maximum range, so that the same echoes are compared.
        wide = replace(ring, max_range=min(max(most * 1.02, ring.max_range), 100.0))
        given = agreement(wide, log, groups)
    reach = max(ring.max_range, *(most * scale * 1.02 for scale, _ in candidates))
    ring = replace(ring, max_range=min(reach, 100.0))
    others = [agreement(ring, replace(log, range=log.range * scale), groups) for scale, _ in candidates]
    # In too small a unit, all echoes are beside the robot, where they agree by chance.
    index = int(np.argmax([other.share - other.chance for other in others]))
    (scale, name), best = candidates[index], others[index]
    if given is not None and _is_clear(given) and given.share - given.chance >= best.share - best.chance:
        return RangeUnit(1.0, given.share, Implausibility("range unit", "", "", ""))
    if not _is_clear(best):
        return None
    what = f"{best.share:.0%} of the echoes agree with the poses"
    if given is not None:
        more = gain(given, best)
        if more.share < SETTINGS.gain or max(more.z, more.support_z) < SETTINGS.sigmas:
            return None
        what = f"only {given.share:.0%} of the echoes agree with the poses if ranges are metres"
        cause = f"the ranges are probably {name}, with which {best.share:.0%} agree"
    else:
        cause = f"the ranges are probably {name}, with which {best.share:.0%} agree with the poses"
    return RangeUnit(scale, best.share, Implausibility("range unit", what, cause, _remedy(scale)))


def _is_clear(one: Agreement) -> bool:
    """Whether poses explain echoes, and not by chance."""
    return one.share >= SETTINGS.share and one.share >= one.chance + SETTINGS.above_chance


def _remedy(scale: float) -> str:
    """What to do about ranges in a unit of this many metres."""
    if scale == _HALVED:
        return "give half path lengths in metres: multiply the ranges by 2"
    if scale == _ROUND_TRIP:
        return "give half path lengths in metres: divide the ranges by 2"
    action = f"multiply by {scale:.6g}" if scale not in (0.01, 0.001) else f"divide by {1 / scale:g}"
    return f"give half path lengths in metres: {action}"
