"""Packing: from dense arrays or a log to the rectangles of real echoes that the compiled kernels take."""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.hardware.errors import SonarError
from jaxsonar.kernels.shape_buckets import bucket_size, next_power_of_two
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.sensors.ring import Ring

SCANS_PER_STEP = (256, 64, 16)
"""Numbers of scans that a compiled step takes, besides one; what remains is padded with scans without echoes."""
DEAR_SCANS_PER_STEP = (32,)
"""The same where a scan takes milliseconds and a compilation many seconds."""
BLOCK = 4096
"""Scans among which those are sought that need the same room."""
DEAR_BLOCK = 512
"""The same where a scan takes milliseconds."""
_FARTHEST = 1e6  # m; beyond all rings, and within single precision
_FEW_CELLS = 50_000  # accumulators larger than this are not stacked by the hundred
_WORTH_A_SHAPE = 256  # scans
_SLACK = 1.1
_FULL = 0.75  # of a step's scans; another call costs more than some padding


class Step(NamedTuple):
    """Scans that one compiled step takes, and their echoes: real ones first, then padding, likewise for the scans."""

    scans: Int[np.ndarray, " scans"]
    """Which scans of the batch these are, ascending; rows beyond them are padding."""
    path: Int[np.ndarray, "rows columns"]
    """Row of the ring's ``paths``; 0 where there is no echo."""
    reported: Float[np.ndarray, "rows columns"]
    """Half path length as reported, metres; NaN where there is no echo."""
    echo: Int[np.ndarray, "rows columns"]
    """Row of the echo in the columns of ``FlatEchoes``; 0 where there is none."""
    pose: Float[np.ndarray, "rows columns 3"] | None
    """model_from_robot of each echo: x, y (m), theta (rad); None: all at the origin."""
    gathered: Float[np.ndarray, " rows"] | None
    """How many scans each row was gathered from; None: one."""
    piece: Int[np.ndarray, "rows pieces"] | None
    """Arcs in pieces (``kernels.Echoes``)."""
    owner: Int[np.ndarray, "rows pieces"] | None
    """Echo of each piece."""

    @property
    def packed(self) -> kernels.Echoes:
        """The echoes as the kernels take them."""
        arrays: Any = (self.path, self.reported, self.pose, self.gathered, self.piece, self.owner)
        return kernels.Echoes(*arrays)  # NumPy arrays: a compiled step takes them to where it runs


class FlatEchoes:
    """Echoes of scans as flat columns, ready to be packed step by step."""

    def __init__(
        self,
        scans: int,
        scan: Int[np.ndarray, " echoes"],
        path: Int[np.ndarray, " echoes"],
        reported: Float[np.ndarray, " echoes"],
        *,
        pose: Float[np.ndarray, "echoes 3"] | None = None,
        gathered: Float[np.ndarray, " scans"] | None = None,
    ):
        """Take columns sorted by scan.

        Args:
            scans: number of scans, those without echoes included.
            scan: index of each echo's scan, ascending.
            path: row of the ring's ``paths``.
            reported: ranges as a log has them, metres.
            pose: model_from_robot when each echo was taken, x, y (m), theta (rad); the same for all if left out.
            gathered: how many scans each of these was gathered from; one if left out.
        """
        self.scans, self.path, self.reported = scans, path, reported
        self.pose, self.gathered = pose, gathered
        self.start = np.searchsorted(scan, np.arange(scans + 1))
        self.scan = scan

    @classmethod
    def from_dense(cls, ring: Ring, ranges: Float[np.ndarray, "scans paths echoes"]) -> "FlatEchoes":
        """Echoes of a dense array, NaN = no echo.

        Raises:
            SonarError: another shape than the ring's paths ask for, or a range that is not positive.
        """
        ranges = np.asarray(ranges)
        paths = len(ring.paths)
        if ranges.ndim != 3 or ranges.shape[1] != paths:
            raise SonarError(
                f"ranges: shape {ranges.shape} came; allowed is (scans, {paths}, echoes) for the {paths} echo paths of "
                f"{ring.name!r}"
            )
        if ranges.dtype.kind != "f":
            raise SonarError(f"ranges: dtype {ranges.dtype} came; allowed are floating-point numbers, NaN for no echo")
        scan, path, echo = np.nonzero(~np.isnan(ranges))
        reported = ranges[scan, path, echo]
        if (reported <= 0).any():
            k = int(np.argmax(reported <= 0))
            raise SonarError(
                f"ranges[{scan[k]}, {path[k]}, {echo[k]}] = {reported[k]:g}; allowed are metres above 0, NaN = no echo"
            )
        return cls(len(ranges), scan, path, reported)

    @classmethod
    def from_log(cls, ring: Ring, log: Log) -> tuple["FlatEchoes", int]:
        """Echoes of a log, and how many of them are of pairs that this ring does not listen to, and left out.

        Raises:
            SonarError: a sensor number that the ring does not have.
        """
        sensor = np.maximum(log.tx, log.rx)
        if (sensor >= ring.count).any():
            k = int(np.argmax(sensor >= ring.count))
            raise SonarError(
                f"scan {log.scan[log.echo_scan[k]]}: echo of sensors tx {log.tx[k]}, rx {log.rx[k]}; allowed are 0 to "
                f"{ring.count - 1}, the sensors of {ring.name!r}"
            )
        path = ring.path_index[log.tx, log.rx]
        heard = path >= 0
        return cls(len(log), log.echo_scan[heard], path[heard], log.range[heard]), int((~heard).sum())

    def steps(
        self, cells: int, *, pieces: Int[np.ndarray, " paths"] | None = None, dear: bool = False
    ) -> Iterator["Step"]:
        """The scans in rectangles of few different shapes, fewer scans at once if the accumulator has many cells.

        Scans are taken in blocks; those of a block that need the same room go together. On a CPU what a scan gives
        depends on neither its room nor its company.

        Args:
            cells: of the accumulator.
            pieces: into how many pieces of ``kernels.PIECE`` points the arc of each path is cut; each echo has the
                points of the widest arc if left out.
            dear: compiling another shape is dear, a scan too: even fewer shapes, with fewer scans.
        """
        if self.scans == 0:
            return
        density = _density(pieces)
        need = self._need(pieces, density)
        most = DEAR_BLOCK if dear else BLOCK
        for first in range(0, self.scans, most):
            block = np.arange(first, min(first + most, self.scans))
            for scans, columns in self._groups(block, need[block], dear=dear):
                last = 0
                while last < len(scans):
                    rows = self._rows(len(scans) - last, cells, dear=dear)
                    yield self._step(scans[last : last + rows], rows, columns, pieces, density)
                    last += rows

    def _rows(self, left: int, cells: int, *, dear: bool) -> int:
        """Number of scans that the next step takes."""
        if self.scans == 1:
            return 1
        small = cells > _FEW_CELLS or self.pose is not None  # windows have echoes by the hundred
        sizes = DEAR_SCANS_PER_STEP if dear else SCANS_PER_STEP[-1:] if small else SCANS_PER_STEP
        return next((size for size in sizes if size * _FULL <= left), sizes[-1])

    def _need(self, pieces: Int[np.ndarray, " paths"] | None, density: float) -> Int[np.ndarray, " scans"]:
        """Columns that each scan needs for its echoes, and for their pieces."""
        count = np.diff(self.start)
        if pieces is None:
            return count
        total = np.concatenate([[0], np.cumsum(pieces[self.path])])
        of_scan = total[self.start[1:]] - total[self.start[:-1]]
        return np.maximum(count, np.ceil(of_scan / density).astype(np.int64))

    def _groups(
        self, block: Int[np.ndarray, " scans"], need: Int[np.ndarray, " scans"], *, dear: bool
    ) -> Iterator[tuple[Int[np.ndarray, " some"], int]]:
        """Scans that go together, and their columns.

        Where scans are dear each has the room that it needs by itself, so that even the last digits do not depend on
        the others. Else groups too small to be worth a shape join the next larger one: votes are whole numbers.
        """
        least = 64 if self.pose is None else 256
        fit, floor, worth = (next_power_of_two, least, 0) if dear else (bucket_size, least // 2, _WORTH_A_SHAPE)
        if len(block) == 1:
            yield block, fit(int(need[0]), least=least)
            return
        distinct, which = np.unique(need, return_inverse=True)
        columns = np.array([fit(count, least=floor) for count in distinct.tolist()])[which]
        waiting = block[:0]
        rooms = np.unique(columns)
        for room in rooms:
            waiting = np.sort(np.concatenate([waiting, block[columns == room]]))
            if len(waiting) >= worth or room == rooms[-1]:
                yield waiting, max(int(room), least if len(block) < worth else 0)
                waiting = block[:0]

    def _step(
        self,
        scans: Int[np.ndarray, " scans"],
        rows: int,
        columns: int,
        pieces: Int[np.ndarray, " paths"] | None,
        density: float,
    ) -> "Step":
        count = self.start[scans + 1] - self.start[scans]
        row = np.repeat(np.arange(len(scans)), count)
        column = _counting(count)
        own = np.repeat(self.start[scans], count) + column
        path, reported = np.zeros((rows, columns), np.int32), np.full((rows, columns), np.nan, np.float32)
        path[row, column] = self.path[own]
        reported[row, column] = np.minimum(self.reported[own], _FARTHEST)
        echo = np.zeros((rows, columns), np.int64)
        echo[row, column] = own
        pose = gathered = piece = owner = None
        if self.pose is not None:
            pose = np.zeros((rows, columns, 3), np.float32)
            pose[row, column] = self.pose[own]
        if self.gathered is not None:
            gathered = np.ones(rows, np.float32)
            gathered[: len(scans)] = self.gathered[scans]
        if pieces is not None:
            of_echo = pieces[self.path[own]]
            at = _counting(np.bincount(row, of_echo, minlength=len(scans)).astype(np.int64))
            at = np.repeat(row, of_echo), at
            piece, owner = np.full((2, rows, int(np.ceil(columns * density))), -1, np.int32)
            piece[at], owner[at] = _counting(of_echo), np.repeat(column, of_echo)
            owner = np.maximum(owner, 0)
        return Step(scans, path, reported, echo, pose, gathered, piece, owner)


def _density(pieces: Int[np.ndarray, " paths"] | None) -> float:
    """Room for pieces per column: somewhat more than an echo has; wide paths hear more often than narrow ones."""
    if pieces is None or not pieces.any():
        return 1.0
    many = pieces.astype(np.float64)
    return min(_SLACK * float(many @ many / many.sum()), float(many.max()))


def _counting(counts: Int[np.ndarray, " groups"]) -> Int[np.ndarray, " all"]:
    """0, 1, 2, ... for each of some groups of these sizes, one after the other."""
    end = np.cumsum(counts)
    return np.arange(end[-1] if len(end) else 0) - np.repeat(end - counts, counts)


Item = TypeVar("Item")


def in_order(items: Iterable[tuple[int, Item]]) -> Iterator[Item]:
    """What belongs to scans 0, 1, 2, ..., from what comes in another order with its number."""
    early: dict[int, Item] = {}
    last = 0
    for index, item in items:
        early[index] = item
        while last in early:
            yield early.pop(last)
            last += 1
    assert not early, f"scan {last} never came"


def exact_paths(ring: Ring) -> kernels.EchoPaths:
    """Geometry of the ring's paths as NumPy arrays in double precision; made once for every ring."""
    cached = ring.__dict__.get("_exact_paths")
    if cached is None:
        cached = jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64), ring.echo_paths)
        object.__setattr__(ring, "_exact_paths", cached)
    return cached


def echoes_of(ring: Ring, scan: Scan) -> tuple[Int[np.ndarray, " echoes"], Float[np.ndarray, " echoes"]]:
    """Path (row of ``paths``) and corrected range, metres, of the echoes of a scan that are of a path and in reach."""
    path = ring.path_index[scan.tx, scan.rx]
    reach = np.asarray(ring.corrected(scan.range, scan.tx, scan.rx), dtype=np.float64)
    heard = (path >= 0) & (reach > 0) & (reach < ring.max_range)
    return path[heard], reach[heard]
