"""A finding of the health check: a fault, its evidence against other causes, and what to do."""

import math
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple


@dataclass(frozen=True)
class Finding:
    """One fault of a ring, of its driver, or of the poses."""

    cause: str
    """The kind of fault, a fixed word such as "dead", "own echo" or "speed of sound"."""
    sensors: tuple[int, ...]
    """Sensors that have the fault, by their numbers in the log; empty if it does not lie in single sensors."""
    sentence: str
    """What was found, in one sentence."""
    confidence: float
    """Probability of this cause against the next best explanation, from 0 to 1."""
    evidence: str
    """The measurements that tell this cause from the others."""
    remedy: str
    """What to do."""

    def as_json(self) -> dict[str, Any]:
        """Everything but the sentence, which stands in a list of its own (``Health.as_json``)."""
        plain = asdict(self)
        del plain["sentence"]
        return plain | {"sensors": list(self.sensors), "confidence": round(self.confidence, 4)}

    def lines(self) -> tuple[str, ...]:
        """The finding as text: the sentence, the evidence, the remedy; parts without text are left out."""
        confidence = "over 99%" if self.confidence > 0.99 else f"{self.confidence:.0%}"
        evidence = self.evidence and f"  evidence: {self.evidence} (confidence {confidence})"
        return tuple(filter(None, (self.sentence, evidence, self.remedy and f"  what to do: {self.remedy}")))


def confidence_of(nats: float) -> float:
    """Probability of a cause from its log-likelihood ratio to the next best explanation (nats), at equal priors."""
    return 1 / (1 + math.exp(-min(max(nats, -50.0), 50.0)))


class GradedFinding(NamedTuple):
    """A finding about one sensor."""

    nats: float
    """Its log-likelihood ratio to a sound sensor."""
    finding: Finding
