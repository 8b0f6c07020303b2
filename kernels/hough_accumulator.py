"""The accumulator: votes of tangent lines, low pass, threshold (paper, section 4).

Rows are theta, columns are rho. The parameter space of lines has two seams, and neighborhoods extend across both:
theta wraps around, and the column before rho = 0 is the first column shifted by half a turn, because (-rho, theta) is
the line (rho, theta + pi).
"""

from dataclasses import dataclass
from functools import partial, reduce

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num

from .planar_geometry import fold_line, wrap_angle
from .sensor_array import EchoPaths

_DIRECTIONS = 719  # samples of the full turn; a prime number, so that they do not align with cones or cells


@dataclass(frozen=True)
class HoughSettings:
    """Parameters of the Hough transform: the values of the paper (section 4); where it has none, chosen by hand.

    Raises:
        ValueError: a value is out of range; the message names it and the allowed values.
    """

    theta_cells: int = 100
    """Number of cells in theta, even; 100 give cells of 0.0628 rad (paper)."""
    rho_cells: int = 100
    """Number of cells in rho, from 0 outward."""
    rho_cell: float = 0.04
    """Size of a cell in rho, metres."""
    point_pitch: float = float(np.radians(1.0))
    """Distance between the points of an arc, radians."""
    smoothing: tuple[float | int, ...] = (1.0, 2.0, 1.0)
    """Taps of the low pass along theta and along rho, an odd number; they are normalized to the sum 1."""
    threshold: float = 0.2
    """Occupancy that a cell must exceed, as a fraction of the votes of a fully visible wall. 0.2 finds most walls for
    300 poses in random rooms other than the demo's (``python -m benchmarks.detection.threshold_sweep``)."""
    min_echoes: int = 3
    """Smallest number of echoes of a line: two determine it, a third confirms it."""

    def __post_init__(self):
        allowed = {
            "theta_cells": (
                4 <= self.theta_cells <= 10_000 and self.theta_cells % 2 == 0,
                "an even number, 4 to 10000",
            ),
            "rho_cells": (
                2 <= self.rho_cells <= 10_000 and self.cells <= 1_000_000,
                "2 to 10000, with theta_cells at most a million cells",
            ),
            "rho_cell": (1e-4 <= self.rho_cell <= 100, "0.0001 to 100 m"),
            "point_pitch": (1e-4 <= self.point_pitch <= np.pi, "0.0001 to pi rad"),
            "smoothing": (
                len(self.smoothing) % 2 == 1
                and len(self.smoothing) <= min(self.theta_cells, self.rho_cells)
                and all(0 <= tap <= 1e6 for tap in self.smoothing)
                and sum(self.smoothing) > 0,
                "an odd number of taps, 0 to 1e6, not all 0",
            ),
            "threshold": (0 <= self.threshold <= 1e6, "0 to 1e6"),
            "min_echoes": (self.min_echoes >= 1, "1 or more"),
        }
        for key, (good, what) in allowed.items():
            if not good:
                raise ValueError(f"{key} = {getattr(self, key)!r}; allowed is {what}")

    @property
    def theta_cell(self) -> float:
        """Size of a cell in theta, radians."""
        return 2 * float(np.pi) / self.theta_cells

    @property
    def cells(self) -> int:
        """Number of cells of the accumulator."""
        return self.theta_cells * self.rho_cells

    @property
    def max_rho(self) -> float:
        """Largest distance that the accumulator holds, metres."""
        return self.rho_cells * self.rho_cell


def theta_row(theta: Float[Array, "*lines"], settings: HoughSettings) -> Int[Array, "*lines"]:
    """Row of the accumulator for the direction theta (radians, not necessarily wrapped)."""
    row = jnp.floor((wrap_angle(theta) + jnp.pi) / settings.theta_cell).astype(jnp.int32)
    return jnp.minimum(row, settings.theta_cells - 1)  # rounding just below pi


def cell_of(
    rho: Float[Array, "*lines"],
    row: Int[Array, "*lines"],
    exists: Bool[Array, "*lines"],
    settings: HoughSettings,
) -> Int[Array, "*lines"]:
    """Flat index row * rho_cells + column of each line's cell, from its distance (any sign) and its row.

    Lines that do not exist and lines beyond the accumulator get the index one past the last cell.

    Oracle: ``cell`` of tests/support/oracles.py.
    """
    turned = row + settings.theta_cells // 2  # (-rho, theta) is (rho, theta + pi)
    turned = jnp.where(turned < settings.theta_cells, turned, turned - settings.theta_cells)
    row = jnp.where(rho < 0, turned, row)
    column = jnp.floor(jnp.abs(rho) / settings.rho_cell)
    inside = exists & (column < settings.rho_cells)
    column = jnp.where(inside, column, 0).astype(jnp.int32)
    return jnp.where(inside, row * settings.rho_cells + column, settings.cells)


def accumulate(cells: Int[Array, "*lines"], settings: HoughSettings) -> Int[Array, "theta rho"]:
    """Number of points in each cell. The votes are integers, so that their order and the device do not matter.

    Oracle: ``accumulate`` of tests/support/oracles.py.
    """
    votes = jnp.zeros(settings.cells + 1, jnp.int32).at[cells.ravel()].add(1, mode="promise_in_bounds")
    return votes[:-1].reshape(settings.theta_cells, settings.rho_cells)


def soft_accumulate(
    rho: Float[Array, "*lines"],
    theta: Float[Array, "*lines"],
    weight: Float[Array, "*lines"],
    settings: HoughSettings,
) -> Float[Array, "theta rho"]:
    """Weighted votes by bilinear interpolation: differentiable in rho, theta and weight.

    The votes of a line in the four cells around it sum to its weight. A line at the center of a cell votes for this
    cell only, as in ``accumulate``.
    """
    rows, columns = settings.theta_cells, settings.rho_cells
    rho, theta = fold_line(rho, theta)
    row = (theta.ravel() + jnp.pi) / settings.theta_cell - 0.5
    column = rho.ravel() / settings.rho_cell - 0.5
    weight = weight.ravel()
    first_row, first_column = jnp.floor(row), jnp.floor(column)
    votes = jnp.zeros(rows * columns + 1, weight.dtype)
    for down in (0, 1):
        for right in (0, 1):
            r = (first_row + down).astype(jnp.int32)
            c = (first_column + right).astype(jnp.int32)
            share = weight * (1 - jnp.abs(row - first_row - down)) * (1 - jnp.abs(column - first_column - right))
            r = jnp.where(c < 0, r + rows // 2, r) % rows  # before rho = 0 the same line is half a turn further
            c = jnp.where(c < 0, -1 - c, c)
            index = jnp.where(c < columns, r * columns + c, rows * columns)
            votes = votes.at[index].add(share, mode="promise_in_bounds")
    return votes[:-1].reshape(rows, columns)


def lowpass(votes: Num[Array, "theta rho"], settings: HoughSettings) -> Float[Array, "theta rho"]:
    """Two-dimensional low pass across both seams (paper, section 4); beyond the last column there are no votes.

    Oracle: ``lowpass`` of tests/support/oracles.py.
    """
    taps = (np.asarray(settings.smoothing) / np.sum(settings.smoothing)).tolist()
    half, (rows, columns) = len(taps) // 2, votes.shape
    smooth = jnp.asarray(votes, jnp.float32)
    # Along theta, then along rho, each on one padded array, so that XLA compiles each to one loop.
    wide = jnp.zeros((rows + 2 * half, columns)).at[half : half + rows].set(smooth)
    wide = wide.at[:half].set(smooth[rows - half :]).at[half + rows :].set(smooth[:half])
    smooth = sum((tap * wide[k : k + rows] for k, tap in enumerate(taps)), start=jnp.zeros(()))
    before = _before(smooth, half)
    wide = jnp.zeros((rows, columns + 2 * half)).at[:, half : half + columns].set(smooth).at[:, :half].set(before)
    return sum((tap * wide[:, k : k + columns] for k, tap in enumerate(taps)), start=jnp.zeros(()))


def _before(cells: Float[Array, "theta rho"], width: int) -> Float[Array, "theta width"]:
    """The columns before the first one: (-rho, theta) is (rho, theta + pi)."""
    return jnp.roll(cells[:, :width][:, ::-1], len(cells) // 2, axis=0)


def extend_across_seams(cells: Float[Array, "theta rho"], width: int) -> Float[Array, "rows columns"]:
    """An accumulator with this many more cells on every side: neighbors across both seams; 0 beyond the last column.

    It is one array in memory, so that XLA compiles an operation on neighborhoods to one loop.

    Oracle: ``cell_across_seams`` of tests/support/oracles.py.
    """
    rows, columns = cells.shape
    before = _before(cells, width)
    wide = jnp.zeros((rows + 2 * width, columns + 2 * width), cells.dtype)
    wide = wide.at[width:-width, width:-width].set(cells).at[width:-width, :width].set(before)
    return wide.at[:width].set(wide[rows : rows + width]).at[rows + width :].set(wide[width : 2 * width])


@partial(jax.jit, static_argnames="settings")
def full_wall_votes(paths: EchoPaths, settings: HoughSettings) -> Float[Array, ""]:
    """Votes of a fully visible wall in its cell: the unit of the threshold.

    It is the number of paths that receive the wall times the number of points that an arc has in one cell. So the
    threshold depends neither on the point pitch nor on the ring.

    Oracle: ``full_wall_votes`` of tests/support/oracles.py.
    """
    return votes_of_paths(full_wall_paths(paths), settings)


def votes_of_paths(paths: Float[Array, ""], settings: HoughSettings) -> Float[Array, ""]:
    """Votes in the cell of a wall that this many paths receive."""
    return paths * settings.theta_cell / settings.point_pitch


@jax.jit
def full_wall_paths(paths: EchoPaths) -> Float[Array, ""]:
    """Number of paths that receive a wide plane: the mean over all directions in which any path receives it."""
    directions = (jnp.arange(_DIRECTIONS, dtype=paths.width.dtype) + 0.5) * (2 * jnp.pi / _DIRECTIONS)
    received = jnp.mod(directions[:, None] - paths.start[None, :], 2 * jnp.pi) < paths.width[None, :]
    covered = jnp.maximum(received.any(axis=1).mean(), 1 / _DIRECTIONS) * 2 * jnp.pi
    return paths.width.sum() / covered


def peaks(
    smooth: Float[Array, "theta rho"], level: Float[Array, ""], *, size: int, settings: HoughSettings
) -> tuple[Float[Array, " size"], Float[Array, " size"]]:
    """The highest local maxima of an accumulator after the low pass, as lines (rho, theta).

    Args:
        smooth: occupancies.
        level: smallest occupancy of a maximum.
        size: number of maxima in the result; NaN where there are fewer.
        settings: of the accumulator.

    Returns:
        rho, theta: centroids of the occupancy in the 3 x 3 cells around each maximum, metres and radians.
    """
    rows, columns = smooth.shape
    wide = extend_across_seams(smooth, 1)
    steps = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1)]
    around = [wide[1 + down : 1 + down + rows, 1 + right : 1 + right + columns] for down, right in steps]
    earlier, later = (reduce(jnp.maximum, neighbors) for neighbors in (around[:4], around[5:]))
    # Of equal neighbors exactly one is a maximum.
    peak = jnp.where((smooth > jnp.maximum(later, level)) & (smooth >= earlier), smooth, 0)
    # Across rho = 0 each of two neighbors precedes the other: suppress the one in the second half turn.
    first, across = peak[rows // 2 :, 0], wide[1 + rows // 2 : 1 + rows, 0]
    peak = peak.at[rows // 2 :, 0].set(jnp.where(first > across, first, 0))
    height, cell = jax.lax.top_k(peak.ravel(), size)
    row, column = cell // columns, cell % columns
    mass = jnp.stack([wide[row + 1 + down, column + 1 + right] for down, right in steps])
    off = jnp.asarray(steps, smooth.dtype).T @ (mass / jnp.maximum(mass.sum(axis=0), 1e-6)[None])
    row, column = (index.astype(smooth.dtype) + 0.5 for index in (row, column))
    theta, rho = (row + off[0]) * settings.theta_cell - jnp.pi, (column + off[1]) * settings.rho_cell
    return jnp.where(height > 0, rho, jnp.nan), jnp.where(height > 0, theta, jnp.nan)
