"""Specular echoes of circles: round columns, seen from outside."""

import numpy as np
from jaxtyping import Float

from jaxsonar.geometry.se2 import unit, wrap_angle
from jaxsonar.simulation.traced_echoes import EchoKind, TracedEchoes
from jaxsonar.simulation.tracing_scene import TOLERANCE, TracingScene

_BISECTIONS = 52
"""Halvings of the interval of the reflection point; they reach the precision of the angle."""


def trace_circles(scene: TracingScene) -> TracedEchoes:
    """Echoes with one reflection at a circle. Both sensors are outside of it and see the point of incidence.

    The path over this point is the shortest one between the sensors over the circle. The point lies between the
    directions of the two sensors from the center, and is found by bisection.
    """
    center, radius = scene.circles[..., :2], scene.circles[..., 2]
    away = np.linalg.norm(scene.hub[:, None] - center, axis=-1) - radius
    group, circle = np.nonzero(away <= scene.max_range + scene.radius[:, None])
    i, j = scene.pairs.T
    offset = scene.sensors[group] - center[group, circle, None]
    r = radius[group, circle, None]
    angle = np.arctan2(offset[..., 1], offset[..., 0])
    begin, turn = angle[:, i], wrap_angle(angle[:, j] - angle[:, i])
    low, high = np.zeros_like(turn), np.ones_like(turn)
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        rises = _slope(begin + middle * turn, offset[:, i], offset[:, j], r) * turn > 0
        low, high = np.where(rises, low, middle), np.where(rises, middle, high)
    normal = unit(begin + (low + high) / 2 * turn)
    point = r[..., None] * normal
    length = np.linalg.norm(offset[:, i] - point, axis=-1) + np.linalg.norm(offset[:, j] - point, axis=-1)
    seen = np.linalg.norm(offset, axis=-1) > r + TOLERANCE
    valid = seen[:, i] & seen[:, j] & (length <= 2 * scene.max_range)
    for k in (i, j):
        valid &= ((offset[:, k] - point) * normal).sum(-1) > TOLERANCE
    row, pair = np.nonzero(valid)
    hit = point[row, pair] + center[group[row], circle[row]]
    return scene.audible(
        TracedEchoes.of_kind(EchoKind.CIRCLE, group[row], pair, circle[row], length[row, pair], hit, hit)
    )


def _slope(
    angle: Float[np.ndarray, "rows pairs"],
    tx: Float[np.ndarray, "rows pairs 2"],
    rx: Float[np.ndarray, "rows pairs 2"],
    radius: Float[np.ndarray, "rows 1"],
) -> Float[np.ndarray, "rows pairs"]:
    """Derivative of the path length by the direction of the point of incidence from the center, metres per radian.

    Args:
        angle: that direction, radians.
        tx: transmitters, relative to the center, metres.
        rx: receivers.
        radius: of the circle, metres.
    """
    normal = unit(angle)
    along = np.stack([-normal[..., 1], normal[..., 0]], axis=-1)
    slope = np.zeros_like(angle)
    for sensor in (tx, rx):
        leg = radius[..., None] * normal - sensor
        distance = np.maximum(np.linalg.norm(leg, axis=-1), TOLERANCE)
        slope += radius * (leg * along).sum(-1) / distance
    return slope
