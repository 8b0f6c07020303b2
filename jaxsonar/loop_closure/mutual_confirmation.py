"""Mutual confirmation: closures that agree around their common loop are less likely to be aliasing errors together."""

import numpy as np

from jaxsonar.estimation.pose_graph import PoseGraph
from jaxsonar.geometry.se2 import rotate, transform_points
from jaxsonar.loop_closure.closure_candidate import ClosureCandidate, candidates_chi2_bound, innovation
from jaxsonar.loop_closure.perceptual_aliasing import log_sum_exp
from jaxsonar.loop_closure.settings import SETTINGS


def confirmed_log_odds(graph: PoseGraph, candidate: ClosureCandidate, others: list[ClosureCandidate]) -> float:
    """Log-odds of a candidate against all alternatives, together with other closures that agree with it, nats.

    An alternative remains only if it is possible for all of them, each at the same offset from its position. A building
    that repeats must do so once more for each other place.
    """
    measured, alternatives = candidate.measurement, candidate.measurement.alternatives
    world_offset = rotate(alternatives.offset, graph.poses[candidate.earlier, 2])
    nats, own = alternatives.log_weight.copy(), measured.grid.at(alternatives.offset)
    positions = [transform_points(graph.poses[candidate.earlier], candidate.position)]
    cost, corridors = 0.0, 0
    for other in others:
        by_corridor = other.measurement.undetermined_direction is not None
        if (
            other is candidate
            or (by_corridor and measured.undetermined_direction is not None)
            or not _agree(graph, candidate, other)
        ):
            continue
        theirs = other.measurement.grid.at(rotate(world_offset, -graph.poses[other.earlier, 2]))
        if by_corridor:
            # The walls of one corridor are the same evidence again: only what exceeds this candidate's own counts.
            nats -= np.maximum(theirs - own, 0.0)
            corridors += 1
            continue
        nats -= theirs
        cost += max(float(other.measurement.grid.at(np.zeros((1, 2)))[0]), 0.0)
        position = transform_points(graph.poses[other.earlier], other.position)
        if min(np.linalg.norm(position - one) for one in positions) > SETTINGS.same_place:
            nats[alternatives.is_aliased] += np.log(SETTINGS.aliasing_probability)
            positions.append(position)
    if len(positions) == 1 and not corridors:
        return measured.log_odds
    return measured.log_weight - min(cost, 2.0) - log_sum_exp(nats)


def _agree(graph: PoseGraph, first: ClosureCandidate, second: ClosureCandidate) -> bool:
    """Whether two candidates agree around their common loop, and both with the graph.

    This is evidence only if the first one predicts the second one well.
    """
    residual, cov = innovation(graph, [first, second])
    split = first.dof
    own, mixed, alone = cov[:split, :split], cov[split:, :split], residual[:split]
    conditional = cov[split:, split:] - mixed @ np.linalg.solve(own, mixed.T)
    positions = second.dof - 1
    if np.linalg.eigvalsh(conditional[:positions, :positions])[-1] > SETTINGS.prediction_sd**2:
        return False
    both = float(residual @ np.linalg.solve(cov, residual))
    last = both - float(alone @ np.linalg.solve(own, alone))
    probability = SETTINGS.refusal_probability
    return both <= candidates_chi2_bound([first, second], probability) and last <= candidates_chi2_bound(
        [second], probability
    )
