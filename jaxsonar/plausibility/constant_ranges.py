"""Whether a range can stay constant while the robot moves: whether a wall or a point may be the cause."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.se2 import transform_points, unit, wrap_angle
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class ConstantRangeSettings:
    """Constants of reflectors that are tried. Chosen by hand."""

    cone_factor: float = 1.2
    """The detection cones are taken this much wider, ..."""
    cone_margin: float = float(np.radians(5.0))
    """... and by this on either side, radians, because cones and headings are not exact."""
    directions: int = 17
    """Directions in the cone in which a reflector is tried."""
    resolution_quantile: float = 0.05
    """Quantile of the differences of neighboring values that is taken for the resolution of the readings."""


SETTINGS = ConstantRangeSettings()


def may_stay(
    ring: Ring,
    path: Int[np.ndarray, " pairs"],
    distance: Float[np.ndarray, " pairs"],
    before: Float[np.ndarray, "pairs 3"],
    after: Float[np.ndarray, "pairs 3"],
    margin: Float[np.ndarray, " pairs"] | float,
) -> Bool[np.ndarray, " pairs"]:
    """Whether a reflector may have the same range, up to the margin (metres), at two poses of the robot.

    Walls and points in all directions of the detection cone at the first pose are tried; the cone must contain them at
    the second pose, too. True where a pose is unknown.
    """
    geometry = ring.exact_paths
    half = SETTINGS.cone_factor * geometry.width[path] / 2 + SETTINGS.cone_margin
    center = geometry.start[path] + geometry.width[path] / 2
    midpoint = np.asarray(geometry.midpoint)[path]
    margin = np.broadcast_to(margin, distance.shape)[:, None]
    origin, to = transform_points(before, midpoint), transform_points(after, midpoint)
    angle = (before[:, 2] + center)[:, None] + half[:, None] * np.linspace(-1, 1, SETTINGS.directions)
    way, axis = to - origin, (after[:, 2] + center)[:, None]
    # Change of the range of a wall with this normal, and of a point in this direction.
    toward = unit(angle)
    wall = (way[:, None] * toward).sum(axis=-1)
    sight = distance[:, None, None] * toward - way[:, None]
    point = np.hypot(*np.moveaxis(sight, -1, 0)) - distance[:, None]
    direction = np.arctan2(sight[..., 1], sight[..., 0])
    stays = np.isnan(before).any(axis=1) | np.isnan(after).any(axis=1)
    for change, seen in ((wall, angle), (point, direction)):
        in_cone = np.abs(wrap_angle(seen - axis)) <= half[:, None]
        crosses = (change[:, 1:] * change[:, :-1] <= 0) & in_cone[:, 1:] & in_cone[:, :-1]
        stays |= crosses.any(axis=1) | (in_cone & (np.abs(change) <= margin)).any(axis=1)
    return stays


def range_resolution(reported: Float[np.ndarray, " readings"]) -> float:
    """Step between the values of readings, metres; too large for few readings."""
    steps = np.diff(np.unique(reported))
    steps = steps[steps > 1e-6 * reported.max(initial=0)]  # larger than the rounding of 32-bit floats
    return float(np.quantile(steps, SETTINGS.resolution_quantile)) if len(steps) else 0.0
