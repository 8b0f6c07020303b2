"""The global map: walls, corners and edges in the world frame (paper, section 5)."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.segments import lengths

POINT_KINDS = ("corner", "edge")
"""Kinds of points: right-angled corners (two reflections), and edges (diffraction)."""


@dataclass(frozen=True, eq=False)
class GlobalMap:
    """Walls, corners and edges in the world frame, sorted by decreasing number of echoes. The arrays are read-only.

    ``len(world)`` is the number of walls. Maps of the Hough detector, and maps merged as in the paper, have no points.
    """

    segments: Float[np.ndarray, "segments 2 2"]
    """Endpoints (x, y) of the walls, metres."""
    rho: Float[np.ndarray, " segments"]
    """Distance of each wall's line from the world's origin, metres, >= 0."""
    theta: Float[np.ndarray, " segments"]
    """Direction of the line's normal, radians, in [-pi, pi)."""
    sigma_rho: Float[np.ndarray, " segments"]
    """Standard deviation of rho, metres, from the scatter of the fused lines; NaN where it is unknown, as for a single
    line."""
    sigma_theta: Float[np.ndarray, " segments"]
    """Standard deviation of theta, radians; NaN where it is unknown."""
    echoes: Int[np.ndarray, " segments"]
    """Number of echoes that support each wall."""
    scans: tuple[tuple[int, ...], ...]
    """Numbers of the scans that observed each wall, ascending."""
    points: Float[np.ndarray, "points 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    """Positions (x, y) of corners and edges, metres."""
    point_kinds: tuple[str, ...] = ()
    """Kind of each point: "corner" (right-angled, two reflections) or "edge" (diffraction; also thin poles)."""
    point_cov: Float[np.ndarray, "points 2 2"] = field(default_factory=lambda: np.zeros((0, 2, 2)))
    """Covariance of each point's (x, y), square metres; NaN where it is unknown."""
    point_echoes: Int[np.ndarray, " points"] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """Number of echoes that support each point."""
    point_scans: tuple[tuple[int, ...], ...] = ()
    """Numbers of the scans that observed each point, ascending."""

    def __post_init__(self):
        for name in (
            "segments",
            "rho",
            "theta",
            "sigma_rho",
            "sigma_theta",
            "echoes",
            "points",
            "point_cov",
            "point_echoes",
        ):
            view = getattr(self, name).view()
            view.flags.writeable = False  # only the view is read-only, not the caller's array
            object.__setattr__(self, name, view)

    def __len__(self) -> int:
        return len(self.segments)

    @property
    def length(self) -> Float[np.ndarray, " segments"]:
        """Length of each wall, metres."""
        return lengths(self.segments)
