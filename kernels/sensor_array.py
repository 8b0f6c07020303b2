"""From sensors to echo paths: virtual sensors, baselines and detection ranges (paper, section 3)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .planar_geometry import normal, rotate, wrap_angle


class SensorArray(eqx.Module):
    """A ring of sensors. Every field is a leaf: no program is compiled again when a value changes."""

    position: Float[Array, "sensors 2"]
    """Mounting positions, robot frame, metres."""
    heading: Float[Array, " sensors"]
    """Directions of the sensors' axes, radians counter-clockwise from x."""
    beam: Float[Array, " sensors"]
    """Full opening angles of the detection cones, radians."""
    range_offset: Float[Array, " sensors"]
    """Constant error of each sensor's ranges, metres: positive if they are reported too long."""
    range_scale: Float[Array, ""]
    """Speed of sound divided by the speed that the reported ranges assume."""
    max_range: Float[Array, ""]
    """Half path length beyond which echoes are ignored, metres."""
    tx: Int[Array, " paths"]
    """Transmitter of each echo path."""
    rx: Int[Array, " paths"]
    """Receiver of each echo path."""


class EchoPaths(eqx.Module):
    """Geometry of one transmitter-receiver pair, or of all of them with a leading axis."""

    midpoint: Float[Array, "*paths 2"]
    """The virtual sensor: midpoint of tx and rx, robot frame, metres."""
    half_baseline: Float[Array, "*paths 2"]
    """Half the vector from tx to rx, metres; zero for a direct path."""
    start: Float[Array, "*paths"]
    """First direction of the detection range of planes, radians."""
    width: Float[Array, "*paths"]
    """Width of the detection range, radians, counter-clockwise from start; 0 where the cones do not overlap."""
    range_offset: Float[Array, "*paths"]
    """Constant error of the path's ranges, metres: the mean of its two sensors."""
    axes: Float[Array, "*paths 2 2"]
    """Unit vectors along the axes of tx and rx."""
    cone: Float[Array, "*paths 2"]
    """Squared chord between the axis and the border of the cones of tx and rx: 4 sin(beam / 4)^2, 0 to 2."""


def chord_squared(angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Squared distance of two unit vectors at this angle (radians, at most pi), without cancellation."""
    return 4 * jnp.sin(jnp.minimum(angle, jnp.pi) / 2) ** 2


def widen_cones(paths: EchoPaths, factor: float) -> EchoPaths:
    """Return the same paths with detection cones that are wider by a factor, but not wider than half the plane."""
    half_beam = jnp.minimum(factor * 2 * jnp.arcsin(jnp.sqrt(paths.cone) / 2), jnp.pi / 2)
    return eqx.tree_at(lambda p: p.cone, paths, chord_squared(half_beam))


def transform_path(path: EchoPaths, pose: Float[Array, "3"]) -> EchoPaths:
    """Transform ONE echo path from the robot frame to the parent frame of a pose x, y (metres), theta (radians)."""
    return EchoPaths(
        midpoint=pose[:2] + rotate(path.midpoint, pose[2]),
        half_baseline=rotate(path.half_baseline, pose[2]),
        start=path.start + pose[2],
        width=path.width,
        range_offset=path.range_offset,
        axes=jax.vmap(rotate, in_axes=(0, None))(path.axes, pose[2]),
        cone=path.cone,
    )


@jax.jit
def echo_paths(sensors: SensorArray) -> EchoPaths:
    """Geometry of every echo path of a ring, in the order of ``sensors.tx``.

    Oracle: ``receives`` of tests/support/oracles.py.
    """

    def one_path(tx: Int[Array, ""], rx: Int[Array, ""]) -> EchoPaths:
        # The echo of a plane reaches rx only from a direction in both cones: intersect them, relative to tx.
        turn = wrap_angle(sensors.heading[rx] - sensors.heading[tx])
        half_tx, half_rx = sensors.beam[tx] / 2, sensors.beam[rx] / 2
        first = jnp.maximum(-half_tx, turn - half_rx)
        last = jnp.minimum(half_tx, turn + half_rx)
        return EchoPaths(
            midpoint=(sensors.position[tx] + sensors.position[rx]) / 2,
            half_baseline=(sensors.position[rx] - sensors.position[tx]) / 2,
            start=sensors.heading[tx] + first,
            width=jnp.maximum(last - first, 0),
            range_offset=(sensors.range_offset[tx] + sensors.range_offset[rx]) / 2,
            axes=normal(jnp.stack([sensors.heading[tx], sensors.heading[rx]])),
            cone=chord_squared(jnp.stack([half_tx, half_rx])),
        )

    return jax.vmap(one_path)(sensors.tx, sensors.rx)
