"""Landmarks of a map and the echoes that they cause: from the world frame to ONE echo path in the robot frame."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .detection_cones import SETTINGS, echo_level, visibility
from .measurement_model import (
    CIRCLE,
    EDGE,
    PLANE,
    PredictedEcho,
    circle_echo,
    corner_echo,
    echo_of_kind,
    edge_echo,
    plane_echo,
    reflector_echo,
    second_order_echo,
)
from .planar_geometry import dot, fold_line, normal, rotate_back, tangent
from .sensor_array import EchoPaths

AnyArray = np.ndarray | jax.Array
"""NumPy where landmarks are collected, JAX where they are used."""


class Landmarks(eqx.Module):
    """Reflectors of the world, each relative to an anchor close to it, so that single precision suffices far away."""

    kind: Int[AnyArray, "*landmarks"]
    """PLANE, CORNER, EDGE or CIRCLE; -1 for unused rows."""
    parameters: Float[AnyArray, "*landmarks 2"]
    """Planes: (rho seen from the anchor, theta); points and circles: position (center) minus anchor. World frame,
    metres, radians."""
    anchor: Float[AnyArray, "*landmarks 2"]
    """A fixed position, world frame, metres: the middle of a plane, or where a point was first observed."""
    extent: Float[AnyArray, "*landmarks 2"]
    """Planes: where they begin and end along their tangent, metres from the anchor; points: 0."""
    radius: Float[AnyArray, "*landmarks"] | None = None
    """Radii of circles, metres; 0 for all other kinds. They are constants: maps estimate them. None: there is no
    circle, and the kernels compile without their range model."""

    def take(self, rows: Int[AnyArray, "*some"]) -> "Landmarks":
        """Select some of the landmarks."""
        return jax.tree.map(lambda leaf: leaf[rows], self)

    def with_parameters(self, parameters: Float[AnyArray, "*landmarks 2"]) -> "Landmarks":
        """Return the same landmarks with other parameters."""
        return eqx.tree_at(lambda landmarks: landmarks.parameters, self, parameters)


class Reflection(eqx.Module):
    """The kind of an echo and the landmarks that cause it."""

    kind: Int[AnyArray, "*echoes"]
    """PLANE, CORNER, EDGE, SECOND_ORDER or CIRCLE."""
    first: Int[AnyArray, "*echoes"]
    """Row of the landmark; for SECOND_ORDER of the plane that is met first."""
    second: Int[AnyArray, "*echoes"]
    """Row of the plane that is met second; equal to ``first`` for all other kinds."""


def landmark_in_robot_frame(pose: Float[Array, "3"], landmark: Landmarks) -> Float[Array, "2"]:
    """Transform ONE landmark to the robot frame: (rho, theta) with rho of either sign for a plane, (x, y) for a point.

    Args:
        pose: world_from_robot: x, y (metres), theta (radians).
        landmark: in the world frame.
    """
    offset = jnp.asarray(landmark.anchor) - pose[:2]
    theta = landmark.parameters[1]
    line = jnp.stack([landmark.parameters[0] + dot(normal(theta), offset), theta - pose[2]])
    point = rotate_back(offset + landmark.parameters, pose[2])
    return jnp.where(landmark.kind == PLANE, line, point)


def landmark_echo(local: Float[Array, "2"], landmark: Landmarks, path: EchoPaths) -> PredictedEcho:
    """Echo of ONE landmark that ONE path receives; it does not exist for unused rows.

    Args:
        local: the landmark in the robot frame (``landmark_in_robot_frame``).
        landmark: its kind and radius.
        path: the echo path, robot frame.
    """
    kind = jnp.asarray(landmark.kind)
    return _or_circle(reflector_echo(kind, local, path), kind, local, landmark, path)


def _or_circle(
    echo: PredictedEcho, kind: Int[Array, ""], center: Float[Array, "2"], landmark: Landmarks, path: EchoPaths
) -> PredictedEcho:
    """The echo, or that of a circle if the kind is CIRCLE; its derivatives are by the center."""
    if landmark.radius is None:
        return echo
    circle = circle_echo(center, jnp.asarray(landmark.radius), path).as_predicted()
    return jax.tree.map(lambda round_one, other: jnp.where(kind == CIRCLE, round_one, other), circle, echo)


class PredictedReflection(NamedTuple):
    """The echo of one reflection that one path receives."""

    range: Float[Array, "*echoes"]
    """Metres."""
    visibility: Float[Array, "*echoes"]
    """By the detection cones and, for planes, by the extent of the wall; 0: no echo."""
    arrival: Float[Array, "*echoes 2"]
    """Direction from which the echo arrives, a unit vector in the robot frame."""
    level: Float[Array, "*echoes"]
    """Level of the echo, dB relative to a wall on the axis at 1 m; -inf if it is not possible."""


def predict_reflection(
    pose: Float[Array, "3"], reflection: Reflection, first: Landmarks, second: Landmarks, path: EchoPaths
) -> PredictedReflection:
    """Predict the echo of ONE reflection that ONE path receives.

    Args:
        pose: world_from_robot.
        reflection: its kind; the rows are not used.
        first: its first (or only) landmark.
        second: its second one.
        path: the echo path, robot frame.
    """
    local, second_local = (landmark_in_robot_frame(pose, landmark) for landmark in (first, second))
    line, second_line = (jnp.stack(fold_line(*parameters)) for parameters in (local, second_local))
    wall = plane_echo(line, path)
    kind = jnp.asarray(reflection.kind)
    echo = echo_of_kind(
        kind,
        wall,
        corner_echo(local, path),
        edge_echo(local, path),
        second_order_echo(line, second_line, path),
    )
    echo = _or_circle(echo, kind, local, first, path)
    # The tangent of the folded line points the other way if the robot is behind the wall.
    sign = jnp.where(local[0] < 0, -1, 1)
    along = dot(tangent(first.parameters[1]), pose[:2] - first.anchor) + sign * wall.footpoint
    margin = SETTINGS.association_wall_margin
    beside = (along <= first.extent[0] - margin) | (along >= first.extent[1] + margin)
    possible = echo.exists & ((kind != PLANE) | ~beside)
    level = jnp.where(possible, echo_level(echo, path) + reflector_level(kind, first, echo.range), -jnp.inf)
    return PredictedReflection(echo.range, jnp.where(possible, visibility(echo, path), 0), echo.arrival, level)


def reflector_level(kind: Int[Array, ""], landmark: Landmarks, distance: Float[Array, ""]) -> Float[Array, ""]:
    """Level of an echo relative to that of a wall at the same distance (metres), dB.

    Edges return a cylindrical wave, circles a wave that their curvature has widened.
    """
    distance = jnp.maximum(distance, 1e-2)
    level = jnp.where(kind == EDGE, SETTINGS.edge_level_db - 10 * jnp.log10(distance), 0)
    if landmark.radius is None:
        return level
    radius = jnp.maximum(landmark.radius, 1e-4)
    return jnp.where(kind == CIRCLE, 10 * jnp.log10(radius / (radius + distance)), level)
