"""Multi-hypothesis tracking in a known map: pose hypotheses from features, each tracked through the scans by ranges."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.detection.local_model import LocalModel
from jaxsonar.estimation.odometry_noise import OdometryNoise, step_variance
from jaxsonar.geometry.se2 import compose, diagonal_covariance, propagate, relative, subtract_poses, wrap_pose
from jaxsonar.graph_slam.frontend import SubmapState, update
from jaxsonar.localization.known_map import KnownMap
from jaxsonar.localization.settings import SETTINGS
from jaxsonar.registration.features import scan_features
from jaxsonar.registration.pose_hypotheses import pose_hypotheses, thin_poses
from jaxsonar.registration.pose_likelihood import pose_log_likelihood, refine_poses
from jaxsonar.scans.firing_poses import path_poses
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


class TrackedHypothesis(NamedTuple):
    """A pose hypothesis and its track through the scans so far (Kalman filter)."""

    pose: Float[np.ndarray, "3"]
    """world_from_robot of the latest scan; of the first scan before any update."""
    covariance: Float[np.ndarray, "3 3"]
    poses: tuple[Float[np.ndarray, "3"], ...] = ()
    """Filtered poses of all scans so far."""
    covariances: tuple[Float[np.ndarray, "3 3"], ...] = ()
    log_likelihood: float = 0.0
    """Log-likelihood ratio of the ranges against echoes from anywhere, nats."""
    echoes: int = 0
    explained: int = 0
    """Number of echoes that the map explains."""
    is_start: bool = False
    """Whether it is the start pose that was given."""

    @property
    def explained_fraction(self) -> float:
        """Fraction of the echoes that the map explains."""
        return self.explained / max(self.echoes, 1)

    @property
    def is_determined(self) -> bool:
        """Whether the covariance of the latest pose is small in all directions."""
        position, heading = SETTINGS.max_pose_sd
        variance = np.linalg.eigvalsh(self.covariance[:2, :2])[-1]
        return bool(variance < position**2 and self.covariance[2, 2] < heading**2)

    def is_same(self, other: "TrackedHypothesis") -> bool:
        """Whether two hypotheses are statistically the same."""
        off = subtract_poses(self.pose, other.pose)
        if np.hypot(off[0], off[1]) > SETTINGS.same_pose[0] or abs(off[2]) > SETTINGS.same_pose[1]:
            return False
        covariance = self.covariance + other.covariance + diagonal_covariance(SETTINGS.same_pose_sd)
        return bool(off @ np.linalg.solve(covariance, off) < SETTINGS.same_pose_chi2)


@dataclass(frozen=True)
class HypothesisTracker:
    """The map, the scans, and the odometry between them."""

    ring: Ring
    known_map: KnownMap
    log: Log
    models: Sequence[LocalModel]
    odometry: Float[np.ndarray, "scans 3"]
    """NaN where a scan has none."""
    sigma: float | None
    odometry_noise: OdometryNoise

    @cached_property
    def path_pose(self) -> Float[np.ndarray, "scans paths 3"] | None:
        """scan_from_robot when each path was measured; None: all at the pose of the scan."""
        return path_poses(self.ring, self.log)

    @property
    def rows(self) -> Int[np.ndarray, " rows"]:
        """Scans whose relative poses are known from odometry; only these are used."""
        return np.flatnonzero(np.isfinite(self.odometry[:, 0]))

    @property
    def range_sd(self) -> float:
        """Standard deviation of the ranges, metres."""
        known = [model.sigma for model in self.models if model.sigma > 0]
        return self.sigma or (float(np.median(known)) if known else SETTINGS.default_sigma)

    def initial_hypotheses(self, start: Float[np.ndarray, "3"] | None) -> list[TrackedHypothesis]:
        """Hypotheses for the pose of the first scan: a given start pose, and poses at which features match the map."""
        covariance = diagonal_covariance(SETTINGS.hypothesis_sd)
        found = [TrackedHypothesis(pose, covariance) for pose in self._matching_poses(start)]
        if start is None:
            return found
        return [TrackedHypothesis(start, diagonal_covariance(SETTINGS.start_sd), is_start=True), *found]

    def _matching_poses(self, start: Float[np.ndarray, "3"] | None) -> list[Float[np.ndarray, "3"]]:
        """Poses of the first scan at which features of the first scans match the map, the most likely first."""
        known, rows = self.known_map.features, self.rows[: SETTINGS.first_scans]
        first = self.odometry[rows[0]]
        richest = sorted(rows, key=lambda row: -(len(self.models[row].lines) + len(self.models[row].points)))
        scans = {
            row: scan_features(self.models[row], noise_scale=SETTINGS.noise_scale)
            for row in richest[: SETTINGS.scoring_scans]
        }
        # 1. Hypotheses of the scans with the most features, as poses of the first scan.
        information = np.linalg.inv(diagonal_covariance(SETTINGS.hypothesis_sd))
        candidates = []
        for row in richest[: SETTINGS.hypothesis_scans]:
            scan, back = scans[row], relative(self.odometry[row], first)
            if len(scan.theta) + len(scan.point) < 2:
                continue
            # Two features determine a pose; one wall alone does not.
            poses = pose_hypotheses(scan, known, np.zeros(3))[1 + len(scan.theta) * len(known.theta) :]
            if start is not None:
                poses = poses[_is_near(compose(poses, back), start)]
            if not len(poses):
                continue
            poses = thin_poses(poses, SETTINGS.hypothesis_cell)
            batches = np.array_split(poses, -(-len(poses) // 4096))
            score = np.concatenate([pose_log_likelihood(known, scan, some).log_likelihood for some in batches])
            best = poses[np.argsort(-score, kind="stable")[: 4 * SETTINGS.max_hypotheses]]
            steps = SETTINGS.refinement_steps
            best = refine_poses(known, scan, best, information, prior_mean=best, steps=steps)
            candidates.append(compose(best, back))
        if not candidates:
            return []
        # 2. Scores by all of these scans, with their odometry; the best that differ from each other.
        poses = thin_poses(np.concatenate(candidates), SETTINGS.hypothesis_cell)
        score = np.zeros(len(poses))
        for row, scan in scans.items():
            moved = compose(poses, relative(first, self.odometry[row]))
            score = score + pose_log_likelihood(known, scan, moved).log_likelihood
        kept: list[Float[np.ndarray, 3]] = []
        position, heading = SETTINGS.same_pose
        for k in np.argsort(-score, kind="stable"):
            off = [subtract_poses(poses[k], one) for one in kept]
            if all(np.hypot(*one[:2]) > position / 2 or abs(one[2]) > heading / 2 for one in off):
                kept.append(poses[k])
            if len(kept) == SETTINGS.max_hypotheses:
                break
        return kept

    def track_first_scans(
        self, hypotheses: Sequence[TrackedHypothesis], progress: Callable[[str, int, int], None]
    ) -> list[TrackedHypothesis]:
        """Track hypotheses through the first scans, the most likely first; those far behind are dropped early."""
        count = min(SETTINGS.first_scans, len(self.rows))
        alive, dropped = list(hypotheses), []
        for number in range(count):
            alive = sorted((self.step(one, number) for one in alive), key=lambda one: -one.log_likelihood)
            alive = _merged(alive)
            best = alive[0].log_likelihood if alive else 0.0
            least = best - SETTINGS.pruning[0] - SETTINGS.pruning[1] * max(best, 0.0)
            # A dropped hypothesis would have kept its ratio to the best one.
            behind = [one for one in alive if one.log_likelihood < least]
            dropped += [(one, max(one.log_likelihood, 0.0) / max(best, 1e-9)) for one in behind]
            alive = [one for one in alive if one.log_likelihood >= least]
            progress("hypotheses", number + 1, count)
        best = alive[0].log_likelihood if alive else 0.0
        extrapolated = [one._replace(log_likelihood=best * ratio) for one, ratio in dropped]
        return [*alive, *sorted(extrapolated, key=lambda one: -one.log_likelihood)]

    def weigh_by_start(
        self, hypotheses: Sequence[TrackedHypothesis], start: Float[np.ndarray, "3"]
    ) -> list[TrackedHypothesis]:
        """Add the log-prior of a start pose, the most likely first.

        Undetermined hypotheses are left out, but for the start pose itself: its track contains them.
        """
        position, heading = SETTINGS.start_sd
        sd, weighed = np.array([position, position, heading]), []
        for one in hypotheses:
            if one.is_start or one.is_determined:
                off = subtract_poses(self.smooth(one)[0][0], start)
                log_prior = -float(np.square(off / sd).sum()) / 2
                weighed.append(one._replace(log_likelihood=one.log_likelihood + log_prior))
        return sorted(weighed, key=lambda one: -one.log_likelihood)

    def step(self, hypothesis: TrackedHypothesis, number: int) -> TrackedHypothesis:
        """Predict by odometry and update by the ranges of the scan with this number in ``rows``."""
        row, sigma = int(self.rows[number]), self.range_sd
        pose, covariance = hypothesis.pose, hypothesis.covariance
        if number:
            pose, covariance = self._predict(pose, covariance, number)
        belief = self.known_map.belief_at(pose, covariance, self.ring.max_range)
        scan = self.log[row]
        prior = SubmapState(belief, np.full(len(belief.landmarks.kind), 2, np.int64))
        found = update(
            self.ring,
            prior,
            scan,
            self.models[row],
            row=row,
            sigma=sigma,
            path_pose=None if self.path_pose is None else self.path_pose[row],
            add_landmarks=False,
        )
        pose, covariance = wrap_pose(found.pose), found.pose_covariance
        # Log-likelihood ratio of an explained echo against one from anywhere.
        gain = float(np.log(self.ring.max_range / (sigma * np.sqrt(2 * np.pi))))
        nats = SETTINGS.echo_weight * (gain * found.explained - found.normalized_squares / 2)
        return TrackedHypothesis(
            pose,
            covariance,
            (*hypothesis.poses, pose),
            (*hypothesis.covariances, covariance),
            hypothesis.log_likelihood + nats,
            hypothesis.echoes + scan.echo_count,
            hypothesis.explained + found.explained,
            hypothesis.is_start,
        )

    def smooth(
        self, hypothesis: TrackedHypothesis
    ) -> tuple[Float[np.ndarray, "scans 3"], Float[np.ndarray, "scans 3 3"]]:
        """Smoothed poses of a track and their covariances (Rauch, Tung and Striebel 1965)."""
        poses, covariances = np.array(hypothesis.poses), np.array(hypothesis.covariances)
        for k in reversed(range(len(poses) - 1)):
            # The joint covariance of the predicted pose and the pose before it.
            predicted, joint = self._predict(poses[k], np.tile(covariances[k], (2, 2)), k + 1)
            gain = np.linalg.solve(joint[:3, :3], joint[:3, 3:]).T
            poses[k] = wrap_pose(poses[k] + gain @ subtract_poses(poses[k + 1], predicted))
            covariances[k] += gain @ (covariances[k + 1] - joint[:3, :3]) @ gain.T
        return poses, covariances

    def _predict(
        self, pose: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "unknowns unknowns"], number: int
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "unknowns unknowns"]]:
        """Move a pose, with what it is correlated with, by the odometry between two consecutive rows."""
        step = relative(self.odometry[self.rows[number - 1]], self.odometry[self.rows[number]])
        return propagate(pose, covariance, step, np.diag(step_variance(self.odometry_noise, step)))


def _merged(hypotheses: Sequence[TrackedHypothesis]) -> list[TrackedHypothesis]:
    """The first of those that are the same; a given start pose is preferred, because it assumes least."""
    kept: list[TrackedHypothesis] = []
    for one in hypotheses:
        twin = next((k for k, other in enumerate(kept) if one.is_same(other)), None)
        if twin is None:
            kept.append(one)
        elif one.is_start:
            kept[twin] = one
    return kept


def _is_near(poses: Float[np.ndarray, "poses 3"], start: Float[np.ndarray, "3"]) -> np.ndarray:
    """Which poses are within the gate of a start pose."""
    off = subtract_poses(poses, start)
    position, heading = SETTINGS.start_sd
    near = np.hypot(off[:, 0], off[:, 1]) < SETTINGS.start_gate * position
    return near & (np.abs(off[:, 2]) < SETTINGS.start_gate * heading)
