"""From labelled cells back to the points in them: centre of gravity, involved echoes, extent (paper, sections 4, 5).

On the host, because neighboring points of an arc are mostly in one component: there are few such runs, and NumPy adds
up only those.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.geometry.se2 import unit
from jaxsonar.scans.echo_batches import Step


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
    labels: Int[np.ndarray, "rows theta_and_one rho"],
    counts: Int[np.ndarray, " rows"],
) -> Centres:
    """Centre of gravity of the POINTS of each component (paper, section 4), the mean of theta taken on the circle.

    Args:
        arcs: of the ring's paths.
        step: the echoes, in pieces.
        voted: where their points voted.
        labels: component of each cell (``components.label_components``).
        counts: number of components of each scan.
    """
    scans, size, echoes = len(step.scans), max(1, int(counts.max(initial=0))), step.path.shape[1]
    runs = _runs(arcs, step, voted, labels)
    own = runs.scan * size + np.abs(runs.label) - 1
    rho, theta, votes = mean_lines(own, runs.points, runs.rho, runs.normal_x, runs.normal_y, count=scans * size)
    involved = np.zeros(scans * size * echoes, bool)
    involved[own * echoes + runs.echo] = True
    rho, theta = (values.astype(np.float32).reshape(scans, size) for values in (rho, theta))
    theta[theta >= np.float32(np.pi)] = -np.pi  # rounding
    involved = involved.reshape(scans, size, echoes)
    segments = _extents(rho, theta, sensors_of(arcs, step), involved)
    return Centres(rho, theta, votes.reshape(scans, size), segments, involved)


def mean_lines(
    own: Int[np.ndarray, " sums"],
    lines: Int[np.ndarray, " sums"],
    rho: Float[np.ndarray, " sums"],
    normal_x: Float[np.ndarray, " sums"],
    normal_y: Float[np.ndarray, " sums"],
    *,
    count: int,
) -> tuple[Float[np.ndarray, " count"], Float[np.ndarray, " count"], Int[np.ndarray, " count"]]:
    """Means of lines, that of theta on the circle: rho (metres, >= 0), theta (in [-pi, pi)) and number of lines.

    Args:
        own: which mean each sum of lines belongs to.
        lines: how many lines were summed.
        rho: sums of distances of any sign, metres.
        normal_x: sums of the cosines of the normals.
        normal_y: sums of the sines.
        count: of means; NaN for those that no line belongs to.
    """
    number, rho, x, y = (np.bincount(own, values, minlength=count) for values in (lines, rho, normal_x, normal_y))
    side = np.where(rho < 0, -1.0, 1.0)  # (-rho, n) is (rho, -n)
    theta = np.arctan2(side * y, side * x)
    theta[theta >= np.pi] = -np.pi
    none = number == 0
    theta[none] = np.nan
    rho = np.abs(rho) / np.where(none, np.nan, number)
    return rho, theta, number.astype(np.int64)


class NormalSums(NamedTuple):
    """Sums over the normals of the first k points of every path, k from 0 to all: those of a run are a difference."""

    x: Float[np.ndarray, "paths points_and_one"]
    """Of their cosines."""
    y: Float[np.ndarray, "paths points_and_one"]
    """Of their sines."""


class _Runs(NamedTuple):
    """Sums over neighboring points of an arc in one component and on one side of the origin."""

    scan: Int[np.ndarray, " runs"]
    echo: Int[np.ndarray, " runs"]
    """Column of the step's row."""
    label: Int[np.ndarray, " runs"]
    """Component; minus for one of its parts if it joined across rho = 0."""
    points: Int[np.ndarray, " runs"]
    """How many there are."""
    rho: Float[np.ndarray, " runs"]
    """Distances of their lines, metres: (rho, n) and (-rho, -n) are one line, here all have the component's side."""
    normal_x: Float[np.ndarray, " runs"]
    """Cosines of their normals."""
    normal_y: Float[np.ndarray, " runs"]
    """Sines of their normals."""


def _runs(
    arcs: kernels.RingArcs, step: Step, voted: kernels.Voted, labels: Int[np.ndarray, "rows theta_and_one rho"]
) -> _Runs:
    """The runs of points in components. Points are many, runs few: of points only passes along the memory."""
    assert step.piece is not None
    assert step.owner is not None
    scans, width = len(step.scans), kernels.PIECE
    piece, owner = step.piece[:scans], step.owner[:scans]
    cell, rho = np.asarray(voted.cell), np.asarray(voted.rho)[:scans].ravel()
    label = np.empty((scans, *cell.shape[1:]), labels.dtype)
    for scan in range(scans):  # what one scan needs stays in the cache
        np.take(labels[scan], cell[scan], out=label[scan], mode="clip")  # none is outside; the fastest mode
    label = label.ravel()
    behind = rho < 0
    begins = np.ones(rho.size, bool)  # where the component changes, or the side, and with every arc
    np.not_equal(label[1:], label[:-1], out=begins[1:])
    begins[1:] |= behind[1:] != behind[:-1]
    begins[::width] |= piece.ravel() == 0
    first = np.flatnonzero(begins)
    used = np.flatnonzero(label[first])
    end = np.empty_like(first)
    end[:-1], end[-1] = first[1:], rho.size
    first, points, total = first[used], (end - first)[used], np.add.reduceat(rho, first)[used]
    label, behind, at = label[first].astype(np.int64), behind[first], first // width
    scan, echo = at // owner.shape[1], owner.ravel()[at]
    path = step.path[scan, echo]
    begin = piece.ravel()[at] * width + first - at * width
    normal_x, normal_y = (sums[path, begin + points] - sums[path, begin] for sums in _normal_sums(arcs))
    if step.pose is not None:
        turn = unit(step.pose[scan, echo, 2])
        normal_x, normal_y = (
            turn[:, 0] * normal_x - turn[:, 1] * normal_y,
            turn[:, 1] * normal_x + turn[:, 0] * normal_y,
        )
    side = np.where(behind ^ (label < 0), -1.0, 1.0)
    return _Runs(scan, echo, label, points, side * total, side * normal_x, side * normal_y)


_latest: list[tuple[kernels.RingArcs, NormalSums]] = []


def _normal_sums(arcs: kernels.RingArcs) -> NormalSums:
    """The latest are kept, so that a stream of single scans makes them once."""
    for known, sums in tuple(_latest):
        if known is arcs:
            return sums
    theta = np.asarray(arcs.arcs.theta, np.float64)
    normals = np.stack([np.cos(theta), np.sin(theta)])
    sums = NormalSums(*np.cumsum(np.pad(normals, ((0, 0), (0, 0), (1, 0))), axis=-1))
    _latest[:] = [(arcs, sums)]
    return sums


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
    segments = np.full((rho.size, 2, 2), np.nan, np.float32)
    line, echo = np.divmod(np.flatnonzero(involved), involved.shape[2])
    if len(line):
        x, y = np.cos(theta).ravel(), np.sin(theta).ravel()
        sensor = sensors[line // involved.shape[1], echo]
        foot = sensor[:, 1] * x[line] - sensor[:, 0] * y[line]
        first = np.flatnonzero(np.concatenate([[True], line[1:] != line[:-1]]))
        own = line[first]
        rho, x, y = rho.ravel()[own], x[own], y[own]
        for side, outermost in enumerate((np.minimum, np.maximum)):
            end = outermost.reduceat(foot, first)
            segments[own, side, 0] = rho * x - end * y
            segments[own, side, 1] = rho * y + end * x
    return segments.reshape(*involved.shape[:2], 2, 2)
