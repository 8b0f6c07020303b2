"""The robot's pose and the reflectors around it from ONE scan: iterated Kalman update on the ranges of its echoes.

Pose and reflectors are one normal distribution, so that what is known of one through the other is not counted twice
(paper, section 5, last paragraph; Bell and Cathey 1993: the iterated update is Gauss-Newton on prior and ranges).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from . import measurement_model as reflectors
from .array_geometry import WIDER, EchoPaths, widened
from .geometry import dot, normal, tangent
from .landmarks import AnyArray, Scene, seen_from
from .ml_detection import CORNER, EDGE, PLANE

_STEPS, _CLOSER = 4, 0.05  # variance that the belief allows shrinks so much with each step
_GATE = 4.0  # sigma; an echo farther off is as likely false
_SLACK = 0.05  # m; farther behind what was seen of a wall an echo is more likely of its edge


class Belief(eqx.Module):
    """What is known of the robot and of the reflectors around it: mean and covariance of a normal distribution."""

    pose: Float[AnyArray, "3"]
    """frame_from_robot: x, y (metres), theta (radians)."""
    scene: Scene
    """(reflectors,) the mean of their parameters; rows of kind -1 are free."""
    covariance: Float[AnyArray, "unknowns unknowns"]
    """Of the pose (3) and of the parameters (2 a reflector), square metres and radians."""


class Tracked(eqx.Module):
    """A belief after a scan, and how its echoes fit."""

    belief: Belief
    residual: Float[Array, " echoes"]
    """Measured minus expected range at the new belief, metres; 0 for echoes of no reflector."""
    used: Float[Array, " echoes"]
    """1 for the echoes that count, 0 for all others."""


class Predicted(eqx.Module):
    """What paths would hear of a belief."""

    expected: Float[Array, "reflectors echoes"]
    """Range in which each path would hear each reflector, metres; infinite where it would not."""
    variance: Float[Array, "reflectors echoes"]
    """Of that, square metres."""


@jax.jit
def track(
    belief: Belief,
    paths: EchoPaths,
    ranges: Float[Array, " echoes"],
    row: Int[Array, " echoes"],
    variance: Float[Array, ""],
) -> Tracked:
    """Take in the echoes of one scan whose reflectors are known.

    The scale of a robust weight (Geman and McClure) closes from what the belief allows to the noise of the ranges; in
    the end an echo counts or does not, so that the covariance is that of least squares.

    Args:
        belief: before the scan, the robot's motion accounted for; a reflector that is new has a wide covariance.
        paths: (echoes,) geometry of the path of each echo, in the frame of the pose.
        ranges: half path lengths, corrected for offsets and the speed of sound, metres.
        row: of the scene, where each echo comes from; -1 for none.
        variance: of a range, square metres.
    """
    mean = jnp.concatenate([jnp.asarray(belief.pose), jnp.asarray(belief.scene.parameters).ravel()])
    prior = jnp.asarray(belief.covariance)
    known, at = row >= 0, jnp.maximum(row, 0)
    first, second = 3 + 2 * at, 4 + 2 * at
    each_echo = jax.vmap(_echo, in_axes=(None, 0, 0))

    def linear(state):
        """Residuals, and the Jacobian of the expected ranges: by the pose, and by the parameters of the reflector."""
        scene = jax.tree.map(lambda leaf: jnp.asarray(leaf)[at], _with(belief.scene, state[3:]))
        reach, by_pose, by_own = each_echo(state[:3], scene, paths)
        return jnp.where(known, ranges - reach, 0), by_pose, by_own

    def solved(state, weight):
        """One step of Gauss and Newton from a state: prior and weighted ranges."""
        residual, by_pose, by_own = linear(state)
        root = jnp.sqrt(weight / variance)[:, None]
        by_pose, by_own = root * by_pose, root * by_own
        # Rows of the Jacobian have five entries: three of the pose, two of their reflector.
        spread = prior[:, :3] @ by_pose.T + prior[:, first] * by_own[None, :, 0] + prior[:, second] * by_own[None, :, 1]
        surprise = by_pose @ spread[:3] + by_own[:, :1] * spread[first] + by_own[:, 1:] * spread[second]
        factor = jax.scipy.linalg.cho_factor(surprise + jnp.eye(len(row), dtype=state.dtype))
        moved = state - mean
        back = by_pose @ moved[:3] + by_own[:, 0] * moved[first] + by_own[:, 1] * moved[second]
        step = jax.scipy.linalg.cho_solve(factor, root[:, 0] * residual + back)
        return mean + spread @ step, spread, factor, surprise

    *_, surprise = solved(mean, known.astype(mean.dtype))
    allowed = variance * jnp.diag(surprise)

    def closer(step, state):
        scale = _GATE**2 * (variance + allowed * _CLOSER ** step.astype(mean.dtype))
        residual, *_ = linear(state)
        return solved(state, jnp.where(known, 1 / (1 + residual * residual / scale) ** 2, 0))[0]

    state = jax.lax.fori_loop(0, _STEPS, closer, mean)
    residual, *_ = linear(state)
    used = (known & (residual * residual < _GATE**2 * variance)).astype(mean.dtype)
    state, spread, factor, _ = solved(state, used)
    half = jax.scipy.linalg.solve_triangular(factor[0], spread.T, lower=factor[1], trans=0 if factor[1] else 1)
    found = Belief(state[:3], _with(belief.scene, state[3:]), prior - half.T @ half)
    return Tracked(found, linear(state)[0], used)


@jax.jit
def predict(belief: Belief, paths: EchoPaths) -> Predicted:
    """What paths (echoes,), in the robot frame, would hear of what a belief has, and how well that is known."""
    return Predicted(expected_ranges(belief.pose, belief.scene, paths), _variance(belief, paths))


@jax.jit
def expected_ranges(pose: Float[Array, "3"], scene: Scene, paths: EchoPaths) -> Float[Array, "reflectors echoes"]:
    """Ranges in which paths hear reflectors, metres; infinite where they do not.

    Args:
        pose: frame_from_robot.
        scene: (reflectors,) in that frame; a wall is heard up to 5 cm behind what was seen of it.
        paths: (echoes,) in the robot frame, their cones a little widened here.
    """
    paths = widened(paths, WIDER)

    def one(reflector: Scene, path: EchoPaths):
        local = seen_from(pose, reflector)
        sightings = (reflectors.plane(local, path), reflectors.corner(local, path), reflectors.edge(local, path))
        reach = jnp.stack([sighting.range for sighting in sightings])
        share = jnp.stack([reflectors.heard_share(sighting, path) for sighting in sightings])
        along = dot(tangent(reflector.parameters[1]), pose[:2] - reflector.anchor) + sightings[PLANE].foot
        beside = (along < reflector.ends[0] - _SLACK) | (along > reflector.ends[1] + _SLACK)
        share = share.at[PLANE].multiply(1 - beside.astype(share.dtype))
        kind = jnp.clip(reflector.kind, PLANE, EDGE)
        return jnp.where((reflector.kind >= 0) & (share[kind] > 0), reach[kind], jnp.inf)

    return jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None))(scene, paths)


def _variance(belief: Belief, paths: EchoPaths) -> Float[Array, "reflectors echoes"]:
    """Variance of the range in which each path would hear each reflector, square metres."""
    count = belief.scene.kind.shape[0]
    own = 3 + 2 * jnp.arange(count)[:, None] + jnp.arange(2)[None]
    of_pose, between = belief.covariance[:3, :3], belief.covariance[:3, own]  # (3, reflectors, 2)
    of_own = belief.covariance[own[:, :, None], own[:, None, :]]

    def one(reflector, between, of_own, path):
        _, by_pose, by_own = _echo(jnp.asarray(belief.pose), reflector, path)
        return by_pose @ of_pose @ by_pose + 2 * by_pose @ between @ by_own + by_own @ of_own @ by_own

    each_path = jax.vmap(one, in_axes=(None, None, None, 0))
    return jax.vmap(each_path, in_axes=(0, 1, 0, None))(belief.scene, between, of_own, paths)


def _echo(pose: Float[Array, "3"], reflector: Scene, path: EchoPaths):
    """Range of ONE echo, and its slopes by the pose (3) and by the parameters of the reflector (2)."""
    local = seen_from(pose, reflector)
    sightings = {PLANE: reflectors.plane, CORNER: reflectors.corner, EDGE: reflectors.edge}
    seen = {kind: model(local, path) for kind, model in sightings.items()}
    reach = jnp.select([reflector.kind == kind for kind in seen], [one.range for one in seen.values()], 0)
    a, b = (
        jnp.select([reflector.kind == kind for kind in seen], [one.slope[k] for one in seen.values()], 0)
        for k in (0, 1)
    )
    theta = reflector.parameters[1]
    n, t, ahead, left = normal(theta), tangent(theta), normal(pose[2]), tangent(pose[2])
    offset = jnp.asarray(reflector.anchor) - pose[:2]
    # A plane is (distance + n . offset, theta - heading), a point the offset to it turned by the heading.
    plane = reflector.kind == PLANE
    across = a * ahead + b * left
    by_place = jnp.where(plane, -a * n, -across)
    by_heading = jnp.where(plane, -b, a * local[1] - b * local[0])
    by_own = jnp.where(plane, jnp.stack([a, a * dot(t, offset) + b]), across)
    return reach, jnp.append(by_place, by_heading), by_own


def _with(scene: Scene, parameters: Float[Array, " all"]) -> Scene:
    return eqx.tree_at(lambda s: s.parameters, scene, parameters.reshape(-1, 2))
