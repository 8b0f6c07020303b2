"""Which reflector of a known scene each echo comes from."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .array_geometry import WIDER, EchoPaths, Sensors, echo_paths, widened
from .landmarks import AnyArray, Reflection, Scene, audible, expected_report, take


class Candidates(eqx.Module):
    """The reflections that may be heard in a scene."""

    reflection: Reflection
    """(candidates,) what is met."""
    world: Int[AnyArray, " candidates"]
    """Which world it stands in; -1 for padding."""
    group: Int[AnyArray, " candidates"]
    """Candidates of one group do not compete: wall to wall in either order."""


class Association(eqx.Module):
    """The best candidate of every echo."""

    candidate: Int[Array, "scans echoes"]
    """Row of the candidates; -1 where no reflector can be heard."""
    residual: Float[Array, "scans echoes"]
    """Reported minus expected range, metres; infinite where there is no candidate."""
    rival: Float[Array, "scans echoes"]
    """How far the expected range of another group's candidate is from that of the best one, at least, metres; infinite
    where there is no other. It says how doubtful the choice is without looking at the noise of the echo."""


@jax.jit
def associate(
    sensors: Sensors,
    scene: Scene,
    candidates: Candidates,
    poses: Float[Array, "scans 3"],
    world: Int[Array, " scans"],
    path: Int[Array, "scans echoes"],
    reported: Float[Array, "scans echoes"],
    near: Int[Array, "scans near"],
) -> Association:
    """The reflection with the range nearest to each echo's, of those that its path can hear.

    Args:
        sensors: the ring.
        scene: the reflectors.
        candidates: what may be heard of them.
        poses: world_from_robot of the scans, metres and radians.
        world: which world each scan was taken in.
        path: row of the ring's ``paths`` of each echo.
        reported: half path lengths as reported, metres; NaN where there is no echo.
        near: rows of the candidates that each scan may hear; -1 for none.
    """
    paths = widened(echo_paths(sensors), WIDER)

    def report(pose, reflection, first, second, path: EchoPaths):
        reach, share, _ = audible(pose, reflection, first, second, path)
        said = expected_report(reach, range_offset=path.range_offset, range_scale=sensors.range_scale)
        return jnp.where(share > 0, said, jnp.inf)

    each_path = jax.vmap(report, in_axes=(None, None, None, None, 0))
    each_candidate = jax.vmap(each_path, in_axes=(None, 0, 0, 0, None))

    def one_scan(scan):
        pose, here, path, reported, near = scan
        own = jax.tree.map(lambda leaf: leaf[path], paths)
        reflection, world, group = jax.tree.map(
            lambda leaf: leaf[jnp.maximum(near, 0)], (candidates.reflection, candidates.world, candidates.group)
        )
        first, second = take(scene, reflection.first), take(scene, reflection.second)
        expected = each_candidate(pose, reflection, first, second, own)
        expected = jnp.where(((world == here) & (near >= 0))[:, None], expected, jnp.inf)
        off = jnp.abs(reported[None] - expected)  # (near, echoes)
        off = jnp.where(jnp.isfinite(off), off, jnp.inf)
        best = off.argmin(axis=0)
        nearest = jnp.take_along_axis(expected, best[None], axis=0)[0]
        found = jnp.isfinite(off.min(axis=0))
        residual = reported - nearest
        other = group[:, None] != group[best][None]
        apart = jnp.abs(expected - jnp.where(found, nearest, 0)[None])
        rival = jnp.where(other, apart, jnp.inf).min(axis=0)
        return jnp.where(found, near[best], -1), jnp.where(found, residual, jnp.inf), rival

    return Association(*jax.lax.map(one_scan, (poses, world, path, reported, near)))
