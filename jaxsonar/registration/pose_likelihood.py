"""How well poses of a scan agree with a map: log-likelihood of its walls and points, with gradient and information."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.se2 import perpendicular, rotate, subtract_poses, wrap_angle
from jaxsonar.registration.features import Features
from jaxsonar.registration.settings import FEATURE_SETTINGS as SETTINGS


class PoseLikelihood(NamedTuple):
    """Agreement of a scan with a map, for many poses."""

    log_likelihood: Float[np.ndarray, " poses"]
    """Log-likelihood ratio of walls and points against features unrelated to the map, nats."""
    wall: Int[np.ndarray, "poses lines"]
    """Row of the wall that each wall of the scan is matched to; -1 where it is new."""
    point: Int[np.ndarray, "poses points"]
    """The same for points."""
    gradient: Float[np.ndarray, "poses 3"]
    """Of half the sum of squared residuals by the pose (x, y, theta)."""
    information: Float[np.ndarray, "poses 3 3"]
    """Gauss-Newton approximation of the Hessian of that sum."""


class _Term(NamedTuple):
    """Contribution of walls or of points alone."""

    log_likelihood: Float[np.ndarray, " poses"]
    match: Int[np.ndarray, "poses features"]
    gradient: Float[np.ndarray, "poses 3"]
    information: Float[np.ndarray, "poses 3 3"]

    @staticmethod
    def unmatched(poses: int, features: int) -> "_Term":
        return _Term(np.zeros(poses), np.full((poses, features), -1), np.zeros((poses, 3)), np.zeros((poses, 3, 3)))


def pose_log_likelihood(known: Features, scan: Features, poses: Float[np.ndarray, "poses 3"]) -> PoseLikelihood:
    """Match every feature of a scan to its most likely feature of the map, or to none, at each pose.

    Args:
        known: the map.
        scan: features of the scan in the robot frame.
        poses: map_from_robot, metres and radians.
    """
    walls, points = (_Term.unmatched(len(poses), len(those)) for those in (scan.theta, scan.point))
    if len(known.theta) and len(scan.theta):
        walls = _match_walls(known, scan, poses)
    else:
        walls.log_likelihood[:] = _new_wall_log_odds(known) * scan.weight.sum()
    if len(known.point) and len(scan.point):
        points = _match_points(known, scan, poses)
    return PoseLikelihood(
        log_likelihood=walls.log_likelihood + points.log_likelihood,
        wall=walls.match,
        point=points.match,
        gradient=walls.gradient + points.gradient,
        information=walls.information + points.information,
    )


def refine_poses(
    known: Features,
    scan: Features,
    poses: Float[np.ndarray, "poses 3"],
    prior_information: Float[np.ndarray, "3 3"],
    *,
    prior_mean: Float[np.ndarray, "*#poses 3"] | None = None,
    steps: int = SETTINGS.refinement_steps,
    max_step: float = np.inf,
) -> Float[np.ndarray, "poses 3"]:
    """Gauss-Newton steps of ``pose_log_likelihood``, each pose by itself; the matches are renewed in every step.

    Args:
        known: the map.
        scan: features of the scan in the robot frame.
        poses: start values, map_from_robot.
        prior_information: inverse covariance of the pose before the scan.
        prior_mean: mean of that prior; without one the prior only damps the steps.
        steps: number of steps.
        max_step: largest change of a coordinate in one step, metres and radians.
    """
    for _ in range(steps):
        found = pose_log_likelihood(known, scan, poses)
        gradient = found.gradient
        if prior_mean is not None:
            gradient = gradient + subtract_poses(poses, prior_mean) @ prior_information
        step = np.linalg.solve(found.information + prior_information, gradient[..., None])[..., 0]
        poses = poses - np.clip(step, -max_step, max_step)
    return poses


def _match_walls(known: Features, scan: Features, poses: Float[np.ndarray, "poses 3"]) -> _Term:
    """The most likely wall for each wall of the scan; residuals are the offset at its center and the direction."""
    normal, heading = known.normal, poses[:, 2, None]
    arm = rotate(scan.middle, heading)  # (poses, lines, 2)
    displacement = (poses[:, None, :2] + arm)[:, :, None] - known.reference  # (poses, lines, walls, 2)
    along = (displacement * known.tangent).sum(-1)
    across = (displacement * normal).sum(-1) - known.offset
    turn = wrap_angle(scan.theta[:, None] + heading[..., None] - known.theta)
    var_across = known.offset_variance(along) + scan.covariance[:, :1, 0]
    var_turn = known.covariance[:, 1, 1] + scan.covariance[:, 1:, 1]
    distance = across**2 / var_across + turn**2 / var_turn
    gap = np.maximum(known.beyond(along) - scan.half_length[:, None], 0.0)
    gain = np.log(2 * SETTINGS.wall_offset_range) - distance / 2 - np.log(var_across * var_turn) / 2
    gain = gain - gap / SETTINGS.extension_scale
    gain = np.where((distance < SETTINGS.gate) & (gap < SETTINGS.max_extension), gain, -np.inf)
    wall = gain.argmax(axis=-1)
    pick = (np.arange(len(poses))[:, None], np.arange(len(scan.theta)), wall)
    # New walls tend to be parallel or perpendicular to known ones; agreement in direction alone proves little.
    aligned = np.exp(-(wrap_angle(4 * turn) ** 2) / (32 * var_turn)) / np.sqrt(2 * np.pi * var_turn)
    new = _new_wall_log_odds(known)
    new = new + np.log1p(SETTINGS.right_angle_probability * (np.pi / 2 * aligned.max(axis=-1) - 1))
    best = gain[pick]
    wall = np.where(best > new, wall, -1)
    used = (wall >= 0) * scan.weight
    n = normal[pick[2]]
    jacobian = np.concatenate([n, (n * perpendicular(arm)).sum(-1, keepdims=True)], axis=-1)
    weight = used / var_across[pick]
    information = np.einsum("nl,nli,nlj->nij", weight, jacobian, jacobian)
    gradient = np.einsum("nl,nli->ni", weight * across[pick], jacobian)
    weight = used / np.broadcast_to(var_turn, gain.shape)[pick]
    information[:, 2, 2] += weight.sum(-1)
    gradient[:, 2] += (weight * turn[pick]).sum(-1)
    return _Term((scan.weight * np.maximum(best, new)).sum(-1), wall, gradient, information)


def _match_points(known: Features, scan: Features, poses: Float[np.ndarray, "poses 3"]) -> _Term:
    """The most likely point of the same kind for each point of the scan."""
    arm = rotate(scan.point, poses[:, 2, None])
    displacement = (poses[:, None, :2] + arm)[:, :, None] - known.point
    var = scan.point_sd[:, None] ** 2 + known.point_sd**2
    distance = (displacement**2).sum(-1) / var
    gain = np.log(SETTINGS.point_area) - distance / 2 - np.log(2 * np.pi * var)
    gain = np.where((distance < SETTINGS.gate) & (scan.is_corner[:, None] == known.is_corner), gain, -np.inf)
    point = gain.argmax(axis=-1)
    pick = (np.arange(len(poses))[:, None], np.arange(len(scan.point)), point)
    log_likelihood = SETTINGS.point_weight * np.maximum(gain[pick], 0.0).sum(-1)
    point = np.where(gain[pick] > 0, point, -1)
    weight = SETTINGS.point_weight * (point >= 0) / np.broadcast_to(var, gain.shape)[pick]
    jacobian = np.zeros((*weight.shape, 2, 3))
    jacobian[..., 0, 0] = jacobian[..., 1, 1] = 1.0
    jacobian[..., 2] = perpendicular(arm)
    information = np.einsum("np,npki,npkj->nij", weight, jacobian, jacobian)
    gradient = np.einsum("np,npk,npki->ni", weight, displacement[pick], jacobian)
    return _Term(log_likelihood, point, gradient, information)


def _new_wall_log_odds(known: Features) -> float:
    """Log-odds that an observed wall is not in the map, estimated from how often this was the case."""
    new = (len(known.theta) + 2) / (known.scans.sum() + 4)
    new = float(np.clip(new, *SETTINGS.new_wall_probability))
    return float(np.log(new / (1 - new)))
