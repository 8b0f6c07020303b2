"""SLAM of a whole log: poses of all scans, and the map (paper, section 5, last paragraph)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxsonar.detection.local_model import LocalModel
from jaxsonar.detection.settings import check_sigma
from jaxsonar.estimation.batch_data import BatchData
from jaxsonar.estimation.estimation_log import estimation_log
from jaxsonar.estimation.explained_share import ExplainedShare
from jaxsonar.estimation.landmark_map import landmark_map_of
from jaxsonar.estimation.odometry_noise import OdometryNoise, OdometryNoiseModel
from jaxsonar.estimation.robust_adjustment import explained_echoes
from jaxsonar.estimation.trajectory import Trajectory, stamps_of
from jaxsonar.graph_slam.initial_poses import InitialPoses, LoopClosure, detect, initial_poses
from jaxsonar.graph_slam.interrupted_odometry import InterruptedOdometryNoise, continue_odometry
from jaxsonar.graph_slam.slipped_odometry import SlippedOdometryNoise, repair_heading_slips
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.build_map import add_reflectors, assemble_map, build_map
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.mapping.map_evidence import gather_evidence
from jaxsonar.plausibility.odometry_jumps import OdometryJump
from jaxsonar.reflectors.posed_scans import PosedScans
from jaxsonar.registration.heading_slips import HeadingSlip
from jaxsonar.scans.measured_paths import echoes_of_long_wall
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.single_firings import group_firings
from jaxsonar.scans.sliding_windows import SETTINGS as WINDOWS
from jaxsonar.scans.sliding_windows import automatic_window, check_window
from jaxsonar.sensors.ring import Ring
from jaxsonar.smoothing.smooth_log import Smoothed
from jaxsonar.smoothing.smooth_log import smooth as smooth_poses
from jaxsonar.smoothing.smoother import NothingExplained
from jaxsonar.smoothing.sparse_smoother import SPARSE_ODOMETRY_NOISE


@dataclass(frozen=True)
class SlamSettings:
    """Constants of ``slam``; chosen by hand unless stated otherwise."""

    max_smoothed: int = 2000
    """Scans; longer logs are smoothed only on request. Smoothing takes about a minute for a thousand scans."""
    min_explained: float = 0.1
    """Least fraction of the echoes that poses and map must explain. Recordings of old narrow sonars reach it."""
    min_explained_sparse: float = 0.05
    """The same with windows: the few sensors of such a ring often face no wall, or people. Recordings reach 0.09."""
    unadjusted_gate: float = 0.04
    """Metres; without smoothing, echoes nearer to the range of a wall, corner or edge are explained by it."""
    judged_scans: int = 500
    """Number of scans, evenly selected, of which that is determined."""


SETTINGS = SlamSettings()


@dataclass(frozen=True, eq=False)
class Slam:
    """Poses and map of a log."""

    poses: Float[np.ndarray, "scans 3"]
    """world_from_robot; NaN for scans without an estimate. Firings that are scans of their own are merged first
    (``estimation_log``); one pose belongs to all of them."""
    covariance: Float[np.ndarray, "scans 3 3"]
    """With respect to the first scan that has a pose."""
    stamp: Float[np.ndarray, " scans"]
    """Time of every scan, as ``stamps_of`` gives it."""
    world: GlobalMap
    odometry: Float[np.ndarray, "scans 3"]
    """The poses of the log's scans."""
    closures: tuple[LoopClosure, ...]
    step_ms: Float[np.ndarray, " steps"]
    """Milliseconds of each scan's step; empty where the log was not tracked."""
    smoothed: Smoothed | None
    """The result of smoothing; None without it."""
    explained: ExplainedShare
    """The share of the echoes that poses and map explain."""
    jumps: tuple[OdometryJump, ...] = ()
    """Steps at which the odometry jumps, in rows of the scans. The result does not use them: the motion before and
    after a jump is continued, if the ranges go on; otherwise the smaller part of the log has no poses."""
    slips: tuple[HeadingSlip, ...] = ()
    """Heading slips of the odometry of a sparse ring, in rows of the scans. The poses after them are turned."""

    @property
    def trajectory(self) -> Trajectory:
        """The scans that have a pose; with covariances if all of them have one."""
        known = np.isfinite(self.poses).all(axis=1)
        covariance = self.covariance[known]
        return Trajectory(self.stamp[known], self.poses[known], covariance if np.isfinite(covariance).all() else None)

    @property
    def left_out(self) -> np.ndarray:
        """Rows of the scans without a pose."""
        return np.flatnonzero(~np.isfinite(self.poses).all(axis=1))

    def corrected(self, log: Log) -> Log:
        """The log of these poses, with its firings merged into scans; scans without an estimate have no pose.

        The motion between the readings of a scan stays that of the odometry (``Log.motion``).
        """
        log = group_firings(log)
        return replace(log, pose=self.poses, odometry=log.motion)


def slam(
    ring: Ring,
    log: Log,
    *,
    sigma: float | None = None,
    window: float | None = None,
    odometry_noise: OdometryNoise | None = None,
    smooth: bool | None = None,
    speed: bool = False,
    scale: bool = False,
    live: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> Slam:
    """Estimate the poses of the scans of a log, and the map (paper, section 5, last paragraph).

    Firings that are scans of their own are merged into full scans first (``estimation_log``).
    Logs with odometry are tracked scan by scan, loops are closed, and all poses and landmarks are smoothed together.
    Logs without odometry are registered by the ranges of their echoes, long ones by walls and corners. For sparse rings
    (``automatic_window``) the odometry is smoothed directly, with maps of windows.

    Args:
        ring: the sensors, calibrated.
        log: scans; their poses are odometry, and may be missing.
        sigma: standard deviation of the ranges, metres; estimated if left out.
        window: metres of trajectory gathered into one local model; if left out, ``automatic_window``. With a window,
            any log is treated like that of a sparse ring.
        odometry_noise: noise model of the odometry; default ``OdometryNoise()``, or ``SPARSE_ODOMETRY_NOISE`` with a
            window.
        smooth: whether to smooth. If left out: logs of up to ``SlamSettings.max_smoothed`` scans, except logs that are
            registered by ranges, unless ``speed`` is set.
        speed: whether smoothing estimates the speed of sound.
        scale: whether smoothing estimates the scale factors of the odometry.
        live: whether local models are made one by one, as on a robot, so that ``step_ms`` holds the whole cost.
        progress: called with the current task, the number of finished scans, and of all scans (0 and 0: unknown).

    Raises:
        SonarError: no scan, arguments out of range, odometry in too few scans, a sparse ring without odometry, no wall
            found, too few echoes explained.
    """
    report = progress or (lambda task, done, total: None)
    log = estimation_log(log)
    continued = continue_odometry(ring, log)
    if len(continued.parts) > 1:
        part = continued.largest_part
        options = {"sigma": sigma, "window": window, "odometry_noise": odometry_noise, "smooth": smooth}
        options |= {"speed": speed, "scale": scale, "live": live, "progress": progress}
        return _of_whole_log(slam(ring, continued.log[part], **options), log, part, continued.jumps)
    log, odometry, slips = continued.log, log.pose, ()
    has_odometry = np.asarray(np.isfinite(log.pose).all(axis=1))
    if window is None and len(log) and echoes_of_long_wall(ring, log) < WINDOWS.sparse_echoes:
        if not has_odometry.any():
            paths = f"fewer than {WINDOWS.sparse_echoes:g} paths of {ring.name!r} receive a long wall in one scan"
            raise SonarError(f"slam: no scan has odometry, and {paths}; allowed is a log with odometry for such a ring")
        window = automatic_window(ring, log)
    _check(log, has_odometry, sigma=sigma, window=window, smooth=smooth, speed=speed, scale=scale)
    noise = odometry_noise or (OdometryNoise() if window is None else SPARSE_ODOMETRY_NOISE)
    step_noise: OdometryNoiseModel = InterruptedOdometryNoise(noise, continued.bridged)
    if window is not None:
        report("heading slips", 0, 0)
        log, slips = repair_heading_slips(ring, log)
        step_noise = SlippedOdometryNoise(step_noise, slips)
    required = SETTINGS.min_explained if window is None else SETTINGS.min_explained_sparse
    # 1. Detect: the local model of every scan, unless maps of windows or the tracker do so.
    scan_by_scan = live and has_odometry.any()
    models = None if window is not None or scan_by_scan else detect(ring, log, sigma=sigma, progress=report)
    # 2. Track the poses and close loops. Without odometry, register the scans; with windows, keep the odometry.
    initial = initial_poses(ring, log, models, window=window, sigma=sigma, odometry_noise=noise, progress=report)
    # 3. Smooth: all poses and landmarks on the raw ranges.
    smoothed = None
    if smooth if smooth is not None else _is_smoothed_by_default(initial, has_odometry, speed):
        try:
            smoothed = smooth_poses(
                ring,
                log,
                _smoothing_start(initial, has_odometry),
                odometry=initial.odometry if has_odometry.any() else None,
                sigma=sigma,
                window=window,
                speed=speed,
                scale=scale,
                odometry_noise=step_noise,
                models=initial.models,
                traversals=initial.traversals,
                progress=lambda task: report(task, 0, 0),
            )
        except NothingExplained as reason:
            raise SonarError(f"{reason}; walls {ExplainedShare(0.0, required).shortfall}") from None
    # 4. Map: that of the smoothed landmarks, or one from the initial poses.
    if smoothed is not None:
        poses, covariance, world = smoothed.poses, smoothed.pose_cov, smoothed.world
        share = smoothed.used
    else:
        report("building the map", 0, 0)
        poses, covariance = initial.poses, initial.covariance
        world = _map_at(ring, replace(log, pose=poses), initial.models, window)
        share = _explained_share(ring, replace(log, pose=poses), world)
    explained = ExplainedShare(share, required)
    if not explained.suffices:
        raise SonarError(
            f"slam: poses and map {explained.shortfall}: is it the right ring, are ranges and odometry in metres and "
            "radians?"
        )
    # 5. Reflectors beside the walls, from all scans at their poses.
    posed = PosedScans.of(ring, replace(log, pose=poses))
    world = add_reflectors(world, posed.measurements(), sigma=sigma)
    stamp, closures = stamps_of(log), initial.closures
    jumps, step_ms = continued.jumps, initial.step_ms
    return Slam(poses, covariance, stamp, world, odometry, closures, step_ms, smoothed, explained, jumps, slips)


def _of_whole_log(found: Slam, log: Log, part: slice, jumps: tuple[OdometryJump, ...]) -> Slam:
    """The result for one part of a log as a result for all scans; those of other parts have no pose."""

    def padded(values: np.ndarray, fill: float) -> np.ndarray:
        whole = np.full((len(log), *values.shape[1:]), fill, dtype=values.dtype)
        whole[part] = values
        return whole

    smoothed = found.smoothed
    if smoothed is not None:
        smoothed = replace(
            smoothed,
            poses=padded(smoothed.poses, np.nan),
            pose_cov=padded(smoothed.pose_cov, np.nan),
            explained_counts=padded(smoothed.explained_counts, 0),
        )
    first = part.start
    return replace(
        found,
        poses=padded(found.poses, np.nan),
        covariance=padded(found.covariance, np.nan),
        stamp=stamps_of(log),
        odometry=log.pose,
        closures=tuple(one._replace(first=one.first + first, second=one.second + first) for one in found.closures),
        smoothed=smoothed,
        jumps=jumps,
        slips=tuple(replace(one, row=one.row + first) for one in found.slips),
    )


def _explained_share(ring: Ring, log: Log, world: GlobalMap) -> float:
    """Fraction of the echoes of scans with a pose that a map explains without an adjustment."""
    known = np.flatnonzero(np.isfinite(log.pose).all(axis=1))
    step = max(1, -(-len(known) // SETTINGS.judged_scans))
    kept = np.zeros(len(log), dtype=bool)
    kept[known[::step]] = True
    log = replace(log, pose=np.where(kept[:, None], log.pose, np.nan))
    no_odometry = np.full((len(log), 3), np.nan)
    data = BatchData.from_logs(ring, [log], [no_odometry], OdometryNoise())
    if not data.echo_count:
        return 0.0
    landmark_map = landmark_map_of([world], tie_corners=False)
    with jax.enable_x64(True):
        explained = explained_echoes(ring, data, landmark_map, gate=SETTINGS.unadjusted_gate)
    return float(explained.sum() / data.echo_count)


def _map_at(ring: Ring, log: Log, models: Sequence[LocalModel] | None, window: float | None) -> GlobalMap:
    """The map of a log at its poses."""
    if models is None:
        return build_map(ring, log, window=window, reflectors=False)
    return assemble_map(gather_evidence(ring, log, models))


def _is_smoothed_by_default(initial: InitialPoses, has_odometry: Bool[np.ndarray, " scans"], speed: bool) -> bool:
    # Registration by ranges has adjusted all poses to more echoes than the landmarks of a map explain.
    adjusted_already = not has_odometry.any() and bool(np.isfinite(initial.covariance).any()) and not speed
    return len(has_odometry) <= SETTINGS.max_smoothed and not adjusted_already


def _smoothing_start(initial: InitialPoses, has_odometry: Bool[np.ndarray, " scans"]) -> Float[np.ndarray, "scans 3"]:
    """Poses to start smoothing from; NaN for scans without odometry between scans with odometry.

    No odometry links those to the others. Smoothing registers them on its map, or leaves them out.
    """
    if not has_odometry.any():
        return initial.poses
    is_first = np.arange(len(has_odometry)) == 0  # all others are relative to it
    return np.where((has_odometry | is_first)[:, None], initial.poses, np.nan)


def _check(
    log: Log,
    has_odometry: Bool[np.ndarray, " scans"],
    *,
    sigma: float | None,
    window: float | None,
    smooth: bool | None,
    speed: bool,
    scale: bool,
) -> None:
    """Raise a SonarError for arguments that are out of range or contradict each other."""
    check_sigma(sigma)
    check_window(window)
    count, total = int(has_odometry.sum()), len(log)
    if not total:
        raise SonarError("slam: no scan in the log; allowed is a log with one or more")
    if count and count < max(min(2, total), total / 2):
        raise SonarError(f"slam: odometry in {count} of {total} scans; allowed are half of them or more, or none")
    if scale and not count:
        raise SonarError("slam: the scale factors of the odometry need odometry; allowed is a log with odometry")
    if smooth is False and (scale or speed):
        raise SonarError("slam: speed and scale are estimated by smoothing; allowed is to smooth, or neither of them")
    if window is not None and not count:
        raise SonarError(f"slam: a window of {window:g} m of trajectory needs poses; allowed is a log with odometry")
