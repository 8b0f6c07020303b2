"""Echoes that the walls, corners and edges of a map explain, reflections at two walls included."""

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.robust_statistics import robust_deviation
from jaxsonar.geometry.se2 import perpendicular, wrap_angle
from jaxsonar.geometry.segments import crossings, lengths, point_to_segments
from jaxsonar.reflectors.range_measurements import RangeMeasurements
from jaxsonar.reflectors.settings import SETTINGS
from jaxsonar.sensors.range_models import corner_range, edge_range


def wall_residuals(echoes: RangeMeasurements, walls: Float[np.ndarray, "walls 2 2"]) -> Float[np.ndarray, "rows walls"]:
    """Measured minus predicted range of each echo for each wall, metres; inf where a wall cannot have caused it.

    Args:
        echoes: the echoes.
        walls: both ends, metres.
    """
    settings = SETTINGS.explanation
    length = lengths(walls)
    tangent = (walls[:, 1] - walls[:, 0]) / np.maximum(length, 1e-9)[:, None]
    normal = perpendicular(tangent)
    offset = walls[:, 0] - echoes.origin[:, None]
    ahead, behind = (offset * normal).sum(-1), -(offset * tangent).sum(-1)
    across, along = echoes.half_baseline @ normal.T, echoes.half_baseline @ tangent.T
    predicted = np.hypot(ahead, along)
    safe = np.where(np.abs(ahead) < settings.min_distance, settings.min_distance, ahead)
    foot = behind + across * along / safe
    toward = np.arctan2(normal[:, 1], normal[:, 0]) + np.where(ahead < 0, np.pi, 0.0)
    angle = np.abs(wrap_angle(toward - echoes.axis[:, None]))
    possible = (foot > -settings.beyond) & (foot < length + settings.beyond)
    possible &= angle < echoes.half_width[:, None] + settings.view_margin
    return np.where(possible, echoes.distance[:, None] - predicted, np.inf)


def range_scatter(residual: Float[np.ndarray, "rows walls"]) -> float:
    """Standard deviation of the ranges about the walls of a map, metres; NaN without echoes near walls.

    Args:
        residual: as from ``wall_residuals``.
    """
    settings = SETTINGS.explanation
    nearest = np.abs(residual).min(axis=1, initial=np.inf)
    sigma = settings.sigma_gate
    for _ in range(4):
        near = nearest[nearest < settings.gate * sigma]
        if not len(near):
            return float("nan")
        sigma = max(robust_deviation(near, center=0.0), settings.min_sigma)
    return sigma


def explained_by_points(
    echoes: RangeMeasurements, points: Float[np.ndarray, "points 2"], sigma: float
) -> Bool[np.ndarray, " rows"]:
    """Which echoes a corner or an edge at one of the points explains; sigma in metres."""
    settings = SETTINGS.explanation
    if not len(points) or not len(echoes):
        return np.zeros(len(echoes), dtype=bool)
    origin, half = echoes.origin[:, None], echoes.half_baseline[:, None]
    away = points - origin
    angle = np.abs(wrap_angle(np.arctan2(away[..., 1], away[..., 0]) - echoes.axis[:, None]))
    possible = angle < echoes.half_width[:, None] + settings.view_margin
    possible &= np.hypot(away[..., 0], away[..., 1]) > settings.min_distance
    explained = np.zeros(possible.shape, dtype=bool)
    row, point = np.nonzero(possible)
    for model in (corner_range, edge_range):
        predicted = model(points[point], origin[row, 0], half[row, 0]).range
        explained[row, point] |= np.abs(echoes.distance[row] - predicted) < settings.gate * sigma
    return np.any(explained, axis=1)


def meeting_points(walls: Float[np.ndarray, "walls 2 2"]) -> Float[np.ndarray, "points 2"]:
    """Points where two walls meet, or would meet if they were somewhat longer, metres."""
    if len(walls) < 2:
        return np.zeros((0, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        share, _ = crossings(walls, walls)
    length = lengths(walls)
    beyond = np.maximum(np.abs(share - 0.5) - 0.5, 0) * length[:, None]
    meets = np.maximum(beyond, beyond.T) <= SETTINGS.explanation.corner_reach
    first, second = np.nonzero(np.triu(meets & np.isfinite(share), 1))
    return walls[first, 0] + share[first, second, None] * (walls[first, 1] - walls[first, 0])


def explained_by_two_walls(
    echoes: RangeMeasurements, walls: Float[np.ndarray, "walls 2 2"], sigma: float
) -> Bool[np.ndarray, " rows"]:
    """Which echoes two walls in turn explain, in either order; sigma in metres."""
    settings = SETTINGS.explanation
    explained = np.zeros(len(echoes), dtype=bool)
    if len(walls) < 2 or not len(echoes):
        return explained
    near = point_to_segments(echoes.origin, walls) < echoes.distance[:, None]
    start, end = echoes.origin - echoes.half_baseline, echoes.origin + echoes.half_baseline
    tangent = (walls[:, 1] - walls[:, 0]) / np.maximum(lengths(walls), 1e-9)[:, None]
    normal = perpendicular(tangent)
    for i in range(len(walls)):
        image = _mirrored(start, walls[i, 0], normal[i])
        for j in range(len(walls)):
            rows = np.flatnonzero(near[:, i] & near[:, j] & ~explained) if i != j else np.zeros(0, dtype=np.int64)
            if not len(rows):
                continue
            second = _mirrored(image[rows], walls[j, 0], normal[j])
            residual = echoes.distance[rows] - np.linalg.norm(second - end[rows], axis=-1) / 2
            fits = np.abs(residual) < settings.gate * sigma
            rows, second = rows[fits], second[fits]
            at, on_second = _crossed_at(end[rows], second, walls[j], tangent[j])
            _, on_first = _crossed_at(at, image[rows], walls[i], tangent[i])
            explained[rows[on_first & on_second]] = True
    return explained


def _mirrored(
    points: Float[np.ndarray, "rows 2"], on_line: Float[np.ndarray, "2"], normal: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "rows 2"]:
    return points - 2 * ((points - on_line) @ normal)[:, None] * normal


def _crossed_at(
    start: Float[np.ndarray, "rows 2"],
    end: Float[np.ndarray, "rows 2"],
    wall: Float[np.ndarray, "2 2"],
    tangent: Float[np.ndarray, "2"],
) -> tuple[Float[np.ndarray, "rows 2"], Bool[np.ndarray, " rows"]]:
    """Where the line of sight crosses a wall's line, and whether this is on the wall and between start and end."""
    normal = perpendicular(tangent)
    before, after = (start - wall[0]) @ normal, (end - wall[0]) @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        point = start + (before / (before - after))[:, None] * (end - start)
    along, beyond = (point - wall[0]) @ tangent, SETTINGS.explanation.beyond
    length = float((wall[1] - wall[0]) @ tangent)
    return point, (before * after < 0) & (along > -beyond) & (along < length + beyond)


def hidden_by_walls(
    origin: Float[np.ndarray, "rows 2"], target: Float[np.ndarray, "rows 2"], walls: Float[np.ndarray, "walls 2 2"]
) -> Bool[np.ndarray, " rows"]:
    """Which lines of sight cross a wall before their end.

    Args:
        origin: where they begin, metres.
        target: where they end.
        walls: both ends, metres.
    """
    if not len(walls) or not len(origin):
        return np.zeros(len(origin), dtype=bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        sight, wall = crossings(np.stack([origin, target], axis=1), walls)
    length = np.linalg.norm(target - origin, axis=1)[:, None]
    before = (1 - sight) * length > SETTINGS.decision.hidden
    return (before & (sight > 0) & (wall >= 0) & (wall <= 1)).any(axis=1)


def near_points(
    points: Float[np.ndarray, "points 2"], others: Float[np.ndarray, "others 2"], distance: float
) -> Int[np.ndarray, " near"]:
    """Rows of the points that are closer than a distance (metres) to one of the others."""
    if not len(others):
        return np.zeros(0, dtype=np.int64)
    apart = np.linalg.norm(points[:, None] - others, axis=-1)
    return np.flatnonzero((apart < distance).any(axis=1))
