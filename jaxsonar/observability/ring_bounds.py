"""What a ring can observe, over distance: bounds of walls, corners, edges and circles, and error rates of the kinds."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.geometry.se2 import tangent_of, unit, wrap_angle
from jaxsonar.observability.cramer_rao import reflector_bound
from jaxsonar.observability.kind_errors import error_probability
from jaxsonar.observability.reflectors import (
    NAME_OF_KIND,
    THREE_KINDS,
    ArrayPaths,
    is_heard,
    predicted_ranges,
    reflectors_at,
)
from jaxsonar.observability.settings import SETTINGS, ObservabilitySettings
from jaxsonar.sensors.ring import Ring

FOUR_KINDS = (*THREE_KINDS, kernels.CIRCLE)


@dataclass(frozen=True)
class DistanceBounds:
    """What one measurement knows of a surface at one distance. Medians over bearings; infinite: unobservable."""

    distance: float
    """Distance of the nearest point of the surface from the array's center, metres."""
    echoes: dict[str, float]
    """Number of echoes of a plane, a corner and an edge, and of circles by their radius."""
    range_sd: dict[str, float]
    """Bound of the distance, metres: of a plane, a corner and an edge."""
    bearing_sd: dict[str, float]
    """Bound of the direction, radians: of a plane's normal, of a corner and of an edge."""
    radius_sd: dict[float, float]
    """Bound of the radius of circles by their radius, metres, while it is small against the radius."""
    curvature_sd: dict[float, float]
    """Bound of the curvature of circles by their radius, per metre."""
    three_kinds_error: float
    """Share of wrong decisions between plane, corner and edge; guessing has 2/3."""
    four_kinds_error: float
    """Share of wrong decisions between plane, corner, edge and circle; guessing has 3/4."""


@dataclass(frozen=True)
class RingBounds:
    """What one shot and one scan of a ring know of surfaces at several distances."""

    sigma: float
    """Standard deviation of the ranges, metres. The bounds are proportional to it."""
    bearing: float
    """Direction in which the surfaces are, radians counter-clockwise from x."""
    transmitter: int
    """The sensor that fires the one shot."""
    shot: tuple[DistanceBounds, ...]
    """One transmitter, and all receivers that listen to it."""
    scan: tuple[DistanceBounds, ...]
    """All paths of the ring."""

    def as_json(self) -> dict[str, Any]:
        """For a JSON file: SI units and radians; null where something is unobservable or not heard."""
        return _finite(asdict(self))


def ring_bounds(
    ring: Ring,
    *,
    sigma: float = 0.001,
    settings: ObservabilitySettings = SETTINGS,
    progress: Callable[[int], None] = lambda done: None,
) -> RingBounds:
    """Compute the bounds and the error rates of a ring with its nominal cones.

    Args:
        ring: the sensors.
        sigma: standard deviation of the ranges, metres.
        settings: scenes and iterations.
        progress: called with the number of finished rows.
    """
    direction, transmitter = viewing_direction(ring), foremost_sensor(ring)
    distances = distances_of(ring, settings)
    rows = []
    for pairs in (ring.paths[ring.paths[:, 0] == transmitter], ring.paths):
        for distance in distances:
            rows.append(_distance_bounds(ring, pairs, distance, direction, sigma, settings))
            progress(len(rows))
    shot, scan = rows[: len(distances)], rows[len(distances) :]
    return RingBounds(sigma, direction, transmitter, tuple(shot), tuple(scan))


def viewing_direction(ring: Ring) -> float:
    """The mean direction of the sensors of an array; the axis of sensor 0 of a ring that looks everywhere, radians."""
    heading = np.asarray(ring.heading, np.float64)
    mean = np.exp(1j * heading).mean()
    return float(np.angle(mean)) if abs(mean) > 0.1 else float(heading[0])


def foremost_sensor(ring: Ring) -> int:
    """The sensor that looks ahead; of several, the one with most receivers, then the one nearest to the middle."""
    direction = viewing_direction(ring)
    off_axis = np.abs(wrap_angle(np.asarray(ring.heading, np.float64) - direction))
    receivers = np.bincount(ring.paths[:, 0], minlength=ring.count)
    position = np.asarray(ring.position, np.float64)
    aside = np.abs((position - position.mean(axis=0)) @ tangent_of(direction))
    return int(np.lexsort((aside.round(6), -receivers, off_axis.round(6)))[0])


def distances_of(ring: Ring, settings: ObservabilitySettings = SETTINGS) -> list[float]:
    """Distances of the table within the ring's range and in front of its sensors, metres."""
    position, direction = np.asarray(ring.position, np.float64), viewing_direction(ring)
    ahead = ((position - position.mean(axis=0)) @ unit(direction)).max()
    nearest, farthest = ahead + settings.clearance, ahead + ring.max_range
    return [distance for distance in settings.distances if nearest <= distance <= farthest] or [
        float(nearest + farthest) / 2
    ]


def _distance_bounds(
    ring: Ring,
    pairs: Int[np.ndarray, "paths 2"],
    distance: float,
    direction: float,
    sigma: float,
    settings: ObservabilitySettings,
) -> DistanceBounds:
    paths = ArrayPaths.of(ring, pairs)
    bearing = direction + np.linspace(-settings.bearing, settings.bearing, settings.bearings)
    far = np.full(len(bearing), distance)
    points = {NAME_OF_KIND[kind]: reflector_bound(kind, paths, far, bearing) for kind in THREE_KINDS}
    circles = {radius: reflector_bound(kernels.CIRCLE, paths, far, bearing, radius=radius) for radius in settings.radii}
    errors = [_error(paths, distance, direction, kinds, sigma, settings) for kinds in (THREE_KINDS, FOUR_KINDS)]
    names = {**points, **{f"{radius:g}": circle for radius, circle in circles.items()}}
    return DistanceBounds(
        distance=distance,
        echoes={name: _median(bound.echoes) for name, bound in names.items()},
        range_sd={name: sigma * _median(bound.distance) for name, bound in points.items()},
        bearing_sd={name: sigma * _median(bound.bearing) for name, bound in points.items()},
        radius_sd={radius: sigma * _median(circle.curvature) * radius**2 for radius, circle in circles.items()},
        curvature_sd={radius: sigma * _median(circle.curvature) for radius, circle in circles.items()},
        three_kinds_error=errors[0],
        four_kinds_error=errors[1],
    )


def _error(
    paths: ArrayPaths,
    distance: float,
    direction: float,
    kinds: tuple[int, ...],
    sigma: float,
    settings: ObservabilitySettings,
) -> float:
    """Error rate in simulated scenes of all kinds, the same number of each."""
    rng = np.random.default_rng(settings.seed)
    each = settings.trials // len(kinds)
    far = np.full(each, distance)
    scenes = []
    for kind in kinds:
        bearing = direction + rng.uniform(-settings.bearing, settings.bearing, each)
        low, high = np.log(settings.radii[0]), np.log(settings.radii[-1])
        curvature = np.exp(-rng.uniform(low, high, each))
        predicted = predicted_ranges(kind, reflectors_at(kind, far, bearing, curvature=curvature), paths)
        measured = predicted.range + sigma * rng.standard_normal(predicted.range.shape)
        scenes.append((np.full(each, kind), measured, is_heard(predicted, paths), far, bearing))
    kind, *rest = (np.concatenate(column) for column in zip(*scenes, strict=True))
    true_kind, (measured, heard, far, bearing) = kind.tolist(), rest
    return error_probability(true_kind, paths, measured, heard, far, bearing, sigma=sigma, kinds=kinds)


def _median(values: Float[np.ndarray, " scenes"]) -> float:
    """Median over the scenes in which something is heard; NaN if there are none."""
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _finite(value: Any) -> Any:
    """The same with text as keys, and None for numbers that are not finite."""
    if isinstance(value, dict):
        return {f"{key:g}" if isinstance(key, float) else key: _finite(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
