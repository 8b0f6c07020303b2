"""Settings of the localization in a known map. Lengths in metres, angles in radians."""

from dataclasses import dataclass

import numpy as np

from jaxsonar.detection.settings import DEFAULT_SIGMA


@dataclass(frozen=True)
class UpdateSettings:
    """Update of the hypotheses by one scan, and its evidence. Chosen by hand unless stated otherwise."""

    max_landmarks: int = 32
    """Number of landmarks that are considered from one pose, the nearest first."""
    iterations: tuple[int, int] = (9, 3)
    """Gauss-Newton steps before the last one, for the first scan of a track and for the others."""
    annealing_factor: float = 0.2
    """The weights of the echoes begin with the variance of the predicted pose; each step multiplies it by this."""
    max_innovation: float = 16.3
    """Squared Mahalanobis distance from the predicted pose (three degrees of freedom, 0.1 % of the right fits are
    farther) from which a fit is rejected. An error of the map is the same at all scans: it makes no pose jump."""
    known_share: float = 0.5
    """Prior probability that an echo comes from a landmark of the map."""
    independent_echoes: float = 2.0
    """The echoes of one landmark in one scan count as this many at most: they share its two parameters."""
    full_wall_share: float = 0.5
    """A wall or corner is surely observed by this fraction of the echoes that a long wall causes..."""
    min_full_echoes: float = 2.0
    """... but not by fewer echoes than this."""
    trust_echoes: float = 0.375
    """A landmark corrects the pose if it has more than this fraction of these echoes: a few fit by chance."""
    trust_slope: float = 8.0
    """Increase of its weight with that fraction, up to 1."""
    sight_margin: float = 0.12
    """Distance from the ends of a wall, and in front of a landmark, within which the wall does not hide it, metres;
    more than the thickness of a light wall would hide the jambs of a door."""
    hearing_threshold: float = -36.0
    """Level of the faintest echoes that are matched outside of the cones, dB (``kernels.detection_cones.echo_level``):
    a wall at 1 m up to 52 deg off the axes of 60 deg cones. Chosen by hand."""
    inner_cone: float = 0.7
    """Fraction of the detection cone in which an echo is surely received."""
    end_margin: float = 0.1
    """A wall surely answers from this distance within its ends, metres."""
    reliable_range_fraction: float = 0.85
    """Fraction of the maximum range up to which walls are surely detected."""
    missed_margin: float = 0.03
    """A path hears a wall if its first range is within this and three standard deviations of the expected one, m."""
    min_missed_paths: int = 2
    """Number of paths that must miss a wall before it counts as missed."""
    missed_share: float = 0.7
    """Fraction of the due paths that must miss it."""
    missed_nats: float = 2.0
    """Evidence against a pose for a missed wall: log of the probability that a drawn wall is not there (a closed door
    that is open, a wall behind a curtain)."""


@dataclass(frozen=True)
class MapTrust:
    """How far a map is trusted when places are compared."""

    stretch: float
    """Length of the trajectory that counts as one independent observation, metres."""
    wrong_share: float
    """Fraction of the stretches at which the map is wrong, so that nothing follows from them."""
    temperature: float
    """Factor by which the evidence of one scan is divided: its echoes and landmarks are not independent."""


@dataclass(frozen=True)
class LocalizationSettings:
    """Chosen by hand on the office and on rooms that look alike."""

    min_explained: tuple[float, float] = (0.3, 0.2)
    """Fraction of the echoes that the map must explain, for a search everywhere and for one near a start pose."""
    start_sd: tuple[float, float] = (0.25, float(np.radians(10.0)))
    """Standard deviations of a start pose that a person gives: position (m), heading (rad)."""
    start_gate: float = 3.5
    """Hypotheses are searched within this many standard deviations of a start pose."""

    first_scans: int = 12
    """Number of scans by which the first pose is found."""
    hypothesis_scans: int = 4
    """Number of scans, those with the most features, whose hypotheses are generated."""
    scoring_scans: int = 6
    """Number of scans, those with the most features, whose features score the hypotheses."""
    max_hypotheses: int = 24
    """Number of hypotheses that are tracked."""
    hypothesis_sd: tuple[float, float] = (0.05, float(np.radians(3.0)))
    """Standard deviations of a hypothesis before its ranges are used: position (m), heading (rad)."""
    hypothesis_cell: tuple[float, float] = (0.1, float(np.radians(4.0)))
    """One hypothesis is kept per cell before scoring (m, rad)."""
    refinement_steps: int = 4
    """Gauss-Newton steps of a hypothesis by features."""
    noise_scale: float = 0.5
    """Factor on the noise that is added to features (``scan_features``)."""
    pruning: float = 9.0
    """A hypothesis is dropped if it is behind the best by this many nats."""
    max_tracked: int = 48
    """Number of hypotheses that are tracked together."""
    chance_poses: int = 48
    """Number of poses all over the map whose evidence is that of chance: the best of ``max_hypotheses`` of them, ..."""
    chance_scans: int = 8
    """... at this many scans; in the others it is taken in proportion to the number of echoes."""
    none_share: float = 0.05
    """Prior probability that the robot is at none of the places of the map that are found."""
    plan_trust: MapTrust = MapTrust(1.0, 0.1, 4.0)
    """Trust in a floor plan: it shows doors open or closed, and no furniture. Chosen on 24 simulated drives through
    random plans that are wrong in this way, so that no wrong place is certain."""
    laser_trust: MapTrust = MapTrust(0.75, 0.03, 4.0)
    """Trust in a map of another sensor: it does not show what only sound meets, such as glass."""
    map_trust: MapTrust = MapTrust(0.5, 0.002, 4.0)
    """Trust in a map that was measured."""
    shown_probability: float = 0.01
    """Places that are less probable are not listed."""
    shown_places: int = 5
    """Number of places that are listed."""
    certain: float = 0.99
    """Probability from which a place is certain."""
    same_pose: tuple[float, float] = (0.25, float(np.radians(8.0)))
    """Hypotheses nearer to each other are merged if they are statistically the same: position (m), heading (rad)."""
    same_pose_sd: tuple[float, float] = (0.02, float(np.radians(1.0)))
    """Standard deviations that are added in this test: position (m), heading (rad)."""
    same_pose_chi2: float = 16.0
    """Squared Mahalanobis distance up to which two hypotheses are the same."""
    max_pose_sd: tuple[float, float] = (0.04, float(np.radians(2.0)))
    """Largest standard deviations of a determined pose: position (m), heading (rad)."""
    max_odometry_misfit: float = 4.0
    """Largest mean squared Mahalanobis distance of the steps of a certain track from the odometry. It is 3 if the map
    determines every pose exactly, and less otherwise."""
    later_groups: int = 4
    """Number of groups of ``first_scans`` later scans that contribute hypotheses."""
    later_hypotheses: int = 6
    """Number of hypotheses of each of these groups."""
    similar_hypotheses: int = 12
    """Number of hypotheses at places that look like the track of the best one."""
    seen_walls: int = 6
    """Number of walls, those with the most evidence, by which such places are found."""
    seen_points: int = 4
    """The same for points."""
    pruning_scans: int = 3
    """Hypotheses are merged and dropped after every so many scans."""
    turn_length: float = 0.3
    """Motion that a turn by one radian counts as, metres."""
    shared_length: float = 1.0
    """Length of the trajectory on which the scans share the error of a wall in the map, metres."""
    max_shared_views: float = 10.0
    """Largest number of scans that are taken to share it."""
    crossing_nats: float = 4.0
    """Evidence against a track for every passage through a wall: a door that the map shows closed."""
    crossing_margin: float = 0.15
    """A track nearer to the end of a wall does not pass through it, metres."""
    distance_rows: int = 256
    """Number of scans whose distances from all scans are computed together."""
    batch: int = 8
    """Number of hypotheses that are updated together; the last batch is padded."""
    min_echoes: int = 64
    """Smallest padded number of echoes of a scan."""
    default_sigma: float = DEFAULT_SIGMA
    """Standard deviation of the ranges if no local model has an estimate, metres."""

    default_map_sd: tuple[float, float] = (0.002, float(np.radians(0.1)))
    """Standard deviations of walls of a map without them: across (m), direction (rad)."""
    min_map_sd: tuple[float, float] = (1e-4, float(np.radians(0.005)))
    """Lower bounds of the standard deviations of walls: across (m), direction (rad)."""
    plan_sd: tuple[float, float] = (0.02, float(np.radians(0.3)))
    """Standard deviations of the walls of a floor plan: across (m), direction (rad). Plans and buildings agree within
    1 to 3 cm, and plaster is not plane."""
    exact_sd: float = 1e-5
    """A map whose walls and points have smaller standard deviations is a floor plan, metres."""
    min_landmarks: int = 64
    """Smallest padded number of landmarks; powers of two from there on are compiled."""
    wall_scans: float = 4.0
    """Number of scans that every wall of the map is taken to be observed by."""
    corner_gap: float = 0.05
    """Walls whose ends are this near form a corner, metres."""
    corner_angle: float = float(np.radians(3.0))
    """... if the angle between them differs from 90 degrees by less, radians."""


SETTINGS = LocalizationSettings()
UPDATE_SETTINGS = UpdateSettings()
