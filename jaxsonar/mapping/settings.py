"""Numeric settings of map building, one frozen dataclass per algorithm.

``SETTINGS`` holds the values in use. Unless a field says otherwise, its value was chosen by hand on simulated and
recorded rooms.
"""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class SegmentSettings:
    """Wall segments of single local models."""

    offset_sd: float = 0.01
    """Standard deviation of the offset of a line without covariance (Hough detector), metres: half a cell, and the
    effect of arcs that are cut off at the border of the cone."""
    theta_sd: float = float(np.radians(3.0))
    """Standard deviation of the direction of such a line, radians."""
    merge_cell: float = 0.05
    """Segments whose centers lie in one square cell of this size are stored as one fused segment, metres."""
    merge_angle: float = float(np.radians(6.0))
    """Size of the cells in direction, radians."""


@dataclass(frozen=True)
class PointSettings:
    """Corners and edges."""

    merge_cell: float = 0.05
    """Observations first seen in one square cell of this size are stored as one fused observation, metres."""
    gate: float = 3.0
    """Largest Mahalanobis distance between two observations of one point."""
    position_floor: float = 0.02
    """Standard deviation added to the difference of two observations, metres: corners are not perfectly sharp, and
    odometry is not perfect."""
    max_distance: float = 0.3
    """Observations farther apart than this belong to two points, however large their covariances are, metres."""
    max_normalized_misfit: float = 2.0
    """A point whose observations scatter by more than this (chi-squared per degree of freedom) is not static."""
    min_range: float = 0.1
    """Smallest distance between a point and the robot's center, metres. Guards a division."""
    min_kind_probability: float = 1e-4
    """Probability that a single observation leaves to the other kind at least."""


@dataclass(frozen=True)
class EvidenceSettings:
    """Collection of evidence from local models."""

    min_scans: int = 2
    """Scans that must have seen a wall, a corner or an edge."""
    position_cell: float = 0.05
    """Cell size for the positions at which local models were made, metres."""
    linkage_per_spacing: float = 1.5
    """Linkage distance of the paper's clustering as a multiple of the median distance between neighboring local models
    (paper, section 5)."""
    min_gap: float = 0.4
    """Lower limit of the linkage distance, metres; less than the width of a door."""
    max_gap: float = 0.7
    """Upper limit of the gap that fusion closes between two segments, metres; more than two neighboring scans leave
    unobserved of a wall between them."""
    bridged_gap: float = 1.5
    """Largest part of a wall that may be occluded or unobserved, metres, as ``max_extension``. A gap that was seen
    through stays open, however small."""
    inner_share: float = 0.8
    """No wall comes closer to the center of the robot than this share of the distance of its innermost sensor, ..."""
    max_half_width: float = 0.1
    """... and at most this distance is used, metres."""
    max_coordinate: float = 1e8
    """Largest distance of a pose from the world's origin along x or y, metres; cell numbers overflow beyond it."""
    listed_scans: int = 32
    """Number of scan numbers that are kept per observation when a map is built scan by scan (the latest ones)."""
    block_scans: int = 64
    """Scans whose free space is computed in one vectorized step; limits memory."""


@dataclass(frozen=True)
class FusionSettings:
    """Fusion of segments into walls."""

    max_offset: float = 0.06
    """Segments of one wall lie at most this far apart, measured perpendicular to the wall, metres."""
    gate: float = 3.0
    """Largest difference of offsets and of directions, standard deviations."""
    offset_floor: float = 0.005
    """Smallest systematic error of an offset, metres: walls are not perfectly straight, and odometry is not perfect."""
    max_systematic_error: float = 0.02
    """Largest systematic error that is attributed to the poses, metres."""
    min_error_growth: float = 1.1
    """The estimate of the systematic error is repeated while it grows by at least this factor."""
    angle_per_offset: float = 2.2
    """Systematic error of a direction per systematic error of an offset, radians per metre."""
    max_thickness: float = 0.04
    """Segments seen from opposite sides are one thin wall if they are closer than this, else two walls, metres."""
    near_wall: float = 0.025
    """A segment whose ends are this close to the line of a longer wall belongs to it, however small its covariance is,
    metres; nothing stands this close in front of a wall."""
    outlier_gate: float = 3.0
    """A segment that deviates from its wall by more than this is down-weighted, standard deviations."""
    refit_iterations: int = 5
    """Iterations of the robust refit."""
    angle_scale: float = 2.0
    """Weight of directions against positions in the search for neighbors, metres per radian."""
    search_gaps: float = 1.6
    """Radius of the search for neighbors, in longest gaps; samples of a segment are at most one gap apart."""
    nearest: int = 12
    """Number of neighbors that the first search for candidate pairs considers; a full search follows."""


@dataclass(frozen=True)
class ArtifactSettings:
    """Removal of segments that are not walls, and of walls that are no longer there."""

    min_wall_length: float = 0.6
    """Segments of at least this length are always walls, metres."""
    corner_radius: float = 0.15
    """Largest distance between a corner and the center of the short line that it causes, metres."""
    same_direction: float = float(np.radians(12.0))
    """Lines that differ by less than this have the same direction, radians."""
    perpendicular: float = float(np.radians(10.0))
    """Tolerance for a short wall that stands perpendicular on the end of a long one, radians."""
    min_opening: float = 0.12
    """Part of a gap that must have been seen through before the gap counts as an opening, metres."""
    behind: float = 0.06
    """Distance behind the wall's line at which a segment proves an opening, metres."""
    min_remainder: float = 0.15
    """Shortest part of a segment that is kept after a part of it was removed, metres."""
    driven_end: float = 0.1
    """A segment may reach this far into the way of the robot, metres; footpoints scatter beyond the ends of walls."""
    door_time: float = 300.0
    """A wall that was observed at most this long after the robot drove through it is none, seconds; later it may be a
    door that was closed."""
    unseen_end: float = 0.15
    """Length by which a wall may extend beyond its last footpoint without a corner that ends it, metres."""
    max_extension: float = 1.5
    """Largest distance from the last footpoint of a wall to the corner that ends it, metres."""
    gap_samples: int = 16
    """Points of a gap at which the free space is looked up."""


@dataclass(frozen=True)
class EndpointSettings:
    """Wall ends at corners and edges."""

    max_overshoot: float = 0.2
    """Length by which the footpoints may lie beyond the true end of a wall, metres; echoes of the edge are sometimes
    assigned to the wall."""
    alignment_floor: float = 0.01
    """Standard deviation of the distance between a wall's line and the corner that ends it, metres."""
    constraint_sd: float = 0.005
    """Standard deviation that a corner adds when it constrains a wall's line, metres."""
    max_point_sd: float = 0.1
    """A point with a larger standard deviation ends no wall, metres."""
    max_unobserved: float = 0.3
    """Largest distance from the last footpoint of a wall to the edge that ends it, if nothing else shows that the wall
    goes on until there, metres."""
    min_end_probability: float = 0.8
    """Probability of corner or edge from which on an undecided reflector ends a wall."""
    face_margin: float = 0.1
    """Distance from the ends of a wall, and from other walls, at which its face begins, metres."""
    face_depth: float = 0.03
    """A point closer to the line of a wall than this lies on its face, metres."""


@dataclass(frozen=True)
class FreeSpaceSettings:
    """Directional free space from missing echoes."""

    cell: float = 0.1
    """Side of a cell of the floor, metres."""
    directions: int = 36
    """Number of sectors into which the directions of wall normals are divided."""
    remembered: int = 3
    """Number of latest times that each cell and direction stores. A wall that this many later scans saw through is
    gone."""
    margin: float = 0.10
    """A wall must be closer than the first echo by this much before it counts as missed, metres."""
    certain: float = 0.85
    """Fraction of the cone's width, and of the maximum range, within which a wall is always detected."""
    extension: float = 1.0
    """Length by which a wall is assumed to extend beyond its ends, where it occludes what is behind it, metres."""
    facing: float = float(np.radians(15.0))
    """A ray within this angle of a wall's normal faces the wall, radians."""
    tile_cells: int = 32
    """Cells along the side of a storage tile."""
    rays: int = 17
    """Rays sampled across a cone."""
    arc_points: int = 33
    """Points sampled on the arc of an echo."""

    @property
    def sector(self) -> float:
        """Width of a sector of directions, radians."""
        return 2 * np.pi / self.directions


@dataclass(frozen=True)
class HoughMergingSettings:
    """The paper's merging in parameter space."""

    rho_cell: float = 0.10
    """Cell size in rho, metres (paper, section 5; the cell size in theta is 0.0628 rad)."""
    threshold: float = 0.1
    """Threshold on the low-passed number of lines. A single line leaves a quarter in its cell and must not be lost."""
    max_rho_cells: int = 8192
    """Largest accumulator; larger clusters get coarser cells."""
    cells_per_step: int = 2_000_000
    """Accumulator cells that are processed in one compiled step; limits memory."""


@dataclass(frozen=True)
class SupportSettings:
    """Likelihood of single measurements with and without a wall.

    The measured values come from recorded runs of a robot with eight narrow sonars, against its laser. Changing any of
    the values by a third changed the mean precision and coverage of the maps of two of these runs by at most 0.03.
    """

    sigma: float = 0.025
    """Standard deviation of ranges about a wall, metres, if none is given. Measured: 21 to 41 mm along whole runs,
    mostly because range scale and offset of the sensors are not calibrated."""
    gate: float = 2.5
    """An echo fits a wall if it deviates by at most this, standard deviations."""
    detection: float = 0.92
    """Probability of an echo from a wall that a sensor faces exactly. Measured: 0.87 to 0.97 within 5 degrees."""
    detection_weight: float = 20.0
    """Number of measurements as which this value counts when it is estimated from the walls of a log, ..."""
    min_detection: float = 0.6
    """... the lower limit of the estimate, ..."""
    max_detection: float = 0.97
    """... and the upper one."""
    beam_factor: float = 1.6
    """Angle at which this probability has fallen to 1/e, in halves of the nominal beam. Measured with beams of 30
    degrees: 0.65 to 0.75 at 10 to 15 degrees."""
    beam_margin: float = float(np.radians(10.0))
    """Walls are observed up to this far outside of the nominal beam, radians. Measured with beams of 30 degrees: up to
    0.84 at 20 to 25 degrees."""
    too_short: float = 0.24
    """Share of the echoes of a wall that are too short, because of frames, posts and persons. Measured."""
    heard: float = 0.7
    """Share of the measurements without a wall that hear something within the maximum range."""
    certain: float = 0.9
    """Fraction of the maximum range within which a wall is observed."""
    min_distance: float = 0.05
    """Smallest distance between a sensor and a wall, metres."""


@dataclass(frozen=True)
class GrowthSettings:
    """Growth of walls over single measurements."""

    cell: float = 0.05
    """Cells along the line, metres."""
    footprint: tuple[float, ...] = (0.25, 0.5, 0.25)
    """Share of an echo's evidence for each cell around its foot: the first Fresnel zone is 0.1 m wide at 1 m."""
    cost: float = 4.0
    """Log-likelihood that each metre beyond the known wall costs, nats. A single echo bridges 0.6 to 0.8 m."""
    max_gain: float = 3.5
    """Largest log-likelihood ratio of a single echo, nats."""
    switch: float = 2.5
    """Log-likelihood that each end of a wall costs, nats: an opening needs two or three independent observations."""
    driven_cost: float = 10.0
    """Log-likelihood that a cell costs in which the robot was, nats."""
    reach: float = 3.0
    """Length by which a wall may grow at each end in one iteration, metres."""
    iterations: int = 2
    """Iterations of growth and fit."""
    min_score: float = 9.0
    """Log-likelihood ratio that a wall must have, nats: three independent echoes."""
    min_echoes: int = 4
    """Echoes that a wall must have: two determine its line, and a third may lie on it by chance."""
    min_length: float = 0.2
    """Shortest wall, metres."""
    short: float = 1.0
    """Lines below this length may be artifacts: of corners, edges, and obstacles at several distances, metres."""
    short_share: float = 0.7
    """Mean evidence of the independent echoes of a short wall, minus that against it, as a share of the largest
    evidence that an echo can have. Chosen on simulated corridors with recesses: 30 % of the length below this share is
    not on a wall, 12 % of the length above it. Two recorded runs, whole and in halves, confirm it."""
    corner_share: float = 0.75
    """Share of a line's echoes that a corner or an edge must explain before the line is dropped."""
    hidden_depth: float = 0.15
    """A wall hides what is behind it by more than this, metres."""
    refit_iterations: int = 8
    """Iterations of the fit of a line."""
    direction_prior: float = float(np.radians(30.0))
    """Standard deviation of a rotation in one iteration of the fit, radians; guards echoes from a single position."""
    variance_floor: float = 0.003
    """Standard deviation that is added to the scatter of the ranges, metres: ranges are rounded to 10 mm."""


@dataclass(frozen=True)
class MappingSettings:
    """All settings of map building."""

    segments: SegmentSettings = field(default_factory=SegmentSettings)
    """Wall segments of single local models."""
    points: PointSettings = field(default_factory=PointSettings)
    """Corners and edges."""
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)
    """Collection of evidence."""
    fusion: FusionSettings = field(default_factory=FusionSettings)
    """Fusion of segments into walls."""
    artifacts: ArtifactSettings = field(default_factory=ArtifactSettings)
    """Removal of what is not a wall."""
    endpoints: EndpointSettings = field(default_factory=EndpointSettings)
    """Wall ends at corners and edges."""
    free_space: FreeSpaceSettings = field(default_factory=FreeSpaceSettings)
    """Directional free space."""
    support: SupportSettings = field(default_factory=SupportSettings)
    """Likelihood of single measurements."""
    growth: GrowthSettings = field(default_factory=GrowthSettings)
    """Growth of walls over single measurements."""
    hough: HoughMergingSettings = field(default_factory=HoughMergingSettings)
    """The paper's merging."""


SETTINGS = MappingSettings()
"""The settings in use."""
