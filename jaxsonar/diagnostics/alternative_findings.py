"""Findings from the comparison of explanations of each sensor's direct echoes."""

from collections.abc import Iterator, Mapping

import numpy as np

from jaxsonar.diagnostics.findings import Finding, GradedFinding, confidence_of
from jaxsonar.diagnostics.sensor_alternatives import SensorAlternative

_REMEDIES = {
    "turned": "turn the sensor in its mount, or calibrate the ring (jaxsonar calibrate)",
    "weak": "clean its membrane, and check what covers it, its supply and its gain",
    "dead": "check its plug, its cable and its membrane, and replace it",
}


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
