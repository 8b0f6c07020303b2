"""Range models of plane, corner and edge in NumPy, with derivatives, for transducers at any pose.

The same models as ``kernels.measurement_model``, which is their oracle in the tests. Registration evaluates them
thousands of times on small arrays of changing shapes, for which calls of compiled JAX functions would be too slow.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.geometry.se2 import tangent_of, unit

KINDS = kernels.PLANE, kernels.CORNER, kernels.EDGE


class PredictedRange(NamedTuple):
    """Ranges of paths to reflectors, and their derivatives."""

    range: Float[np.ndarray, "..."]
    """Half the length of the sound's path, metres."""
    d_range_d_landmark: Float[np.ndarray, "... 2"]
    """Derivative by the two parameters of the reflector."""
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
