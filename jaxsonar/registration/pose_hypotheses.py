"""Hypotheses for the pose of a scan in a map: every pose at which one or two features of the scan lie on the map's."""

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.se2 import rotate, wrap_angle
from jaxsonar.registration.features import Features
from jaxsonar.registration.settings import FEATURE_SETTINGS as SETTINGS


def pose_hypotheses(scan: Features, known: Features, expected: Float[np.ndarray, "3"]) -> Float[np.ndarray, "poses 3"]:
    """Poses map_from_robot that align features of a scan with features of a map.

    Args:
        scan: features of the scan in the robot frame.
        known: the map.
        expected: expected pose, metres and radians; it is the first hypothesis.

    Returns:
        The expected pose, one pose for every pair of walls (scan, map), and the poses that are determined by two
        walls, by a wall and a point, and by two points, in this order.
    """
    alike = np.nonzero(scan.is_corner[:, None] == known.is_corner)
    return np.concatenate(
        [
            expected[None],
            _one_wall(scan, known, expected[:2]),
            _two_walls(scan, known),
            _wall_and_point(scan, known, *alike),
            _two_points(scan, known, *alike),
        ]
    )


def thin_poses(poses: Float[np.ndarray, "poses 3"], cell: tuple[float, float]) -> Float[np.ndarray, "kept 3"]:
    """The first pose of every cell (metres, radians), in the given order."""
    number = np.round(np.concatenate([poses[:, :2] / cell[0], wrap_angle(poses[:, 2:]) / cell[1]], axis=-1))
    return poses[np.sort(np.unique(number, axis=0, return_index=True)[1])]


def poses_along_walls(scan: Features, known: Features, *, extent: float, step: float) -> Float[np.ndarray, "poses 3"]:
    """Poses that align one wall of the scan with one wall of the map, all along the latter.

    Args:
        scan: features of the scan in the robot frame.
        known: the map.
        extent: largest distance from the origin along the wall, metres.
        step: spacing of the poses, metres.
    """
    line, wall = _all_pairs(len(scan.theta), len(known.theta))
    heading = known.theta[wall] - scan.theta[line]
    across = _wall_distance(scan, known, line, wall, np.zeros(2), heading)
    along = np.arange(-extent, extent + step, step)
    at = (across[:, None] * known.normal[wall])[:, None] + along[:, None] * known.tangent[wall][:, None]
    return np.concatenate([at, np.broadcast_to(heading[:, None, None], (*at.shape[:2], 1))], axis=-1).reshape(-1, 3)


def _all_pairs(first: int, second: int) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """All pairs (i, j) with i < first and j < second."""
    a, b = np.indices((first, second))
    return a.ravel(), b.ravel()


def _one_wall(scan: Features, known: Features, expected: Float[np.ndarray, "2"]) -> Float[np.ndarray, "poses 3"]:
    """On one wall, as near as possible to the expected position."""
    line, wall = _all_pairs(len(scan.theta), len(known.theta))
    heading = known.theta[wall] - scan.theta[line]
    across = _wall_distance(scan, known, line, wall, expected, heading)
    return _poses(expected + across[:, None] * known.normal[wall], heading)


def _two_walls(scan: Features, known: Features) -> Float[np.ndarray, "poses 3"]:
    """On two walls that are not parallel."""
    i, j = np.nonzero(np.triu(np.abs(np.sin(scan.theta[:, None] - scan.theta)) > SETTINGS.crossing_sine))
    a, b = np.nonzero(np.abs(np.sin(known.theta[:, None] - known.theta)) > SETTINGS.crossing_sine / 2)
    pair, walls = _all_pairs(len(i), len(a))
    i, j, a, b = i[pair], j[pair], a[walls], b[walls]
    first, second = known.theta[a] - scan.theta[i], known.theta[b] - scan.theta[j]
    fits = np.abs(wrap_angle(second - first)) < SETTINGS.same_rotation
    i, j, a, b, first, second = (index[fits] for index in (i, j, a, b, first, second))
    heading = first + wrap_angle(second - first) / 2
    across = [_wall_distance(scan, known, line, wall, np.zeros(2), heading) for line, wall in ((i, a), (j, b))]
    normals = np.stack([known.normal[a], known.normal[b]], axis=1)
    return _poses(np.linalg.solve(normals, np.stack(across, axis=-1)[..., None])[..., 0], heading)


def _wall_and_point(
    scan: Features, known: Features, p: Int[np.ndarray, " alike"], q: Int[np.ndarray, " alike"]
) -> Float[np.ndarray, "poses 3"]:
    """Heading from a wall, position from a point, where the distance of the wall agrees."""
    line, wall = _all_pairs(len(scan.theta), len(known.theta))
    both, points = _all_pairs(len(line), len(p))
    line, wall, p, q = line[both], wall[both], p[points], q[points]
    heading = known.theta[wall] - scan.theta[line]
    at = known.point[q] - rotate(scan.point[p], heading)
    across = np.abs(_wall_distance(scan, known, line, wall, at, heading))
    return _poses(at, heading)[across < SETTINGS.position_tolerance]


def _two_points(
    scan: Features, known: Features, p: Int[np.ndarray, " alike"], q: Int[np.ndarray, " alike"]
) -> Float[np.ndarray, "poses 3"]:
    """On two points of the same kinds and the same distance."""
    first, second = _all_pairs(len(p), len(p))
    mine, theirs = scan.point[p[second]] - scan.point[p[first]], known.point[q[second]] - known.point[q[first]]
    length = np.linalg.norm(mine, axis=1)
    fits = (p[first] < p[second]) & (length > SETTINGS.min_point_distance)
    fits &= np.abs(length - np.linalg.norm(theirs, axis=1)) < SETTINGS.position_tolerance
    first, second, mine, theirs = first[fits], second[fits], mine[fits], theirs[fits]
    heading = np.arctan2(theirs[:, 1], theirs[:, 0]) - np.arctan2(mine[:, 1], mine[:, 0])
    center = (known.point[q[first]] + known.point[q[second]]) / 2
    return _poses(center - rotate((scan.point[p[first]] + scan.point[p[second]]) / 2, heading), heading)


def _wall_distance(
    scan: Features,
    known: Features,
    line: Int[np.ndarray, " poses"],
    wall: Int[np.ndarray, " poses"],
    position: Float[np.ndarray, "2"] | Float[np.ndarray, "poses 2"],
    heading: Float[np.ndarray, " poses"],
) -> Float[np.ndarray, " poses"]:
    """Distances from the centers of the scan's walls to walls of the map along the normals of the latter, metres."""
    middle = position + rotate(scan.middle[line], heading)
    return known.rho[wall] - (known.normal[wall] * middle).sum(-1)


def _poses(
    position: Float[np.ndarray, "poses 2"], heading: Float[np.ndarray, " poses"]
) -> Float[np.ndarray, "poses 3"]:
    return np.concatenate([position, wrap_angle(heading)[:, None]], axis=-1)
