"""Constants of the calibration of a ring."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class CalibrationSettings:
    """Constants of ``calibrate``. All of them were chosen by hand."""

    odometry_error: float = 0.02
    """Default standard deviation of odometry, as a fraction of displacement and rotation."""
    initial_scale: float = 0.04
    """Initial scale of the robust loss with given poses, metres."""
    initial_scale_registered: float = 0.08
    """Initial scale of the robust loss with poses from scan registration, metres."""
    registrations: tuple[tuple[float, float], ...] = ((1.0, 4.0), (0.2, 2.0), (0.2, 1.0))
    """Noise scale and margin (nats) of the successive scan registrations, the most cautious first; they end when all
    scans are registered."""
    min_scans: int = 3
    """Scans with a pose that a log needs."""
    max_sigma_growth: float = 1.15
    """A fit with a range noise larger by this factor has registered scans wrongly."""
    max_mean_offset_sd: float = 0.001
    """The mean range offset is estimated only if its standard deviation is at most this, metres."""
    min_second_order_echoes: int = 10
    """Second-order echoes that the mean range offset needs."""
    max_second_order_misfit: float = 1.5
    """Root mean square residual of second-order echoes in sigma, up to which the walls meet as mapped."""
    min_tied_fraction: float = 0.97
    """Echoes that must still be explained with corners tied to their walls, as a fraction of those without."""
    max_speed_change: float = 0.06
    """Largest relative change of the speed of sound; beyond, the ranges are no half path lengths of this ring."""
    max_offset: float = 0.06
    """Largest change of a range offset, metres; beyond, scans were registered wrongly."""
    min_explained: float = 0.15
    """Smallest fraction of echoes that the map must explain."""
    min_explained_of_alone: float = 0.4
    """Smallest fraction of echoes that the map must explain, relative to the fraction that single scans explain. With
    right poses it is about 1, with poses in a wrong order 0.2."""
    judged_scans: int = 50
    """Number of scans, evenly selected, of which that is determined."""
    unobserved_sd: float = 0.7
    """A parameter is reported as unobserved if its standard deviation exceeds this fraction of its prior one."""


SETTINGS = CalibrationSettings()


@dataclass(frozen=True)
class ClosingTrackSettings:
    """Constants of the scale from closing tracks.

    Chosen by hand on the recorded run corridor8 and confirmed on simulated rooms and on the run slip8.
    """

    max_gap: float = 0.3
    """Largest motion of the sensor between consecutive echoes of a track, metres."""
    max_jump: float = 0.08
    """Largest difference between measured and expected change of the range, metres: several standard deviations, ..."""
    max_jump_share: float = 0.1
    """... plus this share of the motion, for the error of the scale."""
    max_turn: float = float(np.radians(10.0))
    """Largest rotation from the middle of a track, radians: the target may leave the cone."""
    min_echoes: int = 6
    """Echoes of a track."""
    min_motion: float = 0.3
    """Motion along the axis of the sensor, metres. Shorter tracks say little, and wrong ones are hard to recognize."""
    max_error: float = 0.3
    """Tracks with a larger relative error of the scale see a moving target, or several targets."""
    max_sd: float = 0.2
    """Tracks with a larger standard deviation say nothing: sensors that look across the direction of motion."""
    iterations: int = 40
    """Iterations of the reweighted least squares."""
    freedom: float = 3.0
    """Degrees of freedom of Student's t distribution of echoes and of tracks."""
    first_noise: float = 0.02
    """Scale of the residuals of a track at the beginning, metres."""
    min_noise: float = 0.004
    """Least scale of the residuals of a track, metres: ranges in steps of 10 mm, and a few echoes only."""
    spreads: tuple[float, ...] = tuple(np.geomspace(0.03, 0.3, 20).tolist())
    """Candidates of the standard deviation between tracks. It is at least 3 %: targets are no points, and their nearest
    part moves by centimetres along a track of a metre."""
    stretch: float = 2.0
    """Length of trajectory whose tracks are left out at a time for the standard error, metres."""
    most_stretches: int = 60
    """Stretches are longer if there would be more of them."""
    min_tracks: int = 6
    """Tracks that an estimate needs, ..."""
    min_stretches: int = 4
    """... and stretches of the trajectory in which they begin."""


TRACK_SETTINGS = ClosingTrackSettings()
"""The settings in use."""


@dataclass(frozen=True)
class SparseCalibrationSettings:
    """Constants of the calibration of rings whose single scans carry no line.

    Chosen by hand on the recorded run corridor8 and confirmed on simulated rooms and on the run slip8, unless stated
    otherwise.
    """

    min_scans: int = 3
    """Scans with a pose that a log needs."""
    gate: float = 0.12
    """Largest difference between measured and expected range of an echo that is assigned to a wall, metres. The map was
    made from the same echoes."""
    min_echoes: int = 6
    """Echoes that a wall needs."""
    max_direction_sd: float = 0.05
    """Largest standard deviation of the direction of a wall, radians."""
    direction_sd: float = 0.05
    """Prior standard deviation of the direction of a wall around that in the map, radians."""
    stretch: float = 4.0
    """Length of trajectory over which odometry is taken as exact, metres, if poses are estimated: a wall that is seen
    in two such stretches is two walls."""
    iterations: int = 25
    """Iterations of the reweighted least squares."""
    first_noise: float = 0.02
    """Scale of the residuals at the beginning, metres."""
    min_noise: float = 0.003
    """Least scale of the residuals, metres: ranges in steps of 10 mm."""
    freedom: float = 3.0
    """Degrees of freedom of Student's t distribution of the residuals."""
    scale_sd: float = 0.10
    """Prior standard deviation of the logarithm of the scale: the clock of a driver, and its speed of sound. Errors of
    up to 9 % occur."""
    relative_offset_sd: float = 0.015
    """Prior standard deviation of the range offset of a sensor relative to the mean, metres: one or two wavelengths."""
    mean_offset_sd: float = 0.06
    """Prior standard deviation of the mean range offset, metres. Offsets of 68 mm occur."""
    jackknife: float = 2.0
    """Length of trajectory that is left out at a time for the standard errors, metres."""
    most_stretches: int = 60
    """These stretches are longer if there would be more of them."""
    max_scale_sd: float = 0.02
    """A scale with a larger standard deviation is held, unless it differs from the nominal one significantly: 2 % are
    40 mm at 2 m, more than the noise."""
    significant: float = 3.0
    """That many standard deviations are significant."""
    max_offset: float = 0.15
    """Largest change of a range offset, metres."""
    max_log_speed: float = 0.12
    """Largest change of the logarithm of the speed of sound."""
    min_explained: float = 0.05
    """Smallest fraction of the fresh echoes that the walls must explain. Most echoes of sparse rings come from posts,
    door frames and furniture."""


@dataclass(frozen=True)
class EchoModelSettings:
    """Constants of the noise and of the detection probability of a run. Chosen by hand."""

    gate: float = 0.5
    """Echoes whose range differs more from that of the wall in their cone are left out, metres."""
    iterations: int = 100
    """Iterations of the expectation maximization."""
    first_core: float = 0.02
    """Standard deviation of the core at the beginning, metres."""
    first_tail: float = 0.15
    """Scale of the tails at the beginning, metres."""
    min_core: float = 0.003
    """Least standard deviation of the core, metres: ranges in steps of 10 mm."""
    outlier: float = 3.0
    """Echoes that deviate by more than this many standard deviations of the core are too short or too long."""
    bin: float = float(np.radians(5.0))
    """Width of a bin of the angle off axis, radians."""
    bins: int = 6
    """Number of these bins."""
    detection_gate: float = 0.08
    """A wall is heard if an echo lies within this distance of its expected range, metres."""
    detection_range: float = 0.9
    """Walls up to this share of the maximum range are expected to be heard."""


SPARSE_SETTINGS = SparseCalibrationSettings()
ECHO_SETTINGS = EchoModelSettings()
