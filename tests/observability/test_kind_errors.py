"""Separations of kinds against a general least-squares solver; error rates against the theory of two hypotheses."""

import math

import numpy as np
import pytest
from scipy.optimize import least_squares
from support.reflector_paths import half_path

from jaxsonar import Ring, kernels, load_ring
from jaxsonar.observability.kind_errors import error_probability, kind_separations
from jaxsonar.observability.reflector_fits import residual_squares
from jaxsonar.observability.reflectors import (
    NAME_OF_KIND,
    THREE_KINDS,
    ArrayPaths,
    is_heard,
    predicted_ranges,
    reflectors_at,
)

RING = Ring.circular()
BUMPER = load_ring("bumper4")


def noiseless(kind, paths, distance, bearing, **options):
    predicted = predicted_ranges(kind, reflectors_at(kind, distance, bearing, **options), paths)
    return predicted.range, is_heard(predicted, paths)


def least_residual(kind, ring, pairs, ranges, distance, bearing):
    """Norm of the residuals of the best reflector by SciPy, from several starts."""
    center = ring.position.mean(axis=0)
    ends = [(ring.position[tx] - center, ring.position[rx] - center) for tx, rx in pairs]
    name = NAME_OF_KIND[kind]

    def residuals(x):
        return [half_path(name, x, *pair) - value for pair, value in zip(ends, ranges, strict=True)]

    best = np.inf
    for nudge in (0.0, 0.05):
        place = (distance + nudge, bearing + nudge)
        start = place if kind == kernels.PLANE else place[0] * np.array([math.cos(place[1]), math.sin(place[1])])
        found = least_squares(residuals, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
        best = min(best, math.sqrt(2 * found.cost))
    return best


@pytest.mark.parametrize("ring", [RING, BUMPER], ids=["ring", "bumper"])
def test_the_fits_equal_those_of_a_general_solver(ring):
    paths = ArrayPaths.of(ring, ring.paths)
    distance, bearing = np.array([1.0]), np.array([0.06])
    for kind in THREE_KINDS:
        ranges, heard = noiseless(kind, paths, distance, bearing)
        for other in THREE_KINDS:
            came = math.sqrt(residual_squares(other, paths, ranges, heard, distance, bearing)[0])
            if other == kind:
                assert came < 1e-9
                continue
            expected = least_residual(other, ring, ring.paths[heard[0]], ranges[heard], 1.0, 0.06)
            assert came == pytest.approx(expected, rel=1e-4)


def test_the_fit_of_a_circle_finds_its_curvature():
    paths = ArrayPaths.of(BUMPER, BUMPER.paths)
    distance, bearing = np.full(6, 1.0), np.linspace(-0.1, 0.1, 6)
    for radius in (0.05, 0.2, 1.0, 100.0):
        ranges, heard = noiseless(kernels.CIRCLE, paths, distance, bearing, curvature=1 / radius)
        squares = residual_squares(kernels.CIRCLE, paths, ranges, heard, distance + 0.02, bearing - 0.02)
        assert np.sqrt(squares).max() < 1e-5


def test_one_transmitter_never_distinguishes_a_plane_from_a_corner():
    """Both have an image source; a second transmitter is needed."""
    distance, bearing = np.linspace(0.7, 1.6, 9), np.linspace(-0.12, 0.12, 9)
    for pairs in (RING.paths[RING.paths[:, 0] == 0], BUMPER.paths[BUMPER.paths[:, 0] == 1]):
        ring = RING if len(pairs) > 4 else BUMPER
        found = kind_separations(ArrayPaths.of(ring, pairs), distance, bearing)
        assert found[kernels.PLANE, kernels.CORNER].max() < 1e-8
    found = kind_separations(ArrayPaths.of(BUMPER, BUMPER.paths), distance, bearing)
    assert found[kernels.PLANE, kernels.CORNER].min() > 0.1


def test_direct_echoes_never_distinguish_a_corner_from_an_edge():
    direct = RING.paths[RING.paths[:, 0] == RING.paths[:, 1]]
    found = kind_separations(ArrayPaths.of(RING, direct), np.array([1.0, 1.4]), np.array([0.0, 0.1]))
    assert found[kernels.CORNER, kernels.EDGE].max() < 1e-12


def trials(paths, kinds, count, sigma, rng):
    each = np.repeat(kinds, count)
    distance, bearing = np.full(len(each), 1.0), np.full(len(each), 0.05)
    parts = [noiseless(kind, paths, distance[:count], bearing[:count]) for kind in kinds]
    ranges, heard = (np.concatenate(part) for part in zip(*parts, strict=True))
    return each.tolist(), paths, ranges + sigma * rng.standard_normal(ranges.shape), heard, distance, bearing


def test_two_kinds_are_confused_as_often_as_their_sensitivity_index_says(rng):
    paths = ArrayPaths.of(BUMPER, BUMPER.paths)
    kinds = (kernels.CORNER, kernels.EDGE)
    separation = kind_separations(paths, np.ones(1), np.full(1, 0.05))[kinds][0]
    for index in (1.0, 2.0, 3.0):
        sigma = separation / index
        came = error_probability(*trials(paths, kinds, 1000, sigma, rng), sigma=sigma, kinds=kinds)
        assert came == pytest.approx(0.5 * math.erfc(index / 2 / math.sqrt(2)), abs=0.03)


def test_a_single_echo_leaves_the_kind_to_chance(rng):
    paths = ArrayPaths.of(RING, np.array([[0, 0]]))
    came = error_probability(*trials(paths, THREE_KINDS, 10, 0.001, rng), sigma=0.001)
    assert came == pytest.approx(2 / 3)


def test_without_echoes_there_is_no_error_rate():
    paths = ArrayPaths.of(RING, np.array([[0, 0]]))
    nothing = np.zeros((3, 1), bool)
    assert math.isnan(
        error_probability([0, 1, 2], paths, np.ones((3, 1)), nothing, np.ones(3), np.zeros(3), sigma=1e-3)
    )
