"""Numeric settings of occupancy grids. Unless a field says otherwise, its value was chosen by hand on simulations."""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class BayesSettings:
    """Parameters of one Bayesian grid; trained on random rooms by ``benchmarks.mapping.occupancy_grids --train``."""

    occupied: float
    """Log-odds, or number of explained echoes, from which a cell is occupied."""
    missed: float
    """Log-odds, or expected echoes, of a look that heard nothing nearer."""
    prior: float = 0.05
    """Log-odds: probability that a cell is occupied."""
    detected: float = 0.9
    """Log-odds: probability that a look at an occupied cell brings an echo."""
    false: float = 0.05
    """Log-odds: probability of an echo without a reflector."""


@dataclass(frozen=True)
class ReflectorSettings:
    """Known reflectors: which echoes they explain, and which of their parts are drawn."""

    explained: float = 0.08
    """An echo within this distance of the range of a known wall, wall end or corner is attributed to it, metres."""
    distinct: float = 0.02
    """An echo that is later than that of a wall by more is that of a known point or wall end, if it fits it better,
    metres."""
    beyond_end: float = 0.3
    """Known walls also reflect this far beyond their mapped ends, metres: a map has them up to the outermost
    footpoint (paper, section 5)."""
    beyond_cone: float = float(np.radians(5.0))
    """A wall is strong enough to be detected this far outside the cone, radians."""
    explained_outside: float = 0.04
    """The same outside of the cones, for crosstalk, and for reflections at two walls, metres: half as much, because
    more reflectors may agree by chance."""
    hearing_threshold: float = -36.0
    """Level of the faintest echoes that reflectors outside of the cones explain, dB
    (``kernels.detection_cones.echo_level``); that of ``localize``."""
    drawn_sd: float = 2.0
    """Walls and points are drawn this many standard deviations wide."""
    max_drawn: float = 0.15
    """... but at most this far to each side, metres."""
    whole_circle: float = 0.2
    """Circles up to this radius are drawn completely, metres; poles, legs and most columns are smaller."""
    certain_border: float = 0.05
    """Larger ones are drawn completely if no part of their border has a larger standard deviation, metres: a cell. That
    of simulated columns of 0.2 to 0.5 m, heard from 15 poses, was below 0.01 m; that of walls taken for circles was
    above 0.08 m, on simulated rooms and on two recorded runs."""
    border_beside: float = float(np.radians(15.0))
    """The border of a circle is drawn this far beside a reflection, radians."""
    min_looks: int = 2
    """Readings that must look through a part of a wall, or of its extension, to show that there is none."""
    window: int = 2
    """Cells on each side, along a wall, whose readings are taken together."""
    max_extension: float = 3.0
    """Length by which a wall may go on, unseen, beyond its ends, metres."""
    hidden_neighbors: int = 6
    """Number of nearest other edges with which an edge may form such a wall."""
    min_length: float = 0.2
    """Shorter parts of an extension are no walls, metres."""
    max_hidden: float = 0.7
    """Distance up to which two edges may belong to one wall that no sensor has faced, metres."""
    small_obstacle: int = 12
    """Obstacles of at most this many cells may be such edges."""
    touches: float = 0.1
    """A wall whose end is this close to another wall ends there, metres."""


@dataclass(frozen=True)
class FreeCellSettings:
    """Which cells are free."""

    certain: float = 0.6
    """Fraction of the cone in which a missing echo counts as free space. Toward the border a sensor hears only large
    walls: a cone ends where the one-way gain is 6 dB lower, 12 dB in both ways. Chosen on simulated rooms and
    confirmed on two recorded runs."""
    min_detection: float = 0.85
    """Instead of this fraction, with a calibration: share of the walls that must be heard at an angle, ..."""
    min_expected: int = 30
    """... among at least so many."""
    reach: float = 0.95
    """Fraction of the maximum range up to which silence clears cells."""
    range_margin: float = 0.04
    """Cells closer to the echo than this are not counted as free, metres; covers errors of ranges and poses."""
    min_looks: int = 2
    """Looks through a cell that exclude walls of a direction. A scan counts once for this direction and once for each
    of the two beside it."""
    min_excluded: float = 0.4
    """Share of the wall directions that must be excluded in a free cell; in a building of right angles, one of two."""
    irregular: float = 0.1
    """... and more where the known walls are not at right angles, or none is known: so much for a uniform
    distribution of the directions."""
    max_evidence: float = 0.5
    """Evidence of an obstacle up to which a cell can be free, as a fraction of that of an occupied cell."""
    uniform: float = 0.15
    """Part of the distribution of wall directions that does not follow the known walls."""


@dataclass(frozen=True)
class OccupancySettings:
    """Bayesian models, known reflectors, free space, and the grid."""

    elfes: BayesSettings = BayesSettings(occupied=1.5, missed=0.05, prior=0.03)
    """Log-odds of first direct echoes."""
    wilkes: BayesSettings = BayesSettings(occupied=1.5, missed=0.02, prior=0.03)
    """Log-odds of all direct echoes."""
    logodds: BayesSettings = BayesSettings(occupied=1.5, missed=0.02, prior=0.1)
    """Log-odds of all direct and cross echoes."""
    em: BayesSettings = BayesSettings(occupied=0.1, missed=0.02)
    """Expectation maximization."""
    counts: BayesSettings = BayesSettings(occupied=1.5, missed=0.15)
    """Expectation maximization of the echoes that no known reflector explains."""
    rounds: int = 10
    """Iterations of the expectation maximization."""
    clutter: float = 0.02
    """Expected number of echoes of an arc without a reflector."""
    arc_share: float = 0.005
    """Exposure by an echo from the cell's own distance, in looks."""
    reflectors: ReflectorSettings = field(default_factory=ReflectorSettings)
    """Known walls and points."""
    free: FreeCellSettings = field(default_factory=FreeCellSettings)
    """Free cells."""
    min_weight: float = 0.1
    """Least weight of a cell on an arc that counts as a viewpoint."""
    free_threshold: float = 0.196
    """Probability below which Nav2's map_server takes a cell as free; that of map_saver. With Nav2's older 0.25, the
    grey of unknown cells would be read as free (navigation2, pull request 5278)."""
    occupied_threshold: float = 0.65
    """Probability above which it takes a cell as occupied."""
    grey_margin: float = 0.005
    """Distance of probabilities from these thresholds: images have 256 grey values."""
    max_step: float = 0.5
    """Distance between two scans up to which the robot drove along a straight line, metres."""
    min_viewpoints: int = 2
    """Number of viewpoints, 0.2 m apart, from which an obstacle must be observed."""
    viewpoint_cell: float = 0.2
    """Side of the cells that distinguish viewpoints, metres; they form a pattern of 4 x 4 that repeats."""
    max_wall_coordinate: float = 10_000.0
    """Largest coordinate of a known wall, metres."""
    max_coordinate: float = 1e7
    """Largest coordinate of a pose, metres: cells far out have no exact numbers."""
    max_range_cells: int = 400
    """Largest maximum range, in cells: 20 m at 0.05 m."""
    max_cells: int = 10_000_000
    """Largest grid, in cells: 150 m x 150 m at 0.05 m, about 1 GB. More indicates a wrong pose or resolution."""
    arc_cell: tuple[float, float, float] = (0.1, float(np.radians(7.5)), 0.025)
    """Echoes of a path that agree in position (m), direction (rad) and range (m) up to these cells are one arc."""
    max_echoes: int = 2
    """An arc counts as this many echoes at most: echoes from the same viewpoint are not independent."""
    max_readings: int = 500_000
    """Number of direct readings, the latest, that test walls and hidden walls: 20,000 scans of 24 sensors."""
    max_arcs: int = 100_000
    """Largest number of arcs that are kept, ..."""
    max_arc_cells: int = 16_000_000
    """... and of the cells on all of them: wide cones of long range have fewer arcs."""


SETTINGS = OccupancySettings()
"""The settings in use."""
