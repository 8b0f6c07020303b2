"""Ring, poses and reflectors together: Levenberg-Marquardt on the ranges of all echoes, linear in the number of scans.

Every echo touches two sensors, one pose and one or two reflectors. So the normal equations are an arrow: a small dense
block for the ring and the scene, and poses that hang on it and on their neighbors along the path. The poses are
eliminated one after the other (Schur complement of a block tridiagonal matrix); a dense Jacobian of a thousand scans
would hold a gigabyte.

The ring moves along modes: columns that say how offsets, speed of sound and positions change together, each scaled to
the standard deviation that is expected of it, so that every mode has the prior N(0, 1). What is held has no mode.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .geometry import normal, tangent, wrap_angle
from .paths import Sensors
from .scene import Reflection, Scene, expected_range, expected_report, seen_from, take

_REFLECTOR = 1.0  # m, rad; how far a reflector may lie from its start: so that none is undetermined
_DAMPING = (1e-6, 1e-12, 1e8)  # relative to the diagonal: first, least, most
_ENOUGH = 1e-9  # relative decrease of the cost at which it ends


class Heard(eqx.Module):
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

    modes: Float[Array, " modes"]
    """Of the ring, in standard deviations of what is expected of them."""
    poses: Float[Array, "scans 3"]
    """world_from_robot: x, y (metres), theta (radians)."""
    scene: Float[Array, "reflectors 2"]
    """``Scene.parameters``."""


class Problem(eqx.Module):
    """What is given."""

    sensors: Sensors
    """The ring to start from."""
    modes: Float[Array, "ring modes"]
    """Columns: change of offsets (sensors), logarithm of the speed of sound, positions (sensors x 2); metres."""
    scene: Scene
    """The reflectors to start from."""
    heard: Heard
    """The echoes."""
    poses: Float[Array, "scans 3"]
    """The poses to start from."""
    anchored: Float[Array, "scans 3"]
    """Inverse variance of each start pose, 1 / square metres and radians."""
    odometry: Float[Array, "scans 3"]
    """The next pose in the frame of each one; the last is not used."""
    linked: Float[Array, "scans 3"]
    """Inverse variance of the odometry; 0 where there is none, and for the last one."""


class Adjusted(eqx.Module):
    """The result, and how well it is known."""

    unknowns: Unknowns
    cost: Float[Array, ""]
    """Half the weighted sum of squares, priors included."""
    before: Float[Array, ""]
    """The same at the start."""
    covariance: Float[Array, "shared shared"]
    """Of modes and scene parameters, poses accounted for."""
    steps: Int[Array, ""]
    """Steps taken."""


def moved_sensors(sensors: Sensors, change: Float[Array, " ring"]) -> Sensors:
    """The ring after a change of (offsets, logarithm of the speed of sound, positions), as columns of modes are."""
    count = sensors.heading.shape[0]
    offset, speed, place = change[:count], change[count], change[count + 1 :]
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
def residuals(problem: Problem, unknowns: Unknowns) -> Float[Array, "scans echoes"]:
    """Reported minus expected range of every echo, metres; differentiable in the unknowns.

    Echoes of weight 0 have a residual, too; it means nothing.
    """
    sensors = moved_sensors(problem.sensors, problem.modes @ unknowns.modes)
    scene = _at(problem.scene, unknowns.scene)

    def one(path, reported, reflection, pose):
        local, reflectors = _locally(sensors, scene, path, reflection, pose)
        return reported - _report(local, reflectors, reflection.kind)

    each_echo = jax.vmap(one, in_axes=(0, 0, 0, None))
    heard = problem.heard
    return jax.vmap(each_echo)(heard.path, heard.reported, heard.reflection, unknowns.poses)


@jax.jit
def cost(problem: Problem, unknowns: Unknowns) -> Float[Array, ""]:
    """Half the weighted sum of squares of the residuals and of what was expected of modes, poses and reflectors."""
    total = (problem.heard.weight * residuals(problem, unknowns) ** 2).sum() + (unknowns.modes**2).sum()
    total += (((unknowns.scene - problem.scene.parameters) / _REFLECTOR) ** 2).sum()
    total += (problem.anchored * _pose_difference(unknowns.poses, problem.poses) ** 2).sum()
    if len(problem.poses) > 1:
        slips = jax.vmap(_slip)(unknowns.poses[:-1], unknowns.poses[1:], problem.odometry[:-1])
        total += (problem.linked[:-1] * slips**2).sum()
    return total / 2


@partial(jax.jit, static_argnames=("poses_free", "most"))
def adjust(problem: Problem, unknowns: Unknowns, *, poses_free: bool, most: int = 20) -> Adjusted:
    """Least squares on the ranges, from a start within the basin.

    Args:
        problem: echoes, start and priors.
        unknowns: where to begin.
        poses_free: whether the poses are estimated; they stay as they begin otherwise.
        most: steps at most, refused ones included.
    """

    def step(state):
        now, value, damping, count, _ = state
        system = _linearised(problem, now, poses_free)
        shift = _shift(problem, system, damping, poses_free)
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
    reduced, _ = _reduced(_linearised(problem, found, poses_free), jnp.zeros_like(value), poses_free)
    return Adjusted(found, value, before, jnp.linalg.inv(reduced), count)


class _System(NamedTuple):
    """Normal equations H x = g, taken apart: ring and scene (shared), poses, and poses with their next ones."""

    shared: Float[Array, "shared shared"]
    shared_g: Float[Array, " shared"]
    cross: Float[Array, "scans 3 shared"]
    pose: Float[Array, "scans 3 3"]
    pose_g: Float[Array, "scans 3"]
    next: Float[Array, "scans 3 3"]


def _linearised(problem: Problem, unknowns: Unknowns, poses_free: bool) -> _System:
    sensors = moved_sensors(problem.sensors, problem.modes @ unknowns.modes)
    scene = _at(problem.scene, unknowns.scene)
    count, ring = sensors.heading.shape[0], problem.modes.shape[0]
    size = ring + 2 * scene.kind.shape[0]

    def one_echo(path, reported, reflection, weight, pose):
        local, reflectors = _locally(sensors, scene, path, reflection, pose)
        report, slope = jax.value_and_grad(_report)(local, reflectors, reflection.kind)
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
        row = jnp.zeros(size, value.dtype).at[column].add(value)
        keep = weight > 0
        return jnp.where(keep, row, 0), jnp.where(keep, slope.pose, 0), jnp.where(keep, reported - report, 0)

    def one_scan(carry, scan):
        heard, pose = scan
        echo = (heard.path, heard.reported, heard.reflection, heard.weight)
        row, turn, left = jax.vmap(one_echo, in_axes=(0, 0, 0, 0, None))(*echo, pose)
        weighted = heard.weight[:, None] * row
        total = (carry[0] + row.T @ weighted, carry[1] + weighted.T @ left)
        if not poses_free:
            return total, None
        pull = heard.weight[:, None] * turn
        return total, (turn.T @ weighted, pull.T @ turn, pull.T @ left)

    zero = (jnp.zeros((size, size), unknowns.scene.dtype), jnp.zeros(size, unknowns.scene.dtype))
    (h, g), own = jax.lax.scan(one_scan, zero, (problem.heard, unknowns.poses))
    # Along the modes, with what is expected of them and of the reflectors.
    modes, reflectors = problem.modes, jnp.eye(size - ring, dtype=h.dtype)
    shared = jnp.block(
        [
            [modes.T @ h[:ring, :ring] @ modes + jnp.eye(modes.shape[1], dtype=h.dtype), modes.T @ h[:ring, ring:]],
            [h[ring:, :ring] @ modes, h[ring:, ring:] + reflectors / _REFLECTOR**2],
        ]
    )
    strayed = (problem.scene.parameters - unknowns.scene).ravel() / _REFLECTOR**2
    shared_g = jnp.concatenate([modes.T @ g[:ring] - unknowns.modes, g[ring:] + strayed])
    if own is None:
        none = jnp.zeros((0, 3, 3), h.dtype)
        return _System(shared, shared_g, jnp.zeros((0, 3, shared.shape[0]), h.dtype), none, none[:, 0], none)
    cross, pose, pose_g = own
    cross = jnp.concatenate([cross[..., :ring] @ modes, cross[..., ring:]], axis=-1)
    return _with_priors(problem, unknowns, _System(shared, shared_g, cross, pose, pose_g, jnp.zeros_like(pose)))


def _with_priors(problem: Problem, unknowns: Unknowns, system: _System) -> _System:
    """The normal equations with the anchors of the poses and the odometry between them."""
    start = problem.anchored * _pose_difference(problem.poses, unknowns.poses)
    pose = system.pose + jax.vmap(jnp.diag)(problem.anchored)
    pose_g, following = system.pose_g + start, system.next
    if len(problem.poses) > 1:
        here, there = unknowns.poses[:-1], unknowns.poses[1:]
        odometry, weight = problem.odometry[:-1], problem.linked[:-1]
        slip = jax.vmap(_slip)(here, there, odometry)
        by_here, by_there = jax.vmap(jax.jacfwd(_slip, argnums=(0, 1)))(here, there, odometry)
        heavy_here, heavy_there = weight[:, :, None] * by_here, weight[:, :, None] * by_there
        pose = pose.at[:-1].add(_t(by_here) @ heavy_here).at[1:].add(_t(by_there) @ heavy_there)
        pull = -slip[:, :, None]
        pose_g = pose_g.at[:-1].add((_t(heavy_here) @ pull)[..., 0]).at[1:].add((_t(heavy_there) @ pull)[..., 0])
        following = following.at[:-1].set(_t(by_here) @ heavy_there)
    return system._replace(pose=pose, pose_g=pose_g, next=following)


def _reduced(system: _System, damping: Float[Array, ""], poses_free: bool):
    """The equations of ring and scene alone, and what it takes to come back to the poses."""
    shared = _damped(system.shared, damping)
    side = system.shared_g
    if not poses_free:
        return shared, (side, None)

    def eliminate(carry, one):
        shared, side, last, last_right, link = carry
        cross, pose, pose_g, following = one
        # What the pose before leaves of this one: link is H(before, this), last the inverse of the block before.
        into = link.T @ last
        pose = _damped(pose, damping) - into @ link
        right = jnp.concatenate([cross, pose_g[:, None]], axis=1) - into @ last_right
        inverse = jnp.linalg.inv(pose)
        folded = right.T @ inverse @ right
        shared, side = shared - folded[:-1, :-1], side - folded[:-1, -1]
        return (shared, side, inverse, right, following), (inverse, right)

    size = shared.shape[0]
    nothing = jnp.zeros((3, 3), shared.dtype)
    start = (shared, side, nothing, jnp.zeros((3, size + 1), shared.dtype), nothing)
    columns = (system.cross, system.pose, system.pose_g, system.next)
    (shared, side, *_), back = jax.lax.scan(eliminate, start, columns)
    return shared, (side, back)


def _shift(problem: Problem, system: _System, damping: Float[Array, ""], poses_free: bool) -> Unknowns:
    """The step of all unknowns."""
    reduced, (side, back) = _reduced(system, damping, poses_free)
    shared = jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(reduced), side)
    modes = problem.modes.shape[1]
    poses = jnp.zeros_like(problem.poses)
    if back is not None:

        def substitute(later, one):
            inverse, right, following = one
            here = inverse @ (right[:, -1] - right[:, :-1] @ shared - following @ later)
            return here, here

        _, poses = jax.lax.scan(substitute, jnp.zeros(3, shared.dtype), (*back, system.next), reverse=True)
    return Unknowns(shared[:modes], poses, shared[modes:].reshape(-1, 2))


class _Local(NamedTuple):
    """All that ONE report depends on."""

    tx: Float[Array, "2"]
    rx: Float[Array, "2"]
    offset: Float[Array, ""]  # mean of the two sensors
    speed: Float[Array, ""]  # logarithm of the range scale
    pose: Float[Array, "3"]
    first: Float[Array, "2"]  # parameters of the reflectors
    second: Float[Array, "2"]


def _locally(
    sensors: Sensors, scene: Scene, path: Int[Array, ""], reflection: Reflection, pose: Float[Array, "3"]
) -> tuple[_Local, tuple[Scene, Scene]]:
    tx, rx = sensors.tx[path], sensors.rx[path]
    first, second = take(scene, reflection.first), take(scene, reflection.second)
    local = _Local(
        tx=sensors.position[tx],
        rx=sensors.position[rx],
        offset=(sensors.range_offset[tx] + sensors.range_offset[rx]) / 2,
        speed=jnp.log(sensors.range_scale),
        pose=pose,
        first=jnp.asarray(first.parameters),
        second=jnp.asarray(second.parameters),
    )
    return local, (first, second)


def _report(local: _Local, reflectors: tuple[Scene, Scene], kind: Int[Array, ""]) -> Float[Array, ""]:
    """What the path reports, metres."""
    first, second = (
        seen_from(local.pose, eqx.tree_at(lambda r: r.parameters, reflector, parameters))
        for reflector, parameters in zip(reflectors, (local.first, local.second), strict=True)
    )
    reach = expected_range(kind, first, second, local.tx, local.rx)
    return expected_report(reach, range_offset=local.offset, range_scale=jnp.exp(local.speed))


def _slip(here: Float[Array, "3"], there: Float[Array, "3"], odometry: Float[Array, "3"]) -> Float[Array, "3"]:
    """How far the next pose is from where the odometry has it, in the frame of this one: metres and radians."""
    way = there[:2] - here[:2]
    ahead = jnp.stack([normal(here[2]) @ way, tangent(here[2]) @ way])
    return jnp.concatenate([ahead - odometry[:2], wrap_angle(there[2:] - here[2:] - odometry[2:])])


def _pose_difference(a: Float[Array, "scans 3"], b: Float[Array, "scans 3"]) -> Float[Array, "scans 3"]:
    return jnp.concatenate([a[:, :2] - b[:, :2], wrap_angle(a[:, 2:] - b[:, 2:])], axis=1)


def _at(scene: Scene, parameters: Float[Array, "reflectors 2"]) -> Scene:
    return eqx.tree_at(lambda s: s.parameters, scene, parameters)


def _damped(matrix: Float[Array, "n n"], damping: Float[Array, ""]) -> Float[Array, "n n"]:
    return matrix + damping * jnp.diag(jnp.diag(matrix))


def _t(matrices: Float[Array, "*many m n"]) -> Float[Array, "*many n m"]:
    return jnp.swapaxes(matrices, -1, -2)
