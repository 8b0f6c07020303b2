"""Constants of the maximum-likelihood detector: the prior of rooms and rings, and how the evidence is weighted."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class DetectionSettings:
    """Constants of the maximum-likelihood detector.

    Unless noted otherwise, prior and weights were tuned on random rooms (``jaxsonar.random_room``). They matter where
    the ranges do not determine what a reflector is, and hardly elsewhere. Evidence is in nats (natural logarithms of
    likelihood ratios).
    """

    # Sizes

    candidates: int = 20
    """Maxima of the accumulator that are fitted as planes."""
    hypotheses: int = 12
    """Candidates, the best ones, that are evaluated as plane, corner and edge."""
    reflectors: int = 10
    """Largest number of reflectors of a scan."""
    passes: int = 4
    """Passes over the scan: evaluate, select, update the estimate of the scene; chosen by hand."""
    refinement_steps: int = 2
    """Gauss-Newton steps of every hypothesis in each pass; chosen by hand."""
    joint_steps: int = 2
    """Gauss-Newton steps of the joint refinement of the selected reflectors; chosen by hand."""
    second_order_walls: int = 7
    """Reflectors, those with the most evidence, between which second-order echoes are predicted; chosen by hand."""

    second_order_sd: float = 0.002
    """Standard deviation of predicted second-order ranges, metres, in addition to two sigma; chosen by hand."""

    # Candidates and their fit

    peak_threshold: float = 0.1
    """Occupancy of a candidate, as a fraction of the votes of a fully visible wall."""
    fit_tolerance: float = 2.5
    """Tolerance of the robust fit, in standard deviations of the ranges; chosen by hand."""
    fit_initial_scale: float = 0.04
    """Scale of the loss in the first step of the plane fit, metres: the size of an accumulator cell."""
    duplicate_rho: float = 0.005
    """Candidates whose fitted planes are closer than this in rho (metres) and theta are one; chosen by hand."""
    duplicate_theta: float = 0.01
    """The same in theta, radians."""
    max_refinement: float = 0.05
    """Largest change of a parameter in a refinement step, metres or radians; chosen by hand."""

    # Noise, clutter and missed detections

    initial_sigma: float = 0.003
    """First guess of the standard deviation of the ranges where it is estimated, metres."""
    sigma_weight: float = 6.0
    """Weight of the previous pass's sigma in the new estimate, in echoes."""
    min_sigma: float = 1e-4
    """Smallest standard deviation, metres: the limit of single precision and of sensors."""
    min_echoes_for_sigma: int = 4
    """Echoes that a wall needs to contribute to the estimate of sigma; chosen by hand."""
    clutter_density: float = 0.5
    """Echoes per metre and path without an explanation."""
    detection_probability: float = 0.8
    """Prior of the probability that an echo inside both cones is received."""
    detection_weight: float = 8.0
    """Weight of this prior, in paths."""
    detection_bounds: tuple[float, float] = (0.3, 0.97)
    """Bounds of the estimated detection probability; chosen by hand."""
    certain_visibility: float = 0.95
    """Visibility above which a path counts for the estimate of the detection probability; chosen by hand."""
    initial_threshold: float = -30.0
    """First guess of the level of the faintest wall echoes outside the cones, dB (``detection_cones.echo_level``). No
    echo is expected there until the threshold is estimated. Chosen by hand."""
    thresholds: tuple[float, ...] = (-6.0, -10.0, -14.0, -18.0, -22.0, -26.0, -30.0, -34.0, -38.0)
    """Thresholds, beside infinity, among which the most likely one is chosen for each scan, dB."""
    outside_cones: float = 0.05
    """Visibility below which a path counts as outside of the cones; chosen by hand."""
    stray_probability: float = 0.01
    """Probability of an echo below the threshold, and of none far above it; chosen by hand."""
    blanking_distance: float = 0.035
    """Metres behind an echo in which a path cannot receive another one."""
    excuse_gate: float = 4.0
    """Standard deviations by which an echo may be behind a prediction and still count as received; chosen by hand."""
    range_margin: float = 1e-3
    """Metres below the maximum range, in addition to two sigma, from which on no echo is expected."""
    max_occlusion_cost: float = 6.0
    """Largest cost of missed detections, nats: another object may occlude the reflector."""
    max_occlusion_cost_outside: float = 20.0
    """The same where the ring receives echoes outside of its cones: many more paths would have to be occluded. Tuned,
    as the other constants of this case, on 32 random rooms with soft beams at 3 and at 5 mm."""
    max_faint_edge_cost: float = 1.0
    """Largest cost of missed detections far off the axes of an edge, nats: its echo may be too faint."""
    missed_weight_plane: float = 0.7
    """Weight of the missed detections of a wall; 1 where the ring receives echoes outside of its cones."""
    missed_weight_point: float = 1.15
    """Weight of the missed detections of a corner or an edge."""
    gap_visibility: float = 0.4
    """Visibility from which on a path without an echo limits the extent of a wall; chosen by hand."""
    wall_length: float = 2.0
    """Mean length of walls, metres: a wall ends within a gap g between two footpoints with probability g / length."""
    min_gap: float = 0.02
    """Smallest gap in which a wall can end, metres; chosen by hand."""
    loss_margin: float = 1e-3
    """Margin of the loss beyond the faintest echo of an edge, dB; a numerical tolerance."""
    footpoint_margin: float = 1e-3
    """Metres within which two footpoints coincide; a numerical tolerance."""

    # Prior

    expected_planes: float = 3.0
    """Mean number of walls in a scan."""
    expected_corners: float = 1.0
    """Mean number of right-angled corners in a scan."""
    expected_edges: float = 0.3
    """Mean number of edges and poles in a scan."""
    corner_fraction_isolated: float = 0.1
    """Fraction of the corners of which neither wall is detected."""
    corner_fraction_one_wall: float = 0.15
    """Fraction of the corners of which one wall is detected; for each wall."""
    corner_fraction_two_walls: float = 0.5
    """Fraction of the corners of which both walls are detected; for each pair of walls."""
    edge_fraction_isolated: float = 0.3
    """Fraction of the edges and poles that are not on the line of a wall."""
    aligned_fraction: float = 0.4
    """Prior of the fraction of the walls that are parallel or perpendicular to another one."""
    aligned_weight: float = 2.0
    """Weight of this prior, in walls."""
    aligned_sd: float = float(np.radians(0.5))
    """Standard deviation of right angles between walls, radians; chosen by hand."""
    right_angle_gate: float = 3.0
    """Standard deviations by which two walls with a corner between them may deviate from a right angle; chosen by
    hand."""
    same_wall_rho: float = 0.08
    """Metres within which, with ``same_wall_theta``, a hypothesis and a wall are the same; chosen by hand."""
    same_wall_theta: float = 0.15
    """The same in theta, radians."""
    oblique_angles: tuple[float, float] = (0.2, 2.2)
    """Angles between two walls, radians, at which they can meet in a corner; chosen by hand."""
    crossing_distance: float = 0.06
    """Metres within which the foot of a wall is on the line of another wall; chosen by hand."""
    crossing_penalty: float = 2.0
    """Cost of a wall whose foot is on the line of another wall, nats: it is probably a corner."""

    occluded_penalty: float = 40.0
    """Cost of a reflector behind a detected wall, nats: sound does not pass through walls. Chosen by hand."""
    occlusion_margin: float = 0.03
    """Metres by which a detected wall extends beyond its outermost echoes; chosen by hand."""
    edge_strength: tuple[float, float] = (-24.0, 8.0)
    """Mean and standard deviation of the level of an edge or a thin pole relative to that of a wall, dB: poles of 1 cm
    have -20 dB and edges -34 dB at 1 m (Keller's diffraction coefficient)."""
    max_strength_deviation: float = 3.5
    """Largest deviation from that level that counts, standard deviations; chosen by hand."""

    # Circles

    expected_circles: float = 0.02
    """Mean number of round columns in a scan."""
    circle_shape: tuple[float, float] = (0.75, 0.2)
    """Mean and standard deviation of the shape distance / (distance + radius) of a circle, between 0 (a plane) and 1 (a
    pole): radii from 5 cm to 1 m at 1 m. Chosen by hand."""
    circle_bounds: tuple[float, float] = (0.02, 0.98)
    """Bounds of the shape."""
    circle_starts: tuple[float, float, float] = (0.4, 0.6, 0.8)
    """First guesses of the shape of what was selected as plane, corner and edge; chosen by hand."""
    circle_steps: int = 8
    """Gauss-Newton steps of the fit of a circle; chosen by hand."""
    circle_initial_scale: float = 0.01
    """Standard deviation of the ranges in the first of these steps, metres; it is halved from step to step down to that
    of the ranges. Chosen by hand."""
    max_shape_step: float = 0.3
    """Largest change of the shape in a step; chosen by hand."""
    circle_strength_sd: float = 3.0
    """Standard deviation of the level of a circle about 10 log10(radius / (radius + distance)), dB; chosen by hand."""
    circle_handicap: float = 12.0
    """Nats by which a circle must be more likely than other kinds where the ring receives nothing outside of its cones:
    the levels of the echoes then do not tell it from a wall. Tuned on rooms without circles."""
    min_circle_echoes: int = 4
    """Echoes that a circle needs: three determine it."""
    min_circle_distance: float = 0.1
    """Smallest distance for the scale of the curvature, metres; chosen by hand."""

    # Selection

    prior_weight: float = 1.4
    """Weight of the logarithm of the prior."""
    full_wall_bonus: float = 10.0
    """Evidence of a wall that all its paths receive compared with one that none receives, nats: points have fewer
    echoes. 0 where the ring receives echoes outside of its cones, whose levels tell walls from points."""
    typical_fraction: float = 0.55
    """Fraction of the echoes of a full wall at which this bonus is zero: more than a point usually has."""
    min_evidence: float = 6.0
    """Evidence above clutter that a reflector needs, nats."""
    tempering: float = 0.44
    """Factor from nats to log odds of the kinds: the errors of echoes of one reflector are correlated."""
    plane_handicap: float = 2.5
    """Nats by which a plane must be more likely than a point for even odds: there are many points to choose from."""
    plane_handicap_outside: float = 4.5
    """The same where the ring receives echoes outside of its cones: walls have more echoes there and are decided
    nevertheless, whereas lone corners resemble walls. Chosen on 32 random rooms with soft beams at 3 and at 5 mm,
    confirmed on 32 others."""
