"""Directional sensitivity of the sensors, estimated from which walls each of them detected and which it did not."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .data_association import CandidateReflections
from .landmarks import Landmarks, predict_reflection
from .planar_geometry import signed_angle
from .sensor_array import SensorArray, echo_paths, transform_path


@dataclass(frozen=True)
class BeamPatternPrior:
    """Priors of the beam patterns. All of them were chosen by hand."""

    center_sd: float = 0.2
    """Standard deviation of the direction of a sensor around its heading, radians."""
    rolloff_width: float = 0.1
    """Median of the rolloff width, radians. Without a prior, few observations would make it 0."""
    log_rolloff_sd: float = 0.3
    """Standard deviation of the logarithm of the rolloff width."""


PRIOR = BeamPatternPrior()


class BeamPattern(eqx.Module):
    """Detection probability of direct echoes as a function of the direction of arrival."""

    center: Float[Array, " sensors"]
    """Center of the beam of each sensor, counter-clockwise from its heading, radians."""
    half_width: Float[Array, ""]
    """Angle from the center at which the detection probability is half of that at the center, radians."""
    log_rolloff_width: Float[Array, ""]
    """Logarithm of the angle over which the probability falls, radians."""
    detection_log_odds: Float[Array, ""]
    """Log odds of the detection at the center."""


@jax.jit
def off_axis_angles(
    sensors: SensorArray,
    landmarks: Landmarks,
    candidates: CandidateReflections,
    poses: Float[Array, "scans 3"],
    map_index: Int[Array, " scans"],
    motion: Float[Array, "scans sensors 3"] | None = None,
) -> Float[Array, "scans candidates sensors"]:
    """Direction of arrival of every sensor's direct echo of every candidate, from its heading, radians.

    NaN where there is no such echo: behind the sensor, beyond the maximum range, beside the wall, in another map. The
    ring's first paths are the direct ones.

    Args:
        sensors: the ring.
        landmarks: of all maps.
        candidates: reflections at these landmarks.
        poses: world_from_robot of the scans, metres and radians.
        map_index: index of the map in which each scan was taken.
        motion: scan_from_robot when each sensor fired; None: the robot was at rest.
    """
    count = sensors.heading.shape[0]
    paths = jax.tree.map(lambda leaf: leaf[:count], echo_paths(sensors))
    wide = eqx.tree_at(lambda p: p.cone, paths, jnp.full_like(paths.cone, 2))  # half the plane

    def one_echo(pose, map_of_scan, reflection, map_of_candidate, first, second, path, motion):
        path = path if motion is None else transform_path(path, motion)
        echo = predict_reflection(pose, reflection, first, second, path)
        angle = signed_angle(path.axes[0], echo.arrival)
        exists = (echo.visibility > 0) & (echo.range < sensors.max_range) & (map_of_scan == map_of_candidate)
        return jnp.where(exists, angle, jnp.nan)

    first, second = landmarks.take(candidates.reflection.first), landmarks.take(candidates.reflection.second)
    each = jax.vmap(one_echo, in_axes=(None, None, None, None, None, None, 0, 0))
    each = jax.vmap(each, in_axes=(None, None, 0, 0, 0, 0, None, None))
    each = jax.vmap(each, in_axes=(0, 0, None, None, None, None, None, 0))
    return each(poses, map_index, candidates.reflection, candidates.map_index, first, second, wide, motion)


def beam_negative_log_likelihood(
    beams: BeamPattern,
    sensor: Int[Array, " observations"],
    angle: Float[Array, " observations"],
    detected: Bool[Array, " observations"],
    valid: Bool[Array, " observations"],
) -> Float[Array, ""]:
    """Negative log-likelihood of detections and missed detections, plus the negative log-prior, nats.

    Args:
        beams: the beam pattern.
        sensor: index of the sensor of each observation.
        angle: direction of arrival from its heading, radians.
        detected: whether the sensor reported the echo.
        valid: False for padding.
    """
    inside = (beams.half_width - jnp.abs(angle - beams.center[sensor])) / jnp.exp(beams.log_rolloff_width)
    log_detected = jax.nn.log_sigmoid(beams.detection_log_odds) + jax.nn.log_sigmoid(inside)
    log_missed = jnp.log1p(-jnp.exp(jnp.minimum(log_detected, -1e-6)))
    log_likelihood = jnp.where(valid, jnp.where(detected, log_detected, log_missed), 0).sum()
    rolloff = (beams.log_rolloff_width - jnp.log(PRIOR.rolloff_width)) / PRIOR.log_rolloff_sd
    return 0.5 * ((beams.center**2).sum() / PRIOR.center_sd**2 + rolloff**2) - log_likelihood
