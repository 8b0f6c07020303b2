"""Mistakes in what a ring or a log is said to be: numbering and mounting of the sensors, headings, axes.

All sensors keep their numbers, so that findings about single sensors hold for the log: a wrong numbering is described
by a ring whose sensors stand elsewhere.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from jaxsonar.geometry.se2 import rotate
from jaxsonar.plausibility.corrections import axis_corrections, heading_corrections, pose_unit_corrections
from jaxsonar.plausibility.pose_agreement import Agreement, agreement, gain, part_of_groups
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class DescriptionSettings:
    """When another description of a log is right. Chosen by hand on random rooms of the simulator."""

    most_echoes: int = 48
    """Echoes of a scan that are compared, chosen at random."""
    screen_groups: int = 5
    """Groups of scans with which all descriptions are compared first, ..."""
    finalists: int = 4
    """... and number of descriptions that are then compared with all groups."""
    min_echoes: int = 60
    """Echoes that a comparison needs."""
    min_gain: float = 0.04
    """Least gain in the mean support of the echoes, ..."""
    min_z: float = 3.0
    """... in standard errors, ..."""
    max_loss: float = 0.02
    """... and largest loss in the share of explained echoes."""


SETTINGS = DescriptionSettings()


@dataclass(frozen=True, eq=False)
class Description:
    """A mistake, and the ring without it."""

    cause: str
    """Cause of the finding."""
    mistake: str
    """The mistake in words."""
    remedy: str
    """What to do."""
    ring: Ring
    """The true ring."""
    apply: Callable[[Log], Log]
    """Gives the true log, with the same scans and readings."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """The description that explains most, compared with the given one and with the next best one."""

    best: Description
    given: Agreement
    """Agreement of the log as it is."""
    result: Agreement
    """Agreement of the best description."""
    second: str
    """The next best mistake in words; empty if the given description is the next best one."""
    second_support: float
    """Mean support of the next best description."""
    z: float
    """How much better the best one is than the next best one, standard errors."""


def mean_support(ring: Ring, log: Log, groups: Sequence[Int[np.ndarray, "_"]]) -> float:
    """The mean support of some echoes of each scan, the same ones for every description of a log."""
    part = part_of_groups(log, groups, most_echoes=SETTINGS.most_echoes)
    return agreement(ring, *part, support_only=True).mean_support


def _agreement(ring: Ring, log: Log, groups: Sequence[Int[np.ndarray, "_"]]) -> Agreement:
    """The agreement of the same echoes."""
    return agreement(ring, *part_of_groups(log, groups, most_echoes=SETTINGS.most_echoes))


def best_description(ring: Ring, log: Log, groups: Sequence[Int[np.ndarray, "_"]]) -> Comparison | None:
    """The description with which the echoes agree clearly better than with the given one; None if there is none.

    Args:
        ring: the sensors.
        log: the scans.
        groups: rows of the scans that are compared (``pose_agreement.select_groups``).
    """
    given = _agreement(ring, log, groups)
    if given.echoes < SETTINGS.min_echoes:
        return None
    some = np.unique(np.linspace(0, len(groups) - 1, min(len(groups), SETTINGS.screen_groups)).astype(int))
    screen = [groups[k] for k in some]

    def screened(one: Description) -> float:
        return mean_support(one.ring, one.apply(log), screen)

    finalists = sorted(_descriptions(ring, log), key=screened, reverse=True)[: SETTINGS.finalists]
    results = sorted(
        ((one, _agreement(one.ring, one.apply(log), groups)) for one in finalists), key=lambda one: -one[1].mean_support
    )
    best, result = results[0]
    more = gain(given, result)
    if more.support < SETTINGS.min_gain or more.support_z < SETTINGS.min_z or more.share < -SETTINGS.max_loss:
        return None
    rivals = [(one.mistake, other) for one, other in results if one.cause != best.cause]
    second, next_best = max([("", given), *rivals], key=lambda one: one[1].mean_support)
    return Comparison(best, given, result, second, next_best.mean_support, gain(next_best, result).support_z)


def _descriptions(ring: Ring, log: Log) -> Iterator[Description]:
    for one in (*heading_corrections(), *axis_corrections(), *pose_unit_corrections(log)):
        cause = "headings" if one.kind.startswith("heading") else one.kind
        yield Description(cause, one.mistake, one.remedy, ring, one.apply)
    yield from _mounted(ring)
    if not _is_regular(ring):
        yield from _numbered(ring)


def _mounted(ring: Ring) -> Iterator[Description]:
    """Mirrored and rotated rings."""
    position, heading = np.asarray(ring.position), np.asarray(ring.heading)
    yield Description(
        "mirrored ring",
        "the ring is mirrored: its sensors are numbered the other way round",
        "number the sensors counter-clockwise, as the ring does, or mirror the ring's sensors (negate y and heading)",
        replace(ring, position=position * [1, -1], heading=-heading),
        _unchanged,
    )
    spacing = 2 * np.pi / ring.count
    angles = {round(np.degrees(k * spacing), 6) for k in range(1, ring.count)} | {90.0, 180.0, 270.0}
    for angle in sorted(angles):
        signed = angle if angle <= 180 else angle - 360
        turn = np.radians(signed)
        sensors = round(turn / spacing)
        exact = _is_regular(ring) and np.isclose(sensors * spacing, turn)
        steps = f", by {abs(sensors)} sensor{'s' * (abs(sensors) != 1)}" if exact else ""
        side = "counter-clockwise" if signed > 0 else "clockwise"
        yield Description(
            "rotated ring",
            f"the ring is mounted {abs(signed):g} deg too far {side}{steps}",
            f"rotate the ring's sensors by {signed:g} deg (first_heading_deg), or turn the axes of the poses",
            replace(ring, position=rotate(position, np.array(turn)), heading=heading + turn),
            _unchanged,
        )


def _numbered(ring: Ring) -> Iterator[Description]:
    """Other numberings of sensors that are not evenly spaced; those of an even ring are rotations."""
    numbers = np.arange(ring.count)
    for direction, cause in ((1, "rotated ring"), (-1, "mirrored ring")):
        for shift in range(ring.count):
            place = (direction * numbers + shift) % ring.count
            if direction == 1 and shift == 0:
                continue
            way = "" if direction == 1 else "the other way round, "
            changed = replace(
                ring,
                position=np.asarray(ring.position)[place],
                heading=np.asarray(ring.heading)[place],
                beam=np.asarray(ring.beam)[place],
                range_offset=np.asarray(ring.range_offset)[place],
            )
            mistake = f"the sensors are numbered {way}from another one: number 0 is sensor {place[0]} of the ring"
            yield Description(cause, mistake, "number the sensors as the ring does", changed, _unchanged)


def _unchanged(log: Log) -> Log:
    return log


def _is_regular(ring: Ring) -> bool:
    """Whether the sensors stand evenly spaced on a circle, in order."""
    position, heading = np.asarray(ring.position), np.asarray(ring.heading)
    turn = 2 * np.pi / ring.count
    same = np.allclose(rotate(position, np.array(turn)), np.roll(position, -1, axis=0), atol=1e-3)
    return bool(same and np.allclose(np.exp(1j * (heading + turn)), np.exp(1j * np.roll(heading, -1)), atol=1e-3))
