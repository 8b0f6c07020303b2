"""Observations of walls and points in the world frame: the columns and operations that both kinds share."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

Rows = TypeVar("Rows", bound="Observations")


@dataclass(frozen=True, eq=False)
class Observations:
    """A table with one row per observation. A row may be the fusion of several observations."""

    chi_squared: Float[np.ndarray, " rows"]
    """Sum of squared normalized deviations of the fused observations from their estimate; 0 for a single one."""
    count: Int[np.ndarray, " rows"]
    """Number of fused lines or points of local models."""
    echoes: Int[np.ndarray, " rows"]
    """Number of echoes in them."""
    last_seen: Float[np.ndarray, " rows"]
    """Time of the latest observation, seconds; the scan number where the scan has no time stamp."""
    scans: tuple[Int[np.ndarray, " seen"], Int[np.ndarray, " seen"]]
    """Pairs (row, scan number), ascending and unique: the scans that contributed to each row."""

    def __len__(self) -> int:
        return len(self.echoes)

    def grid_cells(self) -> Int[np.ndarray, "rows columns"]:
        """Cell of each row; rows in the same cell are so similar that storing their fusion loses nothing."""
        raise NotImplementedError

    def fuse(self: Rows, group: Int[np.ndarray, " rows"]) -> Rows:
        """One row per group 0, 1, 2, ...: the maximum likelihood estimate from the rows of the group.

        Information adds up, so the fusion of fusions equals the fusion of all rows, in any order, to rounding.
        """
        raise NotImplementedError

    def take(self: Rows, rows: Int[np.ndarray, " some"] | Bool[np.ndarray, " rows"]) -> Rows:
        """The given rows (numbers or mask) in the given order; a row may be repeated."""
        rows = np.arange(len(self))[rows]
        begin, end = np.searchsorted(self.scans[0], [rows, rows + 1])
        count = end - begin
        seen = np.repeat(begin - np.cumsum(count) + count, count) + np.arange(count.sum())
        columns: dict[str, Any] = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "scans"}
        return type(self)(**columns, scans=(np.repeat(np.arange(len(rows)), count), self.scans[1][seen]))

    def scan_lists(self) -> tuple[tuple[int, ...], ...]:
        """Scan numbers of each row, ascending."""
        row, number = self.scans
        parts = np.split(number, np.searchsorted(row, np.arange(1, len(self))))
        return tuple(tuple(part.tolist()) for part in parts[: len(self)])

    def scan_counts(self) -> Int[np.ndarray, " rows"]:
        """Number of scans that contributed to each row."""
        return np.bincount(self.scans[0], minlength=len(self))


def concatenate(tables: Sequence[Rows]) -> Rows:
    """The rows of several tables in one table."""
    columns: dict[str, Any] = {
        f.name: np.concatenate([getattr(table, f.name) for table in tables])
        for f in fields(tables[0])
        if f.name != "scans"
    }
    offset = np.cumsum([0, *(len(table) for table in tables[:-1])])
    rows = np.concatenate([table.scans[0] + first for table, first in zip(tables, offset, strict=True)])
    return type(tables[0])(**columns, scans=(rows, np.concatenate([table.scans[1] for table in tables])))


def merge_cells(observations: Rows, *, max_scans: int | None = None) -> Rows:
    """Observations with one row per cell (``grid_cells``), the fusion of the rows in it.

    Args:
        observations: the rows; their order does not matter.
        max_scans: largest number of scan numbers that each row keeps (the largest numbers); None keeps all.
    """
    if not len(observations):
        return observations
    _, group = np.unique(observations.grid_cells(), axis=0, return_inverse=True)
    fused = observations.fuse(group.ravel())
    return fused if max_scans is None else replace(fused, scans=_largest_numbers(fused.scans, max_scans))


def neighbor_pairs(
    points: Float[np.ndarray, "points dims"],
    queries: Float[np.ndarray, "queries dims"],
    radius: float | Float[np.ndarray, " queries"],
) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """Pairs (row of a query, row of a point) that are at most ``radius`` apart, sorted by query."""
    found = KDTree(points).query_ball_point(queries, radius)
    query = np.repeat(np.arange(len(queries)), [len(near) for near in found])
    return query, np.array([k for near in found for k in near], dtype=np.int64)


def unique_pairs(row: np.ndarray, number: np.ndarray) -> tuple[Int[np.ndarray, " seen"], Int[np.ndarray, " seen"]]:
    """Pairs (row, scan number), ascending and without repetition."""
    order = np.lexsort((number, row))
    row, number = row[order], number[order]
    new = np.ones(len(row), dtype=bool)
    new[1:] = (np.diff(row) > 0) | (np.diff(number) != 0)
    return row[new], number[new]


def _largest_numbers(scans: tuple[np.ndarray, np.ndarray], most: int) -> tuple[np.ndarray, np.ndarray]:
    """The pairs (row, scan number) with the ``most`` largest numbers of each row."""
    row, number = scans
    kept = np.arange(len(row)) >= np.searchsorted(row, row, side="right") - most
    return row[kept], number[kept]
