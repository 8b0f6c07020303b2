"""From labelled cells back to the points in them: centre of gravity, involved echoes, extent (paper, sections 4, 5).

On the host, because few of the points are in a component, and NumPy takes just those.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels

from .echoes import Step
from .poses import unit


class Centres(NamedTuple):
    """Straight lines of a step's scans, in the order of their labels; unused places hold no echo and NaN."""

    rho: Float[np.ndarray, "scans clusters"]
    """Distance from the robot's origin, metres, >= 0."""
    theta: Float[np.ndarray, "scans clusters"]
    """Direction of the normal in the robot frame, radians, in [-pi, pi)."""
    votes: Int[np.ndarray, "scans clusters"]
    """Number of points in the component."""
    segments: Float[np.ndarray, "scans clusters 2 2"]
    """Endpoints: the outermost feet of the perpendiculars from the sensors involved, metres."""
    involved: Bool[np.ndarray, "scans clusters echoes"]
    """Which echoes have a point in the component."""


def centres_of_gravity(
    arcs: kernels.RingArcs,
    step: Step,
    voted: kernels.Voted,
    labels: Int[np.ndarray, "rows theta rho"],
    counts: Int[np.ndarray, " rows"],
) -> Centres:
    """Centre of gravity of the POINTS of each component (paper, section 4), the mean of theta taken on the circle.

    Args:
        arcs: of the ring's paths.
        step: the echoes, in pieces.
        voted: where their points voted.
        labels: component of each cell: 0 none, k or -k (``components.label_components``). Minus marks cells that joined
            across rho = 0: their points enter as the same lines seen from the other side.
        counts: number of components of each scan.
    """
    assert step.piece is not None
    assert step.owner is not None
    scans, size, width = len(step.scans), max(1, int(counts.max(initial=0))), kernels.PIECE
    cell, rho = (np.asarray(values)[:scans] for values in (voted.cell, voted.rho))
    cells = labels[0].size
    label_of_cell = np.zeros((scans, cells + 1), labels.dtype)  # the last one: no cell, no component
    label_of_cell[:, :cells] = labels[:scans].reshape(scans, cells)
    first = (np.arange(scans) * (cells + 1))[:, None, None]
    label = np.take(label_of_cell, cell + first).ravel()
    # The points in components, with the echo and the normal of each; what points of a piece share is found once.
    point = np.flatnonzero(label)
    label, rho, piece = label[point], rho.ravel()[point], point // width
    number, owner = step.piece[:scans], step.owner[:scans]
    path = np.take_along_axis(step.path[:scans], owner, axis=1)
    table = np.asarray(arcs.arcs.normal_x).shape[1]
    begin = path * table + number * width - np.arange(number.size).reshape(number.shape) * width
    at = begin.ravel()[piece] + point
    n_x, n_y = (np.asarray(values).ravel()[at] for values in (arcs.arcs.normal_x, arcs.arcs.normal_y))
    if step.pose is not None:
        turn = np.take_along_axis(step.pose[:scans, :, 2], owner, axis=1).ravel()[piece]
        along, across = np.cos(turn), np.sin(turn)
        n_x, n_y = along * n_x - across * n_y, across * n_x + along * n_y
    side = np.copysign(np.sign(label), label * rho).astype(np.float32)  # (rho, n) and (-rho, -n) are one line
    own = (np.arange(scans) * size - 1).repeat(number.shape[1])[piece] + np.abs(label)

    def total(values: Float[np.ndarray, " points"] | None = None) -> np.ndarray:
        return np.bincount(own, values, minlength=scans * size).reshape(scans, size)

    votes = total()
    empty = votes == 0
    mean = total(side * rho) / np.where(empty, 1, votes)
    theta = np.arctan2(total(side * n_y), total(side * n_x))
    theta = np.where(mean < 0, theta + np.pi, theta)
    theta = np.where(theta >= np.pi, theta - 2 * np.pi, theta).astype(np.float32)
    theta = np.where(theta >= np.float32(np.pi), np.float32(-np.pi), theta)
    echoes = step.path.shape[1]
    involved = np.zeros(scans * size * echoes, bool)
    involved[own * echoes + owner.ravel()[piece]] = True
    involved = involved.reshape(scans, size, echoes)
    rho, theta = (np.where(empty, np.nan, values).astype(np.float32) for values in (np.abs(mean), theta))
    return Centres(rho, theta, votes, _extents(rho, theta, sensors_of(arcs, step), involved), involved)


def sensors_of(arcs: kernels.RingArcs, step: Step) -> Float[np.ndarray, "scans echoes 2"]:
    """Real or virtual sensor of every echo, in the frame of the lines, metres."""
    sensor = np.asarray(arcs.paths.midpoint)[step.path[: len(step.scans)]]
    if step.pose is None:
        return sensor
    pose = step.pose[: len(step.scans)]
    along = unit(pose[..., 2])
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    return pose[..., :2] + sensor[..., :1] * along + sensor[..., 1:] * across


def _extents(
    rho: Float[np.ndarray, "scans clusters"],
    theta: Float[np.ndarray, "scans clusters"],
    sensors: Float[np.ndarray, "scans echoes 2"],
    involved: Bool[np.ndarray, "scans clusters echoes"],
) -> Float[np.ndarray, "scans clusters 2 2"]:
    """Endpoints of each line, the second one counter-clockwise from the first as seen from the origin (section 5)."""
    scan, cluster = np.nonzero(involved.any(axis=2))
    n = unit(theta[scan, cluster])
    t = np.stack([-n[:, 1], n[:, 0]], axis=-1)
    foot = np.einsum("lec,lc->le", sensors[scan], t)
    own = involved[scan, cluster]
    ends = np.stack([np.where(own, foot, np.inf).min(axis=1), np.where(own, foot, -np.inf).max(axis=1)], axis=-1)
    segments = np.full((*rho.shape, 2, 2), np.nan, np.float32)
    segments[scan, cluster] = (rho[scan, cluster, None] * n)[:, None] + ends[..., None] * t[:, None]
    return segments
