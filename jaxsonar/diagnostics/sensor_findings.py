"""Findings about single sensors and the ring, from the measurements of the health check."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.diagnostics.findings import Finding, confidence_of
from jaxsonar.diagnostics.health_report import Health
from jaxsonar.diagnostics.measured_sensors import MeasuredSensors
from jaxsonar.diagnostics.settings import SETTINGS

_FINDINGS = SETTINGS.findings
_ROLES = (
    ("mute", "no other sensor hears it", "check its transmitter and the driver stage, and replace it"),
    ("deaf", "it hears no other sensor", "check its receiver and the amplifier, clean it, and replace it"),
)
"""Cause, meaning and remedy if a sensor has no cross echo as transmitter, as receiver."""
_EXCLUSIVE = frozenset({"dead", "deaf", "mute", "swapped", "stale"})
"""Faults that make findings about offset, rate and direction of the same sensors meaningless."""
_REPLACE = "check its plug, its cable and its membrane, and replace it"


def describe_findings(
    health: Health,
    measured: MeasuredSensors,
    pairs: Int[np.ndarray, " sensors"],
    sigma: float | None,
    faults: Sequence[Finding] = (),
) -> tuple[tuple[str, ...], tuple[Finding, ...]]:
    """A remark for each sensor, and all findings, the most severe first.

    Args:
        health: the measurements.
        measured: what was measured at all.
        pairs: number of direct ranges of each sensor that were compared with the previous scan.
        sigma: standard deviation of the ranges, metres, if it is known.
        faults: findings about the log as a whole, which come first.
    """
    found = [*faults, *_silent_sensors(health, measured), *_exchanged_sensors(health), *_stuck_sensors(health, pairs)]
    excluded = {k for finding in found if finding.cause in _EXCLUSIVE for k in finding.sensors}
    minor = (*_range_offsets(health, sigma), *_weak_or_turned_sensors(health))
    found += [finding for finding in minor if not excluded & set(finding.sensors)]
    found += _ring_findings(health, measured)
    return _remarks(health, found), tuple(found)


def _remarks(health: Health, found: Sequence[Finding]) -> tuple[str, ...]:
    """A short remark for each sensor: the causes of its findings."""

    def remark(finding: Finding, sensor: int) -> str:
        if finding.cause != "swapped":
            return finding.cause
        return f"swapped with {health.place[sensor]}" if len(finding.sensors) == 2 else f"is {health.place[sensor]}"

    return tuple("; ".join(remark(one, k) for one in found if k in one.sensors) for k in range(health.ring.count))


def _silent_sensors(health: Health, measured: MeasuredSensors) -> Iterator[Finding]:
    """Sensors that are dead, deaf (do not receive) or mute (do not transmit).

    If the log does not mark paths that heard nothing, sensors that are never heard are named with both explanations.
    """
    usual = _usual_rates(health)
    echoes = health.direct + health.cross
    others, others_cross = float(np.median(echoes)), float(np.median(health.cross))
    for k in range(health.ring.count):
        expected, detected = health.expected[k], health.heard[k]
        low = _is_low(expected, detected, usual, _FINDINGS.dead_rate)
        few_cross = expected[1:].min() < _FINDINGS.min_expected
        if low[0] and (np.isnan(usual[1]) or low[1:].all() or few_cross):
            amount = "nothing" if detected.sum() == 0 else "hardly anything"
            elsewhere = (
                f", and reports {echoes[k]} echoes elsewhere" if echoes[k] > _FINDINGS.min_elsewhere * others else ""
            )
            yield Finding(
                "dead",
                (k,),
                f"sensor {k} hears {amount}: {detected[0]} of {expected[0]} expected direct echoes, the others "
                f"{100 * usual[0]:.0f} %{elsewhere}",
                *_rate_evidence(expected[0], detected[0], usual[0]),
                _REPLACE,
            )
        elif echoes[k] == 0 and others >= _FINDINGS.min_echoes and (measured.any[k] or not measured.certain):
            doubt = "" if measured.any[k] else "; it is dead, or was not measured"
            yield Finding(
                "dead",
                (k,),
                f"sensor {k} hears nothing: no echo in the log, the others {others:.0f} each{doubt}",
                confidence_of(others) if measured.any[k] else 0.5,
                "a working sensor would have echoes of the walls that its neighbors hear",
                _REPLACE,
            )
        elif _never_in_one_role(measured, k) and others_cross >= _FINDINGS.min_echoes:
            cause, meaning, remedy = _ROLES[int(measured.cross[k, 0])]
            yield Finding(
                cause,
                (k,),
                f"sensor {k} is {cause}, {meaning}: no such echo in the log, unless these paths were not measured",
                0.5,
                "its other echoes are there; the log does not mark paths that heard nothing",
                remedy,
            )
        elif low[1] != low[2] and np.isfinite(usual[1:]).all():
            role = 1 if low[1] else 2
            cause, meaning, remedy = _ROLES[role - 1]
            yield Finding(
                cause,
                (k,),
                f"sensor {k} is {cause}, {meaning}: {detected[role]} of {expected[role]} expected cross echoes, the "
                f"others {100 * usual[role]:.0f} %",
                *_rate_evidence(expected[role], detected[role], usual[role]),
                remedy,
            )


def _rate_evidence(expected: Any, detected: Any, usual: float) -> tuple[float, str]:
    """Confidence that these numbers of echoes do not come from the usual rate, and the evidence as text."""
    p = float(np.clip(usual, 0.01, 0.99))
    own = float(np.clip(detected / max(expected, 1), 1e-3, 1 - 1e-3))
    nats = detected * np.log(own / p) + (expected - detected) * np.log((1 - own) / (1 - p))
    evidence = f"log-likelihood ratio to a sensor with the usual rate {_nats(nats)}"
    return confidence_of(float(nats)), evidence


def _nats(value: float) -> str:
    return f"{value:.0f} nats" if value < 1000 else "over 1000 nats"


def _never_in_one_role(measured: MeasuredSensors, sensor: int) -> bool:
    """Whether the cross echoes of a sensor are all received or all sent, in a log that does not mark silence."""
    sends, receives = measured.cross[sensor]
    return not measured.certain and bool(sends != receives)


def _exchanged_sensors(health: Health) -> Iterator[Finding]:
    """Sensors at each other's positions."""
    for cycle in _cycles(health.place):
        *most, last = [str(k) for k in cycle]
        names = f"{', '.join(most)} and {last}"
        explained = 100 * health.fits[cycle].mean(axis=0)
        better = f"as numbered {explained[0]:.0f} % of their echoes are explained, exchanged {explained[1]:.0f} %"
        evidence = (
            f"the exchange beats the present numbering, and every other exchange, by at least "
            f"{SETTINGS.swaps.min_gain:.0f} nats"
        )
        if len(cycle) == 2:
            sentence, wires = f"sensors {names} look swapped: {better}", "exchange their cables, or their numbers"
        else:
            who = ", ".join(f"{k} is {health.place[k]}" for k in cycle)
            sentence, wires = (
                f"sensors {names} look permuted ({who}): {better}",
                "correct their cables, or their numbers",
            )
        yield Finding("swapped", tuple(cycle), sentence, confidence_of(SETTINGS.swaps.min_gain), evidence, wires)


def _cycles(place: Int[np.ndarray, " sensors"]) -> Iterator[list[int]]:
    """The cycles of a permutation, without fixed points."""
    left = set(np.flatnonzero(place != np.arange(len(place))).tolist())
    while left:
        cycle = [min(left)]
        while (step := int(place[cycle[-1]])) != cycle[0]:
            cycle.append(step)
        left -= set(cycle)
        yield cycle


def _stuck_sensors(health: Health, pairs: Int[np.ndarray, " sensors"]) -> Iterator[Finding]:
    """Sensors that report the same range repeatedly."""
    usual = float(np.nanmedian(health.repeats)) if np.isfinite(health.repeats).any() else 0.0
    usual_constant = _usual_constant_fraction(health)
    for k in range(health.ring.count):
        value, constant = health.constant[k]
        least = max(_FINDINGS.min_repeats, 3 * usual, 0.5 + usual / 2)
        if pairs[k] >= _FINDINGS.min_samples and health.repeats[k] > least:
            yield Finding(
                "stale",
                (k,),
                f"sensor {k} repeats the range of the scan before in {100 * health.repeats[k]:.0f} % of the scans, the "
                f"others in {100 * usual:.0f} %",
                *_rate_evidence(pairs[k], round(health.repeats[k] * pairs[k]), usual),
                "let the driver report a reading only when it is new, or give it an age",
            )
        elif constant > max(_FINDINGS.min_constant, 4 * usual_constant):
            yield Finding(
                "no-echo value",
                (k,),
                f"sensor {k} reports exactly {value:.3f} m in {100 * constant:.0f} % of its direct echoes: is this its "
                f"code for no echo?",
                0.8,
                f"the other sensors report their most frequent range in {100 * usual_constant:.0f} % of their echoes",
                f"let the driver report nothing instead, or name the value with --no-echo {value:.6g}",
            )


def _range_offsets(health: Health, sigma: float | None) -> Iterator[Finding]:
    """Range offsets, the largest first."""
    threshold = max(_FINDINGS.min_offset, sigma if sigma is not None else float(np.nan_to_num(health.sigma)))
    threshold = max(threshold, _FINDINGS.min_offset_from_map) if health.source == "map" else threshold
    size = np.abs(health.offset)
    off = np.flatnonzero((size > 3 * health.offset_error) & (size > threshold))
    for k in off[np.argsort(-size[off], kind="stable")].tolist():
        direction = "much" if health.offset[k] > 0 else "little"
        z = float(size[k] / health.offset_error[k])
        yield Finding(
            "offset",
            (k,),
            f"sensor {k} reports {1e3 * size[k]:.1f} ± {1e3 * health.offset_error[k]:.1f} mm too {direction}, relative "
            f"to the others",
            confidence_of(z**2 / 2 - np.log(health.ring.count)),
            f"the offset is {z:.0f} standard errors, estimated jointly with all other offsets and all walls",
            "calibrate the ring (jaxsonar calibrate), or give the sensor this range_offset",
        )


def _weak_or_turned_sensors(health: Health) -> Iterator[Finding]:
    """Sensors that detect little, or point in another direction."""
    usual = _usual_rates(health)
    for k in range(health.ring.count):
        expected, detected = health.expected[k], health.heard[k]
        if _is_low(expected, detected, usual, _FINDINGS.weak_rate)[0] and expected[0] >= 2 * _FINDINGS.min_expected:
            yield Finding(
                "weak",
                (k,),
                f"sensor {k} hears {detected[0]} of {expected[0]} expected direct echoes, the others "
                f"{100 * usual[0]:.0f} %",
                *_rate_evidence(expected[0], detected[0], usual[0]),
                "clean its membrane, and check what covers it, its supply and its gain",
            )
        turn, error = np.degrees(health.centre[k])
        # Not against a map: its walls end where they were detected.
        if abs(turn) > max(_FINDINGS.min_turn_deg, 4 * error) and health.source == "scans":
            side = "left" if turn > 0 else "right"
            z = float(abs(turn) / error)
            yield Finding(
                "turned",
                (k,),
                f"sensor {k} points {abs(turn):.0f} ± {error:.0f} deg too far to the {side}",
                confidence_of(z**2 / 2 - np.log(health.ring.count)),
                f"the middle of its cone is {z:.0f} standard deviations off its heading",
                "turn the sensor in its mount, or calibrate the ring (jaxsonar calibrate)",
            )


def _ring_findings(health: Health, measured: MeasuredSensors) -> Iterator[Finding]:
    """Findings about the ring as a whole."""
    explained = health.fits[:, 1][np.isfinite(health.fits[:, 1])]
    if health.source == "scans" and len(explained) and np.median(explained) < _FINDINGS.min_explained:
        yield Finding(
            "unexplained echoes",
            (),
            f"walls explain {100 * np.median(explained):.0f} % of the echoes: is it the right ring, are ranges half "
            "path lengths in metres?",
            0.5,
            "",
            "check the ring, the unit of the ranges, and the sensor numbers",
        )
    width, error, nominal = np.degrees([*health.beam, health.nominal])
    if abs(width - nominal) > max(_FINDINGS.min_beam_deg, 3 * error):
        yield Finding(
            "beam width",
            (),
            f"cones are measured {width:.0f} ± {error:.0f} deg wide, the ring has {nominal:.0f} deg",
            confidence_of(((width - nominal) / error) ** 2 / 2),
            f"the difference is {abs(width - nominal) / error:.0f} standard deviations",
            f"set beam_deg = {width:.0f} in the ring",
        )
    usual_constant = _usual_constant_fraction(health)
    if usual_constant > 0.1:
        value = float(np.nanmedian(health.constant[:, 0]))
        yield Finding(
            "no-echo value",
            (),
            f"every sensor reports one range again and again, {value:.3f} m in {100 * usual_constant:.0f} % of its "
            f"echoes",
            0.5,
            "",
            f"if it means no echo, let the driver report nothing, or use --no-echo {value:.6g}",
        )
    all_echoes = int(health.direct.sum() + health.cross.sum() // 2)
    if measured.any_cross and not health.cross.any() and all_echoes:
        yield Finding(
            "unheard paths",
            (),
            f"no cross echo in {health.scans} scans, the ring listens to {health.ring.neighbors} neighbors",
            0.8,
            "",
            "let the device listen to its neighbors, or set neighbors = 0 in the ring",
        )
    in_place = (health.place == np.arange(health.ring.count)).all()
    if health.left_out > max(2, 0.001 * all_echoes) and in_place:
        yield Finding(
            "unused echoes",
            (),
            f"{health.left_out} of {all_echoes} echoes are of pairs of sensors that the ring does not listen to",
            1.0,
            "",
            "set neighbors in the ring to what the device listens to",
        )


def _usual_constant_fraction(health: Health) -> float:
    """Fraction of direct echoes with a sensor's most frequent range, the median over the sensors."""
    known = np.isfinite(health.constant[:, 1])
    return float(np.median(health.constant[known, 1])) if known.any() else 0.0


def _usual_rates(health: Health) -> Float[np.ndarray, " 3"]:
    """Detection rates, the median over the sensors: direct, cross as transmitter, cross as receiver."""
    enough = health.expected >= _FINDINGS.min_expected
    rate = np.where(enough, health.heard / np.maximum(health.expected, 1), np.nan)
    known = [column[np.isfinite(column)] for column in rate.T]
    usual = np.array([np.median(column) if len(column) else np.nan for column in known])
    return np.where(usual > 0.3, usual, np.nan)


def _is_low(
    expected: Int[np.ndarray, " 3"], detected: Int[np.ndarray, " 3"], usual: Float[np.ndarray, " 3"], fraction: float
) -> Bool[np.ndarray, " 3"]:
    """Whether the detection rates are below this fraction of the usual ones, and significantly (4 sigma, binomial)."""
    usual = np.minimum(usual, 0.9)
    sigma = np.sqrt(usual * (1 - usual) * np.maximum(expected, 1))
    enough = expected >= _FINDINGS.min_expected
    return enough & (detected < fraction * usual * expected) & (usual * expected - detected > 4 * sigma)
