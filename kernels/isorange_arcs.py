"""Isorange arcs: where the reflector of an echo with a given range can be (paper, section 4).

The points of equal path length are on a circle around the sensor (direct echo) or on an ellipse with tx and rx as foci
(cross echo). Both have one tangent line for each direction theta of the normal, in one closed form: with the virtual
sensor m, half the baseline d, the unit normal n and the unit tangent t,

    rho(theta) = m . n + sqrt(r^2 - (d . t)^2)

which is the range of a plane (``measurement_model.plane_range``) solved for rho. A circle is the case d = 0.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .planar_geometry import normal, safe_sqrt, tangent
from .sensor_array import EchoPaths


class Arc(eqx.Module):
    """The part of the arcs of one echo path that does not depend on the range: equidistant normals and constants."""

    theta: Float[Array, "*paths points"]
    """Directions of the normals, radians; not wrapped."""
    normal_x: Float[Array, "*paths points"]
    """Cosines of the normals."""
    normal_y: Float[Array, "*paths points"]
    """Sines of the normals."""
    midpoint_normal: Float[Array, "*paths points"]
    """Virtual sensor . normal, metres."""
    baseline_tangent_squared: Float[Array, "*paths points"]
    """(Half baseline . tangent)^2, square metres."""
    half_baseline_squared: Float[Array, "*paths"]
    """Squared length of the half baseline, square metres."""
    exists: Bool[Array, "*paths points"]
    """Which of the points exist: a narrow detection range has fewer points than the widest one."""


def arc(path: EchoPaths, *, pitch: float, points: int) -> Arc:
    """Equidistant points over the detection range of ONE path (paper, section 4).

    Oracle: ``arc_normals`` of tests/support/oracles.py.

    Args:
        path: the echo path.
        pitch: nominal distance between points, radians; the detection range is divided into the nearest whole number
            of equal intervals, at least one, and each interval has its point in the middle.
        points: size of the result, and the largest number of intervals.
    """
    whole = jnp.clip(jnp.round(path.width / pitch), 1, points)
    index = jnp.arange(points, dtype=path.width.dtype)
    theta = path.start + (index + 0.5) * (path.width / whole)
    normals = normal(theta)
    return Arc(
        theta=theta,
        normal_x=normals[:, 0],
        normal_y=normals[:, 1],
        midpoint_normal=normals @ path.midpoint,
        baseline_tangent_squared=(tangent(theta) @ path.half_baseline) ** 2,
        half_baseline_squared=path.half_baseline @ path.half_baseline,
        exists=(index < whole) & (path.width > 0),
    )


def tangent_rho(
    arc: Arc, distance: Float[Array, ""], *, max_range: Float[Array, ""]
) -> tuple[Float[Array, " points"], Bool[Array, " points"]]:
    """Distances from the origin of the tangent lines at the points of ONE echo's arc.

    A missing echo (0 or NaN), an echo at or beyond the maximum range, and an echo shorter than the baseline, which no
    reflector can cause, have no lines.

    Oracle: ``lines_of_echo`` of tests/support/oracles.py.

    Args:
        arc: the arc's normals and constants.
        distance: half the path length of the echo (its range), metres.
        max_range: half path length from which on echoes are ignored, metres.

    Returns:
        rho: metres, may be negative; 0 where there is no line.
        exists: which of the points have a line.
    """
    valid = (distance < max_range) & (distance * distance > arc.half_baseline_squared) & (distance > 0)  # False for NaN
    distance = jnp.where(valid, distance, 1)  # before the arithmetic, so that no gradient is NaN
    rho = arc.midpoint_normal + safe_sqrt(distance * distance - arc.baseline_tangent_squared)
    exists = arc.exists & valid
    return jnp.where(exists, rho, 0), exists


def arc_point(path: EchoPaths, distance: Float[Array, ""], theta: Float[Array, ""]) -> Float[Array, "2"]:
    """Point of ONE echo's arc at which the tangent line has the normal direction theta, robot frame, metres.

    Oracle: ``ellipse_tangent_rho`` of tests/support/oracles.py.
    """
    n, t = normal(theta), tangent(theta)
    along, across = path.half_baseline @ n, path.half_baseline @ t
    height = safe_sqrt(distance * distance - across * across)
    # Gradient of the ellipse's support function m.n + sqrt(r^2 - (d.t)^2) with respect to the normal.
    slide = jnp.where(height > 0, across * along / jnp.where(height > 0, height, 1), 0)
    return path.midpoint + height * n + slide * t
