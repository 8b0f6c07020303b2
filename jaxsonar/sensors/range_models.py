"""Range models of plane, corner, edge and circle in NumPy, with derivatives, for transducers at any pose.

The same models as ``kernels.measurement_model``, which is their oracle in the tests. Registration evaluates them
thousands of times on small arrays of changing shapes, for which calls of compiled JAX functions would be too slow.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.geometry.se2 import tangent_of, unit, wrap_angle
from jaxsonar.kernels.measurement_model import REFLECTION_STEPS

Real = Any
"""One number for each path: an array, for a single path a NumPy scalar."""
KINDS = kernels.PLANE, kernels.CORNER, kernels.EDGE
MIN_RATE = 1e-9
"""Smallest curvature of a circle for a division, per metre; a smaller one is a straight line in double precision."""


class PredictedRange(NamedTuple):
    """Ranges of paths to reflectors, and their derivatives."""

    range: Float[np.ndarray, "..."]
    """Half the length of the sound's path, metres."""
    d_range_d_landmark: Float[np.ndarray, "... parameters"]
    """Derivative by the parameters of the reflector: three for a circle, two for the other kinds."""
    d_range_d_midpoint: Float[np.ndarray, "... 2"]
    """Derivative by the midpoint between transmitter and receiver."""
    d_range_d_half_baseline: Float[np.ndarray, "... 2"]
    """Derivative by half the vector from transmitter to receiver."""

    @property
    def departure(self) -> Float[np.ndarray, "... 2"]:
        """Unit vectors along which the sound leaves the transmitters."""
        return self.d_range_d_half_baseline - self.d_range_d_midpoint

    @property
    def arrival(self) -> Float[np.ndarray, "... 2"]:
        """Unit vectors from the receivers to where the sound comes from."""
        return -self.d_range_d_half_baseline - self.d_range_d_midpoint


def plane_range(
    plane: Float[np.ndarray, "*#batch 2"],
    midpoint: Float[np.ndarray, "*#batch 2"],
    half_baseline: Float[np.ndarray, "*#batch 2"],
) -> PredictedRange:
    """Range to a wall.

    Args:
        plane: (rho, theta), metres and radians; rho may be negative.
        midpoint: midpoint between transmitter and receiver, metres.
        half_baseline: half the vector from transmitter to receiver, metres.
    """
    rho, cos, sin = plane[..., 0], np.cos(plane[..., 1]), np.sin(plane[..., 1])
    mx, my, bx, by = midpoint[..., 0], midpoint[..., 1], half_baseline[..., 0], half_baseline[..., 1]
    height, across = rho - (mx * cos + my * sin), by * cos - bx * sin
    distance = np.sqrt(height * height + across * across)
    upright, along = height / distance, across / distance
    turn = -(upright * (my * cos - mx * sin) + along * (bx * cos + by * sin))
    return PredictedRange(
        distance,
        np.stack([upright, turn], axis=-1),
        np.stack([-cos * upright, -sin * upright], axis=-1),
        np.stack([-sin * along, cos * along], axis=-1),
    )


def plane_footpoint(
    plane: Float[np.ndarray, "*#batch 2"],
    midpoint: Float[np.ndarray, "*#batch 2"],
    half_baseline: Float[np.ndarray, "*#batch 2"],
    *,
    min_height: float,
) -> Float[np.ndarray, "*#batch"]:
    """Coordinate of the point of reflection along a wall, metres from the foot of the origin.

    Args:
        plane: (rho, theta), metres and radians; rho may be negative.
        midpoint: midpoint between transmitter and receiver, metres.
        half_baseline: half the vector from transmitter to receiver, metres.
        min_height: smallest distance of the midpoint from the wall, metres; a smaller one is replaced.
    """
    normal, tangent = unit(plane[..., 1]), tangent_of(plane[..., 1])
    height = plane[..., 0] - (midpoint * normal).sum(-1)
    height = np.where(np.abs(height) < min_height, min_height, height)
    baselines = (half_baseline * tangent).sum(-1) * (half_baseline * normal).sum(-1)
    return (midpoint * tangent).sum(-1) + baselines / height


def corner_range(
    point: Float[np.ndarray, "*#batch 2"],
    midpoint: Float[np.ndarray, "*#batch 2"],
    half_baseline: Float[np.ndarray, "*#batch 2"],
) -> PredictedRange:
    """Range to a right-angled corner (x, y), metres; it does not depend on the baseline."""
    away = point - midpoint
    distance = np.sqrt(away[..., 0] ** 2 + away[..., 1] ** 2)
    towards = away / distance[..., None]
    return PredictedRange(distance, towards, -towards, np.zeros_like(towards))


def edge_range(
    point: Float[np.ndarray, "*#batch 2"],
    midpoint: Float[np.ndarray, "*#batch 2"],
    half_baseline: Float[np.ndarray, "*#batch 2"],
) -> PredictedRange:
    """Range to an edge or a thin pole (x, y), metres."""
    away = point - midpoint
    out, back = away + half_baseline, away - half_baseline
    first, second = (np.sqrt(leg[..., 0] ** 2 + leg[..., 1] ** 2) for leg in (out, back))
    out, back = out / first[..., None], back / second[..., None]
    mean = (out + back) / 2
    return PredictedRange((first + second) / 2, mean, -mean, (out - back) / 2)


def circle_range(
    circle: Float[np.ndarray, "*#batch 3"],
    midpoint: Float[np.ndarray, "*#batch 2"],
    half_baseline: Float[np.ndarray, "*#batch 2"],
) -> PredictedRange:
    """Range to a circle (x, y, radius), metres; radius 0 or more. NaN or meaningless if it is between the sensors."""
    away = circle[..., :2] - midpoint
    normal = away / np.sqrt((away**2).sum(-1))[..., None]
    radius = circle[..., 2]
    foot = away - radius[..., None] * normal
    _, departure, arrival, here = _reflection(foot, normal, np.ones_like(radius), radius, half_baseline)
    mean = (departure[0] + arrival[0]) / 2
    d_radius = -(mean * here).sum(-1, keepdims=True)
    return PredictedRange(
        (departure[1] + arrival[1]) / 2,
        np.concatenate([mean, np.broadcast_to(d_radius, (*mean.shape[:-1], 1))], axis=-1),
        -mean,
        (departure[0] - arrival[0]) / 2,
    )


def curved_range(
    reflector: Float[np.ndarray, "*#batch 3"],
    midpoint: Float[np.ndarray, "*#batch 2"],
    half_baseline: Float[np.ndarray, "*#batch 2"],
) -> PredictedRange:
    """Range to a curved reflector (rho, theta, kappa): a plane for kappa = 0, a circle of radius 1 / kappa otherwise.

    Args:
        reflector: rho (metres) and theta (radians) of the tangent at the point nearest to the origin, curvature kappa
            per metre. The center is (rho + 1 / kappa) (cos theta, sin theta).
        midpoint: midpoint between transmitter and receiver, metres.
        half_baseline: half the vector from transmitter to receiver, metres.
    """
    rho, kappa = reflector[..., 0], reflector[..., 2]
    normal = unit(reflector[..., 1])
    foot = rho[..., None] * normal - midpoint
    u, departure, arrival, here = _reflection(foot, normal, kappa, np.ones_like(kappa), half_baseline)
    mean = (departure[0] + arrival[0]) / 2
    angle = kappa * u
    along, half = u * _sinc(angle), u * _sinc(angle / 2)
    # Displacement of the surface along its normal at the point of reflection, per unit of each parameter.
    moved = np.stack([np.cos(angle), -(rho * np.sin(angle) + along), half * half / 2], axis=-1)
    return PredictedRange(
        (departure[1] + arrival[1]) / 2,
        (mean * here).sum(-1)[..., None] * moved,
        -mean,
        (departure[0] - arrival[0]) / 2,
    )


def _reflection(
    foot: Float[np.ndarray, "*#batch 2"],
    normal: Float[np.ndarray, "*#batch 2"],
    rate: Float[np.ndarray, "*#batch"],
    speed: Float[np.ndarray, "*#batch"],
    half_baseline: Float[np.ndarray, "*#batch 2"],
) -> tuple[Real, tuple[np.ndarray, Real], tuple[np.ndarray, Real], np.ndarray]:
    """Point of reflection on an arc, as ``kernels.measurement_model.reflection_on_arc``; midpoint at the origin.

    Returns:
        The point's coordinate, direction and length of the legs from the transmitter and from the receiver, and the
        normal at the point.
    """
    tangent = np.stack([-normal[..., 1], normal[..., 0]], axis=-1)
    safe = np.where(np.abs(rate) < MIN_RATE, MIN_RATE, rate)

    def polar(sensor: np.ndarray) -> tuple[Real, Real, Real]:
        offset = sensor - foot
        along, height = (offset * tangent).sum(-1), (offset * normal).sum(-1)
        across, depth = safe * along, speed - safe * height
        distance = np.sqrt(across**2 + depth**2)
        above = (safe * (along**2 + height**2) - 2 * speed * height) / (distance + speed)
        return distance, np.maximum(above, 0), np.arctan2(across, depth)

    def legs(u: Real) -> tuple[tuple[np.ndarray, Real], tuple[np.ndarray, Real], np.ndarray]:
        angle = rate * u
        half, cos, sin = _sinc(angle / 2), np.cos(angle)[..., None], np.sin(angle)[..., None]
        out = speed * u
        point = foot + (out * _sinc(angle))[..., None] * tangent + (out * angle / 2 * half * half)[..., None] * normal
        both = []
        for leg in (point + half_baseline, point - half_baseline):
            length = np.sqrt((leg**2).sum(-1))
            both.append((leg / length[..., None], length))
        return both[0], both[1], cos * normal - sin * tangent

    (far_tx, high_tx, angle_tx), (far_rx, high_rx, angle_rx) = polar(-half_baseline), polar(half_baseline)
    weight = far_tx * high_rx + far_rx * high_tx
    share = np.where(weight > 0, far_rx * high_tx / np.where(weight > 0, weight, 1), 0.5)
    first, span = angle_tx / safe, wrap_angle(angle_rx - angle_tx) / safe
    u, low, high = first + share * span, np.minimum(first, first + span), np.maximum(first, first + span)
    for _ in range(REFLECTION_STEPS):
        departure, arrival, here = legs(u)
        total = departure[0] + arrival[0]
        bend = sum((e * here).sum(-1) ** 2 / length for e, length in (departure, arrival))
        curvature = rate * (total * here).sum(-1) + speed * bend
        slope = total[..., 1] * here[..., 0] - total[..., 0] * here[..., 1]
        u = np.clip(u - slope / np.where(curvature > 0, curvature, np.inf), low, high)
    return u, *legs(u)


def _sinc(x: Real) -> Real:
    return np.sinc(x / np.pi)


RANGE_OF_KIND = {kernels.PLANE: plane_range, kernels.CORNER: corner_range, kernels.EDGE: edge_range}


def predict_ranges(
    kind: Int[np.ndarray, " rows"],
    parameters: Float[np.ndarray, "rows *#batch 2"],
    midpoint: Float[np.ndarray, "#rows *#batch 2"],
    half_baseline: Float[np.ndarray, "#rows *#batch 2"],
) -> PredictedRange:
    """Ranges to reflectors of mixed kinds, one reflector per row.

    Args:
        kind: ``kernels.PLANE``, ``CORNER`` or ``EDGE``.
        parameters: (rho, theta) of planes, (x, y) of corners and edges.
        midpoint: midpoints of the transducers, metres.
        half_baseline: half the vectors from transmitter to receiver, metres.
    """
    if len(kind) and (kind == kind[0]).all():
        return RANGE_OF_KIND[int(kind[0])](parameters, midpoint, half_baseline)
    shape = np.broadcast_shapes(parameters.shape, midpoint.shape, half_baseline.shape)
    out = PredictedRange(np.empty(shape[:-1]), np.empty(shape), np.empty(shape), np.empty(shape))
    for one, predicted in RANGE_OF_KIND.items():
        rows = np.flatnonzero(kind == one)
        if len(rows):
            given = (array[rows] if len(array) > 1 else array for array in (parameters, midpoint, half_baseline))
            for whole, part in zip(out, predicted(*given), strict=True):
                whole[rows] = part
    return out
