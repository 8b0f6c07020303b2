"""The NumPy range models agree with the kernels, their derivatives with finite differences."""

import jax
import numpy as np
import pytest

from jaxsonar import Ring, kernels
from jaxsonar.kernels import measurement_model
from jaxsonar.sensors.range_models import RANGE_OF_KIND, plane_footpoint, predict_ranges

KERNEL_OF_KIND = {
    kernels.PLANE: measurement_model.plane_echo,
    kernels.CORNER: measurement_model.corner_echo,
    kernels.EDGE: measurement_model.edge_echo,
}


@pytest.mark.parametrize("kind", list(RANGE_OF_KIND))
def test_range_models_agree_with_the_kernels(kind, rng):
    paths = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), Ring.circular().echo_paths)
    parameters, range_of = np.array([1.3, 0.4]), RANGE_OF_KIND[kind]
    with jax.enable_x64(True):
        exact = jax.vmap(KERNEL_OF_KIND[kind], in_axes=(None, 0))(jax.numpy.asarray(parameters), paths)
    found = range_of(parameters[None], paths.midpoint, paths.half_baseline)
    np.testing.assert_allclose(found.range, exact.range, rtol=1e-12)
    np.testing.assert_allclose(found.d_range_d_landmark, exact.d_range_d_landmark, atol=1e-12)
    np.testing.assert_allclose(found.departure, exact.departure, atol=1e-12)
    np.testing.assert_allclose(found.arrival, exact.arrival, atol=1e-12)
    step = 1e-6 * rng.normal(size=(2, 2))
    moved = range_of(parameters[None], paths.midpoint + step[0], paths.half_baseline + step[1])
    change = found.d_range_d_midpoint @ step[0] + found.d_range_d_half_baseline @ step[1]
    np.testing.assert_allclose(moved.range - found.range, change, atol=1e-10)


def test_the_footpoint_of_a_plane_agrees_with_the_kernel():
    paths = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), Ring.circular().echo_paths)
    plane = np.array([1.3, 0.4])
    with jax.enable_x64(True):
        exact = jax.vmap(measurement_model.plane_echo, in_axes=(None, 0))(jax.numpy.asarray(plane), paths).footpoint
    found = plane_footpoint(plane, paths.midpoint, paths.half_baseline, min_height=1e-6)
    np.testing.assert_allclose(found, exact, atol=1e-12)


def test_mixed_kinds_give_the_ranges_of_each_kind(rng):
    kind = np.array([0, 2, 1, 0], dtype=np.int32)
    parameters = rng.uniform(0.5, 1.5, (4, 1, 2))
    midpoint, half_baseline = rng.normal(size=(1, 5, 2)), rng.normal(size=(1, 5, 2)) / 9
    found = predict_ranges(kind, parameters, midpoint, half_baseline)
    for row, one in enumerate(kind.tolist()):
        expected = RANGE_OF_KIND[one](parameters[row], midpoint[0], half_baseline[0]).range
        np.testing.assert_array_equal(found.range[row], expected)
