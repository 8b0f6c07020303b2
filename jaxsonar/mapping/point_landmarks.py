"""Corners and edges in the world frame, with what is known of each, and the law by which sightings of one add up."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jaxsonar.detection.extract import LocalModel
from jaxsonar.geometry.se2 import to_world
from jaxsonar.mapping.observations import Sightings, latest_scans, unique_pairs
from jaxsonar.mapping.observations import join as join
from jaxsonar.mapping.segment_fusion import mutual

CELL = 0.05
"""Metres; sightings of one cell of the floor are kept as their sum."""
GATE = 3.0
"""Standard deviations by which sightings of one point may differ."""
FLOOR = 0.02
"""Metres; how well two sightings can agree at best: corners are not quite sharp, nor is odometry."""
FARTHEST = 0.3
"""Metres; sightings farther apart are of two points, however little is known of them."""
RESTLESS = 2.0
"""Mean square, in variances, by which the sightings of something that moves along with the robot differ."""
NEAREST = 0.1
"""Metres; nothing is nearer to the robot's centre."""
SURE = 1e-4
"""A single sighting leaves at least this probability to the other kind."""


@dataclass(frozen=True, eq=False)
class Points(Sightings):
    """Corners and edges, world frame, one row each; a corner is right-angled, thin poles are edges."""

    place: Float[np.ndarray, "points 2"]
    """Metres."""
    information: Float[np.ndarray, "points 2 2"]
    """Inverse covariance of ``place``, 1 / m^2: across the line of sight much less is known than along it."""
    evidence: Float[np.ndarray, " points"]
    """For a corner and against an edge: sum of log odds, nats."""
    cell: Int[np.ndarray, "points 2"]
    """Cell of the floor that it was first sighted in; of a sum, that of one of its members."""

    @property
    def cov(self) -> Float[np.ndarray, "points 2 2"]:
        """Covariance of ``place`` from ``information``, square metres."""
        return np.linalg.inv(self.information)

    @property
    def honest_cov(self) -> Float[np.ndarray, "points 2 2"]:
        """The same, scaled by how much the sightings differ; what is expected of one counts as one more of them."""
        cov = ((self.misfit + 2) / (2 * self.count))[:, None, None] * self.cov
        return (cov + cov.swapaxes(1, 2)) / 2

    @property
    def kinds(self) -> tuple[str, ...]:
        """Which kind has more evidence, "corner" or "edge"."""
        return tuple("corner" if e > 0 else "edge" for e in self.evidence.tolist())

    @property
    def times(self) -> Int[np.ndarray, " points"]:
        """In how many scans each was seen."""
        return np.bincount(self.scans[0], minlength=len(self))


def aggregate(models: Sequence[LocalModel], poses: Float[np.ndarray, "models 3"]) -> Points:
    """The corners and edges of local models in the world frame; models without a pose are left out.

    Args:
        models: local models, robot frame.
        poses: world_from_robot of each, x, y (m), theta (rad), NaN where there is none.
    """
    known = np.all(np.isfinite(poses), axis=1)
    found = [(k, point) for k, model in enumerate(models) if known[k] for point in model.points]
    model = np.array([k for k, _ in found], dtype=np.int64)
    place = np.array([to_world(poses[k], np.array([[p.x, p.y]]))[0] for k, p in found]).reshape(-1, 2)
    c, s = np.cos(poses[model, 2]), np.sin(poses[model, 2])
    turn = np.stack([c, -s, s, c], axis=-1).reshape(-1, 2, 2)
    cov = turn @ np.array([p.cov for _, p in found], dtype=np.float64).reshape(-1, 2, 2) @ turn.swapaxes(1, 2)
    # What is known is a piece of an arc around the robot: an error of its bearing is one of its range, too.
    sight = place - poses[model, :2]
    distance = np.maximum(np.linalg.norm(sight, axis=-1), NEAREST)
    ray = sight / distance[:, None]
    aside = np.stack([-ray[:, 1], ray[:, 0]], axis=-1)
    bend = np.einsum("pi,pij,pj->p", aside, cov, aside) / (2 * distance)
    cov += 3 * bend[:, None, None] ** 2 * ray[:, :, None] * ray[:, None, :]
    sure = np.clip([p.probability for _, p in found], SURE, 1 - SURE)
    when = np.array([m.scan if np.isnan(m.stamp) else m.stamp for m in models], dtype=np.float64)
    seen = np.array([(row, models[k].scan) for row, (k, _) in enumerate(found)], dtype=np.int64).reshape(-1, 2)
    return Points(
        place=place,
        information=np.linalg.inv(cov),
        evidence=np.log(sure / (1 - sure)) * np.array([1.0 if p.kind == "corner" else -1.0 for _, p in found]),
        misfit=np.zeros(len(found)),
        count=np.ones(len(found), dtype=np.int64),
        echoes=np.array([p.echoes for _, p in found], dtype=np.int64),
        latest=when[model],
        cell=np.floor(place / CELL).astype(np.int64),
        scans=unique_pairs(*seen.T),
    )


def add_up(points: Points, group: Int[np.ndarray, " points"]) -> Points:
    """Points that are one, one row a group: the mean weighed by information.

    The sum of sums is the sum of all, in any order, to rounding.

    Args:
        points: sightings.
        group: which of them are one, 0, 1, ...; none may be missing.
    """
    groups = int(group.max(initial=-1)) + 1
    if len(points) == groups:  # nothing to add, only an order to keep
        return points.take(np.argsort(group, kind="stable"))
    first = np.zeros(groups, dtype=np.int64)
    first[group[::-1]] = np.arange(len(group))[::-1]
    offset = points.place - points.place[first][group]  # from nearby, for the digits
    pull = np.einsum("pij,pj->pi", points.information, offset)
    information = np.zeros((groups, 2, 2))
    np.add.at(information, group, points.information)
    middle = np.zeros((groups, 2))
    np.add.at(middle, group, pull)
    middle = np.linalg.solve(information, middle[..., None])[..., 0]
    away = offset - middle[group]
    least = np.einsum("pi,pij,pj->p", away, points.information, away)

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(group, values, groups)

    latest = np.full(groups, -np.inf)
    np.maximum.at(latest, group, points.latest)
    cell = points.cell[np.lexsort((*points.cell.T, group))]
    return Points(
        place=points.place[first] + middle,
        information=information,
        evidence=total(points.evidence),
        misfit=total(points.misfit + least),
        count=np.rint(total(points.count)).astype(np.int64),
        echoes=np.rint(total(points.echoes)).astype(np.int64),
        latest=latest,
        cell=cell[np.searchsorted(np.sort(group), np.arange(groups))],
        scans=unique_pairs(group[points.scans[0]], points.scans[1]),
    )


def condense(points: Points, *, scans: int | None = None) -> Points:
    """Sightings of one cell as their sum; the order of the points does not matter.

    Args:
        points: sightings.
        scans: keep the numbers of at most so many scans of each, the largest ones; all if left out.
    """
    if not len(points):
        return points
    group = np.unique(points.cell, axis=0, return_inverse=True)[1].ravel()
    summed = add_up(points, group)
    return replace(summed, scans=latest_scans(summed.scans, scans))


def cluster(points: Points) -> tuple[Points, Int[np.ndarray, " points"]]:
    """Corners and edges from sightings: in rounds, those that are each other's likeliest match add up.

    Two match if they differ by at most ``GATE`` standard deviations, with a ``FLOOR``, and by ``FARTHEST``. The result
    does not depend on the order of the points, and clustering it again changes nothing.

    Returns:
        The points, and which of them each sighting belongs to.
    """
    point_of = np.arange(len(points))
    while len(points) > 1:
        pairs = KDTree(points.place).query_pairs(FARTHEST, output_type="ndarray").reshape(-1, 2)
        a, b = pairs.T
        cov = points.cov
        spread = cov[a] + cov[b] + FLOOR**2 * np.eye(2)
        squared = _squared(points.place[b] - points.place[a], spread)
        near = squared <= GATE**2
        if not near.any():
            break
        unlikely = squared[near] + np.log(np.linalg.det(spread[near]))
        group = mutual(pairs[near].astype(np.int64), unlikely, len(points))
        points, point_of = add_up(points, group), group[point_of]
    return points, point_of


def steady(
    points: Points, sightings: Points, point_of: Int[np.ndarray, " sightings"], *, floor: float
) -> Bool[np.ndarray, " points"]:
    """Which points stay where they are while the robot moves.

    Two walls that are not square mirror the robot, too, but the image moves along with it.

    Args:
        points: sums of the sightings.
        sightings: what they were seen as.
        point_of: which of the points each sighting belongs to.
        floor: how far off noise a sighting may be because poses are, metres.
    """
    offset = sightings.place - points.place[point_of]
    squared = _squared(offset, sightings.cov + floor**2 * np.eye(2)) + sightings.misfit
    freedom = 2 * np.maximum(points.count - 1, 1)
    return np.bincount(point_of, squared, len(points)) <= RESTLESS * freedom


def _squared(
    offset: Float[np.ndarray, "points 2"], cov: Float[np.ndarray, "points 2 2"]
) -> Float[np.ndarray, " points"]:
    """Squared offsets in standard deviations."""
    return (offset * np.linalg.solve(cov, offset[..., None])[..., 0]).sum(-1)
