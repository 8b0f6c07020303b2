"""Probable mistakes of a ring: units of its beam width, its speed of sound and its lengths."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.plausibility.implausibility import Implausibility
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class RingSettings:
    """What is possible for ultrasonic sensors in air on a robot. Chosen by hand."""

    narrowest: float = 3.15
    """Beam width in degrees that any width in radians stays below; no ultrasonic transducer has such a narrow beam."""
    slowest: float = 280.0
    """Speed of sound in air at -78 deg C, metres per second."""
    fastest: float = 400.0
    """Speed of sound in air at 125 deg C, metres per second."""
    air: float = 343.2
    """Speed of sound in air at 20 deg C, metres per second."""
    farthest: float = 30.0
    """Ultrasonic sensors in air do not hear echoes from farther away, metres."""
    widest: float = 4.0
    """Sensors on a robot are at most this far from its origin, metres, ..."""
    radius_of_range: float = 2.0
    """... and, if that is more than ``wide``, at most this many times the maximum range."""
    wide: float = 1.5
    """Size from which on a ring is compared with its maximum range, metres."""
    spread: float = float(np.radians(60.0))
    """Directions of sensors around a robot differ by more than this, radians."""
    heading: float = float(np.radians(10.0))
    """Sensors that face outward do so within this angle, radians."""


SETTINGS = RingSettings()

_SPEED_UNITS = (
    (0.01, "centimetres per second"),
    (1 / 3.6, "kilometres per hour"),
    (0.3048, "feet per second"),
    (0.44704, "miles per hour"),
    (0.0254, "inches per second"),
    (1000.0, "millimetres per microsecond (kilometres per second)"),
    (10.0, "centimetres per millisecond"),
    (1e4, "centimetres per microsecond"),
    (0.001, "millimetres per second"),
)
"""Metres per second of a unit, and its name."""


def implausible_ring(ring: Ring) -> Iterator[Implausibility]:
    """Probable mistakes of a ring.

    Args:
        ring: the sensors.
    """
    widest = float(np.degrees(ring.beam.max()))
    if widest <= SETTINGS.narrowest:
        what = f"the beam width is {widest:.3g} deg"
        cause = "it was probably given in radians"
        yield Implausibility("beam width", what, cause, f"give degrees: {np.degrees(widest):.4g}")
    speed = float(ring.speed_of_sound)
    if not SETTINGS.slowest <= speed <= SETTINGS.fastest:
        yield _implausible_speed(speed)
    size = float(np.hypot(*np.asarray(ring.position).T).max())
    if size > SETTINGS.widest or (size > SETTINGS.wide and size > SETTINGS.radius_of_range * ring.max_range):
        what = f"a sensor is {size:g} m away from the origin of the robot"
        cause = f"the positions or the radius are probably in {_small_unit(size, 0.03)}"
        yield Implausibility("ring size", what, cause, "give metres")
    if ring.max_range > SETTINGS.farthest:
        what = f"the maximum range is {ring.max_range:g} m"
        cause = f"it is probably in {_small_unit(ring.max_range, 0.3)}"
        yield Implausibility("maximum range", what, cause, "give metres")
    yield from _headings_in_radians(ring)


def _implausible_speed(speed: float) -> Implausibility:
    """The mistake of a speed of sound that is none in air."""
    what = f"the speed of sound is {speed:g} m/s; in air it is {SETTINGS.air:g} m/s at 20 deg C".replace("; ", ", and ")
    scale, name = min(_SPEED_UNITS, key=lambda unit: abs(np.log(speed * unit[0] / SETTINGS.air)))
    converted = speed * scale
    if SETTINGS.slowest <= converted <= SETTINGS.fastest:
        cause, remedy = f"it is probably in {name}", f"give metres per second: {converted:.4g}"
    else:
        cause, remedy = "it is probably no speed of sound in air", "give metres per second"
    return Implausibility("speed of sound", what, cause, remedy)


def _headings_in_radians(ring: Ring) -> Iterator[Implausibility]:
    """Headings that face outward if their degrees are taken for radians."""
    away = np.hypot(*np.asarray(ring.position).T)
    outward = np.arctan2(*np.asarray(ring.position).T[::-1])[away > 0.3 * away.max()]
    heading = np.asarray(ring.heading)[away > 0.3 * away.max()]
    given, radians = heading, np.degrees(heading)
    if len(heading) < 3 or np.abs(radians).max() > 2 * np.pi + 1e-6:
        return
    if np.abs(wrap_angle(outward - outward[0])).max() < SETTINGS.spread:
        return
    as_given, as_radians = (np.abs(wrap_angle(one - outward)) for one in (given, radians))
    if as_radians.max() <= SETTINGS.heading < np.median(as_given):
        what = f"the sensors lie around the robot, and all of them face {np.degrees(heading).mean():.0f} deg within "
        what += f"{np.degrees(np.abs(heading - heading.mean()).max()):.1f} deg"
        yield Implausibility(
            "sensor headings", what, "the headings are probably in radians", "give heading_deg in degrees"
        )


def _small_unit(value: float, least: float) -> str:
    """The unit that a length of metres probably has: the larger one in which it is possible."""
    return "millimetres" if value / 1000 >= least else "centimetres"
