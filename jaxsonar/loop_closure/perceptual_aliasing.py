"""Perceptual aliasing: other poses of a submap that the prior allows and that no negative evidence excludes.

Agreement of reflectors alone proves little in buildings, where rooms and doors repeat. A place that looks like the
known one may exist, unobserved, wherever nothing contradicts it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar.loop_closure.pose_candidates import PosePrior
from jaxsonar.loop_closure.settings import SETTINGS
from jaxsonar.loop_closure.submap_matching import PoseFit
from jaxsonar.loop_closure.submap_negative_evidence import neighborhood_negative_evidence
from jaxsonar.loop_closure.submap_view import SubmapNeighborhood


class AlternativeHypotheses(NamedTuple):
    """Alternatives to a closure; offsets from its position, in the frame of the earlier submap."""

    offset: Float[np.ndarray, "alternatives 2"]
    log_weight: Float[np.ndarray, " alternatives"]
    """Log-probability up to a constant, the same as in ``ClosureMeasurement.log_weight``, nats."""
    is_aliased: Bool[np.ndarray, " alternatives"]
    """Whether this is an unobserved place that looks like the known one, and not the known one itself."""


class PenaltyGrid(NamedTuple):
    """Negative evidence on a grid of offsets from the position of a closure.

    It is 0 also where it was not evaluated because the prior excludes the position.
    """

    first: Float[np.ndarray, "2"]
    """Offset of the first cell, metres."""
    pitch: float
    """Metres."""
    nats: Float[np.ndarray, "cells cells"]

    def at(self, offset: Float[np.ndarray, "offsets 2"]) -> Float[np.ndarray, " offsets"]:
        """Negative evidence in the cell of each offset; 0 outside the grid."""
        cell = np.round((offset - self.first) / self.pitch).astype(int)
        inside = ((cell >= 0) & (cell < self.nats.shape)).all(axis=-1)
        cell = np.clip(cell, 0, np.array(self.nats.shape) - 1)
        return np.where(inside, self.nats[cell[:, 0], cell[:, 1]], 0.0)


def log_sum_exp(nats: Float[np.ndarray, " terms"]) -> float:
    """Logarithm of the sum of exponentials; minus infinity of an empty sum."""
    return float(np.logaddexp.reduce(nats, initial=-np.inf))


def enumerate_alternatives(
    fit: PoseFit, earlier: SubmapNeighborhood, newest: SubmapNeighborhood, prior: PosePrior, *, reliable_range: float
) -> tuple[Float[np.ndarray, "cells 2"], Float[np.ndarray, " cells"], PenaltyGrid]:
    """Positions on a grid that covers the prior, with the heading of the fit.

    Args:
        fit: the pose of the closure.
        earlier: the submap that stays, with its neighbors.
        newest: the submap that is moved, with its neighbors.
        prior: prior of the pose.
        reliable_range: walls within this distance are surely detected, metres.

    Returns:
        Offsets from the fit (metres), log-probability of each cell (prior and negative evidence, nats), and the grid.
    """
    cov = prior.covariance
    # The prior of the position, given the heading of the fit.
    turn = prior.offset(fit.pose[None])[0, 2]
    conditional = cov[:2, :2] - np.outer(cov[:2, 2], cov[2, :2]) / cov[2, 2]
    mean = prior.pose[:2] + cov[:2, 2] / cov[2, 2] * turn
    cells = SETTINGS.grid_cells
    pitch = max(SETTINGS.grid_step, 4 * float(np.sqrt(np.linalg.eigvalsh(conditional)[-1])) / cells)
    step = pitch * np.arange(-cells, cells + 1)
    position = mean + np.stack(np.meshgrid(step, step, indexing="ij"), axis=-1).reshape(-1, 2)
    poses = np.concatenate([position, np.full((len(position), 1), fit.pose[2])], axis=-1)
    density = prior.log_density(poses, np.eye(3))
    nats = np.zeros(len(poses))
    likely = density > density.max() - SETTINGS.grid_log_range
    offset = position - fit.pose[:2]
    if (np.linalg.norm(offset[likely], axis=-1) > SETTINGS.alternative_distance).any():
        nats[likely] = neighborhood_negative_evidence(
            earlier,
            newest,
            poses[likely],
            tolerance=SETTINGS.grid_tolerance,
            reliable_range=reliable_range,
            limit=SETTINGS.max_log_odds,
        )
    grid = PenaltyGrid(offset[0], pitch, nats.reshape(len(step), len(step)))
    return offset, density - nats + 2 * np.log(pitch), grid
