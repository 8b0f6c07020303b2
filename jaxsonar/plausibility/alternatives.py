"""Other descriptions of a log with which its echoes may agree better: units, headings, axes, numbering of the sensors.

Each alternative undoes one mistake, or the units of positions and headings at once. The true description of a log
agrees better with its echoes than any wrong one (``pose_agreement``). An alternative that agrees clearly better
therefore shows the mistake.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from jaxsonar.plausibility.corrections import (
    Correction,
    axis_corrections,
    heading_corrections,
    pose_unit_corrections,
    renumbering,
    turned_rings,
)
from jaxsonar.plausibility.implausibility import Implausibility
from jaxsonar.plausibility.pose_agreement import (
    Agreement,
    Gain,
    agreement,
    bounded,
    gain,
    part_of_groups,
    select_groups,
)
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class AlternativeSettings:
    """When an alternative is right. Chosen by hand on 70 simulated logs; no alternative of a true log gained 0.005."""

    gain: float = 0.02
    """Least gain in the mean support of the echoes."""
    z: float = 3.5
    """Least gain in standard errors."""
    turned: float = 0.1
    """A turned ring gains at least this share of what the given description lacks: late poses of a robot that turns
    look like a slightly turned ring."""
    tie: float = 2.0
    """An alternative that is worse than the best one by less than this many standard errors may be true, too, ..."""
    tie_margin: float = 0.01
    """... if it is also worse by less than this."""
    above_chance: float = 0.3
    """The alternative explains at least this share of the echoes more than chance. Then it is no accident among wrong
    descriptions."""
    least_echoes: int = 30
    """With fewer compared echoes, nothing is stated."""
    screen_groups: int = 4
    """Groups of scans with which all alternatives are compared first."""
    finalists: int = 6
    """Alternatives that are then compared with all groups, ..."""
    of_a_kind: int = 2
    """... and as many of them of one kind."""
    most_echoes: int = 32
    """Echoes of a scan that are compared."""
    shifts: int = 16
    """Shifts of the numbering that are tried first in larger rings, before those near the best one."""
    rounds: int = 2
    """Mistakes that are looked for one after the other."""


SETTINGS = AlternativeSettings()


@dataclass(frozen=True)
class Alternative:
    """A description of a log with which its echoes agree better than with the given one."""

    corrections: tuple[Correction, ...]
    """The mistakes; one as a rule."""
    given: Agreement
    """Agreement of echoes of the log as it is. The rows are those of a part of the log."""
    corrected: Agreement
    """Agreement of echoes of the corrected log."""
    gain: Gain
    """The difference."""
    ties: tuple[Correction, ...]
    """Single mistakes of other kinds that explain the echoes as well."""
    second: str
    """The next best mistake of another kind in words; empty if the given description is better."""
    second_support: float
    """Mean support of the echoes with it."""
    second_z: float
    """Gain over it in standard errors."""

    @property
    def kind(self) -> str:
        """Kind of the first mistake, as in ``Implausibility``."""
        return self.corrections[0].kind

    @property
    def mistake(self) -> str:
        """The mistakes in words, such as "the headings are in degrees"."""
        return " and ".join(one.mistake for one in self.corrections)

    def apply(self, log: Log) -> Log:
        """The corrected log; it has the same scans and readings in the same order."""
        for correction in self.corrections:
            log = correction.apply(log)
        return log

    def describe(self, ring: Ring, log: Log) -> tuple[Ring, Log]:
        """The corrected ring and log; the sensors keep the numbers of the log."""
        for correction in self.corrections:
            ring, log = correction.describe(ring, log)
        return ring, log

    def implausibilities(self) -> Iterator[Implausibility]:
        """The mistakes in words."""
        what = f"an echo is confirmed by only {self.given.mean_support:.0%} of the scans around it"
        for one in self.corrections:
            others = [*one.equivalents, *(tie.mistake for tie in self.ties)]
            cause = f"probably {self.mistake} (then by {self.corrected.mean_support:.0%})"
            yield Implausibility(one.kind, what, ", or ".join([cause, *others]), one.remedy)


def find_mistakes(ring: Ring, log: Log) -> list[Alternative]:
    """Mistakes in poses and numbering, one after the other: each holds for the log corrected by those before it.

    Args:
        ring: the sensors.
        log: the scans; ranges in metres.
    """
    found: list[Alternative] = []
    while len(found) < SETTINGS.rounds and (one := best_alternative(ring, log)):
        if one.kind in {earlier.kind for earlier in found}:
            break
        found.append(one)
        log = one.apply(log)
    return found


def best_alternative(ring: Ring, log: Log) -> Alternative | None:
    """The description of a log with which its echoes agree clearly better than with the given one; None: there is none.

    All alternatives are compared on few scans, and the best ones on more.

    Args:
        ring: the sensors.
        log: the scans; ranges in metres.
    """
    comparison = _Comparison(ring, log)
    given = comparison.full(())
    if given.echoes < SETTINGS.least_echoes:
        return None
    candidates = _candidates(comparison)
    results = [(one, comparison.full(one, support_only=True)) for one in _finalists(comparison, candidates)]
    best, agreed = max(results, key=lambda one: one[1].mean_support)
    ties = [(one, other) for one, other in results if _ties(agreed, other)]
    # Of two descriptions that agree as well, the one with fewer mistakes, or the more common one.
    different = [one for one in ties if [c.kind for c in one[0]] != [c.kind for c in best]]
    rank = {one: (len(one), k) for k, one in enumerate(candidates)}
    best, _ = min([(best, agreed), *different], key=lambda one: rank[one[0]])
    agreed = comparison.full(best)
    more = gain(given, agreed)
    if more.support < SETTINGS.gain or more.support_z < SETTINGS.z or agreed.echoes < SETTINGS.least_echoes:
        return None
    if agreed.share < agreed.chance + SETTINGS.above_chance:
        return None
    if best[0].kind == "first sensor" and more.support < SETTINGS.turned * (1 - given.mean_support):
        return None
    kinds = {one.kind for one in best}
    others = {one[0].kind: one[0] for one, _ in reversed(ties) if len(one) == 1 and one[0].kind not in kinds}
    rivals = [
        (" and ".join(c.mistake for c in one), other) for one, other in results if not kinds & {c.kind for c in one}
    ]
    second, agrees = max([("", given), *rivals], key=lambda one: one[1].mean_support)
    lead = gain(agrees, agreed).support_z
    return Alternative(best, given, agreed, more, tuple(others.values()), second, agrees.mean_support, lead)


class _Comparison:
    """Agreement of a log after corrections, on few groups of scans and on all of them."""

    def __init__(self, ring: Ring, log: Log):
        self.ring = ring
        self.log = log
        self._parts: dict[str, tuple[tuple[Log, list[np.ndarray]], ...]] = {}
        self._screened: dict[tuple[Correction, ...], float] = {}

    def screen(self, corrections: tuple[Correction, ...]) -> float:
        """Mean support on few groups."""
        if corrections not in self._screened:
            self._screened[corrections] = self._agreement(corrections, 0, support_only=True).mean_support
        return self._screened[corrections]

    def full(self, corrections: tuple[Correction, ...], *, support_only: bool = False) -> Agreement:
        """Agreement on all groups."""
        return self._agreement(corrections, 1, support_only=support_only)

    def _agreement(self, corrections: tuple[Correction, ...], which: int, *, support_only: bool) -> Agreement:
        # Positions in another unit bring other scans close together.
        unit = next((one for one in corrections if one.kind == "pose unit"), None)
        key = "" if unit is None else unit.mistake
        if key not in self._parts:
            scaled = self.log if unit is None else unit.apply(self.log)
            groups = select_groups(scaled)
            few = _moving_groups(scaled, groups)
            limits = {"most_echoes": SETTINGS.most_echoes}
            self._parts[key] = tuple(part_of_groups(self.log, one, **limits) for one in (few, groups))
        log, groups = self._parts[key][which]
        for one in corrections:
            log = one.apply(log)
        return agreement(self.ring, log, groups, support_only=support_only)


def _moving_groups(log: Log, groups: list[Int[np.ndarray, "_"]]) -> list[Int[np.ndarray, "_"]]:
    """Few groups in which the robot both drives and turns: most mistakes show only there."""

    def motion(group: Int[np.ndarray, "_"]) -> float:
        steps = np.abs(np.diff(bounded(log.pose[group]), axis=0))
        length, turn = np.hypot(steps[:, 0], steps[:, 1]).sum(), np.abs(np.sin(steps[:, 2])).sum()
        return float(min(length, 1.0) + min(turn, 1.0) + min(length * turn, 1.0))

    most = sorted(range(len(groups)), key=lambda k: -motion(groups[k]))[: SETTINGS.screen_groups]
    return [groups[k] for k in sorted(most)]


def _candidates(comparison: _Comparison) -> list[tuple[Correction, ...]]:
    """All alternatives, common mistakes first."""
    ring, log = comparison.ring, comparison.log
    headings = heading_corrections()
    clockwise, from_one = renumbering(ring, 0, clockwise=True), renumbering(ring, ring.count - 1, clockwise=False)
    common = [*headings, clockwise, from_one] if ring.count > 2 else headings
    candidates = [(one,) for one in [*common, *axis_corrections(), *turned_rings(ring), *_renumberings(comparison)]]
    units = pose_unit_corrections(log)
    candidates += [(unit,) for unit in units] + [(unit, heading) for unit in units for heading in headings]
    if ring.count > 2:  # in a wrong unit, nothing else agrees
        candidates += [(one, clockwise) for one in [*units, *headings] if one.kind.endswith("unit")]
    return candidates


def _renumberings(comparison: _Comparison) -> list[Correction]:
    """Other numberings of the sensors: from another first one, counter-clockwise or clockwise.

    In large rings, every few shifts are screened first, and then those near the best one. Those of ``_candidates`` are
    left out.
    """
    ring, found = comparison.ring, []
    stride = -(-ring.count // SETTINGS.shifts)
    for clockwise in (False, True):
        if ring.count < 3:
            continue
        last = ring.count - 1 if clockwise else ring.count - 2
        near = {1, last, *range(1, last, stride)}
        shifts = {k: renumbering(ring, k, clockwise=clockwise) for k in sorted(near)}
        best = max(shifts, key=lambda k: comparison.screen((shifts[k],)))
        for k in range(best - stride + 1, best + stride):
            if 1 <= k <= last and k not in shifts:
                shifts[k] = renumbering(ring, k, clockwise=clockwise)
        found += shifts.values()
    return found


def _finalists(comparison: _Comparison, candidates: list[tuple[Correction, ...]]) -> list[tuple[Correction, ...]]:
    """The alternatives with the largest support on few groups, in the order of the candidates."""
    chosen, kinds = [], []
    for one in sorted(candidates, key=lambda one: -comparison.screen(one)):
        kind = tuple(c.kind for c in one)
        if kinds.count(kind) < SETTINGS.of_a_kind:
            chosen.append(one)
            kinds.append(kind)
        if len(chosen) == SETTINGS.finalists:
            break
    return [one for one in candidates if one in chosen]


def _ties(best: Agreement, other: Agreement) -> bool:
    """Whether an alternative that agrees less well than the best one may be true, too."""
    less = gain(other, best)
    return less.support < min(SETTINGS.tie_margin, SETTINGS.tie * less.support_sigma)
