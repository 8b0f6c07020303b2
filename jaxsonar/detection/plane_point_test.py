"""Test of plane against point for the candidate lines of a window of scans.

With few sensors, a post or a corner reflects into every pose of the window. Its arcs then intersect in one point, and
the Hough transform reports the common tangent as a line. Fits of both models to the ranges decide which one it is.
"""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.detection.arc_tables import arc_tables
from jaxsonar.detection.hough_detector import HoughBatch, LineCandidate
from jaxsonar.detection.settings import SETTINGS
from jaxsonar.kernels.shape_buckets import bucket_size
from jaxsonar.sensors.ring import Ring


def confirmed_walls(
    ring: Ring, detections: HoughBatch, settings: kernels.HoughSettings, *, gap: float, tolerance: float
) -> list[list[LineCandidate]]:
    """The walls of each window of a batch.

    Candidates are accepted in the order of the plane model's score. Each echo is assigned to at most one wall.

    Args:
        ring: the sensors.
        detections: the candidates.
        settings: settings of the Hough step that found them.
        tolerance: largest range residual of an echo that a reflector explains, metres.
        gap: a wall without echoes over more than this length is split into two, metres.
    """
    batch, lines = detections.batch, detections.lines
    rows, columns = lines.rho.shape
    # Fit a plane and a point to the ranges near each candidate line.
    candidates = np.full((2, len(batch.path), bucket_size(columns, least=16)), np.nan, np.float32)
    candidates[:, :rows, :columns] = lines.rho, lines.theta
    rho, theta = (jnp.asarray(values) for values in candidates)
    arcs = arc_tables(ring, settings).arcs
    fits = kernels.fit_candidates(arcs, batch.packed, rho, theta, tolerance=tolerance)
    plane, point = np.asarray(fits.plane_score), np.asarray(fits.point_score)
    rho, theta, foot = (np.asarray(values) for values in (fits.rho, fits.theta, fits.footpoint))
    # Keep the candidates that the plane model explains clearly better; scores are NaN where there is no candidate.
    is_plane = plane > SETTINGS.plane_to_point_ratio * point
    explained = np.asarray(fits.explained) & is_plane[..., None]
    # Greedy assignment of the echoes, best plane first; one wall per part without a gap.
    walls: list[list[LineCandidate]] = [[] for _ in range(rows)]
    unassigned = np.ones((rows, explained.shape[2]), dtype=bool)
    for row in range(rows):
        for k in np.argsort(-plane[row, :columns], kind="stable"):
            for echoes in _contiguous_parts(explained[row, k] & unassigned[row], foot[row, k], gap):
                unassigned[row, echoes] = False
                line = float(rho[row, k]), float(theta[row, k])
                segment = _segment(*line, foot[row, k, echoes[[0, -1]]])
                walls[row].append(LineCandidate(*line, segment, int(lines.votes[row, k]), np.sort(echoes)))
    return walls


def _contiguous_parts(
    selected: Bool[np.ndarray, " echoes"], foot: Float[np.ndarray, " echoes"], gap: float
) -> Iterator[Int[np.ndarray, " part"]]:
    """Echoes of each part of a wall without a gap, ordered along the wall; parts that are too small are dropped."""
    echoes = np.flatnonzero(selected)
    echoes = echoes[np.argsort(foot[echoes], kind="stable")]
    for part in np.split(echoes, np.flatnonzero(np.diff(foot[echoes]) > gap) + 1):
        long_enough = len(part) and foot[part[-1]] - foot[part[0]] >= SETTINGS.min_wall_extent
        if len(part) >= SETTINGS.min_wall_echoes and long_enough:
            yield part


def _segment(rho: float, theta: float, ends: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2 2"]:
    """Endpoints (x, y) of a line between two positions along it, metres."""
    normal = np.array([np.cos(theta), np.sin(theta)])
    return rho * normal + np.outer(ends, [-normal[1], normal[0]])
