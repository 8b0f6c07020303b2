"""Settings of the localization in a known map. Lengths in metres, angles in radians."""

from dataclasses import dataclass

import numpy as np

from jaxsonar.detection.settings import DEFAULT_SIGMA


@dataclass(frozen=True)
class AcceptanceSettings:
    """When the best pose hypothesis is accepted."""

    margin: float
    """Log-likelihood ratio by which it must beat all others together, nats. Echoes of one wall are not independent."""
    margin_fraction: float
    """The margin grows by this fraction of its own log-likelihood ratio."""
    min_explained: float
    """Fraction of the echoes that the map must explain."""


@dataclass(frozen=True)
class LocalizationSettings:
    """Chosen by hand on the office and on rooms that look alike."""

    global_acceptance: AcceptanceSettings = AcceptanceSettings(20.0, 0.05, 0.5)
    """For a search without a start pose."""
    local_acceptance: AcceptanceSettings = AcceptanceSettings(6.0, 0.03, 0.2)
    """For a search near a start pose."""
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
    pruning: tuple[float, float] = (30.0, 0.2)
    """A hypothesis is dropped if it is behind the best by this many nats plus this fraction of the best one's nats."""
    same_pose: tuple[float, float] = (0.25, float(np.radians(8.0)))
    """Hypotheses nearer to each other are merged if they are statistically the same: position (m), heading (rad)."""
    same_pose_sd: tuple[float, float] = (0.02, float(np.radians(1.0)))
    """Standard deviations that are added in this test: position (m), heading (rad)."""
    same_pose_chi2: float = 16.0
    """Squared Mahalanobis distance up to which two hypotheses are the same."""
    max_pose_sd: tuple[float, float] = (0.03, float(np.radians(2.0)))
    """Largest standard deviations of a determined pose: position (m), heading (rad)."""
    default_sigma: float = DEFAULT_SIGMA
    """Standard deviation of the ranges if no local model has an estimate, metres."""
    echo_weight: float = 0.25
    """Weight of the log-likelihood of one echo; echoes of one wall are not independent."""

    default_map_sd: tuple[float, float] = (0.002, float(np.radians(0.1)))
    """Standard deviations of walls of a map without them: across (m), direction (rad)."""
    min_map_sd: tuple[float, float] = (1e-4, float(np.radians(0.005)))
    """Lower bounds of the standard deviations of walls: across (m), direction (rad)."""
    wall_scans: float = 4.0
    """Number of scans that every wall of the map is taken to be observed by."""
    wall_extension: float = 0.3
    """A wall is detected at most this far beyond its ends, metres."""
    corner_gap: float = 0.05
    """Walls whose ends are this near form a corner, metres."""
    corner_angle: float = float(np.radians(3.0))
    """... if the angle between them differs from 90 degrees by less, radians."""
    max_landmarks: int = 32
    """Number of landmarks that are considered from one pose, the nearest first."""


SETTINGS = LocalizationSettings()
