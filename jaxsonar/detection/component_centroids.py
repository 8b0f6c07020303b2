"""Centroids of connected components over the arc points that voted for them, and line endpoints (paper, sections 4, 5).

Neighboring points of an arc are mostly in the same component. The host therefore sums over runs of points: a scan has
about 3000 points, but only about 100 runs.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.detection.arc_tables import ArcTables
from jaxsonar.geometry.se2 import perpendicular, unit
from jaxsonar.scans.echo_batches import EchoBatch


class Centroids(NamedTuple):
    """One line per component of each scan, in the order of the labels; unused entries have no echo and hold NaN."""

    rho: Float[np.ndarray, "scans components"]
    """Distance from the robot's origin, metres, >= 0."""
    theta: Float[np.ndarray, "scans components"]
    """Direction of the normal in the robot frame, radians, in [-pi, pi)."""
    votes: Int[np.ndarray, "scans components"]
    """Number of points in the component."""
    segments: Float[np.ndarray, "scans components 2 2"]
    """Endpoints: the outermost feet of the perpendiculars from the involved sensors, metres."""
    involved: Bool[np.ndarray, "scans components echoes"]
    """Echoes that have a point in the component."""


def component_centroids(
    tables: ArcTables,
    batch: EchoBatch,
    voted: kernels.Votes,
    labels: Int[np.ndarray, "rows theta_and_one rho"],
    counts: Int[np.ndarray, " rows"],
) -> Centroids:
    """Center of gravity of the points (not of the cells) of each component (paper, section 4); theta on the circle.

    Args:
        tables: arcs of the ring's paths.
        batch: the echoes, cut into arc pieces.
        voted: cell and rho of each point.
        labels: component of each cell (``connected_components.label_components``).
        counts: number of components of each scan.
    """
    scans, size, echoes = len(batch.scans), max(1, int(counts.max(initial=0))), batch.path.shape[1]
    runs = _find_runs(tables, batch, voted, labels)
    component = runs.scan * size + np.abs(runs.label) - 1
    rho, theta, votes = mean_lines(
        component, runs.points, runs.rho, runs.normal_x, runs.normal_y, components=scans * size
    )
    involved = np.zeros(scans * size * echoes, bool)
    involved[component * echoes + runs.echo] = True
    rho, theta = (values.astype(np.float32).reshape(scans, size) for values in (rho, theta))
    theta[theta >= np.float32(np.pi)] = -np.pi  # rounding to single precision
    involved = involved.reshape(scans, size, echoes)
    segments = _segment_endpoints(rho, theta, sensor_positions(tables.arcs, batch), involved)
    return Centroids(rho, theta, votes.reshape(scans, size), segments, involved)


def mean_lines(
    component: Int[np.ndarray, " sums"],
    points: Int[np.ndarray, " sums"],
    rho: Float[np.ndarray, " sums"],
    normal_x: Float[np.ndarray, " sums"],
    normal_y: Float[np.ndarray, " sums"],
    *,
    components: int,
) -> tuple[Float[np.ndarray, " components"], Float[np.ndarray, " components"], Int[np.ndarray, " components"]]:
    """Mean line of each component from partial sums over its points; the mean of theta is circular.

    Oracle: ``mean_line`` of tests/support/oracles.py.

    Args:
        component: component of each partial sum.
        points: number of points of each partial sum.
        rho: sum of signed distances, metres. (rho, n) and (-rho, -n) are the same line; all points of a component must
            use the same side.
        normal_x: sum of the x components of the normals.
        normal_y: sum of the y components.
        components: number of components.

    Returns:
        rho (metres, >= 0), theta (radians, in [-pi, pi)) and number of points; NaN for a component without points.
    """
    count, rho, x, y = (np.bincount(component, values, components) for values in (points, rho, normal_x, normal_y))
    side = np.where(rho < 0, -1.0, 1.0)  # (-rho, n) is the line (rho, -n)
    theta = np.arctan2(side * y, side * x)
    theta[theta >= np.pi] = -np.pi
    empty = count == 0
    theta[empty] = np.nan
    rho = np.abs(rho) / np.where(empty, np.nan, count)
    return rho, theta, count.astype(np.int64)


class _Runs(NamedTuple):
    """Sums over runs: neighboring points of an arc in one component and on one side of the origin."""

    scan: Int[np.ndarray, " runs"]
    echo: Int[np.ndarray, " runs"]
    """Column of the batch."""
    label: Int[np.ndarray, " runs"]
    """Component k, or -k for the far side of a component that joins across rho = 0."""
    points: Int[np.ndarray, " runs"]
    """Number of points."""
    rho: Float[np.ndarray, " runs"]
    """Sum of the distances, metres, with the sign that makes all points of the component lie on one side."""
    normal_x: Float[np.ndarray, " runs"]
    """Sum of the x components of the normals, likewise."""
    normal_y: Float[np.ndarray, " runs"]
    """Sum of the y components of the normals, likewise."""


def _find_runs(
    tables: ArcTables, batch: EchoBatch, voted: kernels.Votes, labels: Int[np.ndarray, "rows theta_and_one rho"]
) -> _Runs:
    """Runs of points in components. Only the steps up to ``reduceat`` pass over all points."""
    assert batch.piece is not None
    assert batch.owner is not None
    scans, width = len(batch.scans), kernels.PIECE_POINTS
    piece, owner = batch.piece[:scans], batch.owner[:scans]
    cell, rho = np.asarray(voted.cell), np.asarray(voted.rho)[:scans].ravel()
    # Look up the component of each point; scan by scan, so that the labels of a scan stay in the cache.
    label = np.empty((scans, *cell.shape[1:]), labels.dtype)
    for scan in range(scans):
        np.take(labels[scan], cell[scan], out=label[scan], mode="clip")  # all indices are valid; "clip" is fastest
    label = label.ravel()
    # A run starts where the component or the side of the origin changes, and at the first point of every arc.
    behind = rho < 0
    starts = np.ones(rho.size, bool)
    np.not_equal(label[1:], label[:-1], out=starts[1:])
    starts[1:] |= behind[1:] != behind[:-1]
    starts[::width] |= piece.ravel() == 0
    first = np.flatnonzero(starts)
    used = np.flatnonzero(label[first])
    end = np.empty_like(first)
    end[:-1], end[-1] = first[1:], rho.size
    first, points, total = first[used], (end - first)[used], np.add.reduceat(rho, first)[used]
    # The sum of the normals of a run is a difference of cumulative sums.
    label, behind, at = label[first].astype(np.int64), behind[first], first // width
    scan, echo = at // owner.shape[1], owner.ravel()[at]
    path = batch.path[scan, echo]
    begin = piece.ravel()[at] * width + first - at * width
    normal_x, normal_y = (sums[path, begin + points] - sums[path, begin] for sums in tables.normal_sums)
    if batch.pose is not None:
        turn = unit(batch.pose[scan, echo, 2])
        normal_x, normal_y = (
            turn[:, 0] * normal_x - turn[:, 1] * normal_y,
            turn[:, 1] * normal_x + turn[:, 0] * normal_y,
        )
    side = np.where(behind ^ (label < 0), -1.0, 1.0)
    return _Runs(scan, echo, label, points, side * total, side * normal_x, side * normal_y)


def sensor_positions(arcs: kernels.RingArcs, batch: EchoBatch) -> Float[np.ndarray, "scans echoes 2"]:
    """Real or virtual sensor of every echo in the frame of the lines, metres (paper, section 5)."""
    sensor = np.asarray(arcs.paths.midpoint)[batch.path[: len(batch.scans)]]
    if batch.pose is None:
        return sensor
    pose = batch.pose[: len(batch.scans)]
    along = unit(pose[..., 2])
    return pose[..., :2] + sensor[..., :1] * along + sensor[..., 1:] * perpendicular(along)


def _segment_endpoints(
    rho: Float[np.ndarray, "scans components"],
    theta: Float[np.ndarray, "scans components"],
    sensors: Float[np.ndarray, "scans echoes 2"],
    involved: Bool[np.ndarray, "scans components echoes"],
) -> Float[np.ndarray, "scans components 2 2"]:
    """``kernels.segment_endpoints`` of many lines in NumPy, without a row for the echoes that are not involved."""
    segments = np.full((rho.size, 2, 2), np.nan, np.float32)
    line, echo = np.divmod(np.flatnonzero(involved), involved.shape[2])
    if len(line):
        x, y = np.cos(theta).ravel(), np.sin(theta).ravel()
        sensor = sensors[line // involved.shape[1], echo]
        foot = sensor[:, 1] * x[line] - sensor[:, 0] * y[line]
        first = np.flatnonzero(np.concatenate([[True], line[1:] != line[:-1]]))
        own = line[first]
        rho, x, y = rho.ravel()[own], x[own], y[own]
        for end, outermost in enumerate((np.minimum, np.maximum)):
            along = outermost.reduceat(foot, first)
            segments[own, end, 0] = rho * x - along * y
            segments[own, end, 1] = rho * y + along * x
    return segments.reshape(*involved.shape[:2], 2, 2)
