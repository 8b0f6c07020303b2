"""Plane, corner, edge and circle at a distance and a bearing from an array, and the paths that hear them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.detection.local_model import KIND_NAMES
from jaxsonar.geometry.se2 import unit
from jaxsonar.sensors.range_models import RANGE_OF_KIND, PredictedRange, curved_range
from jaxsonar.sensors.ring import Ring

NAME_OF_KIND = dict(zip(kernels.REFLECTOR_KINDS, KIND_NAMES, strict=True))
"""Names of ``kernels.REFLECTOR_KINDS``."""
THREE_KINDS = (kernels.PLANE, kernels.CORNER, kernels.EDGE)


@dataclass(frozen=True, eq=False)
class ArrayPaths:
    """Some echo paths of an array, in the frame of the robot moved to the array's center; double precision."""

    midpoint: Float[np.ndarray, "paths 2"]
    """Midpoint between transmitter and receiver, metres."""
    half_baseline: Float[np.ndarray, "paths 2"]
    """Half the vector from transmitter to receiver, metres."""
    axes: Float[np.ndarray, "paths 2 2"]
    """Unit vectors along the axes of transmitter and receiver."""
    min_cosine: Float[np.ndarray, "paths 2"]
    """Cosine of the half beam width of transmitter and receiver: the border of the nominal cones."""
    max_range: float
    """Largest half path length, metres."""

    @classmethod
    def of(cls, ring: Ring, pairs: Int[np.ndarray, "paths 2"]) -> "ArrayPaths":
        """The paths of these pairs (transmitter, receiver)."""
        position = np.asarray(ring.position, np.float64)
        ends = (position - position.mean(axis=0))[pairs]
        return cls(
            midpoint=ends.mean(axis=1),
            half_baseline=(ends[:, 1] - ends[:, 0]) / 2,
            axes=unit(np.asarray(ring.heading, np.float64)[pairs]),
            min_cosine=np.cos(np.asarray(ring.beam, np.float64)[pairs] / 2),
            max_range=ring.max_range,
        )

    def selected(self, chosen: Bool[np.ndarray, " paths"]) -> "ArrayPaths":
        """Some of these paths."""
        return ArrayPaths(
            self.midpoint[chosen],
            self.half_baseline[chosen],
            self.axes[chosen],
            self.min_cosine[chosen],
            self.max_range,
        )

    def __len__(self) -> int:
        return len(self.midpoint)


def reflectors_at(
    kind: int,
    distance: Float[np.ndarray, " scenes"],
    bearing: Float[np.ndarray, " scenes"],
    *,
    curvature: Float[np.ndarray, " scenes"] | float = 0.0,
) -> Float[np.ndarray, "scenes parameters"]:
    """Parameters of reflectors whose nearest point is at this distance (metres) and bearing (radians).

    Returns:
        (rho, theta) of planes; (x, y) of corners and edges; (rho, theta, curvature) of circles.
    """
    if kind == kernels.PLANE:
        return np.stack([distance, bearing], axis=-1)
    if kind == kernels.CIRCLE:
        return np.stack([distance, bearing, np.broadcast_to(curvature, distance.shape)], axis=-1)
    return distance[:, None] * unit(bearing)


def predicted_ranges(
    kind: int, parameters: Float[np.ndarray, "scenes parameters"], paths: ArrayPaths
) -> PredictedRange:
    """Ranges of every path to every reflector of one kind, (scenes, paths), with derivatives."""
    model = curved_range if kind == kernels.CIRCLE else RANGE_OF_KIND[kind]
    return model(parameters[:, None], paths.midpoint[None], paths.half_baseline[None])


def is_heard(predicted: PredictedRange, paths: ArrayPaths) -> Bool[np.ndarray, "scenes paths"]:
    """Whether the sound leaves and arrives within the nominal cones of both sensors, and the echo is near enough."""
    ways = np.stack([predicted.departure, predicted.arrival], axis=-2)
    cosine = (ways * paths.axes).sum(axis=-1)
    return (cosine >= paths.min_cosine).all(axis=-1) & (predicted.range <= paths.max_range)
