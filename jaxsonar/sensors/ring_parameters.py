"""Reduced parameter basis of a ring for calibration, with a Gaussian prior on every parameter."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxsonar.hardware.errors import SonarError
from jaxsonar.sensors.ring import Ring

PARAMETERS = ("offset", "speed", "position", "radius", "heading")
"""Groups of ring parameters that can be estimated."""
DEFAULT_PARAMETERS = ("offset", "speed")
"""Groups that are estimated unless others are chosen."""


@dataclass(frozen=True)
class RingPrior:
    """Prior standard deviations of ring parameters before calibration, and the range of valid speeds of sound."""

    offset_sd: float = 0.03
    """Range offsets, metres: delays of detectors, a few wavelengths."""
    speed_sd: float = 0.015
    """Speed of sound, relative: an unknown temperature between about 11 and 29 deg C, or an equal scale error."""
    measured_speed_sd: float = 0.001
    """Speed of sound after a temperature measurement, relative: about half a kelvin."""
    position_sd: float = 0.005
    """Mounting positions, metres."""
    radius_sd: float = 0.05
    """Radius of a ring that was guessed, metres."""
    min_speed: float = 290.0
    """Smallest speed of sound in air, metres per second: -60 deg C."""
    max_speed: float = 380.0
    """Largest speed of sound in air, metres per second: 85 deg C."""


PRIOR = RingPrior()


@dataclass(frozen=True)
class ParameterBasis:
    """Linear basis of changes of a ring: each coefficient has the prior N(0, 1). A fixed parameter has no column."""

    columns: Float[np.ndarray, "parameters basis"]
    """Change of the ring per unit of each coefficient. Rows: range offsets of all sensors (metres), log speed of sound,
    x and y of every sensor (metres)."""
    names: tuple[str, ...]
    """Parameter group of each column: a name from ``PARAMETERS``, or "mean" for the mean range offset."""

    def only(self, *names: str) -> "ParameterBasis":
        """The basis with all other columns set to 0. The shape stays, so that no kernel is compiled again."""
        kept = np.array([name in names for name in self.names])
        return ParameterBasis(self.columns * kept, self.names)


def parameter_basis(ring: Ring, free: Sequence[str], *, poses_free: bool, speed_sd: float) -> ParameterBasis:
    """Basis of the chosen parameter groups.

    Range offsets are split into deviations that sum to zero and their mean, because the mean can be held separately.

    Args:
        ring: nominal sensors.
        free: names from ``PARAMETERS``.
        poses_free: whether poses are estimated as well. A common motion of all sensors is then equivalent to a change
            of the robot frame (gauge freedom), and the positions' basis does not contain it.
        speed_sd: prior standard deviation of the speed of sound, relative.

    Raises:
        SonarError: the radius is free, but all sensors have one position.
    """
    count = ring.count
    position = np.asarray(ring.position, np.float64)
    blocks: list[tuple[str, np.ndarray]] = []

    def add(name: str, columns: np.ndarray, first_row: int) -> None:
        block = np.zeros((3 * count + 1, columns.shape[1]))
        block[first_row : first_row + len(columns)] = columns
        blocks.append((name, block))

    if "offset" in free:
        mean = np.full((count, count), 1 / count)
        add("offset", PRIOR.offset_sd * (np.eye(count) - mean), 0)
        add("mean", np.full((count, 1), PRIOR.offset_sd), 0)
    if "speed" in free:
        add("speed", np.full((1, 1), speed_sd), count)
    if "position" in free:
        add("position", PRIOR.position_sd * _position_projector(position, poses_free), count + 1)
    if "radius" in free:
        outward = position - position.mean(axis=0)
        radius = np.linalg.norm(outward, axis=1).mean()
        if radius == 0:
            raise SonarError(f"ring {ring.name!r}: all sensors are in one place; allowed for a free radius is a ring")
        add("radius", PRIOR.radius_sd * (outward / radius).reshape(-1, 1), count + 1)
    if not blocks:
        add("none", np.zeros((1, 1)), 0)
    columns = np.concatenate([columns for _, columns in blocks], axis=1)
    return ParameterBasis(columns, tuple(name for name, block in blocks for _ in range(block.shape[1])))


def _position_projector(
    position: Float[np.ndarray, "sensors 2"], poses_free: bool
) -> Float[np.ndarray, "coordinates coordinates"]:
    """Projector onto position changes without common translation and rotation; the identity for known poses."""
    size = position.size
    if not poses_free:
        return np.eye(size)
    rotation = np.stack([-position[:, 1], position[:, 0]], axis=1).ravel()
    shift_x, shift_y = np.tile([1.0, 0.0], len(position)), np.tile([0.0, 1.0], len(position))
    basis, singular, _ = np.linalg.svd(np.stack([shift_x, shift_y, rotation], axis=1), full_matrices=False)
    basis = basis[:, singular > 1e-9]
    return np.eye(size) - basis @ basis.T


def check_parameters(free: Sequence[str]) -> None:
    """Raise a SonarError for a name that is not in ``PARAMETERS``, a repeated name, or no name."""
    for name in free:
        if name not in PARAMETERS:
            raise SonarError(f"free {name!r}; allowed are {', '.join(PARAMETERS)}")
    if len(set(free)) < len(free):
        raise SonarError(f"free {', '.join(free)}: one came twice; allowed is each of {', '.join(PARAMETERS)} once")
    if not free:
        raise SonarError(f"free: nothing came; allowed are one or more of {', '.join(PARAMETERS)}")


def check_speed_of_sound(ring: Ring) -> None:
    """Raise a SonarError for a speed of sound that air does not have."""
    speed, low, high = float(ring.speed_of_sound), PRIOR.min_speed, PRIOR.max_speed
    if not low <= speed <= high:
        raise SonarError(
            f"ring {ring.name!r}: speed_of_sound {speed:g} m/s; allowed is that of air, {low:g} to {high:g}"
        )
