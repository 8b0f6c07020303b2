"""What the health check of a ring tells of each sensor."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True, eq=False)
class Health:
    """What a log tells of each sensor of a ring; arrays have one entry a sensor, NaN where there is too little to tell.

    Sensors are numbered as in the log. A sensor that seems to sit elsewhere (``place``) is judged as the one there.
    """

    ring: Ring
    """The ring as it should be."""
    scans: int
    """Scans of the log."""
    used: int
    """Of them, those that were explained."""
    walls: int
    """Walls in all these scans that the sensors were compared with."""
    source: str
    """Where the walls come from: "scans" (each for itself), "map" (the log's poses: residuals hold their errors and the
    sensors' delay, too), or "" (there are none)."""
    empty: str
    """Why there are no walls; empty if there are."""
    left_out: int
    """Echoes of pairs (tx, rx) that the ring does not listen to."""
    sigma: float
    """Robust standard deviation of the ranges around the walls, metres; NaN without walls."""
    direct: Int[np.ndarray, " sensors"]
    """Direct echoes in the log."""
    cross: Int[np.ndarray, " sensors"]
    """Cross echoes in the log that the sensor sent or heard."""
    expected: Int[np.ndarray, "sensors 3"]
    """Sightings of walls well inside the cones: direct, cross as transmitter, cross as receiver."""
    heard: Int[np.ndarray, "sensors 3"]
    """How many of them were heard."""
    place: Int[np.ndarray, " sensors"]
    """Which sensor of the ring it seems to be; itself where the wiring is right."""
    fits: Float[np.ndarray, "sensors 2"]
    """Share of its echoes that what stands around explains: as numbered, and at ``place``."""
    offset: Float[np.ndarray, " sensors"]
    """What it reports too much, relative to the others, metres."""
    offset_error: Float[np.ndarray, " sensors"]
    """Standard error of the offset, metres."""
    median: Float[np.ndarray, " sensors"]
    """Median residual of its direct echoes against walls from the other echoes, metres."""
    quartiles: Float[np.ndarray, "sensors 4"]
    """5, 25, 75 and 95 % points of the same residuals, metres."""
    spread: Float[np.ndarray, "sensors 2"]
    """1.4826 x median absolute deviation of the residuals, metres: of direct, and of all its echoes."""
    repeats: Float[np.ndarray, " sensors"]
    """Share of its nearest direct echoes whose range is exactly that of the scan before."""
    constant: Float[np.ndarray, "sensors 2"]
    """Its most frequent range, metres, and the share of its direct echoes that have it."""
    beam: Float[np.ndarray, " 2"]
    """Full width of the cones, measured, and its standard deviation, radians."""
    curve: Float[np.ndarray, " 4"]
    """Share heard as a function of the angle off the axis: half width, softness (both rad), share inside, outside."""
    asked: Int[np.ndarray, " bins"]
    """Direct sightings by angle off the axis, in bins of 2.5 deg from -90 to 90 deg."""
    answered: Int[np.ndarray, " bins"]
    """How many of them were heard."""
    beam_each: Float[np.ndarray, "sensors 2"]
    """Full width of each sensor's cone and its standard deviation, radians."""
    centre: Float[np.ndarray, "sensors 2"]
    """Where the middle of its cone looks, counter-clockwise from its heading, and its standard deviation, radians."""
    remarks: tuple[str, ...]
    """What is the matter with each sensor, in a few words; empty: nothing."""
    findings: tuple[str, ...]
    """One sentence for each thing that is not as it should be, the worst first; empty: healthy."""

    @property
    def nominal(self) -> float:
        """Mean full width of the cones as the ring has it, radians."""
        return float(np.mean(self.ring.beam))

    def as_json(self) -> dict[str, Any]:
        """Plain numbers for a JSON file, SI units and radians; null where there is nothing to tell."""

        def plain(value: Any) -> Any:
            if isinstance(value, np.ndarray):
                value = value.tolist()
            if isinstance(value, list | tuple):
                return [plain(item) for item in value]
            return None if isinstance(value, float) and not np.isfinite(value) else value

        return {"ring": self.ring.name, "nominal_beam": self.nominal} | {
            field.name: plain(getattr(self, field.name)) for field in fields(self) if field.name != "ring"
        }
