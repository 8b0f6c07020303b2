"""Settings of the detectors, their defaults for a ring, and checks of arguments."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from jaxsonar import kernels
from jaxsonar.hardware.errors import SonarError
from jaxsonar.sensors.ring import Ring

METHODS = ("ml", "hough")
"""Detection methods: "ml" is maximum likelihood over the ranges, "hough" the method of the paper (section 4)."""


@dataclass(frozen=True)
class DecisionSettings:
    """Constants of decisions on the host. Kernels have ``kernels.HoughSettings`` and ``kernels.DetectionSettings``."""

    min_probability: float = 0.7
    """Posterior probability from which on a reflector is reported as a corner, edge or circle. Chosen by hand."""
    min_wall_probability: float = 0.5
    """The same for walls: a wall is more likely than all other kinds together."""
    max_radius_error: float = 0.5
    """Largest standard deviation of the radius of a circle that one scan decides on, relative to the radius. Chosen by
    hand."""
    window_threshold: float = 0.05
    """Occupancy threshold for windows of scans, as a fraction of a fully observed wall. Lower than for single scans,
    because the test of plane against point decides and a wall may be observed by one sensor only. Chosen by hand."""
    window_tolerance: float = 0.03
    """Largest range residual of an echo that a reflector explains, metres. Covers range steps of 10 mm, readings that
    are 0.2 s old, and odometry errors."""
    window_gate: float = 3.0
    """The same in standard deviations of the ranges, where these are given."""
    plane_to_point_ratio: float = 4 / 3
    """A plane must explain this many times the echoes that a point explains; otherwise the candidate is dropped."""
    min_wall_echoes: int = 4
    """Echoes that a wall of a window must have: two determine it, and a third may lie on it by chance."""
    min_wall_extent: float = 0.2
    """Length along the wall that its echoes must cover, metres: a shorter one does not determine the direction."""


SETTINGS = DecisionSettings()

MIN_SIGMA = kernels.DetectionSettings().min_sigma
"""Smallest standard deviation of ranges, metres; ranges have single precision."""

DEFAULT_SIGMA = 0.003
"""Standard deviation of ranges that is assumed where a local model has no estimate, metres; chosen by hand."""


def window_tolerance(sigma: float | None) -> float:
    """Largest range residual of an echo that a reflector of a window explains, metres.

    Args:
        sigma: standard deviation of the ranges, metres; None if unknown.
    """
    return SETTINGS.window_tolerance if sigma is None else SETTINGS.window_gate * sigma


def check_method(method: str) -> None:
    """Raise a SonarError for an unknown detection method."""
    if method not in METHODS:
        raise SonarError(f"method {method!r}; allowed is {' or '.join(METHODS)}")


def check_sigma(sigma: float | None) -> None:
    """Raise a SonarError for a standard deviation of ranges (metres) that is out of range."""
    if sigma is not None and not MIN_SIGMA <= sigma <= 1:
        raise SonarError(f"sigma {sigma:g} m; allowed are {MIN_SIGMA:g} to 1 m, or none for an estimate")


def hough_settings(
    ring: Ring, settings: kernels.HoughSettings | None, *, window: float | None = None
) -> kernels.HoughSettings:
    """The given settings after a check, or the paper's with enough cells in rho for the ring, at least 100.

    Args:
        ring: the sensors.
        settings: the given settings, if any.
        window: length of trajectory that is gathered into one local model, metres.

    Raises:
        SonarError: the given accumulator is too small for the lines that this ring can observe.
    """
    max_rho = _max_rho(ring, window)
    if settings is None:
        return _default_settings(max_rho, windows=window is not None)
    if settings.max_rho < max_rho:
        raise SonarError(
            f"settings: rho_cells {settings.rho_cells} x rho_cell {settings.rho_cell:g} m = {settings.max_rho:g} m; "
            f"allowed is {max_rho:.3f} m or more, the reach of {ring.name!r}"
        )
    return settings


def widened(ring: Ring, settings: kernels.HoughSettings, *, window: float | None) -> kernels.HoughSettings:
    """The settings with at least as many cells in rho as a window of this length (metres) needs."""
    cells = int(np.ceil(_max_rho(ring, window) / settings.rho_cell))
    return replace(settings, rho_cells=max(settings.rho_cells, cells))


def _max_rho(ring: Ring, window: float | None) -> float:
    """Largest distance of a line that a ring observes, metres."""
    return float(np.linalg.norm(ring.position, axis=1).max() + ring.max_range) + (window or 0.0)


@lru_cache(maxsize=8)
def _default_settings(max_rho: float, *, windows: bool) -> kernels.HoughSettings:
    """The paper's settings for lines up to this distance, metres. Cached because they are needed for every scan."""
    settings = kernels.HoughSettings(threshold=SETTINGS.window_threshold) if windows else kernels.HoughSettings()
    return replace(settings, rho_cells=max(settings.rho_cells, int(np.ceil(max_rho / settings.rho_cell))))
