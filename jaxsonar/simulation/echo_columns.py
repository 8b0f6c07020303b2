"""The table of simulated echoes that the stages of the simulator pass on."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class EchoColumns(NamedTuple):
    """Columns of echoes; ``Simulation`` describes them."""

    scan: Int[np.ndarray, " echoes"]
    path: Int[np.ndarray, " echoes"]
    range: Float[np.ndarray, " echoes"]
    """At first half the true path length, later the reported range, metres."""
    amplitude: Float[np.ndarray, " echoes"]
    kind: Int[np.ndarray, " echoes"]
    reflector: Int[np.ndarray, " echoes"]
    reflector_kind: Int[np.ndarray, " echoes"]
    transmitter: Int[np.ndarray, " echoes"]
    second: Int[np.ndarray, " echoes"]
    """Second wall; the first one in the opposite direction."""

    @classmethod
    def empty(cls) -> "EchoColumns":
        """No echoes."""
        index, real = np.zeros(0, dtype=int), np.zeros(0)
        return cls(index, index, real, real, index, index, index, index, index)

    @classmethod
    def concatenate(cls, parts: list["EchoColumns"]) -> "EchoColumns":
        """All echoes of several parts."""
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def sorted(self) -> "EchoColumns":
        """The echoes by scan, path and range; ties by the reflector."""
        order = np.lexsort((self.second, self.reflector, self.kind, self.range, self.path, self.scan))
        return EchoColumns(*(column[order] for column in self))
