"""Residuals and Jacobians of the bundle adjustment of ring parameters, poses and landmarks on the echo ranges.

Every echo depends on two sensors, one pose and one or two landmarks. Derivatives are therefore taken per echo, with
respect to these few quantities; a dense Jacobian of a thousand scans would take a gigabyte.

The ring parameters (range offsets, logarithm of the speed of sound, positions) are linear in the coordinates of a
reduced basis. Each column of the basis is scaled to its prior standard deviation, so that every coordinate has the
prior N(0, 1). A parameter that is held fixed is in no column.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .landmarks import Landmarks, Reflection, landmark_in_robot_frame
from .measurement_model import expected_range, reported_range
from .planar_geometry import rotate, rotate_back, wrap_angle
from .sensor_array import SensorArray


class EchoFactors(eqx.Module):
    """Echoes that are assigned to landmarks, scan by scan; a rectangle in which missing echoes have weight 0."""

    path: Int[Array, "*scans echoes"]
    """Row of the ring's ``paths``."""
    reported: Float[Array, "*scans echoes"]
    """Reported half path length, metres."""
    reflection: Reflection
    """(scans, echoes) the landmarks that cause each echo."""
    weight: Float[Array, "*scans echoes"]
    """Inverse variance, 1 / square metres; 0 leaves an echo out."""
    motion: Float[Array, "*scans echoes 3"] | None = None
    """scan_from_robot when each path was measured: x, y (metres), theta (radians); None: the robot was at rest."""


class Unknowns(eqx.Module):
    """The estimated quantities."""

    coordinates: Float[Array, " coordinates"]
    """Of the ring parameters in the basis, in prior standard deviations."""
    poses: Float[Array, "scans 3"]
    """world_from_robot: x, y (metres), theta (radians)."""
    landmarks: Float[Array, "landmarks 2"]
    """``Landmarks.parameters``."""


class LeastSquaresProblem(eqx.Module):
    """Measurements and priors."""

    sensors: SensorArray
    """The ring at coordinates 0."""
    basis: Float[Array, "parameters coordinates"]
    """Columns: changes of the range offsets (sensors), of the logarithm of the speed of sound, and of the positions
    (sensors x 2); metres. Two more rows, if present: logarithms of the scale of the odometry's displacements and
    rotations."""
    landmarks: Landmarks
    """Prior means of the landmarks."""
    factors: EchoFactors
    """The echoes."""
    prior_poses: Float[Array, "scans 3"]
    """Prior means of the poses."""
    prior_information: Float[Array, "scans 3"]
    """Inverse prior variances of the poses, 1 / square metres and radians."""
    odometry: Float[Array, "scans 3"]
    """The next pose in the frame of each pose, as measured; the last row is not used."""
    odometry_information: Float[Array, "scans 3"]
    """Inverse variances of the odometry; 0 where there is none. The last row is not used."""
    landmark_prior_sd: float = eqx.field(default=1.0, static=True)
    """Prior standard deviation of all landmark parameters, metres and radians; makes every landmark determined."""


class Jacobians(eqx.Module):
    """Residuals of echoes and odometry, and derivatives of their predictions."""

    residual: Float[Array, " echoes"]
    """Reported minus predicted range, metres."""
    d_range_d_coordinates: Float[Array, "echoes coordinates"]
    d_range_d_pose: Float[Array, "echoes 3"]
    d_range_d_first: Float[Array, "echoes 2"]
    """By the parameters of the first landmark."""
    d_range_d_second: Float[Array, "echoes 2"]
    """By the parameters of the second landmark; 0 unless the echo is of second order."""
    odometry_residual: Float[Array, "steps 3"]
    """Predicted minus measured steps, in the frame of the first pose: metres and radians."""
    d_odometry_d_from: Float[Array, "steps 3 3"]
    d_odometry_d_to: Float[Array, "steps 3 3"]
    d_odometry_d_coordinates: Float[Array, "steps 3 coordinates"]


def apply_parameters(sensors: SensorArray, change: Float[Array, " parameters"]) -> SensorArray:
    """The ring after a change of its parameters (offsets, logarithm of the speed of sound, positions).

    Args:
        sensors: the ring.
        change: as a column of ``LeastSquaresProblem.basis``; rows of the odometry are ignored.
    """
    count = sensors.heading.shape[0]
    offset, log_speed, position = change[:count], change[count], change[count + 1 : 3 * count + 1]
    return eqx.tree_at(
        lambda s: (s.range_offset, s.range_scale, s.position),
        sensors,
        (
            sensors.range_offset + offset,
            sensors.range_scale * jnp.exp(log_speed),
            sensors.position + position.reshape(count, 2),
        ),
    )


@jax.jit
def residuals(problem: LeastSquaresProblem, unknowns: Unknowns) -> Float[Array, "scans echoes"]:
    """Reported minus predicted range of every echo, metres; differentiable in the unknowns.

    The residual of an echo of weight 0 is meaningless.
    """
    sensors = apply_parameters(problem.sensors, problem.basis @ unknowns.coordinates)
    landmarks = problem.landmarks.with_parameters(unknowns.landmarks)

    def one_echo(path, reported, reflection, motion, pose):
        geometry, own = echo_geometry(sensors, landmarks, path, reflection, pose)
        return reported - predicted_report(geometry, own, reflection.kind, motion)

    each_echo = jax.vmap(one_echo, in_axes=(0, 0, 0, 0, None))
    factors = problem.factors
    echoes = (factors.path, factors.reported, factors.reflection, factors.motion)
    return jax.vmap(each_echo)(*echoes, unknowns.poses)


@jax.jit
def odometry_residuals(problem: LeastSquaresProblem, unknowns: Unknowns) -> Float[Array, "steps 3"]:
    """``odometry_residual`` of every step between consecutive poses; meaningless where there is no odometry."""
    steps = (unknowns.poses[:-1], unknowns.poses[1:], problem.odometry[:-1])
    return jax.vmap(odometry_residual, in_axes=(0, 0, 0, None))(*steps, _odometry_scale(problem, unknowns))


@jax.jit
def cost(problem: LeastSquaresProblem, unknowns: Unknowns) -> Float[Array, ""]:
    """Half the weighted sum of squares of echoes, odometry and the priors of coordinates, poses and landmarks."""
    total = (problem.factors.weight * residuals(problem, unknowns) ** 2).sum() + (unknowns.coordinates**2).sum()
    total += (((unknowns.landmarks - problem.landmarks.parameters) / problem.landmark_prior_sd) ** 2).sum()
    total += (problem.prior_information * _pose_difference(unknowns.poses, problem.prior_poses) ** 2).sum()
    if len(problem.prior_poses) > 1:
        total += (problem.odometry_information[:-1] * odometry_residuals(problem, unknowns) ** 2).sum()
    return total / 2


@jax.jit
def linearize(
    problem: LeastSquaresProblem, unknowns: Unknowns, scan: Int[Array, " echoes"], echo: Int[Array, " echoes"]
) -> Jacobians:
    """Residuals and Jacobians of selected echoes and of all odometry.

    Args:
        problem: echoes and odometry; weights are not used.
        unknowns: the point of linearization.
        scan: row of each selected echo.
        echo: its column.
    """
    sensors = apply_parameters(problem.sensors, problem.basis @ unknowns.coordinates)
    landmarks = problem.landmarks.with_parameters(unknowns.landmarks)
    count = sensors.heading.shape[0]
    factors, basis = problem.factors, problem.basis
    position_rows = basis[count + 1 : 3 * count + 1].reshape(count, 2, -1)

    def one_echo(scan, echo):
        path, reported = factors.path[scan, echo], factors.reported[scan, echo]
        reflection, motion = jax.tree.map(lambda leaf: leaf[scan, echo], (factors.reflection, factors.motion))
        geometry, own = echo_geometry(sensors, landmarks, path, reflection, unknowns.poses[scan])
        report, slope = jax.value_and_grad(predicted_report)(geometry, own, reflection.kind, motion)
        tx, rx = sensors.tx[path], sensors.rx[path]
        by_coordinates = slope.offset / 2 * (basis[tx] + basis[rx]) + slope.log_scale * basis[count]
        by_coordinates += slope.tx @ position_rows[tx] + slope.rx @ position_rows[rx]
        return reported - report, by_coordinates, slope.pose, slope.first, slope.second

    steps = (unknowns.poses[:-1], unknowns.poses[1:], problem.odometry[:-1])
    axes, scale = (0, 0, 0, None), _odometry_scale(problem, unknowns)
    residual = odometry_residuals(problem, unknowns)
    by_from, by_to, by_scale = jax.vmap(jax.jacfwd(odometry_residual, argnums=(0, 1, 3)), in_axes=axes)(*steps, scale)
    by_coordinates = jnp.zeros((*residual.shape, basis.shape[1]), residual.dtype)
    if _has_odometry_scale(problem):
        by_coordinates = by_scale @ basis[-2:]
    return Jacobians(*jax.vmap(one_echo)(scan, echo), residual, by_from, by_to, by_coordinates)


class EchoGeometry(NamedTuple):
    """Everything that ONE predicted range is differentiated by."""

    tx: Float[Array, "2"]
    rx: Float[Array, "2"]
    offset: Float[Array, ""]
    """Mean range offset of the two sensors."""
    log_scale: Float[Array, ""]
    """Logarithm of the range scale."""
    pose: Float[Array, "3"]
    first: Float[Array, "2"]
    """Parameters of the first landmark."""
    second: Float[Array, "2"]
    """Parameters of the second landmark."""


def echo_geometry(
    sensors: SensorArray, landmarks: Landmarks, path: Int[Array, ""], reflection: Reflection, pose: Float[Array, "3"]
) -> tuple[EchoGeometry, tuple[Landmarks, Landmarks]]:
    """What ONE echo depends on, and its two landmarks."""
    tx, rx = sensors.tx[path], sensors.rx[path]
    first, second = landmarks.take(reflection.first), landmarks.take(reflection.second)
    geometry = EchoGeometry(
        tx=sensors.position[tx],
        rx=sensors.position[rx],
        offset=(sensors.range_offset[tx] + sensors.range_offset[rx]) / 2,
        log_scale=jnp.log(sensors.range_scale),
        pose=pose,
        first=jnp.asarray(first.parameters),
        second=jnp.asarray(second.parameters),
    )
    return geometry, (first, second)


def predicted_report(
    geometry: EchoGeometry,
    landmarks: tuple[Landmarks, Landmarks],
    kind: Int[Array, ""],
    motion: Float[Array, "3"] | None = None,
) -> Float[Array, ""]:
    """The range that the path of ONE echo reports, metres.

    Args:
        geometry: what the range is differentiated by.
        landmarks: the first and the second landmark; their parameters are those of ``geometry``.
        kind: of the reflection.
        motion: scan_from_robot when the path was measured; None if the robot did not move since the scan's pose.
    """
    first, second = (
        landmark_in_robot_frame(geometry.pose, landmark.with_parameters(parameters))
        for landmark, parameters in zip(landmarks, (geometry.first, geometry.second), strict=True)
    )
    tx, rx = geometry.tx, geometry.rx
    if motion is not None:
        tx, rx = (motion[:2] + rotate(position, motion[2]) for position in (tx, rx))
    radius = landmarks[0].radius
    radius = None if radius is None else jnp.asarray(radius)
    true_range = expected_range(kind, first, second, tx, rx, radius)
    return reported_range(true_range, range_offset=geometry.offset, range_scale=jnp.exp(geometry.log_scale))


def odometry_residual(
    here: Float[Array, "3"], there: Float[Array, "3"], odometry: Float[Array, "3"], scale: Float[Array, "2"]
) -> Float[Array, "3"]:
    """Predicted minus measured odometry of ONE step, in the frame of its first pose: metres and radians.

    Args:
        here: world_from_robot at the beginning of the step.
        there: world_from_robot at its end.
        odometry: the measured step.
        scale: logarithms of the scale of measured displacements and rotations.
    """
    step = rotate_back(there[:2] - here[:2], here[2])
    unscale = jnp.exp(-scale)
    rotation = there[2:] - here[2:] - unscale[1:] * wrap_angle(odometry[2:])
    return jnp.concatenate([step - unscale[0] * odometry[:2], wrap_angle(rotation)])


def _has_odometry_scale(problem: LeastSquaresProblem) -> bool:
    return problem.basis.shape[0] > 3 * problem.sensors.heading.shape[0] + 1


def _odometry_scale(problem: LeastSquaresProblem, unknowns: Unknowns) -> Float[Array, "2"]:
    """Logarithms of the scale of the odometry's displacements and rotations; 0 unless they are estimated."""
    if not _has_odometry_scale(problem):
        return jnp.zeros(2, unknowns.poses.dtype)
    return problem.basis[-2:] @ unknowns.coordinates


def _pose_difference(a: Float[Array, "scans 3"], b: Float[Array, "scans 3"]) -> Float[Array, "scans 3"]:
    return jnp.concatenate([a[:, :2] - b[:, :2], wrap_angle(a[:, 2:] - b[:, 2:])], axis=1)
