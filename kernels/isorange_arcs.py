"""Echo arcs: where a reflector may be that answered after a given time (paper, section 4).

The points at equal path length lie on a circle around the sensor (direct echo) or on an ellipse with tx and rx as foci
(cross echo). Both have one tangent line per normal direction theta, in one closed form: with m the virtual sensor, d
half the way from tx to rx, and n, t the unit normal and tangent,

    rho(theta) = m . n + sqrt(r^2 - (d . t)^2)

which is the image-source range of a plane solved for rho. A circle is the case d = 0.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .array_geometry import EchoPaths
from .geometry import normal, safe_sqrt, tangent


class Arc(eqx.Module):
    """What the arcs of one echo path have in common, whatever the range: equidistant normals and their constants."""

    theta: Float[Array, "*paths points"]
    """Directions of the normals, radians, not wrapped."""
    normal_x: Float[Array, "*paths points"]
    """Cosines of the normals."""
    normal_y: Float[Array, "*paths points"]
    """Sines of the normals."""
    midpoint_normal: Float[Array, "*paths points"]
    """The virtual sensor's coordinate along each normal, m . n, metres."""
    baseline_tangent_squared: Float[Array, "*paths points"]
    """Square of the half baseline across each normal, (d . t)^2, square metres."""
    half_baseline_squared: Float[Array, "*paths"]
    """Square of the half baseline, square metres."""
    exists: Bool[Array, "*paths points"]
    """Which of the points exist: a narrow detection range has fewer than the widest."""


def arc(path: EchoPaths, *, pitch: float, points: int) -> Arc:
    """Equidistant points over the detection range of ONE path (paper, section 4).

    Args:
        path: the echo path.
        pitch: wanted distance between points, radians; the range is cut into the nearest whole number of equal pieces,
            at least one, and each piece has its point in the middle.
        points: size of the result; a range that needs more points than this is covered by this many.
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
    arc: Arc, reach: Float[Array, ""], *, max_range: Float[Array, ""]
) -> tuple[Float[Array, " points"], Bool[Array, " points"]]:
    """Distances from the origin of the tangent lines at the points of ONE echo's arc.

    A missing echo (0 or NaN), one at or beyond the maximum range, and one shorter than the way from tx to rx, which no
    reflector can cause, have no lines.

    Args:
        arc: the arc's normals and constants.
        reach: half the path length of the echo, metres.
        max_range: half path length from which on there is no echo, metres.

    Returns:
        rho: metres, may be negative; 0 where there is no line.
        counts: which of the points are lines.
    """
    heard = (reach < max_range) & (reach * reach > arc.half_baseline_squared) & (reach > 0)  # False for NaN
    reach = jnp.where(heard, reach, 1)  # before the arithmetic, so that no gradient is NaN
    rho = arc.midpoint_normal + safe_sqrt(reach * reach - arc.baseline_tangent_squared)
    counts = arc.exists & heard
    return jnp.where(counts, rho, 0), counts


def arc_point(path: EchoPaths, reach: Float[Array, ""], theta: Float[Array, ""]) -> Float[Array, "2"]:
    """Point of ONE echo's arc whose tangent line has the normal direction theta, robot frame, metres."""
    n, t = normal(theta), tangent(theta)
    along, across = path.half_baseline @ n, path.half_baseline @ t
    height = safe_sqrt(reach * reach - across * across)
    # Gradient of the ellipse's support function sqrt(r^2 - (d.t)^2) + m.n with respect to the normal.
    slide = jnp.where(height > 0, across * along / jnp.where(height > 0, height, 1), 0)
    return path.midpoint + height * n + slide * t
