"""Known walls, points and circles: their cells with uncertainty, and the echoes that they explain."""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.segments import crossings, lengths, sample_segments
from jaxsonar.kernels.detection_cones import SETTINGS as CONES
from jaxsonar.occupancy.settings import SETTINGS

_WALLS = SETTINGS.reflectors


@runtime_checkable
class ReflectorMap(Protocol):
    """What a grid uses of a map, such as ``GlobalMap``."""

    @property
    def segments(self) -> Float[np.ndarray, "walls 2 2"]:
        """End points of the walls, world frame, metres."""
        ...

    @property
    def theta(self) -> Float[np.ndarray, " walls"]:
        """Directions of their normals, radians."""
        ...

    @property
    def sigma_rho(self) -> Float[np.ndarray, " walls"]:
        """Standard deviations of their distances from the origin, metres; NaN if unknown."""
        ...

    @property
    def sigma_theta(self) -> Float[np.ndarray, " walls"]:
        """Standard deviations of the directions, radians; NaN if unknown."""
        ...

    @property
    def points(self) -> Float[np.ndarray, "points 2"]:
        """Corners, edges, centers of circles, and undecided reflectors, metres."""
        ...

    @property
    def point_radius(self) -> Float[np.ndarray, " points"]:
        """Radii of circles, metres; NaN for other points."""
        ...

    @property
    def point_circle_cov(self) -> Float[np.ndarray, "points 3 3"]:
        """Covariances of the (x, y, radius) of circles, square metres; NaN if unknown."""
        ...

    @property
    def point_cov(self) -> Float[np.ndarray, "points 2 2"]:
        """Their covariances, square metres; NaN if unknown."""
        ...


class KnownReflectors(NamedTuple):
    """Walls, points and circles of a map, with standard deviations."""

    walls: Float[np.ndarray, "walls 2 2"]
    """Start and end points, world frame, metres."""
    wall_sd: Float[np.ndarray, "walls 2"]
    """Standard deviation across the wall at its start and its end, metres."""
    points: Float[np.ndarray, "points 2"]
    """Corners, edges, centers of circles, and undecided reflectors, metres."""
    point_sd: Float[np.ndarray, " points"]
    """Largest standard deviation of each point, and of the border of each circle, metres."""
    point_radius: Float[np.ndarray, " points"]
    """Radii of circles, metres; 0 for other points."""
    circle_cov: Float[np.ndarray, "points 3 3"]
    """Covariances of the (x, y, radius) of circles, square metres; 0 for other points."""

    @classmethod
    def of_walls(cls, walls: Float[np.ndarray, "walls 2 2"]) -> "KnownReflectors":
        """Exact walls without points. Walls without length are left out."""
        walls = walls[lengths(walls) > 0]
        nothing = np.zeros(0)
        return cls(walls, np.zeros((len(walls), 2)), np.zeros((0, 2)), nothing, nothing, circle_cov=np.zeros((0, 3, 3)))

    @classmethod
    def of_map(cls, world: ReflectorMap) -> "KnownReflectors":
        """Walls and points of a map. Standard deviations that are unknown count as 0."""
        keep = lengths(world.segments) > 0
        walls, theta = world.segments[keep], world.theta[keep]
        sd_rho, sd_theta = np.nan_to_num(world.sigma_rho[keep]), np.nan_to_num(world.sigma_theta[keep])
        # rho belongs to the foot of the world's origin: its error contains that of the direction, by this lever arm.
        tangent = np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
        lever = (walls.mean(axis=1) * tangent).sum(-1) * sd_theta
        middle = np.sqrt(np.maximum(sd_rho**2 - lever**2, 0))
        sd = np.hypot(middle, lengths(walls) / 2 * sd_theta)
        covariance = np.nan_to_num(world.point_cov)
        point_sd = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[:, -1], 0)) if len(covariance) else np.zeros(0)
        circle_cov = np.nan_to_num(world.point_circle_cov)
        radius_sd = np.sqrt(np.maximum(circle_cov[:, 2, 2], 0))
        point_sd, radius = np.hypot(point_sd, radius_sd), np.nan_to_num(world.point_radius)
        return cls(walls, np.stack([sd, sd], axis=-1), world.points, point_sd, radius, circle_cov)

    def near(self, low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]) -> "KnownReflectors":
        """The reflectors that may be in a box, metres."""
        wall = ((self.walls.max(axis=1) >= low) & (self.walls.min(axis=1) <= high)).all(axis=1)
        radius = self.point_radius[:, None]
        point = ((self.points + radius >= low) & (self.points - radius <= high)).all(axis=1)
        of_points = (column[point] for column in self[2:])
        return KnownReflectors(self.walls[wall], self.wall_sd[wall], *of_points)

    def reflecting_points(self) -> Float[np.ndarray, "points 2"]:
        """Points, wall ends, and crossings of walls that go on a little beyond their ends, metres."""
        length = lengths(self.walls)
        fraction, other = crossings(self.walls, self.walls)
        spare = _WALLS.beyond_end / length[:, None]
        meet = np.triu((np.abs(fraction - 0.5) <= 0.5 + spare) & (np.abs(other - 0.5) <= 0.5 + spare.T))
        first, _ = np.nonzero(meet)
        corners = self.walls[first, 0] + fraction[meet][:, None] * (self.walls[first, 1] - self.walls[first, 0])
        return np.concatenate([self.points, self.walls.reshape(-1, 2), corners])

    def reflecting_radii(self) -> Float[np.ndarray, " points"]:
        """Radius of each of ``reflecting_points``, metres; 0 unless it is the center of a circle."""
        radii = np.zeros(len(self.reflecting_points()))
        radii[: len(self.points)] = self.point_radius
        return radii

    def reflecting_levels(self) -> Float[np.ndarray, " points"]:
        """Level of each of ``reflecting_points`` relative to a wall, dB: wall ends are faint, points may be corners."""
        levels, points = np.zeros(len(self.reflecting_points())), len(self.points)
        levels[points : points + 2 * len(self.walls)] = CONES.edge_level_db
        return levels

    def cells(self, resolution: float) -> Int[np.ndarray, "cells 2"]:
        """Cells (column, row) of the world that the reflectors cover, with their uncertainty, without repetition."""
        length = lengths(self.walls)
        # Samples a quarter of a cell apart miss at most a clipped corner of a cell.
        samples = (4 * length / resolution).astype(int) + 2
        points, row = sample_segments(self.walls, samples)
        fraction = np.concatenate([np.linspace(0, 1, n) for n in samples]) if len(samples) else np.zeros(0)
        sd = self.wall_sd[row, 0] * (1 - fraction) + self.wall_sd[row, 1] * fraction
        is_round = self.point_radius > 0
        points = np.concatenate([points, self.points[~is_round]])
        sd = np.concatenate([sd, self.point_sd[~is_round]])
        radius = np.minimum(_WALLS.drawn_sd * sd, _WALLS.max_drawn) / resolution
        center = np.floor(points / resolution).astype(int)
        found = [center]
        reach = int(np.ceil(radius.max(initial=0)))
        for column in range(-reach, reach + 1):
            for line in range(-reach, reach + 1):
                cell = center + np.array([column, line])
                inside = np.linalg.norm(cell + 0.5 - points / resolution, axis=-1) <= radius
                found.append(cell[inside])
        for row in np.flatnonzero(is_round):  # discs
            wide = min(_WALLS.drawn_sd * float(self.point_sd[row]), _WALLS.max_drawn)
            at, reach = self.points[row] / resolution, (self.point_radius[row] + wide) / resolution
            steps = np.arange(-int(np.ceil(reach)) - 1, int(np.ceil(reach)) + 2)
            disc = np.floor(at).astype(int) + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
            # Cells that the disc touches: their point nearest to its center lies within it.
            off = np.maximum(np.abs(disc + 0.5 - at) - 0.5, 0)
            found.append(disc[(off**2).sum(axis=1) <= reach**2])
        return np.unique(np.concatenate(found), axis=0)


def direction_of(walls: Float[np.ndarray, "walls 2 2"]) -> Float[np.ndarray, " walls"]:
    """Directions of the normals of walls, radians."""
    along = walls[:, 1] - walls[:, 0]
    return np.arctan2(along[:, 0], -along[:, 1])
