"""Numeric settings of occupancy grids. Unless a field says otherwise, its value was chosen by hand on simulations."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class OccupancySettings:
    """Inverse sensor model, visibility of known walls, and the grid."""

    range_margin: float = 0.04
    """Cells closer to the echo than this are not counted as free, metres; covers errors of ranges and poses."""
    certain: float = 2 / 3
    """Fraction of the cone in which a missing echo counts as free space. Toward the border a sensor hears only large
    walls: a cone ends where the one-way gain is 6 dB lower, 12 dB in both ways; over the inner two thirds the loss is
    5 dB."""
    shadow: float = float(np.radians(15.0))
    """Angle on each side of the cone that an unexplained echo occludes as well, radians. It may come from something as
    wide as a wall, which an oblique beam would not hear."""
    explained: float = 0.08
    """An echo within this distance of the range of a known wall, wall end or corner is attributed to it, metres."""
    beyond_end: float = 0.3
    """Known walls also reflect this far beyond their mapped ends, metres: a map has them up to the outermost
    footpoint (paper, section 5)."""
    beyond_cone: float = float(np.radians(5.0))
    """A wall is strong enough to be detected this far outside the cone, radians."""
    max_extension: float = 1.0
    """Length by which a wall may extend beyond its end, and occlude what is behind, where no sensor could hear it,
    metres."""
    touches: float = 0.05
    """A wall whose end is this close to another wall ends there, metres."""
    no_wall: float = 0.2
    """If a sensor should detect a wall and does not, there is none within this distance of its footpoint, metres."""
    footprint_weight: int = 20
    """Number of free beams that the robot's own footprint counts as: the robot stood there."""
    viewpoint_cell: float = 0.2
    """Side of the cells that distinguish viewpoints, metres; they form a pattern of 4 x 4 that repeats."""
    max_wall_coordinate: float = 10_000.0
    """Largest coordinate of a known wall, metres."""
    max_range_cells: int = 400
    """Largest maximum range, in cells: 20 m at 0.05 m."""
    max_cells: int = 50_000_000
    """Largest grid, in cells: 350 m x 350 m at 0.05 m. More indicates a wrong pose or resolution."""


SETTINGS = OccupancySettings()
"""The settings in use."""
