"""Where else a submap may lie: what the prior leaves to places at which nothing contradicts it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxsonar.loop_closure.negative_evidence import Vicinity, against_vicinity
from jaxsonar.loop_closure.pose_candidates import Prior
from jaxsonar.loop_closure.submap_matching import Fit

CERTAIN = 9.0
"""More nats than this no closure is worth: a robot may have slipped unnoticed."""
STEP, CELLS = 0.4, 10
"""Least pitch of the grid on which doubt is looked for, metres, and its half size in cells."""
LOOSE = 0.3
"""Slack of contradictions on the grid, metres."""

NEAR = 0.45
"""Doubt begins this far from a pose, metres."""


class Doubts(NamedTuple):
    """Where else the newest submap may lie; offsets from the closure's place, in the frame of the earlier submap."""

    offset: Float[np.ndarray, "places 2"]
    nats: Float[np.ndarray, " places"]
    """Logarithm of its weight, as that of the closure in ``Closure.weight``."""
    unseen: Bool[np.ndarray, " places"]
    """Whether this is a place like the known one that was never seen, not the known one."""


class Field(NamedTuple):
    """Nats against lying elsewhere, on a grid of offsets from the closure's place.

    0, too, where nothing was asked because the prior leaves no room there.
    """

    first: Float[np.ndarray, "2"]
    pitch: float
    nats: Float[np.ndarray, "cells cells"]

    def at(self, offset: Float[np.ndarray, "places 2"]) -> Float[np.ndarray, " places"]:
        """In the cell of each offset; 0 outside the grid."""
        cell = np.round((offset - self.first) / self.pitch).astype(int)
        inside = ((cell >= 0) & (cell < self.nats.shape)).all(axis=-1)
        cell = np.clip(cell, 0, np.array(self.nats.shape) - 1)
        return np.where(inside, self.nats[cell[:, 0], cell[:, 1]], 0.0)


def log_sum(nats: Float[np.ndarray, " terms"]) -> float:
    """Logarithm of the sum of exponentials; minus infinity of none."""
    return float(np.logaddexp.reduce(nats, initial=-np.inf))


def log_density(
    prior: Prior, poses: Float[np.ndarray, "poses 3"], basis: Float[np.ndarray, "3 rank"]
) -> Float[np.ndarray, " poses"]:
    """Of the prior's marginal in the directions of a basis."""
    cov = basis.T @ prior.covariance @ basis
    offset = prior.offset(poses) @ basis
    distance = (offset @ np.linalg.inv(cov) * offset).sum(-1)
    return -distance / 2 - np.linalg.slogdet(2 * np.pi * cov)[1] / 2


def elsewhere(
    fit: Fit, around: tuple[Vicinity, Vicinity], prior: Prior, reach: float
) -> tuple[Float[np.ndarray, "cells 2"], Float[np.ndarray, " cells"], Field]:
    """Places within reach of the prior, as offsets from the fit, heading as found.

    Also the logarithm of the prior's mass that is left of each, and what speaks against each.
    """
    cov = prior.covariance
    turn = prior.offset(fit.pose[None])[0, 2]
    place = cov[:2, :2] - np.outer(cov[:2, 2], cov[2, :2]) / cov[2, 2]
    middle = prior.pose[:2] + cov[:2, 2] / cov[2, 2] * turn
    pitch = max(STEP, 4 * float(np.sqrt(np.linalg.eigvalsh(place)[-1])) / CELLS)
    step = pitch * np.arange(-CELLS, CELLS + 1)
    at = middle + np.stack(np.meshgrid(step, step, indexing="ij"), axis=-1).reshape(-1, 2)
    poses = np.concatenate([at, np.full((len(at), 1), fit.pose[2])], axis=-1)
    density = log_density(prior, poses, np.eye(3))
    nats = np.zeros(len(poses))
    # What is far out in the prior does not matter, whatever speaks against it.
    likely = density > density.max() - 12.0
    offset = at - fit.pose[:2]
    if (np.linalg.norm(offset[likely], axis=-1) > NEAR).any():
        nats[likely] = against_vicinity(*around, poses[likely], slack=LOOSE, reach=reach, enough=CERTAIN)
    field = Field(offset[0], pitch, nats.reshape(len(step), len(step)))
    return offset, density - nats + 2 * np.log(pitch), field
