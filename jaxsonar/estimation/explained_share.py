"""The share of the echoes that the reflectors of a result explain, as measured and as required."""

from typing import NamedTuple


class ExplainedShare(NamedTuple):
    """How many echoes are within the gate of a wall, corner or edge of the result, as a fraction of all echoes."""

    measured: float
    required: float
    """A result that explains less is refused."""

    @property
    def suffices(self) -> bool:
        """Whether enough echoes are explained."""
        return self.measured >= self.required

    @property
    def shortfall(self) -> str:
        """The predicate of a refusal."""
        return f"explain {_percent(self.measured)} of the echoes; needed are {_percent(self.required)} or more"

    def __str__(self) -> str:
        return f"{_percent(self.measured)} of the echoes explained, required: {_percent(self.required)}"


def _percent(fraction: float) -> str:
    """The fraction in percent, with a decimal below 10 %."""
    return f"{100 * fraction:.0f} %" if fraction >= 0.0995 or not fraction else f"{100 * fraction:.1f} %"
