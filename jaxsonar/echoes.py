"""Packing: from dense arrays or a log to the rectangles of real echoes that the compiled kernels take."""

from collections.abc import Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.hardware.errors import SonarError

from .logs import Log
from .ring import Ring

SCANS_PER_STEP = (1, 16, 256)
"""Numbers of scans that a compiled step takes; what remains of a batch is padded with scans without echoes."""
DEAR_SCANS_PER_STEP = (1, 32, 32)
"""The same where a scan takes milliseconds and a compilation many seconds."""
_FARTHEST = 1e6  # m; beyond all rings, and within single precision
_FEW_CELLS = 50_000  # accumulators larger than this are not stacked by the hundred


def room_for(count: int, *, least: int) -> int:
    """Room for count things in few different shapes, so few compilations: ``least``, 1.5 or 2 times that, and so on."""
    room = least
    while room < count:
        room = room * 3 // 2 if room & (room - 1) == 0 else room * 4 // 3  # powers of two, and halfway between
    return room


def power_of_two(count: int, *, least: int) -> int:
    """Room for count things in even fewer shapes: ``least``, a power of two, or the first such that holds them."""
    return max(least, 1 << max(count - 1, 0).bit_length())


class Step(NamedTuple):
    """Scans that one compiled step takes, and their echoes: real ones first, then padding, likewise for the scans."""

    scans: slice
    """Which scans of the batch these are."""
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

    @property
    def packed(self) -> kernels.Echoes:
        """The echoes as the kernels take them."""
        pose = None if self.pose is None else jnp.asarray(self.pose)
        gathered = None if self.gathered is None else jnp.asarray(self.gathered)
        return kernels.Echoes(jnp.asarray(self.path), jnp.asarray(self.reported), pose, gathered)


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

    def steps(self, cells: int, *, dear: bool = False) -> Iterator["Step"]:
        """The scans in rectangles of few different shapes, fewer scans at once if the accumulator has many cells.

        Args:
            cells: of the accumulator.
            dear: compiling another shape is dear, a scan too: even fewer shapes, with fewer scans.
        """
        one, some, many = DEAR_SCANS_PER_STEP if dear else SCANS_PER_STEP
        last = 0
        while last < self.scans:
            first, left = last, self.scans - last
            step = one if left == 1 else some if left <= 4 * some or cells > _FEW_CELLS else many
            last = min(first + step, self.scans)
            begin, end = self.start[first], self.start[last]
            row = self.scan[begin:end] - first
            column = np.arange(begin, end) - self.start[first + row]
            most = int(column.max(initial=-1)) + 1
            columns = room_for(most, least=64 if self.pose is None else 256)
            if dear:
                columns = power_of_two(columns, least=1)
            path = np.zeros((step, columns), np.int32)
            reported = np.full((step, columns), np.nan, np.float32)
            path[row, column] = self.path[begin:end]
            reported[row, column] = np.minimum(self.reported[begin:end], _FARTHEST)
            echo = np.zeros((step, columns), np.int64)
            echo[row, column] = np.arange(begin, end)
            pose = gathered = None
            if self.pose is not None:
                pose = np.zeros((step, columns, 3), np.float32)
                pose[row, column] = self.pose[begin:end]
            if self.gathered is not None:
                gathered = np.ones(step, np.float32)
                gathered[: last - first] = self.gathered[first:last]
            yield Step(slice(first, last), path, reported, echo, pose, gathered)
