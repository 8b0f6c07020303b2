"""Ring, poses and reflectors together: Levenberg-Marquardt on the ranges of all echoes, linear in the number of scans.

Every echo touches two sensors, one pose and one or two reflectors. So the normal equations are an arrow: a small dense
block for the ring and the scene, and poses that hang on it and on their neighbors along the path (``arrow.py``); a
dense Jacobian of a thousand scans would hold a gigabyte.

The ring moves along modes: columns that say how offsets, speed of sound and positions change together, each scaled to
the standard deviation that is expected of it, so that every mode has the prior N(0, 1). What is held has no mode.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .array_geometry import Sensors
from .block_arrowhead import Arrow, covariances, eliminated, solved
from .geometry import normal, tangent, wrap_angle
from .landmarks import Landmarks, Reflection, landmark_in_robot_frame
from .measurement_model import expected_range, reported_range

_DAMPING = (1e-6, 1e-12, 1e8)  # relative to the diagonal: first, least, most
_ENOUGH = 1e-9  # relative decrease of the cost at which it ends


class EchoFactors(eqx.Module):
    """Echoes that come from known reflectors, scan by scan; rectangular, so what is missing has weight 0."""

    path: Int[Array, "*scans echoes"]
    """Row of the ring's ``paths``."""
    reported: Float[Array, "*scans echoes"]
    """Half path length as reported, metres."""
    reflection: Reflection
    """(scans, echoes) where each comes from."""
    weight: Float[Array, "*scans echoes"]
    """Inverse variance, 1 / square metres; 0 leaves an echo out."""


class Unknowns(eqx.Module):
    """What is estimated."""

    coordinates: Float[Array, " coordinates"]
    """Of the ring, in standard deviations of what is expected of them."""
    poses: Float[Array, "scans 3"]
    """world_from_robot: x, y (metres), theta (radians)."""
    landmarks: Float[Array, "reflectors 2"]
    """``Scene.parameters``."""


class LeastSquaresProblem(eqx.Module):
    """What is given."""

    sensors: Sensors
    """The ring to start from."""
    basis: Float[Array, "ring modes"]
    """Columns: change of offsets (sensors), logarithm of the speed of sound, positions (sensors x 2); metres. With two
    rows more the logarithms of how much too long the odometry's ways are, and too far its turns."""
    landmarks: Landmarks
    """The reflectors to start from."""
    factors: EchoFactors
    """The echoes."""
    prior_poses: Float[Array, "scans 3"]
    """The poses to start from."""
    prior_information: Float[Array, "scans 3"]
    """Inverse variance of each start pose, 1 / square metres and radians."""
    odometry: Float[Array, "scans 3"]
    """The next pose in the frame of each one; the last is not used."""
    odometry_information: Float[Array, "scans 3"]
    """Inverse variance of the odometry; 0 where there is none, and for the last one."""
    landmark_prior_sd: float = eqx.field(default=1.0, static=True)
    """Metres, radians; how far a reflector may lie from its start (one standard deviation): none is undetermined."""


class LeastSquaresSolution(eqx.Module):
    """The result, and how well it is known."""

    unknowns: Unknowns
    cost: Float[Array, ""]
    """Half the weighted sum of squares, priors included."""
    initial_cost: Float[Array, ""]
    """The same at the start."""
    covariance: Float[Array, "shared shared"]
    """Of modes and scene parameters, poses accounted for; (0, 0) where it was not asked for."""
    iterations: Int[Array, ""]
    """Steps taken."""


def apply_parameters(sensors: Sensors, change: Float[Array, " ring"]) -> Sensors:
    """The ring after a change of (offsets, logarithm of the speed of sound, positions), as columns of modes are.

    What may follow in such a column is of the odometry, not of the ring.
    """
    count = sensors.heading.shape[0]
    offset, speed, place = change[:count], change[count], change[count + 1 : 3 * count + 1]
    return eqx.tree_at(
        lambda s: (s.range_offset, s.range_scale, s.position),
        sensors,
        (
            sensors.range_offset + offset,
            sensors.range_scale * jnp.exp(speed),
            sensors.position + place.reshape(count, 2),
        ),
    )


@jax.jit
def residuals(problem: LeastSquaresProblem, unknowns: Unknowns) -> Float[Array, "scans echoes"]:
    """Reported minus expected range of every echo, metres; differentiable in the unknowns.

    Echoes of weight 0 have a residual, too; it means nothing.
    """
    sensors = apply_parameters(problem.sensors, problem.basis @ unknowns.coordinates)
    scene = _at(problem.landmarks, unknowns.landmarks)

    def one(path, reported, reflection, pose):
        local, reflectors = echo_geometry(sensors, scene, path, reflection, pose)
        return reported - predicted_report(local, reflectors, reflection.kind)

    each_echo = jax.vmap(one, in_axes=(0, 0, 0, None))
    heard = problem.factors
    return jax.vmap(each_echo)(heard.path, heard.reported, heard.reflection, unknowns.poses)


@jax.jit
def cost(problem: LeastSquaresProblem, unknowns: Unknowns) -> Float[Array, ""]:
    """Half the weighted sum of squares of the residuals and of what was expected of modes, poses and reflectors."""
    total = (problem.factors.weight * residuals(problem, unknowns) ** 2).sum() + (unknowns.coordinates**2).sum()
    total += (((unknowns.landmarks - problem.landmarks.parameters) / problem.landmark_prior_sd) ** 2).sum()
    total += (problem.prior_information * _pose_difference(unknowns.poses, problem.prior_poses) ** 2).sum()
    if len(problem.prior_poses) > 1:
        steps = (unknowns.poses[:-1], unknowns.poses[1:], problem.odometry[:-1])
        slips = jax.vmap(odometry_residual, in_axes=(0, 0, 0, None))(*steps, _odometry_scale(problem, unknowns))
        total += (problem.odometry_information[:-1] * slips**2).sum()
    return total / 2


@partial(jax.jit, static_argnames=("poses_free", "most"))
def adjust(
    problem: LeastSquaresProblem, unknowns: Unknowns, *, poses_free: bool, most: int = 20
) -> LeastSquaresSolution:
    """Least squares on the ranges, from a start within the basin.

    Args:
        problem: echoes, start and priors.
        unknowns: where to begin.
        poses_free: whether the poses are estimated; they stay as they begin otherwise.
        most: steps at most, refused ones included.
    """

    def step(state):
        now, value, damping, count, _ = state
        shift = _shift(problem, _linearised(problem, now, poses_free), damping)
        trial = jax.tree.map(jnp.add, now, shift)
        then = cost(problem, trial)
        better = then <= value * (1 + rounding)  # False for NaN
        now = jax.tree.map(lambda new, old: jnp.where(better, new, old), trial, now)
        done = better & (value - then <= _ENOUGH * value)
        _, least, greatest = _DAMPING
        damping = jnp.clip(jnp.where(better, damping / 10, damping * 30), least, greatest)
        done |= damping >= greatest
        return now, jnp.where(better, then, value), damping, count + 1, done

    before = cost(problem, unknowns)
    rounding = max(_ENOUGH / 1000, 16 * float(jnp.finfo(before.dtype).eps))  # at the minimum the cost falls no more
    start = (unknowns, before, jnp.asarray(_DAMPING[0], before.dtype), jnp.asarray(0), jnp.asarray(False))
    found, value, _, count, _ = jax.lax.while_loop(lambda state: (state[3] < most) & ~state[4], step, start)
    known = eliminated(_linearised(problem, found, poses_free), jnp.zeros_like(value)).shared
    return LeastSquaresSolution(found, value, before, jnp.linalg.inv(known), count)


class Jacobians(eqx.Module):
    """The problem taken apart at a point: what is left of every term, and how the expected report or slip grows."""

    residual: Float[Array, " echoes"]
    """Reported minus expected range, metres."""
    d_range_d_coordinates: Float[Array, "echoes modes"]
    d_range_d_pose: Float[Array, "echoes 3"]
    d_range_d_first: Float[Array, "echoes 2"]
    d_range_d_second: Float[Array, "echoes 2"]
    """0 but for wall to wall."""
    odometry_residual: Float[Array, "steps 3"]
    """How far every pose is from where the odometry has it, seen from the one before: metres and radians."""
    d_odometry_d_from: Float[Array, "steps 3 3"]
    d_odometry_d_to: Float[Array, "steps 3 3"]
    d_odometry_d_coordinates: Float[Array, "steps 3 modes"]


@jax.jit
def linearize(
    problem: LeastSquaresProblem, unknowns: Unknowns, scan: Int[Array, " echoes"], echo: Int[Array, " echoes"]
) -> Jacobians:
    """Residuals and slopes of chosen echoes, and of all odometry.

    Args:
        problem: echoes and odometry; weights are not looked at.
        unknowns: where the slopes are taken.
        scan: row of each of the echoes.
        echo: its column.
    """
    sensors = apply_parameters(problem.sensors, problem.basis @ unknowns.coordinates)
    scene = _at(problem.landmarks, unknowns.landmarks)
    count = sensors.heading.shape[0]
    heard, modes = problem.factors, problem.basis
    place = modes[count + 1 : 3 * count + 1].reshape(count, 2, -1)

    def one(scan, echo):
        path, reported = heard.path[scan, echo], heard.reported[scan, echo]
        reflection = jax.tree.map(lambda leaf: leaf[scan, echo], heard.reflection)
        local, reflectors = echo_geometry(sensors, scene, path, reflection, unknowns.poses[scan])
        report, slope = jax.value_and_grad(predicted_report)(local, reflectors, reflection.kind)
        tx, rx = sensors.tx[path], sensors.rx[path]
        by_modes = slope.offset / 2 * (modes[tx] + modes[rx]) + slope.speed * modes[count]
        by_modes += slope.tx @ place[tx] + slope.rx @ place[rx]
        return reported - report, by_modes, slope.pose, slope.first, slope.second

    steps = (unknowns.poses[:-1], unknowns.poses[1:], problem.odometry[:-1])
    axes, scale = (0, 0, 0, None), _odometry_scale(problem, unknowns)
    slip = jax.vmap(odometry_residual, in_axes=axes)(*steps, scale)
    here, there, by_scale = jax.vmap(jax.jacfwd(odometry_residual, argnums=(0, 1, 3)), in_axes=axes)(*steps, scale)
    by_modes = by_scale @ modes[-2:] if _has_scale(problem) else jnp.zeros((*slip.shape, modes.shape[1]), slip.dtype)
    return Jacobians(*jax.vmap(one)(scan, echo), slip, here, there, by_modes)


@jax.jit
def pose_covariances(problem: LeastSquaresProblem, unknowns: Unknowns) -> Float[Array, "scans 3 3"]:
    """Of every pose (x, y, theta) by itself, at the minimum of the cost; ring and scene unknown as the problem has it.

    By a backward recursion over the chain of poses, O(shared^2) a scan.
    """
    _, poses = covariances(_linearised(problem, unknowns, poses_free=True))
    return poses


def _linearised(problem: LeastSquaresProblem, unknowns: Unknowns, poses_free: bool) -> Arrow:
    """The normal equations; shared are modes and scene parameters. No poses where they are held."""
    sensors = apply_parameters(problem.sensors, problem.basis @ unknowns.coordinates)
    scene = _at(problem.landmarks, unknowns.landmarks)
    count, ring = sensors.heading.shape[0], problem.basis.shape[0]
    size = ring + 2 * scene.kind.shape[0]

    def one_echo(path, reported, reflection, weight, pose):
        local, reflectors = echo_geometry(sensors, scene, path, reflection, pose)
        report, slope = jax.value_and_grad(predicted_report)(local, reflectors, reflection.kind)
        tx, rx = sensors.tx[path], sensors.rx[path]
        pair = jnp.arange(2, dtype=tx.dtype)
        column = jnp.concatenate(
            [
                jnp.stack([tx, rx, jnp.asarray(count, tx.dtype)]),
                *(count + 1 + 2 * sensor + pair for sensor in (tx, rx)),
                *(ring + 2 * row + pair for row in (reflection.first, reflection.second)),
            ]
        )
        value = jnp.concatenate(
            [
                jnp.stack([slope.offset / 2, slope.offset / 2, slope.speed]),
                *(slope.tx, slope.rx, slope.first, slope.second),
            ]
        )
        keep = weight > 0
        return column, jnp.where(keep, value, 0), jnp.where(keep, slope.pose, 0), jnp.where(keep, reported - report, 0)

    def one_scan(carry, scan):
        heard, pose = scan
        echo = (heard.path, heard.reported, heard.reflection, heard.weight)
        column, value, turn, left = jax.vmap(one_echo, in_axes=(0, 0, 0, 0, None))(*echo, pose)
        weighted = heard.weight[:, None] * value
        h, g = carry
        # An echo has 11 slopes, however many reflectors there are.
        h = h.at[column[:, :, None], column[:, None, :]].add(weighted[:, :, None] * value[:, None, :])
        total = (h, g.at[column].add(weighted * left[:, None]))
        if not poses_free:
            return total, None
        pull = heard.weight[:, None] * turn
        cross = jnp.zeros((size, 3), h.dtype).at[column].add(weighted[:, :, None] * turn[:, None, :])
        return total, (cross.T, pull.T @ turn, pull.T @ left)

    zero = (jnp.zeros((size, size), unknowns.landmarks.dtype), jnp.zeros(size, unknowns.landmarks.dtype))
    (h, g), own = jax.lax.scan(one_scan, zero, (problem.factors, unknowns.poses))
    if own is None:
        none = jnp.zeros((0, 3, 3), h.dtype)
        arrow = Arrow(h, g, jnp.zeros((0, 3, size), h.dtype), none, none[:, 0], none)
    else:
        arrow = _with_links(problem, unknowns, Arrow(h, g, *own, jnp.zeros_like(own[1])))
    return _along_modes(problem, unknowns, arrow)


def _along_modes(problem: LeastSquaresProblem, unknowns: Unknowns, arrow: Arrow) -> Arrow:
    """From changes of the ring to its modes, with what is expected of these and of the reflectors."""
    modes, ring, h, g = problem.basis, problem.basis.shape[0], arrow.shared, arrow.shared_g
    reflectors = jnp.eye(len(g) - ring, dtype=h.dtype)
    shared = jnp.block(
        [
            [modes.T @ h[:ring, :ring] @ modes + jnp.eye(modes.shape[1], dtype=h.dtype), modes.T @ h[:ring, ring:]],
            [h[ring:, :ring] @ modes, h[ring:, ring:] + reflectors / problem.landmark_prior_sd**2],
        ]
    )
    strayed = (problem.landmarks.parameters - unknowns.landmarks).ravel() / problem.landmark_prior_sd**2
    shared_g = jnp.concatenate([modes.T @ g[:ring] - unknowns.coordinates, g[ring:] + strayed])
    cross = jnp.concatenate([arrow.cross[..., :ring] @ modes, arrow.cross[..., ring:]], axis=-1)
    return arrow._replace(shared=shared, shared_g=shared_g, cross=cross)


def _with_links(problem: LeastSquaresProblem, unknowns: Unknowns, arrow: Arrow) -> Arrow:
    """The normal equations with the anchors of the poses and the odometry between them."""
    start = problem.prior_information * _pose_difference(problem.prior_poses, unknowns.poses)
    pose = arrow.pose + jax.vmap(jnp.diag)(problem.prior_information)
    pose_g = arrow.pose_g + start
    if len(problem.prior_poses) < 2:
        return arrow._replace(pose=pose, pose_g=pose_g)
    scale = _odometry_scale(problem, unknowns)
    steps = (unknowns.poses[:-1], unknowns.poses[1:], problem.odometry[:-1])
    weight = problem.odometry_information[:-1]
    slip = jax.vmap(odometry_residual, in_axes=(0, 0, 0, None))(*steps, scale)
    by_here, by_there, by_scale = jax.vmap(
        jax.jacfwd(odometry_residual, argnums=(0, 1, 3)), in_axes=(0, 0, 0, None)
    )(*steps, scale)  # fmt: skip
    heavy_here, heavy_there = weight[:, :, None] * by_here, weight[:, :, None] * by_there
    pose = pose.at[:-1].add(_t(by_here) @ heavy_here).at[1:].add(_t(by_there) @ heavy_there)
    pull = -slip[:, :, None]
    pose_g = pose_g.at[:-1].add((_t(heavy_here) @ pull)[..., 0]).at[1:].add((_t(heavy_there) @ pull)[..., 0])
    following = arrow.next.at[:-1].set(_t(by_here) @ heavy_there)
    arrow = arrow._replace(pose=pose, pose_g=pose_g, next=following)
    if not _has_scale(problem):
        return arrow
    ring = problem.basis.shape[0]
    own = slice(ring - 2, ring)
    heavy = weight[:, :, None] * by_scale
    return arrow._replace(
        shared=arrow.shared.at[own, own].add((_t(by_scale) @ heavy).sum(axis=0)),
        shared_g=arrow.shared_g.at[own].add((_t(heavy) @ pull)[..., 0].sum(axis=0)),
        cross=arrow.cross.at[:-1, :, own].add(_t(heavy_here) @ by_scale).at[1:, :, own].add(_t(heavy_there) @ by_scale),
    )


def _shift(problem: LeastSquaresProblem, arrow: Arrow, damping: Float[Array, ""]) -> Unknowns:
    """The step of all unknowns."""
    shared, poses = solved(arrow, damping)
    modes = problem.basis.shape[1]
    held = jnp.zeros_like(problem.prior_poses)
    return Unknowns(shared[:modes], poses if len(arrow.pose) else held, shared[modes:].reshape(-1, 2))


class EchoGeometry(NamedTuple):
    """All that ONE report depends on."""

    tx: Float[Array, "2"]
    rx: Float[Array, "2"]
    offset: Float[Array, ""]  # mean of the two sensors
    speed: Float[Array, ""]  # logarithm of the range scale
    pose: Float[Array, "3"]
    first: Float[Array, "2"]  # parameters of the reflectors
    second: Float[Array, "2"]


def echo_geometry(
    sensors: Sensors, scene: Landmarks, path: Int[Array, ""], reflection: Reflection, pose: Float[Array, "3"]
) -> tuple[EchoGeometry, tuple[Landmarks, Landmarks]]:
    tx, rx = sensors.tx[path], sensors.rx[path]
    first, second = scene.take(reflection.first), scene.take(reflection.second)
    local = EchoGeometry(
        tx=sensors.position[tx],
        rx=sensors.position[rx],
        offset=(sensors.range_offset[tx] + sensors.range_offset[rx]) / 2,
        speed=jnp.log(sensors.range_scale),
        pose=pose,
        first=jnp.asarray(first.parameters),
        second=jnp.asarray(second.parameters),
    )
    return local, (first, second)


def predicted_report(
    local: EchoGeometry, reflectors: tuple[Landmarks, Landmarks], kind: Int[Array, ""]
) -> Float[Array, ""]:
    """What the path reports, metres."""
    first, second = (
        landmark_in_robot_frame(local.pose, eqx.tree_at(lambda r: r.parameters, reflector, parameters))
        for reflector, parameters in zip(reflectors, (local.first, local.second), strict=True)
    )
    reach = expected_range(kind, first, second, local.tx, local.rx)
    return reported_range(reach, range_offset=local.offset, range_scale=jnp.exp(local.speed))


def _has_scale(problem: LeastSquaresProblem) -> bool:
    return problem.basis.shape[0] > 3 * problem.sensors.heading.shape[0] + 1


def _odometry_scale(problem: LeastSquaresProblem, unknowns: Unknowns) -> Float[Array, "2"]:
    """Logarithms of how much too long the odometry's ways are, and too far its turns; 0 where they are no unknowns."""
    if not _has_scale(problem):
        return jnp.zeros(2, unknowns.poses.dtype)
    return problem.basis[-2:] @ unknowns.coordinates


def odometry_residual(
    here: Float[Array, "3"], there: Float[Array, "3"], odometry: Float[Array, "3"], scale: Float[Array, "2"]
) -> Float[Array, "3"]:
    """How far the next pose is from where the odometry has it, in the frame of this one: metres and radians."""
    way = there[:2] - here[:2]
    ahead = jnp.stack([normal(here[2]) @ way, tangent(here[2]) @ way])
    told = jnp.exp(-scale)
    turn = there[2:] - here[2:] - told[1:] * wrap_angle(odometry[2:])
    return jnp.concatenate([ahead - told[0] * odometry[:2], wrap_angle(turn)])


def _pose_difference(a: Float[Array, "scans 3"], b: Float[Array, "scans 3"]) -> Float[Array, "scans 3"]:
    return jnp.concatenate([a[:, :2] - b[:, :2], wrap_angle(a[:, 2:] - b[:, 2:])], axis=1)


def _at(scene: Landmarks, parameters: Float[Array, "reflectors 2"]) -> Landmarks:
    return eqx.tree_at(lambda s: s.parameters, scene, parameters)


def _t(matrices: Float[Array, "*many m n"]) -> Float[Array, "*many n m"]:
    return jnp.swapaxes(matrices, -1, -2)
