"""What explains the direct echoes of a sensor best: no fault, an offset, another direction, or lost echoes?

The poses of the log gather the walls. Each explanation predicts which walls the sensor must hear and at which ranges,
so that echoes where none is expected and missing echoes both count. How often sound sensors miss an expected echo, and
have echoes of something else, is measured on the sensors of the same log. Only walls that other sensors support are
used.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.diagnostics.echo_residuals import ResidualTable
from jaxsonar.diagnostics.findings import Finding, GradedFinding, confidence_of
from jaxsonar.diagnostics.settings import SETTINGS
from jaxsonar.geometry.robust_statistics import robust_deviation

_SETTINGS = SETTINGS.alternatives

_REMEDIES = {
    "turned": "turn the sensor in its mount, or calibrate the ring (jaxsonar calibrate)",
    "weak": "clean its membrane, and check what covers it, its supply and its gain",
    "dead": "check its plug, its cable and its membrane, and replace it",
}


class Rates(NamedTuple):
    """How sound sensors behave."""

    detected: float
    """Probability that an expected echo is detected."""
    foreign: float
    """Share of the echoes that do not come from a known wall."""
    strange: float
    """The same of the echoes in scans in which the sensor faces a known wall."""
    scatter: float
    """Standard deviation of the first among the sensors."""


class SensorAlternative(NamedTuple):
    """The best explanation of the echoes of a sensor, other than a sound sensor."""

    cause: str
    """``offset``, ``turned``, ``weak``, ``dead``, or ``astray``: it hears something, but not where it should."""
    value: float
    """Offset, metres; rotation, radians, counter-clockwise; share of the expected echoes that is detected."""
    error: float
    """Its standard error."""
    nats: float
    """Log-likelihood ratio to a sound sensor, without the part of the trajectory that supports it most."""
    expected: int
    """Expected echoes under this explanation."""
    detected: int
    """Number of them that were detected."""
    echoes: int
    """Echoes of the sensor."""
    explained: int
    """Number of them that this explanation explains."""
    as_stated: int
    """Number of them that a sound sensor would explain."""

    @property
    def is_moved(self) -> bool:
        """Whether it explains the echoes that there are, rather than missing ones."""
        return self.cause in ("turned", "offset")


class _DirectEchoes(NamedTuple):
    """Direct echoes of one sensor: an entry for every scan and wall."""

    scan: Int[np.ndarray, " rows"]
    """Scan, counted without gaps."""
    residual: Float[np.ndarray, " rows"]
    """Reported minus predicted range, metres; inf without an echo."""
    off_axis: Float[np.ndarray, " rows"]
    """Direction of the wall relative to the heading, radians."""
    beyond_end: Float[np.ndarray, " rows"]
    """Distance of the point of reflection from the ends of the wall, metres."""
    is_between: Bool[np.ndarray, " rows"]
    """Whether other sensors hear the wall on both sides of it."""
    block: Int[np.ndarray, " scans"]
    """Part of the trajectory of each scan."""
    heard: Bool[np.ndarray, " scans"]
    """Whether the sensor has an echo in each scan."""


class _Counts(NamedTuple):
    """How an explanation fits, for each scan."""

    expected: Bool[np.ndarray, " scans"]
    """A wall well inside the cone must give an echo."""
    detected: Bool[np.ndarray, " scans"]
    """It did."""
    explained: Bool[np.ndarray, " scans"]
    """The sensor has an echo that a wall in its cone explains."""
    walls: Int[np.ndarray, " scans"]
    """Number of walls in its cone."""
    strange: Bool[np.ndarray, " scans"]
    """It faces a wall, but its echoes come from elsewhere."""
    known: Bool[np.ndarray, " scans"]
    """It faces a wall, and has an echo of a known one."""


def sensor_alternatives(
    table: ResidualTable, half_width: Float[np.ndarray, " sensors"], noise: float, max_range: float
) -> list[SensorAlternative | None]:
    """The best explanation of the echoes of each sensor; None for a sound sensor, or one that cannot be judged.

    Empty if the walls explain too little to judge any sensor.

    Args:
        table: expected and reported echoes.
        half_width: half width of the cone of each sensor, radians.
        noise: standard deviation of the residuals, metres.
        max_range: largest range, metres.
    """
    rows, stated, gate = _stated(table, half_width, noise)
    rates = _usual_rates(rows, stated)
    if rates is None:
        return []
    sides = zip(rows, stated, half_width, strict=True)
    return [_best(one, counts, half, gate, max_range, rates) for one, counts, half in sides]


def _stated(
    table: ResidualTable, half_width: Float[np.ndarray, " sensors"], noise: float
) -> tuple[list[_DirectEchoes], list[_Counts], float]:
    """The direct echoes of each sensor, how a sound sensor explains them, and the gate of their ranges, metres."""
    gate = min(SETTINGS.detection.gate * noise + SETTINGS.detection.gate_margin, _SETTINGS.largest_gate)
    fair = table.independent_echoes >= SETTINGS.detection.min_independent_echoes
    fair &= table.unobstructed & (table.tx == table.rx)
    rows = [_rows_of(table, fair, k, half, gate) for k, half in enumerate(half_width)]
    stated = [_count(one, half, gate, 0.0, 0.0) for one, half in zip(rows, half_width, strict=True)]
    return rows, stated, gate


def _rows_of(
    table: ResidualTable, fair: Bool[np.ndarray, " all"], sensor: int, half_width: float, gate: float
) -> _DirectEchoes:
    direct = (table.tx == sensor) & (table.rx == sensor)
    # Scans in which the sensor hears a wall of its own, that no other sensor hears, tell nothing.
    beside = np.abs(table.off_axis) - half_width
    match = direct & (np.abs(table.residual) < gate) & (beside < _SETTINGS.cone_margin)
    match &= table.beyond_end <= SETTINGS.reference.end_margin
    alone = np.setdiff1d(table.scan[match & ~fair], table.scan[match & fair])
    row = np.flatnonzero(direct & fair & ~np.isin(table.scan, alone))
    each, scan = np.unique(table.scan[row], return_inverse=True)
    heard = np.zeros(len(each), bool)
    heard[scan[np.isfinite(table.residual[row])]] = True
    return _DirectEchoes(
        scan,
        table.residual[row],
        table.off_axis[row],
        table.beyond_end[row],
        table.is_between[row],
        each // _SETTINGS.block_scans,
        heard,
    )


def _count(rows: _DirectEchoes, half_width: float, gate: float, turn: float, offset: float) -> _Counts:
    """How an explanation by a rotation (radians) and an offset (metres) fits."""
    scans = len(rows.heard)
    beside = np.abs(rows.off_axis - turn) - half_width
    residual = rows.residual - offset
    match = np.abs(residual) < gate
    in_cone = (beside < _SETTINGS.cone_margin) & (rows.beyond_end <= SETTINGS.reference.end_margin)
    # A nearer echo may hide the one of this wall.
    faced = (beside < -_SETTINGS.cone_margin) & (rows.beyond_end <= SETTINGS.detection.max_beyond_end)
    faced &= rows.is_between
    tested = faced & ~(residual < -gate)

    def any_of(which: Bool[np.ndarray, " rows"]) -> Bool[np.ndarray, " scans"]:
        return np.bincount(rows.scan[which], minlength=scans) > 0

    explained, expected, faces = any_of(in_cone & match), any_of(tested), any_of(faced)
    walls = np.bincount(rows.scan[in_cone], minlength=scans)
    strange = faces & rows.heard & ~explained
    return _Counts(expected, expected & explained, explained, walls, strange, faces & explained)


def _usual_rates(rows: list[_DirectEchoes], counts: list[_Counts]) -> Rates | None:
    """Medians over the sensors; None if walls explain too little to judge any sensor.

    Sensors of sparse rings hear walls that no other sensor hears, each as its direction has it. Therefore medians of
    shares are weighted by the number of echoes, and what a sensor hears beside the known walls is judged in scans in
    which it faces one.
    """
    expected, detected, explained, strange, known = (
        np.array([getattr(one, name).sum() for one in counts])
        for name in ("expected", "detected", "explained", "strange", "known")
    )
    heard = np.array([one.heard.sum() for one in rows])
    enough = (expected >= SETTINGS.findings.min_expected) & (heard >= SETTINGS.findings.min_expected)
    if enough.sum() < _SETTINGS.min_sensors:
        return None
    each = detected[enough] / expected[enough]
    rate = float(np.median(each))
    foreign = 1 - _weighted_median(explained[enough] / heard[enough], heard[enough])
    faced = strange + known
    beside = _weighted_median(strange / np.maximum(faced, 1), faced)
    if rate < _SETTINGS.least_rate or beside > 1 - _SETTINGS.least_rate or foreign > 1 - _SETTINGS.least_explained:
        return None
    scatter = robust_deviation(each)
    least = 1 - _SETTINGS.most_rate
    return Rates(min(rate, _SETTINGS.most_rate), max(foreign, least), max(beside, least), scatter)


def _weighted_median(values: Float[np.ndarray, " values"], weight: Int[np.ndarray, " values"]) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])


def _log_likelihood(
    counts: _Counts, heard: Bool[np.ndarray, " scans"], detected: float, foreign: float, odds: float
) -> Float[np.ndarray, " scans"]:
    """Log-likelihood of each scan, nats.

    Args:
        counts: how the explanation fits.
        heard: whether there is an echo.
        detected: probability of an expected echo.
        foreign: share of echoes from elsewhere.
        odds: log of the largest range to the width of the gate.
    """
    missed = counts.expected & ~counts.detected
    known = np.log(1 - foreign) + odds - np.log(np.maximum(counts.walls, 1))
    of_echo = np.where(counts.explained, known, np.log(foreign)) * heard
    return of_echo + np.log(detected) * counts.detected + np.log(1 - detected) * missed


def _best(
    rows: _DirectEchoes, stated: _Counts, half_width: float, gate: float, max_range: float, rates: Rates
) -> SensorAlternative | None:
    if not len(rows.heard):
        return None
    odds = float(np.log(max_range / (2 * gate)))
    sound = _log_likelihood(stated, rows.heard, rates.detected, rates.foreign, odds)

    def robust(other: Float[np.ndarray, " scans"]) -> float:
        """Log-likelihood ratio without the part of the trajectory that contributes most; several must contribute."""
        part = np.bincount(rows.block, other - sound)
        if (part > 1).sum() < _SETTINGS.min_parts:
            return 0.0
        return float(part.sum() - max(part.max(), 0.0))

    found: list[SensorAlternative] = []
    heard = int(rows.heard.sum())
    usual_share = (1 - rates.foreign) * heard  # of its echoes, explained by known walls

    def propose(cause: str, value: float, error: float, counts: _Counts, nats: float) -> None:
        expected, detected, explained = (int(one.sum()) for one in counts[:3])
        found.append(
            SensorAlternative(
                cause, value, error, nats, expected, detected, heard, explained, int(stated.explained.sum())
            )
        )

    # Lost echoes.
    expected, detected = int(stated.expected.sum()), int(stated.detected.sum())
    known, strange = int(stated.known.sum()), int(stated.strange.sum())
    faced = known + strange
    rate = float(np.clip(detected / max(expected, 1), 0.01, 0.99))
    usual = min(SETTINGS.findings.weak_rate * rates.detected, rates.detected - _SETTINGS.scatters * rates.scatter)
    if expected >= SETTINGS.findings.min_weak and rate < usual:
        lost = _log_likelihood(stated, rows.heard, rate, rates.foreign, odds)
        few = heard < SETTINGS.findings.min_expected
        # Facing a known wall, a weak sensor hears it or nothing; a sensor astray hears something else. In between, it
        # hears other walls than the known ones.
        fits = known / max((1 - rates.strange) * faced, 1)
        missed = int((stated.expected & ~rows.heard).sum())
        silent = rate < SETTINGS.findings.dead_rate and few
        error = float(np.sqrt(rate * (1 - rate) / expected))
        most_heard = (rate + 2 * error) / rates.detected * len(rows.heard)  # it misses unknown walls as well
        if few or fits >= _SETTINGS.fitting or (missed * _SETTINGS.unfitting > strange and heard < most_heard):
            propose("dead" if silent else "weak", rate, error, stated, robust(lost))
        elif fits < _SETTINGS.unfitting:
            propose("astray", rate, error, stated, robust(lost))
    # Rotations and offsets.
    turns = np.radians(np.arange(-SETTINGS.cones.most_turn_deg, SETTINGS.cones.most_turn_deg + 1, 2.0))
    offsets = np.arange(-_SETTINGS.most_offset, _SETTINGS.most_offset + gate / 4, gate / 2)
    least_offset = max(SETTINGS.findings.min_offset_by_poses, gate)
    gains: list[tuple[float, int]] = []
    # A sensor that hears the walls that it faces neither points elsewhere nor has an offset.
    most = 1 - _SETTINGS.min_gain
    misfits = detected <= most * rates.detected * expected or known <= most * (1 - rates.strange) * faced
    for cause, values, least in (
        ("turned", turns, np.radians(SETTINGS.findings.min_turn_deg)),
        ("offset", offsets, least_offset),
    ):
        tried = [_count(rows, half_width, gate, *((v, 0.0) if cause == "turned" else (0.0, v))) for v in values]
        likelihood = np.stack([_log_likelihood(one, rows.heard, rates.detected, rates.foreign, odds) for one in tried])
        total = likelihood.sum(axis=1)
        posterior = np.exp((total - total.max()) / _SETTINGS.dependent)
        mean = float(posterior @ values / posterior.sum())
        error = float(np.sqrt(posterior @ (values - mean) ** 2 / posterior.sum() + (values[1] - values[0]) ** 2 / 12))
        best = int(np.argmin(np.abs(values - mean)))
        explained, before = int(tried[best].explained.sum()), int(stated.explained.sum())
        enough = explained >= max(_SETTINGS.fitting * usual_share, SETTINGS.findings.min_expected)
        enough &= misfits and before < most * usual_share
        enough &= explained - before >= max(SETTINGS.findings.min_expected, _SETTINGS.min_gain * heard)
        gains.append((float(total.max()), max(int(one.explained.sum()) for one in tried) - before))
        if abs(mean) >= least and abs(mean) > 4 * error and enough:
            propose(cause, mean, error, tried[best], robust(likelihood[best]) - float(np.log(len(values))))
    # If the more likely one of them explains some echoes, it is in doubt: then the sensor is not called astray.
    if max(gains)[1] >= SETTINGS.findings.min_expected:
        found = [one for one in found if one.cause != "astray"]
    good = [one for one in found if one.nats > _SETTINGS.min_nats]
    # What explains the echoes that there are comes first.
    return max(good, key=lambda one: (one.is_moved, one.nats)) if good else None


def suspects(table: ResidualTable, half_width: Float[np.ndarray, " sensors"], noise: float) -> list[int]:
    """Sensors whose echoes fit the walls worse than those of the others, the worst first.

    Their own echoes may have spoiled the walls: judge them by walls without these echoes.

    Args:
        table: expected and reported echoes.
        half_width: half width of the cone of each sensor, radians.
        noise: standard deviation of the residuals, metres.
    """
    rows, counts, _ = _stated(table, half_width, noise)
    rates = _usual_rates(rows, counts)
    if rates is None:
        return []
    lost = np.array(
        [
            max(
                (one.expected.sum() * rates.detected - one.detected.sum()) / np.sqrt(max(one.expected.sum(), 1)),
                (one.strange.sum() - rates.strange * (one.strange.sum() + one.known.sum()))
                / np.sqrt(max(one.strange.sum() + one.known.sum(), 1)),
            )
            for one in counts
        ]
    )
    worst = np.argsort(-lost, kind="stable")[: _SETTINGS.most_suspects]
    return [int(k) for k in worst if lost[k] > _SETTINGS.suspicious]


def explained_otherwise(alternatives: Mapping[int, SensorAlternative | None]) -> Iterator[GradedFinding]:
    """Findings about sensors whose echoes are explained better by a fault."""
    for sensor, one in alternatives.items():
        if one is None or one.cause == "offset":  # measured more exactly with all walls: ``range_offsets``
            continue
        cause = "turned" if one.cause == "astray" else one.cause
        evidence = (
            f"explains {one.explained} of {one.echoes} echoes, a sound sensor {one.as_stated}; log-likelihood ratio "
            f"{one.nats:.0f} nats without the part of the log that supports it most"
        )
        finding = Finding(cause, (sensor,), _sentence(sensor, one), confidence_of(one.nats), evidence, _REMEDIES[cause])
        yield GradedFinding(one.nats, finding)


def _sentence(sensor: int, one: SensorAlternative) -> str:
    heard = f"{one.detected} of {one.expected} expected direct echoes"
    match one.cause:
        case "turned":
            turn, error = np.degrees([abs(one.value), one.error])
            side = "left" if one.value > 0 else "right"
            return f"sensor {sensor} points {turn:.0f} ± {error:.0f} deg too far to the {side}"
        case "astray":
            elsewhere = f"{one.echoes - one.explained} of its {one.echoes} echoes come from elsewhere"
            return f"sensor {sensor} does not point where it should: it hears {heard}, and {elsewhere}"
        case "dead":
            amount = "nothing" if one.detected == 0 else "hardly anything"
            return f"sensor {sensor} hears {amount}: {heard}"
        case _:
            return f"sensor {sensor} hears {heard}, clearly less than the others"
