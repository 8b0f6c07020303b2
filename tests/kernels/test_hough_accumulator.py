"""Local maxima of the accumulator equal a loop over its cells, across both seams; the paths that receive a wall."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import oracles

from jaxsonar import HoughSettings, Ring, kernels, load_ring
from jaxsonar.kernels import hough_accumulator as hough

SMALL = HoughSettings(theta_cells=12, rho_cells=9, rho_cell=0.25)
ROWS, COLUMNS = SMALL.theta_cells, SMALL.rho_cells
AROUND = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1)]
peaks = jax.jit(hough.peaks, static_argnames=("size", "settings"))
seeds = st.integers(0, 10_000)


def peaks_of(smooth, level=0.0, size=20):
    """Lines (rho, theta) of the maxima, without unused rows."""
    rho, theta = peaks(jnp.asarray(smooth, jnp.float32), jnp.float32(level), size=size, settings=SMALL)
    assert rho.shape == theta.shape == (size,)
    np.testing.assert_array_equal(np.isnan(rho), np.isnan(theta))
    there = np.isfinite(rho)
    assert (np.diff(there.astype(int)) <= 0).all(), "NaN comes last"
    return np.column_stack([rho, theta])[there].astype(float)


def value(smooth, row, column):
    """Occupancy of a cell, also across the seams; 0 beyond the last column."""
    where = oracles.cell_across_seams(row, column, SMALL)
    return 0.0 if where is None else smooth[where]


def maxima(smooth, level):
    """(height, rho, theta) of all maxima, by a loop over the cells; valid if no neighbors are equal."""
    found = []
    for row in range(ROWS):
        for column in range(COLUMNS):
            around = {(down, right): value(smooth, row + down, column + right) for down, right in AROUND}
            height = around[0, 0]
            if height <= level or any(other >= height for step, other in around.items() if step != (0, 0)):
                continue
            mass = sum(around.values())
            down, right = (sum(step[axis] * other for step, other in around.items()) / mass for axis in (0, 1))
            theta = (row + 0.5 + down) * SMALL.theta_cell - math.pi
            found.append((height, (column + 0.5 + right) * SMALL.rho_cell, theta))
    return sorted(found, reverse=True)


def same_lines(came, wanted):
    np.testing.assert_allclose(came[:, 0], [rho for _, rho, _ in wanted], atol=1e-5)
    np.testing.assert_allclose(oracles.wrap(came[:, 1] - np.array([theta for *_, theta in wanted])), 0, atol=1e-5)


@settings(max_examples=40)
@given(seeds, st.sampled_from([0.0, 0.3, 0.9]))
def test_maxima_are_those_of_a_loop_over_all_cells_in_descending_order(seed, level):
    smooth = np.random.default_rng(seed).random((ROWS, COLUMNS)).astype(np.float32)
    wanted = maxima(smooth.astype(float), np.float32(level))
    assert len(wanted) < 40
    came = peaks_of(smooth, level, size=40)
    assert len(came) == len(wanted)
    if wanted:
        same_lines(came, wanted)


@pytest.mark.slow
@settings(max_examples=15)
@given(seeds, st.integers(1, 5))
def test_a_small_result_holds_the_highest_maxima(seed, size):
    smooth = np.random.default_rng(seed).random((ROWS, COLUMNS)).astype(np.float32)
    wanted = maxima(smooth.astype(float), 0.0)[:size]
    same_lines(peaks_of(smooth, size=size), wanted)


def test_an_empty_accumulator_and_cells_at_the_level_have_no_maxima():
    assert len(peaks_of(np.zeros((ROWS, COLUMNS)))) == 0
    flat = np.zeros((ROWS, COLUMNS))
    flat[3, 4] = 2.0
    assert len(peaks_of(flat, level=2.0)) == 0
    assert len(peaks_of(flat, level=1.99)) == 1


@pytest.mark.parametrize("row", range(ROWS))
@pytest.mark.parametrize("column", [0, 1, 4, COLUMNS - 1])
def test_an_isolated_cell_gives_the_line_at_its_center(row, column):
    smooth = np.zeros((ROWS, COLUMNS))
    smooth[row, column] = 1.0
    ((rho, theta),) = peaks_of(smooth)
    assert rho == pytest.approx((column + 0.5) * SMALL.rho_cell)
    assert oracles.wrap(theta - (row + 0.5) * SMALL.theta_cell + math.pi) == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize("row", range(ROWS))
def test_a_neighbor_across_rho_0_belongs_to_the_same_maximum(row):
    smooth = np.zeros((ROWS, COLUMNS))
    smooth[row, 0], smooth[(row + ROWS // 2) % ROWS, 0] = 3.0, 1.0
    ((rho, theta),) = peaks_of(smooth)
    assert rho == pytest.approx((0.5 - 0.25) * SMALL.rho_cell)
    assert oracles.wrap(theta - (row + 0.5) * SMALL.theta_cell + math.pi) == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize("shape", [(1, 2), (2, 1), (2, 2), (3, 2), (1, 4)])
@pytest.mark.parametrize("column", [0, 3])
@pytest.mark.parametrize("row", [0, 5, ROWS - 1])
def test_exactly_one_of_equal_neighbors_is_a_maximum(row, column, shape):
    smooth = np.zeros((ROWS, COLUMNS))
    for down in range(shape[0]):
        for right in range(shape[1]):
            smooth[(row + down) % ROWS, column + right] = 1.0
    ((rho, theta),) = peaks_of(smooth)
    middle = (column + shape[1] / 2) * SMALL.rho_cell
    assert abs(rho - middle) <= shape[1] / 2 * SMALL.rho_cell
    off = oracles.wrap(theta - (row + shape[0] / 2) * SMALL.theta_cell + math.pi)
    assert abs(off) <= shape[0] / 2 * SMALL.theta_cell


@pytest.mark.parametrize("row", [0, 3, ROWS // 2, ROWS - 1])
def test_exactly_one_of_equal_neighbors_across_rho_0_is_a_maximum(row):
    smooth = np.zeros((ROWS, COLUMNS))
    smooth[row, 0] = smooth[(row + ROWS // 2) % ROWS, 0] = 1.0
    assert len(peaks_of(smooth)) == 1


@settings(max_examples=15)
@given(seeds, st.integers(0, ROWS - 1))
def test_rotating_the_accumulator_rotates_the_lines(seed, steps):
    smooth = np.random.default_rng(seed).random((ROWS, COLUMNS)).astype(np.float32)
    here, there = peaks_of(smooth, size=40), peaks_of(np.roll(smooth, steps, axis=0), size=40)
    np.testing.assert_allclose(there[:, 0], here[:, 0], atol=1e-5)
    off = oracles.wrap(there[:, 1] - here[:, 1] - steps * SMALL.theta_cell)
    np.testing.assert_allclose(off, 0, atol=1e-5)


@pytest.mark.slow
def test_a_batch_gives_the_results_of_single_accumulators(rng):
    smooth = jnp.asarray(rng.random((3, ROWS, COLUMNS)), jnp.float32)
    level = jnp.float32(0.5)
    kernel = partial(hough.peaks, size=9, settings=SMALL)
    batch = jax.vmap(kernel, in_axes=(0, None))(smooth, level)
    for k in range(3):
        for one, all_ in zip(kernel(smooth[k], level), batch, strict=True):
            np.testing.assert_allclose(one, all_[k], atol=1e-6)


RINGS = {
    "corridor8": load_ring("corridor8"),
    "one sensor": Ring([(0.1, 0.0)], [0.3], beam=1.0, neighbors=0, max_range=2.0),
    "cones that never meet": Ring.circular(count=3, beam=1.0, neighbors=1),
    "wide": Ring.circular(count=5, beam=2 * math.pi / 3, neighbors=2),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", RINGS)
def test_the_number_of_paths_that_receive_a_wide_wall_is_that_of_a_loop(name):
    ring = RINGS[name]
    setup = HoughSettings()
    wanted = oracles.full_wall_votes(ring, setup) * setup.point_pitch / setup.theta_cell
    came = float(hough.full_wall_paths(ring.echo_paths))
    assert came == pytest.approx(wanted, rel=0.01)
    votes = float(kernels.full_wall_votes(ring.echo_paths, setup))
    assert votes == pytest.approx(came * setup.theta_cell / setup.point_pitch, rel=1e-5)


def test_with_one_sensor_one_path_receives_a_wall():
    assert float(hough.full_wall_paths(RINGS["one sensor"].echo_paths)) == pytest.approx(1, rel=0.01)
    assert float(hough.full_wall_paths(RINGS["cones that never meet"].echo_paths)) == pytest.approx(1, rel=0.01)
