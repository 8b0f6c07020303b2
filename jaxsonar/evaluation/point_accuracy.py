"""Accuracy of the circles and points of a map: matched columns and poles, those that are walls, and false ones."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.evaluation.settings import SETTINGS
from jaxsonar.geometry.segments import lengths, point_to_segments

KIND_OF_REFERENCE = {"pole": "edge", "circle": "circle"}
"""Kind in a map of each kind of reference: a thin pole answers as an edge."""


@dataclass(frozen=True, eq=False)
class PointEvaluation:
    """The points of a map compared with the poles and circles of a reference."""

    reference_kinds: tuple[str, ...]
    """Kind of each reference, "pole" or "circle"."""
    match: Int[np.ndarray, " references"]
    """Row of the point of the map at each reference; -1 for none."""
    match_kinds: tuple[str, ...]
    """Kind of that point in the map, "" for none."""
    position_error: Float[np.ndarray, " references"]
    """Distance of that point from the reference, metres: between the centers, or from the surface for points that have
    no radius; NaN for none."""
    radius_error: Float[np.ndarray, " references"]
    """Radius in the map minus that of the reference, metres; NaN unless both are circles."""
    as_wall: Bool[np.ndarray, " references"]
    """Whether a wall of the map stands at the reference instead."""
    false: Int[np.ndarray, " false"]
    """Rows of the map's points that are neither at a reference nor on one of its walls."""

    @property
    def missing(self) -> Bool[np.ndarray, " references"]:
        """References at which the map has nothing."""
        return (self.match < 0) & ~self.as_wall

    @property
    def right_kind(self) -> Bool[np.ndarray, " references"]:
        """References at which the map has a point of the right kind."""
        pairs = zip(self.reference_kinds, self.match_kinds, strict=True)
        return np.array([KIND_OF_REFERENCE[there] == here for there, here in pairs], dtype=bool)

    @property
    def recall(self) -> float:
        """Fraction of the references at which the map has a point; NaN without references."""
        return float((self.match >= 0).mean()) if len(self.match) else math.nan

    def as_json(self) -> dict[str, Any]:
        """Plain numbers for a JSON file, SI units; null for NaN."""
        known = [None if math.isnan(self.recall) else self.recall]
        columns = (self.match, self.position_error, self.radius_error, self.as_wall)
        rows = zip(self.reference_kinds, self.match_kinds, *(column.tolist() for column in columns), strict=True)
        return {
            "references": len(self.match),
            "matched": int((self.match >= 0).sum()),
            "right_kind": int(self.right_kind.sum()),
            "as_wall": int(self.as_wall.sum()),
            "missing": int(self.missing.sum()),
            "false": self.false.tolist(),
            "recall": known[0],
            "reference_points": [
                {
                    "kind": kind,
                    "point": None if row < 0 else row,
                    "point_kind": found or None,
                    "position_error_m": None if math.isnan(position) else position,
                    "radius_error_m": None if math.isnan(radius) else radius,
                    "as_wall": wall,
                }
                for kind, found, row, position, radius, wall in rows
            ],
        }


def evaluate_points(
    points: Float[np.ndarray, "points 2"],
    kinds: tuple[str, ...],
    radii: Float[np.ndarray, " points"],
    segments: Float[np.ndarray, "segments 2 2"],
    reference: Float[np.ndarray, "references 2"],
    reference_kinds: tuple[str, ...],
    reference_radii: Float[np.ndarray, " references"],
    reference_walls: Float[np.ndarray, "walls 2 2"],
    *,
    gate: float = SETTINGS.maps.gate_distance,
) -> PointEvaluation:
    """Compare the points of a map with the poles and circles of a reference, both in one frame, metres.

    A point is at a reference if its distance from the surface is below the gate. For circles, the distance between the
    centers counts, and may be larger by the radius of the reference. Nearest pairs are matched first.

    Args:
        points: positions of the map's points; centers of circles.
        kinds: their kinds.
        radii: their radii; NaN unless they are circles.
        segments: ends of the map's walls.
        reference: centers of poles and circles.
        reference_kinds: "pole" or "circle".
        reference_radii: their radii, 0 for poles.
        reference_walls: ends of the reference's walls.
        gate: largest distance of a match, metres.
    """
    between = np.linalg.norm(points[:, None] - reference, axis=-1)
    surface = np.abs(between - reference_radii)
    is_circle = np.isfinite(radii)[:, None]
    distance = np.where(is_circle, between, surface)
    match = np.full(len(reference), -1)
    used = np.zeros(len(points), dtype=bool)
    for flat in np.argsort(distance, axis=None, kind="stable").tolist():
        point, there = divmod(flat, max(len(reference), 1))
        if distance[point, there] > gate + (reference_radii[there] if is_circle[point, 0] else 0.0):
            continue
        if match[there] < 0 and not used[point]:
            match[there], used[point] = point, True
    found = match >= 0
    position_error = np.full(len(reference), np.nan)
    position_error[found] = distance[match[found], np.flatnonzero(found)]
    radius_error = np.full(len(reference), np.nan)
    radius_error[found] = radii[match[found]] - reference_radii[found]
    # Walls of the map at a reference, of which most lies nearer to it than to any wall of the reference.
    ends = np.linspace(0.0, 1.0, SETTINGS.maps.wall_samples)
    samples = segments[:, None, 0] + ends[:, None] * (segments[:, None, 1] - segments[:, None, 0])
    flat_samples = samples.reshape(-1, 2)
    shape = (len(segments), len(ends))
    walls = reference_walls[lengths(reference_walls) > 0]
    to_wall = point_to_segments(flat_samples, walls).min(axis=1, initial=np.inf).reshape(shape)
    to_surface = np.linalg.norm(samples[:, :, None] - reference, axis=-1) - reference_radii
    at = (to_surface <= gate) & (np.abs(to_surface) < to_wall[..., None])
    as_wall = (at.mean(axis=1) >= 0.5).any(axis=0)
    # False points.
    near_wall = point_to_segments(points, walls).min(axis=1, initial=np.inf) <= gate
    circle = np.array([kind == "circle" for kind in kinds], dtype=bool)
    at_reference = (surface.min(axis=1, initial=np.inf) <= gate) & ~circle
    false = np.flatnonzero(~used & ~at_reference & (circle | ~near_wall))
    match_kinds = tuple(kinds[row] if row >= 0 else "" for row in match.tolist())
    return PointEvaluation(reference_kinds, match, match_kinds, position_error, radius_error, as_wall, false)
