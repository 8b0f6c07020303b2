"""Bounds, separations and error rates of all configurations, on surfaces at 0.7 to 1.6 m."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.aural.configurations import CODED, Configuration, configurations
from jaxsonar import kernels
from jaxsonar.observability.cramer_rao import reflector_bound
from jaxsonar.observability.kind_errors import error_probability, kind_separations
from jaxsonar.observability.reflectors import THREE_KINDS, ArrayPaths, is_heard, predicted_ranges, reflectors_at

NEAREST, FARTHEST, BEARING = 0.7, 1.6, 0.12
"""Surfaces: distance from the array's center, metres, uniform; bearing, radians, uniform on both sides."""
DRAWS = 24
"""Surfaces of which the bounds and the separations are the medians."""
TRIALS = 120
"""Surfaces of which an error rate is the mean: 40 of each kind; its standard error is 0.045 at most."""
SIGMAS = (0.001, 0.005)
"""Standard deviations of the ranges at which the error rates are counted, metres."""
SEED = 3


@dataclass(frozen=True)
class Row:
    """One row of the table."""

    name: str
    echoes: float
    """Mean number of echoes of a wall."""
    wall_distance: float
    """Bound of a wall's distance, metres per metre of sigma."""
    wall_direction: float
    """Bound of a wall's direction, radians per metre of sigma."""
    errors: tuple[float, ...]
    """Share of wrong kinds (plane, corner, edge), for each of ``SIGMAS``; guessing has 2/3."""
    plane_corner: float
    """Norm of the residuals that distinguish a plane from a corner, metres; divided by sigma it is d'."""
    plane_edge: float
    """The same for a plane and an edge."""


def rows(progress: Callable[[int], None] = lambda done: None) -> list[Row]:
    """All rows. Surfaces and noise are drawn from one generator, row by row."""
    rng = np.random.default_rng(SEED)
    found: list[Row] = []
    for configuration in configurations():
        found.append(row_of(configuration, rng))
        if configuration.name in CODED:
            found.append(replace(found[-1], name=CODED[configuration.name]))
        progress(len(found))
    return found


def row_of(configuration: Configuration, rng: np.random.Generator) -> Row:
    """One row; draws the surfaces of the medians, then those of the error rates."""
    paths = configuration.paths
    distance, bearing = rng.uniform([NEAREST, -BEARING], [FARTHEST, BEARING], (DRAWS, 2)).T
    wall = reflector_bound(kernels.PLANE, paths, distance, bearing)
    separations = kind_separations(paths, distance, bearing)
    errors = tuple(_error_rate(paths, rng, sigma) for sigma in SIGMAS)
    return Row(
        configuration.name,
        float(wall.echoes[wall.echoes > 0].mean()),
        float(np.nanmedian(wall.distance)),
        float(np.nanmedian(wall.bearing)),
        errors,
        float(np.nanmedian(separations[kernels.PLANE, kernels.CORNER])),
        float(np.nanmedian(separations[kernels.PLANE, kernels.EDGE])),
    )


def _error_rate(paths: ArrayPaths, rng: np.random.Generator, sigma: float) -> float:
    """Error rate of ``TRIALS`` simulated surfaces, the kinds in turn. Only paths that hear the surface get noise."""
    kinds = [THREE_KINDS[trial % len(THREE_KINDS)] for trial in range(TRIALS)]
    surfaces = np.empty((TRIALS, 2))
    ranges, heard = np.zeros((TRIALS, len(paths))), np.zeros((TRIALS, len(paths)), bool)
    for trial, kind in enumerate(kinds):
        surfaces[trial] = rng.uniform([NEAREST, -BEARING], [FARTHEST, BEARING])
        ranges[trial], heard[trial] = _noiseless(kind, paths, surfaces[trial])
        ranges[trial, heard[trial]] += sigma * rng.standard_normal(heard[trial].sum())
    return error_probability(kinds, paths, ranges, heard, *surfaces.T, sigma=sigma)


def _noiseless(
    kind: int, paths: ArrayPaths, surface: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, " paths"], Bool[np.ndarray, " paths"]]:
    predicted = predicted_ranges(kind, reflectors_at(kind, surface[:1], surface[1:]), paths)
    return predicted.range[0], is_heard(predicted, paths)[0]


def markdown(table: list[Row]) -> str:
    """The table in Markdown, per millimetre of sigma."""
    sigmas = " / ".join(f"{1e3 * sigma:g}" for sigma in SIGMAS)
    lines = [
        f"| | echoes | wall, mm / deg per mm | wrong kind at {sigmas} mm | d' plane-corner / plane-edge, mm |",
        "|---|---:|---:|---:|---:|",
    ]
    for row in table:
        direction = math.degrees(row.wall_direction) * 1e-3
        text = f"{direction:.3g}" if math.isfinite(direction) else "unobservable"
        errors = " / ".join(f"{error:.3f}" for error in row.errors)
        separation = f"{_figures(1e3 * row.plane_corner)} / {_figures(1e3 * row.plane_edge)}"
        lines.append(f"| {row.name} | {row.echoes:.1f} | {row.wall_distance:.2f} / {text} | {errors} | {separation} |")
    return "\n".join(lines) + "\n"


def _figures(value: float) -> str:
    """Three figures; 0 for what is below a nanometre."""
    return "0" if value < 1e-6 else f"{value:.3g}"
