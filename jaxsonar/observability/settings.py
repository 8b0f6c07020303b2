"""Settings of the observability analysis."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ObservabilitySettings:
    """Scenes of the bounds, and iterations of the fits. Chosen by hand."""

    bearing: float = 0.12
    """Largest bearing of a surface off the direction in which the array looks, radians: half the angle between two
    sensors of a ring of 24."""
    bearings: int = 24
    """Number of bearings of which the bounds are the median."""
    radii: tuple[float, ...] = (0.05, 0.2, 1.0)
    """Radii of circles, metres: a leg of a table, a column, a round wall. Those of the kinds are between the first and
    the last, log-uniformly."""
    distances: tuple[float, ...] = (0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 4.0, 5.0)
    """Distances of the surface from the array's center, metres; those within the ring's range are used."""
    clearance: float = 0.2
    """Smallest distance of a surface from the foremost sensor, metres."""
    trials: int = 240
    """Number of simulated scenes of which an error rate is the mean: its standard error is 0.03 at most."""
    steps: int = 15
    """Iterations of a fit."""
    max_step: float = 0.1
    """Largest step of a parameter, metres or radians."""
    first_curvatures: tuple[float, ...] = (0.5, 8.0)
    """First estimates of the curvature of a circle, per metre; the better result counts."""
    max_curvature: float = 300.0
    """Largest curvature, per metre: an edge cannot be distinguished from a thinner pole."""
    seed: int = 3
    """Seed of the simulated noise."""


SETTINGS = ObservabilitySettings()
