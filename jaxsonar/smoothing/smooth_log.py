"""Smoothing of a log: ``smooth`` and its result."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxsonar.detection.extract import local_models
from jaxsonar.detection.local_model import LocalModel
from jaxsonar.detection.settings import check_sigma
from jaxsonar.estimation.odometry_noise import OdometryNoise, OdometryNoiseModel
from jaxsonar.estimation.sparse_adjustment import marginal_covariances
from jaxsonar.geometry.se2 import compose, relative
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.registration.sequential_registration import register_remaining
from jaxsonar.scans.measured_directions import measured_directions
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.sliding_windows import check_window
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_parameters import PRIOR, ParameterBasis, parameter_basis
from jaxsonar.smoothing.covisibility import Traversals
from jaxsonar.smoothing.settings import SETTINGS
from jaxsonar.smoothing.smoothed_map import adjusted_map
from jaxsonar.smoothing.smoother import Smoother, SmoothingFit, has_pose
from jaxsonar.smoothing.sparse_smoother import SPARSE_ODOMETRY_NOISE, SPARSE_SETTINGS, SparseSmoother


@dataclass(frozen=True, eq=False)
class Smoothed:
    """Poses and map with their covariances. The pose of the first scan that has one is fixed."""

    poses: Float[np.ndarray, "scans 3"]
    """world_from_robot: x, y (metres), theta (radians); NaN for scans without a pose."""
    pose_cov: Float[np.ndarray, "scans 3 3"]
    """Covariance of (x, y, theta) with respect to the fixed pose, metres and radians; NaN as above. An undetermined
    direction has a standard deviation of many metres."""
    explained_counts: Int[np.ndarray, " scans"]
    """Number of echoes of each scan that landmarks explain; 0 where the odometry alone determines the pose."""
    world: GlobalMap
    """The adjusted landmarks, with their standard deviations."""
    used: float
    """Fraction of the echoes of scans with a pose that the map explains."""
    sigma: float | None
    """Standard deviation of the ranges, metres, if it was estimated; None if it was given, or the echoes do not
    determine it."""
    ring: Ring
    """The ring, with the estimated speed of sound."""
    speed_of_sound_sd: float
    """Metres per second; 0 if it was fixed."""
    scale: tuple[float, float]
    """Relative errors of the odometry's displacements and rotations (positive: too large); 0 if they were fixed."""
    scale_sd: tuple[float, float]
    """Standard deviations of ``scale``."""
    heading_gain: float | None = None
    """With windows: share of the variance of the headings by odometry that the walls remove."""

    @property
    def keeps_odometry(self) -> bool:
        """Whether the walls add so little to the odometry that its poses are kept."""
        return self.heading_gain is not None and self.heading_gain < SPARSE_SETTINGS.least_heading_gain

    @property
    def left_out(self) -> Int[np.ndarray, " rows"]:
        """Rows of the scans without a pose."""
        return np.flatnonzero(np.isnan(self.poses[:, 0]))


def smooth(
    ring: Ring,
    log: Log,
    poses: Float[np.ndarray, "scans 3"],
    *,
    odometry: Float[np.ndarray, "_ 3"] | None = None,
    sigma: float | None = None,
    window: float | None = None,
    speed: bool = False,
    scale: bool = False,
    odometry_noise: OdometryNoiseModel | None = None,
    models: Sequence[LocalModel] | None = None,
    traversals: Traversals | None = None,
    progress: Callable[[str], None] | None = None,
) -> Smoothed:
    """Adjust all poses and landmarks to the ranges of the echoes.

    Args:
        ring: the sensors, calibrated; fixed, except for the speed of sound on request.
        log: the echoes; its poses are not used.
        poses: (scans, 3) world_from_robot to start from, with errors of centimetres and degrees, and of decimetres at
            loop closures; NaN where unknown. Those are predicted from the nearest pose by odometry, or registered on
            the map.
        odometry: (scans, 3) world_from_robot as measured, with drift; NaN where there is none.
        sigma: standard deviation of the ranges, metres; estimated if left out.
        window: metres of trajectory gathered into one local model of the map, for sparse rings.
        speed: whether the speed of sound is estimated.
        scale: whether the scale factors of the odometry's displacements and rotations are estimated.
        odometry_noise: noise model of the odometry; default ``OdometryNoise()``, or ``SPARSE_ODOMETRY_NOISE`` with
            windows.
        models: the local models of the scans, if they are known already; not with windows.
        traversals: segments of the trajectory and how well they are known relative to each other; if left out, all
            scans may observe the same landmarks.
        progress: called with the current task.

    Raises:
        SonarError: wrong shapes, no pose, no wall found, scale factors without odometry.
    """
    start, measured = _checked(log, poses, odometry, sigma, window, scale)
    report = progress or (lambda task: None)
    if window is not None:
        sparse = SparseSmoother(
            ring=ring,
            log=log,
            odometry=measured,
            basis=_parameter_basis(ring, speed=speed, scale=scale),
            odometry_noise=odometry_noise or SPARSE_ODOMETRY_NOISE,
            sigma=sigma,
            window=window,
            fixed_row=int(has_pose(start).argmax()),
            progress=report,
        )
        found = sparse.fit(_with_predicted_poses(start, measured))
        report("covariances")
        result = replace(_result(sparse, found.fit, found.world), heading_gain=found.heading_gain)
        # What was estimated with poses that are not used is no result.
        return replace(result, speed_of_sound_sd=0.0, scale_sd=(0.0, 0.0)) if result.keeps_odometry else result
    if models is None:
        report("local models")
        models = list(local_models(ring, log, sigma=sigma))
    smoother = Smoother(
        ring=ring,
        log=log,
        odometry=measured,
        basis=_parameter_basis(ring, speed=speed, scale=scale),
        odometry_noise=odometry_noise or OdometryNoise(),
        sigma=sigma,
        models=models,
        traversals=traversals,
        fixed_row=int(has_pose(start).argmax()),
        progress=report,
    )
    # 1. Alternate mapping and least squares from the given poses.
    fit = smoother.fit(_with_predicted_poses(start, measured))
    # 2. Register scans without a pose on the better map, and adjust again.
    margins = SETTINGS.registration_margins[: None if has_pose(measured).any() else 1]
    for margin in margins:
        if has_pose(fit.poses).all():
            break
        report("registering scans without a pose")
        registered = register_remaining(
            models,
            fit.poses,
            measured,
            margin=margin,
            noise_scale=SETTINGS.local_model_noise_scale,
            directions=measured_directions(ring, log),
        )
        if has_pose(registered).sum() > has_pose(fit.poses).sum():
            fit = _better_fit(fit, smoother.fit(registered))
    # 3. Adjust with circles as landmarks.
    report("circles")
    fit = _better_fit(fit, smoother.with_circles(fit))
    # 4. Covariances.
    report("covariances")
    return _result(smoother, fit)


def _better_fit(before: SmoothingFit, after: SmoothingFit) -> SmoothingFit:
    """The fit with more scans, if it explains more echoes without more noise."""
    same_noise = after.adjustment.sigma < SETTINGS.max_sigma_growth * before.adjustment.sigma
    return after if after.explained_count > before.explained_count and same_noise else before


def _result(smoother: Smoother | SparseSmoother, fit: SmoothingFit, world: GlobalMap | None = None) -> Smoothed:
    """The result of a fit, with marginal covariances; without another map, with that of the adjusted landmarks."""
    found, rows, log = fit.adjustment, fit.data.scan_rows[0], smoother.log
    with jax.enable_x64(True):
        cov = marginal_covariances(found.problem, found.solution.unknowns, poses_free=True)
    pose_cov = np.full((len(log), 3, 3), np.nan)
    pose_cov[rows] = cov.poses[: len(rows)]
    pose_cov[np.isnan(fit.poses[:, 0])] = np.nan
    columns, sensors = smoother.basis.columns, smoother.ring.count
    change = columns @ found.state.coordinates
    sd = np.sqrt(np.maximum(np.diag(columns @ cov.coordinates @ columns.T), 0))
    has_scale = len(change) > 3 * sensors + 1
    ring = smoother.ring_of(found.state)
    return Smoothed(
        poses=fit.poses,
        pose_cov=pose_cov,
        explained_counts=fit.echo_counts,
        world=adjusted_map(fit.alternation.maps[0], found, cov.landmarks) if world is None else world,
        used=float(found.used.sum() / max(fit.data.echo_count, 1)),
        sigma=found.sigma if found.sigma_dof >= SETTINGS.min_sigma_dof else None,
        ring=ring,
        speed_of_sound_sd=float(sd[sensors] * ring.speed_of_sound),
        scale=(float(np.expm1(change[-2])), float(np.expm1(change[-1]))) if has_scale else (0.0, 0.0),
        scale_sd=(float(sd[-2]), float(sd[-1])) if has_scale else (0.0, 0.0),
    )


def _parameter_basis(ring: Ring, *, speed: bool, scale: bool) -> ParameterBasis:
    """The free ones of: speed of sound, scale factors of displacements and rotations (two more rows)."""
    basis = parameter_basis(ring, ("speed",) if speed else (), poses_free=True, speed_sd=PRIOR.speed_sd)
    if not scale:
        return basis
    columns = np.zeros((len(basis.columns) + 2, basis.columns.shape[1] + 2))
    columns[:-2, :-2] = basis.columns
    columns[-2:, -2:] = SETTINGS.odometry_scale_sd * np.eye(2)
    return ParameterBasis(columns, (*basis.names, "displacement", "rotation"))


def _with_predicted_poses(
    poses: Float[np.ndarray, "scans 3"], odometry: Float[np.ndarray, "scans 3"]
) -> Float[np.ndarray, "scans 3"]:
    """Missing poses predicted by odometry from the scan nearest in the log that has a pose."""
    predicted, known = poses.copy(), np.flatnonzero(has_pose(poses) & has_pose(odometry))
    if not len(known):
        return predicted
    for row in np.flatnonzero(~has_pose(poses) & has_pose(odometry)):
        nearest = known[np.argmin(np.abs(known - row))]
        predicted[row] = compose(poses[nearest], relative(odometry[nearest], odometry[row]))
    return predicted


def _checked(
    log: Log,
    poses: Float[np.ndarray, "_ 3"],
    odometry: Float[np.ndarray, "_ 3"] | None,
    sigma: float | None,
    window: float | None,
    scale: bool,
) -> tuple[Float[np.ndarray, "scans 3"], Float[np.ndarray, "scans 3"]]:
    """Start and odometry in double precision, rows that are not finite set to NaN; or a SonarError."""
    check_sigma(sigma)
    check_window(window)
    checked = []
    for name, given in {"poses": poses, "odometry": odometry}.items():
        values = np.full((len(log), 3), np.nan) if given is None else np.array(given, dtype=np.float64)
        if values.shape != (len(log), 3):
            raise SonarError(f"smooth: {name} of shape {values.shape}; allowed is ({len(log)}, 3): x, y, theta a scan")
        values[~np.isfinite(values).all(axis=1)] = np.nan
        checked.append(values)
    if not has_pose(checked[0]).any():
        raise SonarError(f"smooth: none of the {len(log)} scans has a pose; allowed is one or more to start from")
    if scale and not has_pose(checked[1]).any():
        raise SonarError("smooth: scale factors need odometry; allowed is odometry, or no scale")
    return checked[0], checked[1]
