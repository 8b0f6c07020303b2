"""Which reflector explains the ranges: a plane, or a point (corner or edge), fitted to the echoes around a candidate.

The Hough step votes for planes only, but a corner or a post answers to many poses as well, and its tangent lines pile
up almost like those of a wall. The ranges themselves tell them apart: a wall's foot travels along with the sensor, a
point stays where it is. Both are fitted robustly: the scale of Geman and McClure's loss is lowered from step to step
(graduated non-convexity), so that echoes of other reflectors lose their weight.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from . import isorange_arcs as arcs
from .geometry import dot, fold_line, normal, safe_sqrt, tangent, towards
from .hough_voting import Echoes, RingArcs

_STEPS = 8
_WIDEST = 4.0  # the loss starts this many tolerances wide
_SLACK = 0.05  # rad; how far beyond its nominal cone a sensor may have heard something
_LONGEST_STEP = 0.1  # m and rad


Seen = tuple[Float[Array, ""], Float[Array, "2"], Float[Array, "2"]]
"""Range of a reflector (metres), its derivatives by the two parameters, and the unit vector it is heard from."""


class Heard(eqx.Module):
    """One echo, or the echoes of ONE model, in its frame."""

    tx: Float[Array, "*echoes 2"]
    """Transmitters when they fired, metres."""
    rx: Float[Array, "*echoes 2"]
    """Receivers, metres."""
    reach: Float[Array, "*echoes"]
    """Half path lengths, corrected, metres; 0 where there is no echo."""
    start: Float[Array, "*echoes"]
    """First direction from which the path hears a plane, radians."""
    width: Float[Array, "*echoes"]
    """Width of its detection range, radians."""


class Fits(eqx.Module):
    """Planes and points that explain the echoes around candidate lines; see ``fit_candidates``."""

    rho: Float[Array, "*lines"]
    """Distance of the fitted plane, metres, >= 0."""
    theta: Float[Array, "*lines"]
    """Direction of its normal, radians."""
    explained: Bool[Array, "*lines echoes"]
    """Echoes that the plane explains, to the tolerance."""
    foot: Float[Array, "*lines echoes"]
    """Where along the plane each echo's virtual sensor stands before it, metres from the foot of the origin."""
    plane_score: Float[Array, "*lines"]
    """Sum over the echoes of 1 - (residual / tolerance)^2, where positive: how much the plane explains."""
    point_score: Float[Array, "*lines"]
    """The same of the better one of a corner and an edge."""


def heard(ring: RingArcs, echoes: Echoes) -> Heard:
    """Where the sensors of every echo of ONE model stood, and how far the echo came from."""

    def one_echo(path, reported, pose):
        paths = jax.tree.map(lambda leaf: leaf[path], ring.paths)
        reach = arcs.corrected_range(reported, range_offset=paths.range_offset, range_scale=ring.range_scale)
        reach = jnp.where(reach < ring.max_range, reach, 0)
        tx, rx, start = paths.midpoint - paths.half_baseline, paths.midpoint + paths.half_baseline, paths.start
        if pose is not None:
            forward, left = normal(pose[2]), tangent(pose[2])
            tx = pose[:2] + tx[0] * forward + tx[1] * left
            rx = pose[:2] + rx[0] * forward + rx[1] * left
            start = start + pose[2]
        return Heard(tx, rx, jnp.maximum(reach, 0), start, paths.width)

    poses = None if echoes.pose is None else 0
    return jax.vmap(one_echo, in_axes=(0, 0, poses))(echoes.path, echoes.range, echoes.pose)


def fit(
    model: Callable[[Float[Array, "2"], Heard], Seen],
    start: Float[Array, "2"],
    echoes: Heard,
    *,
    tolerance: float | Float[Array, ""],
    widest: float | Float[Array, ""] | None = None,
) -> tuple[Float[Array, "2"], Float[Array, " echoes"]]:
    """Robust Gauss-Newton fit of ONE reflector with two parameters to the echoes of ONE model.

    Args:
        model: how an echo hears the reflector.
        start: first guess.
        echoes: all echoes, those of other reflectors included.
        tolerance: residual up to which an echo counts as explained, metres.
        widest: scale of the loss in the first step, metres; four tolerances if left out.

    Returns:
        The parameters, and how well they explain every echo: 1 - (residual / tolerance)^2, at least 0.
    """
    last = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), echoes)  # loops over the echoes run along the memory
    middle, border = normal(echoes.start + echoes.width / 2).T, jnp.cos(jnp.minimum(echoes.width / 2 + _SLACK, jnp.pi))

    def look(x):
        def one(echo: Heard, middle, border):
            predicted, slope, direction = model(x, echo)
            audible = (echo.reach > 0) & (dot(direction, middle) >= border)
            return audible, echo.reach - predicted, slope

        return jax.vmap(one, in_axes=-1, out_axes=-1)(last, middle, border)

    def step(x, scale):
        audible, residual, (along, across) = look(x)
        root = jnp.where(audible, 1 / (1 + (residual / scale) ** 2), 0)
        weight = root * root
        pull = weight * residual
        xx, xy, yy = ((weight * a * b).sum() for a, b in ((along, along), (along, across), (across, across)))
        gx, gy = (along * pull).sum(), (across * pull).sum()
        damping = 1e-4 * (xx + yy) + 1e-9
        xx, yy = xx + damping, yy + damping
        move = jnp.stack([yy * gx - xy * gy, xx * gy - xy * gx]) / (xx * yy - xy * xy)
        return x + jnp.clip(move, -_LONGEST_STEP, _LONGEST_STEP), None

    widest = _WIDEST * tolerance if widest is None else widest
    scales = tolerance * (widest / tolerance) ** jnp.linspace(1, 0, _STEPS, dtype=start.dtype)
    x, _ = jax.lax.scan(step, start, scales)
    audible, residual, _ = look(x)
    return x, jnp.where(audible, jnp.maximum(1 - (residual / tolerance) ** 2, 0), 0)


def plane(line: Float[Array, "2"], echo: Heard) -> Seen:
    """A wall (rho, theta), by the image source; a robot that has passed it hears its back."""
    n, t = normal(line[1]), tangent(line[1])
    middle, half = (echo.tx + echo.rx) / 2, (echo.rx - echo.tx) / 2
    height, across = line[0] - dot(middle, n), dot(half, t)
    reach = safe_sqrt(height * height + across * across)
    inverse = 1 / jnp.where(reach > 0, reach, 1)
    turn = -(height * dot(middle, t) + across * dot(half, n))
    return reach, jnp.stack([height * inverse, turn * inverse]), jnp.where(height >= 0, n, -n)


def corner(place: Float[Array, "2"], echo: Heard) -> Seen:
    """A right-angled corner."""
    reach, direction = towards(place - (echo.tx + echo.rx) / 2)
    return reach, direction, direction


def edge(place: Float[Array, "2"], echo: Heard) -> Seen:
    """An edge or a thin pole."""
    (out, departure), (back, arrival) = towards(place - echo.tx), towards(place - echo.rx)
    _, direction = towards(place - (echo.tx + echo.rx) / 2)
    return (out + back) / 2, (departure + arrival) / 2, direction


@partial(jax.jit, static_argnames="tolerance")
def fit_candidates(
    ring: RingArcs,
    echoes: Echoes,
    rho: Float[Array, "scans lines"],
    theta: Float[Array, "scans lines"],
    *,
    tolerance: float,
) -> Fits:
    """Fit a plane, a corner and an edge to the echoes around every candidate line of a batch of scans.

    Args:
        ring: arcs of the ring's paths.
        echoes: (scans, echoes) packed echoes.
        rho: distances of the candidates, metres; NaN where there is none.
        theta: directions of their normals, radians.
        tolerance: residual up to which an echo counts as explained, metres.
    """

    def one_scan(scan: Echoes, rho: Float[Array, " lines"], theta: Float[Array, " lines"]) -> Fits:
        echo = heard(ring, scan)
        middle = (echo.tx + echo.rx) / 2

        def one_candidate(rho: Float[Array, ""], theta: Float[Array, ""]) -> Fits:
            line, score = fit(plane, jnp.stack([rho, theta]), echo, tolerance=tolerance)
            foot = middle @ tangent(line[1])
            mean = (score * foot).sum() / jnp.maximum(score.sum(), 1e-6)
            place = line[0] * normal(line[1]) + mean * tangent(line[1])
            points = [fit(model, place, echo, tolerance=tolerance)[1].sum() for model in (corner, edge)]
            rho, theta = fold_line(line[0], line[1])
            return Fits(rho, theta, score > 0, middle @ tangent(theta), score.sum(), jnp.maximum(*points))

        return jax.vmap(one_candidate)(rho, theta)

    return jax.lax.map(lambda one: one_scan(*one), (echoes, rho, theta))
