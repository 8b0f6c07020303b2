"""Settings of the two registration methods. Lengths in metres, angles in radians, evidence in nats."""

from dataclasses import dataclass

import numpy as np

from jaxsonar.detection.settings import DEFAULT_SIGMA


@dataclass(frozen=True)
class FeatureRegistrationSettings:
    """Registration of a scan to a map by walls, corners and edges. Chosen by hand on simulated rooms."""

    wall_sd_floor: tuple[float, float] = (0.02, float(np.radians(1.0)))
    """Noise added to walls, because the ring may not be calibrated yet: across the wall (m) and of its direction
    (rad), one standard deviation."""
    point_sd_floor: float = 0.03
    """The same for each coordinate of a point, metres."""
    full_weight_echoes: int = 6
    """A wall with this many echoes has weight 1."""
    min_weight: float = 0.3
    """Weight of a wall with very few echoes."""
    crossing_sine: float = 0.3
    """Two walls are not parallel if the sine of the angle between them is larger."""
    position_tolerance: float = 0.15
    """Two positions agree within this distance, metres."""

    gate: float = 14.0
    """Largest squared Mahalanobis distance of a wall or point from the one that it is matched to."""
    extension_scale: float = 1.0
    """A wall may continue beyond its observed part: one nat is lost for every such length of gap, metres."""
    max_extension: float = 2.5
    """No wall continues further than this without being observed, metres."""
    wall_offset_range: float = 2.0
    """Range over which chance would distribute the distance of a wall, metres."""
    point_area: float = 12.0
    """Area over which chance would distribute a point, square metres."""
    point_weight: float = 0.5
    """Weight of points, because their kind may be wrong."""
    new_wall_probability: tuple[float, float] = (0.3, 0.7)
    """Bounds of the probability that a wall was not observed before."""
    right_angle_probability: float = 0.7
    """Probability that a new wall is parallel or perpendicular to known walls."""

    blocked_sight_nats: float = 3.0
    """Penalty for a wall between the robot and what it detected, and for a robot on a wall."""
    detection_probability: float = 0.87
    """Probability that a wall is detected if it faces the robot within the reliable range."""
    single_scan_detection_penalty: float = 0.1
    """Reduction of the detection probability for walls that only one scan observed."""
    min_wall_distance: float = 0.15
    """A robot is never nearer to a wall, metres."""
    min_detection_range: float = 0.2
    """Nearer walls need not be detected, metres."""
    detection_match: tuple[float, float] = (0.12, float(np.radians(15.0)))
    """A detection this near to a wall in distance (m) and direction (rad) may come from it."""
    sight_margin: float = 0.05
    """Distance by which a line of sight must pass through a wall, and from the ends of its observed part, metres."""
    range_quantile: float = 0.98
    """Quantile of all detected distances that serves as the sensors' range."""
    reliable_range_fraction: float = 0.85
    """Fraction of that range within which walls are surely detected."""

    odometry_sd: float = 0.05
    """Standard deviation of odometry, as a fraction of the distance travelled and of the rotation."""
    odometry_sd_floor: tuple[float, float] = (0.005, float(np.radians(0.5)))
    """Standard deviation of odometry at rest: position (m) and heading (rad)."""
    odometry_failure: float = 0.01
    """Probability that the odometry between two scans is wrong altogether."""
    step_sd: float = 0.5
    """Standard deviation of the displacement between two scans without odometry, metres."""
    turn_sd: float = float(np.radians(30.0))
    """Standard deviation of the rotation between two scans without odometry, radians."""
    any_turn: float = 0.05
    """Probability that a rotation is uniformly distributed instead."""
    prior_motions: float = 4.0
    """Number of observed motions that weigh as much as ``step_sd`` and ``turn_sd``."""

    min_point_distance: float = 0.3
    """Two points this near to each other do not determine a heading, metres."""
    same_rotation: float = float(np.radians(7.0))
    """Two walls suggest the same heading if their headings differ by less, radians."""
    refined_poses: int = 64
    """Number of hypotheses that are refined."""
    refinement_steps: int = 4
    """Gauss-Newton steps of the refinement."""
    distinct_pose: tuple[float, float] = (0.2, float(np.radians(10.0)))
    """Poses that differ by more are different answers: position (m), heading (rad)."""
    max_pose_sd: tuple[float, float] = (0.12, float(np.radians(5.0)))
    """Largest standard deviations of a registered pose: position (m), heading (rad)."""
    margin: float = 4.0
    """Log-likelihood ratio by which the best pose must beat every different pose, nats."""
    margin_per_gap: float = 1.0
    """Increase of the margin for every scan between this scan and the nearest registered one, nats."""
    max_unregistered: int = 5
    """Number of consecutive unregistered scans after which a new map is started."""


@dataclass(frozen=True)
class RangeRegistrationSettings:
    """Agglomerative registration by ranges, without odometry.

    All values were chosen by hand on the office without odometry (range noise 5 mm, seeds 0 to 5).
    """

    default_sigma: float = DEFAULT_SIGMA
    """Standard deviation of the ranges if no local model has an estimate, metres."""
    decided_probability: float = 0.8
    """Probability of the kind "plane" for a line of a local model."""
    min_kind_probability: float = 0.02
    """Lower bound of the probability of every kind."""
    group_gate: float = 3.5
    """Echoes farther off in range (in sigma) do not belong to the reflector."""
    group_significance: float = 0.003
    """A group of echoes is rejected if its chi-square is less probable than this."""
    group_steps: int = 6
    """Gauss-Newton steps of the fit of one group of echoes."""
    group_scales: tuple[float, float] = (8.0, 3.0)
    """First and last scale of the robust weights of that fit, in sigma."""
    fit_damping: float = 10.0
    """Information added to both parameters of a reflector in its fit, in units of sigma."""
    fit_max_step: float = 0.1
    """Largest change of a parameter in one step of that fit, metres or radians."""
    echoes_per_path: int = 4
    """Number of echoes that are kept of each path, the nearest first."""

    plane_range: float = 1.0
    """Parameter space over which chance would distribute a wall, m rad: most walls are perpendicular to others."""
    point_area: float = 4.0
    """Area over which chance would distribute a point, square metres."""
    gate: float = 4.0
    """Range residuals beyond this many sigma count as false echoes."""
    corner_tolerance: float = 0.1
    """Largest distance of a corner from the walls that form it, metres."""
    kind_prior_weight: float = 0.5
    """Weight of the kind probabilities of the local models; their residuals are counted again here."""
    max_step: float = 0.2
    """Largest change of a parameter in one Gauss-Newton step, metres or radians."""
    pose_information: tuple[float, float, float] = (1.0, 1.0, 0.3)
    """Weak prior information of poses (x, y, theta); it keeps undetermined directions where they are."""
    fixed_information: float = 1e10
    """Prior information of the pose that is held fixed."""
    landmark_information: float = 1e-2
    """Weak prior information of reflector parameters."""
    kind_steps: tuple[int, int] = (6, 3)
    """Gauss-Newton steps of the reflectors alone, for the first time and later."""
    joint_steps: int = 7
    """Gauss-Newton steps of poses and reflectors together."""
    alternations: int = 3
    """Alternations between the choice of kinds and the joint adjustment."""

    margin: float = 6.0
    """Log-likelihood ratio by which an alignment must beat every different alignment, nats."""
    unrelated_cost: float = 3.0
    """Cost of two consecutive scans having no reflector in common, nats."""
    undetermined_cost: float = 2.0
    """Increase of the margin against an alignment that leaves a direction undetermined and contains the best one."""
    max_scan_gap: int = 2
    """Largest difference of the scan numbers of two clusters that are aligned."""
    steady_probability: float = 0.4
    """Probability that the robot continues its previous motion."""
    steady_sd: tuple[float, float] = (0.12, float(np.radians(12.0)))
    """Standard deviations of that motion per scan: position (m), heading (rad)."""
    distinct_pose: tuple[float, float] = (0.1, float(np.radians(5.0)))
    """Poses that differ by more are different: position (m), heading (rad)."""
    max_pose_sd: tuple[float, float] = (0.1, float(np.radians(4.0)))
    """Largest standard deviations of a determined pose: position (m), heading (rad)."""
    refined_poses: int = 200
    """Number of hypotheses that are refined by features."""
    adjusted_poses: int = 12
    """Number of hypotheses that are then adjusted by ranges."""
    split_nats: float = 3.0
    """Increase of the cost of a merged reflector's echoes from which splitting it again is tried, nats."""
    viable_nats: float = 6.0
    """A kind is considered for matching if its log-evidence is within this of the best kind, nats."""
    kind_weight: float = 0.3
    """Factor on the log-evidence difference between kinds when it is used as a weight."""
    max_motion: float = 3.0
    """Largest motion between consecutive scans, in standard deviations."""
    pose_cell: tuple[float, float] = (0.05, float(np.radians(2.0)))
    """Cell of the hypotheses: one pose is kept in each (m, rad)."""
    slide_step: float = 0.08
    """Spacing of hypotheses along one wall, metres."""
    pose_resolution: tuple[float, float, float] = (0.01, 0.01, 0.01)
    """Poses nearer than this are the same (m, m, rad)."""
    feature_sd_floor: tuple[float, float, float] = (0.006, float(np.radians(0.4)), 0.01)
    """Noise added to features: walls across (m) and direction (rad), points (m)."""
    uncertain_kind_sd: tuple[float, float, float] = (0.02, 0.06, 0.05)
    """Standard deviations of a reflector used as the less likely kind: as wall across (m), direction (rad), as point
    (m)."""
    max_point_sd: float = 0.1
    """Upper bound of the standard deviation of points, metres."""
    match_gate: float = 20.0
    """Largest squared Mahalanobis distance of two reflectors that may be the same."""
    max_match_gap: float = 2.5
    """Largest gap between the observed parts of one wall, metres."""
    match_rounds: int = 5
    """Iterations of matching and adjustment."""
    feature_steps: int = 4
    """Gauss-Newton steps by features."""
    feature_max_step: float = 0.15
    """Largest such step, metres and radians."""
    slide_deviations: tuple[float, ...] = tuple(np.linspace(-2.0, 2.0, 9).tolist())
    """Positions along an undetermined direction at which negative evidence is evaluated, standard deviations."""

    min_due_paths: int = 4
    """Number of paths that must miss a reflector before that counts."""
    missed_fraction: float = 0.4
    """Fraction of the due paths that must miss it."""
    missed_path_nats: float = 0.4
    """Negative evidence of each path that misses a reflector, nats; half for corners."""
    max_missed_nats: float = 4.0
    """Bound of the sum for one scan and one reflector, nats."""
    blocked_sight_nats: float = 4.0
    """Negative evidence of a wall in the line of sight, nats."""
    max_reflector_nats: float = 8.0
    """Bound of the negative evidence against one reflector, nats."""
    min_wall_distance: float = 0.2
    """A robot is never nearer to a wall, metres."""
    straight_scans: int = 2
    """Between scans at most this far apart the robot moves about straight."""
    unassigned_probability: float = 0.5
    """Probability that an unassigned echo comes from a known reflector."""
    max_unassigned_nats: float = 5.0
    """Bound of the evidence of unassigned echoes for one scan and one reflector, nats."""
    inner_cone: float = 0.7
    """Squared chord off the beam axis, relative to the cone edge: surely detected within."""
    outer_cone: float = 1.3
    """The same limit for echoes that may be detected."""
    reliable_range_fraction: float = 0.9
    """Fraction of the maximum range within which reflectors should be detected. Cones are tested exactly here, so it is
    larger than for registration by features."""
    range_tolerance: float = 0.03
    """A reflector counts as detected within this and three sigma, metres."""
    masked_range: float = 0.05
    """Echoes this far behind another echo are masked, metres."""
    sight_margin: float = 0.06
    """Distance by which a line of sight must pass through a wall, metres."""
    due_margin: float = 0.03
    """Distance from the ends of the observed part within which a wall is not due, metres."""
    unassigned_margin: float = 0.3
    """Distance beyond the observed part at which a wall may explain an unassigned echo, metres."""
    front_margin: float = 0.1
    """A sensor is in front of a wall from this distance, metres."""
    max_range_sd: float = 0.02
    """Upper bound of the standard deviation of a predicted range, metres."""


FEATURE_SETTINGS = FeatureRegistrationSettings()
RANGE_SETTINGS = RangeRegistrationSettings()
