"""Headings of the sensors from detections and missed detections of walls; ranges do not depend on headings."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize

from jaxsonar import kernels
from jaxsonar.estimation.adjustment_state import AdjustmentResult
from jaxsonar.estimation.batch_data import BatchData
from jaxsonar.hardware.errors import SonarError
from jaxsonar.kernels.shape_buckets import bucket_size, pad_rows
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class HeadingSettings:
    """Constants of the estimation of headings. All of them were chosen by hand."""

    initial_rolloff_width: float = 0.1
    """Initial width of the rolloff of the beam, radians."""
    initial_log_odds: float = 2.0
    """Initial log odds of a detection at the center of the beam."""
    gradient_tolerance: float = 1e-3
    """Convergence: largest component of the gradient, nats per radian. A heading with a standard deviation of 3 deg
    (a curvature of 365 nats per square radian) is then within 1e-4 standard deviations of the optimum."""
    min_observations: int = 1024
    """Observations are padded to a bucket of at least this size, so that few shapes are compiled."""


SETTINGS = HeadingSettings()


class _WallDetections(NamedTuple):
    """Walls that a sensor could detect directly, over all scans."""

    sensor: Int[np.ndarray, " observations"]
    angle: Float[np.ndarray, " observations"]
    """Direction of arrival from the heading of the sensor, radians."""
    detected: Bool[np.ndarray, " observations"]


def estimate_headings(
    ring: Ring, data: BatchData, found: AdjustmentResult, *, settings: HeadingSettings = SETTINGS
) -> tuple[Ring, Float[np.ndarray, " sensors"]]:
    """The ring with headings in the centers of the beams, and their standard deviations, radians.

    Width and rolloff of the beams, and the detection probability in their center, are estimated as well; all sensors
    share them. To be called with 64-bit floats enabled.

    Args:
        ring: the calibrated ring, with nominal headings.
        data: the echoes.
        found: the adjustment that associated them with landmarks.
        settings: constants of the estimation.

    Raises:
        SonarError: the echoes do not determine the headings.
    """
    # 1. Which walls were detected from which directions, and which were not.
    observations = _wall_detections(ring, data, found)
    size = bucket_size(len(observations.sensor), least=settings.min_observations)
    valid = np.ones(len(observations.sensor), dtype=bool)
    padded = [jnp.asarray(pad_rows(values, size)) for values in (*observations, valid)]
    # 2. Maximum a posteriori estimate of the beam pattern.
    start, unravel = ravel_pytree(
        kernels.BeamPattern(
            jnp.zeros(ring.count),
            jnp.asarray(float(np.median(ring.beam)) / 2),
            jnp.asarray(np.log(settings.initial_rolloff_width)),
            jnp.asarray(settings.initial_log_odds),
        )
    )

    def cost(flat):
        return kernels.beam_negative_log_likelihood(unravel(flat), *padded)

    value_and_gradient = jax.jit(jax.value_and_grad(cost))
    solution = minimize(
        lambda flat: tuple(np.asarray(part, dtype=np.float64) for part in value_and_gradient(jnp.asarray(flat))),
        np.asarray(start),
        jac=True,
        method="BFGS",
        options={"gtol": settings.gradient_tolerance},
    )
    # 3. Its covariance (Laplace approximation).
    hessian = np.asarray(jax.hessian(cost)(jnp.asarray(solution.x)))
    if np.linalg.eigvalsh(hessian).min() <= 0:
        raise SonarError("calibration: headings: the echoes do not determine the edges of the beams; hold the headings")
    variance = np.diag(np.linalg.inv(hessian))[: ring.count]
    heading = np.asarray(ring.heading) + np.asarray(unravel(jnp.asarray(solution.x)).center)
    return replace(ring, heading=heading), np.sqrt(variance)


def _wall_detections(ring: Ring, data: BatchData, found: AdjustmentResult) -> _WallDetections:
    """All walls that a sensor could detect, whether it did, and from where.

    Points are left out: edges are weak, and the directions from which a corner can be detected are unknown.
    """
    landmark_map = found.state.landmark_map
    landmarks, candidates = (jax.tree.map(jnp.asarray, x) for x in (landmark_map.landmarks, landmark_map.candidates))
    poses, map_index = jnp.asarray(found.state.poses), jnp.asarray(data.map_index)
    motion = None if data.path_pose is None else jnp.asarray(data.path_pose[:, : ring.count])
    angle = np.asarray(kernels.off_axis_angles(ring.sensors, landmarks, candidates, poses, map_index, motion))
    detected = np.zeros(angle.shape, dtype=bool)
    scan, echo = np.nonzero(found.used & (data.path < ring.count))
    detected[scan, found.candidate[scan, echo], data.path[scan, echo]] = True
    is_wall = (np.asarray(candidates.reflection.kind) == kernels.PLANE)[None, :, None]
    # A sensor whose echo could not be associated may have detected any of the walls.
    ambiguous = np.zeros((len(data.path), ring.count), dtype=bool)
    scan, echo = np.nonzero(np.isfinite(data.reported) & (data.path < ring.count) & ~found.used)
    ambiguous[scan, data.path[scan, echo]] = True
    kept = np.isfinite(angle) & is_wall & (~ambiguous[:, None] | detected)
    if data.measured is not None:
        kept &= data.measured[:, None, : ring.count]
    _, _, sensor = np.nonzero(kept)
    return _WallDetections(sensor, angle[kept], detected[kept])
