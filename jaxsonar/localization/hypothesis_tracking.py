"""Multi-hypothesis tracking in a known map: all pose hypotheses are tracked through the scans by their ranges."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.detection.local_model import LocalModel
from jaxsonar.estimation.odometry_noise import OdometryNoise, step_variance
from jaxsonar.geometry.se2 import compose, diagonal_covariance, propagate, relative, subtract_poses, wrap_pose
from jaxsonar.geometry.segments import crossings
from jaxsonar.kernels.sensor_array import transform_path
from jaxsonar.kernels.shape_buckets import next_power_of_two, pad_rows
from jaxsonar.localization.hypothesis_generation import matching_poses, similar_poses
from jaxsonar.localization.known_map import KnownMap
from jaxsonar.localization.place_probabilities import relative_log_likelihood
from jaxsonar.localization.scan_update import ScanArrays, ScanUpdate, update_hypotheses
from jaxsonar.localization.settings import SETTINGS, UPDATE_SETTINGS, MapTrust
from jaxsonar.scans.firing_poses import path_poses
from jaxsonar.scans.flat_echoes import corrected_echoes
from jaxsonar.scans.measured_paths import measured_paths
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


class PoseTracks(NamedTuple):
    """Pose hypotheses and their tracks through the scans so far, one row each. Scans to come have rows of zeros."""

    pose: Float[np.ndarray, "hypotheses 3"]
    """world_from_robot of the latest scan; of the first one before any update."""
    covariance: Float[np.ndarray, "hypotheses 3 3"]
    evidence: Float[np.ndarray, "hypotheses landmarks"]
    """Sum of the evidence of each landmark of the map, nats."""
    explained: Float[np.ndarray, " hypotheses"]
    """Number of echoes that the map explains."""
    is_start: Bool[np.ndarray, " hypotheses"]
    """Whether it is the start pose that was given."""
    poses: Float[np.ndarray, "hypotheses scans 3"]
    """Filtered poses."""
    covariances: Float[np.ndarray, "hypotheses scans 3 3"]
    """Their covariances."""
    scan_evidence: Float[np.ndarray, "hypotheses scans"]
    """Evidence of each scan: log-likelihood ratio of its echoes against unknown reflectors, with the agreement of the
    pose with the odometry (``ScanUpdate.log_odometry``), nats."""

    @classmethod
    def at(
        cls, pose: Float[np.ndarray, "hypotheses 3"], covariance: Float[np.ndarray, "hypotheses 3 3"], landmarks: int
    ) -> "PoseTracks":
        """Hypotheses before the first scan, in a map with this many landmarks."""
        count = len(pose)
        nothing, table = np.zeros(count), np.zeros((count, landmarks))
        return cls(pose, covariance, table, nothing, np.zeros(count, dtype=bool), *_empty_tracks(count, 0))

    def take(self, rows: Int[np.ndarray, " rows"] | Bool[np.ndarray, " hypotheses"]) -> "PoseTracks":
        """Select some of the hypotheses."""
        return PoseTracks(*(column[rows] for column in self))

    def join(self, other: "PoseTracks") -> "PoseTracks":
        """These hypotheses and others after the same scans."""
        return PoseTracks(*(np.concatenate([mine, its]) for mine, its in zip(self, other, strict=True)))

    @property
    def is_determined(self) -> Bool[np.ndarray, " hypotheses"]:
        """Whether the covariance of the pose was small in all directions at one of the scans."""
        position, heading = SETTINGS.max_pose_sd
        variance = np.linalg.eigvalsh(self.covariances[:, :, :2, :2])[..., -1]
        is_small = (variance < position**2) & (self.covariances[:, :, 2, 2] < heading**2)
        return np.asarray(is_small.any(axis=1))


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
    trust: MapTrust
    """How far the map is trusted."""

    @property
    def rows(self) -> Int[np.ndarray, " rows"]:
        """Scans whose relative poses are known from odometry; only these are used."""
        return np.flatnonzero(np.isfinite(self.odometry[:, 0]))

    @property
    def range_sd(self) -> float:
        """Standard deviation of the ranges, metres."""
        known = [model.sigma for model in self.models if model.sigma > 0]
        return self.sigma or (float(np.median(known)) if known else SETTINGS.default_sigma)

    @cached_property
    def scans(self) -> list[ScanArrays]:
        """The echoes of the scans in ``rows``."""
        ring, moved = self.ring, path_poses(self.ring, self.log)
        measured = measured_paths(ring, self.log)
        direct = np.flatnonzero(ring.paths[:, 0] == ring.paths[:, 1])
        step = np.median(self._moved) if len(self._moved) else np.inf
        views = float(np.clip(SETTINGS.shared_length / max(step, 1e-3), 1.0, SETTINGS.max_shared_views))
        echoes = [corrected_echoes(ring, self.log[int(row)]) for row in self.rows]
        size = next_power_of_two(max(len(path) for path, _ in echoes), least=SETTINGS.min_echoes)
        full_wall = float(np.asarray(ring.exact_paths.width).sum() / (2 * np.pi))
        full_echoes = max(UPDATE_SETTINGS.full_wall_share * full_wall, UPDATE_SETTINGS.min_full_echoes)
        found = []
        for row, (path, ranges) in zip(self.rows, echoes, strict=True):
            first = np.full(len(ring.paths), np.inf)
            np.minimum.at(first, path, ranges)
            paths = ring.exact_paths
            if moved is not None:
                with jax.enable_x64(True):
                    paths = jax.tree.map(np.asarray, jax.vmap(transform_path)(paths, jnp.asarray(moved[row])))
            found.append(
                ScanArrays(
                    paths=_take(paths, pad_rows(path, size)),
                    ranges=pad_rows(ranges, size),
                    is_echo=np.arange(size) < len(path),
                    direct=_take(paths, direct),
                    first=first[direct],
                    measured=np.asarray(measured[row][direct]),
                    sigma=np.float64(self.range_sd),
                    max_range=np.float64(ring.max_range),
                    full_echoes=np.float64(full_echoes),
                    map_views=np.float64(views),
                )
            )
        return found

    @cached_property
    def echo_counts(self) -> Int[np.ndarray, " rows"]:
        """Number of echoes of the scans in ``rows``."""
        return np.array([int(scan.is_echo.sum()) for scan in self.scans])

    @cached_property
    def chance_nats(self) -> float:
        """Evidence per echo that a scan gains by chance: at poses all over the map, fitted like the hypotheses, nats.

        It depends on the map and on how widely the sensors hear, which no constant covers. In a bare corridor many of
        these poses are as good as the true one, so that little speaks for any place.
        """
        low, high = self.known_map.bounds
        drawn = np.random.default_rng(0).uniform([*low, -np.pi], [*high, np.pi], (SETTINGS.chance_poses, 3))
        start, gained = self._at(list(drawn)), []
        heard = np.flatnonzero(self.echo_counts)
        if not len(heard):
            return 0.0
        chosen = heard[np.unique(np.linspace(0, len(heard) - 1, SETTINGS.chance_scans).round().astype(int))]
        for number in chosen.tolist():
            found = self._update_all(start.pose, start.covariance, number, UPDATE_SETTINGS.iterations[False])
            evidence = found.evidence.sum(axis=1) + found.log_odometry
            gained.append(np.quantile(evidence, 1 - 1 / SETTINGS.max_hypotheses))
        return max(float(np.sum(gained) / self.echo_counts[chosen].sum()), 0.0)

    @cached_property
    def _moved(self) -> Float[np.ndarray, " steps"]:
        """Motion between consecutive scans in ``rows``, metres; a turn by one radian counts as ``turn_length``."""
        step = relative(self.odometry[self.rows[:-1]], self.odometry[self.rows[1:]])
        return np.hypot(step[:, 0], step[:, 1]) + SETTINGS.turn_length * np.abs(step[:, 2])

    @cached_property
    def scan_weights(self) -> Float[np.ndarray, " rows"]:
        """Part of an independent stretch of the trajectory that each scan in ``rows`` is.

        Scans on a stretch that is passed several times share it. Together all scans are at least one stretch.
        """
        position, moved = self.odometry[self.rows, :2], np.append(0.0, self._moved)
        passed = np.empty(len(moved))  # motion nearby
        for begin in range(0, len(moved), SETTINGS.distance_rows):  # no table of all pairs of scans
            part = slice(begin, begin + SETTINGS.distance_rows)
            squared = sum(np.square(np.subtract.outer(one[part], one)) for one in position.T)
            is_near = squared < (self.trust.stretch / 2) ** 2
            passed[part] = is_near @ moved
        weight = moved / np.maximum(passed, self.trust.stretch)
        weight[0] = max(1.0 - weight.sum(), 0.0)
        return weight

    def initial_hypotheses(
        self, start: Float[np.ndarray, "3"] | None, progress: Callable[[str, int, int], None]
    ) -> PoseTracks:
        """Hypotheses for the pose of the first scan.

        They are a given start pose, and poses at which features of the first scans match the map. If the pose is
        searched everywhere, scans farther along the trajectory contribute too, tracked back to the first one.
        """
        rows, size = self.rows, len(self.known_map.arrays.covariance)
        found = self._at(
            matching_poses(self.known_map.features, self.models, self.odometry, rows[: SETTINGS.first_scans], start)
        )
        if start is not None:
            given = PoseTracks.at(start[None], diagonal_covariance(SETTINGS.start_sd)[None], size)
            return given._replace(is_start=np.ones(1, dtype=bool)).join(found)
        later = np.arange(SETTINGS.first_scans, len(rows) - 1, SETTINGS.first_scans)
        later = (
            later[np.unique(np.linspace(0, len(later) - 1, SETTINGS.later_groups).round().astype(int))]
            if len(later)
            else later
        )
        for done, number in enumerate(later):
            progress("hypotheses", done, len(later))
            group = rows[number : number + SETTINGS.first_scans]
            poses = matching_poses(self.known_map.features, self.models, self.odometry, group, None)
            some = self._at(poses[: SETTINGS.later_hypotheses])
            if len(some.pose):
                back = self.track(some, np.arange(number, -1, -1))
                found = found.join(self._at(list(back.pose)))
        return found

    def similar_hypotheses(self, hypotheses: PoseTracks) -> PoseTracks:
        """Hypotheses for the pose of the first scan at which the map looks as it does along the track of the best one.

        The features of single scans may miss one of several places that look alike; what a whole track sees does not.
        """
        seen = self.known_map.seen_features(hypotheses.evidence[0], hypotheses.poses[0, :, :2])
        if len(seen.theta) + len(seen.point) < 2:
            return self._at([])
        first = self.smooth(hypotheses.poses[0], hypotheses.covariances[0])[0][0]
        return self._at(similar_poses(self.known_map.features, seen, first)[: SETTINGS.similar_hypotheses])

    def _at(self, poses: Sequence[Float[np.ndarray, "3"]]) -> PoseTracks:
        covariance = np.tile(diagonal_covariance(SETTINGS.hypothesis_sd), (len(poses), 1, 1))
        return PoseTracks.at(
            np.array(poses, dtype=np.float64).reshape(-1, 3), covariance, len(self.known_map.arrays.covariance)
        )

    def track(
        self,
        hypotheses: PoseTracks,
        numbers: Int[np.ndarray, " steps"],
        progress: Callable[[str, int, int], None] | None = None,
    ) -> PoseTracks:
        """Track hypotheses through scans, forward or backward; the most likely first. Those far behind are dropped.

        Args:
            hypotheses: for the pose of the first of the scans.
            numbers: of the scans in ``rows``, consecutive.
            progress: called with a stage and (scans done, scans).
        """
        hypotheses = PoseTracks(*hypotheses[:5], *_empty_tracks(len(hypotheses.pose), len(numbers)))
        hypotheses = hypotheses._replace(evidence=hypotheses.evidence.copy())
        for k in range(len(numbers)):
            if not len(hypotheses.pose):
                return hypotheses
            hypotheses = self._step(hypotheses, k, numbers)
            if (k + 1) % SETTINGS.pruning_scans == 0:
                kept = np.sort(self._possible(hypotheses, numbers[: k + 1]))
                hypotheses = hypotheses.take(kept) if len(kept) < len(hypotheses.pose) else hypotheses
            if progress:
                progress("hypotheses", k + 1, len(numbers))
        return self.best_of(hypotheses, numbers)

    def _step(self, hypotheses: PoseTracks, k: int, numbers: Int[np.ndarray, " steps"]) -> PoseTracks:
        """Predict by odometry, and update by the scan ``numbers[k]``; its row of the tracks is written in place."""
        number, previous = int(numbers[k]), int(numbers[k - 1]) if k else None
        pose, covariance = hypotheses.pose, hypotheses.covariance
        if previous is not None:
            pose, covariance = self._predict_all(pose, covariance, previous, number)
        found = self._update_all(pose, covariance, number, UPDATE_SETTINGS.iterations[previous is not None])
        poses, covariances = np.asarray(found.poses), np.asarray(found.covariances)
        np.add.at(hypotheses.evidence, (np.arange(len(pose))[:, None], found.landmark), found.evidence)
        of_scan = found.evidence.sum(axis=1) + found.log_odometry
        if previous is not None:
            of_scan = of_scan - SETTINGS.crossing_nats * self._crosses(hypotheses.pose, poses)
        for column, row in zip(hypotheses[5:], (poses, covariances, of_scan), strict=True):
            column[:, k] = row
        explained = hypotheses.explained + found.explained
        return hypotheses._replace(pose=poses, covariance=covariances, explained=explained)

    def log_likelihoods(
        self, hypotheses: PoseTracks, numbers: Int[np.ndarray, " steps"]
    ) -> tuple[Float[np.ndarray, " hypotheses"], float]:
        """Log-likelihoods of hypotheses that were tracked through these scans, and of none of them, nats.

        See ``place_probabilities.relative_log_likelihood``.
        """
        none = self.chance_nats * self.echo_counts[numbers]
        both = np.concatenate([hypotheses.scan_evidence[:, : len(numbers)], none[None]])
        found = relative_log_likelihood(both, self.scan_weights[numbers], self.trust)
        return found[:-1], float(found[-1])

    def best_of(self, hypotheses: PoseTracks, numbers: Int[np.ndarray, " steps"]) -> PoseTracks:
        """The distinct hypotheses whose odds against the best one may still change, the most likely first.

        A given start pose is kept, and preferred to others that are the same, because it assumes least.
        """
        return hypotheses.take(self._possible(hypotheses, numbers))

    def _possible(self, hypotheses: PoseTracks, numbers: Int[np.ndarray, " steps"]) -> Int[np.ndarray, " kept"]:
        """Rows of ``best_of``."""
        score, _ = self.log_likelihoods(hypotheses, numbers)
        order = np.lexsort((-score, ~hypotheses.is_start))
        kept = order[_distinct(hypotheses.take(order))]
        kept = kept[(score[kept] >= score.max(initial=-np.inf) - SETTINGS.pruning) | hypotheses.is_start[kept]]
        return kept[np.argsort(-score[kept], kind="stable")[: SETTINGS.max_tracked]]

    def _update_all(
        self,
        pose: Float[np.ndarray, "hypotheses 3"],
        covariance: Float[np.ndarray, "hypotheses 3 3"],
        number: int,
        iterations: int,
    ) -> ScanUpdate:
        """``update_hypotheses`` in batches of one size, so that it is compiled once for all numbers of hypotheses."""
        size, parts = SETTINGS.batch, []
        with jax.enable_x64(True):
            for begin in range(0, len(pose), size):
                count = min(size, len(pose) - begin)
                padded = np.tile(np.eye(3), (size, 1, 1))
                padded[:count] = covariance[begin : begin + count]
                part = pad_rows(pose[begin : begin + count], size)
                found = update_hypotheses(part, padded, self.known_map.arrays, self.scans[number], np.int64(iterations))
                parts.append([np.asarray(column)[:count] for column in found])
        return ScanUpdate(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def _crosses(
        self, start: Float[np.ndarray, "hypotheses 3"], end: Float[np.ndarray, "hypotheses 3"]
    ) -> Bool[np.ndarray, " hypotheses"]:
        """Whether the robot passes through a wall between two scans."""
        way, wall = crossings(np.stack([start[:, :2], end[:, :2]], axis=1), self.known_map.segments)
        length = np.linalg.norm(np.diff(self.known_map.segments, axis=1)[:, 0], axis=-1)
        margin = SETTINGS.crossing_margin / length
        return ((way > 0) & (way < 1) & (wall > margin) & (wall < 1 - margin)).any(axis=1)

    def smooth(
        self, poses: Float[np.ndarray, "scans 3"], covariances: Float[np.ndarray, "scans 3 3"]
    ) -> tuple[Float[np.ndarray, "scans 3"], Float[np.ndarray, "scans 3 3"]]:
        """Smoothed poses of a track and their covariances (Rauch, Tung and Striebel 1965)."""
        poses, covariances = poses.copy(), covariances.copy()
        for k in reversed(range(len(poses) - 1)):
            # The joint covariance of the predicted pose and the pose before it.
            predicted, joint = self._predict(poses[k], np.tile(covariances[k], (2, 2)), k, k + 1)
            gain = np.linalg.solve(joint[:3, :3], joint[:3, 3:]).T
            poses[k] = wrap_pose(poses[k] + gain @ subtract_poses(poses[k + 1], predicted))
            covariances[k] += gain @ (covariances[k + 1] - joint[:3, :3]) @ gain.T
        return poses, covariances

    def odometry_misfit(self, poses: Float[np.ndarray, "scans 3"]) -> float:
        """Mean squared Mahalanobis distance of the steps of a smoothed track from those of the odometry."""
        step, moved = (relative(one[:-1], one[1:]) for one in (self.odometry[self.rows], poses))
        variance = np.array([step_variance(self.odometry_noise, one) for one in step]).reshape(-1, 3)
        squared = np.square(subtract_poses(moved, step)) / variance
        return float(squared.sum(axis=1).mean()) if len(step) else 0.0

    def _predict(
        self, pose: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "unknowns unknowns"], before: int, after: int
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "unknowns unknowns"]]:
        """Move a pose, with what it is correlated with, by the odometry between two consecutive rows."""
        step = relative(self.odometry[self.rows[before]], self.odometry[self.rows[after]])
        return propagate(pose, covariance, step, np.diag(step_variance(self.odometry_noise, step)))

    def _predict_all(
        self,
        pose: Float[np.ndarray, "hypotheses 3"],
        covariance: Float[np.ndarray, "hypotheses 3 3"],
        before: int,
        after: int,
    ) -> tuple[Float[np.ndarray, "hypotheses 3"], Float[np.ndarray, "hypotheses 3 3"]]:
        """``_predict`` for all hypotheses."""
        step = relative(self.odometry[self.rows[before]], self.odometry[self.rows[after]])
        cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        by_pose, by_step = np.tile(np.eye(3), (2, len(pose), 1, 1))
        by_step[:, 0, 0], by_step[:, 0, 1], by_step[:, 1, 0], by_step[:, 1, 1] = cos, -sin, sin, cos
        moved = compose(pose, step)
        by_pose[:, 0, 2], by_pose[:, 1, 2] = pose[:, 1] - moved[:, 1], moved[:, 0] - pose[:, 0]
        noise = np.diag(step_variance(self.odometry_noise, step))
        return moved, by_pose @ covariance @ by_pose.swapaxes(1, 2) + by_step @ noise @ by_step.swapaxes(1, 2)


def _empty_tracks(
    count: int, scans: int
) -> tuple[
    Float[np.ndarray, "hypotheses scans 3"],
    Float[np.ndarray, "hypotheses scans 3 3"],
    Float[np.ndarray, "hypotheses scans"],
]:
    """Poses, covariances and evidence of tracks that have room for this many scans."""
    return np.zeros((count, scans, 3)), np.zeros((count, scans, 3, 3)), np.zeros((count, scans))


def _take(paths: kernels.EchoPaths, rows: Int[np.ndarray, " rows"]) -> kernels.EchoPaths:
    """Some of the paths, as NumPy arrays."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[rows], paths)


def _distinct(hypotheses: PoseTracks) -> Int[np.ndarray, " kept"]:
    """Rows of the first of those that are statistically the same."""
    pose, covariance = hypotheses.pose, hypotheses.covariance
    off = subtract_poses(pose[:, None], pose[None])
    alike = (np.hypot(off[..., 0], off[..., 1]) < SETTINGS.same_pose[0]) & (np.abs(off[..., 2]) < SETTINGS.same_pose[1])
    both = covariance[:, None] + covariance + diagonal_covariance(SETTINGS.same_pose_sd)
    squared = np.einsum("abi,abi->ab", off, np.linalg.solve(both, off[..., None])[..., 0])
    alike &= squared < SETTINGS.same_pose_chi2
    kept: list[int] = []
    for k in range(len(pose)):
        if not alike[k, kept].any():
            kept.append(k)
    return np.array(kept, dtype=np.int64)
