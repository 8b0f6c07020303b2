"""Findings about single sensors and the ring, from the measurements of the health check."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.diagnostics.cross_counts import one_sided_sensors
from jaxsonar.diagnostics.findings import Finding, GradedFinding, confidence_of
from jaxsonar.diagnostics.health_report import Health
from jaxsonar.diagnostics.measured_sensors import MeasuredSensors
from jaxsonar.diagnostics.sensor_alternatives import SensorAlternative, explained_otherwise
from jaxsonar.diagnostics.settings import SETTINGS
from jaxsonar.geometry.robust_statistics import robust_deviation
from jaxsonar.sensors.ring import Ring

_FINDINGS = SETTINGS.findings
_ROLES = (
    ("mute", "no other sensor hears it", "check its transmitter and the driver stage, and replace it"),
    ("deaf", "it hears no other sensor", "check its receiver and the amplifier, clean it, and replace it"),
)
"""Cause, meaning and remedy if a sensor has no cross echo as transmitter, as receiver."""
_REPLACE = "check its plug, its cable and its membrane, and replace it"


class SensorEvidence(NamedTuple):
    """Measurements of the sensors that ``Health`` does not hold."""

    pairs: Int[np.ndarray, " sensors"]
    """Number of direct ranges of each sensor that were compared with the previous scan."""
    without_worst: Int[np.ndarray, "sensors 2"]
    """``SensorMeasurements.without_worst``."""
    turn_nats: Float[np.ndarray, " sensors"]
    """Log-likelihood ratio of the measured direction of each cone to its heading."""
    cross: Int[np.ndarray, "sensors sensors"]
    """``cross_counts``."""
    faced: Int[np.ndarray, " sensors"]
    """Expected direct echoes of walls well inside the cone, also of sensors that the log never measured."""
    alternatives: dict[int, SensorAlternative | None] | None = None
    """``Comparison.alternatives`` by sensor; None if they were not compared."""


def sensor_findings(
    health: Health, measured: MeasuredSensors, evidence: SensorEvidence, sigma: float | None, known: set[int]
) -> list[GradedFinding]:
    """Faults of single sensors that the walls show, the most certain first; at most one for each sensor.

    Args:
        health: the measurements.
        measured: what was measured at all.
        evidence: more measurements.
        sigma: standard deviation of the ranges, metres, if it is known.
        known: sensors whose fault is known already.
    """
    found: list[GradedFinding] = []
    # What explains the others comes first: an offset or a rotation explains missing echoes, not the other way round.
    if evidence.alternatives is None:
        candidates = (
            *_range_offsets(health, sigma),
            *_turned_sensors(health, evidence),
            *_silent_sensors(health, measured, evidence),
            *_weak_sensors(health, evidence),
        )
    else:
        silent = [
            one for one in _silent_sensors(health, measured, evidence) if health.direct[one.finding.sensors[0]] == 0
        ]
        candidates = (*silent, *explained_otherwise(evidence.alternatives), *_range_offsets(health, sigma))
    for one in candidates:
        if not known & set(one.finding.sensors):
            known = known | set(one.finding.sensors)
            found.append(one)
    return sorted(found, key=lambda one: -one.nats)


def plain_findings(
    health: Health, measured: MeasuredSensors, evidence: SensorEvidence, faults: Sequence[Finding]
) -> list[Finding]:
    """Findings that need no walls, and exchanged sensors; the given ones about the log as a whole come first."""
    found = [*faults, *_exchanged_sensors(health)]
    named = {k for one in faults for k in one.sensors}
    for one in (*_stuck_sensors(health, evidence.pairs), *_one_sided_sensors(measured, evidence)):
        if not named & set(one.sensors):
            named |= set(one.sensors)
            found.append(one)
    return found


def described(health: Health, measured: MeasuredSensors, found: Sequence[Finding], common: int) -> Health:
    """The health with these findings, those about the ring as a whole, and remarks for each sensor.

    Args:
        health: the measurements.
        measured: what was measured at all.
        found: the findings.
        common: number of findings at the beginning that come before the width of the cones.
    """
    found = [*found[:common], *_beam_width(health), *found[common:], *_ring_findings(health, measured, found)]
    dead = {k for one in found if one.cause == "dead" for k in one.sensors}
    return replace(
        health, remarks=_remarks(health, found), findings=tuple(found), unmeasured=measured.unmeasured_without(dead)
    )


def _remarks(health: Health, found: Sequence[Finding]) -> tuple[str, ...]:
    """A short remark for each sensor: the causes of its findings."""

    def remark(finding: Finding, sensor: int) -> str:
        if finding.cause != "swapped":
            return finding.cause
        return f"swapped with {health.place[sensor]}" if len(finding.sensors) == 2 else f"is {health.place[sensor]}"

    return tuple("; ".join(remark(one, k) for one in found if k in one.sensors) for k in range(health.ring.count))


def _silent_sensors(health: Health, measured: MeasuredSensors, evidence: SensorEvidence) -> Iterator[GradedFinding]:
    """Sensors that hear nothing, or nothing of the walls.

    If the log does not mark paths that heard nothing, sensors that are never heard are named with both explanations.
    """
    usual = _usual_rates(health)
    echoes = health.direct + health.cross
    others = float(np.median(echoes))
    for k in range(health.ring.count):
        expected, detected = health.expected[k, 0], health.heard[k, 0]
        # A sensor that faces no wall hears nothing, either.
        faces_walls = not health.source or evidence.faced[k] >= _FINDINGS.min_faced
        heard_never = echoes[k] == 0 and others >= _FINDINGS.min_echoes and faces_walls
        if heard_never and (measured.any[k] or not measured.certain):
            doubt = "" if measured.any[k] else "; it is dead, or was not measured"
            finding = Finding(
                "dead",
                (k,),
                f"sensor {k} hears nothing: no echo in the log, the others {others:.0f} each{doubt}",
                confidence_of(others) if measured.any[k] else 0.5,
                "a working sensor would have echoes of the walls that its neighbors hear",
                _REPLACE,
            )
            yield GradedFinding(others, finding)
        elif _is_low(expected, detected, usual[0], _FINDINGS.dead_rate):
            amount = "nothing" if detected == 0 else "hardly anything"
            elsewhere = (
                f", and reports {echoes[k]} echoes elsewhere" if echoes[k] > _FINDINGS.min_elsewhere * others else ""
            )
            nats = _rate_nats(expected, detected, usual[0])
            finding = Finding(
                "dead",
                (k,),
                f"sensor {k} hears {amount}: {detected} of {expected} expected direct echoes, the others "
                f"{100 * usual[0]:.0f} %{elsewhere}",
                confidence_of(nats),
                f"log-likelihood ratio to the usual rate {_nats(nats)}",
                _REPLACE,
            )
            yield GradedFinding(nats, finding)


def _one_sided_sensors(measured: MeasuredSensors, evidence: SensorEvidence) -> Iterator[Finding]:
    """Deaf and mute sensors."""
    for one in one_sided_sensors(evidence.cross):
        cause, meaning, remedy = _ROLES[int(one.is_deaf)]
        fewer, more = sorted((one.sent, one.received))
        never = fewer == 0 and not measured.certain
        doubt = ", unless these paths were not measured" if never else ""
        yield Finding(
            cause,
            (one.sensor,),
            f"sensor {one.sensor} is {cause}, {meaning}: {fewer} cross echoes, {more} in the other direction{doubt}",
            confidence_of(one.nats),
            "an echo between two sensors has the same path in both directions; log-likelihood ratio to equal rates "
            f"{_nats(one.nats)}",
            remedy,
        )


def _rate_nats(expected: Any, detected: Any, usual: float) -> float:
    """Log-likelihood ratio of the observed rate of echoes to the usual one, nats."""
    p = float(np.clip(usual, 0.01, 0.99))
    own = float(np.clip(detected / max(expected, 1), 1e-3, 1 - 1e-3))
    return float(detected * np.log(own / p) + (expected - detected) * np.log((1 - own) / (1 - p)))


def _nats(value: float) -> str:
    return f"{value:.0f} nats" if value < 1000 else "over 1000 nats"


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
                confidence_of(nats := _rate_nats(pairs[k], round(health.repeats[k] * pairs[k]), usual)),
                f"log-likelihood ratio to the usual rate {_nats(nats)}",
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


def _range_offsets(health: Health, sigma: float | None) -> Iterator[GradedFinding]:
    """Range offsets, the largest first."""
    threshold = max(_FINDINGS.min_offset, sigma if sigma is not None else float(np.nan_to_num(health.sigma)))
    threshold = max(threshold, _FINDINGS.min_offset_by_poses) if health.source == "poses" else threshold
    size = np.abs(health.offset)
    sigmas = _FINDINGS.offset_sigmas[health.source == "poses"]
    off = np.flatnonzero((size > sigmas * health.offset_error) & (size > threshold))
    for k in off[np.argsort(-size[off], kind="stable")].tolist():
        direction = "much" if health.offset[k] > 0 else "little"
        z = float(size[k] / health.offset_error[k])
        finding = Finding(
            "offset",
            (k,),
            f"sensor {k} reports {1e3 * size[k]:.1f} ± {1e3 * health.offset_error[k]:.1f} mm too {direction}, relative "
            f"to the others",
            confidence_of(z**2 / 2 - np.log(health.ring.count)),
            f"the offset is {z:.1f} standard errors, estimated jointly with all other offsets and all walls",
            "calibrate the ring (jaxsonar calibrate), or give the sensor this range_offset",
        )
        yield GradedFinding(z**2 / 2, finding)


def _weak_sensors(health: Health, evidence: SensorEvidence) -> Iterator[GradedFinding]:
    """Sensors that detect little, at more than one wall."""
    usual = _usual_rates(health)[0]
    for k in range(health.ring.count):
        expected, detected = health.expected[k, 0], health.heard[k, 0]
        asked, answered = evidence.without_worst[k]
        low = _is_low(expected, detected, usual, _FINDINGS.weak_rate)
        if low and _is_low(asked, answered, usual, _FINDINGS.weak_rate, least=_FINDINGS.min_weak, sigmas=3.0):
            nats = _rate_nats(asked, answered, usual)
            finding = Finding(
                "weak",
                (k,),
                f"sensor {k} hears {detected} of {expected} expected direct echoes, the others {100 * usual:.0f} %",
                confidence_of(nats),
                f"without the wall of which it misses the most, log-likelihood ratio to the usual rate {_nats(nats)}",
                "clean its membrane, and check what covers it, its supply and its gain",
            )
            yield GradedFinding(nats, finding)


def _turned_sensors(health: Health, evidence: SensorEvidence) -> Iterator[GradedFinding]:
    """Sensors that point in another direction."""
    turns = np.degrees(health.centre[:, 0])
    scatter = robust_deviation(turns[np.isfinite(turns)], center=0.0)
    for k in range(health.ring.count):
        turn, error = np.degrees(health.centre[k])
        nats = float(evidence.turn_nats[k])
        if abs(turn) > max(_FINDINGS.min_turn_deg, 4 * error, 4 * scatter) and nats > _FINDINGS.min_turn_nats:
            side = "left" if turn > 0 else "right"
            finding = Finding(
                "turned",
                (k,),
                f"sensor {k} points {abs(turn):.0f} ± {error:.0f} deg too far to the {side}",
                confidence_of(nats - np.log(health.ring.count)),
                f"it hears walls in these directions; log-likelihood ratio to its heading {_nats(nats)}",
                "turn the sensor in its mount, or calibrate the ring (jaxsonar calibrate)",
            )
            yield GradedFinding(nats, finding)


def differs_from_nominal(beam: Float[np.ndarray, " 2"], ring: Ring) -> bool:
    """Whether a measured width of the cones and its standard deviation (radians) differ from the ring's."""
    width, error, nominal = np.degrees([*beam, float(np.mean(ring.beam))])
    return bool(abs(width - nominal) > max(_FINDINGS.min_beam_deg, _FINDINGS.min_beam * nominal, 3 * error))


def _beam_width(health: Health) -> Iterator[Finding]:
    """Cones that are wider or narrower than the ring states."""
    if differs_from_nominal(health.beam, health.ring):
        width, error, nominal = np.degrees([*health.beam, health.nominal])
        yield Finding(
            "beam width",
            (),
            f"cones are measured {width:.0f} ± {error:.0f} deg wide, the ring has {nominal:.0f} deg",
            confidence_of(((width - nominal) / error) ** 2 / 2),
            f"the difference is {abs(width - nominal) / error:.0f} standard deviations; sensors are judged by the "
            "measured width",
            f"set beam_deg = {width:.0f} in the ring",
        )


def _ring_findings(health: Health, measured: MeasuredSensors, faults: Sequence[Finding]) -> Iterator[Finding]:
    """Findings about the ring as a whole."""
    # Sensors that face no wall hear little, and nothing that walls explain: all echoes count alike.
    echoes = np.where(np.isfinite(health.fits[:, 1]), health.direct + health.cross, 0)
    explained = float(np.nan_to_num(health.fits[:, 1]) @ echoes / max(echoes.sum(), 1))
    if health.source == "scans" and not faults and echoes.any() and explained < _FINDINGS.min_explained:
        yield Finding(
            "unexplained echoes",
            (),
            f"walls explain {100 * explained:.0f} % of the echoes: is it the right ring, are ranges half "
            "path lengths in metres?",
            0.5,
            "",
            "check the ring, the unit of the ranges, and the sensor numbers",
        )
    value, sensors = _common_constant(health)
    usual_constant = _usual_constant_fraction(health)
    if usual_constant > 0.1 and sensors > health.ring.count / 2:
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


def _common_constant(health: Health) -> tuple[float, int]:
    """The range that is the most frequent one of the most sensors, metres, and the number of these sensors."""
    value = health.constant[np.isfinite(health.constant[:, 0]), 0]
    each, sensors = np.unique(value, return_counts=True)
    return (float(each[sensors.argmax()]), int(sensors.max())) if len(each) else (float("nan"), 0)


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
    expected: Any,
    detected: Any,
    usual: float,
    fraction: float,
    *,
    least: int = _FINDINGS.min_expected,
    sigmas: float = 4.0,
) -> bool:
    """Whether a detection rate is significantly (binomial) below this fraction of the usual one."""
    usual = min(usual, 0.9)
    sigma = np.sqrt(usual * (1 - usual) * max(expected, 1))
    lost = usual * expected - detected  # NaN if the usual rate is unknown
    return bool(expected >= least and detected < fraction * usual * expected and lost > sigmas * sigma)
