"""Where sensors really look, from which walls they heard and which they did not."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .array_geometry import Sensors, echo_paths
from .data_association import CandidateReflections
from .geometry import signed_angle
from .landmarks import Landmarks, predict_reflection

_CENTRE_SD = 0.2  # rad; what is expected of the directions of sensors
_BORDER = (0.1, 0.3)  # rad and relative; how wide the border of a cone is, without which few sightings make it a cliff


class BeamPattern(eqx.Module):
    """Detection cones as their echoes show them."""

    centre: Float[Array, " sensors"]
    """How far each sensor looks to the left of its heading, radians."""
    half_width: Float[Array, ""]
    """Off-axis angle at which half of the echoes are heard that are heard on the axis, radians."""
    log_rolloff_width: Float[Array, ""]
    """Logarithm of the width of that border, radians."""
    detection_log_odds: Float[Array, ""]
    """Log odds that an echo on the axis is heard."""


@jax.jit
def off_axis_angles(
    sensors: Sensors,
    scene: Landmarks,
    candidates: CandidateReflections,
    poses: Float[Array, "scans 3"],
    world: Int[Array, " scans"],
) -> Float[Array, "scans candidates sensors"]:
    """Direction from which every sensor's own echo of every candidate would arrive, from its heading, radians.

    NaN where there is none: behind the sensor, beyond the maximum range, beside the wall, in another world. The ring's
    first paths are the direct ones.
    """
    count = sensors.heading.shape[0]
    paths = jax.tree.map(lambda leaf: leaf[:count], echo_paths(sensors))
    wide = eqx.tree_at(lambda p: p.cone, paths, jnp.full_like(paths.cone, 2))  # half the plane

    def one(pose, here, reflection, own, first, second, path):
        reach, share, arrival = predict_reflection(pose, reflection, first, second, path)
        axis = path.axes[0]
        angle = signed_angle(axis, arrival)
        return jnp.where((share > 0) & (reach < sensors.max_range) & (here == own), angle, jnp.nan)

    first, second = scene.take(candidates.reflection.first), scene.take(candidates.reflection.second)
    each = jax.vmap(one, in_axes=(None, None, None, None, None, None, 0))
    each = jax.vmap(each, in_axes=(None, None, 0, 0, 0, 0, None))
    each = jax.vmap(each, in_axes=(0, 0, None, None, None, None, None))
    return each(poses, world, candidates.reflection, candidates.world, first, second, wide)


def beam_negative_log_likelihood(
    beams: BeamPattern,
    sensor: Int[Array, " sightings"],
    angle: Float[Array, " sightings"],
    heard: Bool[Array, " sightings"],
    counts: Bool[Array, " sightings"],
) -> Float[Array, ""]:
    """Negative logarithm of the likelihood of what was heard and what was not, and of what is expected of sensors.

    Args:
        beams: the cones.
        sensor: which one could have heard.
        angle: from which direction, radians from its heading.
        heard: whether it did.
        counts: False for padding.
    """
    inside = (beams.half_width - jnp.abs(angle - beams.centre[sensor])) / jnp.exp(beams.log_rolloff_width)
    log_heard = jax.nn.log_sigmoid(beams.detection_log_odds) + jax.nn.log_sigmoid(inside)
    log_not = jnp.log1p(-jnp.exp(jnp.minimum(log_heard, -1e-6)))
    log_likelihood = jnp.where(counts, jnp.where(heard, log_heard, log_not), 0).sum()
    width, spread = _BORDER
    expected = (beams.centre**2).sum() / _CENTRE_SD**2 + ((beams.log_rolloff_width - jnp.log(width)) / spread) ** 2
    return 0.5 * expected - log_likelihood
