"""Localization in a known map, from a rough start pose or without any (global localization).

Every pose at which walls and corners of a scan match the map is a hypothesis; each is tracked through the scans by the
ranges of the echoes, as long as its odds allow. Where places look alike more than one remains: their probabilities are
returned, and no trajectory.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsonar.detection.extract import local_models
from jaxsonar.detection.local_model import LocalModel
from jaxsonar.detection.settings import check_sigma
from jaxsonar.estimation.estimation_log import estimation_log
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.estimation.trajectory import Trajectory, stamps_of
from jaxsonar.geometry.se2 import subtract_poses
from jaxsonar.hardware.errors import SonarError
from jaxsonar.localization.hypothesis_tracking import HypothesisTracker, PoseTracks
from jaxsonar.localization.known_map import KnownMap, trust_in
from jaxsonar.localization.place_probabilities import place_probabilities
from jaxsonar.localization.settings import SETTINGS
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
    """Log-likelihood relative to the best fit of every scan, nats (``place_probabilities``)."""
    explained: float
    """Fraction of the echoes of all scans that the map explains."""
    probability: float
    """Probability of the place; the rest to 1 of all places is the probability of none of them."""


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
    map_sd: tuple[float, float] | None = None,
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
        map_sd: least standard deviations of the walls of the map: across (m), direction (rad); those of the map if left
            out, and 2 cm and 0.3 deg for a floor plan.
        progress: called with a stage and (scans done, scans).

    Raises:
        SonarError: no scan, a map without walls, arguments out of range, no scan that can be registered.
    """
    _check(world, log, start, sigma, map_sd)
    progress = progress or (lambda stage, done, total: None)
    log = estimation_log(log)
    # 1. Local models, and odometry between the scans.
    models = []
    for model in local_models(ring, log, sigma=sigma):
        models.append(model)
        progress("local models", len(models), len(log))
    odometry, noise = _odometry(ring, log, models), odometry_noise or OdometryNoise()
    # Near a start pose, structure seldom repeats itself.
    trust = trust_in(world) if start is None else SETTINGS.map_trust
    tracker = HypothesisTracker(ring, KnownMap.of(world, map_sd), log, models, odometry, sigma, noise, trust)
    if not len(tracker.rows):
        raise SonarError("localize: no scan could be registered to another; allowed are scans with odometry, or nearby")
    # 2. Hypotheses for the pose of the first scan, tracked through all scans.
    first = None if start is None else np.array(start, dtype=np.float64)
    numbers = np.arange(len(tracker.rows))
    tracks = tracker.track(tracker.initial_hypotheses(first, progress), numbers, progress)
    if len(tracks.pose) and first is None:
        similar = tracker.track(tracker.similar_hypotheses(tracks), numbers, progress)
        tracks = tracker.best_of(tracks.join(similar), numbers)
    # 3. Probabilities of the places; is one of them certain?
    smoothed = [tracker.smooth(*track) for track in zip(tracks.poses, tracks.covariances, strict=True)]
    score, none = tracker.log_likelihoods(tracks, numbers)
    if first is not None:
        score = score + _log_prior(np.array([poses[0] for poses, _ in smoothed]), first, tracks)
    probability = place_probabilities(score, none)
    share = tracks.explained / max(int(tracker.echo_counts.sum()), 1)
    order = np.argsort(-score, kind="stable")
    hypotheses = tuple(
        PoseHypothesis(smoothed[k][0][0], float(score[k]), float(share[k]), float(probability[k]))
        for k in order
        if np.isfinite(score[k])
    )
    is_certain, reason = _judge(hypotheses, len(numbers), is_local=first is not None)
    if is_certain and first is None and not tracks.is_determined[order[0]]:
        is_certain = False
        reason = f"{len(numbers)} scans: a direction of the pose is not determined; a longer path may help"
    if is_certain and tracker.odometry_misfit(smoothed[order[0]][0]) > SETTINGS.max_odometry_misfit:
        is_certain = False
        reason = f"{len(numbers)} scans: the track at the best place contradicts the odometry"
    # 4. The poses of its track.
    poses, covariance = np.full((len(log), 3), np.nan), np.full((len(log), 3, 3), np.nan)
    if is_certain:
        poses[tracker.rows], covariance[tracker.rows] = smoothed[order[0]]
    return Localized(poses, covariance, stamps_of(log), hypotheses, is_certain, reason)


def _log_prior(
    poses: Float[np.ndarray, "hypotheses 3"], start: Float[np.ndarray, "3"], tracks: PoseTracks
) -> Float[np.ndarray, " hypotheses"]:
    """Log-prior of poses of the first scan by a start pose, nats.

    It is -inf for those that are not determined, but for the start pose itself: its track contains them.
    """
    position, heading = SETTINGS.start_sd
    off = subtract_poses(poses, start) / np.array([position, position, heading])
    return np.where(tracks.is_start | tracks.is_determined, -np.square(off).sum(axis=1) / 2, -np.inf)


def _check(
    world: GlobalMap, log: Log, start: Sequence[float] | None, sigma: float | None, map_sd: tuple[float, float] | None
) -> None:
    check_sigma(sigma)
    if map_sd is not None and not (len(map_sd) == 2 and all(0 < sd < 10 for sd in map_sd)):
        raise SonarError(f"localize: map_sd {tuple(map_sd)}; allowed are two standard deviations above 0 (m, rad)")
    if not len(log):
        raise SonarError("localize: no scan in the log; allowed is a log with one or more")
    if not len(world) + len(world.points):
        raise SonarError("localize: the map has no wall and no point; allowed is one with walls in reach")
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


def _judge(hypotheses: Sequence[PoseHypothesis], scans: int, *, is_local: bool) -> tuple[bool, str]:
    """Whether the first hypothesis is certain, and the result in words: a heading, and a line for each place."""
    of = f"{scans} scan{'' if scans == 1 else 's'}"
    # 1. Does the map explain the echoes?
    least = SETTINGS.min_explained[is_local]
    if not hypotheses or hypotheses[0].explained < least:
        share = f": at the best pose {100 * hypotheses[0].explained:.0f} % of the echoes fit" if hypotheses else ""
        return False, f"{of}: no place in the map fits{share}; needed are {100 * least:.0f} %"
    # 2. Is it the only place that is possible?
    best = hypotheses[0]
    fit = f"{100 * best.explained:.0f} % of the echoes fit"
    if best.probability >= SETTINGS.certain:
        x, y, theta = best.pose
        return True, (
            f"{of}: the first is at {x:.3f}, {y:.3f} m, {np.degrees(theta):.2f} deg; "
            f"probability {_percent(best.probability)}; {fit}"
        )
    alike = [one for one in hypotheses if one.probability > SETTINGS.shown_probability][: SETTINGS.shown_places]
    none = 1 - sum(one.probability for one in hypotheses)
    if none > 0.5 or not alike:
        return False, f"{of}: no place in the map fits: at the best pose {fit}; probability of chance {_percent(none)}"
    if len(alike) == 1:
        heading = f"{of}: uncertain, {_percent(none)} for no place of the map"
    else:
        heading = f"{of}: ambiguous, {len(alike)} places look alike"
    lines = [
        f"{_percent(one.probability)}: {one.pose[0]:.2f}, {one.pose[1]:.2f} m, {np.degrees(one.pose[2]):.0f} deg; "
        f"{100 * one.explained:.0f} % of the echoes fit"
        for one in alike
    ]
    return False, "\n".join([f"{heading}; a longer path may help", *lines])


def _percent(probability: float) -> str:
    """A probability in percent that is never rounded to certainty."""
    return f"{min(100 * probability, 99.9):.1f} %"
