"""Things that scans saw, one row each: what pieces of walls and points in the world have in common."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

Rows = TypeVar("Rows", bound="Sightings")


@dataclass(frozen=True, eq=False)
class Sightings:
    """Columns that all sightings have; a row is one, or the sum of several."""

    misfit: Float[np.ndarray, " rows"]
    """Sum of the squared, normalised deviations of those that were added from what they have in common."""
    count: Int[np.ndarray, " rows"]
    """How many lines or points of local models each is the sum of."""
    echoes: Int[np.ndarray, " rows"]
    """How many echoes they rest on."""
    latest: Float[np.ndarray, " rows"]
    """When it was last seen: seconds, or the scan number where there is no stamp."""
    scans: tuple[Int[np.ndarray, " seen"], Int[np.ndarray, " seen"]]
    """Row and scan number of every scan that each was seen in, ascending, each once."""

    def __len__(self) -> int:
        return len(self.echoes)

    def take(self: Rows, rows: Int[np.ndarray, " some"] | Bool[np.ndarray, " rows"]) -> Rows:
        """Some of the rows, in the order asked for; a row may come more than once."""
        rows = np.arange(len(self))[rows]
        begin, end = np.searchsorted(self.scans[0], [rows, rows + 1])
        count = end - begin
        seen = np.repeat(begin - np.cumsum(count) + count, count) + np.arange(count.sum())
        columns: dict[str, Any] = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "scans"}
        return type(self)(**columns, scans=(np.repeat(np.arange(len(rows)), count), self.scans[1][seen]))

    def scan_lists(self) -> tuple[tuple[int, ...], ...]:
        """Numbers of the scans that each was seen in, ascending."""
        row, number = self.scans
        parts = np.split(number, np.searchsorted(row, np.arange(1, len(self))))
        return tuple(tuple(part.tolist()) for part in parts[: len(self)])


def join(parts: Sequence[Rows]) -> Rows:
    """The rows of several collections as one."""
    columns: dict[str, Any] = {
        f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(parts[0]) if f.name != "scans"
    }
    offset = np.cumsum([0, *(len(part) for part in parts[:-1])])
    rows = np.concatenate([part.scans[0] + first for part, first in zip(parts, offset, strict=True)])
    return type(parts[0])(**columns, scans=(rows, np.concatenate([part.scans[1] for part in parts])))


def unique_pairs(row: np.ndarray, number: np.ndarray) -> tuple[Int[np.ndarray, " seen"], Int[np.ndarray, " seen"]]:
    """Pairs of row and scan number, ascending, each once."""
    order = np.lexsort((number, row))
    row, number = row[order], number[order]
    new = np.ones(len(row), dtype=bool)
    new[1:] = (np.diff(row) > 0) | (np.diff(number) != 0)
    return row[new], number[new]


def latest_scans(scans: tuple[np.ndarray, np.ndarray], most: int | None) -> tuple[np.ndarray, np.ndarray]:
    """At most so many scans of each row, those with the largest numbers; all if None."""
    row, number = scans
    kept = np.arange(len(row)) >= np.searchsorted(row, row, side="right") - (len(row) if most is None else most)
    return row[kept], number[kept]
