"""Containers of traced echoes: exact lengths of sound paths with the reflector that caused each of them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import IntEnum

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
