"""The measurement model: the range that ONE echo path measures of ONE reflector, and the directions of the sound.

This is the only range model of planes, corners and edges in the kernels. ``jaxsonar.sensors.range_models`` is its NumPy
counterpart for code that cannot be compiled; the simulator has a geometry of its own, so that each checks the other.

A reflector has two parameters: (rho, theta) of a plane, (x, y) of a corner or an edge. A circle has three: (x, y,
radius), or (rho, theta, curvature), which is a plane at curvature 0. Robot frame, metres, radians. A range is half the
length of the path transmitter -> reflector -> receiver.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .planar_geometry import (
    dot,
    length,
    length_and_direction,
    mirror_point,
    normal,
    safe_sqrt,
    tangent,
    wrap_angle,
)
from .sensor_array import EchoPaths

PLANE, CORNER, EDGE = 0, 1, 2
"""Kinds of reflectors: a wall; a right-angled concave corner; an edge or a thin pole."""
SECOND_ORDER = 3
"""Kind of a reflection only: reflected at one plane, then at another."""
CIRCLE = 4
"""Kind of a reflector: a round column, a leg, a person, convex towards the sensors."""
REFLECTION_STEPS = 6
"""Steps of Newton's method to the point of reflection on a circle. In 20000 random geometries, sensors at most 0.6 m
apart needed 3 to reach the rounding error of double precision; sensors up to 3 m apart needed 7 (after 5: 0.1 um)."""


class PredictedEcho(eqx.Module):
    """What one path receives of one reflector."""

    range: Float[Array, "*paths"]
    """Half the path length, metres."""
    d_range_d_landmark: Float[Array, "*paths 2"]
    """Derivatives of the range with respect to the reflector's two parameters; 0 for second order."""
    departure: Float[Array, "*paths 2"]
    """Unit vector along which the sound leaves the transmitter."""
    arrival: Float[Array, "*paths 2"]
    """Unit vector from the receiver to where the sound comes from."""
    footpoint: Float[Array, "*paths"]
    """Planes: coordinate of the point of reflection along the tangent, metres from the foot of the origin; else 0."""
    exists: Bool[Array, "*paths"]
    """Whether the path is possible, cones aside; for a plane: both sensors are in front of it."""


class CurvedEcho(eqx.Module):
    """What one path receives of one reflector with three parameters."""

    range: Float[Array, "*paths"]
    """Half the path length, metres."""
    d_range_d_landmark: Float[Array, "*paths 3"]
    """Derivatives of the range with respect to the reflector's three parameters."""
    departure: Float[Array, "*paths 2"]
    """Unit vector along which the sound leaves the transmitter."""
    arrival: Float[Array, "*paths 2"]
    """Unit vector from the receiver to where the sound comes from."""
    exists: Bool[Array, "*paths"]
    """Whether the path is possible, cones aside: the circle is not between the sensors, and both are outside of it."""

    def as_predicted(self) -> PredictedEcho:
        """The echo of ONE path with the derivatives by the first two parameters only."""
        footpoint = jnp.zeros_like(self.range)
        slopes = self.d_range_d_landmark[:2]
        return PredictedEcho(self.range, slopes, self.departure, self.arrival, footpoint, self.exists)


# Ranges


class PlaneCoordinates(NamedTuple):
    """ONE path in the coordinates of a plane: components along its normal n and its tangent t."""

    normal: Float[Array, "2"]
    tangent: Float[Array, "2"]
    height: Float[Array, ""]
    """Distance from the path's midpoint to the plane, along n; negative behind the plane."""
    along: Float[Array, ""]
    """Midpoint . t"""
    baseline_normal: Float[Array, ""]
    """Half baseline . n"""
    baseline_tangent: Float[Array, ""]
    """Half baseline . t"""


def plane_coordinates(
    line: Float[Array, "2"], midpoint: Float[Array, "2"], half_baseline: Float[Array, "2"]
) -> PlaneCoordinates:
    """Express ONE path in the coordinates of the plane (rho, theta)."""
    n, t = normal(line[1]), tangent(line[1])
    height = line[0] - dot(midpoint, n)
    return PlaneCoordinates(n, t, height, dot(midpoint, t), dot(half_baseline, n), dot(half_baseline, t))


def image_source(
    path: PlaneCoordinates,
) -> tuple[Float[Array, ""], Float[Array, "2"], Float[Array, ""], Float[Array, ""]]:
    """Range of a plane echo by the image source, exact for direct and cross echoes; the height must not be 0.

    Returns:
        Range sqrt(height^2 + baseline_tangent^2), metres; its derivatives with respect to rho and theta; cosine and
        sine of the angle between the normal and the sound at the transmitter.
    """
    distance = jnp.sqrt(_squared_range(path))
    cosine, sine = path.height / distance, path.baseline_tangent / distance
    return distance, jnp.stack([cosine, -(cosine * path.along + sine * path.baseline_normal)]), cosine, sine


def _squared_range(path: PlaneCoordinates) -> Float[Array, ""]:
    return path.height * path.height + path.baseline_tangent * path.baseline_tangent


def plane_range(
    line: Float[Array, "2"], midpoint: Float[Array, "2"], half_baseline: Float[Array, "2"]
) -> Float[Array, ""]:
    """Range of a plane (rho, theta) with rho of either sign, metres; arguments as ``EchoPaths``."""
    return safe_sqrt(_squared_range(plane_coordinates(line, midpoint, half_baseline)))


def corner_range(corner: Float[Array, "2"], midpoint: Float[Array, "2"]) -> Float[Array, ""]:
    """Range of the double reflection in a right-angled corner, metres: its distance from the virtual sensor."""
    return length(corner - midpoint)


def edge_range(
    edge: Float[Array, "2"], midpoint: Float[Array, "2"], half_baseline: Float[Array, "2"]
) -> Float[Array, ""]:
    """Range of the diffraction at an edge or a thin pole, metres: the mean of its distances from tx and rx."""
    offset = edge - midpoint
    return (length(offset + half_baseline) + length(offset - half_baseline)) / 2


def circle_range(
    center: Float[Array, "2"],
    radius: Float[Array, ""],
    midpoint: Float[Array, "2"],
    half_baseline: Float[Array, "2"],
) -> Float[Array, ""]:
    """Range of the specular reflection at a circle, metres; radius 0 or more, metres."""
    tx, rx = midpoint - half_baseline, midpoint + half_baseline
    return reflection_on_arc(circle_arc(center, radius, midpoint), tx, rx).range


def second_order_range(
    first: Float[Array, "2"], second: Float[Array, "2"], midpoint: Float[Array, "2"], half_baseline: Float[Array, "2"]
) -> Float[Array, ""]:
    """Range of the reflection at a first plane, then at a second, metres: by the image of the image."""
    image = mirror_point(mirror_point(midpoint + half_baseline, second), first)
    return length(image - (midpoint - half_baseline)) / 2


def expected_range(
    kind: Int[Array, ""],
    first: Float[Array, "2"],
    second: Float[Array, "2"],
    tx: Float[Array, "2"],
    rx: Float[Array, "2"],
    radius: Float[Array, ""] | None = None,
) -> Float[Array, ""]:
    """Range of ONE echo of any kind in metres; differentiable in everything but the kind.

    Args:
        kind: PLANE, CORNER, EDGE, SECOND_ORDER or CIRCLE.
        first: the reflector in the robot frame (``landmark_in_robot_frame``).
        second: the plane that is met second; used by SECOND_ORDER only.
        tx: position of the transmitter in the robot frame, metres.
        rx: position of the receiver, metres.
        radius: of a circle, metres; None: there is no circle.
    """
    midpoint, half_baseline = (tx + rx) / 2, (rx - tx) / 2
    ranges = [
        plane_range(first, midpoint, half_baseline),
        corner_range(first, midpoint),
        edge_range(first, midpoint, half_baseline),
        second_order_range(first, second, midpoint, half_baseline),
    ]
    kinds = [PLANE, CORNER, EDGE, SECOND_ORDER]
    if radius is not None:
        ranges.append(circle_range(first, radius, midpoint, half_baseline))
        kinds.append(CIRCLE)
    return jnp.select([kind == k for k in kinds], ranges, jnp.zeros_like(ranges[0]))


def reported_range(
    true_range: Float[Array, ""], *, range_offset: Float[Array, ""], range_scale: Float[Array, ""]
) -> Float[Array, ""]:
    """Range that a path reports for a true range, metres: the inverse of ``corrected_range``."""
    return true_range / range_scale + range_offset


def corrected_range(
    reported: Float[Array, ""], *, range_offset: Float[Array, ""], range_scale: Float[Array, ""]
) -> Float[Array, ""]:
    """True range of ONE echo from the reported one, metres; 0 for NaN or inf, which mean that there is no echo."""
    finite = jnp.isfinite(reported)
    reported = jnp.where(finite, reported, 1)  # before the arithmetic, so that no gradient is NaN
    return jnp.where(finite, (reported - range_offset) * range_scale, 0)


# Echoes: ranges with derivatives and directions


def plane_echo(line: Float[Array, "2"], path: EchoPaths) -> PredictedEcho:
    """Echo of a wall (rho, theta), by the image source."""
    here = plane_coordinates(line, path.midpoint, path.half_baseline)
    in_front = here.height > jnp.abs(here.baseline_normal)
    here = here._replace(height=jnp.where(in_front, here.height, 1))
    distance, d_line, cosine, sine = image_source(here)
    return PredictedEcho(
        range=distance,
        d_range_d_landmark=d_line,
        departure=cosine * here.normal + sine * here.tangent,
        arrival=cosine * here.normal - sine * here.tangent,
        footpoint=here.along + here.baseline_tangent * here.baseline_normal / here.height,
        exists=in_front,
    )


def corner_echo(corner: Float[Array, "2"], path: EchoPaths) -> PredictedEcho:
    """Echo of a right-angled corner: double reflection, as if the virtual sensor were transmitter and receiver."""
    distance, direction = length_and_direction(corner - path.midpoint)
    return PredictedEcho(distance, direction, direction, direction, jnp.zeros_like(distance), distance > 0)


def edge_echo(edge: Float[Array, "2"], path: EchoPaths) -> PredictedEcho:
    """Echo of an edge or a thin pole: diffraction, with a leg from the transmitter and a leg to the receiver."""
    out, departure = length_and_direction(edge - path.midpoint + path.half_baseline)
    back, arrival = length_and_direction(edge - path.midpoint - path.half_baseline)
    gradient = (departure + arrival) / 2
    return PredictedEcho((out + back) / 2, gradient, departure, arrival, jnp.zeros_like(out), (out > 0) & (back > 0))


def point_echo(is_edge: Float[Array, ""], point: Float[Array, "2"], path: EchoPaths) -> PredictedEcho:
    """Echo of an edge (1) or a corner (0), in one program: a corner is an edge seen from the virtual sensor."""
    return edge_echo(point, eqx.tree_at(lambda p: p.half_baseline, path, is_edge * path.half_baseline))


def second_order_echo(first: Float[Array, "2"], second: Float[Array, "2"], path: EchoPaths) -> PredictedEcho:
    """Echo that is reflected at one plane (rho, theta), then at another, by the image of the image."""
    tx, rx = path.midpoint - path.half_baseline, path.midpoint + path.half_baseline
    tx_image, rx_image = mirror_point(tx, first), mirror_point(rx, second)
    distance, departure = length_and_direction(mirror_point(rx_image, first) - tx)
    _, arrival = length_and_direction(mirror_point(tx_image, second) - rx)
    # The straight line from tx_image to rx_image must cross the first plane before the second; each sensor must be in
    # front of its own plane, each image in front of the other plane.
    tx_height, rx_height = _height(tx, first), _height(rx, second)
    rx_image_height, tx_image_height = _height(rx_image, first), _height(tx_image, second)
    heights = jnp.minimum(jnp.minimum(tx_height, rx_height), jnp.minimum(rx_image_height, tx_image_height))
    exists = (heights > 0) & (tx_height * rx_height < tx_image_height * rx_image_height)
    return PredictedEcho(
        distance / 2, jnp.zeros(2, distance.dtype), departure, arrival, jnp.zeros_like(distance), exists
    )


def _height(point: Float[Array, "2"], line: Float[Array, "2"]) -> Float[Array, ""]:
    return line[0] - dot(point, normal(line[1]))


def echo_of_kind(kind: Int[Array, ""], *echoes: PredictedEcho) -> PredictedEcho:
    """Choose by kind from the echoes of PLANE, CORNER, ..., in this order; not existing for any other kind."""
    chosen = jax.tree.map(jnp.zeros_like, echoes[0])
    for k, echo in enumerate(echoes):
        chosen = jax.tree.map(lambda new, old, k=k: jnp.where(kind == k, new, old), echo, chosen)
    return chosen


def reflector_echo(kind: Int[Array, ""], reflector: Float[Array, "2"], path: EchoPaths) -> PredictedEcho:
    """Echo of ONE reflector of kind PLANE, CORNER or EDGE; does not exist for any other kind."""
    models = (plane_echo, corner_echo, edge_echo)
    return echo_of_kind(kind, *(model(reflector, path) for model in models))


# Circles


class CircularArc(NamedTuple):
    """A curve of constant curvature: foot + (speed / rate) (sin(rate u) t + (1 - cos(rate u)) n) at the coordinate u.

    Rate 1 and speed a give a circle of radius a, for which u is an angle, and which may shrink to a point. Rate kappa
    and speed 1 give a circle of curvature kappa, for which u is the arc length, and which may straighten to a line.
    """

    foot: Float[Array, "2"]
    """Point at u = 0, metres."""
    normal: Float[Array, "2"]
    """Unit normal n at the foot, towards the center of the circle, away from the sensors."""
    rate: Float[Array, ""]
    """Rotation of the tangent per unit of u, radians."""
    speed: Float[Array, ""]
    """Length of the curve per unit of u, metres."""


def circle_arc(center: Float[Array, "2"], radius: Float[Array, ""], midpoint: Float[Array, "2"]) -> CircularArc:
    """A circle by its center and radius, with the foot nearest to a path's midpoint."""
    towards = length_and_direction(center - midpoint)[1]
    return CircularArc(center - radius * towards, towards, jnp.ones_like(radius), radius)


class ArcReflection(NamedTuple):
    """The specular reflection of ONE path at an arc."""

    range: Float[Array, ""]
    departure: Float[Array, "2"]
    arrival: Float[Array, "2"]
    normal: Float[Array, "2"]
    """Unit normal of the arc at the point of reflection."""
    coordinate: Float[Array, ""]
    """The point's coordinate u."""
    exists: Bool[Array, ""]


def reflection_on_arc(arc: CircularArc, tx: Float[Array, "2"], rx: Float[Array, "2"]) -> ArcReflection:
    """Shortest path tx -> arc -> rx, where the angles of incidence and reflection are equal.

    The path is stationary, so that its derivatives do not depend on the solver's. The last step of Newton's method is
    differentiable nevertheless, which makes second derivatives correct, too.
    """
    start = jax.lax.stop_gradient((arc, tx, rx))
    u, ends, outside = _first_coordinate(*start)
    low, high = jnp.minimum(*ends), jnp.maximum(*ends)
    u = jax.lax.fori_loop(0, REFLECTION_STEPS, lambda _, u: jnp.clip(_newton_step(*start, u), low, high), u)
    u = _newton_step(arc, tx, rx, jax.lax.stop_gradient(u))
    point, normal_here = _point_on_arc(arc, u)
    out, departure = length_and_direction(point - tx)
    back, arrival = length_and_direction(point - rx)
    exists = outside & (dot(departure, normal_here) > 0) & (dot(arrival, normal_here) > 0)
    return ArcReflection((out + back) / 2, departure, arrival, normal_here, u, exists)


def _first_coordinate(
    arc: CircularArc, tx: Float[Array, "2"], rx: Float[Array, "2"]
) -> tuple[Float[Array, ""], tuple[Float[Array, ""], Float[Array, ""]], Bool[Array, ""]]:
    """First estimate of the point of reflection, exact for a line, a point and nearby sensors.

    Returns:
        Its coordinate, the coordinates of the points nearest to tx and rx, between which the reflection must be, and
        whether both sensors are outside of the circle.
    """
    rate = jnp.where(jnp.abs(arc.rate) < 1e-9, 1e-9, arc.rate)
    (q_tx, h_tx, angle_tx), (q_rx, h_rx, angle_rx) = (_polar(arc, rate, sensor) for sensor in (tx, rx))
    outside = (h_tx > 0) & (h_rx > 0)
    # Small angles: tan(incidence) = q / h * angle from the normal through the sensor.
    share = jnp.where(outside, q_rx * h_tx / jnp.where(outside, q_tx * h_rx + q_rx * h_tx, 1), 0.5)
    first, span = angle_tx / rate, wrap_angle(angle_rx - angle_tx) / rate
    return first + share * span, (first, first + span), outside


def _polar(
    arc: CircularArc, rate: Float[Array, ""], sensor: Float[Array, "2"]
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Distance of a sensor from the center times the rate, its distance from the arc, and its angle rate * u."""
    along, height = _in_frame(arc, sensor - arc.foot)
    across, depth = rate * along, arc.speed - rate * height
    q = safe_sqrt(across * across + depth * depth)
    # h = (q - speed) / rate without cancellation.
    h = (rate * (along * along + height * height) - 2 * arc.speed * height) / jnp.where(
        q + arc.speed > 0, q + arc.speed, 1
    )
    return q, h, jnp.arctan2(across, depth)


def _in_frame(arc: CircularArc, vector: Float[Array, "2"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Components of a vector along the tangent and the normal at the arc's foot."""
    n = arc.normal
    return n[0] * vector[1] - n[1] * vector[0], dot(n, vector)


def _point_on_arc(arc: CircularArc, u: Float[Array, ""]) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Point of an arc at a coordinate, and the unit normal there."""
    n, t = arc.normal, jnp.stack([-arc.normal[1], arc.normal[0]])
    angle = arc.rate * u
    half = sinc(angle / 2)
    point = arc.foot + arc.speed * u * (sinc(angle) * t + angle / 2 * half * half * n)
    return point, jnp.cos(angle) * n - jnp.sin(angle) * t


def _newton_step(
    arc: CircularArc, tx: Float[Array, "2"], rx: Float[Array, "2"], u: Float[Array, ""]
) -> Float[Array, ""]:
    """One step towards the coordinate at which the length of the path is stationary."""
    point, n = _point_on_arc(arc, u)
    (out, e_tx), (back, e_rx) = length_and_direction(point - tx), length_and_direction(point - rx)
    t = jnp.stack([-n[1], n[0]])
    slope = dot(e_tx + e_rx, t)
    bend = sum(dot(e, n) ** 2 / jnp.where(d > 0, d, 1) for e, d in ((e_tx, out), (e_rx, back)))
    curvature = arc.rate * dot(e_tx + e_rx, n) + arc.speed * bend
    return u - slope / jnp.where(curvature > 1e-9, curvature, jnp.inf)


def sinc(x: Float[Array, ""]) -> Float[Array, ""]:
    """sin(x) / x with exact derivatives at and near 0."""
    small = jnp.abs(x) < 0.5
    square = jnp.where(small, x * x, 0)
    series = jnp.ones_like(x)
    for k in (7, 6, 5, 4, 3, 2, 1):
        series = 1 - series * square / (2 * k * (2 * k + 1))
    return jnp.where(small, series, jnp.sin(x) / jnp.where(small, 1, x))


def circle_echo(center: Float[Array, "2"], radius: Float[Array, ""], path: EchoPaths) -> CurvedEcho:
    """Echo of a circle (x, y, radius): specular reflection; derivatives by x, y and the radius."""
    tx, rx = path.midpoint - path.half_baseline, path.midpoint + path.half_baseline
    found = reflection_on_arc(circle_arc(center, radius, path.midpoint), tx, rx)
    mean = (found.departure + found.arrival) / 2
    d_landmark = jnp.stack([mean[0], mean[1], -dot(mean, found.normal)])
    return CurvedEcho(found.range, d_landmark, found.departure, found.arrival, found.exists)


def curved_echo(parameters: Float[Array, "3"], path: EchoPaths) -> CurvedEcho:
    """Echo of a curved reflector (rho, theta, kappa): a plane for kappa = 0, a circle of radius 1 / kappa otherwise.

    The circle touches the plane (rho, theta) on its far side, at the point nearest to the origin: its center is
    (rho + 1 / kappa) normal(theta). Exact from kappa = 0 to poles of a millimetre, kappa = 1000 per metre. Negative
    curvatures (concave surfaces) are valid while the sensors are much nearer to the surface than its center is.

    Args:
        parameters: rho in metres, theta in radians, kappa per metre.
        path: the echo path.
    """
    rho, theta, kappa = parameters[0], parameters[1], parameters[2]
    n = normal(theta)
    tx, rx = path.midpoint - path.half_baseline, path.midpoint + path.half_baseline
    found = reflection_on_arc(CircularArc(rho * n, n, kappa, jnp.ones_like(kappa)), tx, rx)
    cosine = dot(found.departure + found.arrival, found.normal) / 2
    u, angle = found.coordinate, kappa * found.coordinate
    half = u * sinc(angle / 2)
    # Displacement of the surface along its normal at the point of reflection, per unit of each parameter.
    moved = jnp.stack([jnp.cos(angle), -(rho * jnp.sin(angle) + u * sinc(angle)), half * half / 2])
    return CurvedEcho(found.range, cosine * moved, found.departure, found.arrival, found.exists)
