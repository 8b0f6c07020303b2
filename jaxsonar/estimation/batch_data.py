"""Echoes, poses and odometry of whole logs as padded arrays: the measurements of batch estimation."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.estimation.odometry_noise import OdometryNoiseModel
from jaxsonar.geometry.se2 import relative
from jaxsonar.kernels.shape_buckets import next_power_of_two
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.sliding_windows import is_fresh_reading
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class BatchDataSettings:
    """Priors and array sizes of ``BatchData``."""

    first_pose_sd: float = 1e-5
    """Prior standard deviation of the first pose of a log, metres and radians: it defines the frame. Chosen by hand."""
    pose_sd: float = 1.0
    """Prior standard deviation of all other poses, metres and radians: every pose is determined. Chosen by hand."""
    min_scan_rows: int = 8
    """Scans are padded to a power of two, at least this."""
    min_echo_columns: int = 16
    """Echoes of a scan are padded to a power of two, at least this."""
    packed_columns: int = 16
    """Echoes in a row of ``packed_echoes``."""
    packed_row_multiple: int = 256
    """The number of rows of ``packed_echoes`` is a multiple of this, so that few shapes are compiled."""


SETTINGS = BatchDataSettings()


@dataclass(frozen=True, eq=False)
class BatchData:
    """Scans of all logs in padded rectangles: a row per scan, a column per echo."""

    path: Int[np.ndarray, "scans echoes"]
    """Row of the ring's ``paths``; 0 where there is no echo."""
    reported: Float[np.ndarray, "scans echoes"]
    """Reported ranges, metres; NaN where there is no echo."""
    poses: Float[np.ndarray, "scans 3"]
    """world_from_robot, initial values."""
    map_index: Int[np.ndarray, " scans"]
    """Index of the log, which has a map of its own; -1 for padding and for scans without a pose."""
    prior_information: Float[np.ndarray, "scans 3"]
    odometry: Float[np.ndarray, "scans 3"]
    odometry_information: Float[np.ndarray, "scans 3"]
    """As in ``kernels.LeastSquaresProblem``, like the two before."""
    scan_rows: tuple[Int[np.ndarray, " _"], ...]
    """For each log: the indices of the scans that are used. They occupy consecutive rows from ``first_row`` on: first
    those with odometry in their order, then those without."""
    first_row: tuple[int, ...]
    landmark_prior_sd: float = 1.0
    """As in ``kernels.LeastSquaresProblem``."""
    max_iterations: int = 20
    """Maximum number of iterations of each least-squares adjustment."""
    cost_tolerance: float = 0.0
    """Absolute convergence tolerance of the cost (half a sum of squares in units of sigma)."""
    wall_explained: Bool[np.ndarray, "scans echoes"] | None = None
    """Echoes that a wall of their own scan explains: they are not assigned to points of the map. None: unknown."""
    measured: Bool[np.ndarray, "scans paths"] | None = None
    """Paths that each scan measured, whether or not they heard anything; None: all of them."""
    path_pose: Float[np.ndarray, "scans paths 3"] | None = None
    """scan_from_robot when each path was measured, metres and radians; None: all at the pose of the scan."""
    min_echoes_per_landmark: int = 1
    """Echoes of a landmark are used only in scans with at least this many of them. A pose that is hardly constrained in
    one direction would otherwise move to where one or two echoes of an unmapped object fit a landmark."""

    @classmethod
    def from_logs(
        cls,
        ring: Ring,
        logs: Sequence[Log],
        odometry: Sequence[Float[np.ndarray, "_ 3"]],
        noise: OdometryNoiseModel,
        *,
        keep_empty_scans: bool = False,
        settings: BatchDataSettings = SETTINGS,
    ) -> "BatchData":
        """Collect the scans that have a pose and echoes.

        Args:
            ring: the sensors.
            logs: scans, with initial poses.
            odometry: measured poses of every log, (scans, 3) each; NaN where there are none.
            noise: noise model of the odometry.
            keep_empty_scans: whether scans without echoes are used as well, because odometry connects them.
            settings: priors and array sizes.
        """
        flats = [FlatEchoes.from_log(ring, log)[0] for log in logs]
        fresh = [_is_new(log, flat) for log, flat in zip(logs, flats, strict=True)]
        used, counts = [], []
        for log, flat, is_fresh, measured in zip(logs, flats, fresh, odometry, strict=True):
            count = np.bincount(flat.scan[is_fresh], minlength=len(log))
            rows = np.flatnonzero(np.all(np.isfinite(log.pose), axis=1) & (keep_empty_scans | (count > 0)))
            # Odometry connects consecutive rows, so scans without odometry come last.
            rows = rows[np.argsort(~np.isfinite(measured[rows]).all(axis=1), kind="stable")]
            used.append(rows)
            counts.append(count[rows])
        begin = np.cumsum([0, *(len(rows) for rows in used)])
        max_count = max((int(count.max(initial=1)) for count in counts), default=1)
        scans = next_power_of_two(int(begin[-1]), least=settings.min_scan_rows)
        columns = next_power_of_two(max_count, least=settings.min_echo_columns)
        data = cls(
            path=np.zeros((scans, columns), np.int32),
            reported=np.full((scans, columns), np.nan),
            poses=np.zeros((scans, 3)),
            map_index=np.full(scans, -1, np.int32),
            prior_information=np.full((scans, 3), 1 / settings.pose_sd**2),
            odometry=np.zeros((scans, 3)),
            odometry_information=np.zeros((scans, 3)),
            scan_rows=tuple(used),
            first_row=tuple(begin[:-1].tolist()),
            measured=_by_path(scans, begin, used, [flat.measured for flat in flats], np.ones(len(ring.paths), bool)),
            path_pose=_by_path(scans, begin, used, [flat.path_pose for flat in flats], np.zeros((len(ring.paths), 3))),
        )
        for number, (log, flat, is_fresh, measured) in enumerate(zip(logs, flats, fresh, odometry, strict=True)):
            data._fill_echoes(number, log, flat, is_fresh)
            data._fill_odometry(number, measured, noise)
            data.prior_information[data.first_row[number] : data.first_row[number] + 1] = 1 / settings.first_pose_sd**2
        return data

    def _fill_echoes(self, number: int, log: Log, flat: FlatEchoes, fresh: Bool[np.ndarray, " echoes"]) -> None:
        """Write echoes and poses of one log into the rectangles."""
        first, rows = self.first_row[number], self.scan_rows[number]
        row_of_scan = np.full(len(log), -1)
        row_of_scan[rows] = np.arange(first, first + len(rows))
        echo = np.flatnonzero(fresh & (row_of_scan[flat.scan] >= 0))
        row = row_of_scan[flat.scan[echo]]
        column = np.arange(len(echo)) - np.searchsorted(flat.scan[echo], flat.scan[echo])
        self.path[row, column] = flat.path[echo]
        self.reported[row, column] = flat.reported[echo]
        self.poses[first : first + len(rows)] = log.pose[rows]
        self.map_index[first : first + len(rows)] = number

    def _fill_odometry(self, number: int, measured: Float[np.ndarray, "_ 3"], noise: OdometryNoiseModel) -> None:
        """Write the odometry steps of one log into the rectangles."""
        rows = self.scan_rows[number]
        rows = rows[np.isfinite(measured[rows]).all(axis=1)]
        if len(rows) < 2:
            return
        steps = slice(self.first_row[number], self.first_row[number] + len(rows) - 1)
        self.odometry[steps] = relative(measured[rows[:-1]], measured[rows[1:]])
        self.odometry_information[steps] = 1 / noise(measured, rows) ** 2

    @property
    def echo_count(self) -> int:
        """Number of echoes."""
        return int(np.isfinite(self.reported).sum())

    @cached_property
    def motion(self) -> Float[np.ndarray, "scans echoes 3"] | None:
        """scan_from_robot when each echo was measured, metres and radians; None: all at the pose of the scan."""
        return None if self.path_pose is None else self.path_pose[np.arange(len(self.path))[:, None], self.path]

    @property
    def scan_count(self) -> int:
        """Number of scans, without padding."""
        return int((self.map_index >= 0).sum())

    @cached_property
    def packed_echoes(self) -> tuple[Int[np.ndarray, "rows columns"], Int[np.ndarray, "rows columns"]]:
        """Scan and column of every echo, in short rows of echoes of one scan; padded with echoes that do not exist.

        Scans differ much in their number of echoes; short rows need less padding than a row per scan.
        """
        width, multiple = SETTINGS.packed_columns, SETTINGS.packed_row_multiple
        count = np.isfinite(self.reported).sum(axis=1)
        rows = np.repeat(np.arange(len(count)), -(-count // width))
        first = np.concatenate([np.arange(0, n, width) for n in count.tolist()])
        scan = np.zeros(-(-max(len(rows), 1) // multiple) * multiple, dtype=np.int64)
        begin = np.full(len(scan), self.path.shape[1])
        scan[: len(rows)], begin[: len(rows)] = rows, first
        columns = begin[:, None] + np.arange(width)
        # Beyond the last column the last one is repeated; its result is the same.
        return np.broadcast_to(scan[:, None], columns.shape), np.minimum(columns, self.path.shape[1] - 1)

    def logs_with_poses(self, logs: Sequence[Log], poses: Float[np.ndarray, "scans 3"]) -> list[Log]:
        """The logs with these poses; NaN for scans that are not used."""
        out = []
        for log, rows, first in zip(logs, self.scan_rows, self.first_row, strict=True):
            pose = np.full((len(log), 3), np.nan)
            pose[rows] = poses[first : first + len(rows)]
            out.append(replace(log, pose=pose))
        return out


def _is_new(log: Log, flat: FlatEchoes) -> Bool[np.ndarray, " echoes"]:
    """Echoes that are measurements of their own. A log without ages and silent readings does not say which are."""
    declared = not len(log.asked) or log.age.any()
    return np.ones(len(flat.scan), bool) if declared else is_fresh_reading(flat)


def _by_path(
    scans: int,
    begin: Int[np.ndarray, " bounds"],
    used: Sequence[Int[np.ndarray, " _"]],
    values: Sequence[np.ndarray | None],
    default: np.ndarray,
) -> np.ndarray | None:
    """Values of the paths of all used scans, one row per scan; None if no log has any."""
    if all(value is None for value in values):
        return None
    out = np.tile(default, (scans, *[1] * default.ndim))
    for first, rows, value in zip(begin[:-1].tolist(), used, values, strict=True):
        if value is not None:
            out[first : first + len(rows)] = value[rows]
    return out
