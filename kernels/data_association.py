"""Nearest-neighbor association of echoes with the landmarks of a map, by their ranges."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .detection_cones import DEAF, SETTINGS
from .landmarks import AnyArray, Landmarks, Reflection, predict_reflection
from .measurement_model import reported_range
from .sensor_array import EchoPaths, SensorArray, echo_paths, transform_path, widen_cones


class CandidateReflections(eqx.Module):
    """The reflections that echoes may be associated with."""

    reflection: Reflection
    """(candidates,) kind and landmarks of each reflection; kind -1 for unused rows."""
    map_index: Int[AnyArray, " candidates"]
    """Index of the map that each reflection belongs to; -1 for unused rows."""
    group: Int[AnyArray, " candidates"]
    """Candidates of one group do not compete with each other: second order reflections at two walls in either order."""


class EchoAssociation(eqx.Module):
    """The nearest candidate of every echo."""

    candidate: Int[Array, "scans echoes"]
    """Row of the candidate; -1 where the path can receive no candidate."""
    residual: Float[Array, "scans echoes"]
    """Reported minus expected range, metres; infinite where there is no candidate."""
    competitor_gap: Float[Array, "scans echoes"]
    """Smallest difference between the expected ranges of the nearest candidate and of a candidate of another group,
    metres; infinite without one. It measures the ambiguity of the association independently of the echo's noise."""
    level: Float[Array, "scans echoes"]
    """Level of the nearest candidate's echo if it arrives from outside of the cones, dB relative to a wall on the axis
    at 1 m; infinite inside the cones or without a candidate."""


@jax.jit
def associate(
    sensors: SensorArray,
    landmarks: Landmarks,
    candidates: CandidateReflections,
    poses: Float[Array, "scans 3"],
    map_index: Int[Array, " scans"],
    path: Int[Array, "scans echoes"],
    reported: Float[Array, "scans echoes"],
    near: Int[Array, "scans near"],
    motion: Float[Array, "scans echoes 3"] | None = None,
    threshold: float | Float[Array, ""] = DEAF,
) -> EchoAssociation:
    """Associate every echo with the candidate of the nearest range that its path can receive.

    Args:
        sensors: the ring.
        landmarks: of all maps.
        candidates: reflections at these landmarks.
        poses: world_from_robot of the scans, metres and radians.
        map_index: index of the map in which each scan was taken.
        path: row of the ring's ``paths`` of each echo.
        reported: half path lengths as reported, metres; NaN where there is no echo.
        near: rows of the candidates that each scan may receive; -1 for unused entries.
        motion: scan_from_robot when the path of each echo was measured; None: the robot was at rest.
        threshold: level of the faintest echoes that are heard outside of the cones (``EchoAssociation.level``).
    """
    paths = widen_cones(echo_paths(sensors), SETTINGS.association_cone_factor)

    def report(pose, reflection, first, second, path: EchoPaths):
        echo = predict_reflection(pose, reflection, first, second, path)
        report = reported_range(echo.range, range_offset=path.range_offset, range_scale=sensors.range_scale)
        level = jnp.where(echo.visibility > 0, jnp.inf, echo.level)
        return jnp.where((echo.visibility > 0) | (echo.level > threshold), report, jnp.inf), level

    each_path = jax.vmap(report, in_axes=(None, None, None, None, 0))
    each_candidate = jax.vmap(each_path, in_axes=(None, 0, 0, 0, None))

    def associate_scan(scan):
        pose, map_of_scan, path, reported, near, motion = scan
        # Expected ranges of all candidates on the path of each echo.
        echo_path = jax.tree.map(lambda leaf: leaf[path], paths)
        if motion is not None:
            echo_path = jax.vmap(transform_path)(echo_path, motion)
        reflection, map_of_candidate, group = jax.tree.map(
            lambda leaf: leaf[jnp.maximum(near, 0)], (candidates.reflection, candidates.map_index, candidates.group)
        )
        first, second = landmarks.take(reflection.first), landmarks.take(reflection.second)
        expected, level = each_candidate(pose, reflection, first, second, echo_path)
        expected = jnp.where(((map_of_candidate == map_of_scan) & (near >= 0))[:, None], expected, jnp.inf)
        # The nearest one.
        distance = jnp.abs(reported[None] - expected)  # (near, echoes)
        distance = jnp.where(jnp.isfinite(distance), distance, jnp.inf)
        best = distance.argmin(axis=0)
        nearest = jnp.take_along_axis(expected, best[None], axis=0)[0]
        found = jnp.isfinite(distance.min(axis=0))
        # Its competitors.
        competes = group[:, None] != group[best][None]
        gap = jnp.abs(expected - jnp.where(found, nearest, 0)[None])
        competitor_gap = jnp.where(competes, gap, jnp.inf).min(axis=0)
        level = jnp.where(found, jnp.take_along_axis(level, best[None], axis=0)[0], jnp.inf)
        return jnp.where(found, near[best], -1), jnp.where(found, reported - nearest, jnp.inf), competitor_gap, level

    return EchoAssociation(*jax.lax.map(associate_scan, (poses, map_index, path, reported, near, motion)))
