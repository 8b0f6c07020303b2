"""From raw scans to lines and a growing map, as they come: the step between a device and what a robot steers by."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.detection.arc_tables import arc_tables
from jaxsonar.detection.extract import local_model, local_models
from jaxsonar.detection.local_map import LocalModel
from jaxsonar.detection.settings import check_method, check_sigma, hough_settings
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.estimation.trajectory import Trajectory
from jaxsonar.geometry.se2 import relative
from jaxsonar.graph_slam.incremental_mapper import Mapper
from jaxsonar.hardware.scan_assembler import RawScan
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.scans.scan_log import Log, Scan
from jaxsonar.sensors.ring import Ring, speed_of_sound

AT_ONCE = 64
"""Scans taken together where so many wait."""
FEW = 4
"""Scans; fewer are faster one by one."""
STILL = 1e-4
"""Metres and radians; a robot that moves less than this during a scan stands still."""
DEGREE = 0.1
"""Kelvin; a change of the air's temperature that is worth a new speed of sound."""
_WARM = {"ml": (1,), "hough": (1, FEW, AT_ONCE)}  # numbers of scans that are taken together
_ECHOES = (60, 90, 120)  # of a scan, each in a room of its own (``kernels.shape_buckets.bucket_size``)


@dataclass(frozen=True, eq=False)
class LiveScan:
    """One scan with what it tells."""

    scan: Scan
    """As a log has it."""
    model: LocalModel
    """Its walls, in the frame of the pose of its last group."""


class LiveMap:
    """Takes raw scans, gives lines at once and a map when asked; for one thread."""

    def __init__(
        self,
        ring: Ring,
        *,
        method: str = "ml",
        settings: kernels.HoughSettings | None = None,
        sigma: float | None = None,
        mapping: bool = True,
        odometry_noise: OdometryNoise | None = None,
    ):
        """Nothing is known yet.

        Args:
            ring: the sensors; a measured temperature replaces its speed of sound.
            method: "ml" or "hough", as ``local_models``.
            settings: as ``local_models``.
            sigma: as ``local_models``.
            mapping: False: lines only, at a fraction of the work.
            slip: how wrong the device's poses are: they are odometry then, and the robot's own are estimated, for the
                map and in what ``take`` gives. They are right if left out.

        Raises:
            SonarError: as ``local_models``.
        """
        check_method(method)
        check_sigma(sigma)
        self.ring = ring
        self.left_out = 0
        """Echoes of pairs of sensors that the ring does not listen to."""
        self.unplaced = 0
        """Scans without a pose, which are not in the map."""
        self._choices = {"method": method, "settings": hough_settings(ring, settings), "sigma": sigma}
        self.slam = odometry_noise is not None
        self._mapper = Mapper(ring=ring, **self._choices, odometry_noise=odometry_noise) if mapping or self.slam else None
        self._state = self._mapper.start() if self._mapper is not None else None
        self._waiting: list[LiveScan] = []
        self._stamps: list[float] = []
        self._temperature = float("nan")
        self._paths, self._path_index = ring.paths, ring.path_index
        self._firing: Int[np.ndarray, " sensors"] = np.full(ring.count, -1)
        for group, sensors in enumerate(ring.firing_groups):
            self._firing[sensors] = group

    def warm_up(self) -> None:
        """Compile what the first scans need."""
        method = str(self._choices["method"])
        rng = np.random.default_rng(0)
        settings = self._choices["settings"]
        heard = np.repeat(self.ring.paths, arc_tables(self.ring, settings).pieces, axis=0)  # wide paths hear more often

        def one(echoes: int) -> LiveScan:
            path = heard[rng.integers(len(heard), size=echoes)]
            reach = rng.uniform(0.3, 0.9, echoes) * self.ring.max_range
            pose, nothing = np.zeros(3), np.full(echoes, np.nan)
            scans = [Scan(k, 0.0, pose, path[:, 0], path[:, 1], reach, nothing) for k in range(max(_WARM[method]))]
            for number in _WARM[method]:
                list(local_models(self.ring, Log.from_scans(scans[:number]), **self._choices))
            model = local_model(self.ring, scans[0], path_pose=np.zeros((len(self.ring.paths), 3)), **self._choices)
            return LiveScan(scans[0], model)

        sizes = _ECHOES if method == "hough" else (_ECHOES[0], _ECHOES[-1])  # ml has rooms of powers of two
        with ThreadPoolExecutor(len(sizes)) as pool:
            warm = list(pool.map(one, sizes))
        if self._mapper is None:
            return
        if not self.slam:
            self._mapper.map(self._mapper.including(self._mapper.start(), [warm[0].scan], [warm[0].model]))
            return
        state = self._mapper.start()
        for number, taken in enumerate((*warm, *warm)):
            state, _ = self._mapper.step(state, replace(taken.scan, scan=number), model=taken.model)
        self._mapper.map(state)

    def take(self, raws: Sequence[RawScan]) -> list[LiveScan]:
        """The lines of some scans.

        Args:
            raws: in the order in which they came.

        Raises:
            SonarError: a sensor number that the ring does not have.
        """
        scans = [self.scan_of(raw) for raw in raws]
        poses = [self.path_poses(raw) for raw in raws]
        self._follow_temperature(raws)
        if len(scans) >= FEW and self._choices["method"] == "hough" and all(pose is None for pose in poses):
            models = list(local_models(self.ring, Log.from_scans(scans), **self._choices))
        else:
            pairs = zip(scans, poses, strict=True)
            models = [local_model(self.ring, scan, path_pose=pose, **self._choices) for scan, pose in pairs]
        if self.slam:
            return [self._tracked(*one) for one in zip(scans, models, poses, strict=True)]
        taken = [LiveScan(scan, model) for scan, model in zip(scans, models, strict=True)]
        self.unplaced += sum(not np.isfinite(scan.pose).all() for scan in scans)
        if self._mapper is not None:
            self._waiting += taken
        return taken

    @property
    def waiting(self) -> int:
        """Scans that were taken but are not in the map yet."""
        return len(self._waiting)

    def absorb(self) -> None:
        """Put what was taken into the map: dearer than the lines, cheaper for several scans at once."""
        if self._mapper is None or self._state is None or not self._waiting:
            return
        scans, models = [live.scan for live in self._waiting], [live.model for live in self._waiting]
        self._waiting = []
        self._state = self._mapper.including(self._state, scans, models)

    def map(self) -> GlobalMap:
        """The map of all scans that were taken."""
        self.absorb()
        assert self._mapper is not None, "lines only"
        assert self._state is not None
        return self._mapper.map(self._state)

    def _tracked(self, scan: Scan, model: LocalModel, path_pose: Float[np.ndarray, "paths 3"] | None) -> LiveScan:
        """A scan where the robot seems to have been; at once in the map."""
        assert self._mapper is not None
        assert self._state is not None
        self._state, info = self._mapper.step(self._state, scan, model=model, path_pose=path_pose)
        assert info.pose is not None
        self._stamps.append(scan.stamp if np.isfinite(scan.stamp) else float(scan.scan))
        return LiveScan(replace(scan, pose=info.pose), model)

    def trajectory(self) -> Trajectory:
        """The robot's poses as they are known now, with their covariances; only where they are estimated."""
        assert self._mapper is not None
        assert self._state is not None
        poses, covariances = self._mapper.trajectory(self._state)
        return Trajectory(np.array(self._stamps), poses, covariances)

    def scan_of(self, raw: RawScan) -> Scan:
        """A raw scan as a log has it: times of flight as ranges."""
        echoes = raw.echoes
        tx, rx = echoes["tx"].astype(np.int64), echoes["rx"].astype(np.int64)
        self.left_out += int((self._path_index[tx, rx] < 0).sum())
        return Scan(
            scan=raw.scan,
            stamp=raw.stamp,
            pose=raw.pose,
            tx=tx,
            rx=rx,
            range=raw.ranges,
            amplitude=echoes["amplitude"].astype(np.float64),
        )

    def path_poses(self, raw: RawScan) -> Float[np.ndarray, "paths 3"] | None:
        """Where the robot was when each path fired, seen from where it was at the end; None if it stood still.

        A group without a pose is taken to have fired at the end.
        """
        moved = relative(np.broadcast_to(raw.pose, raw.group_pose.shape), raw.group_pose)
        moved = np.where(np.isfinite(moved), moved, 0.0)
        if np.abs(moved).max(initial=0.0) < STILL:
            return None
        # A transmitter fires in the group in which it was last heard to, else where the ring's geometry has it.
        self._firing[raw.echoes["tx"]] = raw.group
        group = self._firing[self._paths[:, 0]]
        return np.where((group < len(moved))[:, None], moved[np.minimum(group, len(moved) - 1)], 0.0)

    def _follow_temperature(self, raws: Sequence[RawScan]) -> None:
        measured = [raw.temperature for raw in raws if not np.isnan(raw.temperature)]
        if not measured or abs(measured[-1] - self._temperature) < DEGREE:
            return
        self._temperature = measured[-1]
        self.ring = replace(self.ring, speed_of_sound=speed_of_sound(self._temperature))
        if self._mapper is not None:
            self._mapper = replace(self._mapper, ring=self.ring)
