"""Where a scan may lie in a map: what is expected of the motion, hypotheses from walls and points, and the only one."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.se2 import composed, relative, wrap_angle
from jaxsonar.registration.feature_map import NOT_PARALLEL, SAME_PLACE, Places, Seen, turned
from jaxsonar.registration.pose_likelihood import contradictions, explained

STEP, TURN = 0.5, np.radians(30.0)
"""Standard deviations of the motion between two scans without odometry, metres and radians; any turn may happen."""
FEW = 4.0
"""So many motions weigh as much as those two numbers; a steady robot is soon known as such."""
ANY_TURN = 0.05
"""Probability that a turn has nothing to do with TURN."""
ODOMETRY_FLOOR = (0.005, np.radians(0.5))
"""Standard deviation of odometry where the robot stands, metres and radians."""
SLIP = 0.01
"""Probability that odometry is wrong altogether."""
SAME_ANGLE = np.radians(7.0)
"""Radians by which two lines may turn the robot differently."""
KEPT = 64
"""Hypotheses that are refined."""
ELSEWHERE = (0.2, np.radians(10.0))
"""Metres and radians."""
SURE = (0.12, np.radians(5.0))
"""Largest standard deviation of a pose that counts as placed, metres and radians."""


class Prior(NamedTuple):
    """Where the robot may be, before its scan is looked at: normal around a pose."""

    pose: Float[np.ndarray, "3"]
    """world_from_robot."""
    sigma: tuple[float, float]
    """Standard deviations of the place (in x and in y) and of the heading, metres and radians."""
    any_turn: float
    """Probability that the heading is anything."""
    weight: float
    """Probability of this prior."""
    path: bool = False
    """The robot came straight from ``pose``, so that no wall is between."""

    def offset(self, poses: Float[np.ndarray, "poses 3"]) -> Float[np.ndarray, "poses 3"]:
        """Of poses from the mean, world frame."""
        return _poses(poses[:, :2] - self.pose[:2], poses[:, 2] - self.pose[2])

    def log_density(self, poses: Float[np.ndarray, "poses 3"]) -> Float[np.ndarray, " poses"]:
        """Nats."""
        offset = self.offset(poses)
        away = (offset[:, :2] ** 2).sum(-1) / self.sigma[0] ** 2
        turn = offset[:, 2] / self.sigma[1]
        near = (1 - self.any_turn) * np.exp(-(turn**2) / 2) / (np.sqrt(2 * np.pi) * self.sigma[1])
        heading = np.log(near + self.any_turn / (2 * np.pi) + 1e-30)
        return np.log(self.weight) - away / 2 - np.log(2 * np.pi * self.sigma[0] ** 2) + heading

    def information(self) -> Float[np.ndarray, "3 3"]:
        """Of a pose near the mean; where any turn is possible the heading is left to the scan."""
        heading = 1e-3 if self.any_turn else self.sigma[1] ** -2
        return np.diag([self.sigma[0] ** -2, self.sigma[0] ** -2, heading])


class Motion:
    """What is expected of the robot between scans: its odometry, and what robots usually do.

    Args:
        odometry: world_from_robot of every scan, drifting; NaN where there is none.
        slip: standard deviation of odometry as a share of the way and of the turn.
    """

    def __init__(self, odometry: Float[np.ndarray, "scans 3"], slip: float):
        self.odometry, self.slip = odometry, slip
        steps = np.linalg.norm(np.diff(odometry[:, :2], axis=0), axis=1)
        turns = np.abs(wrap_angle(np.diff(odometry[:, 2])))
        # Ways and turns up to each scan; NaN from the first gap in odometry on would lose the rest, so gaps count 0.
        self._way = np.concatenate([[0.0], np.cumsum(np.nan_to_num(steps))])
        self._turned = np.concatenate([[0.0], np.cumsum(np.nan_to_num(turns))])

    def known(self, scan: int | np.integer) -> bool:
        """Whether a scan has odometry."""
        return bool(np.isfinite(self.odometry[scan, 0]))

    def priors(
        self, poses: Float[np.ndarray, "scans 3"], anchors: Int[np.ndarray, " anchors"], scan: int
    ) -> list[Prior]:
        """Of a scan, from the placed scans before and after: by odometry, if both have it, and by what robots do."""
        nearest = anchors[np.argmin(np.abs(anchors - scan))]
        by_odometry = self.known(scan) and self.known(nearest)
        priors = [self._by_odometry(poses, nearest, scan)] if by_odometry else []
        # Between two placed scans: their mean by nearness, and as sure as both together.
        gaps = np.abs(anchors - scan).astype(float)
        weight = 1 / gaps**2
        middle = poses[nearest].copy()
        middle[:2] = (weight[:, None] * poses[anchors, :2]).sum(0) / weight.sum()
        middle[2] += float((weight * wrap_angle(poses[anchors, 2] - middle[2])).sum() / weight.sum())
        steps = float(np.sqrt(1 / weight.sum()))
        step, turn = _usual(poses)
        sigma = (step * steps**0.75, min(turn * steps**0.5, 2.0))
        alone = len(anchors) == 1 and bool(gaps[0] == 1)
        return [*priors, Prior(middle, sigma, ANY_TURN, SLIP if by_odometry else 1.0, path=alone)]

    def _by_odometry(self, poses: Float[np.ndarray, "scans 3"], anchor: int | np.integer, scan: int) -> Prior:
        heading = ODOMETRY_FLOOR[1] + self.slip * abs(self._turned[scan] - self._turned[anchor])
        place = ODOMETRY_FLOOR[0] + (self.slip + heading / 2) * abs(self._way[scan] - self._way[anchor])
        moved = relative(self.odometry[anchor], self.odometry[scan])
        return Prior(composed(poses[anchor], moved), (place, heading), 0.0, 1 - SLIP)


def _usual(poses: Float[np.ndarray, "scans 3"]) -> tuple[float, float]:
    """Standard deviations of motion between scans, learned from those in a row that are placed."""
    motion = relative(poses[:-1], poses[1:])
    motion = motion[np.isfinite(motion[:, 0])]
    place = (FEW * STEP**2 + (motion[:, :2] ** 2).sum() / 2) / (FEW + len(motion))
    turn = (FEW * TURN**2 + (motion[:, 2] ** 2).sum()) / (FEW + len(motion))
    return max(STEP / 2, float(np.sqrt(place))), max(TURN / 2, float(np.sqrt(turn)))


def only_pose(
    seen: Seen, places: Places, priors: list[Prior], *, reach: float, margin: float
) -> Float[np.ndarray, "3"] | None:
    """The one pose at which a scan agrees with a map, or None.

    Args:
        seen: what the scan saw.
        places: the map.
        priors: where the robot may be, the widest one last.
        reach: walls as near as this would be heard, metres; 0: silence says nothing.
        margin: nats by which the best hypothesis must beat any other one that is elsewhere.
    """
    widest = priors[-1]
    near = places.near(widest.pose[:2], 3 * widest.sigma[0] + 2 * seen.radius)
    refined = [_refined(seen, near, prior, reach) for prior in priors]
    poses, nats, information = (np.concatenate(part) for part in zip(*refined, strict=True))
    if not len(poses):
        return None
    best = int(nats.argmax())
    away = np.linalg.norm(poses[:, :2] - poses[best, :2], axis=1) > ELSEWHERE[0]
    away |= np.abs(wrap_angle(poses[:, 2] - poses[best, 2])) > ELSEWHERE[1]
    if nats[away].max(initial=-np.inf) > nats[best] - margin:
        return None
    spread = np.linalg.inv(information[best])
    if np.linalg.eigvalsh(spread[:2, :2])[-1] > SURE[0] ** 2 or spread[2, 2] > SURE[1] ** 2:
        return None
    return np.append(poses[best, :2], wrap_angle(float(poses[best, 2])))


def _refined(
    seen: Seen, places: Places, prior: Prior, reach: float
) -> tuple[Float[np.ndarray, "poses 3"], Float[np.ndarray, " poses"], Float[np.ndarray, "poses 3 3"]]:
    """The best hypotheses under a prior: poses, their evidence in nats, and their information."""
    poses = hypotheses(seen, places, prior.pose)
    poses = poses[np.linalg.norm(poses[:, :2] - prior.pose[:2], axis=1) < 3.5 * prior.sigma[0]]
    score = explained(places, seen, poses).evidence + prior.log_density(poses)
    poses = poses[np.argsort(-score, kind="stable")[:KEPT]]
    # Gauss and Newton, each pose by itself.
    for _ in range(4):
        result = explained(places, seen, poses)
        gradient = result.gradient
        if not prior.any_turn:  # odometry is a measurement; what robots usually do only damps the steps
            gradient = gradient + prior.offset(poses) @ prior.information()
        poses = poses - np.linalg.solve(result.information + prior.information(), gradient[..., None])[..., 0]
    result = explained(places, seen, poses)
    information = result.information + prior.information()
    room = 1.5 * np.log(2 * np.pi) - np.linalg.slogdet(information)[1] / 2
    came = prior.pose[:2] if prior.path else None
    against = contradictions(places, seen, poses, result.wall, reach=reach, came=came)
    return poses, result.evidence + prior.log_density(poses) + room - against, information


def thinned(poses: Float[np.ndarray, "poses 3"], cell: tuple[float, float]) -> Float[np.ndarray, "kept 3"]:
    """The first pose of each cell of so many metres and radians, in their order."""
    number = np.round(np.concatenate([poses[:, :2] / cell[0], wrap_angle(poses[:, 2:]) / cell[1]], axis=-1))
    return poses[np.sort(np.unique(number, axis=0, return_index=True)[1])]


def hypotheses(seen: Seen, places: Places, expected: Float[np.ndarray, "3"]) -> Float[np.ndarray, "poses 3"]:
    """Poses worth a look, the expected one included: two lines, a line and a point, two points, or one line."""
    alike = np.nonzero(seen.kind[:, None] == places.kind)
    return np.concatenate(
        [
            expected[None],
            _one_line(seen, places, expected[:2]),
            _two_lines(seen, places),
            _line_and_point(seen, places, *alike),
            _two_points(seen, places, *alike),
        ]
    )


def _one_line(seen: Seen, places: Places, expected: Float[np.ndarray, "2"]) -> Float[np.ndarray, "poses 3"]:
    """On one wall, as near as possible to where the robot is expected."""
    line, wall = _every(len(seen.theta), len(places.theta))
    heading = places.theta[wall] - seen.theta[line]
    short = _short(seen, places, line, wall, expected, heading)
    return _poses(expected + short[:, None] * places.normal[wall], heading)


def _two_lines(seen: Seen, places: Places) -> Float[np.ndarray, "poses 3"]:
    """On two walls that cross."""
    i, j = np.nonzero(np.triu(np.abs(np.sin(seen.theta[:, None] - seen.theta)) > NOT_PARALLEL))
    a, b = np.nonzero(np.abs(np.sin(places.theta[:, None] - places.theta)) > NOT_PARALLEL / 2)
    pair, walls = _every(len(i), len(a))
    i, j, a, b = i[pair], j[pair], a[walls], b[walls]
    first, second = places.theta[a] - seen.theta[i], places.theta[b] - seen.theta[j]
    fits = np.abs(wrap_angle(second - first)) < SAME_ANGLE
    i, j, a, b, first, second = (index[fits] for index in (i, j, a, b, first, second))
    heading = first + wrap_angle(second - first) / 2
    rest = [_short(seen, places, line, wall, np.zeros(2), heading) for line, wall in ((i, a), (j, b))]
    across = np.stack([places.normal[a], places.normal[b]], axis=1)
    return _poses(np.linalg.solve(across, np.stack(rest, axis=-1)[..., None])[..., 0], heading)


def _line_and_point(
    seen: Seen, places: Places, p: Int[np.ndarray, " alike"], q: Int[np.ndarray, " alike"]
) -> Float[np.ndarray, "poses 3"]:
    """The heading of a line on a wall, the place of a point on another one of its kind, if that suits the line."""
    line, wall = _every(len(seen.theta), len(places.theta))
    both, points = _every(len(line), len(p))
    line, wall, p, q = line[both], wall[both], p[points], q[points]
    heading = places.theta[wall] - seen.theta[line]
    at = places.point[q] - turned(seen.point[p], heading)
    return _poses(at, heading)[np.abs(_short(seen, places, line, wall, at, heading)) < SAME_PLACE]


def _two_points(
    seen: Seen, places: Places, p: Int[np.ndarray, " alike"], q: Int[np.ndarray, " alike"]
) -> Float[np.ndarray, "poses 3"]:
    """On two others of their kinds, as far apart."""
    first, second = _every(len(p), len(p))
    mine, known = seen.point[p[second]] - seen.point[p[first]], places.point[q[second]] - places.point[q[first]]
    length = np.linalg.norm(mine, axis=1)
    fits = (p[first] < p[second]) & (length > 0.3)
    fits &= np.abs(length - np.linalg.norm(known, axis=1)) < SAME_PLACE
    first, second, mine, known = first[fits], second[fits], mine[fits], known[fits]
    heading = np.arctan2(known[:, 1], known[:, 0]) - np.arctan2(mine[:, 1], mine[:, 0])
    centre = (places.point[q[first]] + places.point[q[second]]) / 2
    return _poses(centre - turned((seen.point[p[first]] + seen.point[p[second]]) / 2, heading), heading)


def _short(
    seen: Seen,
    places: Places,
    line: Int[np.ndarray, " poses"],
    wall: Int[np.ndarray, " poses"],
    at: Float[np.ndarray, "2"] | Float[np.ndarray, "poses 2"],
    heading: Float[np.ndarray, " poses"],
) -> Float[np.ndarray, " poses"]:
    """How far the middle of a line is from its wall, along the wall's normal, with the robot there."""
    middle = at + turned(seen.middle[line], heading)
    return places.level[wall] - (places.normal[wall] * middle).sum(-1)


def _every(first: int, second: int) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """All pairs of numbers below these."""
    a, b = np.indices((first, second))
    return a.ravel(), b.ravel()


def _poses(at: Float[np.ndarray, "poses 2"], heading: Float[np.ndarray, " poses"]) -> Float[np.ndarray, "poses 3"]:
    return np.concatenate([at, wrap_angle(heading)[:, None]], axis=-1)
