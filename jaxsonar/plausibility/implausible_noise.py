"""Probable mistakes of numbers that describe errors: noise in millimetres, shares in per cent."""

from collections.abc import Iterator
from dataclasses import dataclass

from jaxsonar.plausibility.implausibility import Implausibility


@dataclass(frozen=True)
class NoiseSettings:
    """When numbers that describe errors have another unit. Chosen by hand."""

    largest: float = 0.15
    """No ultrasonic sensor has a larger standard deviation of its ranges, metres."""
    millimetres: float = 0.5
    """From this number on, it was given in millimetres; below, in centimetres or millimetres."""
    clutter: float = 3.0
    """No sensor has more false echoes per real echo."""


SETTINGS = NoiseSettings()


def implausible_noise(
    sigma: float | None = None, *, drift: float | None = None, clutter: float | None = None
) -> Iterator[Implausibility]:
    """Probable mistakes of the description of errors.

    Args:
        sigma: standard deviation of the ranges, metres; None: not given.
        drift: slow drift of the ranges, metres; None: not given.
        clutter: false echoes per real echo; None: not given.
    """
    for name, value in (("noise", sigma), ("drift", drift)):
        if value is not None and value > SETTINGS.largest:
            unit = "millimetres" if value >= SETTINGS.millimetres else "centimetres"
            scale = 1000 if value >= SETTINGS.millimetres else 100
            what = f"the {name} of the ranges is {value:g} m"
            yield Implausibility("noise unit", what, f"it is probably in {unit}", f"give metres: {value / scale:g}")
    if clutter is not None and clutter > SETTINGS.clutter:
        what = f"there are {clutter:g} false echoes per real echo"
        yield Implausibility("noise unit", what, "the clutter is probably in per cent", f"give {clutter / 100:g}")
