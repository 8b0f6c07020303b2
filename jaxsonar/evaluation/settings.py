"""Numeric settings of the evaluation. Unless a field says otherwise, its value was chosen by hand."""

import math
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class LineMatchSettings:
    """Matching of extracted lines with true walls."""

    gate_rho: float = 0.10
    """Largest deviation in rho of a match, metres; three times the paper's largest deviation."""
    gate_theta: float = float(np.radians(15.0))
    """Largest deviation in theta of a match, radians; twice the paper's largest deviation."""
    min_echoes: int = 8
    """First-order echoes from which on a wall should be found."""


@dataclass(frozen=True)
class MapMatchSettings:
    """Matching of the segments of a map with those of a reference."""

    gate_distance: float = 0.15
    """Largest distance between a piece of the map and its reference, metres."""
    gate_angle: float = math.radians(10.0)
    """Largest angle between them, radians."""
    min_overlap: float = 0.05
    """Shorter overlaps give no deviation, metres."""
    wall_samples: int = 21
    """Points of a wall of the map that are compared with poles and circles."""


@dataclass(frozen=True)
class LaserSettings:
    """Walls from laser scans."""

    corner_gate: float = 0.2
    """Walls whose ends are closer than this to the crossing of their lines meet there, metres."""
    min_corner_angle: float = float(np.radians(15.0))
    """Lines with a smaller angle between them have no well-defined crossing, radians."""
    min_incidence: float = float(np.radians(10.0))
    """Smallest angle of incidence at which a wall is expected to give connected returns, radians (Borges and Aldon,
    2004)."""
    range_noise: float = 0.03
    """Three standard deviations of common laser range finders, metres."""
    cell: float = 0.05
    """Size of the cells that vote for lines, and sampling of a wall's profile, metres."""
    band: float = 0.15
    """Returns within this distance of a line are analysed together, metres: a wall and its recesses."""
    max_extent: float = 1000.0
    """Largest extent of one reference map, metres."""
    window_cells: int = 4
    """Cells on each side of a step that determine its height, and of a cell that determine how many scans saw it."""


@dataclass(frozen=True)
class LaserRangeSettings:
    """Ranges of sonars against the walls of a laser."""

    gate: float = 0.2
    """Largest difference between the corrected range of an echo and that of the wall, metres: three standard deviations
    of the mean range offset of uncalibrated rings (60 mm), ..."""
    gate_share: float = 0.1
    """... plus this share of the distance, for the scale: errors of up to 9 % occur."""
    freedom: float = 3.0
    """Degrees of freedom of Student's t distribution of the residuals."""
    first_noise: float = 0.08
    """Scale of the residuals at the beginning, metres: an offset of that size occurs."""
    min_noise: float = 0.003
    """Least scale of the residuals, metres: ranges in steps of 10 mm."""
    iterations: int = 60
    """Iterations of the reweighted least squares."""
    sensor_offset_sd: float = 0.015
    """Prior standard deviation of the range offset of a sensor relative to the mean, metres: one or two wavelengths."""
    min_echoes: int = 30
    """Echoes that a fit needs, ..."""
    min_walls: int = 4
    """... and walls."""
    max_clock_difference: float = 5.0
    """Largest difference between the lengths of two recordings of one run with different clocks, seconds."""


@dataclass(frozen=True)
class EvaluationSettings:
    """All settings of the evaluation."""

    lines: LineMatchSettings = field(default_factory=LineMatchSettings)
    """Matching of lines."""
    maps: MapMatchSettings = field(default_factory=MapMatchSettings)
    """Matching of maps."""
    laser: LaserSettings = field(default_factory=LaserSettings)
    """Walls from laser scans."""
    ranges: LaserRangeSettings = field(default_factory=LaserRangeSettings)
    """Ranges against these walls."""


SETTINGS = EvaluationSettings()
"""The settings in use."""
