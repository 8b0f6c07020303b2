"""Bounds that exclude walls which a sensor cannot hear, before any echo is traced."""

import numpy as np
from jaxtyping import Float

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.geometry.segments import cross
from jaxsonar.simulation.acoustics import Acoustics

ANGLE_MARGIN = 1e-6
"""Rounding error of angles that is allowed, radians."""


def least_wall_losses(
    sensors: Float[np.ndarray, "groups sensors 2"],
    axis: Float[np.ndarray, "groups sensors 2"],
    walls: Float[np.ndarray, "walls 2 2"],
    half_beam: Float[np.ndarray, " sensors"],
    acoustics: Acoustics | None,
) -> Float[np.ndarray, "groups walls sensors"]:
    """Smallest one-way loss of a beam towards each wall, dB; infinite if no part of it is in front or in the cone.

    Args:
        sensors: positions, metres.
        axis: unit vectors of their axes.
        walls: endpoints, in the frame of the sensors.
        half_beam: half the width of each cone, radians.
        acoustics: for soft beams; None for hard beams, without loss in their cones.
    """
    leg = walls[:, :, None] - sensors[:, None, None]
    towards = axis[:, None, None]
    angle = np.arctan2(cross(towards, leg), (towards * leg).sum(-1))
    first, last = angle[:, :, 0], angle[:, :, 1]
    turn = wrap_angle(last - first)
    # The wall spans the angles from first to first + turn. Close to the wall, the sign of a turn of pi is unknown.
    spans_axis = (first * (first + turn) <= 0) | (np.abs(turn) > np.pi - ANGLE_MARGIN)
    nearest = np.maximum(np.where(spans_axis, 0.0, np.minimum(np.abs(first), np.abs(last))) - ANGLE_MARGIN, 0.0)
    if acoustics is None:
        return np.where(nearest <= half_beam, 0.0, np.inf)
    return np.where(nearest <= np.pi / 2, acoustics.beam_edge_db * (nearest / half_beam) ** 2, np.inf)


def largest_loss(range_: Float[np.ndarray, " rows"], acoustics: Acoustics | None) -> Float[np.ndarray, " rows"]:
    """Largest loss of both beams with which an echo of walls can be detected, dB.

    Args:
        range_: least half path lengths, metres.
        acoustics: for soft beams; None for hard beams.
    """
    if acoustics is None:
        return np.zeros(len(range_))
    with np.errstate(divide="ignore"):
        least = -20 * np.log10(acoustics.threshold) if acoustics.threshold > 0 else np.inf
        spread = -20 * np.log10(np.maximum(range_, 1e-9))
    return least + spread - acoustics.absorption_db_per_m * (2 * np.maximum(range_, 0.0) - 2.0) + 1e-6
