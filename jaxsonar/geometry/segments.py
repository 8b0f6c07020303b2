"""Planar line segments, (segments, 2, 2): two end points (x, y) each, metres."""

import numpy as np
from jaxtyping import Float, Int


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
