"""Packing of flat echoes into padded rectangles, the batches that compiled kernels take."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.kernels.shape_buckets import bucket_size, next_power_of_two
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.measured_paths import equivalent_scans
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class BatchPolicy:
    """Shapes of batches: a compromise between padding and the number of compiled programs. All chosen by timing."""

    rows: tuple[int, ...] = (256, 64, 16)
    """Scans per batch, largest first."""
    one_row: bool = True
    """Whether a log of one scan has a batch of one row."""
    min_fill: float = 0.75
    """A batch size is used if at least this fraction of its rows hold scans; otherwise the next smaller size is."""
    large_accumulator: int = 50_000
    """Cells of an accumulator above which only the smallest batch size is used, because of memory."""
    block: int = 4096
    """Scans that are sorted into groups of similar size at a time."""
    bucket: Callable[..., int] = bucket_size
    """Rounds the number of columns (echoes) up to one of a few sizes."""
    min_columns: int = 64
    """Smallest number of columns for single scans; a power of two."""
    min_columns_window: int = 256
    """Smallest number of columns for windows of scans, which hold hundreds of echoes; a power of two."""
    halve_min_columns: bool = True
    """Whether groups of at least ``min_group`` scans may have half the smallest number of columns."""
    min_group: int = 256
    """Smaller groups join the next larger number of columns. 0: the columns of a scan depend on that scan alone."""
    all_paths: bool = False
    """Whether the kernel predicts the echoes of all paths. Only then batches hold ``measured`` and ``path_pose``."""
    piece_slack: float = 1.1
    """Room for arc pieces per column, relative to the mean number of pieces of an echo: paths with wide detection
    ranges receive more echoes than those with narrow ones."""


FAST_SCANS = BatchPolicy()
"""For kernels that take much less than a millisecond per scan and give integer sums, independent of the padding."""
SLOW_SCANS = BatchPolicy(
    rows=(32,),
    one_row=False,
    block=512,
    bucket=next_power_of_two,
    halve_min_columns=False,
    min_group=0,
    all_paths=True,
)
"""For kernels that take milliseconds per scan and many seconds to compile, and that skip padding. The number of columns
of a scan depends on that scan alone, so that floating-point sums do not depend on the other scans of the batch."""

_MAX_REPORTED = 1e6
"""Metres; larger ranges are clipped. Beyond every ring's maximum range, and safe in single precision."""


class EchoBatch(NamedTuple):
    """Scans of one compiled call, one scan per row. Unused rows and columns are padding and come last."""

    scans: Int[np.ndarray, " scans"]
    """Index of each scan in the log, ascending; further rows are padding."""
    path: Int[np.ndarray, "rows columns"]
    """Row of ``Ring.paths``; 0 where there is no echo."""
    reported: Float[np.ndarray, "rows columns"]
    """Half path length as reported, metres; NaN where there is no echo."""
    echo: Int[np.ndarray, "rows columns"]
    """Index of the echo in the columns of ``FlatEchoes``; 0 where there is no echo."""
    pose: Float[np.ndarray, "rows columns 3"] | None
    """model_from_robot of each echo: x, y (m), theta (rad); None: the identity for all."""
    scans_per_row: Float[np.ndarray, " rows"] | None
    """Number of scans of all paths to which the measurements of each row amount; None: one."""
    piece: Int[np.ndarray, "rows pieces"] | None
    """Index of each arc piece within its arc (``kernels.PackedEchoes``); -1 is padding."""
    owner: Int[np.ndarray, "rows pieces"] | None
    """Column of the echo to which each arc piece belongs."""
    measured: Bool[np.ndarray, "rows paths"] | None = None
    """Paths that each scan measured; None: all."""
    path_pose: Float[np.ndarray, "rows paths 3"] | None = None
    """model_from_robot when each path was measured: x, y (m), theta (rad); None: the identity for all."""

    @property
    def packed(self) -> kernels.PackedEchoes:
        """The arrays as the argument of a kernel; they stay NumPy arrays until the compiled call transfers them."""
        arrays: Any = (self.path, self.reported, self.pose, self.scans_per_row, self.piece, self.owner)
        masks: Any = (self.measured, self.path_pose)
        return kernels.PackedEchoes(*arrays, *masks)


def pack(
    ring: Ring,
    echoes: FlatEchoes,
    cells: int,
    *,
    pieces: Int[np.ndarray, " paths"] | None = None,
    policy: BatchPolicy = FAST_SCANS,
) -> Iterator[EchoBatch]:
    """Batches that together hold every scan once, in few different shapes; scans may come out of order.

    On a CPU the result of a scan depends neither on its padding nor on the other scans of its batch.

    Args:
        ring: the sensors.
        echoes: the echoes of all scans.
        cells: number of cells of the accumulator.
        pieces: number of pieces of ``kernels.PIECE_POINTS`` points into which the arc of each path is cut. If omitted,
            every echo has as many points as the widest arc.
        policy: shapes of the batches.
    """
    if echoes.scan_count == 0:
        return
    weights = _scans_per_row(ring, echoes)
    density = _piece_density(pieces, policy)
    needed = _needed_columns(echoes, pieces, density)
    for first in range(0, echoes.scan_count, policy.block):
        block = np.arange(first, min(first + policy.block, echoes.scan_count))
        # Scans of similar size share a number of columns.
        for scans, columns in _group_by_columns(echoes, block, needed[block], policy):
            done = 0
            while done < len(scans):
                rows = _batch_rows(echoes, len(scans) - done, cells, policy)
                yield _fill(echoes, scans[done : done + rows], weights, rows, columns, pieces, density, policy)
                done += rows


def _scans_per_row(ring: Ring, echoes: FlatEchoes) -> Float[np.ndarray, " scans"] | None:
    """Number of scans of all paths to which the measurements of each scan amount; None: one for all."""
    if echoes.scans_per_window is not None or (echoes.measured is None and echoes.path_pose is None):
        return echoes.scans_per_window
    return np.ones(echoes.scan_count) if echoes.measured is None else equivalent_scans(ring, echoes.measured)


def _batch_rows(echoes: FlatEchoes, remaining: int, cells: int, policy: BatchPolicy) -> int:
    """Number of rows of the next batch."""
    if echoes.scan_count == 1 and policy.one_row:
        return 1
    # Windows hold hundreds of echoes each.
    large = cells > policy.large_accumulator or echoes.pose is not None
    sizes = policy.rows[-1:] if large else policy.rows
    return next((size for size in sizes if size * policy.min_fill <= remaining), sizes[-1])


def _piece_density(pieces: Int[np.ndarray, " paths"] | None, policy: BatchPolicy) -> float:
    """Arc pieces reserved per column; the mean is weighted by width, since wide paths receive more echoes."""
    if pieces is None or not pieces.any():
        return 1.0
    count = pieces.astype(np.float64)
    return min(policy.piece_slack * float(count @ count / count.sum()), float(count.max()))


def _needed_columns(
    echoes: FlatEchoes, pieces: Int[np.ndarray, " paths"] | None, density: float
) -> Int[np.ndarray, " scans"]:
    """Columns that each scan needs for its echoes and for their arc pieces."""
    count = np.diff(echoes.start)
    if pieces is None:
        return count
    cumulative = np.concatenate([[0], np.cumsum(pieces[echoes.path])])
    scan_pieces = cumulative[echoes.start[1:]] - cumulative[echoes.start[:-1]]
    return np.maximum(count, np.ceil(scan_pieces / density).astype(np.int64))


def _group_by_columns(
    echoes: FlatEchoes, block: Int[np.ndarray, " scans"], needed: Int[np.ndarray, " scans"], policy: BatchPolicy
) -> Iterator[tuple[Int[np.ndarray, " group"], int]]:
    """Groups of scans with one number of columns, and that number."""
    least = policy.min_columns if echoes.pose is None else policy.min_columns_window
    if len(block) == 1:
        yield block, policy.bucket(int(needed[0]), least=least)
        return
    smallest = least // 2 if policy.halve_min_columns else least
    distinct, which = np.unique(needed, return_inverse=True)
    columns = np.array([policy.bucket(count, least=smallest) for count in distinct.tolist()])[which]
    group = block[:0]
    sizes = np.unique(columns)
    for size in sizes:
        group = np.sort(np.concatenate([group, block[columns == size]]))
        if len(group) >= policy.min_group or size == sizes[-1]:
            yield group, max(int(size), least if len(block) < policy.min_group else 0)
            group = block[:0]


def _fill(
    echoes: FlatEchoes,
    scans: Int[np.ndarray, " scans"],
    weights: Float[np.ndarray, " all"] | None,
    rows: int,
    columns: int,
    pieces: Int[np.ndarray, " paths"] | None,
    density: float,
    policy: BatchPolicy,
) -> EchoBatch:
    """One batch: the echoes of these scans in padded arrays."""
    count = echoes.start[scans + 1] - echoes.start[scans]
    row = np.repeat(np.arange(len(scans)), count)
    column = _ranks(count)
    index = np.repeat(echoes.start[scans], count) + column
    path, reported = np.zeros((rows, columns), np.int32), np.full((rows, columns), np.nan, np.float32)
    path[row, column] = echoes.path[index]
    reported[row, column] = np.minimum(echoes.reported[index], _MAX_REPORTED)
    echo = np.zeros((rows, columns), np.int64)
    echo[row, column] = index
    pose = scans_per_row = piece = owner = measured = path_pose = None
    if echoes.echo_pose is not None:
        pose = np.zeros((rows, columns, 3), np.float32)
        pose[row, column] = echoes.echo_pose[index]
    if weights is not None:
        scans_per_row = np.ones(rows, np.float32)
        scans_per_row[: len(scans)] = weights[scans]
    masks = [mask for mask in (echoes.measured, echoes.path_pose) if mask is not None]
    if policy.all_paths and masks:
        # Both together, so that scans with missing measurements and scans with motion share one program.
        paths = masks[0].shape[1]
        measured, path_pose = np.ones((rows, paths), bool), np.zeros((rows, paths, 3), np.float32)
        if echoes.measured is not None:
            measured[: len(scans)] = echoes.measured[scans]
        if echoes.path_pose is not None:
            path_pose[: len(scans)] = echoes.path_pose[scans]
        pose = np.zeros((rows, columns, 3), np.float32) if pose is None else pose
    if pieces is not None:
        echo_pieces = pieces[echoes.path[index]]
        slot = _ranks(np.bincount(row, echo_pieces, minlength=len(scans)).astype(np.int64))
        target = np.repeat(row, echo_pieces), slot
        piece, owner = np.full((2, rows, int(np.ceil(columns * density))), -1, np.int32)
        piece[target], owner[target] = _ranks(echo_pieces), np.repeat(column, echo_pieces)
        owner = np.maximum(owner, 0)
    return EchoBatch(scans, path, reported, echo, pose, scans_per_row, piece, owner, measured, path_pose)


def _ranks(counts: Int[np.ndarray, " groups"]) -> Int[np.ndarray, " all"]:
    """0, 1, 2, ... within each of several groups of these sizes, concatenated."""
    end = np.cumsum(counts)
    return np.arange(end[-1] if len(end) else 0) - np.repeat(end - counts, counts)


Item = TypeVar("Item")


def restore_order(items: Iterable[tuple[int, Item]]) -> Iterator[Item]:
    """Items in the order 0, 1, 2, ... of their indices, each as soon as all earlier ones have been given."""
    waiting: dict[int, Item] = {}
    following = 0
    for index, item in items:
        waiting[index] = item
        while following in waiting:
            yield waiting.pop(following)
            following += 1
    assert not waiting, f"scan {following} is missing"
