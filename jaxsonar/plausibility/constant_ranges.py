"""Evidence of constant ranges: whether a wall or a point can be the cause while the robot moves, or only the robot."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.se2 import transform_points, unit, wrap_angle
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class ConstantRangeSettings:
    """Constants of reflectors that are tried, and of the evidence that the robot is the cause.

    Chosen by hand on simulated rooms and rings.
    """

    cone_factor: float = 1.2
    """The detection cones are taken this much wider, ..."""
    cone_margin: float = float(np.radians(5.0))
    """... and by this on either side, radians, because cones and headings are not exact."""
    directions: int = 17
    """Directions in the cone in which a reflector is tried."""
    resolution_quantile: float = 0.05
    """Quantile of the differences of neighboring values that is taken for the resolution of the readings."""
    min_change: float = 0.03
    """Change of the range of a wall from which on it must show, metres, ..."""
    drift: float = 0.03
    """... and its growth with the distance that the robot has driven between two poses, because odometry drifts. With
    0 to 0.01, a robot that drives three times along the walls of a room seems to hear itself."""
    places: int = 6
    """Number of poses, none of which shares a possible wall or point with another, at which the echo must be. A robot
    that drives along the walls of a room at a fixed distance reaches fewer."""
    places_if_contradicted: int = 3
    """Number of these poses if other sensors that look in the same directions contradict a wall."""
    places_per_metre: float = 0.15
    """For each metre that the robot drove between them, there must be this many more: the errors of odometry in the
    headings add up, too."""
    enough: int = 18
    """The search ends after this many."""
    returned: float = 0.6
    """After the robot has left all walls and points that may have caused the echo, at least this share of the next
    measurements has the echo, ..."""
    returned_relative: float = 0.8
    """... and, unless other sensors contradict a wall, at least this multiple of the share of all measurements. Along
    walls at equal distances, the share of all measurements is larger."""
    extent: float = 0.25
    """Extent of these poses, at least, metres. A robot that only turns may be in the middle of a regular room."""
    same_view: float = 0.2
    """Two scans show one view if at least this share of the paths that heard something in both has about the same
    range, ..."""
    same_range: float = 0.05
    """... up to this difference, metres."""
    common_paths: int = 3
    """Scans with fewer common paths count as one view."""
    covered: float = 0.95
    """Share of the detection range of a path that other sensors must cover to contradict a wall."""


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


def independent_places(
    ring: Ring,
    path: int,
    distance: float,
    half_width: float,
    pose: Float[np.ndarray, "measurements 3"],
    has_echo: Bool[np.ndarray, " measurements"],
    *,
    contradicted: bool = False,
) -> int:
    """Number of poses at which an echo cannot have come from a common wall or point; 0 if they prove nothing.

    Args:
        ring: the sensors.
        path: row of ``Ring.paths``.
        distance: the constant range, metres.
        half_width: tolerance of the range, metres.
        pose: world_from_robot of the measurements of the path.
        has_echo: whether each measurement has the echo.
        contradicted: whether other sensors contradict a wall (``is_contradicted``); fewer poses are enough then.
    """
    margin = max(SETTINGS.min_change, half_width)
    places, lost = _poses_apart(ring, path, distance, margin, pose, has_echo)
    if not len(places):
        return 0
    driven = np.append(0.0, np.cumsum(np.hypot(*np.diff(pose[:, :2], axis=0).T)))
    extent = float(np.hypot(*np.ptp(pose[places, :2], axis=0)))
    least = SETTINGS.places + SETTINGS.places_per_metre * (driven[places[-1]] - driven[places[0]])
    least = SETTINGS.places_if_contradicted if contradicted else min(least, SETTINGS.enough)
    if extent < SETTINGS.extent or len(places) < least:
        return 0
    # A few losses may be chance: the same trajectory from its end and from its middle gives more comparisons.
    found, half = len(places), len(pose) // 2
    for order in (np.arange(len(pose))[::-1], np.roll(np.arange(len(pose)), half)):
        again, lost_again = _poses_apart(ring, path, distance, margin, pose[order], has_echo[order])
        found, lost = found + len(again), lost + lost_again
    return len(places) if _is_found_again(found, lost, 0.0 if contradicted else float(has_echo.mean())) else 0


def _poses_apart(
    ring: Ring,
    path: int,
    distance: float,
    margin: float,
    pose: Float[np.ndarray, "measurements 3"],
    has_echo: Bool[np.ndarray, " measurements"],
) -> tuple[Int[np.ndarray, " places"], int]:
    """Poses with the echo, none of which shares a wall or point with one before, and how many such poses lack it."""
    driven = np.append(0.0, np.cumsum(np.hypot(*np.diff(pose[:, :2], axis=0).T)))
    explained, places, lost, k = np.zeros(len(pose), bool), [], 0, 0
    while len(places) < SETTINGS.enough and len(fresh := np.flatnonzero(~explained[k:])):
        k += int(fresh[0])
        if not has_echo[k]:
            lost += 1
            k += 1
            continue
        places.append(k)
        change = margin + SETTINGS.drift * (driven[k:] - driven[k])
        here, same = np.broadcast_to(pose[k], pose[k:].shape), np.ones(len(change))
        explained[k:] |= may_stay(ring, np.full(len(same), path), distance * same, here, pose[k:], change)
        explained[k] = True
    return np.array(places, np.int64), lost


def distinct_views(
    first_echo: Float[np.ndarray, "scans paths"],
    tells: Bool[np.ndarray, " scans"],
    has_echo: Bool[np.ndarray, " scans"],
) -> int:
    """Number of scans with an echo whose other echoes differ from one another; 0 if they prove nothing.

    Without poses, only the other echoes tell that the robot moves.

    Args:
        first_echo: range of the first echo that is not constant, metres; NaN if there is none.
        tells: the scans that measured the path and did not only hear something nearer.
        has_echo: the scans with the echo.
    """
    explained, views, lost, k = ~tells, 0, 0, 0
    while views < SETTINGS.enough and len(fresh := np.flatnonzero(~explained[k:])):
        k += int(fresh[0])
        difference = np.abs(first_echo[k:] - first_echo[k])
        common = np.isfinite(difference).sum(axis=1)
        if common[0] < SETTINGS.common_paths:  # this scan shows too little
            k += 1
            continue
        if not has_echo[k]:
            lost += 1
            k += 1
            continue
        views += 1
        same = (difference <= SETTINGS.same_range).sum(axis=1)
        explained[k:] |= (common < SETTINGS.common_paths) | (same >= SETTINGS.same_view * common)
    return views if views >= SETTINGS.places and _is_found_again(views, lost, float(has_echo[tells].mean())) else 0


def is_contradicted(
    ring: Ring, path: int, constant: Bool[np.ndarray, " paths"], looking: Bool[np.ndarray, " paths"]
) -> bool:
    """Whether other sensors look in all directions of a path, and none of them has a constant range.

    A wall beside a robot that drives along it has a constant range in all paths that hear it.

    Args:
        ring: the sensors.
        path: row of ``Ring.paths``.
        constant: paths that may have a constant range.
        looking: paths that were measured and usually heard nothing nearer.
    """
    geometry = ring.exact_paths
    others = ~np.isin(ring.paths, ring.paths[path]).any(axis=1) & looking & (geometry.width > 0)
    fraction = (np.arange(2 * SETTINGS.directions) + 0.5) / (2 * SETTINGS.directions)
    angle = geometry.start[path] + geometry.width[path] * fraction
    seen = np.mod(angle - geometry.start[others][:, None], 2 * np.pi) < geometry.width[others][:, None]
    seen_by_constant = seen[constant[others]].any()
    return bool(geometry.width[path] > 0 and seen.any(axis=0).mean() >= SETTINGS.covered and not seen_by_constant)


def _is_found_again(found: int, lost: int, share: float) -> bool:
    """Whether an echo was found again often enough, compared with its share of all measurements."""
    return found >= max(SETTINGS.returned, SETTINGS.returned_relative * share) * (found + lost)
