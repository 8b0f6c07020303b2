"""Settings of loop closure. Lengths in metres, angles in radians, evidence in nats."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class LoopClosureSettings:
    """Chosen by hand on simulated loops, twin rooms and bare corridors (``benchmarks.slam.accuracy``)."""

    # Selection of earlier submaps (submap_graph)
    max_compared: int = 4
    """Number of earlier submaps that are compared with a new one."""
    max_considered: int = 12
    """Number of nearest submaps among which they are selected."""
    recent_submaps: int = 5
    """Submaps up to this number before the new one. Of the compared submaps, at most half are recent."""
    enough_closures: int = 2
    """Stop after this many accepted closures per submap."""
    neighbors: int = 2
    """Number of submaps before and after a submap that contribute negative evidence."""
    overlap_sd: float = 3.0
    """Submaps may overlap if they do within this many standard deviations."""
    default_radius: tuple[float, float] = (2.0, 1.0)
    """Radius of a submap without poses, and distance of reflectors from the trajectory, metres."""

    # Pose candidates
    wall_sd_floor: tuple[float, float] = (0.03, float(np.radians(1.5)))
    """Noise added to walls while poses are rough: across (m) and direction (rad), one standard deviation."""
    point_sd_floor: float = 0.04
    """The same for points, metres."""
    candidate_cell: tuple[float, float] = (0.06, float(np.radians(2.0)))
    """One candidate is kept per cell (m, rad)."""
    max_scored: int = 1500
    """Number of candidates that are scored."""
    max_candidates: int = 16
    """Number of candidates that are returned; four times as many are refined."""
    candidate_steps: int = 3
    """Gauss-Newton steps of the refinement."""
    search_sd: float = 4.0
    """Candidates are searched within this many standard deviations of the prior."""

    # Matching of reflectors
    pair_gate: float = 14.0
    """Largest squared Mahalanobis distance of a pair."""
    max_wall_gap: float = 1.0
    """Largest gap between the observed parts of one wall, metres."""
    rejection_probability: float = 0.005
    """Probability with which the chi-square test of joint compatibility rejects correct pairs."""
    min_compatible_fraction: float = 2 / 3
    """Least fraction of the pairs that must be jointly compatible."""
    parallel_angle: float = float(np.radians(10.0))
    """Walls that differ by less in direction do not determine the position along them, radians."""
    max_pair_log_likelihood_ratio: float = 4.0
    """Bound of the log-likelihood ratio of one pair, nats."""
    fit_steps: int = 8
    """Maximum number of Gauss-Newton steps of a fit."""
    fit_tolerance: float = 1e-5
    """A fit ends with a smaller step, metres and radians."""

    # Sequential constraints
    sequential_steps: int = 3
    """Steps of the iterated Kalman update."""
    sequential_pose_sd: tuple[float, float] = (0.02, float(np.radians(1.0)))
    """Standard deviations of a pose candidate: position (m), heading (rad)."""
    sequential_distinct: tuple[float, float] = (0.04, float(np.radians(1.5)))
    """Two constraints differ if their poses differ by more: position (m), heading (rad)."""
    sequential_similarity: float = 0.5
    """A rival counts fully if its pairs have this fraction of the log-likelihood ratio of the best."""
    sequential_margin: float = 4.0
    """Log-likelihood ratio by which one constraint must beat all that differ, nats."""

    # Closure detection
    reliable_range: float = 1.5
    """Walls within this distance are surely detected, metres."""
    inflation: float = 1.5
    """Covariance inflation: standard deviations of the prior are taken this much larger than estimated."""
    rough_pose_sd: tuple[float, float] = (0.04, float(np.radians(1.5)))
    """Standard deviations of a pose candidate: position (m), heading (rad)."""
    min_log_likelihood_ratio: float = 8.0
    """Log-likelihood ratio by which the pairs must beat chance, nats."""
    min_pairs: int = 4
    """Minimum number of pairs."""
    min_corridor_pairs: int = 2
    """The same for a closure by parallel walls alone."""
    margin: float = 4.0
    """Log-likelihood ratio by which the best pose must beat every other one with matching reflectors, nats."""
    min_level_distance: float = 0.3
    """Pairs nearer to each other than this along an axis are redundant, metres."""
    max_negative_evidence: float = 4.0
    """Largest negative evidence against a closure, nats."""
    similarity: float = 0.4
    """A rival counts fully if its pairs have this fraction of the log-likelihood ratio of the best."""
    distinct_pose: tuple[float, float] = (0.08, float(np.radians(3.0)))
    """Poses that differ by more are rivals: position (m), heading (rad)."""
    distinct_chi2: float = 25.0
    """Rivals also differ by this squared Mahalanobis distance."""
    facing_angle: float = float(np.radians(45.0))
    """A wall determines an axis if its normal is within this angle of it."""
    opposite_angle: float = float(np.radians(150.0))
    """Walls on opposite sides of the robot have normals that differ by more."""
    corridor_angle: float = float(np.radians(5.0))
    """Walls of one corridor differ by less in direction."""

    # Perceptual aliasing
    aliasing_probability: float = 0.3
    """Probability that another place looks like a given one (perceptual aliasing)."""
    aliasing_spacing: float = 5.0
    """Distance between such places, metres."""
    max_log_odds: float = 9.0
    """Bound of the log-odds of a closure, nats: the robot may have slipped without notice."""
    grid_step: float = 0.4
    """Smallest pitch of the grid of alternative positions, metres."""
    grid_cells: int = 10
    """Half size of that grid, cells."""
    grid_tolerance: float = 0.3
    """Tolerance of the negative evidence on the grid, metres."""
    grid_log_range: float = 12.0
    """Cells whose prior density is lower by this many nats are ignored."""
    alternative_distance: float = 0.45
    """Alternative positions are at least this far from the closure, metres."""

    # Negative evidence
    viewpoints: int = 6
    """Number of positions on the trajectory of a submap that serve as viewpoints."""
    min_scans: int = 3
    """Number of scans that must have observed a reflector before its absence counts."""
    blocked_trajectory_nats: float = 6.0
    """Evidence against a wall across the trajectory, nats."""
    blocked_sight_nats: float = 3.0
    """Evidence against a wall in a line of sight, nats."""
    missed_nats: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0)
    """Evidence against a wall that was not detected from 0, 1, 2, and more viewpoints, nats."""
    corner_factor: float = 0.6
    """The same for corners, as a fraction."""
    edge_factor: float = 0.3
    """The same for edges, whose echoes are weak, as a fraction."""
    crossing_margin: float = 0.05
    """A blocked line passes through the wall by this distance, metres."""
    crossing_border: float = 0.1
    """A line is not surely blocked within this distance of the ends of the wall, metres."""
    robot_radius: float = 0.1
    """No wall is nearer to the center of the robot, metres."""
    min_range: float = 0.2
    """Nearer reflectors need not be detected, metres."""
    same_wall_angle: float = float(np.radians(15.0))
    """Walls may be the same if their directions differ by less, radians."""
    end_margin: float = 0.15
    """A wall is not surely detected within this distance of its ends, metres."""
    negative_evidence_tolerance: float = 0.1
    """Tolerance of the negative evidence at a fitted pose, metres."""

    # Verification
    refusal_probability: float = 1e-3
    """A candidate is refused if its chi-square under the graph is less probable."""
    withdrawal_probability: float = 1e-5
    """An accepted closure is withdrawn if its chi-square in the graph is less probable."""
    max_withdrawal_trials: int = 4
    """Number of closures with the largest chi-square whose removal is tried."""
    acceptance_log_odds: float = 6.9
    """Log-odds at which a single closure is accepted, nats (1000:1)."""
    confirmed_log_odds: float = 5.3
    """Log-odds at which a closure is accepted if others confirm it, nats (200:1)."""
    prediction_sd: float = 0.15
    """A closure confirms another one only if it predicts its position with this standard deviation, metres."""
    same_place: float = 3.0
    """Closures whose reflectors are nearer to each other concern one place and may share one aliasing error, metres."""
    max_undecided: int = 16
    """Number of the latest undecided candidates that are reconsidered."""


SETTINGS = LoopClosureSettings()
