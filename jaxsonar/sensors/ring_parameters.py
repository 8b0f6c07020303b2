"""What may change about a ring, and what is expected of it: the modes along which calibration moves it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxsonar.hardware.errors import SonarError
from jaxsonar.sensors.ring import Ring

FREE = ("offset", "speed", "position", "radius", "heading")
"""What can be estimated of a ring."""
DEFAULT_FREE = ("offset", "speed")
AIR = (290.0, 380.0)
"""Metres per second; sound in air from -60 to 85 deg C."""
OFFSET_SD = 0.03
"""Metres; range offsets before calibration: delays of detectors, a few wavelengths."""
SPEED_SD = 0.015
"""Relative; an unknown temperature between about 11 and 29 deg C, or a scale that a driver got wrong by so much."""
THERMOMETER_SD = 0.001
"""Relative; a measured temperature, to about half a kelvin."""
POSITION_SD = 0.005
"""Metres; how far from its place a sensor may be mounted."""
RADIUS_SD = 0.05
"""Metres; a radius that was guessed."""


@dataclass(frozen=True)
class RingModes:
    """Columns that say how (offsets, log speed of sound, positions) may change, each with the prior N(0, 1)."""

    columns: Float[np.ndarray, "ring modes"]
    """Metres, relative, metres; rows: offsets (sensors), log speed, x and y of every sensor."""
    names: tuple[str, ...]
    """What each column belongs to: a name of ``FREE``, or "mean"."""

    def only(self, *names: str) -> "RingModes":
        """The same shape, the columns of other names held at 0: so that nothing is compiled anew."""
        kept = np.array([name in names for name in self.names])
        return RingModes(self.columns * kept, self.names)


def ring_modes(ring: Ring, free: Sequence[str], *, poses_free: bool, speed_sd: float) -> RingModes:
    """The modes of a ring.

    Args:
        ring: the sensors where they are thought to be.
        free: names of ``FREE``.
        poses_free: whether the poses are estimated: then moving or turning all sensors together moves the robot's frame
            and is no change of the ring.
        speed_sd: relative standard deviation that is expected of the speed of sound.
    """
    count = ring.count
    position = np.asarray(ring.position, np.float64)
    blocks: list[tuple[str, np.ndarray]] = []

    def add(name: str, columns: np.ndarray, begin: int) -> None:
        whole = np.zeros((3 * count + 1, columns.shape[1]))
        whole[begin : begin + len(columns)] = columns
        blocks.append((name, whole))

    if "offset" in free:
        level = np.full((count, count), 1 / count)
        add("offset", OFFSET_SD * (np.eye(count) - level), 0)
        add("mean", np.full((count, 1), OFFSET_SD), 0)
    if "speed" in free:
        add("speed", np.full((1, 1), speed_sd), count)
    if "position" in free:
        add("position", POSITION_SD * _without_motion(position, poses_free), count + 1)
    if "radius" in free:
        outward = position - position.mean(axis=0)
        far = np.linalg.norm(outward, axis=1).mean()
        if far == 0:
            raise SonarError(f"ring {ring.name!r}: all sensors are in one place; allowed for a free radius is a ring")
        add("radius", RADIUS_SD * (outward / far).reshape(-1, 1), count + 1)
    if not blocks:
        add("none", np.zeros((1, 1)), 0)
    columns = np.concatenate([columns for _, columns in blocks], axis=1)
    return RingModes(columns, tuple(name for name, block in blocks for _ in range(block.shape[1])))


def _without_motion(position: Float[np.ndarray, "sensors 2"], poses_free: bool) -> Float[np.ndarray, "places places"]:
    """Projector on changes of the positions that are no motion of the whole array; the identity for known poses."""
    size = position.size
    if not poses_free:
        return np.eye(size)
    turned = np.stack([-position[:, 1], position[:, 0]], axis=1).ravel()
    along_x, along_y = np.tile([1.0, 0.0], len(position)), np.tile([0.0, 1.0], len(position))
    basis, strength, _ = np.linalg.svd(np.stack([along_x, along_y, turned], axis=1), full_matrices=False)
    basis = basis[:, strength > 1e-9]
    return np.eye(size) - basis @ basis.T


def check_free(free: Sequence[str]) -> None:
    """Raise a SonarError for something that cannot be estimated."""
    for name in free:
        if name not in FREE:
            raise SonarError(f"free {name!r}; allowed are {', '.join(FREE)}")
    if len(set(free)) < len(free):
        raise SonarError(f"free {', '.join(free)}: one came twice; allowed is each of {', '.join(FREE)} once")
    if not free:
        raise SonarError(f"free: nothing came; allowed are one or more of {', '.join(FREE)}")


def check_air(ring: Ring) -> None:
    """Raise a SonarError for a speed of sound that no air has."""
    speed, (low, high) = float(ring.speed_of_sound), AIR
    if not low <= speed <= high:
        raise SonarError(
            f"ring {ring.name!r}: speed_of_sound {speed:g} m/s; allowed is that of air, {low:g} to {high:g}"
        )
