"""Planar line segments, (segments, 2, 2): two end points (x, y) each, metres."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.se2 import unit


def cross(u: Float[np.ndarray, "*#batch 2"], v: Float[np.ndarray, "*#batch 2"]) -> Float[np.ndarray, "..."]:
    """Cross product of planar vectors: positive where v is counter-clockwise from u."""
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def lengths(segments: Float[np.ndarray, "segments 2 2"]) -> Float[np.ndarray, " segments"]:
    """Length of every segment, metres."""
    return np.linalg.norm(segments[:, 1] - segments[:, 0], axis=-1)


def point_to_segments(
    points: Float[np.ndarray, "points 2"], segments: Float[np.ndarray, "segments 2 2"]
) -> Float[np.ndarray, "points segments"]:
    """Distance of every point from every segment, metres."""
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    offset = points[:, None] - start
    share = np.clip((offset * along).sum(-1) / (along**2).sum(-1), 0.0, 1.0)
    return np.linalg.norm(offset - share[..., None] * along, axis=-1)


def crossings(
    first: Float[np.ndarray, "a 2 2"], second: Float[np.ndarray, "b 2 2"]
) -> tuple[Float[np.ndarray, "a b"], Float[np.ndarray, "a b"]]:
    """Where the lines through each pair of segments cross.

    Returns:
        The position of the crossing on the first and on the second segment, as fractions of their lengths (0 at the
        start, 1 at the end; outside of [0, 1] beyond the ends); NaN for parallel lines.
    """
    u = (first[:, 1] - first[:, 0])[:, None]
    v = (second[:, 1] - second[:, 0])[None]
    offset = second[None, :, 0] - first[:, None, 0]
    determinant = cross(u, v)
    determinant = np.where(np.abs(determinant) > 1e-12, determinant, np.nan)
    return cross(offset, v) / determinant, cross(offset, u) / determinant


class PerpendicularIntersections(NamedTuple):
    """Where the lines of walls cross at about a right angle."""

    first: Int[np.ndarray, " pairs"]
    """Row of the first wall of each pair; the pairs are in lexicographic order."""
    second: Int[np.ndarray, " pairs"]
    """Row of the second wall, after the first one."""
    point: Float[np.ndarray, "pairs 2"]
    """Intersection of the two lines, metres."""
    gap: Float[np.ndarray, "pairs 2"]
    """Distance of the nearer end of each of the two walls from the intersection, metres."""


def perpendicular_intersections(
    theta: Float[np.ndarray, " walls"], segments: Float[np.ndarray, "walls 2 2"], *, max_skew: float
) -> PerpendicularIntersections:
    """Intersections of the lines of all pairs of walls that are about perpendicular.

    Args:
        theta: directions of the normals, radians.
        segments: the observed parts, metres.
        max_skew: largest deviation from a right angle, radians; below 90 degrees.
    """
    first, second = np.triu_indices(len(theta), k=1)
    is_perpendicular = np.abs(np.sin(theta[first] - theta[second])) > np.cos(max_skew)
    pair = np.stack([first[is_perpendicular], second[is_perpendicular]], axis=-1)
    normal = unit(theta[pair])
    offset = (normal * segments.mean(axis=1)[pair]).sum(-1)
    point = np.linalg.solve(normal, offset[..., None])[..., 0]
    gap = np.linalg.norm(segments[pair] - point[:, None, None], axis=-1).min(axis=-1)
    return PerpendicularIntersections(pair[:, 0], pair[:, 1], point, gap)


def sample_segments(
    segments: Float[np.ndarray, "segments 2 2"], samples: Int[np.ndarray, " segments"]
) -> tuple[Float[np.ndarray, "points 2"], Int[np.ndarray, " points"]]:
    """Equidistant points on segments, from start to end.

    Args:
        segments: the segments.
        samples: number of points of each segment, at least 2.

    Returns:
        The points, metres, and the row of the segment of each.
    """
    row = np.repeat(np.arange(len(segments)), samples)
    step = np.arange(len(row)) - np.repeat(np.cumsum(samples) - samples, samples)
    share = step / (samples[row] - 1)
    start, end = segments[row, 0], segments[row, 1]
    return start + share[:, None] * (end - start), row
