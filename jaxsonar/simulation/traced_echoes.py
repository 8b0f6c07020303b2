"""Containers of traced echoes, and of the echoes that paths report, with the reflector that caused each of them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int


class EchoKind(IntEnum):
    """Reflector type that caused an echo."""

    PLANE = 0
    """One reflection at a wall."""
    CORNER = 1
    """Double reflection in a right-angled corner."""
    EDGE = 2
    """Diffraction at a free end or an outer corner of walls."""
    POLE = 3
    """Scattering at a pole."""
    SECOND_ORDER = 4
    """Consecutive reflections at two walls that do not form a right-angled corner."""
    CLUTTER = 5
    """False echo without any reflector."""
    CIRCLE = 6
    """One reflection at a circle."""
    CROSSTALK = 7
    """Echo of another transmitter of the same firing group, from any reflector."""


@dataclass(frozen=True, eq=False)
class TracedEchoes:
    """Sound paths between pairs of sensors, one entry per path, in no particular order."""

    group: Int[np.ndarray, " found"]
    """Index of the group of sensors (a scan)."""
    pair: Int[np.ndarray, " found"]
    """Index of the pair (tx, rx)."""
    kind: Int[np.ndarray, " found"]
    """A value of ``EchoKind``."""
    reflector: Int[np.ndarray, " found"]
    """Wall (plane, or first wall of a second-order path), vertex of ``Room.junctions`` (corner, edge), pole, circle."""
    second: Int[np.ndarray, " found"]
    """Second wall of a second-order path, otherwise -1."""
    length: Float[np.ndarray, " found"]
    """Length of the sound path from tx to rx, metres."""
    first: Float[np.ndarray, "found 2"]
    """First point of incidence, world frame, metres: the sound leaves tx in its direction."""
    last: Float[np.ndarray, "found 2"]
    """Last point of incidence: the sound reaches rx from there."""

    def __len__(self) -> int:
        return len(self.length)

    def __getitem__(self, index: Int[np.ndarray, " some"] | Bool[np.ndarray, " found"]) -> "TracedEchoes":
        return TracedEchoes(*(getattr(self, field.name)[index] for field in fields(self)))

    @classmethod
    def concatenate(cls, parts: Sequence["TracedEchoes"]) -> "TracedEchoes":
        """All entries of several containers, possibly of none."""
        parts = [cls.empty(), *parts]
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))

    @classmethod
    def of_kind(
        cls,
        kind: EchoKind,
        group: Int[np.ndarray, " found"],
        pair: Int[np.ndarray, " found"],
        reflector: Int[np.ndarray, " found"],
        length: Float[np.ndarray, " found"],
        first: Float[np.ndarray, "found 2"],
        last: Float[np.ndarray, "found 2"],
    ) -> "TracedEchoes":
        """Entries of one kind without a second wall."""
        kinds, second = np.full(len(group), int(kind)), np.full(len(group), -1)
        return cls(group, pair, kinds, reflector, second, length, first, last)

    @classmethod
    def empty(cls) -> "TracedEchoes":
        """No entries."""
        index, points = np.zeros(0, dtype=int), np.zeros((0, 2))
        return cls.of_kind(EchoKind.PLANE, index, index, index, np.zeros(0), points, points)


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
