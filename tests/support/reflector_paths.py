"""Half path lengths of one reflector by plain geometry, one path at a time: an oracle of the observability analysis."""

import math

import numpy as np
from support.oracles import receives, shortest_path_over_circle


def half_path(kind, parameters, tx, rx):
    """Half the length of the path tx -> reflector -> rx.

    Args:
        kind: "plane" (rho, theta), "corner" (x, y), "edge" (x, y) or "circle" (rho, theta, radius).
        parameters: of the reflector.
        tx: position of the transmitter.
        rx: position of the receiver.
    """
    if kind == "plane":
        n = np.array([math.cos(parameters[1]), math.sin(parameters[1])])
        return math.dist(tx + 2 * (parameters[0] - n @ tx) * n, rx) / 2
    if kind == "corner":  # mirrored at both walls, that is at the point itself
        return math.dist(2 * np.asarray(parameters) - tx, rx) / 2
    if kind == "edge":
        return (math.dist(parameters, tx) + math.dist(parameters, rx)) / 2
    rho, theta, radius = parameters
    circle = np.array([[(rho + radius) * math.cos(theta), (rho + radius) * math.sin(theta), radius]])
    return float(shortest_path_over_circle(circle, np.array([tx]), np.array([rx]))[0]) / 2


def information(kind, parameters, ring, pairs, heard):
    """Fisher information of the parameters for ranges with variance 1, from central differences."""
    parameters = np.asarray(parameters, np.float64)
    steps = 1e-4 * np.diag(np.ones(len(parameters)))
    total = np.zeros((len(parameters), len(parameters)))
    center = np.asarray(ring.position).mean(axis=0)
    for (tx, rx), counts in zip(pairs, heard, strict=True):
        if counts:
            ends = ring.position[tx] - center, ring.position[rx] - center
            slope = [(half_path(kind, parameters + s, *ends) - half_path(kind, parameters - s, *ends)) for s in steps]
            total += np.outer(slope, slope) / 4e-8
    return total


def hears(kind, parameters, ring, tx, rx):
    """Whether both sensors of a path have the wall, the corner or the edge in their cones."""
    center = np.asarray(ring.position).mean(axis=0)
    ends = ring.position[tx] - center, ring.position[rx] - center
    if kind == "plane":
        n = np.array([math.cos(parameters[1]), math.sin(parameters[1])])
        towards = [other + 2 * (parameters[0] - n @ other) * n - own for own, other in (ends, ends[::-1])]
    elif kind == "corner":
        towards = [np.asarray(parameters) - (ends[0] + ends[1]) / 2] * 2
    else:
        towards = [np.asarray(parameters) - end for end in ends]
    return all(
        receives(ring.heading[sensor], ring.beam[sensor], math.atan2(way[1], way[0]))
        for sensor, way in zip((tx, rx), towards, strict=True)
    )
