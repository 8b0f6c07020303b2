"""Walls of an occupancy grid, such as a laser map: cells to segments with covariances, for localization.

Occupied cells beside free ones are the surfaces that sound and light meet. Neighboring surface cells that face the
same way form groups, each is split at its corners and gaps, and a line is fitted to each part (split and merge, with
total least squares).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation, convolve
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from jaxsonar.geometry.se2 import transform_points, wrap_angle
from jaxsonar.geometry.segments import cross
from jaxsonar.mapping.global_map import GlobalMap


@dataclass(frozen=True)
class GridWallSettings:
    """Chosen by hand on rasterized simulated rooms. Lengths in cells unless stated otherwise."""

    normal_window: int = 2
    """Free cells at most this far away determine the direction that a surface cell faces."""
    link_distance: float = 2.9
    """Surface cells at most this far apart may belong to one wall: speckle leaves out single cells."""
    link_angle: float = float(np.radians(40.0))
    """... if they face directions that differ by less, radians."""
    facing_angle: float = float(np.radians(35.0))
    """The cells of a wall face its normal within this angle, radians."""
    split_distance: float = 1.3
    """A group is split where it is farther from its line: staircase and thickness of a straight wall stay below."""
    max_gap_m: float = 0.35
    """A wall ends at a gap that is longer, metres; narrower than a door."""
    min_length_m: float = 0.25
    """Shorter walls are left out, metres."""
    unknown_border: int = 2
    """Free space counts as this many cells wider, where cells are unknown, ..."""
    min_touching: float = 0.1
    """... if a smaller fraction of the occupied cells touches free ones."""
    min_cells: int = 4
    """Least number of surface cells of a wall."""
    merge_angle: float = float(np.radians(4.0))
    """Parts of walls are joined if their directions differ by less, radians."""
    merge_distance: float = 1.0
    """... and if the joined line is at most this far from the middle of each part."""
    same_distance: float = 1.5
    """Two sides of a wall that are nearer to each other are one thin wall."""
    corner_reach_m: float = 0.35
    """Two walls meet in a corner if both end this near to their crossing, metres."""
    corner_sine: float = 0.5
    """... and if the sine of the angle between them is larger."""
    systematic: float = 0.29
    """Standard deviation of the offset of a wall that no number of cells removes: 1 / sqrt(12)."""
    min_theta_sd: float = float(np.radians(0.2))
    """Least standard deviation of the direction of a wall, radians."""


SETTINGS = GridWallSettings()


class _FittedLine(NamedTuple):
    """A line that is fitted to surface cells."""

    cells: Int[np.ndarray, " cells"]
    """Rows of the surface cells."""
    center: Float[np.ndarray, "2"]
    tangent: Float[np.ndarray, "2"]
    """Unit vector along the line; the free side is to its left."""
    extent: Float[np.ndarray, "2"]
    """Where the line begins and ends along the tangent, from the center."""
    rms: float
    """Root mean square distance of the cells."""

    @property
    def length(self) -> float:
        return float(self.extent[1] - self.extent[0])

    @property
    def normal(self) -> Float[np.ndarray, "2"]:
        return np.array([-self.tangent[1], self.tangent[0]])


def map_from_grid(
    occupied: Bool[np.ndarray, "rows columns"],
    free: Bool[np.ndarray, "rows columns"],
    *,
    resolution: float,
    origin: Float[np.ndarray, "3"],
) -> GlobalMap:
    """Walls of an occupancy grid as a global map without points.

    Args:
        occupied: occupied cells; row 0 is at the origin, rows along y, columns along x.
        free: free cells. All others are unknown; walls are extracted only where they border on free cells.
        resolution: side of a cell, metres.
        origin: world_from_grid of the outer corner of cell (0, 0): x, y (m), yaw (rad).
    """
    points, facing = _surface(occupied, free)
    lines = []
    for group in _groups(points, facing):
        lines += _split(points, facing, group, SETTINGS.max_gap_m / resolution)
    lines = _joined(points, facing, lines, SETTINGS.max_gap_m / resolution)
    least = SETTINGS.min_length_m / resolution
    lines = [line for line in lines if line.length >= least and len(line.cells) >= SETTINGS.min_cells]
    lines = _without_twins(sorted(lines, key=lambda line: -line.length))
    return _as_map(_met_at_corners(lines, SETTINGS.corner_reach_m / resolution), resolution, origin)


def _surface(
    occupied: Bool[np.ndarray, "rows columns"], free: Bool[np.ndarray, "rows columns"]
) -> tuple[Float[np.ndarray, "cells 2"], Float[np.ndarray, "cells 2"]]:
    """Centers (x, y) of the occupied cells beside free ones, in cells, and the directions that they face.

    A thin wall between free cells has two sides; its cells then occur once for each side.
    """
    reach = SETTINGS.normal_window
    touching = occupied & (convolve(free.astype(np.int8), np.ones((3, 3), np.int8), mode="constant") > 0)
    if touching.sum() < SETTINGS.min_touching * occupied.sum():
        # Careful grids leave a border of unknown cells between free space and walls.
        free = np.asarray(binary_dilation(free, iterations=SETTINGS.unknown_border, mask=~occupied), bool)
    near = convolve(free.astype(np.int8), np.ones((3, 3), np.int8), mode="constant") > 0
    rows, columns = np.nonzero(occupied & near)
    step = np.arange(-reach, reach + 1)
    dy, dx = (part.ravel() for part in np.meshgrid(step, step, indexing="ij"))
    padded = np.pad(free, reach)
    is_free = padded[rows[:, None] + dy + reach, columns[:, None] + dx + reach]
    offset = np.stack([dx, dy], axis=-1) / np.maximum(np.hypot(dx, dy), 1)[:, None]
    pull = is_free @ offset
    centers = np.stack([columns, rows], axis=-1) + 0.5
    # Free on both sides: the principal axis of the free directions is the normal of a thin wall.
    second = np.einsum("ck,ki,kj->cij", is_free.astype(np.float64), offset, offset)
    axis = np.linalg.eigh(second)[1][:, :, 1]
    strength = np.linalg.norm(pull, axis=1)
    is_thin = strength < 0.35 * is_free.sum(axis=1)
    single = pull / np.maximum(strength, 1e-9)[:, None]
    facing = np.concatenate([single[~is_thin], axis[is_thin], -axis[is_thin]])
    return np.concatenate([centers[~is_thin], centers[is_thin], centers[is_thin]]), facing


def _groups(points: Float[np.ndarray, "cells 2"], facing: Float[np.ndarray, "cells 2"]) -> list[np.ndarray]:
    """Rows of neighboring surface cells that face about the same direction."""
    if not len(points):
        return []
    pairs = KDTree(points).query_pairs(SETTINGS.link_distance, output_type="ndarray")
    alike = (facing[pairs[:, 0]] * facing[pairs[:, 1]]).sum(-1) > np.cos(SETTINGS.link_angle)
    pairs = pairs[alike]
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    count, label = connected_components(graph, directed=False)
    order = np.argsort(label, kind="stable")
    return np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1])


def _fit(points: Float[np.ndarray, "cells 2"], facing: Float[np.ndarray, "cells 2"], cells: np.ndarray) -> _FittedLine:
    """Total least squares line through surface cells; the cells in its middle are as thick as those at its ends."""
    some = points[cells]
    center = some.mean(axis=0)
    _, vectors = np.linalg.eigh((some - center).T @ (some - center))
    tangent = vectors[:, 1]
    if tangent[0] * facing[cells, 1].sum() - tangent[1] * facing[cells, 0].sum() < 0:
        tangent = -tangent
    along = (some - center) @ tangent
    across = (some - center) @ np.array([-tangent[1], tangent[0]])
    # Cells end half a cell beyond their centers.
    extent = np.array([along.min() - 0.5, along.max() + 0.5])
    return _FittedLine(cells, center, tangent, extent, float(np.sqrt(np.mean(across**2))))


def _split(
    points: Float[np.ndarray, "cells 2"], facing: Float[np.ndarray, "cells 2"], cells: np.ndarray, max_gap: float
) -> list[_FittedLine]:
    """Lines through a group of surface cells, split at gaps and where the group is far from its line."""
    if len(cells) < 2:
        return []
    line = _fit(points, facing, cells)
    along = (points[cells] - line.center) @ line.tangent
    order = np.argsort(along, kind="stable")
    cells, along = cells[order], along[order]
    gap = np.diff(along)
    if gap.max() > max_gap:
        at = int(gap.argmax()) + 1
        return _split(points, facing, cells[:at], max_gap) + _split(points, facing, cells[at:], max_gap)
    across = (points[cells] - line.center) @ line.normal
    # The median of neighbors, so that single speckles split nothing.
    smooth = np.array([np.median(across[max(k - 2, 0) : k + 3]) for k in range(len(across))])
    if len(cells) < 2 * SETTINGS.min_cells or np.abs(smooth).max() < SETTINGS.split_distance:
        # Cells in a corner face neither of its walls.
        is_mine = np.abs(across) < max(2.5 * line.rms, 1.0)
        is_mine &= facing[cells] @ line.normal > np.cos(SETTINGS.facing_angle)
        return [_fit(points, facing, cells[is_mine])] if is_mine.sum() >= SETTINGS.min_cells else []
    # The farthest cell from the chord between the ends of the group.
    ends = np.stack([along[[0, -1]], smooth[[0, -1]]], axis=-1)
    chord = np.interp(along, ends[:, 0], ends[:, 1])
    at = int(np.abs(smooth - chord).argmax())
    at = min(max(at, SETTINGS.min_cells // 2), len(cells) - SETTINGS.min_cells // 2)
    return _split(points, facing, cells[:at], max_gap) + _split(points, facing, cells[at:], max_gap)


def _joined(
    points: Float[np.ndarray, "cells 2"], facing: Float[np.ndarray, "cells 2"], lines: list[_FittedLine], max_gap: float
) -> list[_FittedLine]:
    """Lines of which neighboring collinear ones are joined, the longest first."""
    lines = sorted(lines, key=lambda line: -line.length)
    k = 0
    while k < len(lines):
        mine = lines[k]
        for j in range(k + 1, len(lines)):
            both = _union(points, facing, mine, lines[j], max_gap)
            if both is not None:
                lines[k] = both
                del lines[j]
                break
        else:
            k += 1
    return lines


def _union(
    points: Float[np.ndarray, "cells 2"],
    facing: Float[np.ndarray, "cells 2"],
    one: _FittedLine,
    other: _FittedLine,
    max_gap: float,
) -> _FittedLine | None:
    """The line through both, or None if they are not parts of one wall."""
    if other.tangent @ one.tangent < np.cos(SETTINGS.merge_angle + 1.0 / max(other.length, 1.0)):
        return None
    ends = (other.center + other.extent[:, None] * other.tangent - one.center) @ one.tangent
    if max(ends.min() - one.extent[1], one.extent[0] - ends.max()) > max_gap:
        return None
    if abs((other.center - one.center) @ one.normal) > SETTINGS.split_distance + 0.02 * abs(ends.mean()):
        return None
    both = _fit(points, facing, np.concatenate([one.cells, other.cells]))
    far = [abs((part.center - both.center) @ both.normal) for part in (one, other)]
    return both if max(far) < SETTINGS.merge_distance and both.rms < SETTINGS.split_distance else None


def _without_twins(lines: list[_FittedLine]) -> list[_FittedLine]:
    """Lines without those that are the other side of a thin wall; the longest first."""
    kept: list[_FittedLine] = []
    for line in lines:
        ends = line.center + line.extent[:, None] * line.tangent
        for other in kept:
            offset = ends - other.center
            is_beside = np.abs(offset @ other.normal).max() < SETTINGS.same_distance
            along = offset @ other.tangent
            if is_beside and along.min() > other.extent[0] - 2 and along.max() < other.extent[1] + 2:
                break
        else:
            kept.append(line)
    return kept


def _met_at_corners(lines: list[_FittedLine], reach: float) -> list[_FittedLine]:
    """Lines whose ends are moved to where they cross another line, if both end near there.

    The cells in a corner belong to neither wall.
    """
    tangent = np.array([line.tangent for line in lines]).reshape(-1, 2)
    center = np.array([line.center for line in lines]).reshape(-1, 2)
    extent = np.array([line.extent for line in lines]).reshape(-1, 2)
    sine = cross(tangent[:, None], tangent[None])
    crossing = np.abs(sine) > SETTINGS.corner_sine
    offset = center[None] - center[:, None]
    # Position of the crossing along the first line of each pair; that along the second is the transposed matrix.
    along = cross(offset, tangent[None]) / np.where(crossing, sine, 1.0)
    gap = np.abs(along[..., None] - extent[:, None])  # (lines, lines, ends)
    meets = crossing & (gap.min(axis=-1) < reach) & (reach > gap.min(axis=-1).T)
    moved = extent.copy()
    for k in range(len(lines)):
        for end in (0, 1):
            candidates = np.flatnonzero(meets[k] & (gap[k].argmin(axis=-1) == end))
            if len(candidates):
                moved[k, end] = along[k, candidates[gap[k, candidates, end].argmin()]]
    return [line._replace(extent=ends) for line, ends in zip(lines, moved, strict=True) if ends[1] > ends[0]]


def _as_map(lines: list[_FittedLine], resolution: float, origin: Float[np.ndarray, "3"]) -> GlobalMap:
    """Lines in cells as walls in the world frame, with standard deviations by the size of the cells."""
    count = len(lines)
    ends = np.array([line.center + line.extent[:, None] * line.tangent for line in lines]).reshape(-1, 2, 2)
    segments = transform_points(origin, resolution * ends)
    along = segments[:, 1] - segments[:, 0]
    theta = np.arctan2(along[:, 1], along[:, 0]) - np.pi / 2
    normal = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    rho = (normal * segments[:, 0]).sum(-1)
    theta = wrap_angle(np.where(rho < 0, theta + np.pi, theta))
    cells = np.array([len(line.cells) for line in lines], dtype=np.float64)
    length = np.array([line.length for line in lines])
    scatter = np.maximum([line.rms for line in lines], SETTINGS.systematic) / np.sqrt(np.maximum(cells, 1.0))
    across = resolution * np.hypot(scatter, SETTINGS.systematic)
    turn = np.maximum(np.sqrt(12) * scatter / np.maximum(length, 1.0), SETTINGS.min_theta_sd)
    # sigma_rho is that of the distance from the origin of the world: the direction adds to it far away.
    arm = (segments.mean(axis=1) * np.stack([-np.sin(theta), np.cos(theta)], axis=-1)).sum(-1)
    sigma_rho = np.hypot(across, arm * turn)
    return GlobalMap(
        segments, np.abs(rho), theta, sigma_rho, turn, cells.astype(np.int64), tuple(() for _ in range(count))
    )
