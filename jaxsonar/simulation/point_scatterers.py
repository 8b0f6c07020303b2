"""Echoes of point scatterers: diffraction at edges and scattering at poles."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.floor_plans.junctions import Junctions
from jaxsonar.simulation.traced_echoes import EchoKind, TracedEchoes
from jaxsonar.simulation.tracing_scene import TOLERANCE, TracingScene, in_cone

Visibility = Callable[[Int[np.ndarray, " rows"], Float[np.ndarray, "rows sensors 2"]], Bool[np.ndarray, "rows sensors"]]
"""Whether a point is visible along each leg from a sensor to it."""


def trace_edges(scene: TracingScene, junctions: Junctions) -> TracedEchoes:
    """Echoes of edges; both sensors must lie inside the edge's wedge of more than 180 deg."""
    edges = junctions.edges
    vertex = junctions.wedge_vertex[edges]
    start, width = junctions.wedge_start[edges], junctions.wedge_width[edges]

    def inside_wedge(
        edge: Int[np.ndarray, " rows"], leg: Float[np.ndarray, "rows sensors 2"]
    ) -> Bool[np.ndarray, "rows sensors"]:
        angle = (np.arctan2(-leg[..., 1], -leg[..., 0]) - start[edge, None]) % (2 * np.pi)
        return (angle > TOLERANCE) & (angle < width[edge, None] - TOLERANCE)

    found = _trace_points(scene, EchoKind.EDGE, junctions.vertices[vertex], inside_wedge)
    return replace(found, reflector=vertex[found.reflector])


def trace_poles(scene: TracingScene, poles: Float[np.ndarray, "poles 2"]) -> TracedEchoes:
    """Echoes of poles, which scatter in all directions."""

    def everywhere(
        pole: Int[np.ndarray, " rows"], leg: Float[np.ndarray, "rows sensors 2"]
    ) -> Bool[np.ndarray, "rows sensors"]:
        return np.ones(leg.shape[:2], dtype=bool)

    return _trace_points(scene, EchoKind.POLE, poles, everywhere)


def _trace_points(
    scene: TracingScene, kind: EchoKind, points: Float[np.ndarray, "points 2"], visibility: Visibility
) -> TracedEchoes:
    """Echoes of points whose visibility can be decided sensor by sensor."""
    points = points - scene.origin
    g, point = scene.points_in_range(points)
    i, j = scene.pairs.T
    leg = points[point, None] - scene.sensors[g]
    distance = np.linalg.norm(leg, axis=-1)
    visible = (distance > TOLERANCE) & visibility(point, leg)
    if scene.axis is not None:
        visible &= in_cone(leg, scene.axis[g], scene.cos_limit)
    length = distance[:, i] + distance[:, j]
    row, pair = np.nonzero(visible[:, i] & visible[:, j] & (length <= 2 * scene.max_range))
    at = points[point[row]]
    found = TracedEchoes.of_kind(kind, g[row], pair, point[row], length[row, pair], at, at)
    loud = scene.loud(found)
    found, row, pair = found[loud], row[loud], pair[loud]
    # Occlusion is tested once for each leg and not for each echo.
    needed = np.zeros_like(visible)
    needed[row, i[pair]] = needed[row, j[pair]] = True
    at_row, sensor = np.nonzero(needed)
    needed[at_row, sensor] = ~scene.block(g[at_row], scene.sensors[g[at_row], sensor], points[point[at_row]])
    return found[needed[row, i[pair]] & needed[row, j[pair]]]
