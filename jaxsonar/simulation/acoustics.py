"""Amplitudes of traced echoes, and the echoes that a threshold detector reports."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.hardware.errors import SonarError
from jaxsonar.simulation.traced_echoes import EchoKind, TracedEchoes


@dataclass(frozen=True)
class Acoustics:
    """Acoustic model. Amplitudes are relative to the direct echo of a large smooth wall on the axis at 1 m.

    Raises:
        SonarError: a value out of the range given.
    """

    reflectivity: float = 1.0
    """Amplitude factor of each reflection at a wall, (0, 1]; about 1 for smooth hard walls."""
    edge_strength: float = 0.02
    """Amplitude of an edge 1 m from both sensors, >= 0; falls with sqrt(d1 d2 (d1 + d2)) of the two distances, a
    cylindrical wave from a point source. 0.02 is a half plane at 40 kHz away from its specular direction (Keller's
    diffraction coefficient 1 / sqrt(8 pi k) and its obliquity factor of 1 to 2)."""
    pole_strength: float = 0.1
    """Amplitude of a thin pole 1 m from both sensors, >= 0; falls like that of an edge. 0.1 is a smooth pole of 1 cm
    radius, such as a table leg: sqrt(radius / distance) of the amplitude of a wall at the same distance."""
    beam_edge_db: float = 6.0
    """One-way loss at the border of a sensor's cone, dB, >= 0; Gaussian in the off-axis angle. Data sheets of such
    transducers define the beam angle by 6 dB."""
    absorption_db_per_m: float = 1.3
    """Loss in air per metre of path beyond the 2 m of the reference wall (a gain for shorter paths), dB/m, >= 0.
    1.3 dB/m is 40 kHz at 20 deg C and 50 % relative humidity (ISO 9613-1)."""
    threshold: float = 0.02
    """Smallest amplitude that is detected, >= 0."""

    def __post_init__(self):
        for field in fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value >= 0):
                raise SonarError(f"acoustics: {field.name} {value:g}; allowed are finite numbers, 0 or more")
        if not 0 < self.reflectivity <= 1:
            raise SonarError(f"acoustics: reflectivity {self.reflectivity:g}; allowed is more than 0 and at most 1")


def amplitudes(
    found: TracedEchoes,
    pairs: Int[np.ndarray, "pairs 2"],
    sensors: Float[np.ndarray, "groups sensors 2"],
    axis: Float[np.ndarray, "groups sensors 2"],
    half_beam: Float[np.ndarray, " sensors"],
    acoustics: Acoustics,
    radius: Float[np.ndarray, " circles"],
) -> Float[np.ndarray, " found"]:
    """Amplitude of each echo: reflection or scattering, spreading, beam pattern and absorption.

    Args:
        found: the echoes.
        pairs: (pairs, 2) sensor indices tx, rx.
        sensors: (groups, sensors, 2) positions, world frame, metres.
        axis: (groups, sensors, 2) unit vectors of the sensor axes.
        half_beam: (sensors,) half the width of each cone, radians.
        acoustics: the acoustic model.
        radius: radii of the circles of the room, metres.
    """
    tx, rx = pairs[found.pair].T
    distance_tx, angle_tx = _distance_and_angle(sensors[found.group, tx], axis[found.group, tx], found.first)
    distance_rx, angle_rx = _distance_and_angle(sensors[found.group, rx], axis[found.group, rx], found.last)
    with np.errstate(divide="ignore"):
        scattered = np.sqrt(2.0 / (distance_tx * distance_rx * (distance_tx + distance_rx)))
    single = (found.kind == EchoKind.PLANE) | (found.kind == EchoKind.CIRCLE)
    reflections = np.where(single, 1, 2)
    strength = np.select(
        [found.kind == EchoKind.EDGE, found.kind == EchoKind.POLE],
        [acoustics.edge_strength * scattered, acoustics.pole_strength * scattered],
        acoustics.reflectivity**reflections / (found.length / 2),
    )
    # A convex mirror widens the wave: at equal distances d, the amplitude falls by sqrt(radius / (radius + d)).
    at = np.flatnonzero(found.kind == EchoKind.CIRCLE)
    r, near, far = radius[found.reflector[at]], distance_tx[at], distance_rx[at]
    strength[at] *= np.sqrt(r / (r + 2 * near * far / (near + far)))
    off_axis = (angle_tx / half_beam[tx]) ** 2 + (angle_rx / half_beam[rx]) ** 2
    loss_db = acoustics.beam_edge_db * off_axis + acoustics.absorption_db_per_m * (found.length - 2.0)
    return strength * 10 ** (-loss_db / 20)


def unblanked(
    key: Int[np.ndarray, " echoes"], distance: Float[np.ndarray, " echoes"], blanking: float, max_echoes: int
) -> Int[np.ndarray, " kept"]:
    """Indices of the echoes that each path reports: the first one, then the next that is ``blanking`` further, etc.

    Args:
        key: path of each echo, not negative; echoes are sorted by path, then by distance.
        distance: half path lengths, metres.
        blanking: smallest difference of consecutive reported echoes, metres.
        max_echoes: largest number of echoes of a path.
    """
    first = np.flatnonzero(np.diff(key, prepend=-1))
    rank = ranks(key)
    table = np.full((len(first), rank.max(initial=0) + 1), np.inf)
    table[np.cumsum(rank == 0) - 1, rank] = distance
    index = np.arange(table.shape[1])
    column = np.zeros(len(first), dtype=int)
    kept = [first]
    for _ in range(1, min(max_echoes, table.shape[1])):
        last = np.take_along_axis(table, column[:, None], axis=1)
        later = np.isfinite(table) & (index > column[:, None]) & (table >= last + blanking)
        more = later.any(axis=1)
        table, first, column = table[more], first[more], later[more].argmax(axis=1)
        kept.append(first + column)
    return np.sort(np.concatenate(kept))


def ranks(key: Int[np.ndarray, " echoes"]) -> Int[np.ndarray, " echoes"]:
    """Position of each entry among those with the same key; keys are sorted and not negative."""
    first = np.flatnonzero(np.diff(key, prepend=-1))
    return np.arange(len(key)) - np.repeat(first, np.diff(np.append(first, len(key))))


def _distance_and_angle(
    sensor: Float[np.ndarray, "found 2"], axis: Float[np.ndarray, "found 2"], point: Float[np.ndarray, "found 2"]
) -> tuple[Float[np.ndarray, " found"], Float[np.ndarray, " found"]]:
    """Distance of a point from a sensor, metres, and its angle off the sensor's axis, radians."""
    leg = point - sensor
    across = axis[:, 0] * leg[:, 1] - axis[:, 1] * leg[:, 0]
    return np.linalg.norm(leg, axis=-1), np.abs(np.arctan2(across, (axis * leg).sum(-1)))
