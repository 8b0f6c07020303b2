"""The ring: where the sensors sit, which of them hear each other, and in which directions (paper, section 3)."""

from collections.abc import Hashable, Sequence
from functools import cached_property, lru_cache
from operator import index
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.hardware.errors import SonarError

REFERENCE_SPEED_OF_SOUND = 343.2
"""m/s; a log's range is time of flight times this, halved, whatever the air was (20 deg C)."""

AnyArray = np.ndarray | jax.Array
"""NumPy outside, JAX (a tracer too) where a loss is differentiated with respect to the ring."""


LARGEST = 100.0
"""Metres; no ultrasonic ring is wider, and none hears farther."""


class Ring(eqx.Module):
    """Ultrasonic sensors on a robot, in the robot frame (x forward, y left, metres, radians).

    A pytree: sensor poses, range offsets and the speed of sound are leaves, so a loss can be differentiated with
    respect to them; what decides array shapes is static.
    """

    position: Float[AnyArray, "sensors 2"]
    """Mounting position (x, y) of each sensor, metres."""
    heading: Float[AnyArray, " sensors"]
    """Direction each sensor looks to, radians counter-clockwise from x."""
    beam: Float[AnyArray, " sensors"]
    """Full horizontal width of each detection cone, radians, in (0, pi]."""
    range_offset: Float[AnyArray, " sensors"]
    """What each sensor reports too much, metres; a path gets the mean of its two sensors."""
    speed_of_sound: Float[AnyArray, ""]
    """Metres per second."""
    neighbors: int = eqx.field(static=True)
    """Cross echoes are heard up to this neighbor on each side."""
    max_range: float = eqx.field(static=True)
    """Half path length up to which an echo counts, metres."""
    name: str = eqx.field(static=True)
    """What a person calls this ring."""

    def __init__(
        self,
        position: Float[AnyArray, "sensors 2"] | Sequence[tuple[float, float]],
        heading: Float[AnyArray, " sensors"] | Sequence[float],
        *,
        beam: Float[AnyArray, " sensors"] | Sequence[float] | float,
        neighbors: int,
        max_range: float,
        range_offset: Float[AnyArray, " sensors"] | Sequence[float] | float = 0.0,
        speed_of_sound: Float[AnyArray, ""] | float = REFERENCE_SPEED_OF_SOUND,
        name: str = "ring",
    ):
        """Any arrangement of sensors: a ring, a car bumper, two rings one above the other.

        The arguments are the fields, so ``dataclasses.replace(ring, neighbors=0)`` gives the same ring but for those.

        Args:
            position: (sensors, 2) mounting positions in the robot frame, metres.
            heading: (sensors,) directions, radians counter-clockwise from x.
            beam: full detection cone, radians, one for all or one each.
            neighbors: cross echoes are heard up to this many sensors further, counted through the list and around.
            max_range: largest half path length that counts as an echo, metres.
            range_offset: metres, subtracted from what the sensor reports; one for all or one each.
            speed_of_sound: metres per second.
            name: what a person calls this ring.

        Raises:
            SonarError: a value that no ring can have, named with what is allowed.
        """
        self.position = np.array(position, dtype=np.float64).reshape(-1, 2)
        self.heading = np.array(heading, dtype=np.float64).reshape(-1)
        count = len(self.position)
        self.beam = _one_each(beam, count, "beam")
        self.range_offset = _one_each(range_offset, count, "range_offset")
        self.speed_of_sound = np.array(speed_of_sound, dtype=np.float64)
        self.neighbors = _whole(neighbors, "neighbors")
        self.max_range = float(max_range)
        self.name = name
        self._check()
        for array in (self.position, self.heading, self.beam, self.range_offset, self.speed_of_sound):
            array.setflags(write=False)

    def _check(self) -> None:
        count = len(self.position)
        if count == 0 or len(self.heading) != count:
            raise SonarError(
                f"ring: {count} positions and {len(self.heading)} headings came; allowed is one each, at least one"
            )
        for field in ("position", "heading", "beam", "range_offset", "speed_of_sound"):
            if not np.isfinite(getattr(self, field)).all():
                raise SonarError(f"ring: {field} holds a value that is not finite; allowed are finite numbers")
        if not ((self.beam > 0) & (self.beam <= np.pi + 1e-9)).all():
            worst = self.beam[(self.beam <= 0) | (self.beam > np.pi + 1e-9)][0]
            raise SonarError(f"ring: beam {np.degrees(worst):g} deg; allowed is more than 0 and at most 180 deg")
        if not 0 <= self.neighbors < count:
            raise SonarError(f"ring: neighbors {self.neighbors}; allowed is 0 to {count - 1} with {count} sensors")
        if not 0 < self.max_range <= LARGEST:
            raise SonarError(f"ring: max_range {self.max_range:g} m; allowed is more than 0 and at most {LARGEST:g} m")
        for field in ("position", "range_offset"):
            if (worst := np.abs(getattr(self, field)).max()) > LARGEST:
                raise SonarError(f"ring: {field} {worst:g} m; allowed is at most {LARGEST:g} m either way")
        if (worst := np.degrees(np.abs(self.heading).max())) > 720:
            raise SonarError(f"ring: heading {worst:g} deg; allowed is at most 720 deg either way")
        if not 0 < self.speed_of_sound <= 10_000:
            raise SonarError(f"ring: speed_of_sound {self.speed_of_sound:g} m/s; allowed is more than 0, at most 10000")

    @classmethod
    def circular(
        cls,
        *,
        count: int = 24,
        radius: float = 0.28,
        beam: float = np.pi / 3,
        neighbors: int = 3,
        max_range: float = 2.0,
        first_heading: float = 0.0,
        speed_of_sound: float = REFERENCE_SPEED_OF_SOUND,
        name: str = "ring",
    ) -> "Ring":
        """Sensors evenly around a circle, looking outward, counter-clockwise; the defaults are the paper's ring.

        Args:
            count: number of sensors.
            radius: radius of the circle, metres.
            beam: full horizontal detection cone of every sensor, radians.
            neighbors: cross echoes are heard up to this neighbor on each side.
            max_range: largest half path length that counts as an echo, metres.
            first_heading: direction of sensor 0, radians.
            speed_of_sound: metres per second.
            name: what a person calls this ring.

        Raises:
            SonarError: a value that no ring can have, named with what is allowed.
        """
        if _whole(count, "count") < 1:
            raise SonarError(f"ring: count {count}; allowed is 1 or more")
        if not 0 <= radius <= LARGEST:
            raise SonarError(f"ring: radius {radius:g} m; allowed is 0 or more, at most {LARGEST:g} m")
        heading = first_heading + 2 * np.pi * np.arange(count) / count
        position = radius * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        return cls(
            position,
            heading,
            beam=beam,
            neighbors=neighbors,
            max_range=max_range,
            speed_of_sound=speed_of_sound,
            name=name,
        )

    @property
    def count(self) -> int:
        """Number of sensors."""
        return len(self.position)

    @property
    def paths(self) -> Int[np.ndarray, "paths 2"]:
        """Echo paths (tx, rx), by neighbor offset 0, +1, -1, +2, -2, ... and then by tx; rx = (tx + offset) mod count.

        An offset that leads to the receivers of an earlier one (as +2 and -2 in a ring of four) is listed once.
        """
        return _paths(self.count, self.neighbors)

    @property
    def path_index(self) -> Int[np.ndarray, "sensors sensors"]:
        """Row of ``paths`` that holds (tx, rx), or -1 where that pair is no echo path of this ring."""
        return _path_index(self.count, self.neighbors)

    @property
    def sensors(self) -> kernels.Sensors:
        """The ring as the kernels take it; differentiable in every leaf of the ring."""
        paths = self.paths.astype(np.int32)
        return kernels.Sensors(
            position=jnp.asarray(self.position),
            heading=jnp.asarray(self.heading),
            beam=jnp.asarray(self.beam),
            range_offset=jnp.asarray(self.range_offset),
            range_scale=jnp.asarray(self.speed_of_sound / REFERENCE_SPEED_OF_SOUND),
            max_range=jnp.asarray(self.max_range),
            tx=jnp.asarray(paths[:, 0]),
            rx=jnp.asarray(paths[:, 1]),
        )

    @property
    def echo_paths(self) -> kernels.EchoPaths:
        """Geometry of every path, in the order of ``paths``."""
        return kernels.echo_paths(self.sensors)

    @cached_property
    def cache(self) -> dict[Hashable, Any]:
        """Values that other packages derive from this ring and compute once, by keys of their own.

        A changed copy of the ring starts with an empty cache.
        """
        return {}

    @cached_property
    def exact_paths(self) -> kernels.EchoPaths:
        """``echo_paths`` as read-only NumPy arrays in double precision, computed once per ring."""

        def exact(leaf: jax.Array) -> np.ndarray:
            array = np.array(leaf, dtype=np.float64)
            array.setflags(write=False)
            return array

        return jax.tree.map(exact, self.echo_paths)

    @property
    def virtual_sensors(self) -> Float[AnyArray, "paths 2"]:
        """Midpoint of tx and rx of each path, robot frame, metres (paper, section 5)."""
        return self.echo_paths.midpoint

    @property
    def detection_ranges(self) -> Float[AnyArray, "paths 2"]:
        """Directions (first, last) from which each path hears a plane, radians, counter-clockwise (paper, section 3).

        The intersection of the two cones: 60, 45, 30 and 15 deg wide in the paper's ring. Empty where the cones do not
        overlap: first and last are then equal.
        """
        paths = self.echo_paths
        return jnp.stack([paths.start, paths.start + paths.width], axis=-1)

    @property
    def firing_groups(self) -> tuple[Int[np.ndarray, " group"], ...]:
        """Sensors that fire at once without mutual interference, group after group (paper, section 3).

        Within a group any two sensors are at least 2 * neighbors + 2 apart, so that no receiver listens to both and the
        one in the middle hears nothing: every eighth sensor in the paper's ring, eight groups. Where the spacing does
        not divide the ring, it is wider here and there, never narrower.
        """
        together = max(1, self.count // (2 * self.neighbors + 2))
        blocks = np.array_split(np.arange(self.count), together)
        longest = max(len(block) for block in blocks)
        return tuple(np.array([block[k] for block in blocks if k < len(block)]) for k in range(longest))

    def corrected(
        self, reported: Float[AnyArray, "*echoes"], tx: Int[AnyArray, "*echoes"], rx: Int[AnyArray, "*echoes"]
    ) -> Float[AnyArray, "*echoes"]:
        """Half path lengths in metres from a log's ranges: offsets taken off, then scaled to this speed of sound."""
        offset = 0.5 * (self.range_offset[tx] + self.range_offset[rx])
        return (reported - offset) * (self.speed_of_sound / REFERENCE_SPEED_OF_SOUND)


def speed_of_sound(temperature: float) -> float:
    """Metres per second in dry air of this temperature, deg C."""
    return 331.3 * float(np.sqrt(1 + temperature / 273.15))


def _one_each(
    value: Float[AnyArray, " sensors"] | Sequence[float] | float, count: int, field: str
) -> Float[np.ndarray, " sensors"]:
    values = np.array(value, dtype=np.float64)
    if values.shape not in ((), (count,)):
        raise SonarError(f"ring: {field} of shape {values.shape}; allowed is one for all, or one for each of {count}")
    return np.array(np.broadcast_to(values, (count,)))


def _whole(value: int, field: str) -> int:
    try:
        return index(value)
    except TypeError:
        raise SonarError(f"ring: {field} {value!r}; allowed is a whole number") from None


@lru_cache(maxsize=8)
def _paths(count: int, neighbors: int) -> Int[np.ndarray, "paths 2"]:
    """``Ring.paths``, read-only; asked for with every scan."""
    offsets = [0] + [sign * k for k in range(1, neighbors + 1) for sign in (1, -1)]
    distinct = list(dict.fromkeys(offset % count for offset in offsets))
    tx = np.tile(np.arange(count), len(distinct))
    paths = np.stack([tx, (tx + np.repeat(distinct, count)) % count], axis=-1)
    paths.setflags(write=False)
    return paths


@lru_cache(maxsize=8)
def _path_index(count: int, neighbors: int) -> Int[np.ndarray, "sensors sensors"]:
    """``Ring.path_index``, read-only."""
    paths, index = _paths(count, neighbors), np.full((count, count), -1)
    index[paths[:, 0], paths[:, 1]] = np.arange(len(paths))
    index.setflags(write=False)
    return index
