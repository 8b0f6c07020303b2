"""The global map: walls, corners, edges and circles in the world frame (paper, section 5)."""

from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.geometry.segments import lengths

POINT_KINDS = ("corner", "edge", "circle", "undecided")
"""Kinds of points: right-angled corners (two reflections), edges (diffraction; also thin poles), round columns, and
reflectors of uncertain kind."""
_OF_SOME_POINTS = {"point_radius": (), "point_circle_cov": (3, 3), "point_probabilities": (4,)}
"""Fields that may be omitted, and the shape of each row."""
_DERIVED: Any = None
"""Default of columns that the constructor fills."""

if TYPE_CHECKING:
    _EndCovariances = Float[np.ndarray, "segments 2 2 2"]
    _Radii = Float[np.ndarray, " points"]
    _CircleCovariances = Float[np.ndarray, "points 3 3"]
    _Probabilities = Float[np.ndarray, "points 4"]
else:  # the constructor replaces None
    _EndCovariances = Float[np.ndarray, "segments 2 2 2"] | None
    _Radii = Float[np.ndarray, " points"] | None
    _CircleCovariances = Float[np.ndarray, "points 3 3"] | None
    _Probabilities = Float[np.ndarray, "points 4"] | None


@dataclass(frozen=True, eq=False)
class GlobalMap:
    """Walls, corners, edges and circles in the world frame, sorted by decreasing number of echoes.

    The arrays are read-only.

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
    end_kinds: tuple[tuple[str, str], ...] = ()
    """Kinds of the points at which each wall starts and ends, "corner" or "edge"; "" where none answers. Empty if
    unknown."""
    end_cov: _EndCovariances = _DERIVED
    """Covariance of the (x, y) of both ends of each wall, where a point answers, square metres; otherwise NaN."""
    points: Float[np.ndarray, "points 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    """Positions (x, y) of corners, edges and circles (their centers), metres. The position of an undecided reflector
    is its point nearest to the robot."""
    point_kinds: tuple[str, ...] = ()
    """Kind of each point, one of ``POINT_KINDS``."""
    point_cov: Float[np.ndarray, "points 2 2"] = field(default_factory=lambda: np.zeros((0, 2, 2)))
    """Covariance of each point's (x, y), square metres; NaN where it is unknown."""
    point_echoes: Int[np.ndarray, " points"] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """Number of echoes that support each point."""
    point_scans: tuple[tuple[int, ...], ...] = ()
    """Numbers of the scans that observed each point, ascending."""
    point_radius: _Radii = _DERIVED
    """Radius of each circle, metres; NaN for all other points, and if omitted."""
    point_circle_cov: _CircleCovariances = _DERIVED
    """Covariance of the (x, y, radius) of each circle, square metres; NaN where unknown, and if omitted."""
    point_probabilities: _Probabilities = _DERIVED
    """Probability of each of ``detection.local_model.KIND_NAMES``; NaN where unknown, and if omitted."""

    def __post_init__(self):
        for name, shape in _OF_SOME_POINTS.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.full((len(self.points), *shape), np.nan))
        if self.end_cov is None:
            object.__setattr__(self, "end_cov", np.full((len(self.segments), 2, 2, 2), np.nan))
        for name in (
            "segments",
            "rho",
            "theta",
            "sigma_rho",
            "sigma_theta",
            "echoes",
            "end_cov",
            "points",
            "point_cov",
            "point_echoes",
            *_OF_SOME_POINTS,
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

    def take_walls(self, rows: Bool[np.ndarray, " segments"]) -> "GlobalMap":
        """The map with the given walls only (a mask), and all points."""
        return self._taken(rows, [f.name for f in fields(self) if not f.name.startswith("point")])

    def take_points(self, rows: Bool[np.ndarray, " points"]) -> "GlobalMap":
        """The map with the given points only (a mask), and all walls."""
        return self._taken(rows, [f.name for f in fields(self) if f.name.startswith("point")])

    def with_kinds(self, *kinds: str) -> "GlobalMap":
        """The map with the points of the given kinds only."""
        return self.take_points(np.array([kind in kinds for kind in self.point_kinds], dtype=bool))

    def with_points(self, points: Float[np.ndarray, "points 2"], **columns: Any) -> "GlobalMap":
        """The map with other points; columns that are omitted are unknown.

        Args:
            points: positions, metres.
            columns: fields whose names begin with ``point_``.
        """
        omitted: dict[str, Any] = dict.fromkeys(_OF_SOME_POINTS)
        return replace(self, points=points, **(omitted | columns))

    def _taken(self, rows: Bool[np.ndarray, " rows"], names: list[str]) -> "GlobalMap":
        columns: dict[str, Any] = {name: getattr(self, name) for name in names}
        columns = {name: value for name, value in columns.items() if len(value) == len(rows)}  # others are omitted
        for name, value in columns.items():
            is_array = isinstance(value, np.ndarray)
            columns[name] = value[rows] if is_array else tuple(value[k] for k in np.flatnonzero(rows).tolist())
        return replace(self, **columns)
