"""The global map: wall segments in the world frame (paper, section 5)."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.floor_plans.room import Room, lines_in

POINT_KINDS = ("corner", "edge")
"""What the points of a map are: right-angled corners, and what diffracts."""


@dataclass(frozen=True, eq=False)
class GlobalMap:
    """Merged walls in the world frame, those with the most echoes first; the arrays are read-only.

    ``len(world)`` counts segments. Maps of method "hough", or merged as in the paper, have no points.
    """

    segments: Float[np.ndarray, "segments 2 2"]
    """Endpoints (x, y), metres."""
    rho: Float[np.ndarray, " segments"]
    """Distance of the line from the world's origin, metres, >= 0."""
    theta: Float[np.ndarray, " segments"]
    """Direction of the line's normal, radians, in [-pi, pi)."""
    sigma_rho: Float[np.ndarray, " segments"]
    """Standard deviation of rho, metres: from how much the added lines differ, for one alone what is expected of it
    (its covariance, or 10 mm, 3 deg); NaN where it is not known."""
    sigma_theta: Float[np.ndarray, " segments"]
    """Standard deviation of theta, radians; NaN where it is not known."""
    echoes: Int[np.ndarray, " segments"]
    """Echoes that the segment rests on."""
    scans: tuple[tuple[int, ...], ...]
    """Numbers of the scans that the segment was seen in, ascending."""
    points: Float[np.ndarray, "points 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    """Corners and edges (x, y), those with the most echoes first, metres."""
    point_kinds: tuple[str, ...] = ()
    """Of each point: "corner" (right-angled, reflects twice) or "edge" (diffracts; thin poles, too)."""
    point_cov: Float[np.ndarray, "points 2 2"] = field(default_factory=lambda: np.zeros((0, 2, 2)))
    """Covariance of each point's (x, y), square metres; NaN where it is not known."""
    point_echoes: Int[np.ndarray, " points"] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """Echoes that each point rests on."""
    point_scans: tuple[tuple[int, ...], ...] = ()
    """Numbers of the scans that each point was seen in, ascending."""

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
            view.flags.writeable = False  # of our view only: the caller's own array stays as it was
            object.__setattr__(self, name, view)

    def __len__(self) -> int:
        return len(self.segments)

    @property
    def length(self) -> Float[np.ndarray, " segments"]:
        """How long the segments are, metres."""
        return np.linalg.norm(self.segments[:, 1] - self.segments[:, 0], axis=-1)


def map_of(room: Room) -> GlobalMap:
    """The walls of a floor plan as a map: known to a micrometre, seen often; its poles are left out."""
    rho, theta = lines_in(room, np.zeros(3))
    count = len(room.walls)
    known = np.full(count, 1e-6)
    return GlobalMap(np.array(room.walls), rho, theta, known, known, np.full(count, 1000), ((0, 1),) * count)
