"""Votes of echoes for the centers of circles of several radii; an edge is a circle of radius 0."""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import maximum_filter, uniform_filter

from jaxsonar.geometry.se2 import unit
from jaxsonar.reflectors.range_measurements import RangeMeasurements
from jaxsonar.reflectors.settings import SETTINGS


def center_seeds(
    echoes: RangeMeasurements,
) -> tuple[Float[np.ndarray, "seeds 2"], Float[np.ndarray, " seeds"]]:
    """Centers (metres) and radii (metres) of circles that many echoes agree with, those with most votes first.

    An echo votes for the centers on an arc behind the points that it may come from.

    Args:
        echoes: echoes that nothing explains yet.
    """
    settings = SETTINGS.voting
    if len(echoes) < settings.min_votes:
        return np.zeros((0, 2)), np.zeros(0)
    half_width = echoes.half_width + settings.beam_margin
    low = np.floor((echoes.origin.min(0) - echoes.max_range - max(settings.radii)) / settings.cell).astype(np.int64)
    high = np.ceil((echoes.origin.max(0) + echoes.max_range + max(settings.radii)) / settings.cell).astype(np.int64)
    shape = tuple((high - low + 1).tolist())
    votes = np.empty((len(settings.radii), *shape), dtype=np.float32)
    for k, radius in enumerate(settings.radii):
        reach = echoes.distance + radius
        points = int(np.ceil(2 * (half_width * reach).max() / settings.spacing)) + 1
        angle = echoes.axis[:, None] + half_width[:, None] * np.linspace(-1, 1, points)
        cell = np.floor((echoes.origin[:, None] + reach[:, None, None] * unit(angle)) / settings.cell).astype(np.int64)
        flat = (cell[..., 0] - low[0]) * shape[1] + cell[..., 1] - low[1]
        new = np.ones(flat.shape, dtype=bool)
        new[:, 1:] = flat[:, 1:] != flat[:, :-1]
        one = np.bincount(flat[new], minlength=shape[0] * shape[1]).reshape(shape).astype(np.float32)
        votes[k] = 3 * uniform_filter(one, 3, mode="constant")
    best = votes.max(axis=0)
    peak = (best >= settings.min_votes) & (best == maximum_filter(best, 5, mode="constant"))
    x, y = np.nonzero(peak)
    order = np.lexsort((y, x, -best[x, y]))[: settings.most_seeds]
    x, y = x[order], y[order]
    radius = np.array(settings.radii)[votes[:, x, y].argmax(axis=0)]
    return (np.stack([x, y], axis=-1) + low + 0.5) * settings.cell, radius
