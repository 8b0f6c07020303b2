"""Numeric settings of the health check. Unless a field says otherwise, its value was chosen by hand on simulations."""

from dataclasses import dataclass, field

import numpy as np

from jaxsonar.detection.settings import MIN_SIGMA


@dataclass(frozen=True)
class ReferenceSettings:
    """Reference walls, and the comparison of echoes with them."""

    max_scans: int = 1000
    """Number of scans that are analysed; longer logs are sampled evenly."""
    block_scans: int = 32
    """Scans per compiled step."""
    piece_groups: tuple[int, int] = (2, 6)
    """Groups of ``pose_agreement`` that make one piece of the trajectory: up to 1.6 m; up to 5 m to compare what
    explains the echoes of a sensor, because sensors see the same walls on such a way only."""
    scans_of_group: int = 20
    """Largest number of scans of a piece for each of its groups."""
    min_share: float = 0.6
    """Walls of single scans as a share of those that the poses gather, from which on the poses are not used."""
    min_echoes: int = 3
    """Echoes that support a reference wall, and sensors that took part in them."""
    min_walls: int = 5
    """Number of reference walls below which single scans are not used. One wall per ten scans is needed, too."""
    walls_of_piece: tuple[int, int] = (8, 14)
    """Largest number of reflectors of a piece of the trajectory, for the same two lengths."""
    default_sigma: float = 0.01
    """Standard deviation of the ranges where it is unknown, metres."""
    min_sigma: float = MIN_SIGMA
    """Lower limit of the noise where it is unknown, metres."""
    end_margin: float = 0.25
    """Length that a wall is assumed to extend beyond its outermost footpoints, unless another wall ends it, metres."""
    support_gate: float = 0.04
    """Residual up to which an echo supports a wall that the poses gather, metres."""
    apart: float = 1e4
    """Distance between the scales of two walls where their lengths share one axis, metres."""
    range_margin: float = 0.02
    """Predicted echoes this close to the maximum range are left out, metres. Also the depth behind another wall from
    which on a point of reflection is occluded."""
    min_wall_angle: float = 0.1
    """A wall occludes only walls whose direction differs by more than this, radians."""


@dataclass(frozen=True)
class DetectionCheckSettings:
    """Which expected echoes were detected."""

    min_independent_echoes: int = 3
    """Echoes that must support a wall besides those of the sensor that is judged."""
    blanking: float = 0.06
    """Distance behind an echo in which another echo may be missed, metres."""
    gate: float = 4.0
    """An echo within this many standard deviations of the expected range is a detection."""
    gate_margin: float = 0.003
    """Added to the gate, metres."""
    explained_gate: float = 3.0
    """An echo within this many standard deviations of a reflector is explained by it."""
    explained_margin: float = 0.002
    """Added to that gate, metres."""
    default_sigma: float = 0.005
    """Standard deviation of the ranges where it could not be estimated, metres."""
    min_visibility: float = 0.95
    """Visibility from which on a wall is well inside both cones."""
    max_beyond_end: float = 0.01
    """Largest distance of such a point of reflection from the wall's ends, metres."""
    min_residuals: int = 5
    """Number of residuals needed for their median and scatter."""


@dataclass(frozen=True)
class OffsetSettings:
    """Estimation of range offsets."""

    gate: float = 0.1
    """An echo farther than this from the expected range of a wall does not come from it, metres."""
    min_visibility: float = 0.2
    """Least visibility of a wall whose echo is used."""
    min_independent_echoes: int = 2
    """Echoes of other sensors that support such a wall: one that only the sensor itself hears tells nothing."""
    iterations: int = 12
    """Iterations of the reweighted least squares."""
    initial_noise: float = 0.01
    """Standard deviation of the residuals before the first iteration, metres."""
    tukey: float = 4.685
    """Tuning constant of Tukey's biweight, standard deviations: 95 % efficiency for normally distributed errors."""
    prior_information: float = 400.0
    """Inverse variance of the prior of offsets and walls: 50 mm, 0.05 rad."""
    min_echoes: int = 16
    """Echoes (direct ones count twice) that the offset of a sensor needs."""
    min_stretches: float = 2.5
    """Stretches of the trajectory that a standard error needs, if poses gather the walls."""
    pooled_stretches: float = 3.0
    """The mean scatter between stretches of all sensors counts as much as this many stretches of a sensor."""
    tail_sigmas: float = 3.5
    """Standard errors from few stretches are larger, so that this many of them mean the same as of many."""
    weak_information: float = 0.03
    """Directions with less than this fraction of the median information are not observable."""
    sparsity_scale: float = 0.0005
    """Offsets below this are treated as zero when the sparsest solution is sought, metres."""
    sparsity_iterations: int = 30
    """Iterations of that search (iteratively reweighted least squares)."""


@dataclass(frozen=True)
class SwapSettings:
    """Search for exchanged sensors."""

    max_scans: tuple[int, int] = (100, 300)
    """Number of scans that are analysed; longer logs are sampled evenly. The second one counts if the poses gather the
    walls."""
    iterations: int = 3
    """Largest number of successive exchanges."""
    discount: float = 0.25
    """Fraction of the log-likelihood of a sensor at its own position that does not count in the search for candidates;
    exchanged sensors spoil the walls, which favors their wrong positions."""
    min_gain: float = 30.0
    """Log-likelihood ratio that an exchange must reach, also against rival exchanges, nats."""
    min_gain_each: float = 8.0
    """Log-likelihood ratio of the new to the old position that each exchanged sensor must reach, nats, ..."""
    min_share_each: float = 0.15
    """... and this share of its log-likelihood ratio to clutter at the new position."""
    extra_sigma: float = 0.002
    """Errors of walls and sensor positions, added to the noise in quadrature, metres; they must not look like an
    exchange."""


@dataclass(frozen=True)
class ConeSettings:
    """Measurement of the detection cones."""

    bin_width: float = float(np.radians(2.5))
    """Width of a bin of off-axis angles, radians."""
    bins: int = 72
    """Number of bins, from -90 to 90 degrees."""
    min_expected: int = 100
    """Expected echoes that the fit of the common cone needs."""
    min_detected: int = 30
    """Detected echoes that it needs."""
    min_per_side: int = 20
    """Expected echoes that it needs inside, and outside of the border."""
    max_error: float = float(np.radians(4.0))
    """Largest standard deviation of a width or direction that is reported, radians."""
    min_expected_each: int = 25
    """Expected echoes that the cone of a single sensor needs."""
    min_detected_each: int = 8
    """Detected echoes that it needs."""
    largest_beam: float = float(np.radians(175))
    """Largest width of a cone that is assumed after a measurement, radians."""
    alike: float = 0.2
    """Scatter of the widths of the cones of a ring, relative to their mean."""
    most_turn_deg: int = 60
    """Largest rotation of a single sensor that is tried, degrees."""
    lower_limits: tuple[float, float, float, float] = (float(np.radians(2)), float(np.radians(0.6)), 0.05, 0.0)
    """Lower limits of the fitted curve: half width and roll-off, radians; probability inside and outside the cone."""
    upper_limits: tuple[float, float, float, float] = (np.pi / 2, float(np.radians(15)), 1.0, 0.4)
    """Upper limits of the same."""
    start_half_widths_deg: tuple[float, ...] = (8, 15, 22, 30, 40, 55, 70)
    """Half widths at which the fit starts, degrees: the likelihood has local maxima."""
    start_shape: tuple[float, float, float] = (float(np.radians(3)), 0.85, 0.03)
    """Roll-off (radians) and probabilities inside and outside the cone at which the fit starts."""
    prior_information: tuple[float, float, float, float] = (3.6, 130.0, 4.0, 25.0)
    """Inverse variances of the curve's prior: standard deviations of 30 deg, 5 deg, 0.5 and 0.2."""


@dataclass(frozen=True)
class ExplanationSettings:
    """Comparison of explanations of the direct echoes of a sensor."""

    largest_gate: float = 0.04
    """An echo farther than this from the range of a wall is not explained by it, metres."""
    cone_margin: float = float(np.radians(3.0))
    """A wall this far inside the cone must be heard, one this far outside may be, radians."""
    block_scans: int = 10
    """Scans that count as one part of the trajectory: their errors are alike."""
    min_parts: int = 3
    """Parts of the trajectory that must support a fault, each by more than 1 nat."""
    most_offset: float = 0.1
    """Largest offset that is tried, metres."""
    min_sensors: int = 3
    """Sensors from which the usual rates are taken."""
    least_rate: float = 0.5
    """Usual rate of detection, and usual share of explained echoes of sensors that face a wall, that the comparison
    needs."""
    least_explained: float = 0.2
    """Usual share of explained echoes, whatever the sensors face, that it needs."""
    most_rate: float = 0.95
    """Both count as at most this."""
    fitting: float = 0.7
    """Share of its echoes, relative to the other sensors, that the right explanation explains at least, ..."""
    unfitting: float = 0.25
    """... and that a wrong one explains at most."""
    scatters: float = 3.0
    """A weak sensor is below the usual rate by this many standard deviations of the rates of the sensors."""
    dependent: float = 4.0
    """Echoes that share the errors of their walls: the likelihood is flatter by this factor for standard errors."""
    min_gain: float = 0.15
    """Share of the echoes of a sensor that an offset or a rotation must explain in addition."""
    most_suspects: int = 4
    """Sensors that are judged by walls without their own echoes, ..."""
    suspicious: float = 1.0
    """... if they fit worse than the others by this many standard deviations."""
    min_nats: float = 12.0
    """Log-likelihood ratio to a sound sensor that is reported, without the best part of the trajectory."""


@dataclass(frozen=True)
class FindingSettings:
    """Thresholds of the findings."""

    most_faulty: float = 0.34
    """Largest share of the sensors of which faults are sought one after another."""
    certain: float = 0.99
    """Confidence of what a strict test of its own has proven."""
    fine_resolution: float = 0.002
    """Ranges with a finer resolution than this do not stay the same by chance, metres."""
    floor_range: float = 0.5
    """A single sensor with a constant echo at more than this hears the floor rather than its own robot, metres, ..."""
    floor_sigma: float = 0.006
    """... if its ranges scatter by more than this, metres."""
    min_offset: float = 0.002
    """Smaller range offsets are never reported, metres."""
    min_offset_by_poses: float = 0.02
    """The same if the poses gather the walls, metres: their errors add to the residuals."""
    offset_sigmas: tuple[float, float] = (4.0, 3.5)
    """Range offsets that are reported are at least this many standard errors; the second one counts if the poses gather
    the walls: ``OffsetSettings.tail_sigmas``."""
    min_explained: float = 0.3
    """Fraction of echoes that reflectors must explain; below, the ring or the units are probably wrong."""
    min_expected: int = 8
    """Expected echoes that a detection rate needs."""
    min_echoes: int = 10
    """Echoes of the median sensor from which on a sensor without any is reported."""
    dead_rate: float = 0.05
    """A sensor with less than this fraction of the usual detection rate is dead."""
    min_elsewhere: float = 0.3
    """Echoes relative to the median sensor from which on a sensor without expected echoes is not dead."""
    weak_rate: float = 0.6
    """A sensor with less than this fraction of the usual detection rate is weak."""
    min_repeats: float = 0.3
    """Fraction of repeated ranges above which a sensor is stale; at least three times the usual fraction, too."""
    min_samples: int = 20
    """Ranges, or pairs of consecutive ranges, that a fraction of them needs."""
    min_constant: float = 0.25
    """Fraction of identical ranges above which a sensor saturates; at least four times the usual fraction, too."""
    min_turn_deg: float = 10.0
    """Rotation of a sensor that is reported, degrees; at least four standard deviations, and four times the scatter of
    all sensors, too."""
    min_turn_nats: float = 10.0
    """Least log-likelihood ratio of that rotation to none."""
    min_weak: int = 6
    """Expected direct echoes that tell a weak sensor, besides those of the wall of which it missed the most."""
    min_asymmetry: float = 8.0
    """Least log-likelihood ratio of a deaf or mute sensor to one that sends and receives equally well, nats."""
    min_reciprocal: float = 0.5
    """Share of the pairs of sensors with echoes in both directions that this comparison needs."""
    deaf_rate: float = 0.25
    """A sensor is deaf or mute if it has less than this fraction of cross echoes in one role."""
    min_beam_deg: float = 5.0
    """Deviation of the cone width that is reported, degrees; at least three standard deviations, too, ..."""
    min_beam: float = 0.25
    """... and at least this share of the width."""
    most_beam: float = 2.5
    """Largest width that counts as measured, relative to the stated one: wrong walls give wider cones still."""
    min_faced: int = 3
    """Expected echoes that a sensor without any echo needs to be dead, if the poses gather the walls."""


@dataclass(frozen=True)
class DiagnosticsSettings:
    """All settings of the health check."""

    reference: ReferenceSettings = field(default_factory=ReferenceSettings)
    """Reference walls."""
    detection: DetectionCheckSettings = field(default_factory=DetectionCheckSettings)
    """Which expected echoes were detected."""
    offsets: OffsetSettings = field(default_factory=OffsetSettings)
    """Range offsets."""
    swaps: SwapSettings = field(default_factory=SwapSettings)
    """Exchanged sensors."""
    cones: ConeSettings = field(default_factory=ConeSettings)
    """Detection cones."""
    alternatives: ExplanationSettings = field(default_factory=ExplanationSettings)
    """Explanations of the echoes of a sensor."""
    findings: FindingSettings = field(default_factory=FindingSettings)
    """Findings."""


SETTINGS = DiagnosticsSettings()
"""The settings in use."""
