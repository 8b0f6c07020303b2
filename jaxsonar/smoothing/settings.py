"""Constants of the smoother."""

from dataclasses import dataclass

from jaxsonar.detection.settings import DEFAULT_SIGMA
from jaxsonar.estimation.alternation import SETTINGS as ALTERNATION_SETTINGS


@dataclass(frozen=True)
class SmoothingSettings:
    """Constants of ``smooth``; chosen by hand unless stated otherwise."""

    # Priors
    start_sd: tuple[float, float, float] = (0.05, 0.05, 0.05)
    """Standard deviations of the initial poses in the first round, metres and radians."""
    fixed_pose_sd: float = 1e-5
    """Standard deviation of the first pose, metres and radians."""
    free_pose_sd: tuple[float, float, float] = (30.0, 30.0, 3.0)
    """Standard deviations of all other poses, metres and radians: only as much prior as the arithmetic needs. The first
    one holds for the parameters of landmarks as well."""
    odometry_scale_sd: float = 0.05
    """Prior standard deviation of the scale factors of an odometry that was never calibrated, relative."""
    min_sigma_dof: float = 10.0
    """Least degrees of freedom of an estimate of the noise of the ranges; its relative error is 0.2 then."""

    # Association
    initial_scale: float = 0.04
    """Scale of the first association of echoes with landmarks, metres."""
    min_echoes_per_landmark: int = 4
    """Least number of echoes of one landmark in a scan for them to count."""

    # Limits
    cost_tolerance: float = 0.01
    """Least squares has converged when a step decreases the cost (half a sum of squares in standard deviations) by less
    than this: far less than the uncertainty of the result."""
    large_problem: int = 100
    """Number of scans beyond which the next two limits hold: the next round continues where one stops."""
    large_problem_iterations: int = 8
    """Iterations of least squares in each round."""
    large_problem_maps: int = 2
    """Number of maps."""

    # Scans without a pose
    local_model_noise_scale: float = 0.2
    """Factor on the extra noise of local models at registration: the ring is calibrated."""
    registration_margins: tuple[float, ...] = (4.0, 2.0)
    """Log-likelihood margins at which scans are registered on the map, nats, one after the other; without odometry only
    the first one."""
    max_sigma_growth: float = 1.15
    """Largest factor by which registered scans may increase the noise of the ranges. More means wrong poses."""
    min_explained: float = 0.5
    """Least fraction of echoes that a scan without odometry must explain, relative to the average of all scans."""
    min_explained_echoes: int = 3
    """Least number of explained echoes of such a scan."""

    # Odometry outliers
    expected_false_outliers: float = 0.3
    """Expected number of steps of a run that are outliers by chance."""
    outlier_steps: int = 2
    """Largest number of consecutive steps that are tested together: a scan with a wrong pose changes two steps."""
    max_split_distance: int = 40
    """Largest number of scans between two detections of a point that an outlier between them splits. Later the robot
    may have returned, and the odometry does not decide whether a point is the same."""
    max_outlier_rounds: int = 2
    """Largest number of repetitions with split points."""
    min_decrease: float = ALTERNATION_SETTINGS.min_growth
    """Factor by which the number of explained echoes must decrease to count as fewer."""

    # Covisibility
    max_covisible_sd: float = 0.04
    """Metres; largest standard deviation of a landmark's position relative to a segment of the trajectory for which
    both observe the same landmark. Neighboring landmarks are farther apart."""
    max_consecutive_sd: float = 0.5
    """Metres; the same for consecutive segments. A larger one means that the robot was moved by hand."""

    # Wall echoes
    default_sigma: float = DEFAULT_SIGMA
    """Standard deviation of the ranges of a scan whose local model has no estimate, metres."""

    # Circles
    max_radius_sd: float = 0.01
    """Metres; a circle whose radius is known worse is no landmark, because its radius is not adjusted. Chosen by
    hand: seen from another side, the whole error of the radius is an error of the range."""
    circle_margin: float = 0.1
    """Metres from the border of a circle within which corners and edges are detections of the circle. Chosen by
    hand: about the error of a point that one scan determines."""


SETTINGS = SmoothingSettings()
