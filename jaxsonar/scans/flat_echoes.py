"""Echoes of scans as flat columns, addressed by the echo paths of a ring."""

from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.firing_poses import path_poses
from jaxsonar.scans.measured_paths import measured_paths
from jaxsonar.scans.readings import counts_from_one, is_repeated
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.sensors.ring import Ring


class FlatEchoes:
    """Echoes of scans or of windows of scans, one array per column, sorted by scan."""

    def __init__(
        self,
        scan_count: int,
        scan: Int[np.ndarray, " echoes"],
        path: Int[np.ndarray, " echoes"],
        reported: Float[np.ndarray, " echoes"],
        *,
        pose: Float[np.ndarray, "echoes 3"] | None = None,
        scans_per_window: Float[np.ndarray, " scans"] | None = None,
        measured: Bool[np.ndarray, "scans paths"] | None = None,
        path_pose: Float[np.ndarray, "scans paths 3"] | None = None,
    ):
        """Store columns that are sorted by scan.

        Args:
            scan_count: number of scans, including those without echoes.
            scan: index of the scan of each echo, ascending.
            path: row of ``Ring.paths`` of each echo.
            reported: ranges as a log holds them, metres.
            pose: model_from_robot when each echo was received: x, y (m), theta (rad). All echoes share one pose if
                omitted.
            scans_per_window: number of scans of all paths to which the measurements of each window amount; those of
                single scans follow from ``measured`` if omitted.
            measured: paths that each scan measured, whether or not they heard anything; all of them if omitted.
            path_pose: scan_from_robot when each path was measured; all at the pose of the scan if omitted.
        """
        self.measured, self.path_pose = measured, path_pose
        self.scan_count, self.scan, self.path, self.reported = scan_count, scan, path, reported
        self.pose, self.scans_per_window = pose, scans_per_window
        self.start = np.searchsorted(scan, np.arange(scan_count + 1))

    @cached_property
    def echo_pose(self) -> Float[np.ndarray, "echoes 3"] | None:
        """model_from_robot when each echo was received; None: the identity for all."""
        return self.path_pose[self.scan, self.path] if self.path_pose is not None else self.pose

    @classmethod
    def from_dense(
        cls,
        ring: Ring,
        ranges: Float[np.ndarray, "scans paths echoes"],
        measured: Bool[np.ndarray, "scans paths"] | None = None,
    ) -> "FlatEchoes":
        """Echoes of a dense array of ranges (metres), in which NaN means no echo.

        Args:
            ring: the sensors.
            ranges: half path lengths as a log holds them.
            measured: paths that were measured, whether or not they heard anything; all of them if omitted.

        Raises:
            SonarError: a shape does not match the ring's paths, a range is not positive, or a path with an echo was not
                measured.
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
        if measured is not None:
            measured = np.asarray(measured)
            if measured.shape != ranges.shape[:2] or measured.dtype != bool:
                raise SonarError(
                    f"measured: {measured.dtype} of shape {measured.shape} came; allowed is bool of shape "
                    f"{ranges.shape[:2]}, the scans and paths of the ranges"
                )
            if not measured[scan, path].all():
                k = int(np.argmin(measured[scan, path]))
                raise SonarError(
                    f"measured[{scan[k]}, {path[k]}] = False came with an echo at {reported[k]:g} m; allowed are "
                    "echoes of measured paths"
                )
            measured = None if measured.all() else measured
        return cls(len(ranges), scan, path, reported, measured=measured)

    @classmethod
    def from_log(
        cls, ring: Ring, log: Log, *, path_pose: Float[np.ndarray, "scans paths 3"] | None = None
    ) -> tuple["FlatEchoes", int]:
        """Echoes of a log on the ring's paths, and the number of echoes on other (tx, rx) pairs, which are omitted.

        Repeated old readings (``is_repeated``) are omitted, too. ``measured`` is None if every scan measured all paths,
        ``path_pose`` is None if every reading belongs to the pose of its scan.

        Args:
            ring: the sensors.
            log: the scans.
            path_pose: scan_from_robot when each path was measured; interpolated (``firing_poses.path_poses``) if
                omitted.

        Raises:
            SonarError: the log contains a sensor index that the ring does not have.
        """
        sensor = np.maximum(log.tx, log.rx)
        if (sensor >= ring.count).any():
            k = int(np.argmax(sensor >= ring.count))
            hint = "; the log seems to count from 1" * counts_from_one(log.tx, log.rx, ring.count)
            raise SonarError(
                f"scan {log.scan[log.echo_scan[k]]}: echo of sensors tx {log.tx[k]}, rx {log.rx[k]}; allowed are 0 to "
                f"{ring.count - 1}, the sensors of {ring.name!r}{hint}"
            )
        path = ring.path_index[log.tx, log.rx]
        heard = np.isfinite(log.range)
        used = (path >= 0) & heard & ~is_repeated(log)
        measured = measured_paths(ring, log)
        flat = cls(
            len(log),
            log.echo_scan[used],
            path[used],
            log.range[used],
            measured=None if measured.all() else measured,
            path_pose=path_poses(ring, log) if path_pose is None else path_pose,
        )
        return flat, int((heard & (path < 0)).sum())


def corrected_echoes(ring: Ring, scan: Scan) -> tuple[Int[np.ndarray, " echoes"], Float[np.ndarray, " echoes"]]:
    """Path (row of ``Ring.paths``) and corrected range (metres) of the echoes of a scan.

    Echoes on other (tx, rx) pairs, and those at or beyond the maximum range, are omitted.
    """
    path = ring.path_index[scan.tx, scan.rx]
    distance = np.asarray(ring.corrected(scan.range, scan.tx, scan.rx), dtype=np.float64)
    valid = (path >= 0) & (distance > 0) & (distance < ring.max_range)
    return path[valid], distance[valid]
