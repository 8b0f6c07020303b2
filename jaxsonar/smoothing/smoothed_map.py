"""A map whose walls, corners and edges are where they settled, with the covariances of the least squares."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.estimation.robust_adjustment import LEAST_ECHOES, Settled
from jaxsonar.geometry.se2 import unit, wrap_angle
from jaxsonar.mapping.global_map import GlobalMap


def settled_map(world: GlobalMap, found: Settled, cov: Float[np.ndarray, "reflectors 2 2"]) -> GlobalMap:
    """The map with the reflectors that it settled to; those that hardly an echo is left of are gone.

    Args:
        world: the map that the reflectors are from (``surroundings``, the only world).
        found: the end of the settling.
        cov: of the parameters of each reflector by itself, metres and radians.
    """
    scene, walls = found.state.around.scene, len(world)
    count = walls + len(world.points)
    parameters, anchor = np.asarray(scene.parameters)[:count], np.asarray(scene.anchor)[:count]
    echoes = _echoes(found, count)
    kept = np.flatnonzero(echoes >= LEAST_ECHOES)
    wall, point = kept[kept < walls], kept[kept >= walls]
    # (distance of the anchor, theta) -> (rho, theta)
    theta = parameters[wall, 1]
    normal, along = unit(theta), unit(theta + np.pi / 2)
    rho = parameters[wall, 0] + (normal * anchor[wall]).sum(-1)
    lever = (along * anchor[wall]).sum(-1)
    turn = cov[wall, 1, 1]
    variance = cov[wall, 0, 0] + 2 * lever * cov[wall, 0, 1] + lever**2 * turn
    middle = anchor[wall] + parameters[wall, :1] * normal
    ends = np.asarray(scene.ends)[wall]
    kinds = {kernels.CORNER: "corner", kernels.EDGE: "edge"}
    from_points = point - walls
    return replace(
        world,
        segments=middle[:, None] + ends[..., None] * along[:, None],
        rho=np.abs(rho),
        theta=wrap_angle(np.where(rho < 0, theta + np.pi, theta)),
        sigma_rho=np.sqrt(variance),
        sigma_theta=np.sqrt(turn),
        echoes=echoes[wall],
        scans=tuple(world.scans[k] for k in wall),
        points=anchor[point] + parameters[point],
        point_kinds=tuple(kinds[kind] for kind in np.asarray(scene.kind)[point].tolist()),
        point_cov=cov[point],
        point_echoes=echoes[point],
        point_scans=tuple(world.point_scans[k] for k in from_points),
    )


def _echoes(found: Settled, count: int) -> Int[np.ndarray, " reflectors"]:
    """That each reflector explains."""
    reflection = found.problem.heard.reflection
    first = np.asarray(reflection.first)[found.used]
    return np.bincount(first, minlength=count)[:count]
