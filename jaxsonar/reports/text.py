"""Text of counts and numbers. Imports nothing, so that the command line can use it before a computation."""

import math

NO_VALUE = "–"
"""Text of a missing value in a table."""


def plural(count: int, noun: str) -> str:
    """A count with its noun: "1 wall", "2 walls"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def point_counts(kinds: tuple[str, ...]) -> list[str]:
    """How many points of each kind a map has, for example ["1 circle", "2 corners"]; kinds without any are left out."""
    names = {"undecided": "undecided reflector"}
    return [plural(kinds.count(kind), names.get(kind, kind)) for kind in sorted(set(kinds))]


def fixed(value: float | int | None, digits: int) -> str:
    """A number with a fixed number of decimals; ``NO_VALUE`` for None and NaN."""
    return NO_VALUE if value is None or math.isnan(value) else f"{value:.{digits}f}"


def with_error(value: float, error: float, *, digits: int) -> str:
    """A number and its standard deviation; ``NO_VALUE`` for NaN."""
    return NO_VALUE if math.isnan(value) else f"{value:.{digits}f} ± {error:.{digits}f}"
