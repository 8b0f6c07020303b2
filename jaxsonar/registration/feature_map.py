"""Maps of features: registered scans are fused by Kalman updates of matched walls and points."""

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.se2 import inverse, tangent_of, unit, wrap_angle
from jaxsonar.registration.features import Features
from jaxsonar.registration.settings import FEATURE_SETTINGS as SETTINGS


def map_as_scan(known: Features, world_from_robot: Float[np.ndarray, "3"]) -> Features:
    """A map as a single scan taken at a pose would observe it."""
    seen = known.transform(inverse(world_from_robot))
    half = known.half_length
    variance = known.covariance[:, [0, 1], [0, 1]] + np.square(SETTINGS.wall_sd_floor)
    return seen._replace(
        reference=seen.middle,
        offset=np.zeros(len(half)),
        covariance=variance[:, :, None] * np.eye(2),
        extent=np.stack([-half, half], axis=-1),
        weight=np.minimum(known.scans / 2, 1.0),
        point_sd=known.point_sd + SETTINGS.point_sd_floor,
    )


def fuse_scan(
    known: Features,
    scan: Features,
    world_from_robot: Float[np.ndarray, "3"],
    wall: Int[np.ndarray, " lines"],
    point: Int[np.ndarray, " points"],
) -> Features:
    """The map after a registered scan: matched features are refined, the others are appended.

    Args:
        known: the map.
        scan: features of the scan in the robot frame.
        world_from_robot: pose of the scan, metres and radians.
        wall: row of the matched wall of each wall of the scan; -1 if it is new.
        point: the same for points.
    """
    seen = scan.transform(world_from_robot)
    segments = seen.segment
    known = known._replace(**{name: getattr(known, name).copy() for name in Features._fields[1:10]})
    for row, match in enumerate(wall):
        if match >= 0:
            _update_wall(known, int(match), segments[row], float(seen.theta[row]), seen.covariance[row])
    for row, match in enumerate(point):
        if match >= 0:
            a, b = known.point_sd[match] ** -2, seen.point_sd[row] ** -2
            known.point[match] = (a * known.point[match] + b * seen.point[row]) / (a + b)
            known.point_sd[match] = (a + b) ** -0.5
    new = seen.take(wall < 0, point < 0)
    columns = [np.concatenate([old, more]) for old, more in zip(known[:10], new[:10], strict=True)]
    return Features(*columns)


def _update_wall(
    known: Features,
    wall: int,
    segment: Float[np.ndarray, "2 2"],
    theta: float,
    noise: Float[np.ndarray, "2 2"],
) -> None:
    """Kalman update of a wall, in place; the measurement is the offset at the segment's center and the direction."""
    from_reference = segment - known.reference[wall]
    middle = from_reference.mean(axis=0)
    along = float(middle @ tangent_of(known.theta[wall]))
    across = middle @ unit(known.theta[wall]) - known.offset[wall]
    innovation = np.array([across, wrap_angle(float(theta - known.theta[wall]))])
    design = np.array([[1.0, along], [0.0, 1.0]])
    cov = known.covariance[wall]
    gain = cov @ design.T @ np.linalg.inv(design @ cov @ design.T + noise)
    change = gain @ innovation
    known.offset[wall] += change[0]
    known.theta[wall] = wrap_angle(float(known.theta[wall] + change[1]))
    known.covariance[wall] = (np.eye(2) - gain @ design) @ cov
    reached = from_reference @ tangent_of(known.theta[wall])
    known.extent[wall] = min(known.extent[wall, 0], reached.min()), max(known.extent[wall, 1], reached.max())
    known.scans[wall] += 1
