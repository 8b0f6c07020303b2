"""Echoes of circles: the shortest path over the circle, its limits plane and pole, derivatives, both precisions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.echo_paths import paths_between
from support.oracles import shortest_path_over_circle

from jaxsonar.kernels import measurement_model
from jaxsonar.sensors import range_models

PATHS = 400
circle_echoes = jax.jit(jax.vmap(measurement_model.circle_echo))
curved_echoes = jax.jit(jax.vmap(measurement_model.curved_echo))


def scenes(rng, *, spread=0.4, radius=None):
    """Random sensors around the origin and circles in front of them: tx, rx, (rho, theta, kappa), (x, y, radius)."""
    tx, rx = rng.uniform(-spread, spread, (2, PATHS, 2))
    rx[::4] = tx[::4]
    radius = 10 ** rng.uniform(-3, 2, PATHS) if radius is None else np.full(PATHS, radius)
    theta, rho = rng.uniform(-3.1, 3.1, PATHS), rng.uniform(0.6, 2, PATHS)
    n = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    curved = np.column_stack([rho, theta, 1 / np.maximum(radius, 1e-9)])
    return tx, rx, curved, np.column_stack([(rho + radius)[:, None] * n, radius])


def is_between(tx, rx, circle):
    """Whether the circle cuts the straight line from tx to rx, or one of them is inside."""
    along = rx - tx
    share = ((circle[:, :2] - tx) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-300)
    nearest = tx + np.clip(share, 0, 1)[:, None] * along
    return np.linalg.norm(nearest - circle[:, :2], axis=-1) < circle[:, 2]


@pytest.mark.parametrize("spread", [0.3, 0.7, 1.5])
def test_the_range_is_that_of_the_shortest_path_over_the_circle(spread, rng):
    tx, rx, curved, circle = scenes(rng, spread=spread)
    expected, between = shortest_path_over_circle(circle, tx, rx) / 2, is_between(tx, rx, circle)
    with jax.enable_x64(True):
        path = paths_between(tx, rx, dtype=jnp.float64)
        by_circle = circle_echoes(jnp.asarray(circle[:, :2]), jnp.asarray(circle[:, 2]), path)
        by_curvature = curved_echoes(jnp.asarray(curved), path)
    numpy_ranges = [
        range_models.circle_range(circle, (tx + rx) / 2, (rx - tx) / 2),
        range_models.curved_range(curved, (tx + rx) / 2, (rx - tx) / 2),
    ]
    for echo in (by_circle, by_curvature):
        np.testing.assert_array_equal(echo.exists, ~between)
        assert np.isfinite(echo.range).all()
    for came in (by_circle, by_curvature, *numpy_ranges):
        np.testing.assert_allclose(np.asarray(came.range)[~between], expected[~between], atol=1e-8)
    for kernel, numpy_range in zip((by_circle, by_curvature), numpy_ranges, strict=True):
        for field in ("d_range_d_landmark", "departure", "arrival"):
            came = getattr(numpy_range, field)[~between]
            np.testing.assert_allclose(came, np.asarray(getattr(kernel, field))[~between], atol=1e-7, err_msg=field)


def test_the_circle_of_radius_0_is_an_edge(rng):
    tx, rx, _, circle = scenes(rng, radius=0.0)
    came = range_models.circle_range(circle, (tx + rx) / 2, (rx - tx) / 2)
    edge = range_models.edge_range(circle[:, :2], (tx + rx) / 2, (rx - tx) / 2)
    np.testing.assert_allclose(came.range, edge.range, atol=1e-12)
    np.testing.assert_allclose(came.d_range_d_landmark[:, :2], edge.d_range_d_landmark, atol=1e-12)
    kernel = circle_echoes(
        jnp.asarray(circle[:, :2], jnp.float32), jnp.asarray(circle[:, 2], jnp.float32), paths_between(tx, rx)
    )
    np.testing.assert_allclose(kernel.range, edge.range, atol=1e-6)
    assert kernel.exists.all()


@pytest.mark.parametrize("kappa", [0.0, 1e-12, 1e-9, 1e-7])
def test_the_curvature_0_is_a_plane(kappa, rng):
    tx, rx, curved, _ = scenes(rng)
    curved[:, 2] = kappa
    came = range_models.curved_range(curved, (tx + rx) / 2, (rx - tx) / 2)
    plane = range_models.plane_range(curved[:, :2], (tx + rx) / 2, (rx - tx) / 2)
    np.testing.assert_allclose(came.range, plane.range, atol=1e-12 + kappa)
    np.testing.assert_allclose(came.d_range_d_landmark[:, :2], plane.d_range_d_landmark, atol=1e-9 + 10 * kappa)
    kernel = curved_echoes(jnp.asarray(curved, jnp.float32), paths_between(tx, rx))
    np.testing.assert_allclose(kernel.range, plane.range, atol=1e-6)
    np.testing.assert_allclose(kernel.d_range_d_landmark, came.d_range_d_landmark, atol=1e-5)


def test_a_direct_echo_has_the_closed_form_of_the_distance_from_a_circle(rng):
    """Also for concave surfaces, kappa < 0, whose center is far behind the sensors."""
    tx, _, curved, _ = scenes(rng)
    curved[::2, 2] = -rng.uniform(0, 0.2, PATHS // 2)
    rho, theta, kappa = curved.T
    height = rho - (tx[:, 0] * np.cos(theta) + tx[:, 1] * np.sin(theta))
    along = tx[:, 1] * np.cos(theta) - tx[:, 0] * np.sin(theta)
    square = height**2 + along**2
    distance = (2 * height + kappa * square) / (1 + np.sqrt(1 + 2 * kappa * height + kappa**2 * square))
    came = range_models.curved_range(curved, tx, np.zeros_like(tx))
    np.testing.assert_allclose(came.range, distance, atol=1e-12)
    with jax.enable_x64(True):
        kernel = curved_echoes(jnp.asarray(curved), paths_between(tx, tx, dtype=jnp.float64))
    np.testing.assert_allclose(kernel.range, distance, atol=1e-12)


def test_single_precision_is_exact_to_a_micrometre_at_every_curvature(rng):
    tx, rx, curved, circle = scenes(rng)
    curved[:100, 2] = 10 ** rng.uniform(-9, -1, 100)
    exact = range_models.curved_range(curved, (tx + rx) / 2, (rx - tx) / 2)
    path = paths_between(tx, rx)
    came = curved_echoes(jnp.asarray(curved, jnp.float32), path)
    good = np.asarray(came.exists)
    assert good.mean() > 0.9
    assert came.range.dtype == jnp.float32
    np.testing.assert_allclose(came.range[good], exact.range[good], atol=2e-6)
    np.testing.assert_allclose(came.d_range_d_landmark[good], exact.d_range_d_landmark[good], atol=2e-5)
    small = circle[:, 2] < 1
    came = circle_echoes(jnp.asarray(circle[:, :2], jnp.float32), jnp.asarray(circle[:, 2], jnp.float32), path)
    exact = range_models.circle_range(circle, (tx + rx) / 2, (rx - tx) / 2)
    np.testing.assert_allclose(came.range[small & good], exact.range[small & good], atol=2e-6)


# derivatives


def circle_range_of(x, path):
    return measurement_model.circle_range(x[:2], x[2], path.midpoint, path.half_baseline)


def curved_range_of(x, path):
    return measurement_model.curved_echo(x, path).range


@pytest.mark.parametrize("curved", [False, True])
def test_derivatives_equal_finite_differences_and_forward_and_reverse_gradients(curved, rng):
    tx, rx, by_curvature, circle = scenes(rng)
    keep = (by_curvature[:, 2] < 50) & ~is_between(tx, rx, circle)
    tx, rx, by_curvature, circle = tx[keep], rx[keep], by_curvature[keep], circle[keep]
    if curved:
        by_curvature[::5, 2] = 0.0
    value = by_curvature if curved else circle
    one_range = curved_range_of if curved else circle_range_of
    with jax.enable_x64(True):
        path, x = paths_between(tx, rx, dtype=jnp.float64), jnp.asarray(value)
        ranges = jax.jit(jax.vmap(one_range))
        steps = 1e-6 * np.eye(3)[:, None]
        numerical = np.stack([(ranges(x + s, path) - ranges(x - s, path)) / 2e-6 for s in steps], axis=-1)
        came = curved_echoes(x, path) if curved else circle_echoes(x[:, :2], x[:, 2], path)
        np.testing.assert_allclose(came.d_range_d_landmark, numerical, atol=2e-7, rtol=1e-6)
        for jacobian in (jax.jacfwd, jax.jacrev):
            there = jax.jit(jax.vmap(jacobian(one_range)))(x, path)
            np.testing.assert_allclose(there, came.d_range_d_landmark, atol=1e-9, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("curved", [False, True])
def test_second_derivatives_equal_finite_differences_of_the_first(curved, rng):
    tx, rx, by_curvature, circle = scenes(rng, radius=0.3)
    value = by_curvature if curved else circle
    one_range = curved_range_of if curved else circle_range_of
    with jax.enable_x64(True):
        path, x = paths_between(tx, rx, dtype=jnp.float64), jnp.asarray(value)
        step = jnp.asarray(rng.normal(size=(1, 3)) * np.ones((PATHS, 1)))
        first = jax.jit(jax.vmap(jax.grad(one_range)))
        numerical = (first(x + 1e-5 * step, path) - first(x - 1e-5 * step, path)) / 2e-5
        _, came = jax.jit(lambda x, step: jax.jvp(lambda x: first(x, path), (x,), (step,)))(x, step)
    np.testing.assert_allclose(came, numerical, atol=1e-7)


@pytest.mark.parametrize("curved", [False, True])
def test_derivatives_by_the_sensors_equal_finite_differences(curved, rng):
    tx, rx, by_curvature, circle = scenes(rng, radius=0.3)
    model, value = (range_models.curved_range, by_curvature) if curved else (range_models.circle_range, circle)
    midpoint, half = (tx + rx) / 2, (rx - tx) / 2
    came = model(value, midpoint, half)
    for axis in np.eye(2):
        moved = [model(value, midpoint + s * axis, half).range for s in (1e-6, -1e-6)]
        np.testing.assert_allclose(came.d_range_d_midpoint @ axis, (moved[0] - moved[1]) / 2e-6, atol=1e-8)
        moved = [model(value, midpoint, half + s * axis).range for s in (1e-6, -1e-6)]
        np.testing.assert_allclose(came.d_range_d_half_baseline @ axis, (moved[0] - moved[1]) / 2e-6, atol=1e-8)


def test_numpy_models_broadcast(rng):
    """Every reflector against every path."""
    tx, rx, curved, circle = scenes(rng, radius=0.2)
    for model, value in ((range_models.curved_range, curved), (range_models.circle_range, circle)):
        every = model(value[:5, None], (tx + rx)[None, :7] / 2, (rx - tx)[None, :7] / 2)
        assert every.range.shape == (5, 7)
        assert every.d_range_d_landmark.shape == (5, 7, 3)
        assert every.d_range_d_midpoint.shape == every.d_range_d_half_baseline.shape == (5, 7, 2)
        one = model(value[3], (tx + rx)[6] / 2, (rx - tx)[6] / 2)
        np.testing.assert_allclose(one.range, every.range[3, 6], atol=1e-14)


@jax.jit
def sums(x, path):
    """A sum over all that a circle predicts, in both of its parametrizations."""
    echo = jax.vmap(lambda p: measurement_model.curved_echo(x, p))(path)
    radius = 1 / (x[2] + 1e-3)
    circle = jax.vmap(lambda p: measurement_model.circle_echo(jnp.stack([0.5 + radius, x[1]]), radius, p))(path)
    return sum(e.range.sum() + e.d_range_d_landmark.sum() + e.departure.sum() for e in (echo, circle))


value_and_gradient = jax.jit(jax.value_and_grad(sums))


@pytest.mark.slow
@pytest.mark.parametrize("place", [(0.5, 0.0), (0.7, 0.0), (1.2, 0.1)])
@pytest.mark.parametrize("kappa", [0.0, 5.0, 1e3])
def test_values_and_gradients_are_finite_if_a_sensor_is_on_or_behind_the_reflector(place, kappa):
    here, there = np.array([place, place, (0.1, 0.2)]), np.array([place, (0.1, 0.2), place])
    value, slope = value_and_gradient(jnp.asarray([0.5, 0.0, kappa], jnp.float32), paths_between(here, there))
    assert np.isfinite(value)
    assert np.isfinite(slope).all()
