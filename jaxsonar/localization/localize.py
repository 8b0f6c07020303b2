"""Localization in a known map, from a rough start pose or without any (global localization).

Every pose at which walls and corners of a scan match the map is a hypothesis; each is tracked through the first scans
by the ranges of the echoes. Where places look alike more than one remains, and no pose is returned.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from jaxsonar.detection.extract import local_models
from jaxsonar.detection.local_model import LocalModel
from jaxsonar.detection.settings import check_sigma
from jaxsonar.estimation.estimation_log import estimation_log
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.estimation.trajectory import Trajectory, stamps_of
from jaxsonar.hardware.errors import SonarError
from jaxsonar.localization.hypothesis_tracking import HypothesisTracker
from jaxsonar.localization.known_map import KnownMap
from jaxsonar.localization.settings import SETTINGS, AcceptanceSettings
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.registration.sequential_registration import register_scans
from jaxsonar.scans.measured_directions import measured_directions
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


class PoseHypothesis(NamedTuple):
    """A possible pose of the first scan."""

    pose: Float[np.ndarray, "3"]
    """world_from_robot, metres and radians."""
    log_likelihood: float
    """Log-likelihood ratio of the first scans against echoes from anywhere, nats."""
    explained: float
    """Fraction of their echoes that the map explains."""


@dataclass(frozen=True, eq=False)
class Localized:
    """Poses in a known map."""

    poses: Float[np.ndarray, "scans 3"]
    """world_from_robot, metres and radians; NaN for scans without a certain pose. Firings that are scans of their own
    are merged first (``estimation_log``); one pose belongs to all of them."""
    covariance: Float[np.ndarray, "scans 3 3"]
    """Covariances in the world frame; the uncertainty of the map is taken into account scan by scan."""
    stamp: Float[np.ndarray, " scans"]
    """Seconds."""
    hypotheses: tuple[PoseHypothesis, ...]
    """Possible poses of the first scan, the most likely first."""
    is_certain: bool
    """Whether only one hypothesis is possible."""
    reason: str
    """The result, or why there is none, in words."""

    @property
    def trajectory(self) -> Trajectory:
        """Trajectory of the scans that have a pose."""
        known = np.isfinite(self.poses).all(axis=1)
        return Trajectory(self.stamp[known], self.poses[known], self.covariance[known])


def localize(
    ring: Ring,
    world: GlobalMap,
    log: Log,
    *,
    start: Sequence[float] | None = None,
    sigma: float | None = None,
    odometry_noise: OdometryNoise | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Localized:
    """Poses of scans in a known map.

    Args:
        ring: the sensors.
        world: the map.
        log: scans of a trajectory; their poses are odometry. Without odometry the scans are registered to each other
            first, and those that cannot be registered get no pose.
        start: approximate pose of the first scan, world_from_robot: x, y (m), theta (rad); anywhere if left out.
        sigma: standard deviation of the ranges, metres; estimated if left out.
        odometry_noise: noise model of the odometry.
        progress: called with a stage and (scans done, scans).

    Raises:
        SonarError: no scan, a map without walls, arguments out of range, no scan that can be registered.
    """
    _check(world, log, start, sigma)
    progress = progress or (lambda stage, done, total: None)
    log = estimation_log(log)
    # 1. Local models, and odometry between the scans.
    models = []
    for model in local_models(ring, log, sigma=sigma):
        models.append(model)
        progress("local models", len(models), len(log))
    odometry, noise = _odometry(ring, log, models), odometry_noise or OdometryNoise()
    tracker = HypothesisTracker(ring, KnownMap.of(world), log, models, odometry, sigma, noise)
    if not len(tracker.rows):
        raise SonarError("localize: no scan could be registered to another; allowed are scans with odometry, or nearby")
    # 2. Hypotheses for the pose of the first scan, tracked through the first scans.
    first = None if start is None else np.array(start, dtype=np.float64)
    tracks = tracker.track_first_scans(tracker.initial_hypotheses(first), progress)
    if first is not None:
        tracks = tracker.weigh_by_start(tracks, first)
    # 3. Is the best one the only one that is possible?
    hypotheses = tuple(
        PoseHypothesis(tracker.smooth(one)[0][0], one.log_likelihood, one.explained_fraction) for one in tracks
    )
    acceptance = SETTINGS.global_acceptance if first is None else SETTINGS.local_acceptance
    is_certain, reason = _judge(hypotheses, len(tracker.rows), acceptance)
    if is_certain and first is None and not tracks[0].is_determined:
        is_certain = False
        reason = f"{len(tracker.rows)} scans: a direction of the pose is not determined; a longer path may help"
    # 4. Track it through all other scans, and smooth.
    poses, covariance = np.full((len(log), 3), np.nan), np.full((len(log), 3, 3), np.nan)
    if is_certain:
        track = tracks[0]
        for number in range(len(track.poses), len(tracker.rows)):
            track = tracker.step(track, number)
            progress("localizing", number + 1, len(tracker.rows))
        poses[tracker.rows], covariance[tracker.rows] = tracker.smooth(track)
    return Localized(poses, covariance, stamps_of(log), hypotheses, is_certain, reason)


def _check(world: GlobalMap, log: Log, start: Sequence[float] | None, sigma: float | None) -> None:
    check_sigma(sigma)
    if not len(log):
        raise SonarError("localize: no scan in the log; allowed is a log with one or more")
    if not len(world) + len(world.points):
        raise SonarError("localize: the map has no wall; allowed is one with walls in reach")
    if start is not None and not (len(start) == 3 and np.isfinite(np.asarray(start, dtype=np.float64)).all()):
        raise SonarError(f"localize: start {tuple(start)}; allowed are x, y (m) and theta (rad)")


def _odometry(ring: Ring, log: Log, models: Sequence[LocalModel]) -> Float[np.ndarray, "scans 3"]:
    """Odometry of the log; without it, poses by registration of the scans. NaN where a scan has none."""
    known = np.asarray(np.isfinite(log.pose).all(axis=1))
    if known.any():
        return np.where(known[:, None], log.pose, np.nan)
    clusters = []
    if len(models) > 1:
        directions = measured_directions(ring, log)
        clusters = register_scans(models, None, noise_scale=SETTINGS.noise_scale, directions=directions)
    if clusters and np.isfinite(clusters[0][:, 0]).sum() > 1:
        return clusters[0]
    # Use the one scan with the most features.
    alone = np.full((len(log), 3), np.nan)
    alone[int(np.argmax([len(model.lines) + len(model.points) for model in models]))] = 0.0
    return alone


def _judge(hypotheses: Sequence[PoseHypothesis], scans: int, acceptance: AcceptanceSettings) -> tuple[bool, str]:
    """Whether the first hypothesis is the only possible one, and the result in words."""
    of = f"{scans} scan{'' if scans == 1 else 's'}"
    # 1. Does the map explain the echoes?
    least = acceptance.min_explained
    if not hypotheses or hypotheses[0].explained < least:
        share = f": at the best pose {100 * hypotheses[0].explained:.0f} % of the echoes fit" if hypotheses else ""
        return False, f"{of}: no place in the map fits{share}; needed are {100 * least:.0f} %"
    # 2. Does the best hypothesis beat all others together?
    best, others = hypotheses[0], [one.log_likelihood for one in hypotheses[1:]]
    ratio = best.log_likelihood - float(np.asarray(logsumexp(others))) if others else np.inf
    margin = acceptance.margin + acceptance.margin_fraction * max(best.log_likelihood, 0.0)
    if ratio < margin:
        alike = [one for one in hypotheses if one.log_likelihood > best.log_likelihood - margin]
        alike = alike if len(alike) > 1 else list(hypotheses[:2])
        shown = "; ".join(f"{p.pose[0]:.2f}, {p.pose[1]:.2f} m, {np.degrees(p.pose[2]):.0f} deg" for p in alike[:4])
        more = f"; {len(alike) - 4} more" if len(alike) > 4 else ""
        return False, f"{of}: ambiguous, {len(alike)} places look alike: {shown}{more}; a longer path may help"
    rivals = f"log-likelihood ratio to all other poses: {ratio:.0f} nats" if others else "no other pose fits"
    x, y, theta = best.pose
    return True, (
        f"{of}: the first is at {x:.3f}, {y:.3f} m, {np.degrees(theta):.2f} deg; {rivals}; "
        f"{100 * best.explained:.0f} % of the echoes fit"
    )
