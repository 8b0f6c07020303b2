"""Cramer-Rao bounds against finite differences of plain geometry, and against the scatter of simulated estimates."""

import numpy as np
import pytest
from support.reflector_paths import hears, information

from jaxsonar import Ring, kernels, load_ring
from jaxsonar.observability.cramer_rao import covariance_bound, reflector_bound
from jaxsonar.observability.reflectors import NAME_OF_KIND, ArrayPaths, is_heard, predicted_ranges, reflectors_at

RINGS = {"ring": Ring.circular(), "bumper": load_ring("bumper4")}
DISTANCE, BEARING = 1.1, 0.07
rings = pytest.mark.parametrize("name", RINGS)


def scene(kind, paths, *, radius=0.2):
    """Parameters, predicted ranges and heard paths of one reflector."""
    parameters = reflectors_at(kind, np.array([DISTANCE]), np.array([BEARING]), curvature=1 / radius)
    predicted = predicted_ranges(kind, parameters, paths)
    return parameters, predicted, is_heard(predicted, paths)


@rings
@pytest.mark.parametrize("kind", [kernels.PLANE, kernels.CORNER, kernels.EDGE])
def test_the_nominal_cones_decide_what_is_heard(name, kind):
    ring = RINGS[name]
    parameters, _, heard = scene(kind, ArrayPaths.of(ring, ring.paths))
    expected = [hears(NAME_OF_KIND[kind], parameters[0], ring, tx, rx) for tx, rx in ring.paths]
    np.testing.assert_array_equal(heard[0], expected)
    assert heard.any()


@rings
@pytest.mark.parametrize("kind", NAME_OF_KIND)
def test_the_bounds_equal_those_of_finite_differences_of_plain_geometry(name, kind):
    ring, radius = RINGS[name], 0.2
    paths = ArrayPaths.of(ring, ring.paths)
    parameters, _, heard = scene(kind, paths, radius=radius)
    plain = parameters[0].copy()
    if kind == kernels.CIRCLE:
        plain[2] = radius
    covariance = np.linalg.inv(information(NAME_OF_KIND[kind], plain, ring, ring.paths, heard[0]))
    bound = reflector_bound(kind, paths, np.array([DISTANCE]), np.array([BEARING]), radius=radius)
    assert bound.echoes[0] == heard.sum()
    if kind in (kernels.PLANE, kernels.CIRCLE):
        expected = np.sqrt(np.diag(covariance)[:2])
    else:
        n = np.array([np.cos(BEARING), np.sin(BEARING)])
        t = np.array([-n[1], n[0]])
        expected = np.sqrt([n @ covariance @ n, t @ covariance @ t / DISTANCE**2])
    np.testing.assert_allclose([bound.distance[0], bound.bearing[0]], expected, rtol=2e-3)
    if kind == kernels.CIRCLE:
        np.testing.assert_allclose(bound.curvature[0] * radius**2, np.sqrt(covariance[2, 2]), rtol=2e-3)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("ring", kernels.PLANE), ("ring", kernels.EDGE), ("bumper", kernels.CORNER), ("bumper", kernels.CIRCLE)],
)
def test_maximum_likelihood_estimates_scatter_as_much_as_the_bound(name, kind, rng):
    trials, sigma = 2000, 1e-4
    paths = ArrayPaths.of(RINGS[name], RINGS[name].paths)
    truth, predicted, heard = scene(kind, paths)
    measured = predicted.range + sigma * rng.standard_normal((trials, heard.shape[1]))
    found = np.repeat(truth, trials, axis=0)
    for _ in range(6):
        now = predicted_ranges(kind, found, paths)
        jacobian, residual = now.d_range_d_landmark * heard[..., None], (measured - now.range) * heard
        normal = np.einsum("spi,spj->sij", jacobian, jacobian)
        found = found + np.linalg.solve(normal, np.einsum("spi,sp->si", jacobian, residual)[..., None])[..., 0]
    bound = sigma**2 * covariance_bound(predicted.d_range_d_landmark, heard)[0]
    error = found - truth[0]
    np.testing.assert_allclose(error.std(axis=0), np.sqrt(np.diag(bound)), rtol=0.07)
    squared = np.einsum("si,ij,sj->s", error, np.linalg.inv(bound), error)
    assert squared.mean() == pytest.approx(truth.shape[1], rel=0.07)


def test_one_receiver_knows_a_distance_and_no_direction():
    ring = Ring.circular()
    paths = ArrayPaths.of(ring, np.array([[0, 0]]))
    for kind in (kernels.PLANE, kernels.CORNER, kernels.EDGE):
        bound = reflector_bound(kind, paths, np.array([1.0]), np.array([0.05]))
        assert bound.distance[0] == pytest.approx(1, rel=0.01)
        assert np.isinf(bound.bearing[0])
    assert np.isinf(reflector_bound(kernels.CIRCLE, paths, np.array([1.0]), np.array([0.05])).curvature[0])


def test_two_echoes_do_not_determine_the_three_parameters_of_a_circle():
    paths = ArrayPaths.of(RINGS["bumper"], np.array([[1, 1], [1, 2]]))
    bound = reflector_bound(kernels.CIRCLE, paths, np.array([1.0]), np.array([0.05]), radius=0.3)
    assert np.isinf([bound.curvature[0], bound.bearing[0], bound.distance[0]]).all()
    assert np.isfinite(reflector_bound(kernels.PLANE, paths, np.array([1.0]), np.array([0.05])).bearing[0])


def test_a_reflector_that_no_path_hears_has_no_bound():
    paths = ArrayPaths.of(RINGS["bumper"], RINGS["bumper"].paths)
    for far, bearing in ((1.0, np.pi), (5.0, 0.0)):
        bound = reflector_bound(kernels.EDGE, paths, np.array([far]), np.array([bearing]))
        assert bound.echoes[0] == 0
        assert np.isnan([bound.distance[0], bound.bearing[0]]).all()


@pytest.mark.parametrize("kind", NAME_OF_KIND)
def test_more_paths_never_weaken_a_bound(kind):
    ring = RINGS["bumper"]
    distance, bearing = np.full(20, 1.2), np.linspace(-0.2, 0.2, 20)
    less = reflector_bound(kind, ArrayPaths.of(ring, ring.paths[:9]), distance, bearing)
    more = reflector_bound(kind, ArrayPaths.of(ring, ring.paths), distance, bearing)
    for field in ("distance", "bearing", "curvature"):
        assert (getattr(more, field) <= getattr(less, field) * (1 + 1e-9)).all()


def test_the_bounds_of_known_arrays():
    """Bound of the radius per mm of range noise, surface at 1 m, from an independent computation."""
    for name, radii in (("bumper", {0.05: 4.9, 0.2: 6.0, 1.0: 15.0}), ("ring", {0.05: 200, 0.2: 300, 1.0: 1024})):
        ring = RINGS[name]
        paths = ArrayPaths.of(ring, ring.paths)
        for radius, expected in radii.items():
            bound = reflector_bound(kernels.CIRCLE, paths, np.ones(1), np.array([0.05]), radius=radius)
            assert bound.curvature[0] * radius**2 == pytest.approx(expected, rel=0.1)
