"""A submap as negative evidence uses it: walls, viewpoints of the robot, and lines of sight."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.loop_closure.settings import SETTINGS
from jaxsonar.loop_closure.submap import Submap
from jaxsonar.registration.features import Features
from jaxsonar.scans.measured_directions import direction_sector, rotated_directions


class SubmapView(NamedTuple):
    """A submap in its own frame."""

    row: Int[np.ndarray, " walls"]
    """Row of each wall in the submap."""
    features: Features
    """Walls with their centers as references, and points."""
    is_certain: Bool[np.ndarray, " walls"]
    """Whether enough scans observed the wall."""
    point_factor: Float[np.ndarray, " points"]
    """Negative evidence of the absence of each point, as a fraction of that of a wall."""
    viewpoint: Float[np.ndarray, "viewpoints 2"]
    """Positions of the robot, in order, metres."""
    sight_start: Float[np.ndarray, "sights 2"]
    """Start of each line of sight, one robot radius behind the viewpoint, metres."""
    sight_end: Float[np.ndarray, "sights 2"]
    """End of each line of sight, just before the detected reflector, metres."""
    directions: Bool[np.ndarray, "viewpoints directions"] | None = None
    """Directions that were measured at each viewpoint (``measured_directions``), in the frame of the submap; None: all.
    """

    def measured_from(
        self, directions: Float[np.ndarray, "poses viewpoints reflectors"]
    ) -> Bool[np.ndarray, "poses viewpoints reflectors"]:
        """Whether directions (radians, frame of the submap) were measured at each viewpoint."""
        if self.directions is None:
            return np.ones(directions.shape, dtype=bool)
        return self.directions[np.arange(len(self.viewpoint))[:, None], direction_sector(directions)]

    @property
    def center(self) -> Float[np.ndarray, "2"]:
        """Center of the bounding box of the viewpoints."""
        return (self.viewpoint.min(axis=0) + self.viewpoint.max(axis=0)) / 2

    @property
    def radius(self) -> float:
        """Half the diagonal of that box, metres."""
        return float(np.linalg.norm(np.ptp(self.viewpoint, axis=0))) / 2

    @classmethod
    def of(cls, submap: Submap) -> "SubmapView":
        """View of a submap."""
        features = submap.features.as_measurement((0.0, 0.0, 0.0))
        chosen = np.linspace(0, max(len(submap.poses) - 1, 0), SETTINGS.viewpoints)
        chosen = np.unique(chosen.round().astype(int))
        viewpoint = submap.poses[chosen, :2] if len(submap.poses) else np.zeros((1, 2))
        measured = None
        if submap.directions is not None and len(submap.poses):
            headings = submap.poses[chosen, 2].tolist()
            pairs = zip(submap.directions[chosen], headings, strict=True)
            measured = np.array([rotated_directions(one, heading) for one, heading in pairs])
        # Lines of sight: to each wall from all viewpoints whose foot point is on it, to each point from the nearest.
        offset = viewpoint[:, None] - features.reference
        along, distance = (offset * features.tangent).sum(-1), -(offset * features.normal).sum(-1)
        on_wall = (np.abs(along) <= features.half_length + SETTINGS.end_margin) & (distance > 0)
        nearest = np.linalg.norm(viewpoint[:, None] - features.point, axis=-1).argmin(axis=0)
        view, wall = np.nonzero(on_wall)
        start = np.concatenate([viewpoint[nearest], viewpoint[view]])
        foot = viewpoint[view] + distance[view, wall, None] * features.normal[wall]
        target = np.concatenate([features.point, foot])
        away = target - start
        end = start + 0.9 * away
        start = start - SETTINGS.robot_radius * away / np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-9)
        factor = np.where(features.is_corner, SETTINGS.corner_factor, SETTINGS.edge_factor)
        certain = submap.scan_counts >= SETTINGS.min_scans
        wall = submap.landmarks.kind == kernels.PLANE
        return cls(submap.walls, features, certain[wall], factor * certain[~wall], viewpoint, start, end, measured)


class SubmapNeighborhood(NamedTuple):
    """A submap, and the submaps just before and after it."""

    own: SubmapView
    neighbors: tuple[tuple[Float[np.ndarray, "3"], SubmapView], ...] = ()
    """The neighbors, nearest first: own_from_neighbor, and the view."""

    @property
    def all(self) -> tuple[tuple[Float[np.ndarray, "3"], SubmapView], ...]:
        """The submap itself first, then its neighbors."""
        return (np.zeros(3), self.own), *self.neighbors
