"""``LiveMap``: raw scans of a device to lines at once, and to a map that grows."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jaxsonar import kernels
from jaxsonar.detection.arc_tables import arc_tables
from jaxsonar.detection.extract import local_model, local_models
from jaxsonar.detection.local_model import LocalModel
from jaxsonar.detection.settings import check_method, check_sigma, hough_settings
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.estimation.trajectory import Trajectory
from jaxsonar.graph_slam.incremental_mapper import Mapper
from jaxsonar.hardware.scan_assembler import RawScan
from jaxsonar.live.robot_echo_filter import RobotEchoFilter
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.scans.firing_poses import path_poses_of_scan
from jaxsonar.scans.raw_scans import scan_from_raw
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.sensors.ring import Ring, speed_of_sound


@dataclass(frozen=True)
class LiveMapSettings:
    """Batching and thresholds of live processing. All values are chosen by hand."""

    max_batch: int = 64
    """Maximum number of scans that are processed together."""
    min_batch: int = 4
    """Minimum number of scans that are processed together (hough); fewer are faster one by one."""
    standing_threshold: float = 1e-4
    """Metres and radians. A robot that moves less than this during a scan counts as standing."""
    temperature_step: float = 0.1
    """Kelvin. A smaller change of the air temperature does not change the speed of sound."""


SETTINGS = LiveMapSettings()
_WARM_UP_BATCHES = {"ml": (1,), "hough": (1, SETTINGS.min_batch, SETTINGS.max_batch)}
"""Numbers of scans that are processed together, by method. Each has its own compiled program."""
_WARM_UP_ECHOES = (60, 90, 120)
"""Numbers of echoes in a scan. Each has its own bucket size (``kernels.shape_buckets.bucket_size``)."""


@dataclass(frozen=True, eq=False)
class LiveScan:
    """One scan with its local model."""

    scan: Scan
    """The scan as in a log."""
    model: LocalModel
    """Local model in the robot frame at the first firing."""


class LiveMap:
    """Processes raw scans: lines at once, the map on request. Not thread-safe."""

    def __init__(
        self,
        ring: Ring,
        *,
        method: str = "ml",
        settings: kernels.HoughSettings | None = None,
        sigma: float | None = None,
        mapping: bool = True,
        odometry_noise: OdometryNoise | None = None,
        on_warning: Callable[[str], None] | None = None,
    ):
        """An empty map.

        Args:
            ring: the sensors; a measured temperature replaces its speed of sound.
            method: "ml" or "hough", as in ``local_models``.
            settings: as in ``local_models``.
            sigma: as in ``local_models``.
            mapping: False: detect lines only, at a fraction of the computing time.
            odometry_noise: noise of the device's poses. If given, they are odometry, and the poses of the robot are
                estimated for the map and for the scans that ``process`` returns. By default they are exact.
            on_warning: called with a message of one line, such as that a sensor hears the robot itself.

        Raises:
            SonarError: as in ``local_models``.
        """
        check_method(method)
        check_sigma(sigma)
        self.ring = ring
        self.left_out = 0
        """Number of echoes left out: their sensor pairs are not echo paths of the ring."""
        self.in_range = 0
        """Number of echoes on paths of the ring within its maximum range."""
        self.without_pose = 0
        """Number of scans without a pose; they are not in the map."""
        self._options = {"method": method, "settings": hough_settings(ring, settings), "sigma": sigma}
        self.slam = odometry_noise is not None
        self._mapper: Mapper | None = None
        if mapping or self.slam:
            self._mapper = Mapper(ring=ring, **self._options, odometry_noise=odometry_noise)
        self._state = self._mapper.start() if self._mapper is not None else None
        self._pending: list[LiveScan] = []
        self._stamps: list[float] = []
        self._temperature = float("nan")
        self._path_index = ring.path_index
        self._robot_echoes = RobotEchoFilter(ring, on_warning=on_warning)

    def warm_up(self) -> None:
        """Compile the programs that the first scans need, by processing synthetic scans."""
        method = str(self._options["method"])
        rng = np.random.default_rng(0)
        settings = self._options["settings"]
        paths = np.repeat(
            self.ring.paths, arc_tables(self.ring, settings).pieces, axis=0
        )  # wide paths have more echoes

        def synthetic_scan(echoes: int) -> LiveScan:
            path = paths[rng.integers(len(paths), size=echoes)]
            ranges = rng.uniform(0.3, 0.9, echoes) * self.ring.max_range
            pose, amplitude = np.zeros(3), np.full(echoes, np.nan)
            scan = Scan(0, 0.0, pose, path[:, 0], path[:, 1], ranges, amplitude, asked=self.ring.paths)
            scans = [replace(scan, scan=k) for k in range(max(_WARM_UP_BATCHES[method]))]
            for number in _WARM_UP_BATCHES[method]:
                list(local_models(self.ring, Log.from_scans(scans[:number]), **self._options))
            model = local_model(self.ring, scan, path_pose=np.zeros((len(self.ring.paths), 3)), **self._options)
            return LiveScan(scan, model)

        # The bucket sizes of ml are powers of two, so the middle size has no program of its own.
        sizes = _WARM_UP_ECHOES if method == "hough" else (_WARM_UP_ECHOES[0], _WARM_UP_ECHOES[-1])
        with ThreadPoolExecutor(len(sizes)) as pool:
            warm = list(pool.map(synthetic_scan, sizes))
        RobotEchoFilter(self.ring).warm_up(warm[0].scan)
        if self._mapper is None:
            return
        if not self.slam:
            self._mapper.map(self._mapper.add_scans(self._mapper.start(), [warm[0].scan], [warm[0].model]))
            return
        state = self._mapper.start()
        for number, live in enumerate((*warm, *warm)):
            state, _ = self._mapper.step(state, replace(live.scan, scan=number), model=live.model)
        self._mapper.map(state)

    def process(self, raw_scans: Sequence[RawScan]) -> list[LiveScan]:
        """Detect the lines of some scans, without the echoes of the robot itself.

        Args:
            raw_scans: scans in order of arrival.

        Raises:
            SonarError: a sensor number that the ring does not have.
        """
        scans = [scan_from_raw(raw) for raw in raw_scans]
        self._follow_temperature(raw_scans)
        self._count_echoes(scans)
        scans = self._robot_echoes.clean(scans)
        poses = [self._path_pose(scan) for scan in scans]
        robot_stood = all(pose is None for pose in poses)
        if len(scans) >= SETTINGS.min_batch and self._options["method"] == "hough" and robot_stood:
            models = list(local_models(self.ring, Log.from_scans([_at_rest(scan) for scan in scans]), **self._options))
        else:
            models = [
                local_model(self.ring, scan if pose is not None else _at_rest(scan), path_pose=pose, **self._options)
                for scan, pose in zip(scans, poses, strict=True)
            ]
        if self.slam:
            return [self._tracked(*one) for one in zip(scans, models, poses, strict=True)]
        live_scans = [LiveScan(scan, model) for scan, model in zip(scans, models, strict=True)]
        self.without_pose += sum(not np.isfinite(scan.pose).all() for scan in scans)
        if self._mapper is not None:
            self._pending += live_scans
        return live_scans

    @property
    def pending(self) -> int:
        """Number of processed scans that are not in the map yet."""
        return len(self._pending)

    def update_map(self) -> None:
        """Add the pending scans to the map. Costs more than detection; cheaper for several scans together."""
        if self._mapper is None or self._state is None or not self._pending:
            return
        scans, models = [live.scan for live in self._pending], [live.model for live in self._pending]
        self._pending = []
        self._state = self._mapper.add_scans(self._state, scans, models)

    def map(self) -> GlobalMap:
        """The map of all processed scans."""
        self.update_map()
        assert self._mapper is not None, "lines only"
        assert self._state is not None
        return self._mapper.map(self._state)

    def _tracked(self, scan: Scan, model: LocalModel, path_pose: Float[np.ndarray, "paths 3"] | None) -> LiveScan:
        """The scan at its estimated pose; it is added to the map at once."""
        assert self._mapper is not None
        assert self._state is not None
        self._state, info = self._mapper.step(self._state, scan, model=model, path_pose=path_pose)
        assert info.pose is not None
        self._stamps.append(scan.stamp if np.isfinite(scan.stamp) else float(scan.scan))
        return LiveScan(replace(scan, pose=info.pose), model)

    def trajectory(self) -> Trajectory:
        """The current estimates of all poses with their covariances. Only with ``odometry_noise``."""
        assert self._mapper is not None
        assert self._state is not None
        poses, covariances = self._mapper.trajectory(self._state)
        return Trajectory(np.array(self._stamps), poses, covariances)

    def poses(self) -> Float[np.ndarray, "scans 3"]:
        """The current estimates of all poses: x, y (m), theta (rad). Only with ``odometry_noise``."""
        assert self._state is not None
        assert self._state.submap_evidence is not None
        return self._state.submap_evidence.poses()

    def scans_at_current_poses(self) -> list[Scan]:
        """All scans with the current estimates of their poses. Only with ``odometry_noise``."""
        assert self._state is not None
        assert self._state.submap_evidence is not None
        return self._state.submap_evidence.scans_at_current_poses()

    def _path_pose(self, scan: Scan) -> Float[np.ndarray, "paths 3"] | None:
        """Pose of the robot when each path was measured, relative to its pose at the first firing; None if it stood."""
        if scan.odometry is None or np.ptp(scan.odometry[:, 1:], axis=0).max() < SETTINGS.standing_threshold:
            return None
        return path_poses_of_scan(self.ring, scan)

    def _count_echoes(self, scans: Sequence[Scan]) -> None:
        none = np.zeros(0, np.int64)
        tx, rx, reported = (
            np.concatenate([none, *(getattr(scan, name) for scan in scans)]) for name in ("tx", "rx", "range")
        )
        on_path = self._path_index[tx, rx] >= 0
        distance = np.asarray(self.ring.corrected(reported, tx, rx))
        self.left_out += int((~on_path).sum())
        self.in_range += int((on_path & (distance > 0) & (distance < self.ring.max_range)).sum())

    def _follow_temperature(self, raw_scans: Sequence[RawScan]) -> None:
        measured = [raw.temperature for raw in raw_scans if not np.isnan(raw.temperature)]
        if not measured or abs(measured[-1] - self._temperature) < SETTINGS.temperature_step:
            return
        self._temperature = measured[-1]
        self.ring = replace(self.ring, speed_of_sound=speed_of_sound(self._temperature))
        if self._mapper is not None:
            self._mapper = replace(self._mapper, ring=self.ring)


def _at_rest(scan: Scan) -> Scan:
    """The scan as if all groups had fired at its pose."""
    return replace(scan, t=None, odometry=None)
