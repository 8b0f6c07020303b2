"""What ONE echo path reports of ONE reflector of the world: the model that calibration fits to the ranges.

Everything is differentiable in the ring, the pose and the reflector, forward and in reverse, in single and double
precision.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from . import measurement_model as reflectors
from .array_geometry import EchoPaths
from .geometry import edge_range, fold_line, mirrored, normal, point_range, safe_sqrt, tangent
from .ml_detection import CORNER, EDGE, PLANE

SECOND = 3
"""Wall to wall: reflected at a first plane, then at a second; beside ``PLANE``, ``CORNER`` and ``EDGE``."""
_SLACK = 0.3  # m; a wall may go on behind its outermost foot
_FAR = 1e3  # m; where a plane stands that is none


AnyArray = np.ndarray | jax.Array
"""NumPy where a scene is put together, JAX where it is used."""


class Scene(eqx.Module):
    """Reflectors of the world, each given relative to an anchor near it, so that single precision suffices far away."""

    kind: Int[AnyArray, "*reflectors"]
    """PLANE, CORNER or EDGE; -1 for none."""
    parameters: Float[AnyArray, "*reflectors 2"]
    """Planes: (distance of the anchor along the normal, theta); points: place minus anchor. Metres, radians, world."""
    anchor: Float[AnyArray, "*reflectors 2"]
    """A fixed place in the world, metres: planes their middle, points where they were first seen."""
    ends: Float[AnyArray, "*reflectors 2"]
    """Planes: where they begin and end along their tangent, metres from the anchor; points: 0."""


class Reflection(eqx.Module):
    """Which reflector an echo comes from."""

    kind: Int[AnyArray, "*echoes"]
    """PLANE, CORNER, EDGE or SECOND."""
    first: Int[AnyArray, "*echoes"]
    """Row of the scene; of wall to wall the plane that is met first."""
    second: Int[AnyArray, "*echoes"]
    """Row of the plane that is met second; the same as ``first`` for all other kinds."""


def seen_from(pose: Float[Array, "3"], reflector: Scene) -> Float[Array, "2"]:
    """ONE reflector in the robot frame: (rho, theta) with rho of either sign for a plane, (x, y) for a point.

    Args:
        pose: world_from_robot: x, y (metres), theta (radians).
        reflector: of the world.
    """
    offset = reflector.anchor - pose[:2]
    theta = reflector.parameters[1]
    line = jnp.stack([reflector.parameters[0] + normal(theta) @ offset, theta - pose[2]])
    place = offset + reflector.parameters
    point = jnp.stack([normal(pose[2]) @ place, tangent(pose[2]) @ place])
    return jnp.where(reflector.kind == PLANE, line, point)


def expected_range(
    kind: Int[Array, ""],
    first: Float[Array, "2"],
    second: Float[Array, "2"],
    tx: Float[Array, "2"],
    rx: Float[Array, "2"],
) -> Float[Array, ""]:
    """Half the path length of ONE echo in metres, exact for every kind.

    Args:
        kind: PLANE, CORNER, EDGE or SECOND.
        first: the reflector in the robot frame (``seen_from``).
        second: the plane that is met second; used by SECOND only.
        tx: position of the transmitter in the robot frame, metres.
        rx: position of the receiver, metres.
    """
    nowhere = jnp.asarray([_FAR, 0], first.dtype)
    first_line = jnp.where((kind == PLANE) | (kind == SECOND), first, nowhere)
    second_line = jnp.where(kind == SECOND, second, nowhere)
    middle, half = (tx + rx) / 2, (rx - tx) / 2
    height, across = first_line[0] - middle @ normal(first_line[1]), half @ tangent(first_line[1])
    around = tx - mirrored(mirrored(rx, second_line), first_line)
    ranges = {
        PLANE: safe_sqrt(height * height + across * across),
        CORNER: point_range(first, tx, rx),
        EDGE: edge_range(first, tx, rx),
        SECOND: safe_sqrt(around @ around) / 2,
    }
    return jnp.select([kind == k for k in ranges], list(ranges.values()), jnp.zeros_like(height))


def expected_report(
    reach: Float[Array, ""], *, range_offset: Float[Array, ""], range_scale: Float[Array, ""]
) -> Float[Array, ""]:
    """What a path reports of a true half path length: the inverse of ``corrected_range``, metres."""
    return reach / range_scale + range_offset


def audible(
    pose: Float[Array, "3"], reflection: Reflection, first: Scene, second: Scene, path: EchoPaths
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, "2"]]:
    """How ONE path hears ONE reflection of the world.

    Args:
        pose: world_from_robot.
        reflection: what is asked for.
        first: its first (or only) reflector.
        second: its second one.
        path: the echo path, robot frame.

    Returns:
        Range in metres, how far it lies within both cones (0 = it is not heard), and the direction from which it
        arrives, a unit vector in the robot frame.
    """
    one, other = seen_from(pose, first), seen_from(pose, second)
    line, second_line = (jnp.stack(fold_line(*seen)) for seen in (one, other))
    wall = reflectors.plane(line, path)
    turned = jnp.where(one[0] < 0, -1, 1)  # the robot stands behind the wall as its normal goes
    along = tangent(first.parameters[1]) @ (pose[:2] - first.anchor) + turned * wall.foot
    on_wall = (along > first.ends[0] - _SLACK) & (along < first.ends[1] + _SLACK)
    seen = [
        wall,
        reflectors.corner(one, path),
        reflectors.edge(one, path),
        reflectors.second_order(line, second_line, path),
    ]
    share = jnp.stack([reflectors.heard_share(sighting, path) for sighting in seen])
    share = share.at[PLANE].multiply(on_wall.astype(share.dtype))
    kind = jnp.clip(reflection.kind, 0, SECOND)
    reach = jnp.stack([sighting.range for sighting in seen])[kind]
    arrival = jnp.stack([sighting.arrival for sighting in seen])[kind]
    return reach, jnp.where(reflection.kind >= 0, share[kind], 0), arrival


def take(scene: Scene, rows: Int[AnyArray, "*some"]) -> Scene:
    """Some reflectors of a scene."""
    return jax.tree.map(lambda leaf: leaf[rows], scene)
