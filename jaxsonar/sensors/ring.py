"""The sensor array: sensor poses, echo paths and detection ranges (paper, section 3)."""

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
from jaxsonar.fileio.atomic_files import shown
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.messages import REFERENCE_SPEED_OF_SOUND

AnyArray = np.ndarray | jax.Array
"""NumPy arrays as a rule; JAX arrays or tracers where a loss is differentiated with respect to the ring."""

MAX_SIZE = 100.0
"""Largest position, radius, range offset and maximum range of an ultrasonic ring, metres."""


class Ring(eqx.Module):
    """Ultrasonic sensors on a robot, in the robot frame (x forward, y left; metres, radians).

    The ring is a pytree. Sensor poses, beams, range offsets and the speed of sound are leaves, so that a loss can be
    differentiated with respect to them. The fields that determine array shapes are static.
    """

    position: Float[AnyArray, "sensors 2"]
    """Mounting position (x, y) of each sensor, metres."""
    heading: Float[AnyArray, " sensors"]
    """Direction of each sensor's axis, radians counter-clockwise from x."""
    beam: Float[AnyArray, " sensors"]
    """Full horizontal width of each detection cone, radians, in (0, pi]."""
    range_offset: Float[AnyArray, " sensors"]
    """Constant error of the reported range of each sensor, metres; that of a path is the mean of its two sensors."""
    speed_of_sound: Float[AnyArray, ""]
    """Metres per second."""
    neighbors: int = eqx.field(static=True)
    """Cross echoes are received up to this neighbor on each side."""
    closed: bool = eqx.field(static=True)
    """Whether the list of sensors closes to a ring: are the last and the first sensor neighbors?"""
    max_range: float = eqx.field(static=True)
    """Largest half path length of an echo, metres."""
    name: str = eqx.field(static=True)
    """Name in messages and figures."""
    names: tuple[str, ...] = eqx.field(static=True)
    """How recordings of other robots call each sensor: a topic if it begins with "/", otherwise the frame of its
    messages; "" for a sensor without a name. The tuple is empty if no sensor has a name."""

    def __init__(
        self,
        position: Float[AnyArray, "sensors 2"] | Sequence[tuple[float, float]],
        heading: Float[AnyArray, " sensors"] | Sequence[float],
        *,
        beam: Float[AnyArray, " sensors"] | Sequence[float] | float,
        neighbors: int,
        max_range: float,
        closed: bool | None = None,
        range_offset: Float[AnyArray, " sensors"] | Sequence[float] | float = 0.0,
        speed_of_sound: Float[AnyArray, ""] | float = REFERENCE_SPEED_OF_SOUND,
        name: str = "ring",
        names: Sequence[str] = (),
    ):
        """Build an array of any arrangement: a ring, a car bumper, two rings one above the other.

        The arguments are the fields; ``dataclasses.replace(ring, neighbors=0)`` gives a changed copy.

        Args:
            position: (sensors, 2) mounting positions, robot frame, metres.
            heading: (sensors,) directions of the axes, radians counter-clockwise from x.
            beam: full width of the detection cone, radians, one for all sensors or one each.
            neighbors: cross echoes are received up to this many sensors away in the list, which is cyclic if closed.
            max_range: largest half path length of an echo, metres.
            closed: whether the last and the first sensor are neighbors; None decides from positions and headings.
            range_offset: subtracted from the reported range, metres, one for all sensors or one each.
            speed_of_sound: metres per second.
            name: name in messages and figures.
            names: topic or frame of each sensor in recordings of other robots, one each, or none at all.

        Raises:
            SonarError: a value out of range; the message names it and the allowed range.
        """
        self.position = np.array(position, dtype=np.float64).reshape(-1, 2)
        self.heading = np.array(heading, dtype=np.float64).reshape(-1)
        count = len(self.position)
        self.beam = _one_each(beam, count, "beam")
        self.range_offset = _one_each(range_offset, count, "range_offset")
        self.speed_of_sound = np.array(speed_of_sound, dtype=np.float64)
        self.neighbors = _whole(neighbors, "neighbors")
        self.closed = _is_closed(self.position, self.heading) if closed is None else bool(closed)
        self.max_range = float(max_range)
        self.name = name
        self.names = tuple(str(one) for one in names) if any(names) else ()
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
        if not 0 < self.max_range <= MAX_SIZE:
            allowed = f"allowed is more than 0 and at most {MAX_SIZE:g} m{_other_unit(self.max_range)}"
            raise SonarError(f"ring: max_range {self.max_range:g} m; {allowed}")
        for field in ("position", "range_offset"):
            if (worst := np.abs(getattr(self, field)).max()) > MAX_SIZE:
                allowed = f"allowed is at most {MAX_SIZE:g} m either way{_other_unit(worst)}"
                raise SonarError(f"ring: {field} {worst:g} m; {allowed}")
        if (worst := np.degrees(np.abs(self.heading).max())) > 720:
            raise SonarError(f"ring: heading {worst:g} deg; allowed is at most 720 deg either way")
        if not 0 < self.speed_of_sound <= 10_000:
            hint = "; is it in cm/s, mm/s or inches per second?" if self.speed_of_sound > 10_000 else ""
            allowed = f"allowed is more than 0, at most 10000{hint}"
            raise SonarError(f"ring: speed_of_sound {self.speed_of_sound:g} m/s; {allowed}")
        if self.names and len(self.names) != count:
            raise SonarError(f"ring: {len(self.names)} names came; allowed is one for each of {count} sensors, or none")
        given = [one for one in self.names if one]
        if twice := next((one for one in given if given.count(one) > 1), None):
            raise SonarError(f"ring: the name {shown(twice)} came twice; allowed is one sensor for each name")

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
        names: Sequence[str] = (),
    ) -> "Ring":
        """Build a ring of evenly spaced sensors that face outward, counter-clockwise; by default the paper's ring.

        Args:
            count: number of sensors.
            radius: radius of the circle, metres.
            beam: full horizontal width of every detection cone, radians.
            neighbors: cross echoes are received up to this neighbor on each side.
            max_range: largest half path length of an echo, metres.
            first_heading: direction of the axis of sensor 0, radians.
            speed_of_sound: metres per second.
            name: name in messages and figures.
            names: as in the constructor.

        Raises:
            SonarError: a value out of range; the message names it and the allowed range.
        """
        if _whole(count, "count") < 1:
            raise SonarError(f"ring: count {count}; allowed is 1 or more")
        if not 0 <= radius <= MAX_SIZE:
            allowed = f"allowed is 0 or more, at most {MAX_SIZE:g} m{_other_unit(radius)}"
            raise SonarError(f"ring: radius {radius:g} m; {allowed}")
        heading = first_heading + 2 * np.pi * np.arange(count) / count
        position = radius * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        return cls(
            position,
            heading,
            beam=beam,
            neighbors=neighbors,
            max_range=max_range,
            closed=True,
            speed_of_sound=speed_of_sound,
            name=name,
            names=names,
        )

    @property
    def count(self) -> int:
        """Number of sensors."""
        return len(self.position)

    @property
    def paths(self) -> Int[np.ndarray, "paths 2"]:
        """Echo paths (tx, rx), ordered by neighbor offset 0, +1, -1, +2, -2, ..., then by tx.

        The receiver is rx = (tx + offset) mod count. Offsets that give the same receivers, such as +2 and -2 in a ring
        of four sensors, are listed once. In an open array, pairs that are more than ``neighbors`` apart in the list are
        left out: those that only its two ends make neighbors.
        """
        return _paths(self.count, self.neighbors, self.closed)

    @property
    def path_index(self) -> Int[np.ndarray, "sensors sensors"]:
        """Row of ``paths`` for each (tx, rx); -1 if the pair is no echo path of this ring."""
        return _path_index(self.count, self.neighbors, self.closed)

    @property
    def sensors(self) -> kernels.SensorArray:
        """The ring as an argument of kernels; differentiable with respect to every leaf of the ring."""
        paths = self.paths.astype(np.int32)
        return kernels.SensorArray(
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
        """Directions (first, last) in which each path detects a plane, radians, counter-clockwise (paper, section 3).

        It is the intersection of the two cones: 60, 45, 30 and 15 deg wide in the paper's ring. If the cones do not
        overlap it is empty, with equal first and last directions.
        """
        paths = self.echo_paths
        return jnp.stack([paths.start, paths.start + paths.width], axis=-1)

    @property
    def firing_groups(self) -> tuple[Int[np.ndarray, " group"], ...]:
        """Groups of sensors that fire simultaneously without mutual interference, in firing order (paper, section 3).

        Any two sensors of a group are at least 2 * neighbors + 2 apart, so that no receiver listens to both: every
        eighth sensor of the paper's ring, in eight groups. If this spacing does not divide the number of sensors, some
        gaps of a ring are wider; some groups of an open array have a sensor less.
        """
        if not self.closed:
            spacing = min(2 * self.neighbors + 2, self.count)
            return tuple(np.arange(first, self.count, spacing) for first in range(spacing))
        together = max(1, self.count // (2 * self.neighbors + 2))
        blocks = np.array_split(np.arange(self.count), together)
        longest = max(len(block) for block in blocks)
        return tuple(np.array([block[k] for block in blocks if k < len(block)]) for k in range(longest))

    @property
    def firing_group_of_sensor(self) -> Int[np.ndarray, " sensors"]:
        """Index of each sensor's group in ``firing_groups``."""
        group = np.empty(self.count, dtype=np.int64)
        for k, sensors in enumerate(self.firing_groups):
            group[sensors] = k
        return group

    def corrected(
        self, reported: Float[AnyArray, "*echoes"], tx: Int[AnyArray, "*echoes"], rx: Int[AnyArray, "*echoes"]
    ) -> Float[AnyArray, "*echoes"]:
        """Half path lengths (metres) from a log's ranges: subtract the path's offset, scale to this speed of sound."""
        offset = 0.5 * (self.range_offset[tx] + self.range_offset[rx])
        return (reported - offset) * (self.speed_of_sound / REFERENCE_SPEED_OF_SOUND)


def speed_of_sound(temperature: float) -> float:
    """Speed of sound in dry air, metres per second, at a temperature in deg C."""
    return 331.3 * float(np.sqrt(1 + temperature / 273.15))


def _one_each(
    value: Float[AnyArray, " sensors"] | Sequence[float] | float, count: int, field: str
) -> Float[np.ndarray, " sensors"]:
    values = np.array(value, dtype=np.float64)
    if values.shape not in ((), (count,)):
        raise SonarError(f"ring: {field} of shape {values.shape}; allowed is one for all, or one for each of {count}")
    return np.array(np.broadcast_to(values, (count,)))


def _other_unit(value: float) -> str:
    """A question about the unit of a length of metres that is too large; empty for other values."""
    if not MAX_SIZE < value < np.inf:
        return ""
    return "; is it in mm?" if value >= 10 * MAX_SIZE else "; is it in mm or cm?"


def _whole(value: int, field: str) -> int:
    try:
        return index(value)
    except TypeError:
        raise SonarError(f"ring: {field} {value!r}; allowed is a whole number") from None


def _is_closed(position: Float[np.ndarray, "sensors 2"], heading: Float[np.ndarray, " sensors"]) -> bool:
    """Whether sensors surround the robot: the headings turn once or more, and the last step is one of the usual ones.

    The step from the last sensor to the first may be twice as long as the longest other one, so that one sensor may be
    missing, and a ring remains closed after a calibration.
    """
    if len(position) < 3:
        return True
    steps = np.linalg.norm(np.roll(position, -1, axis=0) - position, axis=1)
    turns = wrap_angle(np.roll(heading, -1) - heading)
    return bool(abs(turns.sum()) > np.pi and steps[-1] <= 2 * steps[:-1].max() + 1e-9)


@lru_cache(maxsize=8)
def _paths(count: int, neighbors: int, closed: bool) -> Int[np.ndarray, "paths 2"]:
    """``Ring.paths`` as a read-only array; cached because every scan needs it."""
    offsets = [0] + [sign * k for k in range(1, neighbors + 1) for sign in (1, -1)]
    distinct = list(dict.fromkeys(offset % count for offset in offsets))
    tx = np.tile(np.arange(count), len(distinct))
    paths = np.stack([tx, (tx + np.repeat(distinct, count)) % count], axis=-1)
    if not closed:
        paths = paths[np.abs(paths[:, 1] - paths[:, 0]) <= neighbors]
    paths.setflags(write=False)
    return paths


@lru_cache(maxsize=8)
def _path_index(count: int, neighbors: int, closed: bool) -> Int[np.ndarray, "sensors sensors"]:
    """``Ring.path_index`` as a read-only array."""
    paths, index = _paths(count, neighbors, closed), np.full((count, count), -1)
    index[paths[:, 0], paths[:, 1]] = np.arange(len(paths))
    index.setflags(write=False)
    return index
