"""Candidate poses of one submap in the frame of another: every way to align reflectors that the prior allows."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsonar.geometry.se2 import subtract_poses
from jaxsonar.loop_closure.settings import SETTINGS
from jaxsonar.loop_closure.submap import Submap
from jaxsonar.registration.pose_hypotheses import pose_hypotheses, thin_poses
from jaxsonar.registration.pose_likelihood import pose_log_likelihood, refine_poses


class PosePrior(NamedTuple):
    """Normal distribution of the pose of the newest submap."""

    pose: Float[np.ndarray, "3"]
    """Mean, earlier_from_newest, metres and radians."""
    covariance: Float[np.ndarray, "3 3"]

    def offset(self, poses: Float[np.ndarray, "*poses 3"]) -> Float[np.ndarray, "*poses 3"]:
        """Differences of poses from the mean."""
        return subtract_poses(poses, self.pose)

    def distance(self, poses: Float[np.ndarray, "*poses 3"]) -> Float[np.ndarray, "*poses"]:
        """Squared Mahalanobis distance from the mean."""
        offset = self.offset(poses)
        return (offset @ np.linalg.inv(self.covariance) * offset).sum(-1)

    def log_density(
        self, poses: Float[np.ndarray, "poses 3"], basis: Float[np.ndarray, "3 rank"]
    ) -> Float[np.ndarray, " poses"]:
        """Log-density of the marginal in the directions of a basis."""
        cov = basis.T @ self.covariance @ basis
        offset = self.offset(poses) @ basis
        distance = (offset @ np.linalg.inv(cov) * offset).sum(-1)
        return -distance / 2 - np.linalg.slogdet(2 * np.pi * cov)[1] / 2


def pose_candidates(earlier: Submap, newest: Submap, prior: PosePrior) -> Float[np.ndarray, "poses 3"]:
    """Different poses earlier_from_newest within the prior at which reflectors agree, the most likely first."""
    known = earlier.features
    scan = newest.features.as_measurement((*SETTINGS.wall_sd_floor, SETTINGS.point_sd_floor))
    poses = pose_hypotheses(scan, known, prior.pose)
    poses = poses[prior.distance(poses) < SETTINGS.search_sd**2]
    poses = thin_poses(poses, SETTINGS.candidate_cell)[: SETTINGS.max_scored]
    score = pose_log_likelihood(known, scan, poses).log_likelihood - prior.distance(poses) / 2
    poses = poses[np.argsort(-score, kind="stable")[: 4 * SETTINGS.max_candidates]]
    information = np.linalg.inv(prior.covariance)
    poses = refine_poses(known, scan, poses, information, prior_mean=prior.pose, steps=SETTINGS.candidate_steps)
    score = pose_log_likelihood(known, scan, poses).log_likelihood - prior.distance(poses) / 2
    return thin_poses(poses[np.argsort(-score, kind="stable")], SETTINGS.candidate_cell)[: SETTINGS.max_candidates]
