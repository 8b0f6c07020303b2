"""Where one submap may lie on another: every way to lay walls on walls and points on points that the prior allows."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsonar import kernels
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.loop_closure.submap import Submap
from jaxsonar.loop_closure.submap_matching import blocks
from jaxsonar.registration.feature_map import Places, Seen
from jaxsonar.registration.pose_hypotheses import hypotheses, thinned
from jaxsonar.registration.pose_likelihood import explained

FLOOR = (0.03, np.radians(1.5), 0.04)
"""Added to the noise of walls (across, direction) and points while poses are rough: metres, radians, metres."""
CELL = (0.06, float(np.radians(2.0)))
"""Starts nearer to each other than this are one."""
SCORED, KEPT = 1500, 16
"""Starts that are scored and refined at most, and those that come out of it."""
SIGMAS = 4.0
"""So many standard deviations of the prior are searched."""


class Prior(NamedTuple):
    """Where the newest submap is expected: normal around a pose."""

    pose: Float[np.ndarray, "3"]
    """earlier_from_newest."""
    covariance: Float[np.ndarray, "3 3"]

    def offset(self, poses: Float[np.ndarray, "*poses 3"]) -> Float[np.ndarray, "*poses 3"]:
        """Of poses from the mean."""
        offset = poses - self.pose
        return np.concatenate([offset[..., :2], wrap_angle(offset[..., 2:])], axis=-1)

    def distance(self, poses: Float[np.ndarray, "*poses 3"]) -> Float[np.ndarray, "*poses"]:
        """Squared Mahalanobis distance from the mean."""
        offset = self.offset(poses)
        return (offset @ np.linalg.inv(self.covariance) * offset).sum(-1)


def starts(earlier: Submap, newest: Submap, prior: Prior) -> Float[np.ndarray, "poses 3"]:
    """Different poses earlier_from_newest within the prior that lay something on something, the likeliest first."""
    places, seen = _places(earlier), _seen(newest)
    poses = hypotheses(seen, places, prior.pose)
    poses = poses[prior.distance(poses) < SIGMAS**2]
    poses = thinned(poses, CELL)
    score = explained(places, seen, poses[:SCORED]).evidence - prior.distance(poses[:SCORED]) / 2
    poses = poses[np.argsort(-score, kind="stable")[: 4 * KEPT]]
    information = np.linalg.inv(prior.covariance)
    for _ in range(3):
        result = explained(places, seen, poses)
        gradient = result.gradient + prior.offset(poses) @ information
        poses = poses - np.linalg.solve(result.information + information, gradient[..., None])[..., 0]
    score = explained(places, seen, poses).evidence - prior.distance(poses) / 2
    return thinned(poses[np.argsort(-score, kind="stable")], CELL)[:KEPT]


def _seen(submap: Submap) -> Seen:
    """A submap as if seen at once."""
    row = submap.walls
    points = np.flatnonzero(submap.kind != kernels.PLANE)
    cov, segment = blocks(submap), submap.segments
    along = submap.ends[row].mean(axis=-1)
    across = cov[row, 0, 0] + 2 * along * cov[row, 0, 1] + along**2 * cov[row, 1, 1]
    return Seen(
        theta=submap.parameters[row, 1],
        segment=segment,
        sigma=np.sqrt(np.stack([across, cov[row, 1, 1]], axis=-1) + np.square(FLOOR[:2])),
        trust=np.ones(len(row)),
        point=submap.points,
        kind=submap.kind[points] == kernels.CORNER,
        spread=np.sqrt(np.trace(cov[points], axis1=1, axis2=2) / 2 + FLOOR[2] ** 2),
        heard=np.zeros((0, 2)),
    )


def _places(submap: Submap) -> Places:
    """A submap as a map."""
    row = submap.walls
    points = np.flatnonzero(submap.kind != kernels.PLANE)
    cov = blocks(submap)
    places = Places()
    places.reference, places.theta = submap.anchor[row], submap.parameters[row, 1]
    places.offset, places.extent = submap.parameters[row, 0], submap.ends[row]
    places.cov, places.sightings = cov[row], submap.scans[row].astype(np.float64)
    places.point, places.kind = submap.points, submap.kind[points] == kernels.CORNER
    places.spread = np.sqrt(np.trace(cov[points], axis1=1, axis2=2) / 2)
    return places
