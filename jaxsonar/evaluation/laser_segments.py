"""The polygonal model of the surroundings that one laser scan gives (paper, section 4, figure 2)."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.floor_plans.room import cross, crossings
from jaxsonar.geometry.se2 import to_world, unit
from jaxsonar.hardware.errors import SonarError

JOIN = 0.2
"""Metres; walls whose ends are nearer than this to the crossing of their lines meet there."""
_LEAST_INCIDENCE = np.radians(10.0)  # a wall seen under less than this falls apart into single returns
_NOISE = 0.03  # m; three sigma of common laser range finders
_LEAST_CORNER = np.radians(15.0)  # lines that differ by less cross at no sharp place


@dataclass(frozen=True, eq=False)
class PolygonalModel:
    """What one laser scan says about the surroundings: a chain of segments, in the order of the beams."""

    segments: Float[np.ndarray, "segments 2 2"]
    """Ends of what exists, metres; the free space is to the left of start -> end."""
    pseudo: Float[np.ndarray, "pseudo 2 2"] = field(default_factory=lambda: np.zeros((0, 2, 2)))
    """From the end of a segment to the start of the next one where they do not meet: the border of what was visible."""
    intersections: Float[np.ndarray, "intersections 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    """Where neighboring segments meet, metres."""

    def moved(self, pose: Float[np.ndarray, "3"]) -> "PolygonalModel":
        """The same model in the frame in which its own has this pose: x, y (metres), theta (radians)."""
        return PolygonalModel(
            to_world(pose, self.segments), to_world(pose, self.pseudo), to_world(pose, self.intersections)
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

    Returns in a row are split where they bend and merged where a line holds them (split and merge); each line is the
    total least squares fit. Where two neighbors meet, both end at the crossing of their lines; elsewhere a pseudo
    segment closes the gap. A scan all around has no seam.

    Args:
        bearing: directions of the beams, radians, ascending.
        ranges: metres; NaN where nothing came back.
        max_deviation: how far a return may be from its line, metres.
        min_points: returns that a segment needs.
        min_length: metres that a segment needs.

    Raises:
        SonarError: beams that do not ascend, or ranges below 0.
    """
    check_scan(bearing, ranges)
    heard = np.flatnonzero(~np.isnan(ranges))
    around = len(bearing) > 1 and bearing[-1] - bearing[0] + np.diff(bearing).max() > 2 * np.pi - 1e-6
    angle, reach = bearing[heard], ranges[heard]
    points = reach[:, None] * unit(angle)
    if around and len(points):
        # Start behind the widest gap, so that no wall is cut at the seam.
        first = (int(np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1).argmax()) + 1) % len(points)
        points, reach = np.roll(points, -first, axis=0), np.roll(reach, -first)
        angle = np.unwrap(np.roll(angle, -first))
    pieces = _pieces(points, angle, reach, max_deviation, min_points, min_length)
    segments = np.array([fitted(points[a:b]) for a, b in pieces]).reshape(-1, 2, 2)
    before = np.arange(len(segments) if around and len(segments) > 1 else max(len(segments) - 1, 0))
    after = (before + 1) % max(len(segments), 1)
    segments, meet, corners = joined(segments, before, after)
    pseudo = np.stack([segments[before, 1], segments[after, 0]], axis=1)[~meet]
    return PolygonalModel(segments, pseudo, corners[meet])


def fitted(points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "2 2"]:
    """The segment of least squared distances (total least squares), from the first to the last point's foot."""
    centre = points.mean(axis=0)
    tangent = np.linalg.svd(points - centre, full_matrices=False)[2][0]
    tangent = tangent if tangent @ (points[-1] - points[0]) >= 0 else -tangent
    share = (points - centre) @ tangent
    return centre + np.array([[share.min()], [share.max()]]) * tangent


def split(points: Float[np.ndarray, "points 2"], first: int, last: int, tolerance: float) -> list[tuple[int, int]]:
    """Split and merge: slices of points[first:last] that deviate from a line by no more than the tolerance, metres."""
    parts, open_ = [], [(first, last)]
    while open_:
        a, b = open_.pop()
        chord = points[b - 1] - points[a]
        away = np.abs(cross(chord, points[a:b] - points[a])) / max(float(np.hypot(*chord)), 1e-9)
        k = a + int(away.argmax())
        if away.max() <= tolerance or b - a < 3:
            parts.append((a, b))
        else:
            open_ += [(k, b), (a, k)]  # the left one comes next
    merged = parts[:1]
    for a, b in parts[1:]:
        if _deviation(points[merged[-1][0] : b]) <= tolerance:
            merged[-1] = (merged[-1][0], b)
        else:
            merged.append((a, b))
    return merged


def joined(
    segments: Float[np.ndarray, "segments 2 2"], before: Int[np.ndarray, " pairs"], after: Int[np.ndarray, " pairs"]
) -> tuple[Float[np.ndarray, "segments 2 2"], Bool[np.ndarray, " pairs"], Float[np.ndarray, "pairs 2"]]:
    """Segments, where the end of one (``before``) meets the start of another (``after``) brought to their crossing.

    Returns:
        segments: those that meet end at the crossing of their lines.
        meet: which pairs do.
        corner: where the lines of each pair cross, metres.
    """
    along = segments[:, 1] - segments[:, 0]
    share, _ = crossings(segments, segments)
    corner = segments[before, 0] + share[before, after, None] * along[before]
    sine = np.abs(cross(along[before], along[after])) / np.maximum(
        lengths(segments)[before] * lengths(segments)[after], 1e-12
    )
    from_end = np.linalg.norm(corner - segments[before, 1], axis=1)
    from_start = np.linalg.norm(corner - segments[after, 0], axis=1)
    meet = (sine > np.sin(_LEAST_CORNER)) & (from_end <= JOIN) & (from_start <= JOIN)
    segments = segments.copy()
    segments[before[meet], 1] = corner[meet]
    segments[after[meet], 0] = corner[meet]
    return segments, meet, corner


def check_scan(bearing: Float[np.ndarray, " beams"], ranges: Float[np.ndarray, "*scans beams"]) -> None:
    """Complain about what is no laser scan: bearings in radians that do not ascend, ranges that are no metres."""
    if not (np.isfinite(bearing).all() and (np.diff(bearing) > 0).all()):
        raise SonarError("laser: bearings that do not ascend came; allowed are finite radians, each above the last")
    if (ranges < 0).any() or np.isinf(ranges).any():
        raise SonarError("laser: a range below 0 or infinite came; allowed are metres, NaN = nothing came back")


def lengths(segments: Float[np.ndarray, "segments 2 2"]) -> Float[np.ndarray, " segments"]:
    """Metres."""
    return np.linalg.norm(segments[:, 1] - segments[:, 0], axis=-1)


def _pieces(
    points: Float[np.ndarray, "points 2"],
    angle: Float[np.ndarray, " points"],
    reach: Float[np.ndarray, " points"],
    max_deviation: float,
    min_points: int,
    min_length: float,
) -> list[tuple[int, int]]:
    """Slices of the returns that are straight segments, in their order."""
    turn = np.diff(angle)
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    # Returns of one wall are at most this far apart, down to the least angle of incidence (Borges and Aldon 2004).
    grazing = np.sin(np.maximum(_LEAST_INCIDENCE - turn, 1e-9))
    allowed = np.minimum(reach[1:], reach[:-1]) * np.sin(turn) / grazing + _NOISE
    jumps = np.flatnonzero((step > allowed) | (turn >= _LEAST_INCIDENCE)) + 1
    found = []
    for a, b in zip([0, *jumps.tolist()], [*jumps.tolist(), len(points)], strict=True):
        found += split(points, a, b, max_deviation) if b - a >= min_points else []
    long = [(a, b) for a, b in found if b - a >= min_points]
    return [(a, b) for a, b in long if lengths(fitted(points[a:b])[None])[0] >= min_length]


def _deviation(points: Float[np.ndarray, "points 2"]) -> float:
    """Largest distance from the line that fits, metres."""
    start, end = fitted(points)
    return float(np.abs(cross(end - start, points - start)).max() / max(float(np.hypot(*(end - start))), 1e-9))
