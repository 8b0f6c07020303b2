"""The map of adjusted landmarks, with their covariances."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaxsonar.estimation.adjustment_state import AdjustmentResult
from jaxsonar.estimation.landmark_map import LANDMARK_KINDS
from jaxsonar.estimation.robust_adjustment import SETTINGS as GNC_SETTINGS
from jaxsonar.geometry.landmarks import landmark_positions, wall_segments
from jaxsonar.geometry.se2 import tangent_of, unit, wrap_angle
from jaxsonar.mapping.global_map import GlobalMap


def adjusted_map(world: GlobalMap, adjustment: AdjustmentResult, cov: Float[np.ndarray, "landmarks 2 2"]) -> GlobalMap:
    """The map with its landmarks where the adjustment put them; landmarks with too few echoes are removed.

    Args:
        world: the map from which the landmarks were made, the only one of the adjustment.
        adjustment: its result.
        cov: marginal covariance of the parameters of each landmark, metres and radians.
    """
    world = world.with_kinds(*LANDMARK_KINDS)
    wall_count, count = len(world), len(world) + len(world.points)
    first = np.asarray(adjustment.problem.factors.reflection.first)[adjustment.used]
    echoes = np.bincount(first, minlength=count)[:count]
    kept = np.flatnonzero(echoes >= GNC_SETTINGS.min_landmark_echoes)
    wall, point = kept[kept < wall_count], kept[kept >= wall_count]
    walls, points = (adjustment.state.landmark_map.landmarks.take(rows) for rows in (wall, point))
    # From (distance of the anchor, theta) to (rho, theta).
    distance, theta = np.asarray(walls.parameters).T
    rho = distance + (unit(theta) * walls.anchor).sum(-1)
    arm = (tangent_of(theta) * walls.anchor).sum(-1)
    theta_variance = cov[wall, 1, 1]
    rho_variance = cov[wall, 0, 0] + 2 * arm * cov[wall, 0, 1] + arm**2 * theta_variance
    kinds = {kind: name for name, kind in LANDMARK_KINDS.items()}
    is_kept = np.isin(np.arange(count), kept)
    return replace(
        world.take_walls(is_kept[:wall_count]).take_points(is_kept[wall_count:]),
        points=landmark_positions(points),
        point_kinds=tuple(kinds[kind] for kind in points.kind.tolist()),
        point_cov=cov[point],
        point_echoes=echoes[point],
        segments=wall_segments(walls),
        rho=np.abs(rho),
        theta=wrap_angle(np.where(rho < 0, theta + np.pi, theta)),
        sigma_rho=np.sqrt(rho_variance),
        sigma_theta=np.sqrt(theta_variance),
        echoes=echoes[wall],
        end_kinds=(),
        end_cov=np.full((len(wall), 2, 2, 2), np.nan),
    )
