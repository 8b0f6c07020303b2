"""Simulated conditions of the detection benchmark."""

from dataclasses import dataclass

import numpy as np

from jaxsonar import Ring


@dataclass(frozen=True)
class Condition:
    """Parameters of a simulation. The defaults are the base condition, of which one parameter at a time is varied."""

    name: str
    sigma: float = 0.003
    """Range noise, metres."""
    lost: float = 0.1
    """Probability that an echo is lost."""
    false: float = 0.02
    """False echoes per true echo."""
    cone_deg: float = 60.0
    """Full width of the detection cones, degrees."""
    sensors: int = 24
    """Number of sensors of the ring."""
    beams: str = "soft"
    """"soft": paths detect what is loud enough, and there is crosstalk. "hard": only echoes within both cones."""
    columns: float = 0.0
    """Expected number of round columns in each random room."""
    quick: bool = False
    """Whether the condition is part of the quick run."""

    @property
    def ring(self) -> Ring:
        """The ring. Cross echoes reach as far around as the cones overlap well: 45 deg, or 105 deg for wide cones."""
        around = 105 if self.cone_deg > 90 else 45
        neighbors = around * self.sensors // 360
        return Ring.circular(count=self.sensors, beam=np.radians(self.cone_deg), neighbors=neighbors)


BASE = Condition("base", quick=True)

HARD = Condition("5 mm, 30 % lost, 20 % false", sigma=0.005, lost=0.3, false=0.2, quick=True)

CONDITIONS = (
    BASE,
    Condition("sigma 1 mm", sigma=0.001, quick=True),
    Condition("sigma 5 mm", sigma=0.005),
    Condition("sigma 10 mm", sigma=0.010, quick=True),
    Condition("none lost", lost=0.0),
    Condition("30 % lost", lost=0.3, quick=True),
    Condition("50 % lost", lost=0.5),
    Condition("none false", false=0.0),
    Condition("20 % false", false=0.2, quick=True),
    Condition("50 % false", false=0.5),
    Condition("cones of 120 deg", cone_deg=120.0),
    Condition("32 sensors", sensors=32),
    Condition("none lost or false, 1 mm", sigma=0.001, lost=0.0, false=0.0, quick=True),
    Condition("none lost or false, 3 mm", lost=0.0, false=0.0),
    Condition("none lost or false, 5 mm", sigma=0.005, lost=0.0, false=0.0),
    HARD,
    Condition("5 mm, 10 % lost, 50 % false", sigma=0.005, false=0.5),
    Condition("5 mm, cones of 120 deg", sigma=0.005, cone_deg=120.0),
    Condition("a column in each room", columns=1.0, quick=True),
    Condition("hard cones", beams="hard", quick=True),
    Condition("hard cones; 5 mm, 30 % lost, 20 % false", sigma=0.005, lost=0.3, false=0.2, beams="hard"),
)

ISOLATED = (
    Condition("one reflector, 1 mm, cones of 60 deg", sigma=0.001, lost=0.0, false=0.0, beams="hard", quick=True),
    Condition("one reflector, 5 mm, cones of 120 deg", 0.005, lost=0.0, false=0.0, cone_deg=120.0, beams="hard"),
)
"""Conditions of scans with one reflector each. The cones are hard, so that edges and walls have equally many echoes."""

THREE_WALLS = Condition("three walls, 1 mm", sigma=0.001, lost=0.0, false=0.0)
