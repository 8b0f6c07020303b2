"""The polygonal model of a single laser scan (paper, section 4, figure 2)."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.evaluation.settings import SETTINGS
from jaxsonar.geometry.se2 import transform_points, unit
from jaxsonar.geometry.segments import cross, crossings, lengths
from jaxsonar.hardware.errors import SonarError


@dataclass(frozen=True, eq=False)
class PolygonalModel:
    """The surroundings according to one laser scan: a chain of segments in the order of the beams."""

    segments: Float[np.ndarray, "segments 2 2"]
    """Ends of the walls, metres; the free space is to the left of start -> end."""
    pseudo: Float[np.ndarray, "pseudo 2 2"] = field(default_factory=lambda: np.zeros((0, 2, 2)))
    """Segments that close the gaps between neighboring walls that do not meet: the border of what was visible."""
    intersections: Float[np.ndarray, "intersections 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    """Corners where neighboring walls meet, metres."""

    def transform(self, a_from_b: Float[np.ndarray, "3"]) -> "PolygonalModel":
        """The same model, given in frame b, in frame a: x, y (metres), theta (radians)."""
        return PolygonalModel(
            transform_points(a_from_b, self.segments),
            transform_points(a_from_b, self.pseudo),
            transform_points(a_from_b, self.intersections),
        )


def polygonal_model(
    bearing: Float[np.ndarray, " beams"],
    ranges: Float[np.ndarray, " beams"],
    *,
    max_deviation: float = 0.04,
    min_points: int = 6,
    min_length: float = 0.2,
) -> PolygonalModel:
    """The polygonal model of one laser scan, in the laser's frame (paper, section 4, figure 2).

    Consecutive returns are segmented by split and merge, and each line is a total least squares fit. Neighbors that
    meet end at the crossing of their lines; elsewhere a pseudo segment closes the gap. A scan over the full circle has
    no seam.

    Args:
        bearing: directions of the beams, radians, ascending.
        ranges: metres; NaN without a return.
        max_deviation: largest distance of a return from its line, metres.
        min_points: least number of returns of a segment.
        min_length: least length of a segment, metres.

    Raises:
        SonarError: bearings that do not ascend, or negative ranges.
    """
    check_laser_scan(bearing, ranges)
    # Returns in the laser's frame. A full circle starts behind the widest gap, so that no wall is cut at the seam.
    valid = np.flatnonzero(~np.isnan(ranges))
    full_circle = len(bearing) > 1 and bearing[-1] - bearing[0] + np.diff(bearing).max() > 2 * np.pi - 1e-6
    angle, distance = bearing[valid], ranges[valid]
    points = distance[:, None] * unit(angle)
    if full_circle and len(points):
        first = (int(np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1).argmax()) + 1) % len(points)
        points, distance = np.roll(points, -first, axis=0), np.roll(distance, -first)
        angle = np.unwrap(np.roll(angle, -first))
    # Straight segments.
    slices = _straight_slices(points, angle, distance, max_deviation, min_points, min_length)
    segments = np.array([fit_segment(points[a:b]) for a, b in slices]).reshape(-1, 2, 2)
    # Corners between neighbors, and pseudo segments where neighbors do not meet.
    before = np.arange(len(segments) if full_circle and len(segments) > 1 else max(len(segments) - 1, 0))
    after = (before + 1) % max(len(segments), 1)
    segments, meet, corners = join_at_corners(segments, before, after)
    pseudo = np.stack([segments[before, 1], segments[after, 0]], axis=1)[~meet]
    return PolygonalModel(segments, pseudo, corners[meet])


def fit_segment(points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "2 2"]:
    """The total least squares segment between the outermost projections, directed from the first to the last point."""
    center = points.mean(axis=0)
    tangent = np.linalg.svd(points - center, full_matrices=False)[2][0]
    tangent = tangent if tangent @ (points[-1] - points[0]) >= 0 else -tangent
    along = (points - center) @ tangent
    return center + np.array([[along.min()], [along.max()]]) * tangent


def split_and_merge(
    points: Float[np.ndarray, "points 2"], first: int, last: int, tolerance: float
) -> list[tuple[int, int]]:
    """Slices of points[first:last] that deviate from a line by at most the tolerance, metres (split and merge)."""
    slices, pending = [], [(first, last)]
    while pending:
        a, b = pending.pop()
        chord = points[b - 1] - points[a]
        deviation = np.abs(cross(chord, points[a:b] - points[a])) / max(float(np.hypot(*chord)), 1e-9)
        k = a + int(deviation.argmax())
        if deviation.max() <= tolerance or b - a < 3:
            slices.append((a, b))
        else:
            pending += [(k, b), (a, k)]  # the left part is next
    merged = slices[:1]
    for a, b in slices[1:]:
        if _largest_deviation(points[merged[-1][0] : b]) <= tolerance:
            merged[-1] = (merged[-1][0], b)
        else:
            merged.append((a, b))
    return merged


def join_at_corners(
    segments: Float[np.ndarray, "segments 2 2"], before: Int[np.ndarray, " pairs"], after: Int[np.ndarray, " pairs"]
) -> tuple[Float[np.ndarray, "segments 2 2"], Bool[np.ndarray, " pairs"], Float[np.ndarray, "pairs 2"]]:
    """Segments with meeting ends moved to the crossing of their lines.

    Args:
        segments: the segments.
        before: for each pair, the segment whose end may meet ...
        after: ... the start of this one.

    Returns:
        segments: with meeting ends at their corner.
        meet: which pairs meet.
        corner: where the lines of each pair cross, metres.
    """
    along = segments[:, 1] - segments[:, 0]
    fraction, _ = crossings(segments, segments)
    corner = segments[before, 0] + fraction[before, after, None] * along[before]
    sine = np.abs(cross(along[before], along[after])) / np.maximum(
        lengths(segments)[before] * lengths(segments)[after], 1e-12
    )
    from_end = np.linalg.norm(corner - segments[before, 1], axis=1)
    from_start = np.linalg.norm(corner - segments[after, 0], axis=1)
    gate = SETTINGS.laser.corner_gate
    meet = (sine > np.sin(SETTINGS.laser.min_corner_angle)) & (from_end <= gate) & (from_start <= gate)
    segments = segments.copy()
    segments[before[meet], 1] = corner[meet]
    segments[after[meet], 0] = corner[meet]
    return segments, meet, corner


def check_laser_scan(bearing: Float[np.ndarray, " beams"], ranges: Float[np.ndarray, "*scans beams"]) -> None:
    """Raise a SonarError unless bearings ascend and are finite (radians), and ranges are metres or NaN."""
    if not (np.isfinite(bearing).all() and (np.diff(bearing) > 0).all()):
        raise SonarError("laser: bearings that do not ascend came; allowed are finite radians, each above the last")
    if (ranges < 0).any() or np.isinf(ranges).any():
        raise SonarError("laser: a range below 0 or infinite came; allowed are metres, NaN = nothing came back")


def _straight_slices(
    points: Float[np.ndarray, "points 2"],
    angle: Float[np.ndarray, " points"],
    distance: Float[np.ndarray, " points"],
    max_deviation: float,
    min_points: int,
    min_length: float,
) -> list[tuple[int, int]]:
    """Slices of the returns that are straight segments, in their order."""
    settings = SETTINGS.laser
    turn = np.diff(angle)
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    # Largest distance between returns of one wall at the smallest angle of incidence (Borges and Aldon 2004).
    grazing = np.sin(np.maximum(settings.min_incidence - turn, 1e-9))
    allowed = np.minimum(distance[1:], distance[:-1]) * np.sin(turn) / grazing + settings.range_noise
    jumps = np.flatnonzero((step > allowed) | (turn >= settings.min_incidence)) + 1
    found = []
    for a, b in zip([0, *jumps.tolist()], [*jumps.tolist(), len(points)], strict=True):
        found += split_and_merge(points, a, b, max_deviation) if b - a >= min_points else []
    enough = [(a, b) for a, b in found if b - a >= min_points]
    return [(a, b) for a, b in enough if lengths(fit_segment(points[a:b])[None])[0] >= min_length]


def _largest_deviation(points: Float[np.ndarray, "points 2"]) -> float:
    """Largest distance of the points from their total least squares line, metres."""
    start, end = fit_segment(points)
    return float(np.abs(cross(end - start, points - start)).max() / max(float(np.hypot(*(end - start))), 1e-9))
