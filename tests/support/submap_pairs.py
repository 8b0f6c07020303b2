"""Pairs of submaps with a known relative pose, and the submap graph of a simulated drive."""

import numpy as np
from support.submaps import drive, submap, submaps

from jaxsonar.geometry.se2 import relative, subtract_poses
from jaxsonar.loop_closure.submap_graph import SubmapGraph

NICHE = np.array([[0, 0], [4, 0], [4, 3.2], [2.4, 3.2], [2.4, 2.7], [1.2, 2.7], [1.2, 3.2], [0, 3.2]], dtype=float)
FIRST, SECOND = (
    drive((1, 1), (3, 1), (3, 2.2), (1.2, 2.2)),
    drive((3, 2), (1, 1.8), (1, 1), (2.8, 1.2)),
)


def two(outline, first, second, seed, sigma):
    """Two submaps, the true earlier_from_newest, and the mean and covariance of a prior drawn around it."""
    rng = np.random.default_rng(seed)
    earlier, newest = (submap(outline, path, path[-1], rng) for path in (first, second))
    true = relative(first[0], second[0])
    spread = np.array([sigma, sigma, min(0.2 * sigma, np.radians(20))])
    return earlier, newest, true, true + rng.normal(size=3) * spread, np.diag(spread**2)


def off_by(found, true):
    """Error of a relative pose in its determined directions, and the squared Mahalanobis distance."""
    error = found.basis.T @ subtract_poses(found.earlier_from_newest, true)
    return error, float(error @ (found.basis.T @ found.information @ found.basis) @ error)


def run_graph(outline, path, seed, **errors):
    """The graph at the end of a trajectory, and the true poses of the submaps relative to the first."""
    made, true = submaps(outline, path, np.random.default_rng(seed), **errors)
    graph = SubmapGraph()
    for one in made:
        graph.add(one)
        graph.process_all()
    return graph, relative(np.broadcast_to(true[0], true.shape), true)
