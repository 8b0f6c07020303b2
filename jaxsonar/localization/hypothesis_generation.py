"""Initial pose hypotheses: poses at which the features of a few scans match the known map."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.detection.local_model import LocalModel
from jaxsonar.geometry.se2 import compose, diagonal_covariance, relative, subtract_poses
from jaxsonar.localization.settings import SETTINGS
from jaxsonar.registration.features import Features, scan_features
from jaxsonar.registration.pose_hypotheses import pose_hypotheses, thin_poses
from jaxsonar.registration.pose_likelihood import pose_log_likelihood, refine_poses


def matching_poses(
    known: Features,
    models: Sequence[LocalModel],
    odometry: Float[np.ndarray, "scans 3"],
    rows: Int[np.ndarray, " rows"],
    start: Float[np.ndarray, "3"] | None,
) -> list[Float[np.ndarray, "3"]]:
    """Poses of the first of some scans at which features of these scans match the map, the most likely first.

    Args:
        known: the map.
        models: local models of all scans.
        odometry: of all scans.
        rows: the scans that are used.
        start: if given, only poses near it are returned.
    """
    first = odometry[rows[0]]
    richest = sorted(rows, key=lambda row: -(len(models[row].lines) + len(models[row].points)))
    scans = {
        row: scan_features(models[row], noise_scale=SETTINGS.noise_scale) for row in richest[: SETTINGS.scoring_scans]
    }
    # 1. Hypotheses of the scans with the most features, as poses of the first scan.
    information = np.linalg.inv(diagonal_covariance(SETTINGS.hypothesis_sd))
    candidates = []
    for row in richest[: SETTINGS.hypothesis_scans]:
        scan, back = scans[row], relative(odometry[row], first)
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
        moved = compose(poses, relative(first, odometry[row]))
        score = score + pose_log_likelihood(known, scan, moved).log_likelihood
    return _best_distinct(poses, score)


def similar_poses(known: Features, seen: Features, pose: Float[np.ndarray, "3"]) -> list[Float[np.ndarray, "3"]]:
    """Other poses from which the map looks like the part of it that is seen from one pose, the most similar first.

    Args:
        known: the map.
        seen: a part of it, world frame, each wall from the side from which it is seen.
        pose: world_from_robot.
    """
    # 1. Motions of the map onto itself that move walls and points of the part onto others.
    motions = pose_hypotheses(seen, known, np.zeros(3))[1 + len(seen.theta) * len(known.theta) :]
    motions = thin_poses(np.concatenate([np.zeros((1, 3)), motions]), SETTINGS.hypothesis_cell)
    batches = np.array_split(motions, -(-len(motions) // 4096))
    score = np.concatenate([pose_log_likelihood(known, seen, some).log_likelihood for some in batches])
    # 2. The best of them, fitted, as poses of the robot.
    motions = motions[np.argsort(-score, kind="stable")[: 4 * SETTINGS.max_hypotheses]]
    information = np.linalg.inv(diagonal_covariance(SETTINGS.hypothesis_sd))
    motions = refine_poses(known, seen, motions, information, prior_mean=motions, steps=SETTINGS.refinement_steps)
    score = pose_log_likelihood(known, seen, motions).log_likelihood
    return _best_distinct(compose(motions, pose), score)


def _best_distinct(
    poses: Float[np.ndarray, "poses 3"], score: Float[np.ndarray, " poses"]
) -> list[Float[np.ndarray, "3"]]:
    """The poses of the best scores that differ from each other."""
    kept: list[Float[np.ndarray, 3]] = []
    position, heading = SETTINGS.same_pose
    for k in np.argsort(-score, kind="stable"):
        off = [subtract_poses(poses[k], one) for one in kept]
        if all(np.hypot(*one[:2]) > position / 2 or abs(one[2]) > heading / 2 for one in off):
            kept.append(poses[k])
        if len(kept) == SETTINGS.max_hypotheses:
            break
    return kept


def _is_near(poses: Float[np.ndarray, "poses 3"], start: Float[np.ndarray, "3"]) -> np.ndarray:
    """Which poses are within the gate of a start pose."""
    off = subtract_poses(poses, start)
    position, heading = SETTINGS.start_sd
    near = np.hypot(off[:, 0], off[:, 1]) < SETTINGS.start_gate * position
    return near & (np.abs(off[:, 2]) < SETTINGS.start_gate * heading)
