"""What is wrong with a ring, in words."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.diagnostics.health_report import Health

LEAST_OFFSET = 0.002
"""Metres; smaller offsets are never suspicious."""
HARDLY = 0.3
"""Share of the echoes of a sensor that walls, corners and edges explain; below, something is wrong altogether."""
FROM_A_MAP = 0.015
"""Metres; the same where walls come from a map: poses and delays of a driving robot err as well."""


class Finding(NamedTuple):
    """One thing that is not as it should be."""

    words: str
    """A sentence."""
    remarks: dict[int, str]
    """A few words for each sensor concerned."""
    spoils: bool = False
    """Whether nothing else is worth saying of these sensors."""


def findings_of(
    health: Health, pairs: Int[np.ndarray, " sensors"], sigma: float | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """A few words for each sensor, and a sentence for each finding, the worst first.

    Args:
        health: what was measured.
        pairs: of each sensor, how many direct ranges could be compared with the scan before.
        sigma: standard deviation of the ranges, metres, if it is known.
    """
    found = [*_silent(health), *_exchanged(health), *_stuck(health, pairs)]
    spoilt = {k for finding in found if finding.spoils for k in finding.remarks}
    doubts = (*_off(health, sigma), *_weak_or_turned(health))
    found += [finding for finding in doubts if not spoilt & set(finding.remarks)]
    found += [Finding(words, {}) for words in _of_the_ring(health)]
    remarks = ["; ".join(f.remarks[k] for f in found if k in f.remarks) for k in range(health.ring.count)]
    return tuple(remarks), tuple(finding.words for finding in found)


def _silent(health: Health) -> Iterator[Finding]:
    """Dead, wholly or by half."""
    usual = _usual_shares(health)
    echoes = health.direct + health.cross
    others = float(np.median(echoes))
    for k in range(health.ring.count):
        expected, heard = health.expected[k], health.heard[k]
        low = _is_low(expected, heard, usual, 0.15)
        if low[0] and (np.isnan(usual[1]) or low[1:].all() or expected[1:].min() < 8):
            word = "nothing" if heard.sum() == 0 else "hardly anything"
            elsewhere = f", and reports {echoes[k]} echoes elsewhere" if echoes[k] > 0.3 * others else ""
            yield Finding(
                f"sensor {k} hears {word}: {heard[0]} of {expected[0]} expected direct echoes, the others "
                f"{100 * usual[0]:.0f} %{elsewhere}",
                {k: "hears no wall" if elsewhere else "dead"},
                spoils=True,
            )
        elif echoes[k] == 0 and others >= 10:
            words = f"sensor {k} hears nothing: no echo in the log, the others {others:.0f} each"
            yield Finding(words, {k: "dead"}, spoils=True)
        elif low[1] != low[2] and np.isfinite(usual[1:]).all():
            side, word, way = (
                (1, "mute", "nobody hears what it sends") if low[1] else (2, "deaf", "it hears nobody else")
            )
            yield Finding(
                f"sensor {k} is {word}: {way}: {heard[side]} of {expected[side]} expected cross echoes, the others "
                f"{100 * usual[side]:.0f} %",
                {k: word},
                spoils=True,
            )


def _exchanged(health: Health) -> Iterator[Finding]:
    """Sensors in each other's places."""
    for cycle in _cycles(health.place):
        *most, last = [str(k) for k in cycle]
        names = f"{', '.join(most)} and {last}"
        fits = 100 * health.fits[cycle].mean(axis=0)
        better = f"as numbered {fits[0]:.0f} % of their echoes are explained, exchanged {fits[1]:.0f} %"
        if len(cycle) == 2:
            a, b = cycle
            yield Finding(f"sensors {names} look swapped: {better}", {a: f"swapped with {b}", b: f"swapped with {a}"})
        else:
            who = ", ".join(f"{k} is {health.place[k]}" for k in cycle)
            remarks = {k: f"is {health.place[k]}" for k in cycle}
            yield Finding(f"sensors {names} look permuted ({who}): {better}", remarks)


def _cycles(place: Int[np.ndarray, " sensors"]) -> Iterator[list[int]]:
    """The sensors that exchanged places among themselves."""
    left = set(np.flatnonzero(place != np.arange(len(place))).tolist())
    while left:
        cycle = [min(left)]
        while (step := int(place[cycle[-1]])) != cycle[0]:
            cycle.append(step)
        left -= set(cycle)
        yield cycle


def _stuck(health: Health, pairs: Int[np.ndarray, " sensors"]) -> Iterator[Finding]:
    """The same range again and again."""
    usual = float(np.nanmedian(health.repeats)) if np.isfinite(health.repeats).any() else 0.0
    usual_constant = _usual_constant(health)
    for k in range(health.ring.count):
        value, constant = health.constant[k]
        if pairs[k] >= 20 and health.repeats[k] > max(0.3, 3 * usual, 0.5 + usual / 2):
            yield Finding(
                f"sensor {k} repeats the range of the scan before in {100 * health.repeats[k]:.0f} % of the scans, the "
                f"others in {100 * usual:.0f} %",
                {k: "stale"},
                spoils=True,
            )
        elif health.direct[k] >= 20 and constant > max(0.25, 4 * usual_constant):
            yield Finding(
                f"sensor {k} reports exactly {value:.3f} m in {100 * constant:.0f} % of its direct echoes: a mark for "
                f"no echo?",
                {k: "saturates"},
            )


def _off(health: Health, sigma: float | None) -> Iterator[Finding]:
    """Range offsets, the largest first."""
    level = max(LEAST_OFFSET, sigma if sigma is not None else float(np.nan_to_num(health.sigma)))
    level = max(level, FROM_A_MAP) if health.source == "map" else level
    size = np.abs(health.offset)
    off = np.flatnonzero((size > 3 * health.offset_error) & (size > level))
    for k in off[np.argsort(-size[off], kind="stable")].tolist():
        way = "much" if health.offset[k] > 0 else "little"
        yield Finding(
            f"sensor {k} reports {1e3 * size[k]:.1f} ± {1e3 * health.offset_error[k]:.1f} mm too {way}, relative to "
            f"the others",
            {k: "offset"},
        )


def _weak_or_turned(health: Health) -> Iterator[Finding]:
    """Sensors that hear little, or look elsewhere."""
    usual = _usual_shares(health)
    for k in range(health.ring.count):
        expected, heard = health.expected[k], health.heard[k]
        if _is_low(expected, heard, usual, 0.6)[0] and expected[0] >= 16:
            yield Finding(
                f"sensor {k} hears {heard[0]} of {expected[0]} expected direct echoes, the others "
                f"{100 * usual[0]:.0f} %",
                {k: "weak"},
            )
        turn, error = np.degrees(health.centre[k])
        if abs(turn) > max(10.0, 4 * error) and health.source == "scans":  # walls of a map end where they were heard
            way = "left" if turn > 0 else "right"
            words = f"sensor {k} looks {abs(turn):.0f} ± {error:.0f} deg too far to the {way}"
            yield Finding(words, {k: "turned"})


def _of_the_ring(health: Health) -> Iterator[str]:
    """Findings about no sensor alone."""
    fits = health.fits[:, 1][np.isfinite(health.fits[:, 1])]
    if health.source == "scans" and len(fits) and np.median(fits) < HARDLY:
        yield (
            f"walls explain {100 * np.median(fits):.0f} % of the echoes: is it the right ring, are ranges half path "
            "lengths in metres?"
        )
    width, error, nominal = np.degrees([*health.beam, health.nominal])
    if abs(width - nominal) > max(5.0, 3 * error):
        yield f"cones look {width:.0f} ± {error:.0f} deg wide, the ring says {nominal:.0f} deg"
    usual_constant = _usual_constant(health)
    if usual_constant > 0.1:
        value = float(np.median(health.constant[health.direct >= 20, 0]))
        yield (
            f"every sensor reports one range again and again, {value:.3f} m in {100 * usual_constant:.0f} % of its "
            f"echoes"
        )
    everything = int(health.direct.sum() + health.cross.sum() // 2)
    if health.ring.neighbors and not health.cross.any() and everything:
        yield f"no cross echo in {health.scans} scans, the ring listens to {health.ring.neighbors} neighbors"
    in_place = (health.place == np.arange(health.ring.count)).all()
    if health.left_out > max(2, 0.001 * everything) and in_place:
        yield f"{health.left_out} of {everything} echoes are of pairs of sensors that the ring does not listen to"


def _usual_constant(health: Health) -> float:
    """Share of direct echoes with a sensor's most frequent range, the median over the sensors."""
    many = health.direct >= 20
    return float(np.median(health.constant[many, 1])) if many.any() else 0.0


def _usual_shares(health: Health) -> Float[np.ndarray, " 3"]:
    """Share heard of what was expected, the median over the sensors: direct, as transmitter, as receiver."""
    share = np.where(health.expected >= 8, health.heard / np.maximum(health.expected, 1), np.nan)
    known = [column[np.isfinite(column)] for column in share.T]
    usual = np.array([np.median(column) if len(column) else np.nan for column in known])
    return np.where(usual > 0.3, usual, np.nan)


def _is_low(
    expected: Int[np.ndarray, " 3"], heard: Int[np.ndarray, " 3"], usual: Float[np.ndarray, " 3"], part: float
) -> Bool[np.ndarray, " 3"]:
    """Where far less than usual is heard, and not by chance: direct, as transmitter, as receiver."""
    usual = np.minimum(usual, 0.9)
    by_chance = np.sqrt(usual * (1 - usual) * np.maximum(expected, 1))
    return (expected >= 8) & (heard < part * usual * expected) & (usual * expected - heard > 4 * by_chance)
