"""Constants of the calibration of a ring."""

from dataclasses import dataclass


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
