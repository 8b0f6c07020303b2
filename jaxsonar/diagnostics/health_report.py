"""The result of the health check of a ring."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.diagnostics.findings import Finding
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True, eq=False)
class Health:
    """Measurements of every sensor of a ring, from a log.

    Arrays have one entry per sensor, and NaN where data are missing. Sensors are numbered as in the log.
    A sensor that seems to be at another position (``place``) is compared with predictions for that position. The field
    names are the keys of the JSON file.
    """

    ring: Ring
    """The ring as it should be."""
    scans: int
    """Number of scans in the log."""
    used: int
    """Number of scans that were analysed."""
    walls: int
    """Number of reference walls, counted once per scan."""
    source: str
    """Source of the reference walls: "scans" (each scan alone), "poses" (pieces of the trajectory, by the log's poses;
    residuals then include their errors), or "" (no walls)."""
    empty: str
    """Reason why there are no reference walls; empty if there are."""
    left_out: int
    """Number of echoes of pairs (tx, rx) that the ring does not listen to."""
    sigma: float
    """Robust standard deviation of the ranges about the walls, metres; NaN without walls."""
    direct: Int[np.ndarray, " sensors"]
    """Number of direct echoes in the log; a reading that was not renewed counts once."""
    cross: Int[np.ndarray, " sensors"]
    """Number of cross echoes in the log that the sensor sent or received."""
    expected: Int[np.ndarray, "sensors 3"]
    """Expected echoes of walls well inside the cones: direct, cross as transmitter, cross as receiver."""
    heard: Int[np.ndarray, "sensors 3"]
    """Number of them that were detected."""
    place: Int[np.ndarray, " sensors"]
    """Number of the sensor of the ring at whose position it seems to be; its own if the wiring is right."""
    fits: Float[np.ndarray, "sensors 2"]
    """Fraction of its echoes that reflectors explain: at its own position, and at ``place``."""
    offset: Float[np.ndarray, " sensors"]
    """Range offset relative to the other sensors, metres; positive if it reports too much."""
    offset_error: Float[np.ndarray, " sensors"]
    """Standard error of the offset, metres."""
    median: Float[np.ndarray, " sensors"]
    """Median residual of its direct echoes against walls that the other echoes determine, metres."""
    quartiles: Float[np.ndarray, "sensors 4"]
    """5, 25, 75 and 95 % quantiles of the same residuals, metres."""
    spread: Float[np.ndarray, "sensors 2"]
    """Robust standard deviation of the residuals of its direct echoes, and of all its echoes, metres."""
    repeats: Float[np.ndarray, " sensors"]
    """Fraction of its first direct echoes with exactly the range of the previous scan, while the robot moved."""
    constant: Float[np.ndarray, "sensors 2"]
    """Its most frequent range, metres, and the fraction of its direct echoes with that range, while the robot moved."""
    beam: Float[np.ndarray, " 2"]
    """Measured full width of the cones and its standard deviation, radians."""
    curve: Float[np.ndarray, " 4"]
    """Detection probability as a function of the off-axis angle: half width and roll-off width (radians), probability
    inside and outside."""
    asked: Int[np.ndarray, " bins"]
    """Expected direct echoes by off-axis angle, in bins of 2.5 degrees from -90 to 90 degrees."""
    answered: Int[np.ndarray, " bins"]
    """Number of them that were detected."""
    beam_each: Float[np.ndarray, "sensors 2"]
    """Full width of each sensor's cone and its standard deviation, radians."""
    centre: Float[np.ndarray, "sensors 2"]
    """Direction of the middle of its cone relative to its heading, counter-clockwise, and its standard deviation,
    radians."""
    remarks: tuple[str, ...]
    """Short remark for each sensor; empty if nothing is wrong."""
    findings: tuple[Finding, ...]
    """The faults, the most severe first; none if the ring is healthy. In JSON, ``findings`` lists their sentences, and
    ``diagnoses`` the rest of them in the same order."""
    unmeasured: tuple[str, ...] = ()
    """Kinds of paths, and sensors, of which the log holds no measurement; they are not judged."""

    @property
    def nominal(self) -> float:
        """Mean full width of the cones as the ring specifies it, radians."""
        return float(np.mean(self.ring.beam))

    def as_json(self) -> dict[str, Any]:
        """Plain numbers for a JSON file, SI units and radians; null for NaN."""

        def plain(value: Any) -> Any:
            if isinstance(value, np.ndarray):
                value = value.tolist()
            if isinstance(value, list | tuple):
                return [plain(item) for item in value]
            return None if isinstance(value, float) and not np.isfinite(value) else value

        found = {
            "findings": [finding.sentence for finding in self.findings],
            "diagnoses": [finding.as_json() for finding in self.findings],
        }
        special = {"ring", *found}
        measured = {field.name: plain(getattr(self, field.name)) for field in fields(self) if field.name not in special}
        return {"ring": self.ring.name, "nominal_beam": self.nominal} | measured | found


OF_SENSORS = (
    "expected",
    "heard",
    "fits",
    "offset",
    "offset_error",
    "median",
    "quartiles",
    "spread",
    "beam_each",
    "centre",
)
"""Measurements of each sensor by the walls."""
